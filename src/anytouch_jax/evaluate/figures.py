"""Pictures of what a model does: originals, masks, reconstructions and predicted next frames."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD, Config
from anytouch_jax.files import atomic_write
from anytouch_jax.nn.functional import Net
from anytouch_jax.objectives import normalise_touch, reconstruct
from anytouch_jax.ops import tokens

_GREY, _GAP = 128, 4


def reconstruction_panels(
    params: Any, clip: Any, sensor: Any, *, net: Net, config: Config, seed: int = 0
) -> np.ndarray:
    """Rows of samples as one RGB image u8: original frames, masked input, reconstruction, (next frame, prediction).

    `clip` u8 (B, T, H, W, 3), `sensor` i32 (B,). Visible patches are shown as they were; with `norm_pix_loss` the
    prediction is brought back by the true mean and spread of each patch.
    """
    noise = jax.random.uniform(jax.random.key(seed), (len(sensor), net.model.patches))
    pred, hidden = _predict(params, clip, sensor, noise, net=net, config=config)
    return _panels(np.asarray(clip), np.asarray(pred), np.asarray(hidden), net, config)


@partial(jax.jit, static_argnames=("net", "config"))
def _predict(params: Any, clip: Any, sensor: Any, noise: Any, *, net: Net, config: Config) -> Any:
    pixels, _, hidden = reconstruct(params, normalise_touch(clip), sensor, noise, net=net, config=config)
    return pixels, hidden


def _panels(clip: np.ndarray, pred: np.ndarray, hidden: np.ndarray, net: Net, config: Config) -> np.ndarray:
    patch, size, frames = net.model.patch, net.model.image_size, net.model.frames
    if config.objective.norm_pix_loss:
        target = np.asarray(tokens.patchify(normalise_touch(jnp.asarray(clip)), patch))
        spread = np.sqrt(target.var(axis=-1, ddof=1, keepdims=True) + 1e-6)
        pred = pred * spread + target.mean(axis=-1, keepdims=True)
    painted = _to_pixels(np.asarray(tokens.unpatchify(jnp.asarray(pred), patch, size)))
    cover = (
        np.asarray(tokens.unpatchify(jnp.asarray(hidden)[:, :, None, None].repeat(patch**2 * 3, 3), patch, size)) > 0
    )
    shown = min(clip.shape[1], frames)
    masked = np.where(cover, _GREY, clip[:, :shown])
    filled = np.where(cover, painted[:, :shown], clip[:, :shown])
    blocks = {"original": clip[:, :shown], "visible": masked, "reconstructed": filled}
    if clip.shape[1] > frames:
        blocks |= {"next frame": clip[:, frames : frames + 1], "predicted": painted[:, frames : frames + 1]}
    rows = [np.concatenate([_strip(block[i]) for block in blocks.values()], axis=1) for i in range(len(clip))]
    titles = [_title(name, block.shape[1] * (size + _GAP)) for name, block in blocks.items()]
    return np.concatenate([np.concatenate(titles, axis=1), *rows], axis=0)


def _title(name: str, width: int) -> np.ndarray:
    """A white strip (16, width, 3) with a word on it."""
    strip = np.full((16, width, 3), 255, np.uint8)
    cv2.putText(strip, name, (2, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return strip


def _strip(frames: np.ndarray) -> np.ndarray:
    """Frames (T, H, W, 3) side by side, with a white edge."""
    return np.concatenate([np.pad(f, ((0, _GAP), (0, _GAP), (0, 0)), constant_values=255) for f in frames], axis=1)


def _to_pixels(normalised: np.ndarray) -> np.ndarray:
    pixels = (normalised * np.asarray(IMAGENET_STD) + np.asarray(IMAGENET_MEAN)) * 255
    return np.clip(np.nan_to_num(pixels), 0, 255).astype(np.uint8)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write an RGB image u8 (H, W, 3), whole or not at all. Raises OSError."""
    atomic_write(path, cv2.imencode(".png", image[..., ::-1])[1].tobytes())
