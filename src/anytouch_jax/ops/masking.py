"""Random masking of patch positions (Sec. 3.2; He et al., 2022). B batch, N positions, K kept."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


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
