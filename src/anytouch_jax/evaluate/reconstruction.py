"""How well stage 1 tells pixels that it is not shown, beside guesses without a model."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.config import Config
from anytouch_jax.data.loading.evaluation import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.transforms import UNTOUCHED
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.objectives import normalise_touch, reconstruct
from anytouch_jax.ops import losses, tokens


def pixel_scores(params: Any, manifest: Manifest, ends: np.ndarray, config: Config) -> dict[str, float]:
    """Mean squared error of normalised pixels (Eq. 1, 2) over the clips that end at rows `ends`, without augmentation.

    "reconstruction" (hidden patches) and "next_frame" of stage 1; on the same masks the same of `plain_guess`
    ("plain reconstruction", "plain next_frame"), and with the background subtracted of a gel that nothing touches
    ("untouched reconstruction", ...). A window is the model's frames and, if it predicts one, the next; the universal
    tokens serve a sensor that the table lacks. Raises ValueError for no rows, and for `norm_pix_loss`, whose errors
    have the unit of each patch's spread.
    """
    if config.objective.norm_pix_loss or not len(ends):
        raise ValueError("pixels are scored on at least one clip, and not with norm_pix_loss")
    net, sums, count = build(usable(config.model)), dict[str, float](), 0
    frames = config.model.frames + config.objective.next_frame
    for ids, batch in evaluation(manifest, ends, config, "clip", frames=frames, unknown="universal"):
        n = len(ids)  # the rest of the last batch repeats its last row
        noise = jax.random.uniform(jax.random.key(count), (len(batch.sensor), config.model.patches))
        found = _scores(params, batch.clip[:n], batch.sensor[:n], noise[:n], net=net, config=config)
        sums = {name: sums.get(name, 0.0) + float(value) * n for name, value in found.items()}
        count += n
    return {name: value / count for name, value in sums.items()}


@partial(jax.jit, static_argnames=("net", "config"))
def _scores(params: Any, clip: Any, sensor: Any, noise: Any, *, net: Net, config: Config) -> dict[str, Any]:
    clip = normalise_touch(clip)
    pixels, _, hidden = reconstruct(params, clip, sensor, noise, net=net, config=config)
    target = tokens.patchify(clip, net.model.patch)
    guesses = {"": pixels, "plain ": plain_guess(target, hidden, net.model.frames)}
    if config.data.background == "subtract":
        gel = normalise_touch(jnp.full(clip.shape, UNTOUCHED, jnp.uint8))
        guesses["untouched "] = tokens.patchify(gel, net.model.patch)
    following = clip.shape[1] > net.model.frames
    return {
        kind + term: value
        for kind, guess in guesses.items()
        for term, value in losses.reconstruction_loss(guess, target, hidden, next_frame=following)[1].items()
    }


def plain_guess(target: Any, hidden: Any, frames: int) -> Any:
    """Patches (B, N, T, C) as a guess without a model has them, `hidden` bool (B, N).

    Every patch is the mean of the sample's visible ones; a frame beyond the `frames` that the encoder sees is a copy of
    the last of these.
    """
    visible = ~hidden[:, :, None, None]
    mean = (target * visible).sum(axis=1, keepdims=True) / visible.sum(axis=1, keepdims=True)
    guess = jnp.broadcast_to(mean, target.shape)
    return jnp.concatenate([guess[:, :, :frames], target[:, :, frames - 1 : target.shape[2] - 1]], axis=2)
