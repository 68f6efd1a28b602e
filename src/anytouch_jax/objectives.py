"""Training objectives of both stages: Eq. 8 (stage 1) and Eq. 9 (stage 2), over a network.

`*_terms` are deterministic: every random draw is an argument. The parity check runs them. `*_loss`
normalise the pixels, draw masks and sensor tokens from a key, then call the terms. Training runs
them. Arrays may be numpy's, lists or numbers.

Further terms are found by name in `doors.OBJECTIVES` and weighted by `objective.terms`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from anytouch_jax import doors
from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import CLIP_MEAN, CLIP_STD, IMAGENET_MEAN, IMAGENET_STD, Config
from anytouch_jax.errors import ConfigError
from anytouch_jax.nn.functional import Net
from anytouch_jax.ops import losses, tokens

Params = dict[str, Any]
Metrics = dict[str, Array]
Rules = tuple[tuple[str, bool], ...]
AnyBatch = TouchBatch | Stage2Batch
Batch = TypeVar("Batch", bound=tuple[Any, ...])


class Term(Protocol):
    """A further term of the loss: its unweighted value and metrics, or None without its data.

    It gets the batch of the step with uint8 pixels and the loader's sensor rows, and a key of its
    own. `progress` f32 () in [0, 1] is the part of the run that is done.
    """

    def __call__(
        self,
        params: Params,
        batch: AnyBatch,
        key: Array,
        progress: Array,
        *,
        net: Net,
        config: Config,
    ) -> tuple[Array, Metrics] | None: ...


class Objective(NamedTuple):
    """A row of `doors.OBJECTIVES`: a term of the loss, and the parameters that it trains.

    `trains(batch)` returns regexes over parameter names. A parameter that neither they nor the
    stage name is skipped by the optimiser, even where it has a gradient.
    """

    term: Term
    trains: Callable[[AnyBatch], tuple[str, ...]]


def find_objective(name: str) -> Objective:
    """Return the objective of a name in `doors.OBJECTIVES`. Raises ConfigError."""
    if name not in doors.OBJECTIVES:
        known = ", ".join(doors.OBJECTIVES)
        raise ConfigError(
            f"--objective.terms names {name!r}, which is no objective. Choose one of {known}."
        )
    objective: Objective = doors.enter(doors.OBJECTIVES[name])
    return objective


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
    """Return uint8 RGB touch images (..., 3) as float32, normalised by ImageNet's statistics.

    The statistics are the release's choice.
    """
    return _normalise(clip, IMAGENET_MEAN, IMAGENET_STD)


def normalise_image(image: Array) -> Array:
    """Return uint8 RGB RGB images (..., 3) as float32, normalised by CLIP's statistics."""
    return _normalise(image, CLIP_MEAN, CLIP_STD)


def _normalise(pixels: Array, mean: tuple[float, ...], std: tuple[float, ...]) -> Array:
    pixels = jnp.asarray(pixels)
    shape = (1,) * (pixels.ndim - 1) + (3,)
    centred = pixels.astype(jnp.float32) / 255.0 - jnp.asarray(mean).reshape(shape)
    return centred / jnp.asarray(std).reshape(shape)


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
    """Return the loss of stage 1: masked reconstruction and, for clips, the next frame (Eq. 8).

    Args:
        params: Parameters of `net`.
        clip: Normalised pixels, float (B, T, H, W, 3). T is 1 for a still, 3 for a clip, 4 for a
            clip and its next frame.
        sensor: Rows of the token table, i32 (B,), already drawn.
        noise: Numbers (B, N) whose order decides which patches are masked.
        net: The network.
        config: Its `objective` decides masking ratio, targets and terms.
        decoder_sensor: Rows i32 (B,) of the tokens that the decoder of the release gets.

    Returns:
        The loss and its terms, float32 scalars.
    """
    clip, sensor, noise = _arrays((clip, sensor, noise))
    if not config.objective.next_frame:
        clip = clip[:, : net.model.frames]
    pixels, hidden = reconstruct(
        params, clip, sensor, noise, net=net, config=config, decoder_sensor=decoder_sensor
    )
    target = _targets(clip, net, config)
    has_next = clip.shape[1] > net.model.frames
    return losses.reconstruction_loss(pixels, target, hidden, next_frame=has_next)


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
    """Predict every patch of clips from the visible ones.

    The encoder sees the first three frames only, whatever T is: the next frame is never an input.

    Args:
        params: Parameters of `net`.
        clip: Normalised pixels, float (B, T, H, W, 3), see `stage1_terms`.
        sensor: Rows of the token table, i32 (B,).
        noise: Numbers (B, N) whose order decides which patches are masked.
        net: The network.
        config: Its `objective` decides how many patches stay visible.
        decoder_sensor: Rows i32 (B,) of the tokens that the decoder of the release gets.

    Returns:
        Predicted patches (B, N, T, P*P*3), and `hidden` bool (B, N).
    """
    clip, sensor, noise, decoder_sensor = _arrays((clip, sensor, noise, decoder_sensor))
    visible = tokens.count_visible(net.model.patches, config.objective.keep_ratio)
    keep_ids, restore_ids, hidden = tokens.random_mask(noise, visible)
    past = clip[:, : net.model.frames]
    pixels = net.reconstruct(
        params, past, sensor, keep_ids, restore_ids, clip.shape[1], decoder_sensor
    )
    has_next = clip.shape[1] > net.model.frames
    if has_next and config.objective.next_frame_residual:
        pixels = _added_to_last(pixels, _targets(past[:, -1:], net, config))
    return pixels, hidden


def _targets(clip: Array, net: Net, config: Config) -> Array:
    """Return what is predicted of normalised clips (B, T, H, W, 3): patches (B, N, T, P*P*3)."""
    target = tokens.patchify(clip, net.model.patch)
    if config.objective.norm_pix_loss:
        return losses.normalise_patches(target)
    return target


def _added_to_last(pixels: Array, last: Array) -> Array:
    """Add the last input frame (B, N, 1, C) to the prediction of the next one. Not in the paper.

    Most of a gel does not change between two frames. So copying the last frame is hard to beat for
    a network that must paint every pixel anew, and easy for one that predicts the difference.
    """
    change = pixels[:, :, -1:]
    whole = last + change
    return jnp.concatenate([pixels[:, :, :-1].astype(whole.dtype), whole], axis=2)


def stage1_loss(
    params: Params, batch: TouchBatch, key: Array, progress: Array, *, net: Net, config: Config
) -> tuple[Array, Metrics]:
    """Return `stage1_terms` of a uint8 batch, with masks and sensor tokens drawn from `key`.

    Args:
        params: Parameters of `net`.
        batch: Clips u8 (B, T, H, W, 3) with the loader's sensor rows.
        key: Of the step. Masks and sensor tokens are drawn from it.
        progress: The part of the run that is done, f32 () in [0, 1], which drives p_u (Eq. 7).
        net: The network.
        config: Its `objective` has weights and choices.

    Returns:
        The loss, and its terms unweighted, float32 scalars.
    """
    batch = _arrays(batch)
    key_noise, key_universal = jax.random.split(key)
    noise = jax.random.uniform(key_noise, (len(batch.sensor), net.model.patches))
    p_u, sensor = draw_sensor_rows(batch.sensor, key_universal, progress, net=net, config=config)
    clip = normalise_touch(batch.clip)
    loss, metrics = stage1_terms(
        params, clip, sensor, noise, net=net, config=config, decoder_sensor=batch.sensor
    )
    metrics = metrics | {"p_u": p_u}
    return _with_terms((loss, metrics), params, batch, key, progress, net=net, config=config)


def _with_terms(
    stage: tuple[Array, Metrics],
    params: Params,
    batch: AnyBatch,
    key: Array,
    progress: Array,
    *,
    net: Net,
    config: Config,
) -> tuple[Array, Metrics]:
    """Add the further terms of the loss that the batch has data for to those of a stage."""
    loss, metrics = stage
    for number, name, weight in _terms_of(batch, config):
        # The losses of the stages split the key of the step. Folding numbers into it gives other
        # streams, so a further term changes no draw of theirs.
        own_key = jax.random.fold_in(key, number)
        term = find_objective(name).term
        result = term(params, batch, own_key, progress, net=net, config=config)
        if result is None:
            continue
        value, more = result
        if twice := metrics.keys() & more.keys():
            raise ConfigError(f"the objective {name} gives {min(twice)} a second time; rename it")
        loss = loss + weight * value
        metrics = metrics | more
    return loss, metrics


def _terms_of(batch: AnyBatch, config: Config) -> list[tuple[int, str, float]]:
    """Return number, name and weight of the further terms that a batch may have."""
    numbered = []
    if batch.fields is not None:
        # Number 1 even beside others: runs of earlier versions drew with it.
        numbered.append((1, "fields", config.objective.field_weight))
    for number, (name, weight) in enumerate(config.objective.terms, start=2):
        numbered.append((number, name, weight))
    return numbered


def trained_by(batch: AnyBatch, *, config: Config) -> Rules:
    """Return which parameters a batch of `stage1_loss` or `stage2_loss` trains.

    The rules are (regex over parameter names, trained?), and the first match decides. A parameter
    that is not trained has no gradient, and PyTorch's optimiser skips it.
    """
    batch = _arrays(batch)
    stage = _trained_by_stage(batch, config)
    added: list[tuple[str, bool]] = []
    for _, name, _ in _terms_of(batch, config):
        added += [(pattern, True) for pattern in find_objective(name).trains(batch)]
    return (*added, *stage, ("", True))


def _trained_by_stage(batch: AnyBatch, config: Config) -> Rules:
    """Return the rules of `trained_by` without further terms."""
    align: AlignBatch | None = None
    match: MatchBatch | None = None
    frames = 0  # of the touches whose pixels are reconstructed
    if isinstance(batch, TouchBatch):
        frames = batch.clip.shape[1]
    else:
        align = batch.align
        match = batch.match
        # The release keeps the loss of stage 1 on the align batch.
        if align is not None and config.recipe == "release":
            frames = align.clip.shape[1]
    has_image = align is not None and align.image.shape[0] > 0
    has_text = align is not None and align.text.shape[0] > 0
    has_match = match is not None
    cosine = config.model.match_head == "cosine"
    embeds = has_image or has_text or has_match
    return (
        # The decoder reads states before the norm, so stage 1 does not train it.
        ("^touch/post_norm/", embeds),
        ("^touch/", embeds or frames > 0),
        ("^decoder/still_head/", frames == 1),
        ("^decoder/clip_head/", frames > 1),
        ("^decoder/", frames > 0),
        ("^(image|lora)/", has_image),
        ("^text/", has_text),
        ("^logit_scale$", has_image or has_text or (has_match and cosine)),
        ("^matcher/", has_match and not cosine),
        # A head learns by a further term alone.
        ("^fields/", False),
    )


class Embeddings(NamedTuple):
    """Unit-norm embeddings of a batch, each (B, E), and which rows have an image or a text.

    A modality that the whole batch lacks is None.
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
    """Return unit-norm embeddings (B, E) of several batches of touches.

    Batches of one shape share a pass of the encoder: one stack to compile and larger products.

    Args:
        params: Parameters of `net`.
        touches: M batches of (clip float (B, T, H, W, 3), sensor rows i32 (B,)).
        net: The network.
        keep_ids: Patches to keep (M, B, K), or None for all.
    """
    touches = [_arrays(touch) for touch in touches]
    z: list[Array] = [jnp.zeros(0)] * len(touches)
    shapes = list(dict.fromkeys(clip.shape for clip, _ in touches))
    for shape in shapes:
        members = [i for i, (clip, _) in enumerate(touches) if clip.shape == shape]
        # Rows are interleaved, not appended: the batch is sharded by rows, and so each row stays
        # on its device.
        clips = jnp.stack([touches[i][0] for i in members], axis=1)
        sensors = jnp.stack([touches[i][1] for i in members], axis=1)
        clip_rows = clips.reshape(-1, *shape[1:])
        sensor_rows = sensors.reshape(-1)
        if keep_ids is None:
            flat = net.encode_touch(params, clip_rows, sensor_rows)
        else:
            ids = jnp.stack([keep_ids[i] for i in members], axis=1)
            kept = ids.reshape(-1, ids.shape[-1])
            flat = net.encode_touch(params, clip_rows, sensor_rows, keep_ids=kept)
        each = losses.normalise(flat).reshape(shape[0], len(members), flat.shape[1])
        for j, i in enumerate(members):
            z[i] = each[:, j]
    return z


def align_embeddings(params: Params, batch: AlignBatch, touch: Array, *, net: Net) -> Embeddings:
    """Return `touch` (B, E) and the embeddings of packed images and texts, scattered to their rows.

    A tower runs over its V or L slots only, and not at all without slots. Pixels are normalised
    floats.

    Args:
        params: Of the network.
        batch: With its packed images (V, H, W, 3) and texts (L, tokens).
        touch: Unit-norm embeddings (B, E).
        net: The network.
    """
    batch = _arrays(batch)
    (touch,) = _arrays((touch,))
    image = text = has_image = has_text = None
    # An unused slot may hold garbage. Its value is dropped, but NaN would reach the gradients
    # (0 * NaN is NaN), so its content is replaced before the tower.
    if batch.image.shape[0]:
        used = (batch.image_row < len(touch))[:, None, None, None]
        pixels = jnp.where(used, batch.image, 0.0)
        packed = losses.normalise(net.encode_image(params, pixels))
        image, has_image = _scatter(packed, batch.image_row, len(touch))
    if batch.text.shape[0]:
        used = (batch.text_row < len(touch))[:, None]
        ids = jnp.where(used, batch.text, 0)
        # A text without a readable token would have a softmax over nothing.
        mask = batch.text_mask.astype(bool) | ~used
        packed = losses.normalise(net.encode_text(params, ids, mask))
        text, has_text = _scatter(packed, batch.text_row, len(touch))
    return Embeddings(touch, image, text, has_image, has_text)


def _scatter(packed: Array, row: Array, rows: int) -> tuple[Array, Array]:
    """Scatter slots (V, E) to their rows (B, E), and report which rows were filled."""
    # An unused slot has row B, which mode="drop" leaves out. A row of -1 would count from the end
    # and overwrite the last sample.
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

    A part of `batch` that is None is not computed.

    Args:
        params: Parameters of `net`.
        batch: Normalised floats, with sensor rows already drawn.
        noise: Numbers (B, N) that mask the align batch: with them the release recipe adds the loss
            of stage 1. None leaves it out.
        net: The network.
        config: Its `objective` has the weights.
        decoder_sensor: Rows i32 (B,) of the tokens that the decoder of the release gets.
        match_noise: Numbers (M, B, N) that decide which patches the M touches of matching keep.
            None keeps all.
    """
    align, match, _ = _arrays(batch)
    total = jnp.zeros(())
    metrics = Metrics()
    z_align, z_match = _stage2_embeddings(params, align, match, match_noise, net, config)
    if align is not None:
        loss, terms = _alignment(params, align, z_align[0], net, config)
        total = total + loss
        metrics = metrics | terms
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
        loss, accuracy = _matching(params, match, z_match, net, config)
        total = total + config.objective.match_weight * loss
        metrics = metrics | {"match": loss, "match_accuracy": accuracy}
    return total, metrics


def _stage2_embeddings(
    params: Params,
    align: AlignBatch | None,
    match: MatchBatch | None,
    match_noise: Array | None,
    net: Net,
    config: Config,
) -> tuple[list[Array], list[Array]]:
    """Return the touch embeddings (B, E) of the align batch (one or none) and of matching."""
    aligned: list[tuple[Array, Array]] = []
    if align is not None:
        aligned.append((align.clip[:, : net.model.frames], align.sensor))
    matched: list[tuple[Array, Array]] = []
    if match is not None:
        matched.append((match.clip, match.sensor))
        matched.append((match.positive, match.positive_sensor))
        # By cosine the other pairs of the batch are the negatives.
        if net.model.match_head != "cosine":
            assert match.negative is not None and match.negative_sensor is not None
            matched.append((match.negative, match.negative_sensor))
    if match_noise is None:
        z = touch_embeddings(params, aligned + matched, net=net)
        return z[: len(aligned)], z[len(aligned) :]
    # At least one patch: a mean over none would be NaN.
    visible = max(1, tokens.count_visible(net.model.patches, config.objective.match_keep))
    ids = jax.vmap(lambda noise: tokens.random_mask(noise, visible)[0])(match_noise)
    z_align = touch_embeddings(params, aligned, net=net)
    return z_align, touch_embeddings(params, matched, net=net, keep_ids=ids)


def _alignment(
    params: Params, align: AlignBatch, z_touch: Array, net: Net, config: Config
) -> tuple[Array, Metrics]:
    """Return L_align (Eq. 4) of a batch and its terms."""
    z = align_embeddings(params, align, z_touch, net=net)
    scale = net.scale(params)
    loss, terms = losses.alignment_loss(
        *z,
        scale,
        config.pair_weights,
        groups=config.objective.groups,
        center=config.objective.center_embeddings,
    )
    return loss, terms | {"align": loss, "temperature": 1 / scale}


def _matching(
    params: Params, match: MatchBatch, z_touch: list[Array], net: Net, config: Config
) -> tuple[Array, Array]:
    """Return L_match (Eq. 6), or its contrast by cosine, and the ratio of right answers."""
    if net.model.match_head == "cosine":
        first, second = z_touch
        scale = net.scale(params)
        groups = config.objective.groups
        return losses.contrast_loss(first, second, scale, groups=groups, place=match.place)
    z_anchor, z_positive, z_negative = z_touch
    # Eq. 5: logits of the same place and of another one.
    positive = net.match(params, z_anchor, z_positive)
    negative = net.match(params, z_anchor, z_negative)
    right = jnp.concatenate([positive > 0, negative < 0])
    return losses.matching_loss(positive, negative), jnp.mean(right.astype(jnp.float32))


def stage2_loss(
    params: Params, batch: Stage2Batch, key: Array, progress: Array, *, net: Net, config: Config
) -> tuple[Array, Metrics]:
    """Return `stage2_terms` of a uint8 batch, with masks and sensor tokens drawn from `key`.

    Args:
        params: Parameters of `net`.
        batch: Pixels u8 with the loader's sensor rows.
        key: Of the step. Masks and sensor tokens are drawn from it.
        progress: The part of the run that is done, f32 () in [0, 1], which drives p_u (Eq. 7).
        net: The network.
        config: Its `objective` has weights and choices.

    Returns:
        The loss, and its terms unweighted, float32 scalars.
    """
    key_noise, key_align, key_match, key_keep = jax.random.split(key, 4)
    batch = _arrays(batch)
    align = batch.align
    match = batch.match
    patches = net.model.patches
    metrics = Metrics()
    noise = None
    own = None
    match_noise = None
    if align is not None:
        own = align.sensor
        noise = jax.random.uniform(key_noise, (len(own), patches))
        metrics["p_u"], sensor = draw_sensor_rows(own, key_align, progress, net=net, config=config)
        align = align._replace(
            clip=normalise_touch(align.clip), sensor=sensor, image=normalise_image(align.image)
        )
    if match is not None:
        metrics["p_u"], match = _draw_match(match, key_match, progress, net, config)
        if config.objective.match_keep < 1:
            touches = 2 if net.model.match_head == "cosine" else 3
            match_noise = jax.random.uniform(key_keep, (touches, len(match.sensor), patches))
    loss, terms = stage2_terms(
        params,
        Stage2Batch(align, match),
        noise,
        net=net,
        config=config,
        decoder_sensor=own,
        match_noise=match_noise,
    )
    stage = (loss, terms | metrics)
    return _with_terms(stage, params, batch, key, progress, net=net, config=config)


def draw_sensor_rows(
    sensor: Array, key: Array, progress: Array, *, net: Net, config: Config
) -> tuple[Array, Array]:
    """Return p_u at `progress`, and the sensor rows i32 (B,) after one draw a sample (Eq. 7).

    Args:
        sensor: The loader's rows of the token table, i32 (B,).
        key: Of this draw.
        progress: The part of the run that is done, f32 () in [0, 1].
        net: Its model names the universal row.
        config: Its `objective` has p_u at the first and the last step.
    """
    objective = config.objective
    p_u = tokens.universal_probability(progress, objective.universal_start, objective.universal_end)
    uniform = jax.random.uniform(key, sensor.shape)
    return p_u, tokens.draw_tokens(sensor, uniform, p_u, net.model.universal_row)


def _draw_match(
    batch: MatchBatch, key: Array, progress: Array, net: Net, config: Config
) -> tuple[Array, MatchBatch]:
    """Return the matching pair or triple with normalised pixels and drawn tokens."""
    if config.recipe == "release":
        # The release shares one draw between anchor, positive and negative.
        keys = [key] * 3
    else:
        keys = list(jax.random.split(key, 3))

    def drawn(sensor: Array, number: int) -> tuple[Array, Array]:
        return draw_sensor_rows(sensor, keys[number], progress, net=net, config=config)

    p_u, sensor = drawn(batch.sensor, 0)
    _, positive = drawn(batch.positive_sensor, 1)
    batch = batch._replace(clip=normalise_touch(batch.clip), sensor=sensor)
    batch = batch._replace(positive=normalise_touch(batch.positive), positive_sensor=positive)
    if batch.negative is not None and batch.negative_sensor is not None:
        _, negative = drawn(batch.negative_sensor, 2)
        batch = batch._replace(negative=normalise_touch(batch.negative), negative_sensor=negative)
    return p_u, batch
