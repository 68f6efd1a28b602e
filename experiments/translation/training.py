"""Training and scoring translations between sensors (App. "Cross-sensor generation").

The error is the paper's mean squared error between what is generated and the truth. The paper does
not say in which units; here images are in the normalised pixels that its encoder reads (ImageNet's
mean and deviation), fields have each of their six channels in deviations over the training fields.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from anytouch_jax.encoder.embed import run_in_batches
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.errors import UserError
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.train.optim import learning_rate
from experiments.translation.generator import (
    Design,
    Fit,
    Generator,
    Params,
    features,
    judged,
    nameless,
    predict,
    units,
)
from experiments.translation.networks import STATES, Translation

Log = Callable[[str], None]
_SAMPLE = 512  # images that the features' mean and deviation are taken from
_CHUNK = 64
_FAINT = 1e-4
VERSION = 3  # of how a translation learns from the same pairs


class Batch(NamedTuple):
    """Source features, or images u8 where they are computed in the step; normalised targets f32;
    the critic's features (B, 2 D) of the real targets where its encoder is frozen, else None.
    """

    x: Any
    y: Any
    real: Any


class Rates(NamedTuple):
    """What may differ between runs of one compiled step: learning rate, weight of the critic's
    verdict, its penalty.
    """

    learning_rate: Any
    adversarial: Any
    penalty: Any


class State(NamedTuple):
    """What a training step carries on: the generator's and the critic's trained parameters, and
    their optimisers'.
    """

    made: Params
    critic: Params
    made_moments: Any
    critic_moments: Any


def fit(  # noqa: PLR0913, the pairs, their names and the options of a training
    encoder: Encoder | None,
    images: np.ndarray,
    targets: np.ndarray,
    *,
    source: str,
    target: str,
    val: tuple[np.ndarray, np.ndarray] | None = None,
    options: Fit | None = None,
    shape: Translation | None = None,
    log: Log | None = None,
) -> tuple[Generator, list[dict[str, float]]]:
    """Train a translation on pairs: source `images` u8 (n, H, W, 3), `targets` images u8 alike or
    fields f32.

    `encoder` None trains the reference that reads pixels; it needs a `shape`. `val`: pairs of other
    objects; of the states after every twentieth of the steps the one with the smallest error on
    them is kept, else the last. Gives back the generator and its losses at these steps. Raises
    UserError when the error stops being finite.
    """
    options = options or Fit()
    design = _design(encoder, images, targets, source, target, options, shape)
    params = start(design, encoder, images, targets)
    pairs = _pairs(
        design, params, images, targets, val if val is not None and len(val[0]) else None
    )
    program = _step(nameless(design))
    state, still = begin(design, params)
    losses: list[dict[str, float]] = []
    best = np.inf
    made = state.made
    every = max(1, options.steps // 20)
    for step in range(options.steps):
        state, metrics = program(
            state, still, pairs.batch(options, step), rates(design, params["fixed"], step)
        )
        if step % every == every - 1 or step == options.steps - 1:
            error = pairs.val_error(Generator(design, state.made | still))
            losses.append(_finite(step, metrics, error))
            if error is None or error < best:
                best = error or 0.0
                made = state.made
            if log is not None:
                log(", ".join(f"{name} {value:.4g}" for name, value in losses[-1].items()))
    return Generator(design, jax.tree.map(np.asarray, made | still)), losses


def _design(
    encoder: Encoder | None,
    images: np.ndarray,
    targets: np.ndarray,
    source: str,
    target: str,
    options: Fit,
    shape: Translation | None,
) -> Design:
    """What is trained.

    Raises UserError for a reference without a shape, and images of another size.
    """
    if shape is None:
        if encoder is None:
            raise UserError("a reference without an encoder needs its shape")
        model = encoder.config.model
        field = () if targets.dtype == np.uint8 else targets.shape[1:]
        shape = Translation(model, field=field, states=min(STATES, model.touch.depth + 1))
    side = shape.model.image_size
    if images.shape[1:] != (side, side, 3) or (
        targets.dtype == np.uint8 and targets.shape[1:] != images.shape[1:]
    ):
        raise UserError(
            f"images must be {side} x {side} pixels of three colours, not {images.shape}, "
            f"{targets.shape}"
        )
    whence, less = (None, False) if encoder is None else (encoder.source, encoder.subtracts)
    return Design(source, target, shape, whence, options, len(images), less)


class _Pairs(NamedTuple):
    """What a fit reads: of every pair the source's features (else its image), the target, and the
    critic's features of it; `mean`, `scale` of the targets. `val`: source, target of other objects,
    and the source's features.
    """

    x: np.ndarray
    y: np.ndarray
    real: np.ndarray | None
    mean: np.ndarray
    scale: np.ndarray
    val: tuple[np.ndarray, np.ndarray, np.ndarray | None] | None

    def batch(self, options: Fit, step: int) -> Batch:
        """The pairs of a step: a function of the seed and the step alone."""
        rows = np.random.default_rng([options.seed % 2**63, step]).integers(
            len(self.x), size=options.batch
        )
        y = (self.y[rows].astype(np.float32) - self.mean) / self.scale
        return Batch(self.x[rows], y, None if self.real is None else self.real[rows])

    def val_error(self, now: Generator) -> float | None:
        """The mean error on val; None without it."""
        if self.val is None:
            return None
        source, target, read = self.val
        guess = now.normalised(source) if read is None else now.from_features(read)
        return float(_errors(now, guess, target).mean())


def _pairs(
    design: Design, params: Params, images: np.ndarray, targets: np.ndarray, val: Any
) -> _Pairs:
    """The pairs; those of a frozen encoder are seen by it once, before the first step."""
    mean, scale = units(design, params["fixed"])
    if design.encoder is None or design.fit.tune != "frozen":
        return _Pairs(images, targets, None, mean, scale, None if val is None else (*val, None))
    read = partial(_features(nameless(design)), params["encoder"])
    judge = partial(_judged(nameless(design)), (params["encoder"], params["fixed"].get("gel")))
    real = run_in_batches(judge, targets) if design.has_critic else None
    known = None if val is None else (*val, run_in_batches(read, val[0]))
    return _Pairs(run_in_batches(read, images), targets, real, mean, scale, known)


def _finite(step: int, metrics: dict[str, Any], error: float | None) -> dict[str, float]:
    """Return the losses of a step as floats. Raises UserError for an error that is not finite."""
    losses = {"step": step + 1} | {name: float(value) for name, value in metrics.items()}
    losses |= {} if error is None else {"val": error}
    for name, where in (("error", ""), ("val", " on val")):
        if not np.isfinite(losses.get(name, 0.0)):
            raise UserError(
                f"the error{where} is not finite at step {step + 1}; lower the learning rate"
            )
    return losses


def start(
    design: Design, encoder: Encoder | None, images: np.ndarray, targets: np.ndarray
) -> Params:
    """Return the first parameters: `encoder`, a new `head`, and constants `fixed` of the training
    pairs.
    """
    key = jax.random.fold_in(jax.random.key(design.fit.seed), 0)
    params: Params = {"head": design.head.init(key)}
    if encoder is not None:
        params["encoder"] = encoder.params
    every = max(1, len(images) // _SAMPLE)
    read = run_in_batches(
        partial(_features(nameless(design)), params.get("encoder")), images[::every][:_SAMPLE]
    )
    mean, scale = _moments(read)
    fixed = (
        {"mean": mean, "scale": scale}
        if encoder is None
        else {"mean": mean, "whiten": whitening(read)}
    )
    if design.shape.field:
        fixed["unit_mean"], fixed["unit_scale"] = _moments(targets)
    if design.has_critic and design.subtracts:
        fixed["gel"] = untouched(targets[::every][:_SAMPLE], *units(design, fixed))
    middle, spread = mean_target(targets, *units(design, fixed))
    return params | {"fixed": fixed | {"target": middle, "spread": spread}}


def _moments(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviation of the last axis, 1 for what never changes."""
    flat = values.reshape(-1, values.shape[-1]).astype(np.float64)
    mean = flat.mean(0)
    scale = flat.std(0)
    return mean.astype(np.float32), np.where(scale > 1e-9, scale, 1).astype(np.float32)


def whitening(tokens: np.ndarray) -> np.ndarray:
    """The matrix (D, D) that gives centred tokens (..., D) equal variances in all directions, but
    for those of less than `_FAINT` of the largest (ZCA).

    An encoder's channels go together: ten of a hundred directions hold nearly all of their
    variance, and what an image needs in addition is learned late or never where each channel is
    divided by its own deviation.
    """
    flat = tokens.reshape(-1, tokens.shape[-1]).astype(np.float64)
    variance, axes = np.linalg.eigh(np.cov(flat, rowvar=False))
    variance = np.maximum(variance, 0) + max(_FAINT * variance[-1], 1e-12)
    return np.asarray(axes / np.sqrt(variance) @ axes.T, np.float32)


def untouched(targets: np.ndarray, mean: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The untouched gel of the target, normalised: the median of its images, few of which touch a
    given place.
    """
    return ((np.median(targets, axis=0) - mean) / scale).astype(np.float32)


def mean_target(
    targets: np.ndarray, mean: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The mean of normalised targets, and the deviation from it by channel: the first reference,
    and a unit.
    """
    total = np.zeros(targets.shape[1:])
    square = np.zeros(targets.shape[1:])
    for first in range(0, len(targets), _CHUNK):
        part = (targets[first : first + _CHUNK].astype(np.float64) - mean) / scale
        total += part.sum(0)
        square += (part**2).sum(0)
    middle = total / len(targets)
    variance = np.maximum(square / len(targets) - middle**2, 0).mean(tuple(range(middle.ndim - 1)))
    return middle.astype(np.float32), np.sqrt(np.where(variance > 1e-12, variance, 1)).astype(
        np.float32
    )


@lru_cache(maxsize=8)
def _features(design: Design) -> Any:
    return jax.jit(lambda encoder, images: features(design, encoder, images))


@lru_cache(maxsize=8)
def _judged(design: Design) -> Any:
    return jax.jit(lambda read, images: judged(design, read[0], normalise_touch(images), read[1]))


# One step
# --------------------------------------------------------------------------------------------------


# AdamW before its learning rate, gradients clipped.
_TX = optax.chain(
    optax.clip_by_global_norm(1.0), optax.scale_by_adam(b2=0.99), optax.add_decayed_weights(0.05)
)


def rates(design: Design, fixed: Params, step: int) -> Rates:
    """The rates of a step: a short warm-up and cosine decay; the weight times the mean target's own
    error.
    """
    options = design.fit
    # A warm-up in steps that starts above 0 and a decay that ends below the last step: no step is
    # without effect.
    ahead = {"warmup": max(1, options.steps // 20), "total": options.steps + 1}
    rate = learning_rate(step + 1, peak=options.learning_rate, floor=0.0, decay="cosine", **ahead)
    weight = options.adversarial * np.mean(np.square(fixed["spread"]))
    return Rates(np.float32(rate), np.float32(weight), np.float32(options.penalty))


def begin(design: Design, params: Params) -> tuple[State, Params]:
    """Return the state before the first step, and the frozen parameters."""
    made = {"head": params["head"]}
    still = {"fixed": params["fixed"]}
    critic: Params = {}
    if design.has_critic:
        critic = {
            "head": design.critic.init(jax.random.fold_in(jax.random.key(design.fit.seed), 1))
        }
    if "encoder" in params:
        (made if design.fit.tune == "fine" else still)["encoder"] = params["encoder"]
        if design.has_critic and design.fit.tune == "fine":
            critic["encoder"] = params["encoder"]
    return State(made, critic, _TX.init(made), _TX.init(critic)), still


@lru_cache(maxsize=8)
def _step(design: Design) -> Any:
    """(state, still parameters, batch, rates) -> (state, metrics), compiled: one step of both
    networks.
    """
    frozen = design.fit.tune == "frozen"

    def judge_features(critic: Params, still: Params, pixels: Array) -> Array:
        encoder = still["encoder"] if frozen else critic["encoder"]
        return judged(design, encoder, pixels, still["fixed"].get("gel"))

    def made_loss(made: Params, critic: Params, still: Params, batch: Batch, weight: Array) -> Any:
        params = made | still
        x = batch.x if "encoder" in still else features(design, params.get("encoder"), batch.x)
        out = predict(design, params, x)
        error = jnp.mean((out - batch.y) ** 2)
        if not design.has_critic:
            return error, (error, out, jnp.zeros(()))
        read = judge_features(critic, still, out)
        fooled = jnp.mean(jax.nn.softplus(-design.critic.apply(critic["head"], read)))
        return error + weight * fooled, (error, out, read)

    def critic_loss(
        critic: Params, still: Params, batch: Batch, out: Array, read: Array, weight: Array
    ) -> Array:
        real = batch.real if frozen else judge_features(critic, still, batch.y)
        fake = read if frozen else judge_features(critic, still, out)
        logit = lambda x: design.critic.apply(critic["head"], x)  # noqa: E731
        slope = jax.grad(lambda x: jnp.sum(logit(x)))(real)
        penalty = jnp.mean(jnp.sum(slope**2, axis=-1))
        losses = jnp.mean(jax.nn.softplus(-logit(real))) + jnp.mean(jax.nn.softplus(logit(fake)))
        return losses + 0.5 * weight * penalty

    def step(
        state: State, still: Params, batch: Batch, rates: Rates
    ) -> tuple[State, dict[str, Array]]:
        rate, weight, penalty = rates
        grads, (error, out, read) = jax.grad(made_loss, has_aux=True)(
            state.made, state.critic, still, batch, weight
        )
        made, made_moments = _updated(rate, grads, state.made_moments, state.made)
        metrics = {"error": error}
        critic = state.critic
        critic_moments = state.critic_moments
        if design.has_critic:
            out, read = jax.lax.stop_gradient((out, read))
            metrics["critic"], grads = jax.value_and_grad(critic_loss)(
                critic, still, batch, out, read, penalty
            )
            critic, critic_moments = _updated(rate, grads, critic_moments, critic)
        return State(made, critic, made_moments, critic_moments), metrics

    return jax.jit(step)


def _updated(rate: Array, grads: Params, moments: Any, params: Params) -> tuple[Params, Any]:
    updates, moments = _TX.update(grads, moments, params)

    def moved(part: str) -> Params:
        own = 0.1 * rate if part == "encoder" else rate
        result: Params = jax.tree.map(lambda p, u: p - own * u, params[part], updates[part])
        return result

    return {part: moved(part) for part in params}, moments


# Scores
# --------------------------------------------------------------------------------------------------


def errors(generator: Generator, images: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Mean squared error f64 (n,) of every pair, in normalised units (see the module)."""
    return _errors(generator, generator.normalised(images), targets)


def mean_errors(generator: Generator, targets: np.ndarray) -> np.ndarray:
    """As `errors`, of copying the mean target of the generator's training pairs: the first
    reference.
    """
    middle = np.asarray(generator.params["fixed"]["target"])[None]
    return _errors(generator, np.broadcast_to(middle, (len(targets), *middle.shape[1:])), targets)


def _errors(generator: Generator, guess: np.ndarray, targets: np.ndarray) -> np.ndarray:
    mean, scale = units(generator.design, generator.params["fixed"])
    result = []
    for first in range(0, len(targets), _CHUNK):
        part = slice(first, first + _CHUNK)
        away = guess[part] - (targets[part].astype(np.float64) - mean) / scale
        result.append((away**2).mean(axis=tuple(range(1, away.ndim))))
    return np.concatenate(result)
