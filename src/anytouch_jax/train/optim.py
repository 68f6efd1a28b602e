"""The optimiser: names and regex rules, the learning-rate schedule, AdamW with one state per parameter.

A step may leave a parameter out (a clip's head on a batch of stills). Such a parameter is skipped whole: no decay,
no moment, no count, as PyTorch does when a gradient is None. Hence each parameter has its own Adam state.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import optax

from anytouch_jax.config import Config, ConfigError

Array = jax.Array
Tree = Any
T = TypeVar("T")


class OptState(NamedTuple):
    """State of `optimizer`: `moments`, an optax ScaleByAdamState a parameter; `ema`, averaged parameters or {};
    `learning_rate` f32 (), the rate of the last update."""

    moments: Tree
    ema: Tree
    learning_rate: Array


def flatten_names(tree: Tree) -> dict[str, Any]:
    """The leaves of a nested tree by name: the path joined with "/", in the tree's own order."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def match_rules(rules: Sequence[tuple[str, T]], names: Iterable[str]) -> dict[str, T]:
    """The value of the first rule whose regex is found in each name. Raises ConfigError for a name without a rule."""
    found: dict[str, T] = {}
    for name in names:
        values = [value for pattern, value in rules if re.search(pattern, name)]
        if not values:
            raise ConfigError(f'no rule matches the parameter {name}; end the rules with ("", value)')
        found[name] = values[0]
    return found


def learning_rate(t: Array | float, *, peak: float, floor: float, warmup: float, total: float, decay: str) -> Array:
    """Learning rate at time `t`: from 0 linearly to `peak` at `warmup`, then down to `floor` at `total`, and there on.

    `t`, `warmup` and `total` share a unit (steps or epochs) and may be fractions; `decay` is "linear" (the paper) or
    "cosine", half a period (the release). Returns f32 of t's shape. Raises ConfigError for another decay.
    """
    if decay not in ("linear", "cosine"):
        raise ConfigError(f"unknown decay {decay!r}; choose linear or cosine")
    t = jnp.asarray(t, jnp.float32)
    share = jnp.clip((t - warmup) / max(total - warmup, 1e-9), 0.0, 1.0)
    height = 1.0 - share if decay == "linear" else 0.5 * (1.0 + jnp.cos(jnp.pi * share))
    return jnp.where(t < warmup, peak * t / max(warmup, 1e-9), floor + (peak - floor) * height)


def schedule(config: Config) -> Callable[[Array | float], Array]:
    """The schedule of a run: step -> learning rate. Step 0 has rate 0 (golden H)."""
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


def optimizer(config: Config) -> optax.GradientTransformationExtraArgs:
    """AdamW as PyTorch computes it: decoupled decay by `config.weight_decay`, optional global-norm clipping and EMA.

    `update(grads, state, params, *, used=None, step=None, learning_rate=None)`: `used` is a tree of Python bools, a
    parameter that is not used stays as it is and does not count in the clipping norm; the rate is that of `schedule`
    at `step`, or `learning_rate` if given. So a skipped step does not shift the schedule. `ema_params` reads the EMA.
    """
    options, rate = config.optim, schedule(config)
    adam = optax.scale_by_adam(options.beta1, options.beta2, options.eps)
    adamw = functools.partial(_adamw, config, adam)

    def init(params: Tree) -> OptState:
        # A copy: the parameters and their average must not share buffers, since both are donated to the step.
        ema = {} if options.ema is None else jax.tree.map(jnp.copy, params)
        return OptState(jax.tree.map(adam.init, params), ema, jnp.zeros((), jnp.float32))

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
        directions, moments = adamw(grads, state.moments, params, used)
        updates = jax.tree.map(lambda d, p: (-lr * d).astype(p.dtype), directions, params)
        ema = state.ema
        if options.ema is not None:
            ema = optax.incremental_update(optax.apply_updates(params, updates), ema, 1.0 - options.ema)
        return updates, OptState(moments, ema, lr)

    return optax.GradientTransformationExtraArgs(init, update)


def _adamw(
    config: Config, adam: optax.GradientTransformation, grads: Tree, moments: Tree, params: Tree, used: Tree | None
) -> tuple[Tree, Tree]:
    """Directions of AdamW before the learning rate, and the moments; zero and unmoved where a leaf is not used."""
    treedef: Any = jax.tree.structure(params)
    values, states, gradients = (treedef.flatten_up_to(tree) for tree in (params, moments, grads))
    uses = [True] * len(values) if used is None else treedef.flatten_up_to(used)
    decays = match_rules(config.weight_decay, flatten_names(params)).values()
    norm = config.optim.clip_norm
    clip = optax.identity() if norm is None else optax.clip_by_global_norm(norm)
    kept, _ = clip.update([g for g, use in zip(gradients, uses, strict=True) if use], optax.EmptyState())
    clipped = iter(kept)
    directions = []
    for i, (value, use, decay) in enumerate(zip(values, uses, decays, strict=True)):
        if not use:
            directions.append(jnp.zeros_like(value))
            continue
        direction, states[i] = adam.update(next(clipped), states[i])
        direction, _ = optax.add_decayed_weights(decay).update(direction, optax.EmptyState(), value)
        directions.append(direction)
    return treedef.unflatten(directions), treedef.unflatten(states)


def ema_params(opt_state: OptState) -> Tree | None:
    """The exponential moving average of the trained parameters, or None when `optim.ema` is off."""
    return opt_state.ema or None
