"""AdamW, the learning-rate schedule, and rules over parameter names.

A step may not use a parameter, such as a clip's head on a batch of stills. That parameter is
skipped: no decay, no moment and no count, as in PyTorch when a gradient is None. So each parameter
needs its own count, and `optax.adamw` has one for all. Small arrays are packed into one vector. A
ViT has about twenty parameters a stack, most of them vectors. One by one, their updates take longer
to compile than the whole backward pass.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax.config import Config
from anytouch_jax.errors import ConfigError
from anytouch_jax.ops.losses import row_sums
from anytouch_jax.weights.tree import flatten

Array = jax.Array
Tree = Any
T = TypeVar("T")
SMALL = 2**16  # elements; a larger array gets its own kernel and is sharded


class Packing(NamedTuple):
    """Which leaves of a tree are packed into one vector: `groups` of leaf numbers.

    A leaf alone is not changed.
    """

    groups: tuple[tuple[int, ...], ...]
    shapes: tuple[tuple[int, ...], ...]
    treedef: Any

    def pack(self, tree: Tree) -> tuple[Array, ...]:
        """Return one array a group."""
        leaves = self.treedef.flatten_up_to(tree)
        return tuple(
            leaves[group[0]]
            if len(group) == 1
            else jnp.concatenate([leaves[i].reshape(-1) for i in group])
            for group in self.groups
        )

    def unpack(self, arrays: Sequence[Array]) -> Tree:
        """Return the tree that was packed."""
        leaves: list[Any] = [None] * len(self.shapes)
        for group, array in zip(self.groups, arrays, strict=True):
            start = 0
            for i in group:
                size = int(np.prod(self.shapes[i]))
                leaves[i] = (
                    array
                    if len(group) == 1
                    else array[start : start + size].reshape(self.shapes[i])
                )
                start += size
        return self.treedef.unflatten(leaves)

    def spread(self, group: int, values: Any) -> Any:
        """Repeat `values` (leaves,) over the elements of a group: (n,), or () for a group of one
        leaf.
        """
        leaves = self.groups[group]
        if len(leaves) == 1:
            return values[leaves[0]]
        # The index is known while tracing: jnp.repeat would leave XLA to fold a cumulative sum for
        # seconds.
        return values[
            np.repeat(np.asarray(leaves, np.int32), [int(np.prod(self.shapes[i])) for i in leaves])
        ]


def packing(tree: Tree, small: int = SMALL) -> Packing:
    """Return how to pack a tree of arrays or shapes: leaves below `small` elements together, by
    data type.
    """
    leaves, treedef = jax.tree.flatten(tree)
    together: dict[Any, list[int]] = {}
    for i, leaf in enumerate(leaves):
        together.setdefault(leaf.dtype if leaf.size < small else i, []).append(i)
    groups = tuple(tuple(group) for group in together.values())
    return Packing(groups, tuple(leaf.shape for leaf in leaves), treedef)


def global_norm(arrays: Sequence[Array]) -> Array:
    """Return the Euclidean norm of all elements, f32 ()."""

    def squares(x: Array) -> Array:
        x = x.astype(jnp.float32)
        return jnp.sum(row_sums(x * x) if x.ndim > 1 else x * x)

    return jnp.sqrt(sum(map(squares, arrays)))


class OptState(NamedTuple):
    """The state of `optimizer`."""

    counts: Array  # i32 (parameters,): how often each was updated
    mu: tuple[Array, ...]  # first moments, packed by `packing`
    nu: tuple[Array, ...]  # second moments
    learning_rate: Array  # f32 (): the last one


def match_rules(rules: Sequence[tuple[str, T]], names: Iterable[str]) -> dict[str, T]:
    """Return for each name the value of the first rule whose regex matches.

    Raises ConfigError if none does.
    """
    matched: dict[str, T] = {}
    for name in names:
        values = [value for pattern, value in rules if re.search(pattern, name)]
        if not values:
            raise ConfigError(
                f'no rule matches the parameter {name}. End the rules with ("", value).'
            )
        matched[name] = values[0]
    return matched


def learning_rate(
    t: Array | float, *, peak: float, floor: float, warmup: float, total: float, decay: str
) -> Array:
    """Return the learning rate at time `t`, f32 of its shape.

    It rises linearly from 0 to `peak` at `warmup`, falls to `floor` at `total`, and stays there.
    `t`, `warmup` and `total` share a unit (steps or epochs) and may be fractions. `decay` is
    "linear" (the paper) or "cosine", half a period (the release). Raises ConfigError for another
    decay.
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
    ends = {"peak": options.learning_rate, "floor": options.min_rate, "warmup": config.warmup}
    return functools.partial(learning_rate, **ends, total=config.run.steps, decay=options.decay)


def depth_rate(name: str, shape: tuple[int, ...], config: Config) -> Array | float:
    """Return the factor on a parameter's learning rate: a number, or one for each of stacked blocks
    (L, 1, ...).

    Block i of 1 to L of the touch encoder has the factor layer_decay^(L - i), parameters before the
    blocks layer_decay^L, and all others 1. In BEiT's fine-tuning (Bao et al. 2022) the last block
    has layer_decay.
    """
    depth = config.model.touch.depth
    decay = config.optim.layer_decay
    if name.startswith("touch/blocks/"):
        return jnp.expand_dims(decay ** jnp.arange(depth - 1, -1, -1.0), range(1, len(shape)))
    if re.match(r"touch/(?!post_norm|projection)", name):
        return decay**depth
    return 1.0


def optimizer(config: Config) -> optax.GradientTransformationExtraArgs:
    """Return AdamW as PyTorch computes it, with decoupled decay by `config.weight_decay` and
    optional clipping.

    Call `update(grads, state, params, *, used=None, step=None, learning_rate=None, good=True)`.
    `used` is a tree of Python bools. An unused parameter does not change, and does not count in the
    clipping norm. The rate is `learning_rate`, or that of `schedule` at `step`, so that a skipped
    step does not shift the schedule. If `good` bool () is False, the state stays.
    """
    options = config.optim
    rate = schedule(config)

    def init(params: Tree) -> OptState:
        layout = packing(params)
        mu, nu = (tuple(jnp.zeros_like(x) for x in layout.pack(params)) for _ in range(2))
        return OptState(
            jnp.zeros(len(layout.shapes), jnp.int32), mu, nu, jnp.zeros((), jnp.float32)
        )

    def update(
        grads: Tree,
        state: OptState,
        params: Tree | None = None,
        *,
        used: Tree | None = None,
        step: Array | float | None = None,
        learning_rate: Array | float | None = None,
        good: Array | bool = True,
        **_: Any,
    ) -> tuple[Tree, OptState]:
        if params is None or (step is None and learning_rate is None):
            raise TypeError("update needs params, and step or learning_rate")
        lr = jnp.asarray(rate(step) if learning_rate is None else learning_rate, jnp.float32)  # type: ignore[arg-type]
        layout = packing(params)
        changes, count, mu, nu = _adamw(config, layout, grads, state, params, used, good, lr)
        updates = layout.unpack(changes)
        if options.layer_decay != 1:
            slower = [d * depth_rate(name, d.shape, config) for name, d in flatten(updates).items()]
            updates = layout.treedef.unflatten(slower)
        return updates, OptState(count, mu, nu, jnp.where(good, lr, state.learning_rate))

    return optax.GradientTransformationExtraArgs(init, update)


def _adamw(
    config: Config,
    layout: Packing,
    grads: Tree,
    state: OptState,
    params: Tree,
    used: Tree | None,
    good: Array | bool,
    rate: Array,
) -> tuple[list[Array], Array, tuple[Array, ...], tuple[Array, ...]]:
    """Return packed updates, counts and moments. An unused leaf has update 0."""
    options = config.optim
    uses = np.asarray(
        [True] * len(layout.shapes) if used is None else layout.treedef.flatten_up_to(used)
    )
    decays = np.asarray(
        list(match_rules(config.weight_decay, flatten(params)).values()), np.float32
    )
    count = state.counts + uses.astype(np.int32)
    # bias corrections
    first, second = (1.0 - jnp.float32(beta) ** count for beta in (options.beta1, options.beta2))
    gradients = layout.pack(grads)
    use = [layout.spread(k, uses) for k in range(len(gradients))]
    if options.grad_clip is not None:
        length = global_norm(
            [jnp.where(here, g, 0) for here, g in zip(use, gradients, strict=True)]
        )
        gradients = tuple(g * jnp.minimum(1.0, options.grad_clip / length) for g in gradients)
    updates = []
    mus = list(state.mu)
    nus = list(state.nu)
    for k, (grad, value) in enumerate(zip(gradients, layout.pack(params), strict=True)):
        if not np.any(use[k]):
            updates.append(jnp.zeros_like(value))
            continue
        keep = good if np.all(use[k]) else use[k] & good
        mu = options.beta1 * mus[k] + (1 - options.beta1) * grad
        nu = options.beta2 * nus[k] + (1 - options.beta2) * grad * grad
        mus[k], nus[k] = (
            jnp.where(keep, new, old).astype(old.dtype) for new, old in ((mu, mus[k]), (nu, nus[k]))
        )
        # One division comes last, which XLA does not repeat for each reader.
        size = jnp.sqrt(nus[k] / layout.spread(k, second)) + options.eps
        update = (
            -rate
            * (mus[k] / layout.spread(k, first) + layout.spread(k, decays) * value * size)
            / size
        )
        if not np.all(use[k]):  # where a count is 0, the corrected moments are NaN
            update = jnp.where(use[k], update, 0.0)
        updates.append(update.astype(value.dtype))
    return updates, jnp.where(good, count, state.counts), tuple(mus), tuple(nus)
