"""Tangential contact: Coulomb friction under sliding and twist, with its history (stick, partial
slip, full slip).

Friction does not change the pressure. The sideways motion by pressing alone is an optional input.
It is zero on an incompressible half-space, and Cattaneo's and Mindlin's solutions omit it. A bonded
layer is squeezed out, and the object resists. Units are mm, kPa, N and rad. x points right, y down,
and twist is positive from x to y.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from anytouch_jax.errors import UserError
from anytouch_jax.sim.contact.elastic import Plan, is_infinite, tangential_spectra
from anytouch_jax.sim.contact.mechanics import (
    KPA_MM2,
    Fidelity,
    Gel,
    PressResult,
    centroid,
    enlarged,
    grids,
    positions,
)
from anytouch_jax.sim.contact.solver import Compliance, descent, ratio

SLIPPING = 0.999  # of the friction limit


class Shear(NamedTuple):
    """State of the tangential contact, carried from frame to frame."""

    traction: Array  # (H, W, 2) kPa on the gel, along the object's motion
    displacement: Array  # (H, W, 2) mm of the gel's surface
    slipping: Array  # (H, W)
    slip_fraction: Array  # of the contact's area
    force: Array  # (2,) N on the gel
    twist_torque: Array  # N mm on the gel about the centre of pressure
    converged: Array
    iterations: Array
    residual: Array  # error of the surface's motion over the object's motion in this step


def at_rest(shape: tuple[int, int], dtype: Any = jnp.float32) -> Shear:
    """Return the state before any tangential motion, on a grid of `shape`."""
    field = jnp.zeros((*shape, 2), dtype)
    zero = jnp.zeros((), dtype)
    none = jnp.zeros(shape, bool)
    yes = jnp.ones((), bool)
    return Shear(
        field, field, none, zero, jnp.zeros(2, dtype), zero, yes, jnp.zeros((), jnp.int32), zero
    )


def shear_step(
    state: Shear | None,
    contact: PressResult,
    motion: Any,
    gel: Gel,
    pitch: Any,
    friction: Any,
    *,
    fidelity: Fidelity = "exact",
    modulus_object: Any = float("inf"),
    centre: Any = (0.0, 0.0),
    squeezed: Array | None = None,
    coarse: bool = False,
    tolerance: float = 1e-3,
    iterations: int | None = None,
) -> Shear:
    """Move the object by `motion` (dx mm, dy mm, dtheta rad about `centre` mm) under the pressure
    of `contact`.

    `state` is that of the previous frame, or None at rest. The traction starts from it, so a
    reversed motion leaves a locked-in shear. `friction` is Coulomb's coefficient. With "exact",
    projected gradients with all tangential coefficients on the grid of the pressure reach
    `tolerance` in at most `iterations` (400). With "fast", an elastic predictor and the return to
    the friction cone are followed by `iterations` (6) corrections on a coarser grid. `squeezed` (H,
    W, 2) mm is the sideways motion by this step's change of pressure (from `mechanics.sideways`).
    The traction then also resists it, and `displacement` is that of the traction alone. Both are on
    the coarser grid of "fast" if `coarse`. Use `jax.vmap` for a batch. Raises UserError for a
    negative untraced friction.
    """
    _check(contact, pitch, friction, fidelity)
    pressure = contact.pressure
    dtype = pressure.dtype
    state = at_rest((pressure.shape[0], pressure.shape[1]), dtype) if state is None else state
    pitch = jnp.asarray(pitch, dtype)
    friction = jnp.asarray(friction, dtype)
    share = 1 / (1 + jnp.asarray(gel.plane, dtype) / jnp.asarray(modulus_object, dtype))
    # kPa of traction per mm
    unit = jnp.asarray(gel.plane, dtype) * share / pitch
    plan = grids(pressure.shape)[-1] if fidelity == "fast" else Plan(*pressure.shape)
    times = pressure.shape[0] // plan.rows
    load = _pooled(pressure, times)
    before = _pooled(state.traction, times) / unit * times
    spectra = tangential_spectra(plan, pitch * times, gel.poisson, gel.thickness, share, dtype)
    apply = _compliance(plan, spectra)
    limit = jnp.where(load > 0, friction * load, 0) / unit * times
    moved = _rigid(plan, pitch * times, jnp.asarray(motion, dtype), jnp.asarray(centre, dtype))
    if squeezed is not None:
        moved = moved - (squeezed if coarse else _pooled(squeezed, times))

    def within(step: Array) -> Array:
        return _returned(before + step, limit) - before

    start = within(_stiffness(load > 0, gel.poisson) * moved)
    scale = jnp.max(jnp.abs(moved)) + jnp.max(jnp.abs(within(jnp.zeros_like(moved))))
    scale = jnp.where(scale > 0, scale, 1)
    most = iterations or (6 if fidelity == "fast" else 400)
    # Solved for the step, not the total: rounding of a large traction would lose a small step.
    solution = descent(
        apply,
        within,
        moved,
        start,
        most,
        tolerance=None if fidelity == "fast" else tolerance * scale,
    )
    # exactly zero without pressure
    total = jnp.where((limit > 0)[..., None], before + solution.x, 0)
    displacement = apply(total)
    if not is_infinite(modulus_object):  # minus the object's part
        deep = tangential_spectra(plan, pitch * times, gel.poisson, float("inf"), 1.0, dtype)
        displacement = displacement - (1 - share) * _compliance(plan, deep)(total)
    if not coarse:
        displacement = enlarged(displacement, pressure.shape)
    per_pressure = ratio(total * unit / times, load[..., None], 0.0)
    traction = _repeated(per_pressure, times) * pressure[..., None]
    sliding = _length(total) >= SLIPPING * limit
    slipping = _repeated(sliding, times) & (pressure > 0)
    residual = solution.residual / scale
    force, torque, fraction = _totals(traction, slipping, pressure, pitch)
    return Shear(
        traction,
        displacement,
        slipping,
        fraction,
        force,
        torque,
        residual <= tolerance,
        solution.iterations,
        residual,
    )


def _check(contact: PressResult, pitch: Any, friction: Any, fidelity: str) -> None:
    if fidelity not in ("exact", "fast"):
        raise UserError(f'fidelity is "exact" or "fast", not {fidelity!r}')
    if jnp.ndim(contact.pressure) != 2:
        raise UserError(
            f"shear_step takes one contact, not pressures {jnp.shape(contact.pressure)}; use "
            "jax.vmap"
        )
    if not isinstance(pitch, jax.core.Tracer) and not np.all(np.asarray(pitch) > 0):
        raise UserError(f"pitch must be above 0 mm, not {pitch}")
    if not isinstance(friction, jax.core.Tracer) and not np.all(np.asarray(friction) >= 0):
        raise UserError(f"friction must be at least 0, not {friction}")


def _compliance(plan: Plan, spectra: Array) -> Compliance:
    xx, xy, yy = spectra

    def apply(traction: Array) -> Array:
        x = plan.forward(traction[..., 0])
        y = plan.forward(traction[..., 1])
        moved_x = plan.inverse(plan.even(x, xx) + plan.odd(y, xy))
        return jnp.stack([moved_x, plan.inverse(plan.odd(x, xy) + plan.even(y, yy))], -1)

    return apply


def _rigid(plan: Plan, pitch: Array, motion: Array, centre: Array) -> Array:
    """Return the displacement (H, W, 2) mm by `motion` (dx, dy, dtheta)."""
    x, y = positions((plan.rows, plan.columns), pitch)
    return jnp.stack(
        [motion[0] - motion[2] * (y - centre[1]), motion[1] + motion[2] * (x - centre[0])], -1
    )


def _length(field: Array) -> Array:
    squared = jnp.sum(field * field, -1)
    tiny = squared < 1e-24  # of a length whose gradient would overflow
    return jnp.where(tiny, 0, jnp.sqrt(jnp.where(tiny, 1, squared)))


def _returned(traction: Array, limit: Array) -> Array:
    """Return the nearest traction within Coulomb's limit (radial return)."""
    length = _length(traction)
    return (
        traction * jnp.where(length > limit, limit / jnp.where(length > 0, length, 1), 1)[..., None]
    )


def _stiffness(touching: Array, poisson: float) -> Array:
    """Return the mean traction per rigid motion of a sticking circle of the same area (Mindlin
    1949), dimensionless.
    """
    radius = jnp.sqrt(jnp.maximum(jnp.sum(touching), 1) / jnp.pi)
    return 4 * (1 - poisson) / (2 - poisson) / (jnp.pi * radius)


def _pooled(field: Array, times: int) -> Array:
    """Return means over blocks of `times` x `times` pixels of (H, W, ...)."""
    rows, columns, *rest = field.shape
    return jnp.mean(field.reshape(rows // times, times, columns // times, times, *rest), (1, 3))


def _repeated(field: Array, times: int) -> Array:
    if times == 1:
        return field
    return jnp.repeat(jnp.repeat(field, times, 0), times, 1)


def _totals(
    traction: Array, slipping: Array, pressure: Array, pitch: Array
) -> tuple[Array, Array, Array]:
    """Return force (2,) N, torque N mm about the centre of pressure, and the slipping share of the
    contact's area.
    """
    x, y = positions((pressure.shape[0], pressure.shape[1]), pitch)
    middle = centroid(pressure, pitch)
    area = pitch**2 * KPA_MM2
    torque = jnp.sum((x - middle[0]) * traction[..., 1] - (y - middle[1]) * traction[..., 0]) * area
    fraction = jnp.sum(slipping) / jnp.maximum(jnp.sum(pressure > 0), 1)
    return jnp.sum(traction, (0, 1)) * area, torque, fraction.astype(pressure.dtype)
