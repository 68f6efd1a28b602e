"""AdamW, the learning-rate schedule, and rules over parameter names.

A step may not use a parameter, such as a clip's head on a batch of stills. That parameter is
skipped: no decay, no moment and no count, as in PyTorch when a gradient is None. So each parameter
needs its own count, and `optax.adamw` has one for all.

Small arrays are packed into one vector. A ViT has about twenty parameters a stack, most of them
vectors. One by one, their updates take longer to compile than the whole backward pass.
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
# (parameter name, shape) -> factor on its learning rate, a number or an array that broadcasts
RateFn = Callable[[str, tuple[int, ...]], Array | float]
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
        arrays = []
        for group in self.groups:
            if len(group) == 1:
                arrays.append(leaves[group[0]])
            else:
                arrays.append(jnp.concatenate([leaves[i].reshape(-1) for i in group]))
        return tuple(arrays)

    def unpack(self, arrays: Sequence[Array]) -> Tree:
        """Return the tree that was packed."""
        leaves: list[Any] = [None] * len(self.shapes)
        for group, array in zip(self.groups, arrays, strict=True):
            if len(group) == 1:
                leaves[group[0]] = array
                continue
            start = 0
            for i in group:
                size = int(np.prod(self.shapes[i]))
                leaves[i] = array[start : start + size].reshape(self.shapes[i])
                start += size
        return self.treedef.unflatten(leaves)

    def spread(self, group: int, values: Any) -> Any:
        """Repeat `values` (leaves,) over the elements (n,) of a group; () for a single leaf."""
        leaves = self.groups[group]
        if len(leaves) == 1:
            return values[leaves[0]]
        # The index is known while tracing: jnp.repeat would leave XLA to fold a cumulative sum for
        # seconds.
        sizes = [int(np.prod(self.shapes[i])) for i in leaves]
        return values[np.repeat(np.asarray(leaves, np.int32), sizes)]


def packing(tree: Tree, small: int = SMALL) -> Packing:
    """Return how to pack a tree of arrays or shapes.

    Leaves below `small` elements are together, by data type.
    """
    leaves, treedef = jax.tree.flatten(tree)
    together: dict[Any, list[int]] = {}
    for i, leaf in enumerate(leaves):
        name = leaf.dtype if leaf.size < small else i
        together.setdefault(name, []).append(i)
    groups = tuple(tuple(group) for group in together.values())
    return Packing(groups, tuple(leaf.shape for leaf in leaves), treedef)


def global_norm(arrays: Sequence[Array]) -> Array:
    """Return the Euclidean norm of all elements, f32 ()."""

    def squares(x: Array) -> Array:
        x = x.astype(jnp.float32)
        if x.ndim > 1:
            # the faster sum on a CPU
            return jnp.sum(row_sums(x * x))
        return jnp.sum(x * x)

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

    Args:
        t: Time in steps or epochs, which `warmup` and `total` share. It may be a fraction.
        peak: The highest rate, reached linearly from 0 at `warmup`.
        floor: The rate at `total` and after it.
        warmup: Length of the warm-up.
        total: Length of the whole schedule.
        decay: "linear" (the paper) or "cosine", half a period (the release).

    Raises:
        ConfigError: For another decay.
    """
    if decay not in ("linear", "cosine"):
        raise ConfigError(f"unknown decay {decay!r}. Choose linear or cosine.")
    t = jnp.asarray(t, jnp.float32)
    part = jnp.clip((t - warmup) / max(total - warmup, 1e-9), 0.0, 1.0)
    if decay == "linear":
        height = 1.0 - part
    else:
        height = 0.5 * (1.0 + jnp.cos(jnp.pi * part))
    return jnp.where(t < warmup, peak * t / max(warmup, 1e-9), floor + (peak - floor) * height)


def schedule(config: Config) -> Callable[[Array | float], Array]:
    """Return the schedule of a run: step -> learning rate.

    With a warm-up step 0 has rate 0, as in the release.
    """
    options = config.optim
    return functools.partial(
        learning_rate,
        peak=options.learning_rate,
        floor=options.min_rate,
        warmup=config.warmup,
        total=config.run.steps,
        decay=options.decay,
    )


def depth_rate(name: str, shape: tuple[int, ...], config: Config) -> Array | float:
    """Return the factor on a parameter's learning rate by layer decay.

    It is a number, or for stacked blocks (L, 1, ...) one for each.

    Block i of 1 to L of the touch encoder has the factor layer_decay^(L - i), parameters before the
    blocks layer_decay^L, and all others 1. In BEiT's fine-tuning (Bao et al. 2022) the last block
    has layer_decay.
    """
    depth = config.model.touch.depth
    decay = config.optim.layer_decay
    if name.startswith("touch/blocks/"):
        each = decay ** jnp.arange(depth - 1, -1, -1.0)
        return jnp.expand_dims(each, range(1, len(shape)))
    if re.match(r"touch/(?!post_norm|projection)", name):
        return decay**depth
    return 1.0


def optimizer(config: Config, rates: RateFn | None = None) -> optax.GradientTransformationExtraArgs:
    """Return AdamW as PyTorch computes it (Loshchilov and Hutter, 2019).

    Weight decay is decoupled and follows `config.weight_decay`, clipping is optional, and `rates`
    gives factors on learning rates (None: `depth_rate`).

    Call `update(grads, state, params, *, used=None, step=None, learning_rate=None, good=True)`.
    `used` is a tree of Python bools. An unused parameter does not change, and does not count in the
    clipping norm. The rate is `learning_rate`, or that of `schedule` at `step`, so that a skipped
    step does not shift the schedule. If `good` bool () is False, the state stays.
    """
    rate = schedule(config)
    if rates is None and config.optim.layer_decay != 1:
        rates = functools.partial(depth_rate, config=config)

    def init(params: Tree) -> OptState:
        layout = packing(params)
        mu = tuple(jnp.zeros_like(x) for x in layout.pack(params))
        nu = tuple(jnp.zeros_like(x) for x in layout.pack(params))
        counts = jnp.zeros(len(layout.shapes), jnp.int32)
        return OptState(counts, mu, nu, jnp.zeros((), jnp.float32))

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
        if params is None:
            raise TypeError("update needs params")
        if learning_rate is None:
            if step is None:
                raise TypeError("update needs step or learning_rate")
            learning_rate = rate(step)
        lr = jnp.asarray(learning_rate, jnp.float32)
        layout = packing(params)
        if used is None:
            uses = np.ones(len(layout.shapes), bool)
        else:
            uses = np.asarray(layout.treedef.flatten_up_to(used))
        changes, state = _adamw(config, layout, grads, state, params, uses, good, lr)
        updates = layout.unpack(changes)
        if rates is not None:
            scaled = [d * rates(name, d.shape) for name, d in flatten(updates).items()]
            updates = layout.treedef.unflatten(scaled)
        return updates, state

    return optax.GradientTransformationExtraArgs(init, update)


def _adamw(
    config: Config,
    layout: Packing,
    grads: Tree,
    state: OptState,
    params: Tree,
    uses: np.ndarray,
    good: Array | bool,
    rate: Array,
) -> tuple[list[Array], OptState]:
    """Return packed updates and the new state. A leaf that is not in `uses` has update 0."""
    options = config.optim
    decays = np.asarray(
        list(match_rules(config.weight_decay, flatten(params)).values()), np.float32
    )
    # The bias corrections 1 - beta^t of Adam. t is how often this very parameter was updated: a
    # head that sees every second batch is as young as PyTorch would have it.
    count = state.counts + uses.astype(np.int32)
    first = 1.0 - jnp.float32(options.beta1) ** count
    second = 1.0 - jnp.float32(options.beta2) ** count
    gradients = layout.pack(grads)
    use = [layout.spread(k, uses) for k in range(len(gradients))]
    if options.grad_clip is not None:
        gradients = _clipped(gradients, use, options.grad_clip)
    updates = []
    mus = list(state.mu)
    nus = list(state.nu)
    for k, (grad, value) in enumerate(zip(gradients, layout.pack(params), strict=True)):
        # `use` is known while tracing, so groups that a batch kind does not train cost nothing.
        if not np.any(use[k]):
            updates.append(jnp.zeros_like(value))
            continue
        keep = good if np.all(use[k]) else use[k] & good
        mu = options.beta1 * mus[k] + (1 - options.beta1) * grad
        nu = options.beta2 * nus[k] + (1 - options.beta2) * grad * grad
        mus[k] = jnp.where(keep, mu, mus[k]).astype(mus[k].dtype)
        nus[k] = jnp.where(keep, nu, nus[k]).astype(nus[k].dtype)
        # -rate * (mu / first / size + decay * value), with one division that comes last, which XLA
        # does not repeat for each reader.
        size = jnp.sqrt(nus[k] / layout.spread(k, second)) + options.eps
        decayed = layout.spread(k, decays) * value * size
        update = -rate * (mus[k] / layout.spread(k, first) + decayed) / size
        if not np.all(use[k]):
            # Where a count is 0, the corrected moments are NaN.
            update = jnp.where(use[k], update, 0.0)
        updates.append(update.astype(value.dtype))
    counts = jnp.where(good, count, state.counts)
    last_rate = jnp.where(good, rate, state.learning_rate)
    return updates, OptState(counts, tuple(mus), tuple(nus), last_rate)


def _clipped(gradients: tuple[Array, ...], use: Sequence[Any], longest: float) -> tuple[Array, ...]:
    """Return packed gradients whose norm over the used leaves is `longest` at most."""
    counted = [jnp.where(here, g, 0) for here, g in zip(use, gradients, strict=True)]
    length = global_norm(counted)
    return tuple(g * jnp.minimum(1.0, longest / length) for g in gradients)
