"""Interpolation of maps: matrices that resample, differentiate and blur along one axis, and cubic
look-up at points.

On a grid of some hundred points a matrix product beats gathers and short convolutions on a CPU, and
one product can resample, blur and differentiate at once. Maps are (rows, columns). M @ map acts on
rows, map @ M.T on columns.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from anytouch_jax.sim.draws import Leaf


def spline(positions: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Return matrices of the cubic B-spline of `count` samples: value and derivative.

    The spline does not interpolate. It smooths by 0.58 samples, as a skin does, and never
    overshoots, because its weights are positive and sum to one.

    Args:
        positions: (n,) in samples, 0 in the middle of the first one. Outside, the first or the last
            sample is repeated.
        count: Number of samples.

    Returns:
        Two matrices (n, count). The derivative is per sample step.
    """
    positions = jnp.clip(positions, 0.0, count - 1.0)
    # Two samples more at each end: the spline at a border reaches so far.
    knots = jnp.arange(-2.0, count + 2.0)
    d = positions[:, None] - knots[None, :]
    a = jnp.abs(d)
    near = a < 1
    far = a < 2
    # The cubic B-spline: 2/3 - a^2 + a^3/2 up to a distance of one, (2 - a)^3 / 6 up to two.
    value = jnp.where(near, 2 / 3 - a**2 + a**3 / 2, jnp.where(far, (2 - a) ** 3 / 6, 0.0))
    slope = jnp.sign(d) * jnp.where(
        near, -2 * a + 1.5 * a**2, jnp.where(far, -((2 - a) ** 2) / 2, 0.0)
    )
    return _fold(value), _fold(slope)


def _fold(matrix: jax.Array) -> jax.Array:
    """Move columns outside the map to its first and last column, which repeats the edge."""
    first, last = (jnp.sum(edge, 1, keepdims=True) for edge in (matrix[:, :3], matrix[:, -3:]))
    return jnp.concatenate([first, matrix[:, 3:-3], last], 1)


def blur(count: int, sigma: float | jax.Array) -> jax.Array:
    """Return a Gaussian blur (count, count) of `sigma` > 0 samples, which may be traced.

    Rows sum to one.
    """
    place = jnp.arange(count, dtype=jnp.float32)
    kernel = jnp.exp(-0.5 * ((place[:, None] - place[None, :]) / sigma) ** 2)
    return kernel / kernel.sum(1, keepdims=True)


def average(count: int, cells: int) -> npt.NDArray[np.float32]:
    """Return the means (cells, count) over `cells` equal parts of `count` samples.

    Samples on a border are divided.
    """
    left = np.arange(cells)[:, None] * count / cells
    right = np.minimum(left + count / cells, np.arange(count) + 1)
    overlap = right - np.maximum(left, np.arange(count))
    return np.asarray(np.maximum(overlap, 0) * cells / count, np.float32)


class _Neighbours(NamedTuple):
    """The four rows and the four columns around points, and their weights."""

    rows: list[jax.Array]
    columns: list[jax.Array]
    down: tuple[jax.Array, ...]
    across: tuple[jax.Array, ...]
    inside: jax.Array  # whether a point lies on the raster


def sample(raster: Leaf, pitch: float, x: jax.Array, y: jax.Array) -> jax.Array:
    """Return values of a centred raster at points, by a cubic (Catmull-Rom) spline.

    It is exact at pixels, with continuous slopes between them: bilinear facets would be seen in the
    image, which shows slopes. Outside of the raster and at NaN it is the lowest value on the
    border. A point costs sixteen reads. A raster of half floats is read as float32.

    The spline overshoots at a cliff, by a sixteenth of its height and more. The simulator's own
    surfaces have none (`shapes._STEEP`); for those of users there is `sample_sharp`.

    Args:
        raster: (H, W) values.
        pitch: mm between pixels.
        x: Places to the right of the middle, mm.
        y: Places below the middle, mm, of the shape of `x`.
    """
    columns = raster.shape[1]
    dtype = jnp.promote_types(raster.dtype, jnp.float32)
    near = _neighbours(raster, pitch, x, y)
    flat = jnp.asarray(raster).reshape(-1)
    total = jnp.zeros(near.inside.shape, dtype)
    for row, down in zip(near.rows, near.down, strict=True):
        line = jnp.zeros_like(total)
        for column, across in zip(near.columns, near.across, strict=True):
            # The indices are clipped above, so the read need not check them again.
            line = line + across * flat.at[row * columns + column].get(mode="promise_in_bounds")
        total = total + down * line
    return _or_border(raster, near.inside, total)


def sample_sharp(raster: Leaf, pitch: float, x: jax.Array, y: jax.Array) -> jax.Array:
    """Return values as `sample`, without its overshoot at cliffs.

    Along each axis a value stays between its two neighbours, but for the room that a gentle bend on
    both sides of them leaves (`_limited`). So a plateau stays one up to its very edge, and a smooth
    surface is the same as by `sample`: parabolas are exact.

    Args:
        raster: (H, W) values.
        pitch: mm between pixels.
        x: places to the right of the middle, mm.
        y: places below the middle, mm, of the shape of `x`.
    """
    columns = raster.shape[1]
    near = _neighbours(raster, pitch, x, y)
    flat = jnp.asarray(raster).reshape(-1)
    lines = []
    for row in near.rows:
        reads = [
            flat.at[row * columns + column].get(mode="promise_in_bounds") for column in near.columns
        ]
        lines.append(_limited(reads, near.across, pitch))
    return _or_border(raster, near.inside, _limited(lines, near.down, pitch))


def sample_nearest(raster: Leaf, pitch: float, x: jax.Array, y: jax.Array) -> jax.Array:
    """Return the values of the pixels nearest to points, for one read of each; see `sample`.

    Args:
        raster: (H, W) values.
        pitch: mm between pixels.
        x: places to the right of the middle, mm.
        y: places below the middle, mm, of the shape of `x`.
    """
    rows, columns = raster.shape
    down = jnp.nan_to_num(jnp.asarray(y) / pitch + (rows - 1) / 2, nan=-1.0)
    across = jnp.nan_to_num(jnp.asarray(x) / pitch + (columns - 1) / 2, nan=-1.0)
    row = jnp.round(down).astype(jnp.int32)
    column = jnp.round(across).astype(jnp.int32)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    place = jnp.clip(row, 0, rows - 1) * columns + jnp.clip(column, 0, columns - 1)
    value = jnp.asarray(raster).reshape(-1).at[place].get(mode="promise_in_bounds")
    return _or_border(raster, inside, value)


def _limited(values: list[jax.Array], weights: tuple[jax.Array, ...], pitch: float) -> jax.Array:
    """Return the cubic between the middle two of four values, without overshoot.

    Between samples of a parabola of second difference k the largest value is at most k / 8 above
    both. So the cubic may leave the interval between its neighbours by an eighth of the smaller of
    their two second differences, if these have one sign. At the edge of a plateau one of them is 0.
    On a ridge of two pixels both are cliffs: slopes that change by more than 1 within a pixel.
    """
    outer_left, left, right, outer_right = values
    total = sum(weight * value for weight, value in zip(weights, values, strict=True))
    bend_left = outer_left - 2 * left + right
    bend_right = left - 2 * right + outer_right
    smaller = jnp.minimum(jnp.abs(bend_left), jnp.abs(bend_right))
    room = jnp.where(smaller <= pitch, smaller / 8, 0)
    highest = jnp.maximum(left, right)
    highest = highest + jnp.where((bend_left < 0) & (bend_right < 0), room, 0)
    lowest = jnp.minimum(left, right)
    lowest = lowest - jnp.where((bend_left > 0) & (bend_right > 0), room, 0)
    return jnp.clip(total, lowest, highest)


def _neighbours(raster: Leaf, pitch: float, x: jax.Array, y: jax.Array) -> _Neighbours:
    """Return what surrounds points on a centred raster."""
    rows, columns = raster.shape
    dtype = jnp.promote_types(raster.dtype, jnp.float32)
    place = (jnp.asarray(y) / pitch + (rows - 1) / 2, jnp.asarray(x) / pitch + (columns - 1) / 2)
    index = []
    weights = []
    inside = jnp.ones(place[0].shape, bool)
    for at, count in zip(place, (rows, columns), strict=True):
        slack = 1e-3  # rounding must not move a place on the border outside
        inside = inside & (at >= -slack) & (at <= count - 1 + slack)
        at = jnp.clip(jnp.nan_to_num(at), 0, count - 1)
        first = jnp.floor(at)
        # Catmull-Rom weights of the four neighbours, exactly 0, 1, 0, 0 at 0
        f = (at - first).astype(dtype)
        outer = ((-0.5 * f + 1.0) * f - 0.5) * f
        inner = (1.5 * f - 2.5) * f * f + 1.0
        weights.append((outer, inner, ((-1.5 * f + 2.0) * f + 0.5) * f, (0.5 * f - 0.5) * f * f))
        index.append([jnp.clip(first.astype(jnp.int32) + i, 0, count - 1) for i in (-1, 0, 1, 2)])
    return _Neighbours(index[0], index[1], weights[0], weights[1], inside)


def _or_border(raster: Leaf, inside: jax.Array, value: jax.Array) -> jax.Array:
    """Return values `inside`, and the lowest one on the border elsewhere."""
    border = jnp.concatenate([raster[0], raster[-1], raster[:, 0], raster[:, -1]])
    return jnp.where(inside, value, jnp.min(border).astype(value.dtype))
