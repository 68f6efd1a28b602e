"""Reconstruction errors of stage 1 on masked pixels, baselines without a model, and pictures of
reconstructions.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD, Config
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.transforms import UNTOUCHED
from anytouch_jax.errors import refuse_forked
from anytouch_jax.objectives import normalise_touch, reconstruct
from anytouch_jax.ops import losses, tokens

if TYPE_CHECKING:
    from anytouch_jax.nn.functional import Net

_GREY = np.uint8(128)
_GAP = 4
_TITLE = 16


def pixel_scores(
    params: Any, manifest: Manifest, ends: np.ndarray, *, net: Net, config: Config
) -> dict[str, float]:
    """Return the mean squared errors of normalised pixels (Eq. 1, 2) of the clips that end at rows
    `ends`.

    "reconstruction" (masked patches) and "next_frame" are those of stage 1. Those that begin with
    "plain" are of `plain_reconstruction`, and with "untouched" of an untouched gel, if the
    background is subtracted. Sensors outside the table get the universal tokens. Raises ValueError
    without rows, and for `norm_pix_loss`.
    """
    if config.objective.norm_pix_loss or not len(ends):
        raise ValueError("pixels are scored on at least one clip, and not with norm_pix_loss")
    refuse_forked()
    sums = dict[str, float]()
    count = 0
    frames = config.model.frames + config.objective.next_frame
    for ids, batch in evaluation(
        manifest, ends, config, "clip", frames=frames, unknown="universal"
    ):
        n = len(ids)  # the rest of the last batch repeats its last row
        noise = jax.random.uniform(
            jax.random.key(count), (len(batch.sensor), config.model.patches), jnp.float32
        )
        errors = _errors(
            params, batch.clip[:n], batch.sensor[:n], noise[:n], net=net, config=config
        )
        sums = {name: sums.get(name, 0.0) + float(value) * n for name, value in errors.items()}
        count += n
    return {name: value / count for name, value in sums.items()}


@partial(jax.jit, static_argnames=("net", "config"))
def _errors(
    params: Any, clip: Any, sensor: Any, noise: Any, *, net: Net, config: Config
) -> dict[str, Any]:
    clip = normalise_touch(clip)
    pixels, hidden = reconstruct(params, clip, sensor, noise, net=net, config=config)
    target = tokens.patchify(clip, net.model.patch)
    predictions = {"": pixels, "plain ": plain_reconstruction(target, hidden, net.model.frames)}
    if config.data.background == "subtract":
        gel = normalise_touch(jnp.full(clip.shape, UNTOUCHED, jnp.uint8))
        predictions["untouched "] = tokens.patchify(gel, net.model.patch)
    has_next = clip.shape[1] > net.model.frames
    return {
        kind + term: value
        for kind, prediction in predictions.items()
        for term, value in losses.reconstruction_loss(
            prediction, target, hidden, next_frame=has_next
        )[1].items()
    }


def plain_reconstruction(target: Any, hidden: Any, frames: int) -> Any:
    """Return patches (B, N, T, C): the mean of those not `hidden` (B, N); after `frames` a copy of
    the last frame.
    """
    visible = ~hidden[:, :, None, None]
    mean = (target * visible).sum(axis=1, keepdims=True) / visible.sum(axis=1, keepdims=True)
    prediction = jnp.broadcast_to(mean, target.shape)
    return jnp.concatenate(
        [prediction[:, :, :frames], target[:, :, frames - 1 : target.shape[2] - 1]], axis=2
    )


def reconstruction_panels(
    params: Any, clip: Any, sensor: Any, *, net: Net, config: Config, seed: int = 0
) -> np.ndarray:
    """Return an RGB image u8 with a row per sample: original, masked input, reconstruction, next
    frame, prediction.

    `clip` u8 (B, T, H, W, 3), `sensor` i32 (B,). With `norm_pix_loss` the true mean and spread are
    put back.
    """
    refuse_forked()
    patch = net.model.patch
    size = net.model.image_size
    frames = net.model.frames
    noise = jax.random.uniform(jax.random.key(seed), (len(sensor), net.model.patches), jnp.float32)
    pixels, hidden = _predict(params, clip, sensor, noise, net=net, config=config)
    if config.objective.norm_pix_loss:
        target = tokens.patchify(normalise_touch(jnp.asarray(clip)), patch)
        spread = jnp.sqrt(target.var(axis=-1, ddof=1, keepdims=True) + 1e-6)
        pixels = pixels * spread + target.mean(axis=-1, keepdims=True)
    predicted = np.asarray(tokens.unpatchify(pixels, patch, size)) * IMAGENET_STD + IMAGENET_MEAN
    predicted = np.clip(np.nan_to_num(predicted * 255), 0, 255).astype(np.uint8)
    of_pixels = hidden[:, :, None, None].repeat(patch**2 * 3, 3)
    cover = np.asarray(tokens.unpatchify(of_pixels, patch, size)) > 0
    clip = np.asarray(clip)
    shown = clip[:, :frames]
    masked = np.where(cover, _GREY, shown)
    filled = np.where(cover, predicted[:, : shown.shape[1]], shown)
    blocks = {"original": shown, "visible": masked, "reconstructed": filled}
    if clip.shape[1] > frames:
        blocks |= {
            "next frame": clip[:, frames : frames + 1],
            "predicted": predicted[:, frames : frames + 1],
        }
    gap = ((0, 0), (0, 0), (0, _GAP), (0, _GAP), (0, 0))
    columns = []
    for name, block in blocks.items():
        pictures = np.pad(block, gap, constant_values=255)  # (B, T, h, w, 3)
        column = pictures.transpose(0, 2, 1, 3, 4).reshape(len(block) * (size + _GAP), -1, 3)
        title = np.full((_TITLE, column.shape[1], 3), 255, np.uint8)
        cv2.putText(
            title, name, (2, _TITLE - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA
        )
        columns.append(np.concatenate([title, column]))
    return np.concatenate(columns, axis=1)


@partial(jax.jit, static_argnames=("net", "config"))
def _predict(params: Any, clip: Any, sensor: Any, noise: Any, *, net: Net, config: Config) -> Any:
    return reconstruct(params, normalise_touch(clip), sensor, noise, net=net, config=config)
