"""Token sequences of images and clips: patches, positions, segments, sensor tokens, masks.

The paper describes them in Sec. 3.1 and 3.5. Masking is random (Sec. 3.2; He et al., 2022). B
batch, T frames, H W pixels, C colours, P patch, N = (H/P)(W/P) positions, K kept ones, D width.
Arrays may be numpy's, lists or numbers.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def patchify(clip: ArrayLike, patch: int) -> Array:
    """Cut `clip` (B, T, H, W, C) into patch vectors (B, N, T, P*P*C).

    Each is in the order (row, column, colour). Raises ValueError for another shape, and when H or W
    is no multiple of `patch`.
    """
    clip = jnp.asarray(clip)
    b, t, h, w, c = _shape(clip, "a clip", "B T H W C")
    if patch < 1 or h % patch or w % patch:
        raise ValueError(f"a {h} x {w} image cannot be cut into patches of {patch} pixels")
    rows = h // patch
    columns = w // patch
    grid = clip.reshape(b, t, rows, patch, columns, patch, c)
    return grid.transpose(0, 2, 4, 1, 3, 5, 6).reshape(b, rows * columns, t, patch * patch * c)


def unpatchify(patches: ArrayLike, patch: int, height: int) -> Array:
    """Return the exact inverse of `patchify`: (B, N, T, P*P*C) -> (B, T, H, W, C).

    H is `height`. Raises ValueError for another shape, and for patches that do not make images of
    that height.
    """
    patches = jnp.asarray(patches)
    b, n, t, size = _shape(patches, "patches", "B N T P*P*C")
    rows = 0
    if patch > 0 and height % patch == 0:
        rows = height // patch
    if rows < 1 or n % rows or size % patch**2:
        raise ValueError(
            f"{n} patches of {size} values and {patch} pixels do not make images of height {height}"
        )
    columns = n // rows
    colours = size // patch**2
    grid = patches.reshape(b, rows, columns, t, patch, patch, colours)
    return grid.transpose(0, 3, 1, 4, 2, 5, 6).reshape(b, t, height, columns * patch, colours)


def _shape(x: Array, name: str, axes: str) -> tuple[int, ...]:
    """Return the shape of an array. Raises ValueError for another number of axes."""
    if x.ndim != len(axes.split()):
        raise ValueError(f"{name} must be ({', '.join(axes.split())}), not {x.shape}")
    return x.shape


def sincos_table(width: int, grid: int) -> Array:
    """Return fixed 2-D sine-cosine positions (1 + grid^2, width), as MAE.

    Row 0, the class token's, is zero. The first half of the channels encodes the column, the second
    the row, each as [sin | cos]. MAE's code has it in this order, although its names say the
    opposite. Raises ValueError when `width` is no multiple of 4, or `grid` is negative.
    """
    if width < 4 or width % 4 or grid < 0:
        raise ValueError(
            f"a sine-cosine table needs a width that is a multiple of 4, not {width}, and a grid "
            "of 0 or more"
        )
    frequency = 10000.0 ** (-jnp.arange(width // 4) / (width // 4))
    angle = jnp.arange(grid, dtype=frequency.dtype)[:, None] * frequency[None, :]
    # (grid, width / 2)
    axis = jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], axis=1)
    cols = jnp.tile(axis, (grid, 1))
    rows = jnp.repeat(axis, grid, axis=0)
    table = jnp.concatenate([cols, rows], axis=1)
    return jnp.concatenate([jnp.zeros((1, width), table.dtype), table], axis=0)


def segments(clip: ArrayLike, frames: int) -> Array:
    """Cut a long clip (B, T, ...) into S = ceil(T / frames) segments (B, S, frames, ...).

    See the paper's appendix, "Discussion on frame number". The last segment ends with the last
    frame, so it overlaps its neighbour when T is no multiple of `frames`. Raises ValueError when T
    is smaller than `frames`, or `frames` below 1.
    """
    clip = jnp.asarray(clip)
    total = clip.shape[1]
    if frames < 1:
        raise ValueError(f"a segment has 1 frame or more, not {frames}")
    if total < frames:
        raise ValueError(
            f"a clip of {total} frames is shorter than a segment of {frames}; use a still or a "
            "longer clip"
        )
    starts = [min(start, total - frames) for start in range(0, total, frames)]
    return jnp.stack([clip[:, start : start + frames] for start in starts], axis=1)


def universal_probability(progress: ArrayLike, start: float, end: float) -> Array:
    """Return p_u, which grows linearly from `start` to `end` with `progress` in [0, 1].

    The paper's appendix has 0 to 0.75. Before 0 and after 1 it stays where it is.
    """
    return start + (end - start) * jnp.clip(jnp.asarray(progress, float), 0, 1)


def draw_tokens(
    sensor: ArrayLike, uniform: ArrayLike, probability: ArrayLike, universal_row: int
) -> Array:
    """Replace a sensor's row by the universal one where `uniform` < p_u (Eq. 7).

    Returns rows i32 (B,) of the sensor-token table.

    Args:
        sensor: rows i32 (B,) of the sensor-token table.
        uniform: draws (B,) in [0, 1).
        probability: p_u of this step.
        universal_row: the row that all sensors share.
    """
    is_universal = jnp.asarray(uniform, float) < jnp.asarray(probability, float)
    return jnp.where(is_universal, universal_row, jnp.asarray(sensor))


def count_visible(positions: int, ratio: float) -> int:
    """Return how many of `positions` stay visible: floor(N * ratio).

    It is computed in floating point, as in the release. Raises ValueError for a negative number,
    and for a ratio outside 0 to 1.
    """
    if positions < 0 or not 0 <= ratio <= 1:
        raise ValueError(
            f"a ratio between 0 and 1 of 0 or more positions stays visible, not {ratio} of "
            f"{positions}"
        )
    return int(positions * ratio)


def random_mask(noise: ArrayLike, keep: int) -> tuple[Array, Array, Array]:
    """Keep the `keep` positions of smallest noise, each sample by its own row of `noise` (B, N).

    Returns keep_ids (B, K) in ascending order of noise, restore_ids (B, N), and hidden (B, N).
    Position n is element restore_ids[n] of [visible, hidden]. `hidden` is True where a position was
    removed (Omega_M of Eq. 1). Raises ValueError for a number of positions to keep that is not 0 to
    N.
    """
    noise = jnp.asarray(noise)
    _, count = _shape(noise, "noise", "B N")
    if not 0 <= keep <= count:
        raise ValueError(f"0 to {count} of {count} positions can be kept, not {keep}")
    # Each row is sorted by itself. One permutation for the whole batch would look right, and train
    # on the same positions of every sample. The inverse of a permutation is its argsort.
    order = jnp.argsort(noise, axis=1)
    restore_ids = jnp.argsort(order, axis=1)
    return order[:, :keep], restore_ids, restore_ids >= keep


def keep(x: ArrayLike, keep_ids: ArrayLike) -> Array:
    """Return the positions `keep_ids` i32 (B, K) of `x` (B, N, ...), as (B, K, ...)."""
    x = jnp.asarray(x)
    keep_ids = jnp.asarray(keep_ids)
    ids = keep_ids.reshape(keep_ids.shape + (1,) * (x.ndim - 2))
    return jnp.take_along_axis(x, ids, axis=1)


def restore(visible: ArrayLike, mask_token: ArrayLike, restore_ids: ArrayLike) -> Array:
    """Return (B, N, D): `visible` (B, K, D) at its positions, the mask token (D,) at all others.

    Raises ValueError for more visible positions than there are.
    """
    visible = jnp.asarray(visible)
    restore_ids = jnp.asarray(restore_ids)
    batch, count, width = _shape(visible, "visible", "B K D")
    missing = restore_ids.shape[1] - count
    if missing < 0:
        raise ValueError(f"{count} visible positions do not fit into {restore_ids.shape[1]}")
    hidden = jnp.broadcast_to(jnp.asarray(mask_token, visible.dtype), (batch, missing, width))
    # [visible, hidden] is in the order of the noise; `restore_ids` brings it to that of the grid.
    ordered = jnp.concatenate([visible, hidden], axis=1)
    return jnp.take_along_axis(ordered, restore_ids[..., None], axis=1)
