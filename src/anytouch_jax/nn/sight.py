"""Convolutional trunk beside the transformer: it sees textures and edges as an image network does.

Its blocks are the inverted residuals of MobileNetV2 (Sandler et al. 2018), of the sizes of
EfficientNet-lite0 (Tan and Le 2019). `experiments/encoders/distil.py` trains them.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array, lax
from jax.typing import DTypeLike

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD, ModelConfig
from anytouch_jax.nn.layers import Dense, product, stored, table


class Form(NamedTuple):
    """A block: side and stride of its depthwise kernel, channels inside of it and of its output."""

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
    Form(5, 1, 480, 112),
    Form(5, 1, 672, 112),
    Form(5, 1, 672, 112),
)
READ = (2, 4, 7, 10)  # blocks whose means over the image are features
MEANS = sum(BLOCKS[number].outputs for number in READ)
# Pixels are read as (pixel - MIDDLE) / RANGE, as by EfficientNet-lite. The zeros around an image
# are then the grey of an untouched gel, where the background is subtracted.
MIDDLE = 127
RANGE = 128


class Sight(nnx.Module):
    """The trunk, and a linear map from means over its feature maps to `model.sight` values."""

    def __init__(self, model: ModelConfig) -> None:
        trunk: dict[str, Any] = {"stem": _layer(3 * 3 * 3, STEM)}
        channels = STEM
        for number, form in enumerate(BLOCKS):
            own = {
                "depth": _layer(form.side**2, form.inside),
                "narrow": _layer(form.inside, form.outputs),
            }
            # The first block does not widen its input.
            if number:
                own["wide"] = _layer(channels, form.inside)
            trunk[f"block{number}"] = nnx.Dict(own)
            channels = form.outputs
        self.trunk = nnx.Dict(trunk)
        self.read = Dense(MEANS, model.sight, model)
        self.dtype = jnp.dtype(model.dtype)

    def __call__(self, frames: Array) -> Array:
        """Return features (B, model.sight) of normalised frames (B, H, W, 3)."""
        return self.read(feature_means(self.trunk, frames, self.dtype))


def feature_means(trunk: Any, frames: Array, dtype: DTypeLike = jnp.float32) -> Array:
    """Return the means (B, MEANS) over the feature maps of the blocks of `READ`.

    Args:
        trunk: "stem" and "block0" to the last, as in `Sight`.
        frames: Normalised pixels (B, H, W, 3).
        dtype: Type of the operands of matrix products.
    """
    scale = 255 / RANGE * np.asarray(IMAGENET_STD)
    shift = (255 * np.asarray(IMAGENET_MEAN) - MIDDLE) / RANGE
    x = frames * scale[None, None, None] + shift[None, None, None]
    x = stem(trunk["stem"], x.astype(stored(dtype)), dtype)
    means = []
    for number, form in enumerate(BLOCKS):
        x = block(trunk[f"block{number}"], x, form, dtype)
        if number in READ:
            means.append(jnp.mean(x, (1, 2)))
    return jnp.concatenate(means, axis=-1)


def _layer(inputs: int, outputs: int) -> nnx.Dict:
    return nnx.Dict(kernel=table(inputs, outputs), bias=table(outputs))


def stem(params: Any, x: Array, dtype: DTypeLike) -> Array:
    """Return the first feature maps (B, H / 2, W / 2, STEM) of images (B, H, W, 3)."""
    shape = _halved(x.shape, 2)
    padded = _padded(x, 3, 2)
    windows = [_shifted(padded, row, column, shape, 2) for row in range(3) for column in range(3)]
    return relu6(_linear(params, jnp.concatenate(windows, axis=-1), dtype))


def block(params: Any, x: Array, form: Form, dtype: DTypeLike) -> Array:
    """Widen, convolve each channel and narrow feature maps, an inverted residual.

    The input is added where the output has its shape.

    Args:
        params: "depth" and "narrow", and "wide" in all blocks but the first, each with a "kernel"
            and a "bias".
        x: Feature maps (B, H, W, C).
        form: The sizes of the block.
        dtype: Type of the operands of matrix products.

    Returns:
        Feature maps (B, ceil(H / stride), ceil(W / stride), outputs).
    """
    y = x
    if "wide" in params:
        y = relu6(_linear(params["wide"], y, dtype))
    kernel = params["depth"]["kernel"][...].astype(y.dtype)
    y = depthwise(y, kernel.reshape(form.side, form.side, -1), form.stride)
    y = relu6(y + params["depth"]["bias"][...].astype(y.dtype)[None, None, None])
    y = _linear(params["narrow"], y, dtype)
    return x + y if x.shape == y.shape else y


def relu6(x: Array) -> Array:
    """Clip values to 0 to 6."""
    return jnp.clip(x, 0, 6)


def _linear(params: Any, x: Array, dtype: DTypeLike) -> Array:
    y = product(x.reshape(-1, x.shape[-1]), params["kernel"][...], dtype)
    y = y + params["bias"][...].astype(y.dtype)[None]
    return y.reshape(*x.shape[:-1], y.shape[-1])


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def depthwise(x: Array, kernel: Array, stride: int) -> Array:
    """Convolve every channel with a kernel of its own, with zeros around the image.

    It is a sum of shifted images, because XLA's grouped convolution takes ten times longer on a
    CPU.

    Args:
        x: Feature maps (B, H, W, C).
        kernel: One square kernel a channel, (side, side, C), of an odd side.
        stride: Pixels from one output to the next.

    Returns:
        Feature maps (B, ceil(H / stride), ceil(W / stride), C).
    """
    return _valid(_padded(x, kernel.shape[0], stride), kernel, _halved(x.shape, stride), stride)


def _valid(padded: Array, kernel: Array, shape: tuple[int, int], stride: int) -> Array:
    """Return the outputs (B, *shape, C) of a depthwise convolution of padded maps."""
    side = kernel.shape[0]
    total = _shifted(padded, 0, 0, shape, stride) * kernel[0, 0][None, None, None]
    for place in range(1, side * side):
        row = place // side
        column = place % side
        part = _shifted(padded, row, column, shape, stride)
        total = total + part * kernel[row, column][None, None, None]
    return total


def _halved(shape: tuple[int, ...], stride: int) -> tuple[int, int]:
    """Return height and width of the output of a convolution of maps (B, H, W, C)."""
    return -(-shape[1] // stride), -(-shape[2] // stride)


def _around(size: int, side: int, stride: int) -> tuple[int, int]:
    """Return the zeros before and after `size` pixels.

    An odd one comes after, as in TensorFlow, where the teacher was trained.
    """
    outputs = -(-size // stride)
    zeros = max((outputs - 1) * stride + side - size, 0)
    return zeros // 2, zeros - zeros // 2


def _padded(x: Array, side: int, stride: int) -> Array:
    around = [_around(size, side, stride) for size in x.shape[1:3]]
    return jnp.pad(x, ((0, 0), *around, (0, 0)))


def _shifted(padded: Array, row: int, column: int, shape: tuple[int, ...], stride: int) -> Array:
    """Return what one place of the kernel sees, of padded maps (..., H, W, C)."""
    height = (shape[0] - 1) * stride + 1
    width = (shape[1] - 1) * stride + 1
    return padded[..., row : row + height : stride, column : column + width : stride, :]


def _depthwise_forward(x: Array, kernel: Array, stride: int) -> tuple[Array, tuple[Array, Array]]:
    return depthwise(x, kernel, stride), (x, kernel)


def _depthwise_backward(
    stride: int, saved: tuple[Array, Array], gradient: Array
) -> tuple[Array, Array]:
    x, kernel = saved
    side = kernel.shape[0]
    shape = gradient.shape[1:3]
    # The gradient of x is a convolution of the spread gradient with the turned kernel.
    edges = []
    for size, outputs in zip(x.shape[1:3], shape, strict=True):
        before = _around(size, side, stride)[0]
        after = size + before - (outputs - 1) * stride - 1
        edges.append((side - 1 - before, after, stride - 1))
    zero = jnp.zeros((), gradient.dtype)
    spread = lax.pad(gradient, zero, [(0, 0, 0), *edges, (0, 0, 0)])
    to_x = _valid(spread, kernel[::-1, ::-1], x.shape[1:3], 1)

    # Image by image: one sum over the whole batch takes forty times longer on a CPU.
    def add(sums: Array, pair: tuple[Array, Array]) -> tuple[Array, None]:
        image, own = pair
        parts = [
            (_shifted(image, row, column, shape, stride) * own).sum((0, 1))
            for row in range(side)
            for column in range(side)
        ]
        return sums + jnp.stack(parts), None

    start = jnp.zeros((side * side, kernel.shape[2]), gradient.dtype)
    to_kernel, _ = lax.scan(add, start, (_padded(x, side, stride), gradient))
    return to_x, to_kernel.reshape(kernel.shape)


depthwise.defvjp(_depthwise_forward, _depthwise_backward)
