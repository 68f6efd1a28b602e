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
# Learning rates of the encoder: one that knows touch is moved less than one from nothing.
RATE = 1e-4
FRESH_RATE = 5e-4
HEAD_RATE = 1e-3
WARM_UP = 0.1  # of the steps, before the rates fall to 0
TIMED = 4  # steps whose speed decides how many there are
POINTS = 6  # of the curve, after the first one
PENALTY = 1.0  # of the head before training, in variances of a feature
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
        x = self.features(params["touch"], clip) - params["mean"][None]
        x = x / params["deviation"][None]
        return x @ params["head"]["weights"] + params["head"]["bias"][None]

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
    head = next(discriminant_path((x - mean) / deviation, train.shape, len(NAMES), [PENALTY]))
    return {
        "touch": touch,
        "head": {"weights": jnp.asarray(head.weights), "bias": jnp.asarray(head.bias)},
        "mean": jnp.asarray(mean),
        "deviation": jnp.asarray(deviation),
    }


def from_nothing(learner: Learner, seed: int = 0) -> Params:
    """Return the same network with random parameters, and a head that knows nothing.

    Its features hardly differ between touches yet, so no statistics of them are of use.
    """
    width = learner.net.model.embed
    return {
        "touch": learner.net.init(jax.random.key(seed))["touch"],
        "head": {"weights": jnp.zeros((width, len(NAMES))), "bias": jnp.zeros(len(NAMES))},
        "mean": jnp.zeros(width),
        "deviation": jnp.ones(width),
    }


def train_course(
    learner: Learner,
    params: Params,
    data: tuple[Touches, Touches],
    *,
    rate: float,
    seconds: float | None = None,
    steps: int | None = None,
    log: Callable[[str], None],
) -> Course:
    """Train an encoder and its head, and test them before, during and after that.

    Args:
        learner: The network.
        params: Of `with_head`.
        data: Touches of train and of test.
        rate: The highest learning rate of the encoder.
        seconds: Time of training, by which a first few steps decide how many there are.
        steps: How many there are, if that is known.
        log: Gets one sentence at a time.
    """
    train, test = data
    fixed = {name: params[name] for name in ("mean", "deviation")}
    state = {name: params[name] for name in ("touch", "head")}
    tx = optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam(b2=0.99))
    moments = tx.init(state)
    held = shown(learner, test)
    score = jax.jit(learner.logits)

    # All that differs between two trainings is an argument, so the second compiles nothing.
    @jax.jit
    def step(state: Params, moments: Any, fixed: Params, batch: Any, key: Any, rates: Any) -> Any:
        loss, slope = jax.value_and_grad(learner.loss)(state, fixed, batch, key)
        change, moments = tx.update(slope, moments, state)
        change = {
            part: jax.tree.map(lambda one, by=rates[part]: -by * one, change[part])
            for part in ("touch", "head")
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
    number = 0
    while steps is None or number < steps:
        rows = rng.choice(len(train.shape), BATCH, replace=False)
        batch = (train.frame[rows], train.background[rows], train.shape[rows])
        begun = time.monotonic()
        key = jax.random.fold_in(jax.random.key(1), number)
        factor = _factor(number, steps)
        rates = {"touch": np.float32(rate * factor), "head": np.float32(HEAD_RATE * factor)}
        state, moments, loss = step(state, moments, fixed, batch, key, rates)
        jax.block_until_ready(loss)
        number += 1
        if number > 1:  # the first one was compiled
            spent += time.monotonic() - begun
        if steps is None and number == TIMED:
            assert seconds is not None
            steps = max(2 * POINTS, round(seconds * (TIMED - 1) / spent))
        if steps is not None and number * POINTS // steps > (number - 1) * POINTS // steps:
            points.append(tested(number, spent))
    return Course(points, state | fixed)


def _factor(number: int, steps: int | None) -> float:
    """Return the factor on the learning rates at a step: a warm-up, then a fall to 0."""
    if steps is None:  # the first few are timed
        return 0.1
    done = number / steps
    return min((done + 0.01) / WARM_UP, 1 - done)
