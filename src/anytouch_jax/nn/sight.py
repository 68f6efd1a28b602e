"""Sight: a convolutional trunk beside the transformer, that knows textures and edges as a network of photographs does.

Its blocks are the inverted residuals of MobileNetV2 (Sandler et al. 2018), of the sizes of EfficientNet-lite0 (Tan and
Le 2019), at 112 pixels. `experiments/encoders/distil.py` trains them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array, lax

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD, ModelConfig
from anytouch_jax.nn.fields import windows
from anytouch_jax.nn.layers import Dense, product, stored, table


class Form(NamedTuple):
    """A block: side of its depthwise kernel, stride, channels inside of it, channels of its output."""

    side: int
    stride: int
    inside: int
    outputs: int


STEM = 32
BLOCKS = (
    Form(3, 1, 32, 16),
    Form(3, 2, 96, 24),
    Form(3, 1, 144, 24),
    Form(5, 2, 144, 40),
    Form(5, 1, 240, 40),
    Form(3, 2, 240, 80),
    Form(3, 1, 480, 80),
    Form(3, 1, 480, 80),
)
UNTOUCHED = 128  # grey level of an untouched gel: what the zeros around a picture stand for
READ = (0, 1, 2, 4, 7)  # blocks whose means over the picture are features


def relu6(x: Array) -> Array:
    """Clip values to 0 to 6."""
    return jnp.clip(x, 0, 6)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def depthwise(x: Array, kernel: Array, stride: int) -> Array:
    """Convolve every channel with a kernel of its own, with zeros around the picture.

    It is a sum of shifted pictures: XLA's own grouped convolution takes ten times longer on a CPU.

    Args:
        x: Maps (B, H, W, C).
        kernel: One square kernel a channel, (side, side, C), of an odd side.
        stride: Step between outputs in pixels.

    Returns:
        Maps (B, ceil(H / stride), ceil(W / stride), C).
    """
    side = kernel.shape[0]
    shape = (-(-x.shape[1] // stride), -(-x.shape[2] // stride))
    padded = _padded(x, side)
    total = None
    for row in range(side):
        for column in range(side):
            part = _shifted(padded, row, column, shape, stride) * kernel[row, column][None, None, None]
            total = part if total is None else total + part
    assert total is not None
    return total


def _padded(x: Array, side: int) -> Array:
    around = (side // 2, side // 2)
    return jnp.pad(x, ((0, 0), around, around, (0, 0)))


def _shifted(padded: Array, row: int, column: int, shape: tuple[int, ...], stride: int) -> Array:
    """Return what one place of the kernel sees, of padded maps (..., H, W, C)."""
    height, width = ((size - 1) * stride + 1 for size in shape)
    return padded[..., row : row + height : stride, column : column + width : stride, :]


def _depthwise_forward(x: Array, kernel: Array, stride: int) -> tuple[Array, tuple[Array, Array]]:
    return depthwise(x, kernel, stride), (x, kernel)


def _depthwise_backward(stride: int, saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, kernel = saved
    side = kernel.shape[0]
    shape = gradient.shape[1:3]
    missing = [
        (0, there - (size - 1) * stride - 1, stride - 1) for there, size in zip(x.shape[1:3], shape, strict=True)
    ]
    spread = lax.pad(gradient, jnp.zeros((), gradient.dtype), [(0, 0, 0), *missing, (0, 0, 0)])
    to_x = depthwise(spread, kernel[::-1, ::-1], 1)

    # Picture by picture: one sum over the whole batch takes forty times longer on a CPU.
    def add(sums: Array, pair: tuple[Array, Array]) -> tuple[Array, None]:
        picture, own = pair
        parts = [
            (_shifted(picture, row, column, shape, stride) * own).sum(0)
            for row in range(side)
            for column in range(side)
        ]
        return tuple(old + part for old, part in zip(sums, parts, strict=True)), None

    start = tuple(jnp.zeros(gradient.shape[2:], gradient.dtype) for _ in range(side**2))
    sums, _ = lax.scan(add, start, (_padded(x, side), gradient))
    to_kernel = jnp.stack([total.sum(0) for total in sums]).reshape(kernel.shape)
    return to_x, to_kernel


depthwise.defvjp(_depthwise_forward, _depthwise_backward)


def stem(params: Any, x: Array, dtype: Any = jnp.float32) -> Array:
    """Return the first maps (B, H / 2, W / 2, STEM) of pictures (B, H, W, 3), from windows of 3 x 3 pixels."""
    return relu6(_linear(params, windows(x, 3), dtype))


def block(params: Any, x: Array, stride: int, dtype: Any = jnp.float32) -> Array:
    """Widen, convolve each channel, narrow; the input is added where the output has its shape.

    Args:
        params: "depth" and "narrow", and "wide" in all blocks but the first, each with a "kernel" and a "bias".
        x: Maps (B, H, W, C).
        stride: That of the depthwise convolution.
        dtype: Type of the operands of products.
    """
    y = _linear(params["narrow"], inside(params, x, stride, dtype), dtype)
    return x + y if x.shape == y.shape else y


def inside(params: Any, x: Array, stride: int, dtype: Any = jnp.float32) -> Array:
    """Return the widened and convolved maps inside of a `block`."""
    if "wide" in params:
        x = relu6(_linear(params["wide"], x, dtype))
    kernel = params["depth"]["kernel"][...].astype(x.dtype)
    side = round(kernel.shape[0] ** 0.5)
    x = depthwise(x, kernel.reshape(side, side, -1), stride)
    return relu6(x + params["depth"]["bias"][...].astype(x.dtype)[None, None, None])


def _linear(params: Any, x: Array, dtype: Any) -> Array:
    y = product(x.reshape(-1, x.shape[-1]), params["kernel"][...], dtype)
    return y.reshape(*x.shape[:-1], y.shape[-1]) + params["bias"][...].astype(y.dtype)[None, None, None]


def levels(pictures: Array) -> Array:
    """Return pictures u8 as the trunk reads them: 0 is the untouched gel of a picture that is less its background."""
    return (pictures.astype(jnp.float32) - UNTOUCHED) / UNTOUCHED


def maps(params: Any, x: Array, strides: Sequence[int], dtype: Any = jnp.float32) -> list[Array]:
    """Return the outputs of the stem and of each block for `levels` of pictures (B, H, W, 3)."""
    outputs = [stem(params["stem"], x, dtype)]
    for number, stride in enumerate(strides):
        outputs.append(block(params[f"block{number}"], outputs[-1], stride, dtype))
    return outputs


def _layer(inputs: int, outputs: int) -> nnx.Dict:
    return nnx.Dict(kernel=table(inputs, outputs), bias=table(outputs))


class Sight(nnx.Module):
    """The trunk, and a linear map from the means of some of its maps over the picture to `model.sight` values."""

    def __init__(self, model: ModelConfig) -> None:
        self.stem, channels = _layer(27, STEM), STEM
        for number, form in enumerate(BLOCKS):
            own = {"depth": _layer(form.side**2, form.inside), "narrow": _layer(form.inside, form.outputs)}
            if number:
                own["wide"] = _layer(channels, form.inside)
            setattr(self, f"block{number}", nnx.Dict(own))
            channels = form.outputs
        self.read = Dense(sum(BLOCKS[number].outputs for number in READ), model.sight, model)
        self.dtype = jnp.dtype(model.dtype)

    def __call__(self, frames: Array) -> Array:
        """Return features (B, model.sight) of normalised frames (B, H, W, 3)."""
        parts = {name: getattr(self, name) for name in ("stem", *(f"block{number}" for number in range(len(BLOCKS))))}
        level = 255 / UNTOUCHED
        gain, shift = (np.asarray(value, np.float32) for value in (IMAGENET_STD, IMAGENET_MEAN))
        frames = frames * (level * gain)[None, None, None] + (level * shift - 1)[None, None, None]
        outputs = maps(parts, frames.astype(stored(self.dtype)), [form.stride for form in BLOCKS], self.dtype)
        return self.read(jnp.concatenate([jnp.mean(outputs[number + 1], (1, 2)) for number in READ], -1))
