"""Normal contact of a gel with an object pressed to a depth: pressure, displacement, force.

Units are mm, kPa and N. The gel is a linear elastic half-space, or, with a finite thickness, a
layer bonded to a rigid plate. Friction does not change the pressure, which is exact for an
incompressible half-space under a rigid object. `sideways` is the tangential motion by pressing
before friction resists it (`shear`).

In the program all lengths are in units of the deepest penetration and pressures in the unit that
makes the compliance of one pixel about one. So one tolerance and one number of iterations serve a
soft gel under a light touch and a stiff one under a deep press.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from anytouch_jax.errors import UserError
from anytouch_jax.sim.contact.elastic import Plan, is_infinite, normal_spectrum, sideways_kernel
from anytouch_jax.sim.contact.solver import (
    OWN,
    Compliance,
    Solution,
    complementarity,
    conjugate_gradients,
    descent,
    ratio,
    scaled,
)
from anytouch_jax.sim.draws import Scalar

Fidelity = Literal["exact", "fast"]

KPA_MM2 = 1e-3  # N
COARSEST = 24  # pixels; a coarser grid saves no time


@dataclass(frozen=True)
class Gel:
    """A gel: Young's modulus in kPa, Poisson's ratio, thickness in mm.

    An infinite thickness is a half-space. `modulus` and `thickness` may be traced arrays.
    """

    modulus: Scalar = 150.0
    poisson: float = 0.48
    thickness: Scalar = float("inf")

    @property
    def plane(self) -> Scalar:
        """The plane strain modulus E / (1 - nu^2) in kPa."""
        return self.modulus / (1 - self.poisson**2)


jax.tree_util.register_dataclass(Gel, data_fields=["modulus", "thickness"], meta_fields=["poisson"])


class PressResult(NamedTuple):
    """The result of a press on a grid (H, W)."""

    pressure: Array  # (H, W) kPa
    # (H, W) mm of the gel's surface, positive away from the object, and negative where a bonded
    # layer bulges around the contact
    displacement: Array
    force: Array  # N
    converged: Array  # whether `residual` is below the tolerance
    iterations: Array
    residual: Array  # largest gap in contact, or overlap outside, over the largest penetration


def press(
    surface: Array,
    depth: Scalar,
    gel: Gel,
    pitch: Scalar,
    *,
    fidelity: Fidelity = "exact",
    modulus_object: Scalar = float("inf"),
    tolerance: float = 1e-4,
    iterations: int | None = None,
) -> PressResult:
    """Press an object into the flat gel. Use `jax.vmap` for a batch.

    With "exact", conjugate gradients on the contact set (Polonsky and Keer 1999) reach `tolerance`
    in at most `iterations` (300). With "fast", `iterations` (2) projected gradients on this grid
    follow twice and four times as many on coarser grids. Where the gel still cuts the object, it
    takes the object's surface, as in Taxim (Si and Yuan 2022).

    Args:
        surface: Heights (H, W) mm of the object, its highest nominal point at 0. -inf is no object.
        depth: mm by which the point at 0 is pressed in.
        gel: The gel.
        pitch: mm between pixels.
        fidelity: "exact" or "fast".
        modulus_object: E / (1 - nu^2) of the object, kPa.
        tolerance: Of the residual (`PressResult`).
        iterations: At most so many, by default those above.

    Raises:
        UserError: For untraced values that make no sense, such as a negative depth or a modulus of
            0, and for a gel thinner than a pixel ("fast": 1.5 pixels of the coarsest grid).
    """
    _check(surface, depth, pitch, fidelity)
    _check_elastic(np.shape(surface), gel, pitch, fidelity, modulus_object)
    surface = jnp.asarray(surface)
    if surface.dtype not in (jnp.float32, jnp.float64):
        surface = surface.astype(jnp.float32)
    dtype = surface.dtype
    depth = jnp.asarray(depth, dtype)
    pitch_given = pitch
    pitch = jnp.asarray(pitch, dtype)
    plane = jnp.asarray(gel.plane, dtype)
    # The composite modulus E*, of 1 / E* = 1 / E_gel + 1 / E_object, over the gel's own. It is the
    # part of the approach by which the gel gives way, and not the object.
    fraction = 1 / (1 + plane / jnp.asarray(modulus_object, dtype))
    cut = jnp.where(jnp.isfinite(surface), surface + depth, -jnp.ones((), dtype))
    scale = jnp.max(cut)
    scale = jnp.where((scale > 0) & (depth >= 0), scale, 0)
    # 1 at the deepest point
    cut = jnp.where(scale > 0, cut / jnp.where(scale > 0, scale, 1), -1)
    plans = grids(surface.shape) if fidelity == "fast" else [Plan(*surface.shape)]
    known = known_numbers(gel, pitch_given, modulus_object)
    step, part = (pitch, fraction) if known is None else known
    compliances = [
        _compliance(plan, step * 2**level, gel, part, dtype) for level, plan in enumerate(plans)
    ]
    if fidelity == "fast":
        solution, load, moved = _fast(compliances, cut, 2 if iterations is None else iterations)
    else:
        most = 300 if iterations is None else iterations
        solution, load, moved = _exact(compliances, cut, tolerance, most)
    # both move: the gel's part is the rest
    moved = moved - _of_object(plans[0], load, fraction, modulus_object)
    pressure = solution.x * (scale * plane * fraction / pitch)
    force = jnp.sum(pressure) * pitch**2 * KPA_MM2
    converged = solution.residual <= tolerance
    return PressResult(
        pressure, moved * scale, force, converged, solution.iterations, solution.residual
    )


def _check(surface: Any, depth: Scalar, pitch: Scalar, fidelity: str) -> None:
    if fidelity not in ("exact", "fast"):
        raise UserError(f'fidelity is "exact" or "fast", not {fidelity!r}')
    if np.ndim(surface) != 2:
        raise UserError(
            f"press takes one surface of (rows, columns), not {np.shape(surface)}; use jax.vmap "
            "for more"
        )
    for name, value, least, words in (
        ("depth", depth, 0.0, "at least 0"),
        ("pitch", pitch, 1e-12, "above 0"),
    ):
        if isinstance(value, jax.core.Tracer):
            continue
        if not np.all((np.asarray(value) >= least) & np.isfinite(value)):
            raise UserError(f"{name} must be {words} mm, not {value}")
    if not isinstance(surface, jax.core.Tracer):
        values = np.asarray(surface)
        if np.isnan(values).any() or np.isposinf(values).any():
            raise UserError(
                "a surface may hold heights in mm and -inf for no object, but no NaN and no +inf"
            )


def _check_elastic(
    shape: tuple[int, ...], gel: Gel, pitch: Scalar, fidelity: str, modulus_object: Scalar
) -> None:
    if not 0 <= gel.poisson <= 0.5:
        raise UserError(f"a gel's Poisson ratio is 0 to 0.5, not {gel.poisson}")
    for name, value in (
        ("modulus", gel.modulus),
        ("thickness", gel.thickness),
        ("modulus_object", modulus_object),
    ):
        if not isinstance(value, jax.core.Tracer) and not np.all(np.asarray(value) > 0):
            raise UserError(f"{name} must be above 0, not {value}")
    if not any(isinstance(value, jax.core.Tracer) for value in (pitch, gel.thickness)):
        # The tables of a layer are smooth over its thickness. They are read at the middles of
        # pixels, which must be finer than that.
        pixels = 1.5 * 2 ** (len(grids(shape)) - 1) if fidelity == "fast" else 1
        least = np.asarray(pitch) * pixels
        if np.any(np.asarray(gel.thickness) < least):
            raise UserError(
                f"a gel of {gel.thickness} mm is too thin for this grid: {least:g} mm is the least"
            )


def known_numbers(gel: Gel, pitch: Scalar, modulus_object: Scalar) -> tuple[float, float] | None:
    """Return pitch and fraction of a spectrum (`elastic.normal_spectrum`), if no number is traced.

    With them the spectra of a constant gel are computed by numpy, and not by XLA as it compiles.
    """
    numbers = (pitch, gel.modulus, gel.thickness, modulus_object)
    if any(isinstance(value, jax.core.Tracer) for value in numbers):
        return None
    return float(pitch), 1 / (1 + float(gel.plane) / float(modulus_object))


def grids(shape: tuple[int, ...]) -> list[Plan]:
    """Return the grid of `shape` and up to two coarser ones, each half of the one before."""
    plans = [Plan(shape[0], shape[1])]
    while len(plans) < 3 and all(
        n % 2 == 0 and n // 2 >= COARSEST for n in (plans[-1].rows, plans[-1].columns)
    ):
        plans.append(Plan(plans[-1].rows // 2, plans[-1].columns // 2))
    return plans


def _compliance(
    plan: Plan, pitch: float | Array, gel: Gel, fraction: float | Array, dtype: DTypeLike
) -> Compliance:
    """Return the normal displacement by a pressure (H, W), as a function."""
    spectrum = normal_spectrum(plan, pitch, gel.poisson, gel.thickness, fraction, dtype)
    return lambda pressure: plan.inverse(plan.even(plan.forward(pressure), spectrum))


def _of_object(plan: Plan, pressure: Array, fraction: Array, modulus_object: Scalar) -> Any:
    """Return the object's part of the displacement by a pressure, in units of `cut`.

    The object is a half-space.
    """
    if is_infinite(modulus_object):
        return 0.0
    deep = normal_spectrum(plan, 1.0, 0.0, float("inf"), 1.0, pressure.dtype)
    return (1 - fraction) * plan.inverse(plan.even(plan.forward(pressure), deep))


def _exact(
    compliances: list[Compliance], cut: Array, tolerance: float, iterations: int
) -> tuple[Solution, Array, Array]:
    """Return the solution to `tolerance`, its pressure, and the displacement by it."""
    (apply,) = compliances
    start = jnp.maximum(cut, 0)
    start = start * scaled(start, apply(start), cut)
    solution = conjugate_gradients(apply, cut, start, tolerance, iterations)
    return solution, solution.x, solution.excess + cut


def _fast(
    compliances: list[Compliance], cut: Array, iterations: int
) -> tuple[Solution, Array, Array]:
    """Solve from coarse to fine, with twice as many iterations on each coarser grid.

    Long waves, which converge slowly, are solved where they are cheap. Returns the solution, the
    pressure that moves the surface, and that displacement. The number of iterations is fixed, so a
    batch takes the time of one, and gradients pass.
    """
    cuts = [cut]
    for _ in compliances[1:]:
        cuts.append(halved(cuts[-1]))
    pressure = jnp.maximum(cuts[-1], 0)
    for level in range(len(cuts) - 1, -1, -1):
        apply = compliances[level]
        here = cuts[level]
        # A flat gel never bulges to touch what is above it. Without this the interpolated pressure
        # of the coarser grid would press beside the contact.
        pressure = jnp.where(here > 0, pressure, 0)
        solution = _descended(apply, here, pressure, iterations * 2**level)
        pressure = doubled(solution.x) if level else solution.x
    # Taxim's rule: where the gel still cuts the object, it takes the object's surface.
    moved = jnp.maximum(solution.excess, 0) + cut
    return solution._replace(x=_sharpened(solution)), solution.x, moved


def _sharpened(solution: Solution) -> Array:
    """Take one local step with the same load and without a convolution.

    It removes pressure from gaps, which a few projected gradients leave there.
    """
    local = jnp.maximum(solution.x - solution.excess / OWN, 0)
    return local * ratio(jnp.sum(solution.x), jnp.sum(local), 0.0)


def _descended(apply: Compliance, cut: Array, pressure: Array, iterations: int) -> Solution:
    """Run projected gradients from `pressure` at its best scale, and scale the result likewise.

    The scale is the one of least energy. It repairs at once what gradients mend last: a first guess
    that is too strong or too weak all over.
    """
    moved = apply(pressure)
    factor = scaled(pressure, moved, cut)
    end = descent(
        apply, lambda p: jnp.maximum(p, 0), cut, factor * pressure, iterations, moved=factor * moved
    )
    factor = scaled(end.x, end.excess + cut, cut)
    excess = factor * (end.excess + cut) - cut
    return Solution(factor * end.x, excess, complementarity(factor * end.x, excess), end.iterations)


def sideways(
    pressure: Array, gel: Gel, pitch: Scalar, *, fidelity: Fidelity = "exact", coarse: bool = False
) -> Array:
    """Return the tangential motion of a bonded layer's surface by a pressure alone.

    A nearly incompressible layer moves sideways, by up to a fifth of the dent of a ball and by more
    under a wide block. A compressible one is also drawn toward the load. Friction reduces the
    motion (`shear_step`).

    Args:
        pressure: (H, W) kPa.
        gel: The gel.
        pitch: mm between pixels.
        fidelity: With "fast" the motion is computed on the coarsest grid, because it is smooth.
        coarse: Leave it there.

    Returns:
        Motion (H, W, 2) mm along x and y.

    Raises:
        UserError: For a gel without a thickness: an incompressible half-space does not move so.
    """
    if is_infinite(gel.thickness):
        raise UserError("sideways motion needs a bonded layer: set the thickness of the gel")
    shape = pressure.shape
    step = pitch
    pitch = jnp.asarray(pitch, pressure.dtype)
    if isinstance(step, jax.core.Tracer) or isinstance(gel.thickness, jax.core.Tracer):
        step = pitch
    if fidelity == "fast":
        for _ in grids(shape)[1:]:
            pressure = halved(pressure)
            pitch = 2 * pitch
            step = 2 * step
    plan = Plan(*pressure.shape)
    kernel = sideways_kernel(plan, step, gel.poisson, gel.thickness, pressure.dtype)
    spectrum = jnp.asarray(plan.spectrum(kernel), pressure.dtype)
    summed = plan.inverse(plan.even(plan.forward(pressure), spectrum))
    # Its differences from pixel to pixel are mm.
    potential = summed * pitch / (jnp.pi * gel.plane)
    y, x = jnp.gradient(potential)
    motion = jnp.stack([x, y], -1)
    if coarse:
        return motion
    return enlarged(motion, shape)


def enlarged(motion: Array, shape: tuple[int, ...]) -> Array:
    """Return a motion (h, w, 2) of a coarser grid on the grid of `shape`, by a cubic spline."""
    if motion.shape[:2] == shape:
        return motion
    return jax.image.resize(motion, (*shape, 2), "cubic")


def halved(field: Array) -> Array:
    """Return means over 2 x 2 pixels of (H, W)."""
    rows, columns = field.shape
    return jnp.mean(field.reshape(rows // 2, 2, columns // 2, 2), (1, 3))


def doubled(field: Array) -> Array:
    """Interpolate (H, W) linearly to twice the size."""
    return jax.image.resize(field, (2 * field.shape[0], 2 * field.shape[1]), "linear")


def positions(shape: tuple[int, int], pitch: Scalar) -> tuple[Array, Array]:
    """Return x (right) and y (down) of the pixels of a grid, mm from its centre, each (H, W)."""
    pitch = jnp.asarray(pitch)
    y, x = (pitch * (jnp.arange(n, dtype=pitch.dtype) - (n - 1) / 2) for n in shape)
    return jnp.broadcast_to(x[None, :], shape), jnp.broadcast_to(y[:, None], shape)


def area(pressure: Array, pitch: Scalar) -> Array:
    """Return the contact's area in mm^2."""
    return jnp.sum(pressure > 0, (-2, -1)) * jnp.asarray(pitch, pressure.dtype) ** 2


def centroid(pressure: Array, pitch: Scalar) -> Array:
    """Return the centre (x, y) of a pressure (H, W), mm from the field's centre.

    It is (0, 0) without contact.
    """
    x, y = positions((pressure.shape[0], pressure.shape[1]), jnp.asarray(pitch, pressure.dtype))
    total = jnp.sum(pressure)
    moments = jnp.stack([jnp.sum(x * pressure), jnp.sum(y * pressure)])
    return ratio(moments, total, 0.0)
