"""AdamW, the learning-rate schedule, and rules over parameter names.

A step may not use a parameter, such as a clip's head on a batch of stills. That parameter is skipped: no decay, no
moment and no count, as in PyTorch when a gradient is None. So each parameter needs its own count, and `optax.adamw`
has one for all.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax.config import Config
from anytouch_jax.errors import ConfigError
from anytouch_jax.train.pack import Packing, global_norm, packing
from anytouch_jax.weights.tree import flatten

Array = jax.Array
Tree = Any
T = TypeVar("T")


class OptState(NamedTuple):
    """The state of `optimizer`.

    `counts` i32 (parameters,) is how often each parameter was updated. `mu` and `nu` are the first and second moments,
    packed by `pack.packing`. `learning_rate` f32 () is the last one.
    """

    counts: Array
    mu: tuple[Array, ...]
    nu: tuple[Array, ...]
    learning_rate: Array


class Moments(NamedTuple):
    """The state of Adam for one parameter: the count `updates` i32 (), and `mu` and `nu` of its shape."""

    updates: Array
    mu: Array
    nu: Array


def moments(state: OptState, params: Tree) -> Tree:
    """Return the `Moments` of every parameter, in a tree like `params`."""
    layout = packing(params)
    counts = layout.treedef.unflatten(list(state.counts))
    return jax.tree.map(Moments, counts, layout.unpack(state.mu), layout.unpack(state.nu))


def match_rules(rules: Sequence[tuple[str, T]], names: Iterable[str]) -> dict[str, T]:
    """Return for each name the value of the first rule whose regex matches. Raises ConfigError if none does."""
    matched: dict[str, T] = {}
    for name in names:
        values = [value for pattern, value in rules if re.search(pattern, name)]
        if not values:
            raise ConfigError(f'no rule matches the parameter {name}. End the rules with ("", value).')
        matched[name] = values[0]
    return matched


def learning_rate(t: Array | float, *, peak: float, floor: float, warmup: float, total: float, decay: str) -> Array:
    """Return the learning rate at time `t`, f32 of its shape.

    It rises linearly from 0 to `peak` at `warmup`, falls to `floor` at `total`, and stays there. `t`, `warmup` and
    `total` share a unit (steps or epochs) and may be fractions. `decay` is "linear" (the paper) or "cosine", half a
    period (the release). Raises ConfigError for another decay.
    """
    if decay not in ("linear", "cosine"):
        raise ConfigError(f"unknown decay {decay!r}. Choose linear or cosine.")
    t = jnp.asarray(t, jnp.float32)
    share = jnp.clip((t - warmup) / max(total - warmup, 1e-9), 0.0, 1.0)
    height = 1.0 - share if decay == "linear" else 0.5 * (1.0 + jnp.cos(jnp.pi * share))
    return jnp.where(t < warmup, peak * t / max(warmup, 1e-9), floor + (peak - floor) * height)


def schedule(config: Config) -> Callable[[Array | float], Array]:
    """Return the schedule of a run: step -> learning rate. Step 0 has rate 0 (golden H)."""
    options = config.optim

    def rate(step: Array | float) -> Array:
        return learning_rate(
            step,
            peak=options.learning_rate,
            floor=options.min_rate,
            warmup=config.warmup,
            total=config.run.steps,
            decay=options.decay,
        )

    return rate


def depth_rate(name: str, shape: tuple[int, ...], config: Config) -> Array | float:
    """Return the factor on a parameter's learning rate: a number, or one for each of stacked blocks (L, 1, ...).

    Of L blocks of the touch encoder, block i of 1 to L has the factor layer_decay^(L - i). Parameters before the
    blocks have layer_decay^L, and all others 1. BEiT's fine-tuning (Bao et al. 2022) is alike, but its last block has
    the factor layer_decay.
    """
    depth, decay = config.model.touch.depth, config.optim.layer_decay
    if name.startswith("touch/blocks/"):
        return jnp.expand_dims(decay ** jnp.arange(depth - 1, -1, -1.0), range(1, len(shape)))
    return decay**depth if re.match(r"touch/(?!post_norm|projection)", name) else 1.0


def optimizer(config: Config) -> optax.GradientTransformationExtraArgs:
    """Return AdamW as PyTorch computes it, with decoupled decay by `config.weight_decay` and optional clipping.

    Call `update(grads, state, params, *, used=None, step=None, learning_rate=None)`. `used` is a tree of Python bools.
    An unused parameter does not change, and does not count in the clipping norm. The rate is `learning_rate`, or that
    of `schedule` at `step`, so that a skipped step does not shift the schedule.
    """
    options, rate = config.optim, schedule(config)

    def init(params: Tree) -> OptState:
        layout = packing(params)
        mu, nu = (tuple(jnp.zeros_like(x) for x in layout.pack(params)) for _ in range(2))
        return OptState(jnp.zeros(len(layout.shapes), jnp.int32), mu, nu, jnp.zeros((), jnp.float32))

    def update(
        grads: Tree,
        state: OptState,
        params: Tree | None = None,
        *,
        used: Tree | None = None,
        step: Array | float | None = None,
        learning_rate: Array | float | None = None,
        **_: Any,
    ) -> tuple[Tree, OptState]:
        if params is None or (step is None and learning_rate is None):
            raise TypeError("update needs params, and step or learning_rate")
        lr = jnp.asarray(rate(step) if learning_rate is None else learning_rate, jnp.float32)  # type: ignore[arg-type]
        layout = packing(params)
        directions, count, mu, nu = _adamw(config, layout, grads, state, params, used)
        updates = layout.unpack([(-lr * d).astype(d.dtype) for d in directions])
        if options.layer_decay != 1:
            slower = [d * depth_rate(name, d.shape, config) for name, d in flatten(updates).items()]
            updates = layout.treedef.unflatten(slower)
        return updates, OptState(count, mu, nu, lr)

    return optax.GradientTransformationExtraArgs(init, update)


def _adamw(
    config: Config, layout: Packing, grads: Tree, state: OptState, params: Tree, used: Tree | None
) -> tuple[list[Array], Array, tuple[Array, ...], tuple[Array, ...]]:
    """Return packed directions before the learning rate, counts and moments. An unused leaf has direction 0."""
    options = config.optim
    uses = np.asarray([True] * len(layout.shapes) if used is None else layout.treedef.flatten_up_to(used))
    decays = np.asarray(list(match_rules(config.weight_decay, flatten(params)).values()), np.float32)
    count = state.counts + uses.astype(np.int32)
    first, second = (1.0 - jnp.float32(beta) ** count for beta in (options.beta1, options.beta2))  # bias corrections
    gradients = layout.pack(grads)
    use = [layout.spread(k, uses) for k in range(len(gradients))]
    if options.grad_clip is not None:
        length = global_norm([jnp.where(here, g, 0) for here, g in zip(use, gradients, strict=True)])
        gradients = tuple(g * jnp.minimum(1.0, options.grad_clip / length) for g in gradients)
    directions, mus, nus = [], list(state.mu), list(state.nu)
    for k, (grad, value) in enumerate(zip(gradients, layout.pack(params), strict=True)):
        if not np.any(use[k]):
            directions.append(jnp.zeros_like(value))
            continue
        mu = options.beta1 * mus[k] + (1 - options.beta1) * grad
        nu = options.beta2 * nus[k] + (1 - options.beta2) * grad * grad
        mu_hat, nu_hat = mu / layout.spread(k, first), nu / layout.spread(k, second)
        direction = mu_hat / (jnp.sqrt(nu_hat) + options.eps) + layout.spread(k, decays) * value
        if not np.all(use[k]):  # where a count is 0, the corrected moments are NaN
            direction, mu, nu = (
                jnp.where(use[k], new, old) for new, old in ((direction, 0.0), (mu, mus[k]), (nu, nus[k]))
            )
        directions.append(direction.astype(value.dtype))
        mus[k], nus[k] = mu.astype(mus[k].dtype), nu.astype(nus[k].dtype)
    return directions, count, tuple(mus), tuple(nus)
