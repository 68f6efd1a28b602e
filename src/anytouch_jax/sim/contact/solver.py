"""Quadratic programs of contact: least energy with pressure >= 0, or within the friction limit.

Both minimise `x . K x / 2 - x . target` for a compliance K, which is a function. Everything is
dimensionless or in one length unit. `excess` is K x - target: the gap for pressures, minus the slip
for tractions.

For a pressure the minimum is the complementarity of contact: where it presses the gap is zero,
where there is a gap it does not press, and neither is ever negative (Signorini's conditions).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

Compliance = Callable[[Array], Array]
Projection = Callable[[Array], Array]

# coefficient of a pixel on itself, 4 ln(1 + sqrt 2) / pi, the compliance of the shortest waves
OWN = 1.122


class Solution(NamedTuple):
    """The result of a quadratic program."""

    x: Array  # the load
    excess: Array  # K x - target
    residual: Array  # in units of the target
    iterations: Array


class _Conjugate(NamedTuple):
    """State of `conjugate_gradients`."""

    pressure: Array
    excess: Array
    direction: Array
    squared: Array  # sum of the squared gaps of the contact set, one round ago
    free: Array  # whether the contact set did not grow, so the direction may be conjugate
    residual: Array
    iterations: Array


def conjugate_gradients(
    apply: Compliance, target: Array, start: Array, tolerance: float | Array, iterations: int
) -> Solution:
    """Solve for pressures >= 0 by conjugate gradients on the contact set.

    The method is Polonsky and Keer's (Wear 231, 1999). It stops after `iterations`, or if no gap in
    contact and no overlap outside exceeds `tolerance`.

    Args:
        apply: Gives the motion (H, W) of the surface under pressures (H, W).
        target: Motion (H, W) that the surfaces ask for where they touch.
        start: Pressures (H, W) to begin with.
        tolerance: Largest gap or overlap that is left.
        iterations: Most of them.
    """
    excess = apply(start) - target
    zero = jnp.zeros((), target.dtype)
    state = _Conjugate(
        start,
        excess,
        0 * target,
        zero,
        zero > 0,
        complementarity(start, excess),
        jnp.zeros((), jnp.int32),
    )
    state = jax.lax.while_loop(
        lambda s: (s.residual > tolerance) & (s.iterations < iterations),
        lambda s: _round(apply, target, s),
        state,
    )
    return Solution(state.pressure, state.excess, state.residual, state.iterations)


def complementarity(pressure: Array, excess: Array) -> Array:
    """Return the largest gap in contact or overlap outside of it."""
    return jnp.max(jnp.where(pressure > 0, jnp.abs(excess), -excess), initial=0)


def _round(apply: Compliance, target: Array, state: _Conjugate) -> _Conjugate:
    """Return the state after one round: a step on the contact set, then a new contact set."""
    touching = state.pressure > 0
    gap = jnp.where(touching, state.excess, 0)
    squared = jnp.sum(gap * gap)
    # A contact set that grew has another quadratic form, so the search starts again downhill.
    factor = jnp.where(state.free, ratio(squared, state.squared, 0.0), 0)
    direction = jnp.where(touching, gap + factor * state.direction, 0)
    step = ratio(jnp.sum(gap * direction), jnp.sum(direction * apply(direction)), 1 / OWN)
    step = jnp.maximum(step, 0)
    # Pixels that would pull leave the contact, and those that overlap without pressure enter it.
    pressure = jnp.maximum(jnp.where(touching, state.pressure - step * direction, 0), 0)
    overlap = (pressure <= 0) & (state.excess < 0)
    pressure = jnp.where(overlap, -step * state.excess, pressure)
    excess = apply(pressure) - target
    residual = complementarity(pressure, excess)
    return _Conjugate(
        pressure, excess, direction, squared, ~jnp.any(overlap), residual, state.iterations + 1
    )


class _Descent(NamedTuple):
    """State of `descent`."""

    x: Array
    excess: Array
    step: Array
    residual: Array
    iterations: Array


def descent(
    apply: Compliance,
    project: Projection,
    target: Array,
    start: Array,
    iterations: int,
    *,
    tolerance: float | Array | None = None,
    moved: Array | None = None,
) -> Solution:
    """Solve for loads in a convex set by spectral projected gradients.

    Steps have Barzilai and Borwein's length (Birgin, Martinez and Raydan 2000), and a line search
    that is exact, because the energy is quadratic. So energy never rises, and there is one product
    with K an iteration.

    Args:
        apply: The compliance K.
        project: The nearest load of the convex set.
        target: What K of the load should be.
        start: The first load, in the set.
        iterations: At most so many; exactly so many without a tolerance.
        tolerance: Of the projected gradient. Without one the number of iterations is fixed, so the
            result can be differentiated in reverse.
        moved: K of `start`, if known, which saves a product.
    """

    def residual(x: Array, excess: Array) -> Array:
        return jnp.max(jnp.abs(project(x - excess / OWN) - x)) * OWN

    def advance(s: _Descent) -> _Descent:
        way = project(s.x - s.step * s.excess) - s.x
        # Along `way` the energy is a parabola. Its lowest point is at most the whole way off.
        bent_by = apply(way)
        bent = jnp.sum(way * bent_by)
        fraction = jnp.clip(ratio(-jnp.sum(s.excess * way), bent, 0.0), 0, 1)
        x = s.x + fraction * way
        excess = s.excess + fraction * bent_by
        step = ratio(jnp.sum(way * way), bent, 1 / OWN)
        change = s.residual if tolerance is None else residual(x, excess)
        return _Descent(x, excess, step, change, s.iterations + 1)

    excess = (apply(start) if moved is None else moved) - target
    step = jnp.asarray(1 / OWN, target.dtype)
    state = _Descent(start, excess, step, residual(start, excess), jnp.zeros((), jnp.int32))
    if tolerance is None:
        # Not unrolled: a press and a shear took twice as long to compile.
        state = jax.lax.fori_loop(0, iterations, lambda _, s: advance(s), state)
        state = state._replace(residual=residual(state.x, state.excess))
    else:
        state = jax.lax.while_loop(
            lambda s: (s.residual > tolerance) & (s.iterations < iterations), advance, state
        )
    return Solution(state.x, state.excess, state.residual, state.iterations)


def scaled(start: Array, moved: Array, target: Array) -> Array:
    """Return the factor on `start` of least energy. `moved` is K of `start`."""
    return ratio(jnp.sum(start * target), jnp.sum(start * moved), 0.0)


def ratio(above: Array, below: Array, otherwise: float) -> Array:
    """Return `above` over `below`, or `otherwise` where `below` is not above a tiny number.

    The gradient divides by the square of `below`, which must not overflow: the last steps of a
    descent are tiny.
    """
    is_large = below > jnp.finfo(below.dtype).tiny ** 0.45
    return jnp.where(is_large, above / jnp.where(is_large, below, 1), otherwise)
