"""Reconstruction errors of stage 1 on masked pixels, guesses without a model, and images."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD, Config
from anytouch_jax.data.background.contact import known_contact
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.transforms import UNTOUCHED
from anytouch_jax.errors import refuse_forked
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.objectives import normalise_touch, reconstruct
from anytouch_jax.ops import losses, tokens

if TYPE_CHECKING:
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.nn.functional import Net

_CLIPS = 240  # on which errors in contact are measured
# of the panels: colour of hidden patches, gaps and heights of titles in pixels
_GREY = np.uint8(128)
_GAP = 4
_TITLE = 16


def pixel_scores(
    params: Any, manifest: Manifest, ends: np.ndarray, *, net: Net, config: Config
) -> dict[str, float]:
    """Return the mean squared errors of normalised pixels (Eq. 1, 2) of some clips.

    "reconstruction" (masked patches) and "next_frame" are those of stage 1. Those that begin with
    "plain" are of `plain_reconstruction`, and with "untouched" of the background, if it is
    subtracted. Sensors outside the table get the universal tokens.

    Args:
        params: of stage 1, with the decoder.
        manifest: of the clips.
        ends: rows (n,) at which they end.
        net: of the parameters.
        config: of the run.

    Raises:
        ValueError: without rows, and for `norm_pix_loss`, whose errors are not of pixels.
    """
    if config.objective.norm_pix_loss or not len(ends):
        raise ValueError("pixels are scored on at least one clip, and not with norm_pix_loss")
    each = clip_scores(params, manifest, ends, net=net, config=config)
    return {name: float(values.mean()) for name, values in each.items()}


def clip_scores(
    params: Any, manifest: Manifest, ends: np.ndarray, *, net: Net, config: Config
) -> dict[str, np.ndarray]:
    """Return the errors of `pixel_scores` of each clip (n,), in the order of `ends`.

    Args:
        params: of the network.
        manifest: the frames.
        ends: i64 (n,) rows that end the clips.
        net: the network.
        config: of its run.
    """
    refuse_forked()
    parts = dict[str, list[np.ndarray]]()
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
        for name, values in errors.items():
            parts.setdefault(name, []).append(np.asarray(values))
        count += n
    return {name: np.concatenate(several) for name, several in parts.items()}


def contact_errors(
    params: Any, manifest: Manifest, ends: np.ndarray, encoder: Encoder
) -> dict[str, Any]:
    """Return errors of stage 1 and of guesses on clips in contact, {} if there are none.

    "gains" has for each term the best guess, by how much stage 1 is better, and the 95 % interval
    of that over objects. Frames without contact are the background in every patch, so they would
    flatter everything.

    Args:
        params: of the network.
        manifest: the frames.
        ends: i64 (n,) rows that end the clips, of which at most 240 are scored.
        encoder: that the network is of.
    """
    # in contact or unknown
    ends = ends[known_contact(manifest)[ends] != 0]
    config = encoder.config
    if config.objective.norm_pix_loss or not len(ends):
        return {}
    ends = ends[np.linspace(0, len(ends) - 1, min(_CLIPS, len(ends))).astype(int)]
    config = replace(config, data=replace(config.data, batch_size=min(48, len(ends))))
    each = clip_scores(params, manifest, ends, net=encoder.net, config=config)
    groups = manifest.text_column("object")[ends]
    groups = np.where(groups == "", manifest.text_column("sequence")[ends], groups)
    scores: dict[str, Any] = {"clips": len(ends), "gains": {}}
    scores |= {name: float(values.mean()) for name, values in each.items()}
    for term in ("reconstruction", "next_frame"):
        guesses = [kind for kind in ("untouched ", "plain ") if kind + term in each]
        if term not in each or not guesses:
            continue
        best = min(guesses, key=lambda kind: scores[kind + term])
        gain = each[best + term] - each[term]
        scores["gains"][term] = (best, float(gain.mean()), *mean_interval(gain, groups))
    return scores


@partial(jax.jit, static_argnames=("net", "config"))
def _errors(
    params: Any, clip: Any, sensor: Any, noise: Any, *, net: Net, config: Config
) -> dict[str, Any]:
    """Return the errors (n,) of each clip, of the network and of guesses."""
    clip = normalise_touch(clip)
    pixels, hidden = reconstruct(params, clip, sensor, noise, net=net, config=config)
    target = tokens.patchify(clip, net.model.patch)
    predictions = {"": pixels, "plain ": plain_reconstruction(target, hidden, net.model.frames)}
    if config.data.background == "subtract":
        gel = normalise_touch(jnp.full(clip.shape, UNTOUCHED, jnp.uint8))
        predictions["untouched "] = tokens.patchify(gel, net.model.patch)
    has_next = clip.shape[1] > net.model.frames
    errors = {}
    terms_of = partial(_terms, next_frame=has_next)
    for kind, prediction in predictions.items():
        for term, values in jax.vmap(terms_of)(prediction, target, hidden).items():
            errors[kind + term] = values
    return errors


def _terms(prediction: Any, target: Any, hidden: Any, *, next_frame: bool) -> dict[str, Any]:
    """Return the terms of the loss of one clip: all clips have equally many hidden patches."""
    rows = (one[None] for one in (prediction, target, hidden))
    return losses.reconstruction_loss(*rows, next_frame=next_frame)[1]


def plain_reconstruction(target: Any, hidden: Any, frames: int) -> Any:
    """Return a guess without a model: what learning must beat.

    Patches (B, N, T, C) are the mean of those that are not `hidden` (B, N), and after `frames` a
    copy of the last frame.
    """
    visible = ~hidden[:, :, None, None]
    mean = (target * visible).sum(axis=1, keepdims=True) / visible.sum(axis=1, keepdims=True)
    prediction = jnp.broadcast_to(mean, target.shape)
    last = target[:, :, frames - 1 : target.shape[2] - 1]
    return jnp.concatenate([prediction[:, :, :frames], last], axis=2)


def reconstruction_panels(
    params: Any, clip: Any, sensor: Any, *, net: Net, config: Config, seed: int = 0
) -> np.ndarray:
    """Return an RGB image u8 with a row per sample.

    Its columns are original, masked input, reconstruction, next frame and prediction. With
    `norm_pix_loss` the true mean and spread are put back, since the model does not predict them.

    Args:
        params: of stage 1, with the decoder.
        clip: u8 (B, T, H, W, 3).
        sensor: rows of the table of sensors, i32 (B,).
        net: of the parameters.
        config: of the run.
        seed: of the masks.
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
        images = np.pad(block, gap, constant_values=255)  # (B, T, h, w, 3)
        column = images.transpose(0, 2, 1, 3, 4).reshape(len(block) * (size + _GAP), -1, 3)
        title = np.full((_TITLE, column.shape[1], 3), 255, np.uint8)
        cv2.putText(
            title, name, (2, _TITLE - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA
        )
        columns.append(np.concatenate([title, column]))
    return np.concatenate(columns, axis=1)


@partial(jax.jit, static_argnames=("net", "config"))
def _predict(params: Any, clip: Any, sensor: Any, noise: Any, *, net: Net, config: Config) -> Any:
    """Return predicted patches (B, N, T, C) and which were hidden (B, N)."""
    return reconstruct(params, normalise_touch(clip), sensor, noise, net=net, config=config)
