"""Losses of the paper as pure functions. All arithmetic is in float32 or wider, whatever the inputs are.

B batch, N positions, T frames, C values of a patch, E embedding width.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

Metrics = dict[str, Array]


def _wide(x: Array) -> Array:
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


def normalise(x: Array, eps: float = 1e-12) -> Array:
    """Divide the last axis by its length, or by `eps` if that is larger, as torch's `normalize`.

    A power of two, which changes no digit, brings `x` to order one before it is squared: a length of 1e-7 or 1e20 is
    right too. The gradient at zero is 1 / eps.
    """
    x = _wide(x)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=-1, keepdims=True, initial=eps))
    scale = jnp.ldexp(jnp.ones_like(largest), jnp.clip(-jnp.frexp(largest)[1], -126, 126))
    x, least = x * scale, eps * scale
    return x * jax.lax.rsqrt(jnp.maximum(jnp.sum(x * x, axis=-1, keepdims=True), least * least))


def normalise_patches(patches: Array) -> Array:
    """Bring each patch (..., C) to zero mean and unit *unbiased* variance (`norm_pix_loss`, golden Q6)."""
    patches = _wide(patches)
    centred = patches - jnp.mean(patches, axis=-1, keepdims=True)
    variance = jnp.sum(centred * centred, axis=-1, keepdims=True) / max(patches.shape[-1] - 1, 1)
    return centred * jax.lax.rsqrt(variance + 1e-6)


def reconstruction_loss(pred: Array, target: Array, hidden: Array, *, next_frame: bool) -> tuple[Array, Metrics]:
    """Return the loss of masked reconstruction and next-frame prediction (Eq. 1, 2), summed as in Eq. 8.

    `pred`, `target` (B, N, T, C); `hidden` (B, N) True on masked positions. With `next_frame` the last of the T
    frames is the future one: it counts on every position, the others on the hidden positions only.
    Returns the sum and {"reconstruction", "next_frame"}. A batch with nothing hidden has a reconstruction loss of 0.
    """
    error = jnp.mean((_wide(pred) - _wide(target)) ** 2, axis=-1)  # (B, N, T)
    present, future = (error[..., :-1], error[..., -1]) if next_frame else (error, None)
    weight = hidden.astype(error.dtype)
    loss = jnp.sum(jnp.mean(present, axis=-1) * weight) / jnp.maximum(jnp.sum(weight), 1)
    metrics = {"reconstruction": loss}
    if future is not None:
        metrics["next_frame"] = jnp.mean(future)
        loss = loss + metrics["next_frame"]
    return loss, metrics


def info_nce(a: Array, b: Array, scale: Array, present: Array, *, groups: int = 1, place: Array | None = None) -> Array:
    """Return InfoNCE from `a` to `b` (B, E) over the rows that are `present` (B,) in both (Eq. 3), a scalar.

    `scale` is 1 / tau. Absent rows are neither anchors nor negatives and may hold garbage; fewer than one pair
    gives 0. With `groups` > 1 the batch is cut in that many shares, as by the devices of the release. Negatives come
    from a row's share, and the mean is over all shares. Rows of one `place` i32 (B,) are no negatives of each other.
    """
    e = a.shape[-1]
    present = present.reshape(groups, -1)
    a = jnp.where(present[..., None], _wide(a).reshape(groups, -1, e), 0.0)
    b = jnp.where(present[..., None], _wide(b).reshape(groups, -1, e), 0.0)
    # The factor is up to 100: the reduced precision that accelerators use by default would show in the loss.
    logits = _wide(scale) * jnp.einsum("gie,gje->gij", a, b, precision=jax.lax.Precision.HIGHEST)
    rivals = present[:, None, :]
    if place is not None:
        place = place.reshape(groups, -1)
        rivals = rivals & ((place[:, :, None] != place[:, None, :]) | jnp.eye(place.shape[1], dtype=bool)[None])
    logits = jnp.where(rivals, logits, jnp.finfo(logits.dtype).min)
    own = jnp.diagonal(logits, axis1=1, axis2=2)
    loss = jnp.where(present, jax.nn.logsumexp(logits, axis=-1) - own, 0.0)
    pairs = jnp.sum(present, axis=1)
    return jnp.mean(jnp.sum(loss, axis=1) / jnp.maximum(pairs, 1))


def centered(x: Array, present: Array) -> Array:
    """Return unit vectors (B, E): `x` minus its mean over the rows that are `present` (B,), scaled to length 1."""
    x = jnp.where(present[:, None], _wide(x), 0.0)
    mean = jnp.sum(x, axis=0, keepdims=True) / jnp.maximum(jnp.sum(present), 1)
    return normalise(jnp.where(present[:, None], x - mean, 0.0), eps=1e-3)  # a smaller spread is rounding


def alignment_loss(
    touch: Array,
    image: Array | None,
    text: Array | None,
    has_image: Array | None,
    has_text: Array | None,
    scale: Array,
    weights: tuple[float, float, float],
    *,
    groups: int = 1,
    center: bool = False,
) -> tuple[Array, Metrics]:
    """Return the loss of joint alignment of touch, vision and text with missing modalities (Eq. 4).

    `touch`, `image`, `text` (B, E) of unit length; `has_image`, `has_text` (B,) bool; `weights` are the factors of
    the pairs (touch-vision, touch-text, vision-text) on the sum of both directions. A modality that is None is
    absent from the whole batch. `center` subtracts each modality's batch mean first. Untrained towers share one large
    direction, and without this the loss falls by growing it until all embeddings are equal. Returns the loss, its six
    terms and the number of pairs of each kind.
    """
    everyone = jnp.ones(touch.shape[0], bool)
    z = {"touch": (touch, everyone)}
    if image is not None:
        z["vision"] = (image, everyone if has_image is None else has_image)
    if text is not None:
        z["text"] = (text, everyone if has_text is None else has_text)
    if center:
        z = {name: (centered(x, has), has) for name, (x, has) in z.items()}
    total = jnp.zeros((), jnp.promote_types(touch.dtype, jnp.float32))
    metrics: Metrics = {}
    pairs = (("touch", "vision"), ("touch", "text"), ("vision", "text"))
    for (first, second), weight in zip(pairs, weights, strict=True):
        if first not in z or second not in z:
            continue
        (a, has_a), (b, has_b) = z[first], z[second]
        both = has_a & has_b
        forth = info_nce(a, b, scale, both, groups=groups)
        back = info_nce(b, a, scale, both, groups=groups)
        total = total + weight * (forth + back)
        metrics |= {
            f"{first}_to_{second}": forth,
            f"{second}_to_{first}": back,
            f"{first}_{second}_pairs": jnp.sum(both),
        }
    return total, metrics


def contrast_loss(
    first: Array, second: Array, scale: Array, *, groups: int = 1, place: Array | None = None
) -> tuple[Array, Array]:
    """InfoNCE matching between the two unit-norm touches (B, E) of each pair. Not in the paper.

    All other places of the batch are negatives, up to 2 B - 2 for each pair instead of one. `place` i32 (B,) is equal
    for pairs of one place; None means that no two are. Returns the mean of both directions, and the share of `first`
    whose nearest `second` is of its place.
    """
    everyone = jnp.ones(first.shape[0], bool)
    forth = info_nce(first, second, scale, everyone, groups=groups, place=place)
    back = info_nce(second, first, scale, everyone, groups=groups, place=place)
    place = jnp.arange(first.shape[0]) if place is None else place
    right = place[jnp.argmax(_wide(first) @ _wide(second).T, axis=1)] == place
    return (forth + back) / 2, jnp.mean(right.astype(jnp.float32))


def matching_loss(positive_logit: Array, negative_logit: Array) -> Array:
    """Return the binary cross-entropy of matching from logits (B,), each kind averaged over the batch (Eq. 6)."""
    positive, negative = _wide(positive_logit), _wide(negative_logit)
    return jnp.mean(jax.nn.softplus(-positive)) + jnp.mean(jax.nn.softplus(negative))


def laplace_loss(error: Array, log_scale: Array) -> Array:
    """Return the negative log likelihood of errors under Laplace deviations exp(`log_scale`), element-wise.

    The logarithm is bent smoothly into -5..5, so that no deviation vanishes or explodes.
    """
    log_scale = 5.0 * jnp.tanh(_wide(log_scale) / 5.0)
    return jnp.abs(_wide(error)) * jnp.exp(-log_scale) + log_scale


def binary_loss(logit: Array, share: Array) -> Array:
    """Return the cross-entropy between logits and shares in 0..1, element-wise."""
    logit = _wide(logit)
    return jnp.maximum(logit, 0) - logit * share + jnp.log1p(jnp.exp(-jnp.abs(logit)))
