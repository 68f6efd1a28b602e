"""Prepared touches of a manifest in memory, and their random changes in training."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Array, Log
from anytouch_jax.encoder.encoder import Encoder, check_frames, load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.progress import tracked

GREY = 128.0  # of a place that did not change, once the background is subtracted
# Largest changes, as fractions of the side, of the size and of the contrast.
SHIFT = 0.06
ZOOM = 0.08
GAIN = 0.15
_BATCH = 64


class Touches(NamedTuple):
    """Prepared touches.

    Attributes:
        clip: u8 (n, T, H, W, 3).
        sensor: i32 (n,), rows of the table of sensors.
    """

    clip: Array
    sensor: Array

    def take(self, places: Array) -> Touches:
        """Return the touches at some places."""
        return Touches(self.clip[places], self.sensor[places])


def trainable(model: str | Path, frames: int) -> Encoder:
    """Load an encoder that can be fine-tuned on touches of `frames` frames, in float32.

    Raises UserError for one of another family, and for an export.
    """
    encoder = load_encoder(model, engine="xla")
    if type(encoder) is not Encoder:
        raise UserError(
            f"{model} cannot be fine-tuned: name an encoder of AnyTouch, or fit a head on its "
            "frozen features with `anytouch probe label --save`."
        )
    check_frames(encoder.config.model, frames)
    return encoder.computed_in("float32")


def read_touches(
    encoder: Encoder, table: Manifest, rows: Array, frames: int, backgrounds: Backgrounds, log: Log
) -> Touches:
    """Read and prepare touches once, because decoding them again in every pass takes as long.

    Args:
        encoder: what they are prepared for.
        table: the manifest.
        rows: row numbers (n,).
        frames: of a touch.
        backgrounds: backgrounds of its sensor instances.
        log: gets a sentence about each sensor without tokens.
    """
    for name in sorted(set(table.text_column("sensor")[rows])):
        encoder.sensor_row(name, log)
    config = encoder.config.with_settings(
        {"data.batch_size": min(_BATCH, len(rows)), "data.on_bad_sample": "error"}
    )
    clip = np.empty((len(rows), frames, *encoder.blank.shape), np.uint8)
    sensor = np.empty(len(rows), np.int32)
    batches = evaluation(
        table,
        rows,
        config,
        "still" if frames == 1 else "clip",
        frames=frames,
        unknown="universal",
        prepare=encoder.prepare,
        like=encoder.blank,
        backgrounds=backgrounds,
    )
    done = 0
    for _, part in tracked(batches, "batches read", -(-len(rows) // _BATCH)):
        count = min(len(part.sensor), len(rows) - done)
        clip[done : done + count] = part.clip[:count]
        sensor[done : done + count] = part.sensor[:count]
        done += count
    return Touches(clip, sensor)


def changed(key: jax.Array, clip: jax.Array) -> jax.Array:
    """Return clips shifted, zoomed and with another contrast and tint, f32 in 0..255.

    Touches are neither turned nor mirrored: the lights of a sensor stay where they are, so that a
    turned image shows a surface that its gel cannot have. All frames of a clip change alike.

    Args:
        key: draws the changes.
        clip: u8 (B, T, H, W, 3).
    """
    count, _, height, width, _ = clip.shape
    zooms, shifts, gains, tints = jax.random.split(key, 4)
    zoom = jnp.exp(ZOOM * _uniform(zooms, (count, 2)))
    shift = SHIFT * _uniform(shifts, (count, 2))
    pixels = clip.astype(jnp.float32) - GREY
    # A shift with a zoom is separable, so it is two small products of matrices for each touch. XLA
    # computes them far faster than it gathers pixels.
    rows = _resampling(zoom[:, 0], shift[:, 0], height)
    columns = _resampling(zoom[:, 1], shift[:, 1], width)
    pixels = jnp.einsum("bij,btjkc->btikc", rows, pixels)
    pixels = jnp.einsum("bij,btkjc->btkic", columns, pixels)
    gain = GAIN * (_uniform(gains, (count, 1, 1, 1, 1)) + _uniform(tints, (count, 1, 1, 1, 3)))
    return jnp.clip(pixels * jnp.exp(gain) + GREY, 0.0, 255.0)


def _uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def _resampling(zoom: jax.Array, shift: jax.Array, side: int) -> jax.Array:
    """Return matrices (B, side, side) of linear interpolation, with the border repeated."""
    places = jnp.arange(side, dtype=jnp.float32)
    middle = (side - 1) / 2
    source = (places[None] - middle) * zoom[:, None] + middle + side * shift[:, None]
    source = jnp.clip(source, 0.0, side - 1.0)
    return jnp.maximum(0.0, 1.0 - jnp.abs(source[..., None] - places[None, None]))
