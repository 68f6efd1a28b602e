"""Tokens for your own sensor, trained on simulated touches of it.

Here is how long the training takes, its state on disk, and whether its tokens are kept: only if
they are shown to find more held-out touches than the universal ones. What is trained for is in
`task`.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax.encoder.adapt import Adapted, Params, read_model, with_row
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.encoder.base import precision
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.files import atomic_write, read_arrays
from anytouch_jax.progress import bar
from anytouch_jax.sim.endless import CAMERAS, SimulatedTouches
from anytouch_jax.sim.fitting.task import KEPT, REUSE, Kept, State, TokenTask, touch_net
from anytouch_jax.sim.fitting.touches import own_touches, own_world
from anytouch_jax.sim.sensing.own import read_numbers
from anytouch_jax.weights.load import Loaded

BATCHES = 10  # of held-out touches, before and after
TIMED = 4 * REUSE  # steps whose speed decides how many there are
SAVED = 60.0  # seconds between saved states


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
    """Train tokens for the sensor of a folder NAME.sensor.

    Args:
        run: The model, as `load_encoder` takes it.
        sensor: The folder.
        minutes: Of training.
        deep: Train the first blocks too, and hold the features of known sensors where they are.
        state: A file for the state after Ctrl-C, from which the next call continues.
        seed: Of touches and light.
        known: Simulated sensors that take part.
        log: Called with sentences about the progress.

    Returns:
        The model with the new tokens, or with the universal ones if the new ones are not shown to
        be better (`Comparison.shown`). `before` and `after` are the fractions of held-out touches
        that are found among some 200 by a known sensor, with the universal tokens and with those of
        the model; `metadata["source"]["compared"]` has the `Comparison`. None after Ctrl-C.

    Raises:
        UserError: For a model or a sensor that cannot be used.
    """
    numbers = read_numbers(sensor)
    loaded, params = read_model(run)
    config, params, row = with_row(loaded, params, numbers.name, str(run), log)
    known = tuple(name for name in loaded.trained_sensors or CAMERAS if name in known)
    if not known:
        raise UserError(f"{run} was trained on no sensor that is simulated; name another run")
    rows = np.array([row, *(config.model.sensor_row(name) for name in known)], np.int32)
    task = TokenTask(config, touch_net(config), rows, deep)
    frozen = jax.device_put({"touch": params["touch"]})
    features = jax.jit(task.features)
    train = task.start(params)
    identity = f"{numbers} {loaded.trained_sensors} {deep} {minutes} {seed}"
    size = config.model.image_size
    with precision(config):
        world, test = (own_world(sensor, split, known) for split in ("train", "test"))
        root = jax.random.key(seed)
        # Keys of held-out touches are far from those of steps.
        held = [
            own_touches(jax.random.fold_in(root, (1 << 29) + n), test, size=size)
            for n in range(BATCHES)
        ]
        score = partial(_found, held, lambda train, touches: features(train, frozen, touches))
        universal = score(train)
        moments = optax.scale_by_adam().init(train)
        (train, *_), history, finished = _train(
            (train, moments, jnp.zeros((KEPT, config.model.embed))),
            task.make_step(),
            frozen,
            60 * minutes,
            root,
            state,
            lambda n: own_touches(jax.random.fold_in(root, n), world, size=size),
            identity,
            log,
        )
        if not finished:
            return None
        compared = compare_found(universal, score(train))
    metadata = _metadata(loaded, config.model.sensors)
    metadata["source"] = {
        "run": str(run),
        "sensor": numbers.name,
        "frames": 0,
        "minutes": minutes,
        "deep": deep,
        "tokens": "trained" if compared.shown else "universal",
        "compared": compared._asdict(),
    }
    if loaded.trained_sensors is not None:
        metadata["seen"] = [*loaded.trained_sensors, numbers.name]
    before = compared.universal
    if not compared.shown:
        # `with_row` gave the sensor the universal tokens.
        return Adapted(config, params, history, before, before, "simulated", metadata)
    fitted = params | task.merged(train, params)
    return Adapted(config, fitted, history, before, compared.trained, "simulated", metadata)


def _metadata(loaded: Loaded, sensors: Sequence[str]) -> dict[str, Any]:
    """Return what the new run takes over of the metadata of the old one, and its sensors."""
    stored = loaded.metadata if loaded.from_run else {}
    metadata: dict[str, Any] = {
        part: stored[part] for part in ("preprocessing", "data") if part in stored
    }
    metadata["sensors"] = list(sensors)
    return metadata


class Found(NamedTuple):
    """Held-out touches that are felt by your sensor and by a known one."""

    found: np.ndarray  # bool (N,): the nearest one by a known sensor is the same touch
    object: np.ndarray  # i32 (N,), what is touched


class Comparison(NamedTuple):
    """Fractions of the same held-out touches that are found, by universal and by trained tokens."""

    universal: float
    trained: float
    # 95 % interval of their difference under a bootstrap over objects; None with one object
    low: float | None
    high: float | None
    touches: int
    objects: int

    @property
    def shown(self) -> bool:
        """Whether the trained tokens are shown to find more."""
        return self.low is not None and self.low > 0


def compare_found(universal: Found, trained: Found) -> Comparison:
    """Compare two sets of tokens on the same touches.

    Touches are paired, because most of them are found by both or by neither. Objects are what is
    drawn again: touches of one object are found or missed together.
    """
    gain = trained.found.astype(float) - universal.found
    low, high = mean_interval(gain, universal.object)
    return Comparison(
        universal=float(universal.found.mean()),
        trained=float(trained.found.mean()),
        low=low,
        high=high,
        touches=len(gain),
        objects=len(np.unique(universal.object)),
    )


def _found(held: list[SimulatedTouches], features: Callable[..., Any], train: State) -> Found:
    """Return which held-out touches are found: recall@1 from your sensor to a known one.

    A touch by your sensor is found if the nearest one by a known sensor is the same touch.
    """
    parts = [features(train, touches) for touches in held]
    own, other = (np.concatenate([np.asarray(part[i]) for part in parts]) for i in (0, 1))
    by_known = np.concatenate([np.asarray(touches.sensor[:, 0]) > 0 for touches in held])
    nearest = (own @ other[by_known].T).argmax(1)[by_known]
    touched = np.concatenate([np.asarray(touches.object) for touches in held])[by_known]
    return Found(nearest == np.arange(by_known.sum()), touched)


def _train(
    kept: Kept,
    step: Callable[..., Any],
    frozen: Params,
    seconds: float,
    root: Any,
    file: Path | None,
    touches_of: Callable[[int], Any],
    identity: str,
    log: Log,
) -> tuple[Kept, tuple[float, ...], bool]:
    """Train for about `seconds`, from the state in `file` if there is one.

    False is an interruption, with a state.

    The speed of the first steps decides the number of steps, so a continued training equals an
    undisturbed one.
    """
    total = 0
    history = list[float]()
    if file is not None and file.is_file():
        arrays = read_arrays(file)
        (leaves, tree) = jax.tree.flatten(kept)
        if str(arrays.get("identity")) != identity:
            raise UserError(
                f"{file} belongs to another adaptation; remove it, or name another --out"
            )
        kept = jax.tree.unflatten(
            tree, [jnp.asarray(arrays[f"leaf{n}"], x.dtype) for n, x in enumerate(leaves)]
        )
        total = int(arrays["total"])
        history = [float(value) for value in arrays["history"]]
        log(f"continued after {len(history)} steps{f' of {total}' * (total > 0)}")

    def save() -> None:
        if file is not None:
            data = io.BytesIO()
            arrays = {f"leaf{n}": np.asarray(x) for n, x in enumerate(jax.tree.leaves(kept))}
            np.savez(data, identity=identity, total=total, history=history, **arrays)  # type: ignore[arg-type]
            atomic_write(file, data.getvalue())

    # the ends of steps: compiling is not training
    touches = None
    clock = list[float]()
    saved = time.monotonic()
    try:
        with bar(round(seconds), "seconds of training") as advance:
            while not total or len(history) < total:
                number = len(history)
                if touches is None or number % REUSE == 0:
                    touches = touches_of(number // REUSE)
                rate = float(0.5 * (1 + np.cos(np.pi * number / total))) if total else 1.0
                key = jax.random.fold_in(jax.random.fold_in(root, 1 << 30), number)
                new, value = step(kept, frozen, key, touches, number, rate)
                # at once: an interruption finds a whole step
                kept = new
                history = [*history, float(value)]
                clock.append(time.monotonic())
                if not total and (len(clock) > TIMED or clock[-1] - clock[0] >= seconds):
                    total = max(
                        len(history), round(seconds * (len(clock) - 1) / (clock[-1] - clock[0]))
                    )
                advance(round(seconds * len(history) / total) if total else 0)
                if clock[-1] - saved > SAVED:
                    saved = clock[-1]
                    save()
    except KeyboardInterrupt:
        save()
        return kept, tuple(history), False
    return kept, tuple(history), True
