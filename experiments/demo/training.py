"""Training of the demo: an encoder and a head that name the shape of a touch, and its curve."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax.config import Config
from anytouch_jax.evaluate.discriminant import discriminant_path
from anytouch_jax.nn.functional import Net
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.sim.preparation import augmented, prepared
from experiments.demo.touches import NAMES, Touches

BATCH = 32
RATE = 3e-4  # of the encoder, falling to 0
HEAD_RATE = 3e-3
POINTS = 6  # of the curve, after the first one
FIRST_PENALTY = 1.0  # of the head before training, in variances of a feature
Params = dict[str, Any]


class Point(NamedTuple):
    """A held-out test during training."""

    step: int
    seconds: float  # of training, without compiling and testing
    named: np.ndarray  # (n,) numbers of NAMES, of the test touches


class Course(NamedTuple):
    """A training: its tests, the first before any step, and its parameters in the end."""

    points: list[Point]
    params: Params


class Learner(NamedTuple):
    """The network and its settings, which both trainings share."""

    net: Net
    config: Config  # its augmentation; the background is subtracted

    def features(self, touch: Params, clip: Any) -> jax.Array:
        """Return features (n, E) of prepared touches, with the universal tokens."""
        rows = jnp.full(len(clip), self.net.model.universal_row, jnp.int32)
        return self.net.encode_touch({"touch": touch}, normalise_touch(clip), rows)

    def logits(self, params: Params, clip: Any) -> jax.Array:
        """Return logits (n, shapes) of prepared touches."""
        x = (self.features(params["touch"], clip) - params["mean"]) / params["deviation"]
        return x @ params["head"]["weights"] + params["head"]["bias"]

    def loss(self, train: Params, fixed: Params, batch: Any, key: Any) -> jax.Array:
        """Return the cross-entropy of a batch (frames, backgrounds, shapes) in other light."""
        frame, background, shape = batch
        warp, light = jax.random.split(key)
        moved = augmented(warp, jnp.stack([frame, background], 1), self.config)
        clip = prepared(light, moved[:, :1], moved[:, 1], self.config)
        scores = self.logits(train | fixed, clip)
        return optax.softmax_cross_entropy_with_integer_labels(scores, shape).mean()


def shown(learner: Learner, touches: Touches) -> np.ndarray:
    """Return the touches as the encoder sees them, u8 (n, 1, S, S, 3)."""
    return np.asarray(
        prepared(
            jax.random.key(0),
            touches.frame[:, None],
            touches.background,
            learner.config,
            jitter=False,
        )
    )


def in_batches(function: Callable[[Any], Any], rows: np.ndarray, size: int = 64) -> np.ndarray:
    """Return `function` of all rows, by equal batches; the last one is filled up."""
    parts = []
    for start in range(0, len(rows), size):
        part = rows[start : start + size]
        filled = np.concatenate([part, np.repeat(part[-1:], size - len(part), 0)])
        parts.append(np.asarray(function(filled))[: len(part)])
    return np.concatenate(parts)


def with_head(learner: Learner, touch: Params, train: Touches) -> Params:
    """Return the encoder with a head that is fitted in closed form: what a user gets at once."""
    encode = jax.jit(learner.features)
    x = in_batches(partial(encode, touch), shown(learner, train))
    mean = x.mean(0)
    deviation = x.std(0) + 1e-6
    rows = (x - mean) / deviation
    head = next(discriminant_path(rows, train.shape, len(NAMES), [FIRST_PENALTY]))
    return {
        "touch": touch,
        "head": {"weights": jnp.asarray(head.weights), "bias": jnp.asarray(head.bias)},
        "mean": jnp.asarray(mean),
        "deviation": jnp.asarray(deviation),
    }


def train_course(
    learner: Learner,
    params: Params,
    data: tuple[Touches, Touches],
    *,
    seconds: float | None,
    steps: int | None = None,
    log: Callable[[str], None],
) -> Course:
    """Train an encoder and its head, and test them before, during and after that.

    Args:
        learner: The network.
        params: Of `with_head`.
        data: Touches of train and of test.
        seconds: Time of training, by which a first few steps decide how many there are.
        steps: How many there are, if that is known.
        log: Gets one sentence at a time.
    """
    train, test = data
    fixed = {name: params[name] for name in ("mean", "deviation")}
    state = {name: params[name] for name in ("touch", "head")}
    rate = optax.inject_hyperparams(optax.adam)(learning_rate=1.0, b2=0.99)
    tx = optax.chain(optax.clip_by_global_norm(1.0), rate)
    moments = tx.init(state)
    held = shown(learner, test)
    score = jax.jit(learner.logits)

    @jax.jit
    def step(state: Params, moments: Any, batch: Any, key: Any, left: Any) -> Any:
        loss, slope = jax.value_and_grad(learner.loss)(state, fixed, batch, key)
        change, moments = tx.update(slope, moments, state)
        change = {
            "touch": jax.tree.map(lambda one: RATE * left * one, change["touch"]),
            "head": jax.tree.map(lambda one: HEAD_RATE * left * one, change["head"]),
        }
        return optax.apply_updates(state, change), moments, loss

    def tested(number: int, spent: float) -> Point:
        scores = in_batches(partial(score, state | fixed), held)
        point = Point(number, spent, scores.argmax(1))
        right = np.mean(point.named == test.shape)
        log(f"step {number}: {right:.1%} of the held-out touches named rightly")
        return point

    points = [tested(0, 0.0)]
    rng = np.random.default_rng(0)
    spent = 0.0
    timed = 4
    number = 0
    left = 1.0
    while steps is None or number < steps:
        rows = rng.choice(len(train.shape), BATCH, replace=False)
        batch = (train.frame[rows], train.background[rows], train.shape[rows])
        begun = time.monotonic()
        key = jax.random.fold_in(jax.random.key(1), number)
        state, moments, loss = step(state, moments, batch, key, np.float32(left))
        jax.block_until_ready(loss)
        number += 1
        if number > 1:  # the first one was compiled
            spent += time.monotonic() - begun
        if steps is None and number == timed:
            assert seconds is not None
            steps = max(2 * POINTS, round(seconds * (timed - 1) / spent))
        left = 1.0 if steps is None else 1 - number / steps
        if steps is not None and number * POINTS // steps > (number - 1) * POINTS // steps:
            points.append(tested(number, spent))
    return Course(points, state | fixed)
