"""The paper's two sums, Eq. 8 (stage 1) and Eq. 9 (stage 2), assembled from `ops` over a network.

`*_terms` are deterministic (every draw is an argument): what the parity check runs. `*_loss` normalise the pixels,
draw masks and sensor tokens from a key, then call the terms: what training runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import CLIP_MEAN, CLIP_STD, IMAGENET_MEAN, IMAGENET_STD, Config, ModelConfig
from anytouch_jax.nn.functional import Net
from anytouch_jax.ops import losses, masking, sensor_tokens, tokens

Params = dict[str, Any]
Metrics = dict[str, Array]


def normalise_touch(clip: Array) -> Array:
    """uint8 RGB (..., 3) -> float32, ImageNet statistics (the release's choice for touch)."""
    return _normalise(clip, IMAGENET_MEAN, IMAGENET_STD)


def normalise_image(image: Array) -> Array:
    """uint8 RGB (..., 3) -> float32, CLIP statistics (for photographs)."""
    return _normalise(image, CLIP_MEAN, CLIP_STD)


def _normalise(pixels: Array, mean: tuple[float, ...], std: tuple[float, ...]) -> Array:
    shape = (1,) * (pixels.ndim - 1) + (3,)
    return (pixels.astype(jnp.float32) / 255.0 - jnp.asarray(mean).reshape(shape)) / jnp.asarray(std).reshape(shape)


def stage1_terms(
    params: Params,
    clip: Array,
    sensor: Array,
    noise: Array,
    *,
    net: Net,
    config: Config,
    decoder_sensor: Array | None = None,
    force: Array | None = None,
) -> tuple[Array, Metrics]:
    """Masked reconstruction, and next-frame prediction where there is a next frame (Eq. 8).

    `clip` float (B, T, H, W, 3), normalised: T = 1 a still, 3 a clip, 4 a clip and its next frame. `sensor` i32 (B,)
    rows of the token table, already drawn; `noise` (B, N) decides the masks. Returns the loss and its terms. Beyond the
    paper, where `objective` weighs them: frame differences of clips, and `force` (B, 2) from the class token.
    """
    objective, frames = config.objective, net.model.frames
    if not objective.next_frame:
        clip = clip[:, :frames]
    how: dict[str, Any] = {"net": net, "config": config, "decoder_sensor": decoder_sensor}
    pixels, told, hidden = reconstruct(params, clip, sensor, noise, **how, force=force is not None)
    target = tokens.patchify(clip, net.model.patch)
    if objective.norm_pix_loss:
        target = losses.normalise_patches(target)
    loss, metrics = losses.reconstruction_loss(pixels, target, hidden, next_frame=clip.shape[1] > frames)
    if objective.differences and clip.shape[1] > 1:
        metrics["differences"] = losses.difference_loss(pixels, target, hidden)
        loss = loss + objective.differences * metrics["differences"]
    if told is not None and force is not None:
        error, terms = losses.force_loss(told, force)
        loss, metrics = loss + objective.force * error, metrics | terms
    return loss, metrics


def reconstruct(
    params: Params,
    clip: Array,
    sensor: Array,
    noise: Array,
    *,
    net: Net,
    config: Config,
    decoder_sensor: Array | None = None,
    force: bool = False,
) -> tuple[Array, Array | None, Array]:
    """Pixels (B, N, T, P*P*3) of all positions from the visible ones; force (B, 2) where asked for; hidden (B, N).

    See `stage1_terms`. The encoder sees the first three frames only, whatever T is.
    """
    visible = masking.kept(net.model.patches, config.objective.keep_ratio)
    keep_ids, restore_ids, hidden = masking.random_mask(noise, visible)
    seen = clip[:, : net.model.frames]
    given = (seen, sensor, keep_ids, restore_ids, clip.shape[1], decoder_sensor)
    pixels, told = net.apply(params, "reconstruct", *given, force=force)
    return pixels, told, hidden


def stage1_loss(
    params: Params, batch: TouchBatch, key: Array, progress: Array, *, net: Net, config: Config
) -> tuple[Array, Metrics]:
    """`stage1_terms` of a uint8 batch, masks and sensor tokens drawn from `key`; `progress` in [0, 1] drives p_u."""
    key_noise, key_universal = jax.random.split(key)
    noise = jax.random.uniform(key_noise, (len(batch.sensor), net.model.patches))
    p_u, sensor = _draw(batch.sensor, key_universal, progress, net, config)
    clip, own, force = normalise_touch(batch.clip), batch.sensor, batch.force
    loss, metrics = stage1_terms(params, clip, sensor, noise, net=net, config=config, decoder_sensor=own, force=force)
    return loss, metrics | {"p_u": p_u}


class Embeddings(NamedTuple):
    """Unit-norm embeddings of a batch: touch (B, E); image, text (B, E) with rows that may be absent, or None."""

    touch: Array
    image: Array | None
    text: Array | None
    has_image: Array | None
    has_text: Array | None


def touch_embeddings(
    params: Params, touches: Sequence[tuple[Array, Array]], *, net: Net, keep_ids: Array | None = None
) -> list[Array]:
    """Unit-norm embeddings (B, E) of several batches of (clip (B, T, H, W, 3) float, sensor i32 (B,)).

    Batches of one shape share a pass of the encoder: one stack to compile and larger products. They are interleaved row
    by row, not chained, so that each row stays on its device. `keep_ids` (M, B, K): patches to keep of M batches.
    """
    z: list[Array] = [jnp.zeros(0)] * len(touches)
    for shape in {clip.shape: None for clip, _ in touches}:
        members = [i for i, (clip, _) in enumerate(touches) if clip.shape == shape]
        clips, sensors = (jnp.stack(part, axis=1) for part in zip(*(touches[i] for i in members), strict=True))
        rows = clips.reshape(-1, *shape[1:]), sensors.reshape(-1)
        if keep_ids is None:
            flat = net.apply(params, "encode", *rows)
        else:
            ids = jnp.stack([keep_ids[i] for i in members], axis=1)
            flat = net.apply(params, "encode_some", *rows, ids.reshape(-1, ids.shape[-1]))
        each = losses.normalise(flat).reshape(shape[0], len(members), -1)
        for j, i in enumerate(members):
            z[i] = each[:, j]
    return z


def align_embeddings(params: Params, batch: AlignBatch, touch: Array, *, net: Net) -> Embeddings:
    """The embeddings `touch` (B, E) beside those of the packed images and texts, scattered to the rows they belong to.

    A tower runs over its V or L slots only, and not at all without slots. Pixels are normalised floats. What an unused
    slot holds is replaced first: NaN would pass into the gradients although the slot's value is dropped.
    """
    image = text = has_image = has_text = None
    if batch.image.shape[0]:
        used = (batch.image_row < len(touch))[:, None, None, None]
        packed = losses.normalise(net.apply(params, "embed_image", jnp.where(used, batch.image, 0.0)))
        image, has_image = _scatter(packed, batch.image_row, len(touch))
    if batch.text.shape[0]:
        used = (batch.text_row < len(touch))[:, None]
        ids, mask = jnp.where(used, batch.text, 0), batch.text_mask | ~used
        packed = losses.normalise(net.apply(params, "embed_text", ids, mask))
        text, has_text = _scatter(packed, batch.text_row, len(touch))
    return Embeddings(touch, image, text, has_image, has_text)


def _scatter(packed: Array, row: Array, rows: int) -> tuple[Array, Array]:
    """Slots (V, E) to their rows (B, E), and which rows were filled; a slot of row B is unused and dropped."""
    full = jnp.zeros((rows, packed.shape[1]), packed.dtype).at[row].set(packed, mode="drop")
    return full, jnp.zeros(rows, bool).at[row].set(True, mode="drop")


def stage2_terms(
    params: Params,
    batch: Stage2Batch,
    noise: Array | None,
    *,
    net: Net,
    config: Config,
    decoder_sensor: Array | None = None,
    match_noise: Array | None = None,
) -> tuple[Array, Metrics]:
    """L_align + lambda L_match (Eq. 9), plus the stage-1 loss on the align batch where the recipe keeps it.

    Pixels are normalised floats, sensor rows are already drawn; a part of `batch` that is None is not computed.
    `noise` (B, N) is read only for the reconstruction. `match_noise` (M, B, N) decides which patches the M touches of
    matching keep (None: all). Returns the sum and every term, unweighted.
    """
    objective = config.objective
    total = jnp.zeros(())
    metrics: Metrics = {}
    aligned, matched = _touches(batch, net.model)
    if match_noise is None:
        z_touch = touch_embeddings(params, aligned + matched, net=net)
    else:
        kept = max(1, masking.kept(net.model.patches, objective.match_keep))
        ids = jax.vmap(lambda noise: masking.random_mask(noise, kept)[0])(match_noise)
        z_touch = touch_embeddings(params, aligned, net=net) + touch_embeddings(params, matched, net=net, keep_ids=ids)
    if batch.align is not None:
        z = align_embeddings(params, batch.align, z_touch.pop(0), net=net)
        scale = net.apply(params, "scale")
        how: dict[str, Any] = {"groups": objective.groups, "centre": objective.centre}
        align, terms = losses.alignment_loss(*z, scale, objective.pair_weights, **how)
        total, metrics = total + align, metrics | terms | {"align": align, "temperature": 1 / scale}
        if objective.reconstruct and noise is not None:
            own: dict[str, Any] = {"net": net, "config": config, "decoder_sensor": decoder_sensor}
            pixels, terms = stage1_terms(params, batch.align.clip, batch.align.sensor, noise, **own)
            total, metrics = total + pixels, metrics | terms
    if batch.match is not None:
        if net.model.match_head == "cosine":
            first, second = z_touch
            scale, place = net.apply(params, "scale"), batch.match.place
            match, right = losses.contrast_loss(first, second, scale, groups=objective.groups, place=place)
        else:
            z_anchor, *others = z_touch
            positive, negative = (net.apply(params, "match", z_anchor, z) for z in others)  # Eq. 5
            match = losses.matching_loss(positive, negative)
            right = jnp.mean(jnp.concatenate([positive > 0, negative < 0]).astype(jnp.float32))
        total, metrics = total + objective.match_weight * match, metrics | {"match": match, "match_accuracy": right}
    return total, metrics


Touches = list[tuple[Array, Array]]


def _touches(batch: Stage2Batch, model: ModelConfig) -> tuple[Touches, Touches]:
    """The touches that a batch embeds: those to align (without a next frame), and those to match: anchor, positive and,
    where a head tells pairs apart one by one, negative."""
    align, match = batch
    aligned = [] if align is None else [(align.clip[:, : model.frames], align.sensor)]
    if match is None:
        return aligned, []
    pair = [(match.clip, match.sensor), (match.positive, match.positive_sensor)]
    return aligned, pair if model.match_head == "cosine" else [*pair, (match.negative, match.negative_sensor)]


def stage2_loss(
    params: Params, batch: Stage2Batch, key: Array, progress: Array, *, net: Net, config: Config
) -> tuple[Array, Metrics]:
    """`stage2_terms` of a uint8 batch, masks and sensor tokens drawn from `key`; `progress` drives p_u."""
    key_noise, key_align, key_match, key_keep = jax.random.split(key, 4)
    align, match, noise, own, metrics = batch.align, batch.match, None, None, {}
    match_noise = None
    if align is not None:
        own = align.sensor
        noise = jax.random.uniform(key_noise, (len(own), net.model.patches))
        metrics["p_u"], sensor = _draw(own, key_align, progress, net, config)
        align = align._replace(clip=normalise_touch(align.clip), sensor=sensor, image=normalise_image(align.image))
    if match is not None:
        metrics["p_u"], match = _draw_match(match, key_match, progress, net, config)
        if config.objective.match_keep < 1:
            shape = (2 if net.model.match_head == "cosine" else 3, len(match.sensor), net.model.patches)
            match_noise = jax.random.uniform(key_keep, shape)
    loss, terms = stage2_terms(
        params,
        Stage2Batch(align, match),
        noise,
        net=net,
        config=config,
        decoder_sensor=own,
        match_noise=match_noise,
    )
    return loss, terms | metrics


def _draw(sensor: Array, key: Array, progress: Array, net: Net, config: Config) -> tuple[Array, Array]:
    """p_u at `progress`, and the sensor rows after the draw (Eq. 7), one draw a sample."""
    p_u = sensor_tokens.universal_probability(
        progress, config.objective.universal_start, config.objective.universal_end
    )
    uniform = jax.random.uniform(key, sensor.shape)
    return p_u, sensor_tokens.draw_tokens(sensor, uniform, p_u, net.model.universal_row)


def _draw_match(batch: MatchBatch, key: Array, progress: Array, net: Net, config: Config) -> tuple[Array, MatchBatch]:
    """The matching pair or triple with normalised pixels and drawn tokens; the release shares one draw a triple."""
    keys = [key] * 3 if config.objective.universal_shared else list(jax.random.split(key, 3))
    p_u, sensor = _draw(batch.sensor, keys[0], progress, net, config)
    _, positive = _draw(batch.positive_sensor, keys[1], progress, net, config)
    batch = batch._replace(clip=normalise_touch(batch.clip), sensor=sensor)
    batch = batch._replace(positive=normalise_touch(batch.positive), positive_sensor=positive)
    if batch.negative is not None:
        _, negative = _draw(batch.negative_sensor, keys[2], progress, net, config)
        batch = batch._replace(negative=normalise_touch(batch.negative), negative_sensor=negative)
    return p_u, batch
