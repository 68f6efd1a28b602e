"""Training objectives of both stages: Eq. 8 (stage 1) and Eq. 9 (stage 2), assembled from `ops`
over a network.

`*_terms` are deterministic: every random draw is an argument. The parity check runs them. `*_loss`
normalise the pixels, draw masks and sensor tokens from a key, then call the terms. Training runs
them. Arrays may be numpy's, lists or numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from anytouch_jax.batch import AlignBatch, FieldBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import CLIP_MEAN, CLIP_STD, IMAGENET_MEAN, IMAGENET_STD, Config
from anytouch_jax.fields.outputs import FORCE, LENGTH, STRESS, TORQUE
from anytouch_jax.nn.functional import Net
from anytouch_jax.ops import losses, tokens

Params = dict[str, Any]
Metrics = dict[str, Array]


Batch = TypeVar("Batch", bound=tuple[Any, ...])


def _arrays(batch: Batch) -> Batch:
    """Return a batch, or several, with arrays in the place of lists and numbers.

    Arrays and None are kept.
    """

    def convert(x: Any) -> Any:
        if hasattr(x, "_fields"):
            return _arrays(x)
        if x is None or hasattr(x, "shape"):
            return x
        return jnp.asarray(x)

    parts: Any = [convert(x) for x in batch]
    if hasattr(batch, "_fields"):
        return type(batch)(*parts)
    return type(batch)(parts)


def normalise_touch(clip: Array) -> Array:
    """Return uint8 RGB (..., 3) as float32, normalised by ImageNet's statistics (the release's
    choice for touch).
    """
    return _normalise(clip, IMAGENET_MEAN, IMAGENET_STD)


def normalise_image(image: Array) -> Array:
    """Return uint8 RGB (..., 3) as float32, normalised by CLIP's statistics (for photographs)."""
    return _normalise(image, CLIP_MEAN, CLIP_STD)


def _normalise(pixels: Array, mean: tuple[float, ...], std: tuple[float, ...]) -> Array:
    pixels = jnp.asarray(pixels)
    shape = (1,) * (pixels.ndim - 1) + (3,)
    return (pixels.astype(jnp.float32) / 255.0 - jnp.asarray(mean).reshape(shape)) / jnp.asarray(
        std
    ).reshape(shape)


def stage1_terms(
    params: Params,
    clip: Array,
    sensor: Array,
    noise: Array,
    *,
    net: Net,
    config: Config,
    decoder_sensor: Array | None = None,
) -> tuple[Array, Metrics]:
    """Return the loss of stage 1 and its terms: masked reconstruction and, for clips, the next
    frame (Eq. 8).

    `clip` float (B, T, H, W, 3), normalised: T = 1 a still, 3 a clip, 4 a clip and its next frame.
    `sensor` i32 (B,) rows of the token table, already drawn. `noise` (B, N) decides the masks.
    `decoder_sensor` i32 (B,): rows of the tokens that the decoder of the release gets. Both results
    are float32 scalars.
    """
    clip, sensor, noise = _arrays((clip, sensor, noise))
    if not config.objective.next_frame:
        clip = clip[:, : net.model.frames]
    pixels, hidden = reconstruct(
        params, clip, sensor, noise, net=net, config=config, decoder_sensor=decoder_sensor
    )
    target = tokens.patchify(clip, net.model.patch)
    if config.objective.norm_pix_loss:
        target = losses.normalise_patches(target)
    return losses.reconstruction_loss(
        pixels, target, hidden, next_frame=clip.shape[1] > net.model.frames
    )


def reconstruct(
    params: Params,
    clip: Array,
    sensor: Array,
    noise: Array,
    *,
    net: Net,
    config: Config,
    decoder_sensor: Array | None = None,
) -> tuple[Array, Array]:
    """Return pixels (B, N, T, P*P*3) of all positions from the visible ones, and `hidden` (B, N).

    See `stage1_terms`. The encoder sees the first three frames only, whatever T is.
    """
    clip, sensor, noise, decoder_sensor = _arrays((clip, sensor, noise, decoder_sensor))
    visible = tokens.count_visible(net.model.patches, config.objective.keep_ratio)
    keep_ids, restore_ids, hidden = tokens.random_mask(noise, visible)
    past = clip[:, : net.model.frames]
    pixels = net.reconstruct(
        params, past, sensor, keep_ids, restore_ids, clip.shape[1], decoder_sensor
    )
    return pixels, hidden


def stage1_loss(
    params: Params, batch: TouchBatch, key: Array, progress: Array, *, net: Net, config: Config
) -> tuple[Array, Metrics]:
    """Return `stage1_terms` of a uint8 batch, with masks and sensor tokens drawn from `key`.

    The clips are u8 (B, T, H, W, 3). `progress` f32 () in [0, 1] drives p_u (Eq. 7).
    """
    batch = _arrays(batch)
    (key_noise, key_universal) = jax.random.split(key)
    noise = jax.random.uniform(key_noise, (len(batch.sensor), net.model.patches))
    p_u, sensor = _draw_tokens(batch.sensor, key_universal, progress, net, config)
    clip = normalise_touch(batch.clip)
    loss, metrics = stage1_terms(
        params, clip, sensor, noise, net=net, config=config, decoder_sensor=batch.sensor
    )
    return _with_fields(
        params, batch.fields, loss, metrics | {"p_u": p_u}, key, progress, net, config
    )


def _with_fields(
    params: Params,
    batch: FieldBatch | None,
    loss: Array,
    metrics: Metrics,
    key: Array,
    progress: Array,
    net: Net,
    config: Config,
) -> tuple[Array, Metrics]:
    """Add the loss of touches with fields, if the batch has some."""
    if batch is None:
        return loss, metrics
    _, sensor = _draw_tokens(batch.sensor, jax.random.fold_in(key, 1), progress, net, config)
    batch = batch._replace(clip=normalise_touch(batch.clip), sensor=sensor)
    measured, terms = field_terms(params, batch, net=net)
    return loss + config.objective.field_weight * measured, metrics | terms


TOUCHED = 1e-3  # of the gel's modulus: a pressure that counts as contact
# of modulus times width squared, some 0.05 N: smaller forces have no meaningful ratio
LEAST_FORCE = 1e-3


def field_terms(params: Params, batch: FieldBatch, *, net: Net) -> tuple[Array, Metrics]:
    """Return the loss of predicted fields and force, and errors in contact. Not in the paper.

    Every error has a predicted Laplace deviation (Kendall and Gal 2017, "What uncertainties do we
    need"). Pixels in contact weigh as much as all others together. `batch` has normalised pixels
    and drawn sensor rows.
    """
    batch = _arrays(batch)
    out = net.measure(params, batch.clip, batch.sensor, batch.aspect)
    touched = (batch.pressure > TOUCHED).astype(jnp.float32)
    share = losses.mean(touched)
    weight = 0.5 * touched / jnp.maximum(share, 1e-2) + 0.5 * (1 - touched) / jnp.maximum(
        1 - share, 1e-2
    )

    def over_pixels(values: Array) -> Array:
        return losses.mean(weight * values)

    depth = (out.depth - batch.depth) / LENGTH
    shear = (out.shear - batch.shear) / LENGTH
    slopes = losses.mean(jnp.abs(jnp.diff(depth, axis=1))) + losses.mean(
        jnp.abs(jnp.diff(depth, axis=2))
    )
    pressure = jnp.abs(out.pressure - batch.pressure) / STRESS
    ratio = jnp.log((out.force[:, 2] + LEAST_FORCE) / (batch.force[:, 2] + LEAST_FORCE))
    sideways = (out.force[:, :2] - batch.force[:, :2]) / FORCE
    pressed = (jnp.max(touched, (1, 2)) > 0).astype(jnp.float32)
    # none without contact
    slip = jnp.where(pressed > 0, jax.nn.sigmoid(out.slip) - batch.slip, 0.0)
    terms = {
        "depth": over_pixels(losses.laplace_loss(depth, out.depth_log)),
        "slopes": slopes,
        "shear": over_pixels(jnp.mean(losses.laplace_loss(shear, out.shear_log[..., None]), -1)),
        "contact": 2
        * losses.mean(losses.binary_loss(out.contact, touched)),  # unweighted: it is a probability
        "pressure": over_pixels(pressure),
        "normal": losses.mean(losses.laplace_loss(ratio, out.force_log[:, 1])),
        "tangential": losses.mean(losses.laplace_loss(sideways, out.force_log[:, :1])),
        "torque": losses.mean(
            losses.laplace_loss((out.torque - batch.torque) / TORQUE, out.torque_log)
        ),
        "slip": losses.mean(losses.laplace_loss(slip, out.slip_log)),
    }
    seen = (out.contact > 0).astype(jnp.float32)
    both = jnp.sum(seen * touched)
    either = jnp.sum(jnp.maximum(seen, touched))
    metrics = {f"field_{name}": value for name, value in terms.items()} | {
        "contact_iou": both / jnp.maximum(either, 1),
        "depth_error": LENGTH
        * jnp.sum(jnp.abs(depth) * touched)
        / jnp.maximum(jnp.sum(touched), 1),
        "force_error": jnp.sum(jnp.abs(ratio) * pressed) / jnp.maximum(jnp.sum(pressed), 1),
    }
    return jnp.sum(jnp.stack(list(terms.values()))), metrics


def trained_by(batch: TouchBatch | Stage2Batch, *, config: Config) -> tuple[tuple[str, bool], ...]:
    """Return rules (regex over parameter names, trained?) for a batch of `stage1_loss` or
    `stage2_loss`.

    The first match decides. A parameter that is not trained has no gradient, and PyTorch's
    optimiser skips it.
    """
    batch = _arrays(batch)
    align, match = (None, None) if isinstance(batch, TouchBatch) else batch[:2]
    pixels = (
        batch if isinstance(batch, TouchBatch) else align if config.recipe == "release" else None
    )
    frames = 0 if pixels is None else pixels.clip.shape[1]
    has_image = align is not None and align.image.shape[0] > 0
    has_text = align is not None and align.text.shape[0] > 0
    cosine = config.model.match_head == "cosine"
    embeds = has_image or has_text or match is not None
    return (
        ("^touch/post_norm/", embeds),
        ("^touch/", embeds or frames > 0 or batch.fields is not None),
        ("^fields/", batch.fields is not None),
        ("^decoder/still_head/", frames == 1),
        ("^decoder/clip_head/", frames > 1),
        ("^decoder/", frames > 0),
        ("^(image|lora)/", has_image),
        ("^text/", has_text),
        ("^logit_scale$", has_image or has_text or (match is not None and cosine)),
        ("^matcher/", match is not None and not cosine),
        ("", True),
    )


class Embeddings(NamedTuple):
    """Unit-norm embeddings of a batch: touch (B, E); image, text (B, E) with rows that may be
    absent, or None.
    """

    touch: Array
    image: Array | None
    text: Array | None
    has_image: Array | None
    has_text: Array | None


def touch_embeddings(
    params: Params,
    touches: Sequence[tuple[Array, Array]],
    *,
    net: Net,
    keep_ids: Array | None = None,
) -> list[Array]:
    """Return unit-norm embeddings (B, E) of several batches of (clip (B, T, H, W, 3) float, sensor
    i32 (B,)).

    Batches of one shape share a pass of the encoder: one stack to compile and larger products.
    Their rows are interleaved, so that each row stays on its device. `keep_ids` (M, B, K): patches
    to keep of M batches.
    """
    touches = [_arrays(touch) for touch in touches]
    z: list[Array] = [jnp.zeros(0)] * len(touches)
    for shape in {clip.shape: None for clip, _ in touches}:
        members = [i for i, (clip, _) in enumerate(touches) if clip.shape == shape]
        clips, sensors = (
            jnp.stack(part, axis=1) for part in zip(*(touches[i] for i in members), strict=True)
        )
        rows = clips.reshape(-1, *shape[1:]), sensors.reshape(-1)
        if keep_ids is None:
            flat = net.encode_touch(params, *rows)
        else:
            ids = jnp.stack([keep_ids[i] for i in members], axis=1)
            flat = net.encode_touch(params, *rows, keep_ids=ids.reshape(-1, ids.shape[-1]))
        each = losses.normalise(flat).reshape(shape[0], len(members), flat.shape[1])
        for j, i in enumerate(members):
            z[i] = each[:, j]
    return z


def align_embeddings(params: Params, batch: AlignBatch, touch: Array, *, net: Net) -> Embeddings:
    """Return `touch` (B, E) and the embeddings of packed images and texts, scattered to the rows
    they belong to.

    A tower runs over its V or L slots only, and not at all without slots. Pixels are normalised
    floats. The content of an unused slot is replaced first: NaN would reach the gradients although
    the slot's value is dropped.
    """
    batch = _arrays(batch)
    (touch,) = _arrays((touch,))
    image = text = has_image = has_text = None
    if batch.image.shape[0]:
        used = (batch.image_row < len(touch))[:, None, None, None]
        packed = losses.normalise(net.encode_image(params, jnp.where(used, batch.image, 0.0)))
        image, has_image = _scatter(packed, batch.image_row, len(touch))
    if batch.text.shape[0]:
        used = (batch.text_row < len(touch))[:, None]
        ids = jnp.where(used, batch.text, 0)
        mask = batch.text_mask.astype(bool) | ~used
        packed = losses.normalise(net.encode_text(params, ids, mask))
        text, has_text = _scatter(packed, batch.text_row, len(touch))
    return Embeddings(touch, image, text, has_image, has_text)


def _scatter(packed: Array, row: Array, rows: int) -> tuple[Array, Array]:
    """Scatter slots (V, E) to their rows (B, E), and report which rows were filled.

    A slot of row B is dropped.
    """
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
    """Return L_align + lambda L_match (Eq. 9) and every term, unweighted.

    Pixels are normalised floats, sensor rows are already drawn. A part of `batch` that is None is
    not computed. The release recipe adds the stage-1 loss of the align batch, if `noise` (B, N) is
    given. `match_noise` (M, B, N) decides which patches the M touches of matching keep; None keeps
    all.
    """
    (align, match, _) = _arrays(batch)
    objective = config.objective
    total = jnp.zeros(())
    metrics = Metrics()
    aligned = [] if align is None else [(align.clip[:, : net.model.frames], align.sensor)]
    matched = (
        []
        if match is None
        else [(match.clip, match.sensor), (match.positive, match.positive_sensor)]
    )
    if (
        match is not None and net.model.match_head != "cosine"
    ):  # by cosine the other pairs are the negatives
        matched.append((match.negative, match.negative_sensor))
    if match_noise is None:
        z_touch = touch_embeddings(params, aligned + matched, net=net)
    else:
        visible = max(1, tokens.count_visible(net.model.patches, objective.match_keep))
        ids = jax.vmap(lambda noise: tokens.random_mask(noise, visible)[0])(match_noise)
        z_touch = touch_embeddings(params, aligned, net=net) + touch_embeddings(
            params, matched, net=net, keep_ids=ids
        )
    if align is not None:
        z = align_embeddings(params, align, z_touch.pop(0), net=net)
        scale = net.scale(params)
        loss, terms = losses.alignment_loss(
            *z,
            scale,
            config.pair_weights,
            groups=objective.groups,
            center=objective.center_embeddings,
        )
        total = total + loss
        metrics = metrics | terms | {"align": loss, "temperature": 1 / scale}
        if config.recipe == "release" and noise is not None:
            loss, terms = stage1_terms(
                params,
                align.clip,
                align.sensor,
                noise,
                net=net,
                config=config,
                decoder_sensor=decoder_sensor,
            )
            total = total + loss
            metrics = metrics | terms
    if match is not None:
        if net.model.match_head == "cosine":
            (first, second) = z_touch
            scale = net.scale(params)
            loss, right = losses.contrast_loss(
                first, second, scale, groups=objective.groups, place=match.place
            )
        else:
            z_anchor, *others = z_touch
            # Eq. 5
            positive, negative = (net.match(params, z_anchor, z) for z in others)
            loss = losses.matching_loss(positive, negative)
            right = jnp.mean(jnp.concatenate([positive > 0, negative < 0]).astype(jnp.float32))
        total = total + objective.match_weight * loss
        metrics = metrics | {"match": loss, "match_accuracy": right}
    return total, metrics


def stage2_loss(
    params: Params, batch: Stage2Batch, key: Array, progress: Array, *, net: Net, config: Config
) -> tuple[Array, Metrics]:
    """Return `stage2_terms` of a uint8 batch, with masks and sensor tokens drawn from `key`.

    `progress` f32 () in [0, 1] drives p_u (Eq. 7).
    """
    key_noise, key_align, key_match, key_keep = jax.random.split(key, 4)
    (align, match, fields) = _arrays(batch)
    patches = net.model.patches
    metrics = Metrics()
    noise = None
    own = None
    match_noise = None
    if align is not None:
        own = align.sensor
        noise = jax.random.uniform(key_noise, (len(own), patches))
        metrics["p_u"], sensor = _draw_tokens(own, key_align, progress, net, config)
        align = align._replace(
            clip=normalise_touch(align.clip), sensor=sensor, image=normalise_image(align.image)
        )
    if match is not None:
        metrics["p_u"], match = _draw_match(match, key_match, progress, net, config)
        if config.objective.match_keep < 1:
            touches = 2 if net.model.match_head == "cosine" else 3
            match_noise = jax.random.uniform(key_keep, (touches, len(match.sensor), patches))
    batch = Stage2Batch(align, match)
    loss, terms = stage2_terms(
        params, batch, noise, net=net, config=config, decoder_sensor=own, match_noise=match_noise
    )
    return _with_fields(params, fields, loss, terms | metrics, key, progress, net, config)


def _draw_tokens(
    sensor: Array, key: Array, progress: Array, net: Net, config: Config
) -> tuple[Array, Array]:
    """Return p_u at `progress`, and the sensor rows after one draw a sample (Eq. 7)."""
    objective = config.objective
    p_u = tokens.universal_probability(progress, objective.universal_start, objective.universal_end)
    uniform = jax.random.uniform(key, sensor.shape)
    return p_u, tokens.draw_tokens(sensor, uniform, p_u, net.model.universal_row)


def _draw_match(
    batch: MatchBatch, key: Array, progress: Array, net: Net, config: Config
) -> tuple[Array, MatchBatch]:
    """Return the matching pair or triple with normalised pixels and drawn tokens."""
    # The release shares one draw between anchor, positive and negative.
    keys = [key] * 3 if config.recipe == "release" else list(jax.random.split(key, 3))
    p_u, sensor = _draw_tokens(batch.sensor, keys[0], progress, net, config)
    _, positive = _draw_tokens(batch.positive_sensor, keys[1], progress, net, config)
    batch = batch._replace(clip=normalise_touch(batch.clip), sensor=sensor)
    batch = batch._replace(positive=normalise_touch(batch.positive), positive_sensor=positive)
    if batch.negative is not None and batch.negative_sensor is not None:
        _, negative = _draw_tokens(batch.negative_sensor, keys[2], progress, net, config)
        batch = batch._replace(negative=normalise_touch(batch.negative), negative_sensor=negative)
    return p_u, batch
