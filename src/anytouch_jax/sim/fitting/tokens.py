"""Tokens for your own sensor, trained on simulated touches of it.

Each touch is felt by your sensor and by a known one. The features of yours are drawn to those that
the frozen encoder has of the known one, among the features of other touches. No touch repeats.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax.encoder.adapt import Adapted, Params, put_tokens, read_model, with_row
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.encoder.base import precision
from anytouch_jax.errors import CheckError, UserError
from anytouch_jax.files import atomic_write, read_arrays
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.ops import losses
from anytouch_jax.progress import bar
from anytouch_jax.sim.batches import prepared
from anytouch_jax.sim.endless import CAMERAS, SimulatedTouches
from anytouch_jax.sim.fitting.touches import COUNT, own_touches, own_world
from anytouch_jax.sim.sensing.own import read_numbers

# of Adam, for tokens and for blocks
RATE = 1e-3
DEEP_RATE = 1e-4
FIRST = 2  # blocks that are trained with `deep`
KEPT = 480  # features of touches before, that a touch must not be taken for
HEAT = 0.07  # temperature of the contrast
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
    """Return the model of `run` with tokens for the sensor of a folder NAME.sensor, trained for
    `minutes`.

    `known` are the simulated sensors that take part. With `deep` the first blocks are trained too,
    and the features of known sensors are held where they are. `before` and `after` are the shares
    of held-out touches that are found among some 200 by a known sensor, with universal tokens and
    with the new ones. After Ctrl-C the result is None: the next call continues from the file
    `state`. Raises UserError, and CheckError if the new tokens find fewer.
    """
    numbers = read_numbers(sensor)
    loaded, params = read_model(run)
    stored = loaded.metadata if loaded.from_run else {}
    config, params, row = with_row(loaded, params, numbers.name, str(run), log)
    known = tuple(name for name in loaded.trained_sensors or CAMERAS if name in known)
    if not known:
        raise UserError(f"{run} was trained on no sensor that is simulated; name another run")
    size = config.model.image_size
    rows = np.array([row, *(config.model.sensor_row(name) for name in known)], np.int32)
    net = build(
        usable(replace(config.model, image=None, text=None, match_head="none", lora_rank=0))
    )
    plain = config.with_settings(
        {"data.background": "subtract" if config.data.background != "keep" else "keep"}
    )
    frozen = jax.device_put({"touch": params["touch"]})

    def encode(weights: Params, clip: Any, of: Any) -> Any:
        return losses.normalise(net.encode_touch(weights, normalise_touch(clip), of))

    def merged(train: State, frozen: Params) -> Params:
        touch = frozen["touch"] | {name: part for name, part in train.items() if name != "tokens"}
        return put_tokens({"touch": touch}, row, train["tokens"])

    def loss(
        train: State, frozen: Params, key: Any, touches: SimulatedTouches, queue: Any, seen: Any
    ) -> Any:
        keys = jax.random.split(key)
        other, own = (
            prepared(keys[m], touches.clip[:, m], touches.background[:, m], config) for m in (0, 1)
        )
        of = jnp.asarray(rows)[touches.sensor]
        target = jax.lax.stop_gradient(encode(frozen, other, of[:, 0]))
        z = encode(merged(train, frozen), own, of[:, 1])
        among = jnp.where(seen[None], z @ queue.T, -1.0)  # -1 is no rival
        logits = jnp.concatenate([z @ target.T, among], 1) / HEAT
        by_known = touches.sensor[:, 0] > 0
        cost = optax.softmax_cross_entropy_with_integer_labels(logits, jnp.arange(len(z)))
        value = jnp.sum(cost * by_known) / jnp.maximum(by_known.sum(), 1)
        if deep:
            held = encode(merged(train, frozen), other, of[:, 0])
            value = value + 10.0 * jnp.mean(1 - jnp.sum(held * target, 1))
        return value, target

    tx = optax.scale_by_adam()

    @jax.jit
    def step(
        kept: Kept, frozen: Params, key: Any, touches: Any, number: Any, rate: Any
    ) -> tuple[Kept, Any]:
        (train, moments, queue) = kept
        at = number // REUSE * COUNT
        seen = jnp.arange(KEPT) < jnp.where(number % REUSE == 0, at, at + COUNT)
        (value, target), grad = jax.value_and_grad(loss, has_aux=True)(
            train, frozen, key, touches, queue, seen
        )
        updates, moments = tx.update(grad, moments)
        rates = {name: RATE if name == "tokens" else DEEP_RATE for name in train}
        moved = {
            name: jax.tree.map(lambda x, r=rates[name]: -rate * r * x, part)
            for name, part in updates.items()
        }
        if deep:
            moved["blocks"] = jax.tree.map(lambda x: x.at[FIRST:].set(0), moved["blocks"])
        new = jax.lax.dynamic_update_slice(queue, target.astype(queue.dtype), (at % KEPT, 0))
        return (
            optax.apply_updates(train, moved),
            moments,
            jnp.where(number % REUSE == 0, new, queue),
        ), value

    @jax.jit
    def features(train: State, frozen: Params, touches: Any) -> tuple[Any, Any]:
        key = jax.random.key(0)
        of = jnp.asarray(rows)[touches.sensor]
        other, own = (
            prepared(key, touches.clip[:, m], touches.background[:, m], plain, jitter=False)
            for m in (0, 1)
        )
        return encode(merged(train, frozen), own, of[:, 1]), encode(
            merged(train, frozen), other, of[:, 0]
        )

    train: State = {"tokens": jnp.asarray(params["touch"]["sensor_tokens"][row])}
    if deep:
        train |= {
            name: jax.tree.map(jnp.asarray, params["touch"][name]) for name in ("patch", "blocks")
        }
    identity = f"{numbers} {loaded.trained_sensors} {deep} {minutes} {seed}"
    with precision(config):
        world, test = (own_world(sensor, split, known) for split in ("train", "test"))
        root = jax.random.key(seed)
        held = [
            own_touches(jax.random.fold_in(root, (1 << 29) + n), test, size=size)
            for n in range(BATCHES)
        ]
        score = partial(_found, held, lambda train, touches: features(train, frozen, touches))
        before = score(train)
        (train, *_), history, finished = _train(
            (train, tx.init(train), jnp.zeros((KEPT, config.model.embed))),
            step,
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
            "the universal ones "
            f"{before:.1%}: nothing is saved. Look at look.png of {sensor}, or give more --minutes."
        )
    source = {
        "run": str(run),
        "sensor": numbers.name,
        "frames": 0,
        "minutes": minutes,
        "deep": deep,
    }
    metadata: dict[str, Any] = {
        name: stored[name] for name in ("preprocessing", "data") if name in stored
    }
    metadata |= {"sensors": list(config.model.sensors), "source": source}
    metadata |= (
        {} if loaded.trained_sensors is None else {"seen": [*loaded.trained_sensors, numbers.name]}
    )
    return Adapted(
        config, params | merged(train, params), history, before, after, "simulated", metadata
    )


def _found(held: list[SimulatedTouches], features: Callable[..., Any], train: State) -> float:
    """Return the share of held-out touches by your sensor that are nearest to the same touch by a
    known one.
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
