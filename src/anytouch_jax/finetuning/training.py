"""The training itself: head and encoder together, watched by held-out recordings."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.encoder.arrays import Array, Params, run_in_batches
from anytouch_jax.encoder.base import Encoder
from anytouch_jax.errors import UserError
from anytouch_jax.finetuning.images import Touches, changed
from anytouch_jax.finetuning.options import FinetuneOptions
from anytouch_jax.finetuning.rates import HEAD, depth_factor, steadiness, trunk_depths
from anytouch_jax.finetuning.start import Held, Linear, Parts, Target, held_score
from anytouch_jax.train.loop import Work
from anytouch_jax.train.tuning import Tuning, tune_watched
from anytouch_jax.weights.tree import flatten, interpolate

# Looks at the held-out recordings in a run. They come early and often, and then seldom: few labels
# are learned by heart within a few passes.
LOOKS = 12
# Weights are tried as trained, and halfway from the start: these often name new recordings better
# (Wortsman et al., "Robust fine-tuning of zero-shot models", 2022).
_BETWEEN = (1.0, 0.5)
_WATCH = 3  # steps between questions whether it is time for a look
_MOST_HELD = 384  # touches of a look: more would take the time of training
_PATIENCE = 5  # looks without a better score that end a run in its second half


class Batch(NamedTuple):
    """A batch of a step: clip u8 (B, T, H, W, 3), sensor i32 (B,), target i32 or f32 (B,)."""

    clip: Array
    sensor: Array
    target: Array


@dataclass
class Best:
    """The best parameters so far: none while the linear head is unbeaten."""

    start: Held
    score: Held
    encoder: Params | None = None
    head: Linear | None = None
    looks: int = 0
    since: int = 0
    # (part of the run, part of the way from the start, score)
    steps: list[tuple[float, float, Held]] = field(default_factory=list)


class TuningTask(NamedTuple):
    """What is tuned, and on what. `touches` are those of all rows, and `linear` is the start."""

    encoder: Encoder
    touches: Touches
    target: Target
    parts: Parts
    linear: Linear
    score: Held


def train(
    task: TuningTask,
    options: FinetuneOptions,
    until: float,
    watch: Callable[[Best], None],
    ended: Callable[[], bool],
) -> Best:
    """Train head and encoder, and return the best parameters on the held-out rows.

    Ctrl-C ends the training and keeps the best.

    Args:
        task: what is tuned.
        options: how.
        until: time of `time.monotonic` at which it ends.
        watch: gets the best so far, every few steps.
        ended: ends the training once it is True.
    """
    encoder = task.encoder
    steady = steadiness(task.linear.mean, task.linear.scale)
    recipe = replace(options.recipe, rate=options.recipe.rate * steady)
    best = Best(task.score, task.score)
    features = jax.jit(encoder.traceable(options.pooling))
    held = _spread(task.parts.val, _MOST_HELD)
    names = list(flatten(encoder.params))
    depths = trunk_depths(names)
    params = dict(encoder.params) | {
        HEAD: {"kernel": jnp.asarray(task.linear.weights), "bias": jnp.asarray(task.linear.bias)}
    }
    begin = jax.tree.map(np.asarray, params)
    loss = _loss_of(task, options)
    batch = min(recipe.batch, len(task.parts.fit))
    steps = max(2, recipe.passes * len(task.parts.fit) // batch)

    def look(done: float, params: Params) -> None:
        if done < ((best.looks + 1) / LOOKS) ** 2:
            watch(best)
            return
        take(done, params)

    def take(done: float, params: Params) -> None:
        best.looks += 1
        best.since += 1
        # Copies: the loop gives its arrays to the next step.
        now = jax.tree.map(np.array, params)
        for share in _BETWEEN:
            own = interpolate(begin, now, share)
            top = own.pop(HEAD)
            linear = task.linear._replace(weights=top["kernel"], bias=top["bias"])
            try:
                values = compute_features(features, own, task.touches.take(held))
            except UserError:  # features that are not finite: the rates were too high
                continue
            score = held_score(linear(values), task.target, held)
            best.steps.append((done, share, score))
            if score.beats(best.score):
                best.score = score
                best.encoder = own
                best.head = linear
                best.since = 0
        watch(best)

    def over() -> bool:
        return ended() or (best.since >= _PATIENCE and best.looks > LOOKS / 2)

    work = Work(
        params,
        loss,
        partial(_batches, task, batch, options.seed),
        # Tokens of sensors are left as they are: weights are loaded by rules that fill the rows of
        # sensors without training from them.
        frozen=((r"sensor_tokens$", True), ("", False)),
        rates=lambda name, shape: depth_factor(name, shape, recipe, encoder.config.model, depths),
    )
    tuning = Tuning(recipe.rate, recipe.weight_decay, steps, until, _WATCH, options.seed)
    try:
        result = tune_watched(encoder.config, work, tuning, look, over)
        if best.looks < LOOKS:
            # The last step, at the smallest rate, is rarely one of those that are asked.
            take(1.0, result.params)
    except KeyboardInterrupt:
        # The user asks for an end, and the best is there: at least the linear head.
        return best
    return best


def compute_features(run: Callable[..., Any], params: Params, touches: Touches) -> Array:
    """Return features f32 (n, d) of touches by a compiled function of the parameters."""
    placed = jax.device_put(params)
    return run_in_batches(
        lambda part: run(placed, part[0], part[1]), zip(touches.clip, touches.sensor, strict=True)
    )


def _spread(places: Array, most: int) -> Array:
    """Return at most `most` of some places, evenly spread."""
    return places[np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).astype(int))]


def _batches(
    task: TuningTask, size: int, seed: int, start: int, stop: int
) -> Iterator[tuple[int, Batch, dict[str, Any]]]:
    """Yield the batch of each step: passes over the touches, each in another order."""
    rng = np.random.default_rng([19, seed % 2**63])
    fit = task.parts.fit
    order = np.array([], np.int64)
    kind = np.float32 if task.target.is_number else np.int32
    for step in range(start, stop):
        if len(order) < size:
            order = np.concatenate([order, rng.permutation(fit)])
        places, order = order[:size], order[size:]
        touches = task.touches.take(places)
        yield step, Batch(*touches, task.target.y[places].astype(kind)), {}


def _loss_of(task: TuningTask, options: FinetuneOptions) -> Callable[..., Any]:
    """Return the loss of a batch: cross-entropy of smoothed labels, or squared errors of numbers.

    Label smoothing (Szegedy et al. 2016) keeps a head of few recordings from growing without end.
    """
    run = task.encoder.traceable(options.pooling)
    mean = jnp.asarray(task.linear.mean)[None]
    scale = jnp.asarray(task.linear.scale)[None]
    # Of numbers, so that a loss in newtons and one in millimetres are alike.
    spread = float(np.std(task.target.y[task.parts.fit])) or 1.0
    smoothing = options.recipe.smoothing

    def loss(
        params: Params, batch: Batch, key: jax.Array, progress: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        clip: Any = batch.clip
        if options.augment:
            clip = changed(key, clip)
        own = {name: part for name, part in params.items() if name != HEAD}
        x = (run(own, clip, jnp.asarray(batch.sensor)) - mean) / scale
        outputs = x @ params[HEAD]["kernel"] + params[HEAD]["bias"][None]
        if task.target.is_number:
            error = (outputs[:, 0] - batch.target) / spread
            return jnp.mean(error * error), {}
        if outputs.shape[1] == 1:
            outputs = jnp.concatenate([jnp.zeros_like(outputs), outputs], axis=1)
        logs = jax.nn.log_softmax(outputs)
        chosen = jnp.take_along_axis(logs, batch.target[:, None], axis=1)[:, 0]
        return -jnp.mean((1 - smoothing) * chosen + smoothing * jnp.mean(logs, axis=1)), {}

    return loss


def time_left(until: float) -> float:
    """Return the seconds until a time of `time.monotonic`, 0 after it."""
    return max(0.0, until - time.monotonic())
