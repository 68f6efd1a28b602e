"""Fine-tuning of a pouring policy: the encoder is trained with the MLP over its features.

Demonstrations are few, and an encoder soon knows their gels by heart. So a step draws many runs, in mirrors of chance,
with a few moments each: the segments of the standing and of the lifted cylinder are embedded once a run, and the last
one of a moment is the one before of the next.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
import optax

from anytouch_jax.encoder.encoder import Pooling, touch_features
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import Net
from experiments.pouring.policy import LAG, LIFTED, Head, Learning, Touch, forward, inputs, segments
from experiments.pouring.trials import FRAMES, Trials

Array = npt.NDArray[Any]
Params = Any


class Chains(NamedTuple):
    """Moments of R runs, C of each in a chain: the `runs` (R,), the `numbers` (R, 3 + C) of the segments to embed
    (standing, lifted, the one before the chain, the C of the chain) and `inside` (R, C), which moments there are."""

    runs: Array
    numbers: Array
    inside: Array


def draw(rng: np.random.Generator, steps: Array, runs: int, moments: int) -> Chains:
    """Chains of `moments`, `LAG` apart, in `runs` runs drawn from those that took `steps` (B,) actions.

    Each moment of choice of a run is as likely as the others; a chain may stick out at either end of its run.
    """
    drawn = rng.integers(len(steps), size=runs)
    last = (steps[drawn] - FRAMES)[:, None]
    end = rng.integers(LIFTED, last + 1 + LAG * (moments - 1))
    chain = end - LAG * np.arange(moments, -1, -1)
    inside = (chain[:, 1:] >= LIFTED) & (chain[:, 1:] <= last)
    known = np.broadcast_to([0, LIFTED], (runs, 2))
    return Chains(drawn, np.concatenate([known, np.clip(chain, LIFTED, last)], 1), inside)


def fine_tune(policy: Touch, trials: Trials, learning: Learning) -> Touch:
    """Go on from a policy over frozen features with the encoder's parameters trained too, on all demonstrations.

    The policy's `loss` then is that of its last tenth of steps. Raises UserError when that is not finite.
    """
    assert trials.frames is not None
    encoder, stills, runs = policy.encoder, policy.stills, learning.tune_runs
    step, state, params = _tuner(policy, learning)
    rng = np.random.default_rng(learning.seed % 2**63)
    losses: list[jax.Array] = []
    for _ in range(learning.tune_steps):
        chains = draw(rng, trials.steps, runs, learning.tune_moments)
        where = np.stack([chains.numbers, np.broadcast_to(chains.runs[:, None], chains.numbers.shape)], -1)
        sides = rng.integers(2, size=(len(trials.steps), 2))
        clips = segments(encoder, trials.frames, where.reshape(-1, 2), 1 if stills else FRAMES, sides)
        clips = clips.reshape(runs, -1, *clips.shape[1:])
        choices = trials.choices[chains.numbers[:, 3:] + FRAMES - 1, chains.runs[:, None]]
        params, state, loss = step(params, state, clips, choices, chains.inside)
        losses.append(loss)
    tuned = replace(encoder, params=params["encoder"], source=f"{encoder.source}, fine-tuned")
    head = policy.head._replace(**params["head"])
    late = float(np.mean(jax.device_get(losses[-max(1, learning.tune_steps // 10) :])))
    if not math.isfinite(late):
        raise UserError(f"fine-tuning went astray (its loss is {late}); lower tune_rate, {learning.tune_rate:g} now")
    return Touch(
        tuned, head, stills=stills, pooling=policy.pooling, sensor=policy.sensor, votes=policy.votes, loss=late
    )


def _tuner(policy: Touch, learning: Learning) -> tuple[Callable[..., tuple[Params, Any, jax.Array]], Any, Params]:
    """The compiled step of fine-tuning, its optimiser's state and its parameters."""
    encoder, head = policy.encoder, policy.head
    params = {"encoder": encoder.params, "head": {"basis": head.basis, "layers": head.layers}}
    steps = learning.tune_steps

    def optimiser_of(rate: float) -> optax.GradientTransformation:
        rates = optax.warmup_cosine_decay_schedule(0.0, rate, steps // 10, steps)
        return optax.adamw(rates, weight_decay=learning.decay)

    optimiser = optax.chain(
        optax.clip_by_global_norm(1.0),
        optax.multi_transform(
            {"encoder": optimiser_of(learning.tune_rate), "head": optimiser_of(2 * learning.rate)},
            {"encoder": "encoder", "head": "head"},
        ),
    )
    sensor = encoder.sensor_row(policy.sensor)
    logits = partial(logits_of, net=encoder.net, pooling=policy.pooling, mean=head.mean, sensor=sensor)

    def loss_of(params: Params, clips: jax.Array, choices: jax.Array, inside: jax.Array) -> jax.Array:
        losses = optax.softmax_cross_entropy_with_integer_labels(logits(params, clips), choices)
        return jnp.sum(losses * inside) / jnp.maximum(jnp.sum(inside), 1)

    @jax.jit
    def step(params: Params, state: Any, clips: jax.Array, choices: jax.Array, inside: jax.Array) -> Any:
        loss, slope = jax.value_and_grad(loss_of)(params, clips, choices, inside)
        change, state = optimiser.update(slope, state, params)
        return optax.apply_updates(params, change), state, loss

    return step, optimiser.init(params), params


def logits_of(
    params: Params, clips: jax.Array, *, net: Net, pooling: Pooling, mean: jax.Array, sensor: int
) -> jax.Array:
    """Logits (R, C, 3) of the moments of chains, from their segments (R, 3 + C, T, h, w, 3), and parameters of the
    encoder and of the MLP with its basis."""
    runs, count = clips.shape[:2]
    flat = clips.reshape(runs * count, *clips.shape[2:])
    rows = jnp.full(len(flat), sensor, jnp.int32)
    z = touch_features(params["encoder"], flat, rows, net=net, pooling=pooling, join="mean")
    z = z.reshape(runs, count, -1)
    before, now = z[:, 2:-1], z[:, 3:]
    standing, lifted = (jnp.broadcast_to(z[:, i : i + 1], now.shape) for i in (0, 1))
    x = inputs(now, before, lifted, standing, jnp)
    return forward(Head(mean, **params["head"]), x.reshape(-1, x.shape[-1])).reshape(*now.shape[:2], -1)
