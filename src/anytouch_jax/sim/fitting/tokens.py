"""Tokens for your own sensor, trained on simulated touches of it.

Each touch is felt by your sensor and by a known one. The features of yours are drawn to those that
the frozen encoder has of the known one, among the features of other touches. No touch repeats.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.encoder.adapt import Adapted, read_model, with_row
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.encoder.base import precision
from anytouch_jax.errors import UserError
from anytouch_jax.sim.endless import CAMERAS
from anytouch_jax.sim.fitting.comparison import compare_found, found_touches
from anytouch_jax.sim.fitting.contrast import RATE, REUSE, Contrast, State, felt_batches, rate_of
from anytouch_jax.sim.fitting.touches import own_touches, own_world
from anytouch_jax.sim.sensing.own import read_numbers
from anytouch_jax.train.loop import Work
from anytouch_jax.train.tuning import tune_for_seconds
from anytouch_jax.weights import checkpoint

BATCHES = 10  # of held-out touches, before and after
TIMED = 4 * REUSE  # steps whose speed decides how many there are


def adapt_by_simulation(
    run: str | Path,
    sensor: str | Path,
    *,
    minutes: float,
    deep: bool = False,
    state: Path | None = None,
    seed: int = 0,
    known: Sequence[str] = CAMERAS,
    log: Log = print,
) -> Adapted | None:
    """Return the model of `run` with tokens for your own sensor, trained on simulated touches.

    It has the universal tokens if the new ones are not shown to be better (`Comparison.shown`).
    `before` and `after` are the fractions of held-out touches that are found among some 200 by a
    known sensor, with the universal tokens and with those of the model.
    `metadata["source"]["compared"]` has the `Comparison`.

    Args:
        run: What `load_encoder` takes.
        sensor: A folder NAME.sensor of `anytouch sensor fit`.
        minutes: Time of training, after the simulator was compiled.
        deep: Train the first blocks too, and hold the features of known sensors where they are.
        state: Folder that keeps an interrupted training. After Ctrl-C the result is None, and the
            next call continues from there. None: an interruption loses it.
        seed: Of all draws.
        known: The simulated sensors that take part.
        log: Gets one sentence at a time.

    Raises:
        UserError: For a run or a sensor that cannot be used.
    """
    numbers = read_numbers(sensor)
    loaded, params = read_model(run)
    config, params, row = with_row(loaded, params, numbers.name, str(run), log)
    known = tuple(name for name in loaded.trained_sensors or CAMERAS if name in known)
    if not known:
        raise UserError(f"{run} was trained on no sensor that is simulated; name another run")
    rows = np.array([row, *(config.model.sensor_row(name) for name in known)], np.int32)
    identity = f"{numbers} {loaded.trained_sensors} {deep} {minutes} {seed}"
    if state is not None:
        _check_state(state, identity)
    with precision(config):
        contrast = Contrast(config, row, rows, deep)
        frozen = jax.device_put({"touch": params["touch"]})
        first: State = {"tokens": jnp.asarray(params["touch"]["sensor_tokens"][row])}
        if deep:
            first["patch"] = jax.tree.map(jnp.asarray, params["touch"]["patch"])
            first["blocks"] = jax.tree.map(jnp.asarray, params["touch"]["blocks"])
        world, test = (own_world(sensor, split, known) for split in ("train", "test"))
        root = jax.random.key(seed)
        size = config.model.image_size
        held = [
            own_touches(jax.random.fold_in(root, (1 << 29) + n), test, size=size)
            for n in range(BATCHES)
        ]
        features = jax.jit(contrast.features)
        score = partial(
            found_touches, held, lambda train, touches: features(train, frozen, touches)
        )
        universal = score(first)
        work = Work(
            {"frozen": frozen, **first},
            contrast.loss,
            partial(
                felt_batches,
                contrast=contrast,
                frozen=frozen,
                root=root,
                touches_of=lambda n: own_touches(jax.random.fold_in(root, n), world, size=size),
            ),
            frozen=(("^frozen/", True), ("", False)),
            rates=rate_of,
            metadata={"identity": identity},
        )
        result = tune_for_seconds(
            config,
            work,
            rate=RATE,
            seconds=60 * minutes,
            run_dir=state,
            log=log,
            timed=TIMED,
        )
        if result.interrupted:
            return None
        train = result.state.trainable
        compared = compare_found(universal, score(train))
    source = {
        "run": str(run),
        "sensor": numbers.name,
        "frames": 0,
        "minutes": minutes,
        "deep": deep,
        "tokens": "trained" if compared.shown else "universal",
        "compared": compared._asdict(),
    }
    stored = loaded.metadata if loaded.from_run else {}
    metadata: dict[str, Any] = {
        name: stored[name] for name in ("preprocessing", "data") if name in stored
    }
    metadata |= {"sensors": list(config.model.sensors), "source": source}
    if loaded.trained_sensors is not None:
        metadata["seen"] = [*loaded.trained_sensors, numbers.name]
    before = compared.universal
    after = before
    # `with_row` gave the sensor the universal tokens, which stay if no gain is shown.
    if compared.shown:
        params = params | contrast.merged(train, frozen)
        after = compared.trained
    return Adapted(config, params, result.losses, before, after, "simulated", metadata)


def _check_state(folder: Path, identity: str) -> None:
    """Raise UserError for a folder that keeps another adaptation."""
    if not checkpoint.steps(folder / "checkpoints"):
        return
    if checkpoint.read_metadata(folder).get("identity") != identity:
        raise UserError(f"{folder} belongs to another adaptation; remove it, or name another --out")
