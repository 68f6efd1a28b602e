"""Tokens for your own sensor, trained on simulated touches of it.

Each touch is felt by your sensor and by a known one. The features of yours are drawn to those that
the frozen encoder has of the known one, among the features of other touches (InfoNCE with the known
sensor as a fixed target). No touch repeats.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax.config import Config
from anytouch_jax.encoder.adapt import Adapted, Params, put_tokens, read_model, with_row
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.encoder.base import precision
from anytouch_jax.errors import CheckError, UserError
from anytouch_jax.files import atomic_write, read_arrays
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.ops import losses
from anytouch_jax.progress import bar
from anytouch_jax.sim.batches import prepared
from anytouch_jax.sim.endless import CAMERAS, SimulatedTouches
from anytouch_jax.sim.fitting.touches import COUNT, own_touches, own_world
from anytouch_jax.sim.sensing.own import read_numbers
from anytouch_jax.weights.load import Loaded

# of Adam, for tokens and for blocks
RATE = 1e-3
DEEP_RATE = 1e-4
FIRST = 2  # blocks that are trained with `deep`
KEPT = 480  # features of earlier touches, which serve as negatives
HEAT = 0.07  # temperature of InfoNCE
HOLD = 10.0  # weight that holds the features of known sensors with `deep`
REUSE = 4  # steps with the same touches in other light
BATCHES = 10  # of held-out touches, before and after
TIMED = 4 * REUSE  # steps whose speed decides how many there are
SAVED = 60.0  # seconds between saved states
State = dict[str, Any]
Kept = tuple[State, Any, Any]  # what is trained, its moments, and features of touches before


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
        The model with the new tokens. `before` and `after` are the fractions of held-out touches
        that are found among some 200 by a known sensor, with universal tokens and with the new
        ones. None after Ctrl-C.

    Raises:
        UserError: For a model or a sensor that cannot be used.
        CheckError: If the new tokens find fewer touches.
    """
    numbers = read_numbers(sensor)
    loaded, params = read_model(run)
    config, params, row = with_row(loaded, params, numbers.name, str(run), log)
    known = tuple(name for name in loaded.trained_sensors or CAMERAS if name in known)
    if not known:
        raise UserError(f"{run} was trained on no sensor that is simulated; name another run")
    rows = np.array([row, *(config.model.sensor_row(name) for name in known)], np.int32)
    task = _Task(config, touch_net(config), rows, deep)
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
        before = score(train)
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
        after = score(train)
    if after < before:
        raise CheckError(
            f"the new tokens find {after:.1%} of held-out simulated touches by a known sensor, and "
            f"the universal ones {before:.1%}: nothing is saved. Look at look.png of {sensor}, or "
            "give more --minutes."
        )
    metadata = _metadata(loaded, config, run, numbers.name, minutes, deep)
    fitted = params | task.merged(train, params)
    return Adapted(config, fitted, history, before, after, "simulated", metadata)


def touch_net(config: Config) -> Net:
    """Return the network of a model without its towers: touch alone is encoded."""
    model = replace(config.model, image=None, text=None, match_head="none", lora_rank=0)
    return build(usable(model))


def _metadata(
    loaded: Loaded, config: Config, run: str | Path, name: str, minutes: float, deep: bool
) -> dict[str, Any]:
    """Return the metadata of the new run: that of the old one, its sensors, and its source."""
    stored = loaded.metadata if loaded.from_run else {}
    metadata: dict[str, Any] = {
        part: stored[part] for part in ("preprocessing", "data") if part in stored
    }
    metadata["sensors"] = list(config.model.sensors)
    metadata["source"] = {
        "run": str(run),
        "sensor": name,
        "frames": 0,
        "minutes": minutes,
        "deep": deep,
    }
    if loaded.trained_sensors is not None:
        metadata["seen"] = [*loaded.trained_sensors, name]
    return metadata


@dataclass(frozen=True, eq=False)
class _Task:
    """What is trained, and for what. `rows` are those of the families in a world, yours first."""

    config: Config
    net: Net
    rows: np.ndarray
    deep: bool

    def start(self, params: Params) -> State:
        """Return what is trained, as it is in a model."""
        touch = params["touch"]
        train: State = {"tokens": jnp.asarray(touch["sensor_tokens"][self.rows[0]])}
        if self.deep:
            for name in ("patch", "blocks"):
                train[name] = jax.tree.map(jnp.asarray, touch[name])
        return train

    def merged(self, train: State, frozen: Params) -> Params:
        """Return the parameters of touch with what is trained in its place."""
        trained = {name: part for name, part in train.items() if name != "tokens"}
        touch = frozen["touch"] | trained
        return put_tokens({"touch": touch}, int(self.rows[0]), train["tokens"])

    def encode(self, weights: Params, clip: jax.Array, of: jax.Array) -> jax.Array:
        """Return normalised features of clips u8 by the sensors of rows `of`."""
        return losses.normalise(self.net.encode_touch(weights, normalise_touch(clip), of))

    def loss(
        self,
        train: State,
        frozen: Params,
        key: jax.Array,
        touches: SimulatedTouches,
        queue: jax.Array,
        seen: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        """Return InfoNCE from your sensor to a known one, and the features by the known one.

        `queue` (KEPT, E) are features of earlier touches, of which `seen` (KEPT,) are filled.
        """
        keys = jax.random.split(key)
        other, own = (
            prepared(keys[m], touches.clip[:, m], touches.background[:, m], self.config)
            for m in (0, 1)
        )
        of = jnp.asarray(self.rows)[touches.sensor]
        # The frozen encoder is the teacher, so it is not drawn to the new sensor.
        target = jax.lax.stop_gradient(self.encode(frozen, other, of[:, 0]))
        z = self.encode(self.merged(train, frozen), own, of[:, 1])
        among = jnp.where(seen[None], z @ queue.T, -1.0)  # -1 is the least similar of all
        logits = jnp.concatenate([z @ target.T, among], 1) / HEAT
        # A touch that your sensor felt twice has no target by a known one.
        by_known = touches.sensor[:, 0] > 0
        cost = optax.softmax_cross_entropy_with_integer_labels(logits, jnp.arange(len(z)))
        value = jnp.sum(cost * by_known) / jnp.maximum(by_known.sum(), 1)
        if self.deep:
            held = self.encode(self.merged(train, frozen), other, of[:, 0])
            value = value + HOLD * jnp.mean(1 - jnp.sum(held * target, 1))
        return value, target

    def make_step(self) -> Callable[..., tuple[Kept, jax.Array]]:
        """Return a compiled step of Adam."""
        tx = optax.scale_by_adam()

        @jax.jit
        def step(
            kept: Kept, frozen: Params, key: Any, touches: Any, number: Any, rate: Any
        ) -> tuple[Kept, jax.Array]:
            train, moments, queue = kept
            # Touches are shown REUSE times. Their features enter the queue once, at the first time,
            # and are negatives from the next batch on.
            at = number // REUSE * COUNT
            seen = jnp.arange(KEPT) < jnp.where(number % REUSE == 0, at, at + COUNT)
            (value, target), grad = jax.value_and_grad(self.loss, has_aux=True)(
                train, frozen, key, touches, queue, seen
            )
            updates, moments = tx.update(grad, moments)
            moved = {}
            for name, part in updates.items():
                own_rate = RATE if name == "tokens" else DEEP_RATE
                moved[name] = jax.tree.map(lambda x, r=own_rate: -rate * r * x, part)
            if self.deep:
                moved["blocks"] = jax.tree.map(lambda x: x.at[FIRST:].set(0), moved["blocks"])
            new = jax.lax.dynamic_update_slice(queue, target.astype(queue.dtype), (at % KEPT, 0))
            queue = jnp.where(number % REUSE == 0, new, queue)
            return (optax.apply_updates(train, moved), moments, queue), value

        return step

    def features(
        self, train: State, frozen: Params, touches: SimulatedTouches
    ) -> tuple[jax.Array, jax.Array]:
        """Return features of touches by your sensor and by the other one, in the light as it is."""
        key = jax.random.key(0)
        of = jnp.asarray(self.rows)[touches.sensor]
        # A score must not depend on a draw, so "either" is "subtract" here.
        background = "keep" if self.config.data.background == "keep" else "subtract"
        plain = self.config.with_settings({"data.background": background})
        other, own = (
            prepared(key, touches.clip[:, m], touches.background[:, m], plain, jitter=False)
            for m in (0, 1)
        )
        weights = self.merged(train, frozen)
        return self.encode(weights, own, of[:, 1]), self.encode(weights, other, of[:, 0])


def _found(held: list[SimulatedTouches], features: Callable[..., Any], train: State) -> float:
    """Return the fraction of held-out touches that are found: recall@1 from your sensor to a known.

    A touch by your sensor is found if the nearest one by a known sensor is the same touch.
    """
    parts = [features(train, touches) for touches in held]
    own, other = (np.concatenate([np.asarray(part[i]) for part in parts]) for i in (0, 1))
    by_known = np.concatenate([np.asarray(touches.sensor[:, 0]) > 0 for touches in held])
    nearest = (own @ other[by_known].T).argmax(1)[by_known]
    return float((nearest == np.arange(by_known.sum())).mean())


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
