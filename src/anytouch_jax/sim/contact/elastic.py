"""Elastic half-spaces and bonded layers: influence coefficients of a load, and their convolution.

Lengths are in pixels and stresses in units of the composite modulus E*. A stress p on one pixel
moves the surface at an offset of (i, j) pixels by `p / E* * pitch * coefficient(i, j)`.
Coefficients are listed at offsets >= 0, because they are even or odd in both.

A gel is a layer bonded to a rigid plate. Its coefficients are those of the half-space, which have
closed forms but are singular at the load, minus a difference that is smooth and has none. The
difference is a table over the distance (`layer_tables`), in units of the layer's thickness, so one
table serves gels of every thickness.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array
from jax.typing import DTypeLike

from anytouch_jax.sim.draws import Scalar

Host = npt.NDArray[np.float64]

# Thicknesses of the layer. The motion of a bonded layer decays exponentially with the distance, and
# is zero beyond.
FAR = 12.0
DISTANCE: Host = np.linspace(0, FAR, 513)
# Up to this side length four matrix products are faster than two FFTs (twice as fast at 112, on two
# cores).
MATMUL_LIMIT = 144


@dataclass(frozen=True)
class Plan:
    """Fourier transforms of (rows, columns) fields, padded so that convolutions do not wrap around.

    A transform is complex, or for small sizes a real (2, 2, KH, KW) array. The latter holds the
    cosine and sine sums of the parts that are even and odd about the centre in x and in y. A
    symmetric kernel does not mix them, so its convolution is a product in either form.
    """

    rows: int
    columns: int

    @property
    def padded(self) -> tuple[int, int]:
        """Rows and columns of the padded field."""
        rows = 2 * self.rows
        columns = 2 * self.columns
        if self.matmul:
            # of a field with an even number of rows and columns
            return rows + rows % 4, columns + columns % 4
        return _smooth(rows - 1), _smooth(columns - 1)

    @property
    def matmul(self) -> bool:
        """Whether transforms are matrix products, and not FFTs."""
        return max(self.rows, self.columns) <= MATMUL_LIMIT

    def forward(self, field: Array) -> Array:
        """Return the transform of a field (rows, columns)."""
        if not self.matmul:
            return jnp.fft.rfft2(field, self.padded)
        y, x = (_waves(size, field.dtype) for size in self.padded)
        parts = _split(_split(jnp.pad(field, ((0, self.rows % 2), (0, self.columns % 2))), 0), 2)
        return _einsum("xlj,xykj->xykl", x, _einsum("yki,xyij->xykj", y, parts))

    def inverse(self, transform: Array) -> Array:
        """Return the field (rows, columns) of a transform, without its padding."""
        if not self.matmul:
            return jnp.fft.irfft2(transform, self.padded)[: self.rows, : self.columns]
        y, x = (_waves(size, transform.dtype) for size in self.padded)
        parts = _einsum("yki,xykj->xyij", y, _einsum("xlj,xykl->xykj", x, transform))
        return _join(_join(parts, 2), 0)[: self.rows, : self.columns]

    def even(self, transform: Array, spectrum: Array) -> Array:
        """Return the transform of a field's convolution with a kernel even in x and in y."""
        if self.matmul:
            return transform * spectrum[None, None]
        return transform * _unfold(spectrum, self.padded[0], 1)

    def odd(self, transform: Array, spectrum: Array) -> Array:
        """Return the transform of a field's convolution with a kernel odd in x and in y."""
        if not self.matmul:
            return transform * _unfold(spectrum, self.padded[0], -1)
        # An odd kernel exchanges even and odd parts: sin(a - b) = sin a cos b - cos a sin b, once
        # for x and once for y, and i squared is -1.
        sign = jnp.array([[-1, 1], [1, -1]], transform.dtype)[:, :, None, None]
        return sign * transform[::-1, ::-1] * spectrum[None, None]

    def spectrum(self, quadrant: Any, parity: int = 1) -> Any:
        """Return the spectrum of a kernel from its (rows, columns) coefficients at offsets >= 0.

        Products with two small tables are cheaper than a transform of the unfolded kernel. numpy
        coefficients, which are known before the program runs, give a numpy spectrum in float64.
        """
        sizes = zip((self.rows, self.columns), self.padded, strict=True)
        y, x = (_kernel_table(size, padded, parity, self.matmul) for size, padded in sizes)
        if isinstance(quadrant, np.ndarray):
            return parity * (y @ quadrant @ x.T)
        along = _einsum("ij,lj->il", quadrant, jnp.asarray(x, quadrant.dtype))
        return parity * _einsum("ki,il->kl", jnp.asarray(y, quadrant.dtype), along)


def _smooth(least: int) -> int:
    """Return the first even size from `least` on with no prime factor above 7."""
    size = least + least % 2
    while functools.reduce(_without, (2, 3, 5, 7), size) > 1:
        size += 2
    return size


def _without(size: int, factor: int) -> int:
    while size % factor == 0:
        size //= factor
    return size


@functools.lru_cache(maxsize=64)
def _wave_table(padded: int) -> Host:
    angle = 2 * np.pi / padded * np.outer(np.arange(padded // 2 + 1), np.arange(padded // 4) + 0.5)
    return np.stack([np.cos(angle), np.sin(angle)])


@functools.lru_cache(maxsize=64)
def _kernel_table(size: int, padded: int, parity: int, weighted: bool) -> Host:
    """Return the table (padded / 2 + 1, size) that sums a kernel, even or odd, to its spectrum.

    `weighted` includes the factors that the matrix form of `Plan.inverse` leaves out.
    """
    wave = np.arange(padded // 2 + 1)
    offset = np.arange(size)
    angle = 2 * np.pi / padded * np.outer(wave, offset)
    # An offset above 0 stands for itself and for its negative.
    if parity > 0:
        table = np.cos(angle) * np.where(offset > 0, 2, 1)
    else:
        table = 2 * np.sin(angle)
    if weighted:
        table *= np.where(wave % (padded // 2) > 0, 2, 1)[:, None] / padded
    return table


def _waves(padded: int, dtype: DTypeLike) -> Array:
    return jnp.asarray(_wave_table(padded), dtype)


def _einsum(formula: str, a: Array, b: Array) -> Array:
    # Accelerators would cut float32 to 10 bits, and the solver would not converge.
    return jnp.einsum(formula, a, b, precision=jax.lax.Precision.HIGHEST)


def _split(field: Array, axis: int) -> Array:
    """Return the parts even and odd about the centre of `axis`, by distance, stacked in front."""
    left, right = jnp.split(field, 2, axis)
    left = jnp.flip(left, axis)
    return jnp.stack([right + left, right - left])


def _join(parts: Array, axis: int) -> Array:
    """Invert `_split` up to a factor of two: parts (2, ...) -> ..., concatenated along `axis`."""
    even = parts[0]
    odd = parts[1]
    return jnp.concatenate([jnp.flip(even - odd, axis), even + odd], axis)


def _unfold(half: Array, size: int, parity: int) -> Array:
    """Return all `size` rows in FFT order from rows 0 .. size/2."""
    return jnp.concatenate([half, parity * half[1 : size // 2][::-1]], 0)


def normal_coefficients(rows: int, columns: int) -> Host:
    """Return the normal displacement by a unit pressure on a pixel, at offsets >= 0.

    Boussinesq's point load moves the surface at a distance r by P / (pi E* r). Its integral over a
    square has a closed form (Love 1929; Johnson, Contact Mechanics, 3.25), finite at the load.
    """
    return (_over_pixel(_xx, rows, columns) + _over_pixel(_yy, rows, columns)) / np.pi


def tangential_coefficients(rows: int, columns: int, poisson: float) -> tuple[Host, Host, Host]:
    """Return the tangential displacement by a unit traction on a pixel, at offsets >= 0.

    They are of x by x, of x by y (odd in x and in y), and of y by y: Cerruti's load (Johnson,
    Contact Mechanics, 3.75) over a square, in units of the normal modulus E*.
    """
    xx, yy, xy = (_over_pixel(integral, rows, columns) / np.pi for integral in (_xx, _yy, _xy))
    ratio = poisson / (1 - poisson)
    return xx + yy + ratio * xx, ratio * xy, xx + yy + ratio * yy


def _xx(x: Host, y: Host) -> Host:
    """Return the double integral of x^2 / r^3.

    With its counterpart in y it sums to that of 1 / r.
    """
    return y * np.arcsinh(x / np.abs(y))


def _yy(x: Host, y: Host) -> Host:
    """Return the double integral of y^2 / r^3."""
    return x * np.arcsinh(y / np.abs(x))


def _xy(x: Host, y: Host) -> Host:
    """Return the double integral of x y / r^3."""
    return -np.hypot(x, y)


def _over_pixel(integral: Callable[[Host, Host], Host], rows: int, columns: int) -> Host:
    """Return a double integral between the borders of each pixel (rows, columns)."""
    y, x = np.meshgrid(
        np.arange(rows, dtype=np.float64), np.arange(columns, dtype=np.float64), indexing="ij"
    )
    right = x + 0.5
    left = x - 0.5
    low = y + 0.5
    high = y - 0.5
    return integral(right, low) - integral(left, low) - integral(right, high) + integral(left, high)


def layer_symbols(wave: Host, poisson: float) -> tuple[Host, Host, Host]:
    """Return a bonded layer's compliance over the half-space's, for loads that are waves.

    The loads are normal, tangential along the wave, and tangential across it (Sneddon 1951; Johnson
    5.8). `wave` is the wave number times the thickness. Short waves do not feel the plate, so the
    ratios go to 1; long ones are held by it.
    """
    k = 3 - 4 * poisson
    # divided by exp(2 wave), so nothing overflows
    decay = np.exp(-2 * wave)
    below = k * (1 + decay**2) + (1 + k**2 + 4 * wave**2) * decay
    sinh = k * (1 - decay**2)
    return (sinh - 4 * wave * decay) / below, (sinh + 4 * wave * decay) / below, np.tanh(wave)


def sideways_symbol(wave: Host, poisson: float) -> Host:
    """Return a bonded layer's tangential motion under a normal load that is a wave.

    It is the motion toward the load's crests over a half-space's normal motion. `wave` and the
    derivation are as in `layer_symbols`. It is negative where the layer is squeezed out.
    """
    k = 3 - 4 * poisson
    decay = np.exp(-2 * wave)
    below = k * (1 + decay**2) + (1 + k**2 + 4 * wave**2) * decay
    drawn = k * (1 - 2 * poisson) / 2 * (1 - decay) ** 2
    squeezed = 2 * wave**2 * decay
    return (drawn - squeezed) / (1 - poisson) / below


@functools.lru_cache(maxsize=1)
def _hankel() -> tuple[Host, Host, Host, Host]:
    """Return what Hankel transforms to `DISTANCE` need.

    These are waves, quadrature weights, and the Bessel functions J0 and J2 of distance times wave
    (distances, waves). Above a wave of 14 the symbols of a layer are those of a half-space.
    """
    nodes, weights = np.polynomial.legendre.leggauss(128)
    wave = 7.0 * (nodes + 1)
    weights = 7.0 * weights
    # J_n(x) is the mean of cos(n t - x sin t) over t from 0 to pi.
    turn = (np.arange(200) + 0.5) * np.pi / 200
    phase = np.outer(DISTANCE, wave)[..., None] * np.sin(turn)
    return wave, weights, np.cos(phase).mean(-1), np.cos(2 * turn - phase).mean(-1)


@functools.lru_cache(maxsize=8)
def layer_tables(poisson: float) -> tuple[Host, Host, Host]:
    """Return the motions of a half-space minus those of a layer by a point load, at `DISTANCE`.

    The motions are normal, tangential (mean over directions) and tangential (amplitude of cos 2
    phi), in units of P / (pi E* thickness). The difference is smooth: near the load, where both
    diverge, they are the same.
    """
    wave, weights, bessel0, bessel2 = _hankel()
    normal, along, across = (1 - symbol for symbol in layer_symbols(wave, poisson))
    across = across / (1 - poisson)
    twofold = -bessel2 @ (weights * (along - across) / 2)
    return bessel0 @ (weights * normal), bessel0 @ (weights * (along + across) / 2), twofold


def is_infinite(value: Any) -> bool:
    """Return whether a thickness or a modulus is a number, not traced, and infinite."""
    return isinstance(value, float | int) and bool(np.isinf(value))


@functools.lru_cache(maxsize=8)
def sideways_table(poisson: float) -> tuple[Host, float]:
    """Return the smooth part of `sideways_kernel` at `DISTANCE` d thicknesses, and the factor of
    asinh(2 / d).
    """
    wave, weights, bessel0, _ = _hankel()
    # Short waves move a half-space sideways too, unless it is incompressible. That part has no
    # smooth table, but a closed form: asinh(2 / d) is the integral of (1 - exp(-2 w)) J0(w d) / w.
    rest = (1 - 2 * poisson) / (2 * (1 - poisson))
    smooth = (sideways_symbol(wave, poisson) + rest * np.expm1(-2 * wave)) / wave
    return bessel0 @ (weights * smooth), rest


def sideways_kernel(
    plan: Plan, pitch: Scalar, poisson: float, thickness: Scalar, dtype: DTypeLike
) -> Any:
    """Return the potential of the sideways motion of a layer's surface by a load on a pixel.

    Its gradient is that motion. It is (H, W) at offsets >= 0, in units of P / (pi E*). A load pulls
    or pushes along the line to it, so the motion has no curl, and one potential replaces two
    kernels.

    Args:
        plan: The transform of the grid.
        pitch: mm between pixels.
        poisson: Poisson's ratio of the gel.
        thickness: mm of the gel.
        dtype: Of the potential.
    """
    table, rest = sideways_table(poisson)
    # Near the load the potential goes as -log r. At 0 this is the mean of log r over a pixel.
    radius = np.maximum(_radius(plan), np.exp(np.pi / 4 - 1.5 - np.log(2) / 2))
    xp, kind = _library(dtype, pitch, thickness)
    far = xp.asarray(radius, kind) * xp.asarray(pitch / thickness, kind)
    return xp.where(far < FAR, _between(far, table) + rest * xp.arcsinh(2 / far), 0)


def _library(dtype: DTypeLike, *values: Any) -> tuple[ModuleType, Any]:
    """Return the array library that computes with some values, and the type of its numbers.

    Values that are known before a program runs are for numpy, in float64. XLA would compute with
    them too while it compiles, but by an interpreter, which takes seconds and prints alarms.
    """
    if any(isinstance(value, jax.Array) for value in values):
        return jnp, dtype
    return np, np.float64


def _between(far: Any, table: Host) -> Any:
    """Return values between those of a table at `DISTANCE`. Equal steps need no search."""
    xp = far.__array_namespace__()
    step = far / DISTANCE[1]
    left = xp.clip(step.astype(xp.int32), 0, len(table) - 2)
    lines = xp.asarray(np.stack([table[:-1], np.diff(table)], 1), far.dtype)[left]
    return lines[..., 0] + (step - left) * lines[..., 1]


def _looked_up(far: Any, table: Host, limit: float) -> Any:
    """Return a difference between half-space and layer at any distance.

    Beyond FAR the layer does not move, so the difference is the half-space's motion, `limit` / far.
    """
    xp = far.__array_namespace__()
    return xp.where(far < FAR, _between(far, table), limit / xp.maximum(far, FAR))


def normal_spectrum(
    plan: Plan, pitch: Scalar, poisson: float, thickness: Scalar, fraction: Scalar, dtype: DTypeLike
) -> Array:
    """Return the spectrum (KH, KW) of the normal coefficients.

    Args:
        plan: The transform of the grid.
        pitch: mm between pixels.
        poisson: Poisson's ratio of the gel.
        thickness: mm of the gel; infinite for a half-space.
        fraction: E* over the gel's plane modulus: the part of the motion that is the layer's.
        dtype: Of the spectrum.
    """
    if is_infinite(thickness):
        return jnp.asarray(_normal_host(plan), dtype)
    xp, kind = _library(dtype, pitch, thickness, fraction)
    deep = xp.asarray(_normal_host(plan), kind)
    scale = xp.asarray(pitch / thickness, kind)
    table, _, _ = layer_tables(poisson)
    radius = xp.asarray(_radius(plan), kind) * scale
    layer = deep - plan.spectrum(fraction * scale / np.pi * _looked_up(radius, table, 1.0))
    return jnp.asarray(layer, dtype)


def tangential_spectra(
    plan: Plan, pitch: Scalar, poisson: float, thickness: Scalar, fraction: Scalar, dtype: DTypeLike
) -> Array:
    """Return the spectra (3, KH, KW) of the tangential coefficients xx, xy, yy.

    Arguments are those of `normal_spectrum`.
    """
    if is_infinite(thickness):
        return jnp.asarray(_tangential_host(plan, poisson), dtype)
    xp, kind = _library(dtype, pitch, thickness, fraction)
    deep = xp.asarray(_tangential_host(plan, poisson), kind)
    scale = xp.asarray(pitch / thickness, kind)
    _, mean, twofold = layer_tables(poisson)
    radius = xp.asarray(_radius(plan), kind) * scale
    ratio = poisson / (1 - poisson)
    mean_at = fraction * scale / np.pi * _looked_up(radius, mean, 1 + ratio / 2)
    twofold_at = fraction * scale / np.pi * _looked_up(radius, twofold, ratio / 2)
    cosine, sine = (xp.asarray(table, kind) for table in _twice_the_angle(plan))
    # A motion along x by a load along x varies as cos 2 phi about its mean over directions.
    parts = (mean_at + cosine * twofold_at, sine * twofold_at, mean_at - cosine * twofold_at)
    layer = deep - xp.stack(
        [plan.spectrum(part, p) for part, p in zip(parts, (1, -1, 1), strict=True)]
    )
    return jnp.asarray(layer, dtype)


@functools.lru_cache(maxsize=64)
def _normal_host(plan: Plan) -> Host:
    return plan.spectrum(normal_coefficients(plan.rows, plan.columns))


@functools.lru_cache(maxsize=64)
def _tangential_host(plan: Plan, poisson: float) -> Host:
    parts = tangential_coefficients(plan.rows, plan.columns, poisson)
    return np.stack([plan.spectrum(part, p) for part, p in zip(parts, (1, -1, 1), strict=True)])


def _radius(plan: Plan) -> Host:
    """Return the distance in pixels of offsets >= 0, (rows, columns)."""
    return np.hypot(np.arange(plan.rows)[:, None], np.arange(plan.columns)[None, :])


def _twice_the_angle(plan: Plan) -> tuple[Host, Host]:
    """Return cosine and sine of twice the direction of offsets >= 0, each (rows, columns)."""
    y = np.arange(plan.rows)[:, None]
    x = np.arange(plan.columns)[None, :]
    squared = np.maximum(x**2 + y**2, 1)
    return (x**2 - y**2) / squared, 2 * x * y / squared
