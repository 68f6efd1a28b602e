"""Losses of the paper as pure functions.

All arithmetic is in float32 or wider, whatever the inputs are.

B batch, N positions, T frames, C values of a patch, E embedding width. Arrays may be numpy's, lists
or numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

Metrics = dict[str, Array]
MOST_SCALE = 100.0  # 1 / tau, as CLIP (Radford et al., 2021, Sec. 2.5)


def _wide(*values: ArrayLike) -> list[Array]:
    """Return arrays of one float type: float64 if a value has it, else float32.

    So 16-bit embeddings have a loss of 32 bits. A Python number has no type of its own, although
    jnp.asarray gives it one.
    """
    arrays = [jnp.asarray(value) for value in values]
    pairs = zip(values, arrays, strict=True)
    is_double = any(x.dtype == jnp.float64 and not isinstance(value, float) for value, x in pairs)
    return [x.astype(jnp.float64 if is_double else jnp.float32) for x in arrays]


def mean(values: Array, count: Array | int | None = None) -> Array:
    """Return the sum of `values` over their number or `count`. That of nothing is 0."""
    if count is None:
        count = values.size
    return jnp.sum(values) / jnp.maximum(jnp.asarray(count, values.dtype), 1)


def row_sums(x: Array) -> Array:
    """Return the sums (..., 1) of x (..., N) over its last axis."""
    if jax.default_backend() != "cpu":
        return jnp.sum(x, axis=-1, keepdims=True)
    # On a CPU as a product with ones: XLA fuses what makes `x` into a product, but writes `x` to
    # memory for a sum. LayerNorm and the norms of gradients are bound by memory.
    rows = x.reshape(math.prod(x.shape[:-1]), x.shape[-1])
    sums = jnp.dot(rows, jnp.ones((x.shape[-1], 1), x.dtype), precision="highest")
    return sums.reshape(*x.shape[:-1], 1)


def _equal_shapes(**arrays: Array) -> None:
    """Raise ValueError for arrays of two shapes, which would be broadcast in silence."""
    if len({x.shape for x in arrays.values()}) > 1:
        shapes = [f"{name} {x.shape}" for name, x in arrays.items()]
        raise ValueError(f"{', '.join(shapes)} must have one shape")


def normalise(x: ArrayLike, eps: float = 1e-12) -> Array:
    """Divide vectors (..., E) by their Euclidean length, or by `eps` if that is larger.

    PyTorch's `normalize` does the same. The gradient at zero is 1 / eps, so it is finite.
    """
    (x,) = _wide(x)
    # Squares of 1e-20 or 1e20 leave the range of float32. A power of two, which changes no digit,
    # brings `x` to order one before it is squared.
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=-1, keepdims=True, initial=eps))
    scale = jnp.ldexp(jnp.ones_like(largest), jnp.clip(-jnp.frexp(largest)[1], -126, 126))
    x = x * scale
    least = eps * scale
    return x * jax.lax.rsqrt(jnp.maximum(jnp.sum(x * x, axis=-1, keepdims=True), least * least))


def normalise_patches(patches: ArrayLike) -> Array:
    """Bring each patch (..., C) to zero mean and unit variance (MAE's `norm_pix_loss`)."""
    (patches,) = _wide(patches)
    centred = patches - jnp.mean(patches, axis=-1, keepdims=True)
    # Divided by C - 1: torch's `var`, which MAE and the release use, is the unbiased one.
    variance = jnp.sum(centred * centred, axis=-1, keepdims=True) / max(patches.shape[-1] - 1, 1)
    return centred * jax.lax.rsqrt(variance + 1e-6)


def reconstruction_loss(
    pred: ArrayLike, target: ArrayLike, hidden: ArrayLike, *, next_frame: bool
) -> tuple[Array, Metrics]:
    """Return the loss of masked reconstruction (Eq. 1) and next frame (Eq. 2), summed as in Eq. 8.

    Args:
        pred: Predicted patches (B, N, T, C).
        target: True patches (B, N, T, C).
        hidden: True (B, N) on masked positions, which alone count. Without any the loss is 0.
        next_frame: Whether the last of the T frames is the future one, which counts on every
            position. What does not count may be garbage.

    Returns:
        The sum, and its terms "reconstruction" and "next_frame".

    Raises:
        ValueError: For shapes that do not fit, and for a next frame without another.
    """
    pred, target = _wide(pred, target)
    hidden = jnp.asarray(hidden, bool)
    _equal_shapes(pred=pred, target=target)
    if pred.ndim != 4 or hidden.shape != pred.shape[:2] or pred.shape[2] <= next_frame:
        wanted = "(B, N, T, C) with T of 2 or more" if next_frame else "(B, N, T, C)"
        raise ValueError(
            f"pred must be {wanted} and hidden (B, N), not {pred.shape} and {hidden.shape}"
        )
    frames = pred.shape[2] - next_frame
    is_future = jnp.arange(pred.shape[2]) >= frames
    counts = hidden[..., None] | is_future[None, None]  # (B, N, T)
    # The error is selected, not multiplied by the mask: 0 * NaN would be NaN.
    error = jnp.mean(jnp.where(counts[..., None], pred - target, 0.0) ** 2, axis=-1)
    loss = mean(jnp.mean(error[..., :frames], axis=-1), jnp.sum(hidden))
    metrics = {"reconstruction": loss}
    if next_frame:
        metrics["next_frame"] = mean(error[..., -1])
        loss = loss + metrics["next_frame"]
    return loss, metrics


def info_nce(
    a: ArrayLike,
    b: ArrayLike,
    scale: ArrayLike,
    present: ArrayLike,
    *,
    groups: int = 1,
    place: ArrayLike | None = None,
) -> Array:
    """Return InfoNCE from `a` to `b` over the rows that have both, a scalar (Eq. 3).

    Args:
        a: Unit-norm embeddings (B, E), the anchors.
        b: Unit-norm embeddings (B, E), of which a row's own is the positive.
        scale: 1 / tau, which counts as 100 beyond 100.
        present: Whether a row (B,) has both. Absent rows are neither anchors nor negatives and may
            hold garbage; fewer than one pair gives 0.
        groups: Parts of equal size that the batch is cut into, as by the devices of the release.
            Negatives come from a row's part, and the mean is over all parts.
        place: Numbers i32 (B,). Rows of one place are no negatives of each other.

    Raises:
        ValueError: For shapes that do not fit, and for groups of unequal size.
    """
    a, b, scale = _wide(a, b, scale)
    present = jnp.asarray(present, bool)
    _equal_shapes(a=a, b=b)
    if a.ndim != 2 or present.shape != a.shape[:1]:
        raise ValueError(
            f"a and b must be (B, E) and present (B,), not {a.shape} and {present.shape}"
        )
    rows, width = a.shape
    if groups < 1 or rows % groups:
        raise ValueError(f"{rows} rows cannot be cut into {groups} groups of equal size")
    # An infinite scale would give 0 * inf below.
    scale = jnp.minimum(scale, jnp.finfo(scale.dtype).max)
    # Clipped by a factor without gradient: a scale beyond the limit keeps its own, so that it can
    # fall again.
    scale = scale * jax.lax.stop_gradient(jnp.where(scale > MOST_SCALE, MOST_SCALE / scale, 1.0))
    present = present.reshape(groups, rows // groups)
    # Garbage in absent rows must not reach the products: a NaN there would reach every gradient.
    a = jnp.where(present[..., None], a.reshape(*present.shape, width), 0.0)
    b = jnp.where(present[..., None], b.reshape(*present.shape, width), 0.0)
    # The factor is up to 100: the reduced precision that accelerators use by default would show in
    # the loss.
    logits = scale * jnp.einsum("gie,gje->gij", a, b, precision=jax.lax.Precision.HIGHEST)
    # Which columns a row is compared with (groups, rows, columns): the negatives, and its own.
    negatives_mask = present[:, None, :]
    if place is not None:
        place = jnp.asarray(place).reshape(present.shape)
        elsewhere = place[:, :, None] != place[:, None, :]
        itself = jnp.eye(place.shape[1], dtype=bool)[None]
        negatives_mask = negatives_mask & (elsewhere | itself)
    # The lowest finite number, not -inf: the logsumexp of a row without anything would be
    # inf - inf, and its gradient NaN although the row does not count.
    logits = jnp.where(negatives_mask, logits, jnp.finfo(logits.dtype).min)
    own = jnp.diagonal(logits, axis1=1, axis2=2)
    loss = jnp.where(present, jax.nn.logsumexp(logits, axis=-1) - own, 0.0)
    pairs = jnp.sum(present, axis=1).astype(loss.dtype)
    return jnp.mean(jnp.sum(loss, axis=1) / jnp.maximum(pairs, 1))


def centered(x: ArrayLike, present: ArrayLike) -> Array:
    """Return unit vectors (B, E): `x` minus its mean over the `present` rows; others are 0.

    Not in the paper. A vector within 0.001 of the mean stays shorter than 1, because such a spread
    is rounding.
    """
    (x,) = _wide(x)
    present = jnp.asarray(present, bool)[:, None]
    x = jnp.where(present, x, 0.0)
    mean = jnp.sum(x, axis=0, keepdims=True) / jnp.maximum(jnp.sum(present).astype(x.dtype), 1)
    return normalise(jnp.where(present, x - mean, 0.0), eps=1e-3)


def alignment_loss(  # noqa: PLR0913  Eq. 4 has three modalities, two of which may be missing
    touch: ArrayLike,
    image: ArrayLike | None,
    text: ArrayLike | None,
    has_image: ArrayLike | None,
    has_text: ArrayLike | None,
    scale: ArrayLike,
    weights: Sequence[ArrayLike],
    *,
    groups: int = 1,
    center: bool = False,
) -> tuple[Array, Metrics]:
    """Return the loss of joint alignment of touch, vision and text (Eq. 4).

    Args:
        touch: Unit-norm embeddings (B, E).
        image: Unit-norm embeddings (B, E), or None if the whole batch lacks them.
        text: Unit-norm embeddings (B, E), or None.
        has_image: Which rows (B,) have an image. None: all.
        has_text: Which rows (B,) have a text. None: all.
        scale: 1 / tau.
        weights: Factors of touch-vision, touch-text and vision-text on the sum of both directions.
        groups: See `info_nce`.
        center: Subtract each modality's batch mean first. Untrained towers share one large
            direction, and without this the loss falls by growing it until all embeddings are equal.

    Returns:
        The loss, its six terms, and the number of pairs of each kind.

    Raises:
        ValueError: For shapes that do not fit.
    """
    everyone = jnp.ones(len(jnp.asarray(touch)), bool)
    given = {"touch": (touch, None), "vision": (image, has_image), "text": (text, has_text)}
    z: dict[str, tuple[Array, Array]] = {}
    for name, (x, has) in given.items():
        if x is None:
            continue
        has = everyone if has is None else jnp.asarray(has, bool)
        z[name] = (centered(x, has) if center else jnp.asarray(x), has)
    if len(weights) != 3:
        raise ValueError(
            "weights are three factors, of touch-vision, touch-text and vision-text, not "
            f"{len(weights)}"
        )
    scale, *weights = _wide(scale, *weights)
    total = jnp.zeros((), _wide(touch)[0].dtype)
    metrics = Metrics()
    pairs = (("touch", "vision"), ("touch", "text"), ("vision", "text"))
    for (first, second), weight in zip(pairs, weights, strict=True):
        if first not in z or second not in z:
            continue
        a, has_a = z[first]
        b, has_b = z[second]
        both = has_a & has_b
        forth = info_nce(a, b, scale, both, groups=groups)
        back = info_nce(b, a, scale, both, groups=groups)
        total = total + weight.astype(forth.dtype) * (forth + back)
        metrics |= {
            f"{first}_to_{second}": forth,
            f"{second}_to_{first}": back,
            f"{first}_{second}_pairs": jnp.sum(both),
        }
    return total, metrics


def contrast_loss(
    first: ArrayLike,
    second: ArrayLike,
    scale: ArrayLike,
    *,
    groups: int = 1,
    place: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Return InfoNCE between the two touches of each pair. Not in the paper.

    All other places of the batch are negatives, up to 2 B - 2 for each pair instead of one.

    Args:
        first: Unit-norm embeddings (B, E).
        second: Unit-norm embeddings (B, E) of touches of the same places.
        scale: 1 / tau.
        groups: See `info_nce`.
        place: Numbers i32 (B,), equal for pairs of one place. None: no two are.

    Returns:
        The mean of both directions, and the ratio of `first` whose nearest `second` is of its
        place.

    Raises:
        ValueError: As `info_nce`.
    """
    first, second, scale = _wide(first, second, scale)
    everyone = jnp.ones(len(first), bool)
    forth = info_nce(first, second, scale, everyone, groups=groups, place=place)
    back = info_nce(second, first, scale, everyone, groups=groups, place=place)
    place = jnp.arange(len(first)) if place is None else jnp.asarray(place)
    # there is no largest of nothing
    nearest = jnp.argmax(first @ second.T, axis=1) if len(first) else place
    return (forth + back) / 2, mean((place[nearest] == place).astype(jnp.float32))


def matching_loss(positive_logit: ArrayLike, negative_logit: ArrayLike) -> Array:
    """Return the binary cross-entropy of matching from logits (B,) (Eq. 6).

    Each kind is averaged over the batch. Without pairs it is 0.
    """
    positive, negative = _wide(positive_logit, negative_logit)
    # -log sigmoid(x) is softplus(-x), which stays finite for logits of +-1e4
    return mean(jax.nn.softplus(-positive)) + mean(jax.nn.softplus(negative))


def laplace_loss(error: ArrayLike, log_scale: ArrayLike) -> Array:
    """Return the negative log likelihood of errors under Laplace distributions, element-wise.

    Their scales are exp(`log_scale`). The logarithm is bent smoothly into -5..5, so that no
    deviation vanishes or explodes.
    """
    error, log_scale = _wide(error, log_scale)
    log_scale = 5.0 * jnp.tanh(log_scale / 5.0)
    return jnp.abs(error) * jnp.exp(-log_scale) + log_scale


def binary_loss(logit: ArrayLike, fraction: ArrayLike) -> Array:
    """Return the cross-entropy between logits and shares in 0..1, element-wise."""
    logit, fraction = _wide(logit, fraction)
    return jnp.maximum(logit, 0) - logit * fraction + jnp.log1p(jnp.exp(-jnp.abs(logit)))
