"""Tangential contact: Coulomb friction under sliding and twist, with its history.

A contact sticks, slips in part, and slips as a whole. Where it sticks the gel moves with the
object; where it slips the traction is at the friction limit, friction times pressure, against the
slip. Which part does which depends on all motion before, so a contact is computed frame by frame.

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
from jax.typing import ArrayLike, DTypeLike

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
    known_numbers,
    positions,
)
from anytouch_jax.sim.contact.solver import Compliance, descent, ratio
from anytouch_jax.sim.draws import Scalar

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


def at_rest(shape: tuple[int, int], dtype: DTypeLike = jnp.float32) -> Shear:
    """Return the state before any tangential motion, on a grid of `shape`."""
    field = jnp.zeros((*shape, 2), dtype)
    zero = jnp.zeros((), dtype)
    none = jnp.zeros(shape, bool)
    yes = jnp.ones((), bool)
    return Shear(
        field, field, none, zero, jnp.zeros(2, dtype), zero, yes, jnp.zeros((), jnp.int32), zero
    )


class Interface(NamedTuple):
    """A gel and an object, and how their tangential contact is solved: equal in all frames."""

    gel: Gel
    pitch: Scalar  # mm between pixels
    friction: Scalar  # Coulomb's coefficient
    # With "exact", projected gradients with all tangential coefficients on the grid of the pressure
    # reach `tolerance` in at most `iterations` (400). With "fast", an elastic predictor and the
    # return to the friction cone are followed by `iterations` (6) corrections on a coarser grid.
    fidelity: Fidelity = "exact"
    modulus_object: Scalar = float("inf")  # E / (1 - nu^2) of the object, kPa
    centre: ArrayLike | tuple[float, float] = (0.0, 0.0)  # (2,) mm, about which the object turns
    coarse: bool = False  # leave `squeezed` and the displacement on the coarser grid of "fast"
    tolerance: float = 1e-3
    iterations: int | None = None


def shear_step(
    state: Shear | None,
    contact: PressResult,
    motion: ArrayLike,
    gel: Gel,
    pitch: Scalar,
    friction: Scalar,
    *,
    squeezed: Array | None = None,
    **options: Any,
) -> Shear:
    """Return `slide` for an `Interface` of these values; `options` are the rest of its fields."""
    return slide(state, contact, motion, Interface(gel, pitch, friction, **options), squeezed)


def slide(
    state: Shear | None,
    contact: PressResult,
    motion: ArrayLike,
    interface: Interface,
    squeezed: Array | None = None,
) -> Shear:
    """Move the object over the gel under the pressure of a contact. Use `jax.vmap` for a batch.

    Args:
        state: The state of the previous frame, or None at rest. The traction starts from it, so a
            reversed motion leaves a locked-in shear.
        contact: The press of this frame, with a pressure (H, W).
        motion: (dx mm, dy mm, dtheta rad) of the object since the previous frame.
        interface: What is equal in all frames.
        squeezed: Sideways motion (H, W, 2) mm by this step's change of pressure, from
            `mechanics.sideways`. The traction then also resists it, and `displacement` is that of
            the traction alone.

    Raises:
        UserError: For a negative friction that is not traced.
    """
    gel = interface.gel
    fidelity = interface.fidelity
    _check(contact, interface.pitch, interface.friction, fidelity)
    pressure = contact.pressure
    dtype = pressure.dtype
    if state is None:
        state = at_rest((pressure.shape[0], pressure.shape[1]), dtype)
    pitch = jnp.asarray(interface.pitch, dtype)
    friction = jnp.asarray(interface.friction, dtype)
    # E* over the gel's plane modulus, as in `mechanics.press`
    gel_part = 1 / (
        1 + jnp.asarray(gel.plane, dtype) / jnp.asarray(interface.modulus_object, dtype)
    )
    # kPa of traction per mm. Tractions are divided by it, so everything below is in mm.
    unit = jnp.asarray(gel.plane, dtype) * gel_part / pitch
    plan = grids(pressure.shape)[-1] if fidelity == "fast" else Plan(*pressure.shape)
    times = pressure.shape[0] // plan.rows
    load = _pooled(pressure, times)
    before = _pooled(state.traction, times) / unit * times
    known = known_numbers(gel, interface.pitch, interface.modulus_object)
    step, part = (pitch, gel_part) if known is None else known
    spectra = tangential_spectra(plan, step * times, gel.poisson, gel.thickness, part, dtype)
    apply = _compliance(plan, spectra)
    limit = jnp.where(load > 0, friction * load, 0) / unit * times
    moved = _rigid(
        plan, pitch * times, jnp.asarray(motion, dtype), jnp.asarray(interface.centre, dtype)
    )
    if squeezed is not None:
        moved = moved - (squeezed if interface.coarse else _pooled(squeezed, times))

    def within(step: Array) -> Array:
        """Return the nearest change of the traction that stays within Coulomb's limit."""
        return _returned(before + step, limit) - before

    # The elastic predictor: all of the contact sticks, and is as stiff as a circle of its area.
    start = within(_stiffness(load > 0, gel.poisson) * moved)
    # Motion that the residual is compared with: the object's, or that by tractions which a smaller
    # pressure no longer holds.
    scale = jnp.max(jnp.abs(moved)) + jnp.max(jnp.abs(within(jnp.zeros_like(moved))))
    scale = jnp.where(scale > 0, scale, 1)
    # Solved for the step, not the total: rounding of a large traction would lose a small step.
    if fidelity == "fast":
        solution = descent(apply, within, moved, start, interface.iterations or 6)
    else:
        most = interface.iterations or 400
        tolerance = interface.tolerance * scale
        solution = descent(apply, within, moved, start, most, tolerance=tolerance)
    # exactly zero without pressure
    total = jnp.where((limit > 0)[..., None], before + solution.x, 0)
    displacement = apply(total)
    # The compliance is that of gel and object together. The object's part is a half-space's.
    if not is_infinite(interface.modulus_object):
        deep = tangential_spectra(plan, pitch * times, gel.poisson, float("inf"), 1.0, dtype)
        displacement = displacement - (1 - gel_part) * _compliance(plan, deep)(total)
    if not interface.coarse:
        displacement = enlarged(displacement, pressure.shape)
    # A traction is smooth relative to the pressure, which falls to zero at the rim. So the ratio is
    # repeated on the fine grid, and not the traction, which would have steps and reach outside.
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
        residual <= interface.tolerance,
        solution.iterations,
        residual,
    )


def _check(contact: PressResult, pitch: Scalar, friction: Scalar, fidelity: str) -> None:
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
    """Return the surface's motion (H, W, 2) by a traction (H, W, 2), as a function."""
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
    """Return the lengths (H, W) of vectors (H, W, 2)."""
    squared = jnp.sum(field * field, -1)
    tiny = squared < 1e-24  # of a length whose gradient would overflow
    return jnp.where(tiny, 0, jnp.sqrt(jnp.where(tiny, 1, squared)))


def _returned(traction: Array, limit: Array) -> Array:
    """Return the nearest traction within Coulomb's limit (radial return)."""
    length = _length(traction)
    factor = jnp.where(length > limit, limit / jnp.where(length > 0, length, 1), 1)
    return traction * factor[..., None]


def _stiffness(touching: Array, poisson: float) -> Array:
    """Return the mean traction per rigid motion of a sticking circle of the same area.

    It is dimensionless (Mindlin 1949).
    """
    radius = jnp.sqrt(jnp.maximum(jnp.sum(touching), 1) / jnp.pi)
    return 4 * (1 - poisson) / (2 - poisson) / (jnp.pi * radius)


def _pooled(field: Array, times: int) -> Array:
    """Return means over blocks of `times` x `times` pixels of (H, W, ...)."""
    rows, columns, *rest = field.shape
    return jnp.mean(field.reshape(rows // times, times, columns // times, times, *rest), (1, 3))


def _repeated(field: Array, times: int) -> Array:
    """Return (H, W, ...) with every pixel repeated `times` x `times`, which undoes `_pooled`."""
    if times == 1:
        return field
    return jnp.repeat(jnp.repeat(field, times, 0), times, 1)


def _totals(
    traction: Array, slipping: Array, pressure: Array, pitch: Array
) -> tuple[Array, Array, Array]:
    """Return force, torque about the centre of pressure, and the slipping part of the contact.

    They are (2,) N, N mm, and a fraction of the contact's area.
    """
    x, y = positions((pressure.shape[0], pressure.shape[1]), pitch)
    middle = centroid(pressure, pitch)
    area = pitch**2 * KPA_MM2
    torque = jnp.sum((x - middle[0]) * traction[..., 1] - (y - middle[1]) * traction[..., 0]) * area
    fraction = jnp.sum(slipping) / jnp.maximum(jnp.sum(pressure > 0), 1)
    return jnp.sum(traction, (0, 1)) * area, torque, fraction.astype(pressure.dtype)
