"""Images and clips as token sequences: patches, position tables, segments, sensor tokens (Sec. 3.1, 3.5), masking.

B batch, T frames, H W pixels, C colours, P patch, N = (H/P)(W/P) positions, K kept ones, D width. Masking is random
(Sec. 3.2; He et al., 2022).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def patchify(clip: Array, patch: int) -> Array:
    """Cut `clip` (B, T, H, W, C) into patch vectors (B, N, T, P*P*C), each in the order (row, col, colour).

    Raises ValueError when H or W is no multiple of `patch`.
    """
    b, t, h, w, c = clip.shape
    if h % patch or w % patch:
        raise ValueError(f"a {h} x {w} image cannot be cut into patches of {patch} pixels")
    grid = clip.reshape(b, t, h // patch, patch, w // patch, patch, c)
    return grid.transpose(0, 2, 4, 1, 3, 5, 6).reshape(b, -1, t, patch * patch * c)


def unpatchify(patches: Array, patch: int, height: int) -> Array:
    """The exact inverse of `patchify`: (B, N, T, P*P*C) -> (B, T, H, W, C) with H = `height`."""
    b, n, t, size = patches.shape
    rows, colours = height // patch, size // patch**2
    grid = patches.reshape(b, rows, n // rows, t, patch, patch, colours)
    return grid.transpose(0, 3, 1, 4, 2, 5, 6).reshape(b, t, height, -1, colours)


def sincos_table(width: int, grid: int) -> Array:
    """Fixed 2-D sine-cosine positions (1 + grid^2, width); row 0, the class token's, is zero (MAE, golden I).

    The first half of the channels encodes the column, the second the row, each as [sin | cos].
    Raises ValueError when `width` is no multiple of 4.
    """
    if width % 4:
        raise ValueError(f"a sine-cosine table needs a width that is a multiple of 4, not {width}")
    frequency = 10000.0 ** (-jnp.arange(width // 4) / (width // 4))
    angle = jnp.arange(grid)[:, None] * frequency[None, :]
    axis = jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], axis=1)  # (grid, width / 2)
    cols = jnp.tile(axis, (grid, 1))
    rows = jnp.repeat(axis, grid, axis=0)
    table = jnp.concatenate([cols, rows], axis=1)
    return jnp.concatenate([jnp.zeros((1, width), table.dtype), table], axis=0)


def segments(clip: Array, frames: int) -> Array:
    """Cut a long clip (B, T, ...) into S = ceil(T / frames) segments (B, S, frames, ...) (App. "frame number").

    The last segment ends with the last frame, so it overlaps its neighbour when T is no multiple of `frames`.
    Raises ValueError when T is smaller than `frames`.
    """
    total = clip.shape[1]
    if total < frames:
        raise ValueError(
            f"a clip of {total} frames is shorter than a segment of {frames}; use a still or a longer clip"
        )
    starts = [min(start, total - frames) for start in range(0, total, frames)]
    return jnp.stack([clip[:, start : start + frames] for start in starts], axis=1)


def universal_probability(progress: Array, start: float, end: float) -> Array:
    """Return p_u, which grows linearly from `start` to `end` with `progress` in [0, 1] (appendix: 0 to 0.75)."""
    return start + (end - start) * progress


def draw_tokens(sensor: Array, uniform: Array, probability: Array, universal_row: int) -> Array:
    """Replace a sensor's row by the universal one where `uniform` < p_u: i ~ Bernoulli(p_u) (Eq. 7).

    `sensor` i32 (B,), `uniform` (B,) in [0, 1). Returns rows i32 (B,) of the sensor-token table.
    """
    return jnp.where(uniform < probability, universal_row, sensor)


def count_visible(positions: int, ratio: float) -> int:
    """Return how many of `positions` stay visible: floor(N * ratio) in floating point, as the release."""
    return int(positions * ratio)


def random_mask(noise: Array, keep: int) -> tuple[Array, Array, Array]:
    """Keep the `keep` positions of smallest noise, each sample by its own row of `noise` (B, N).

    Returns keep_ids (B, K) in ascending order of noise, restore_ids (B, N), and hidden (B, N). Position n is element
    restore_ids[n] of [visible, hidden]. `hidden` is True where a position was removed (Omega_M of Eq. 1).
    """
    order = jnp.argsort(noise, axis=1)
    restore_ids = jnp.argsort(order, axis=1)
    return order[:, :keep], restore_ids, restore_ids >= keep


def keep(x: Array, keep_ids: Array) -> Array:
    """Return the positions `keep_ids` (B, K) of `x` (B, N, ...), as (B, K, ...)."""
    ids = keep_ids.reshape(keep_ids.shape + (1,) * (x.ndim - 2))
    return jnp.take_along_axis(x, ids, axis=1)


def restore(visible: Array, mask_token: Array, restore_ids: Array) -> Array:
    """Put `visible` (B, K, D) back to its positions and the mask token (D,) everywhere else: (B, N, D)."""
    batch, count, width = visible.shape
    hidden = jnp.broadcast_to(mask_token.astype(visible.dtype), (batch, restore_ids.shape[1] - count, width))
    return jnp.take_along_axis(jnp.concatenate([visible, hidden], axis=1), restore_ids[..., None], axis=1)
