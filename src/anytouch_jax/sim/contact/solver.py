"""Quadratic programs of contact: least energy with pressure >= 0, or with a traction within the
friction limit.

Both minimise `x . K x / 2 - x . target` for a compliance K, which is a function. Everything is
dimensionless or in one length unit. `excess` is K x - target: the gap for pressures, minus the slip
for tractions.
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
    """A load `x`, its `excess` K x - target, the residual in units of target, and the number of
    iterations.
    """

    x: Array
    excess: Array
    residual: Array
    iterations: Array


class _Conjugate(NamedTuple):
    pressure: Array
    excess: Array
    direction: Array
    squared: Array
    free: Array
    residual: Array
    iterations: Array


def conjugate_gradients(
    apply: Compliance, target: Array, start: Array, tolerance: float | Array, iterations: int
) -> Solution:
    """Solve for pressures >= 0 by conjugate gradients on the contact set (Polonsky and Keer, Wear
    231, 1999).

    It stops after `iterations`, or if no gap in contact and no overlap outside exceeds `tolerance`.
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
    touching = state.pressure > 0
    gap = jnp.where(touching, state.excess, 0)
    squared = jnp.sum(gap * gap)
    factor = jnp.where(state.free, ratio(squared, state.squared, 0.0), 0)
    direction = jnp.where(touching, gap + factor * state.direction, 0)
    step = ratio(jnp.sum(gap * direction), jnp.sum(direction * apply(direction)), 1 / OWN)
    step = jnp.maximum(step, 0)
    pressure = jnp.maximum(jnp.where(touching, state.pressure - step * direction, 0), 0)
    overlap = (pressure <= 0) & (state.excess < 0)
    pressure = jnp.where(overlap, -step * state.excess, pressure)
    excess = apply(pressure) - target
    residual = complementarity(pressure, excess)
    return _Conjugate(
        pressure, excess, direction, squared, ~jnp.any(overlap), residual, state.iterations + 1
    )


class _Descent(NamedTuple):
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
    """Solve for loads in a convex set by projected gradients with Barzilai-Borwein steps (Birgin et
    al. 2000).

    Energy never rises. There is one product with K an iteration. It stops after `iterations`, or at
    a projected gradient below `tolerance`. `moved` is K of `start`, if known.
    """

    def residual(x: Array, excess: Array) -> Array:
        return jnp.max(jnp.abs(project(x - excess / OWN) - x)) * OWN

    def advance(s: _Descent) -> _Descent:
        way = project(s.x - s.step * s.excess) - s.x
        bent_by = apply(way)
        bent = jnp.sum(way * bent_by)
        share = jnp.clip(ratio(-jnp.sum(s.excess * way), bent, 0.0), 0, 1)
        x = s.x + share * way
        excess = s.excess + share * bent_by
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
