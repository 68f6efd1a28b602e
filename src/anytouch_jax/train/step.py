"""Training steps as pure functions: loss, gradients, accumulation, update and its metrics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from anytouch_jax.batch import AlignBatch
from anytouch_jax.config import Config
from anytouch_jax.errors import ConfigError, refuse_forked
from anytouch_jax.shown import shown_short
from anytouch_jax.train.optim import OptState, global_norm, match_rules, optimizer, packing
from anytouch_jax.weights.tree import flatten, nest

Array = jax.Array
Tree = Any
# (params, batch, key, progress) -> scalar loss and a dict of scalar metrics
LossAndMetrics = tuple[Array, dict[str, Array]]
LossFn = Callable[[Tree, Any, Array, Array], LossAndMetrics]
Rules = Sequence[tuple[str, bool]]  # (regex over parameter names, answer); the first match decides
# batch -> rules: is it trained?
TrainedFn = Callable[[Any], Rules]
StepFn = Callable[..., tuple["TrainState", dict[str, Array]]]


@shown_short
class TrainState(NamedTuple):
    """State of training: parameters as nested dicts, and the state of the optimiser.

    `step` i32 () is the number of steps that are done, skipped ones too.
    """

    step: Array
    trainable: Tree
    frozen: Tree
    opt_state: Any


def split(params: Tree, rules: Rules) -> tuple[Tree, Tree]:
    """Split nested parameters into (trainable, frozen) by rules (regex, frozen?)."""
    leaves = flatten(params)
    frozen = match_rules(rules, leaves)
    trainable = {name: leaf for name, leaf in leaves.items() if not frozen[name]}
    fixed = {name: leaf for name, leaf in leaves.items() if frozen[name]}
    return nest(trainable), nest(fixed)


def merge(trainable: Tree, frozen: Tree) -> Tree:
    """Return the nested parameters that `split` separated.

    Raises ValueError if a parameter is in both.
    """
    merged = dict(trainable)
    for name, value in frozen.items():
        if name not in merged:
            merged[name] = value
        elif isinstance(merged[name], dict) and isinstance(value, dict):
            merged[name] = merge(merged[name], value)
        else:
            raise ValueError(f"the parameter {name} is both trainable and frozen")
    return merged


def init_state(params: Tree, config: Config, frozen: Rules | None = None) -> TrainState:
    """Return the state before the first step: parameters split, moments zero.

    `frozen` are rules (regex, frozen?), those of the configuration by default.
    """
    refuse_forked()
    trainable, fixed = split(params, config.frozen if frozen is None else frozen)
    step = jnp.zeros((), jnp.int32)
    return TrainState(step, trainable, fixed, optimizer(config).init(trainable))


def make_step(
    loss_fn: LossFn,
    tx: optax.GradientTransformation,
    *,
    total_steps: int,
    accumulate: int = 1,
    trained: TrainedFn | None = None,
) -> StepFn:
    """Return `step(state, batch, seed_key) -> (state, metrics)`, pure and ready for jit.

    The loss gets `key = fold_in(seed_key, step)` and `progress = step / total_steps`. A run for a
    time passes the ratio of its time as a fourth argument, which then decides the learning rate
    too. If the loss, or the norm of gradients or parameters, is not finite, no update is applied,
    `step` advances and `skipped` is 1. Metrics are f32 scalars: those of the loss, loss, grad_norm,
    param_norm (before the update), update_norm, learning_rate, skipped.

    Args:
        loss_fn: (params, batch, key, progress) -> scalar loss and metrics. Only trainable
            parameters are differentiated.
        tx: The optimiser, `optimizer` or one of optax.
        total_steps: Steps of the whole schedule.
        accumulate: Micro-batches (rows m, m + accumulate, ...) that run in turn. Their losses,
            gradients and metrics are averaged, which equals the large batch for a mean over rows,
            not for InfoNCE. `optax.MultiSteps` would need several calls.
        trained: `objectives.trained_by`. Parameters that a batch does not train by its rules are
            skipped, as PyTorch skips those whose gradient is None.

    Raises:
        ConfigError: While tracing, for rows that `accumulate` does not divide, and for packed
            image or text slots with it.
    """
    tx = optax.with_extra_args_support(tx)

    def step(
        state: TrainState, batch: Any, seed_key: Array, progress: Array | None = None
    ) -> tuple[TrainState, dict[str, Array]]:
        refuse_forked()
        # The step itself is in the key: a run that continues draws what it would have drawn.
        key = jax.random.fold_in(seed_key, state.step)
        at: Array = state.step
        if progress is None:
            progress = state.step.astype(jnp.float32) / total_steps
        else:
            at = progress * total_steps

        def loss(
            trainable: Tree, frozen: Tree, part: Any, key: Array, progress: Array
        ) -> LossAndMetrics:
            value, metrics = loss_fn(merge(trainable, frozen), part, key, progress)
            metrics = {k: jnp.asarray(v, jnp.float32) for k, v in metrics.items()}
            return value.astype(jnp.float32), metrics

        used = None
        if trained is not None:
            used = nest(match_rules(trained(batch), flatten(state.trainable)))
        function = jax.value_and_grad(loss, has_aux=True)

        def gradients(part: Any, key: Array) -> tuple[Array, dict[str, Array], Tree]:
            (value, metrics), grads = function(state.trainable, state.frozen, part, key, progress)
            return value, metrics, grads

        if accumulate == 1:
            value, metrics, grads = gradients(batch, key)
        else:
            parts = micro_batches(batch, accumulate)
            value, metrics, grads = _mean_over(gradients, parts, key)
        layout = packing(state.trainable)
        norms = {
            "grad_norm": global_norm(layout.pack(grads)),
            "param_norm": global_norm(layout.pack(state.trainable)),
        }
        # As the change waits for both norms, XLA overwrites parameters and moments in place.
        good = (
            jnp.isfinite(value)
            & jnp.isfinite(norms["grad_norm"])
            & jnp.isfinite(norms["param_norm"])
        )
        updates, opt_state = tx.update(
            grads, state.opt_state, state.trainable, used=used, step=at, good=good
        )
        return _finish(state, good, metrics | norms | {"loss": value}, updates, opt_state)

    return step


def _finish(
    state: TrainState, good: Array, metrics: dict[str, Array], updates: Tree, opt_state: Any
) -> tuple[TrainState, dict[str, Array]]:
    """Apply the update if `good`, and return the new state and its metrics."""
    # an optimiser of optax keeps its learning rate to itself
    rate = getattr(opt_state, "learning_rate", jnp.nan)

    def kept(new: Tree, old: Tree) -> Tree:
        return jax.tree.map(lambda a, b: jnp.where(good, a, b), new, old)

    trainable = kept(optax.apply_updates(state.trainable, updates), state.trainable)
    # Ours has kept its own moments, inside the same loop over elements that computes them.
    if not isinstance(opt_state, OptState):
        opt_state = kept(opt_state, state.opt_state)
    metrics = metrics | {
        "update_norm": jnp.where(good, global_norm(packing(updates).pack(updates)), 0.0),
        "learning_rate": jnp.asarray(rate),
        "skipped": jnp.where(good, 0.0, 1.0),
    }
    metrics = {name: jnp.asarray(value, jnp.float32) for name, value in metrics.items()}
    return TrainState(state.step + 1, trainable, state.frozen, opt_state), metrics


def micro_batches(batch: Any, accumulate: int) -> Any:
    """Split every leading axis B into (accumulate, B / accumulate). Raises ConfigError.

    Micro-batch m has the rows m, m + accumulate, ...: with strided rows a sharded batch needs no
    transfer.
    """
    for part in jax.tree.leaves(batch, is_leaf=lambda x: isinstance(x, AlignBatch)):
        if isinstance(part, AlignBatch) and part.image.shape[0] + part.text.shape[0] > 0:
            raise ConfigError(
                "--optim.accumulate must be 1 for batches with images or texts, whose slots refer "
                "to rows of the whole batch. Lower --batch instead."
            )

    def deal(x: Array) -> Array:
        if x.shape[0] % accumulate:
            raise ConfigError(
                f"a batch of {x.shape[0]} rows is not divisible by --optim.accumulate {accumulate}"
            )
        return jnp.swapaxes(x.reshape(x.shape[0] // accumulate, accumulate, *x.shape[1:]), 0, 1)

    return jax.tree.map(deal, batch)


def _mean_over(gradients: Callable[[Any, Array], Any], parts: Any, key: Array) -> Any:
    """Return the mean of (loss, metrics, gradients) over micro-batches, each with its own key.

    They run one at a time, so that the memory is that of one.
    """
    count = jax.tree.leaves(parts)[0].shape[0]
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(count))
    first = jax.tree.map(lambda x: x[0], (parts, keys))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(gradients, *first))

    def add(total: Any, part: tuple[Any, Array]) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, total, gradients(*part)), None

    total, _ = jax.lax.scan(add, zeros, (parts, keys))
    return jax.tree.map(lambda x: x / count, total)
