"""Decoder of fields: depth, shear, contact and force from encoder states and pixels.

Every output is free of scale: lengths are over the image's width, stresses over the gel's modulus.
So a network that was trained on sensors of any zoom reads one of any size.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array, lax
from jax.typing import DTypeLike

from anytouch_jax.config import ModelConfig
from anytouch_jax.fields.outputs import (
    DIFFERENCE,
    FORCE,
    LENGTH,
    STATES,
    STRESS,
    TORQUE,
    TOUCHED_BORDER,
    FieldOutput,
)
from anytouch_jax.fields.poisson import border, integrate
from anytouch_jax.nn.layers import Dense, LayerNorm, Mlp, gelu, product, stored, table


def windows(x: Array, side: int, stride: int = 2) -> Array:
    """Return every `stride`th window of `side` x `side` pixels (odd) of x (B, H, W, C).

    There are zeros around the image. The result is (B, ceil(H / stride), ceil(W / stride),
    side * side * C), a window in the order (row, column, channel).
    """
    around = side // 2
    x = jnp.pad(x, ((0, 0), (around, around), (around, around), (0, 0)))
    ends = [size - side + 1 for size in x.shape[1:3]]
    cut = [
        x[:, i : i + ends[0] : stride, j : j + ends[1] : stride]
        for i in range(side)
        for j in range(side)
    ]
    return jnp.concatenate(cut, axis=-1)


def convolved(x: Array, kernel: Array, side: int, stride: int, dtype: DTypeLike) -> Array:
    """Convolve x (B, H, W, C) with a square kernel, zeros around x.

    Args:
        x: Maps (B, H, W, C).
        kernel: (side * side * C, outputs), rows in the order of `windows`.
        side: Pixels of the kernel, odd.
        stride: Pixels from one output to the next.
        dtype: Both operands are rounded to it.
    """
    if jax.default_backend() != "cpu":
        # As a product: without tuning, cuDNN's gradient of so few channels takes a second.
        x = windows(x, side, stride)
        y = product(x.reshape(-1, x.shape[-1]), kernel, dtype)
        return y.reshape(*x.shape[:-1], kernel.shape[-1])
    # On a CPU the windows would be written to memory, side * side times the size of x. Values are
    # rounded to `dtype`, and computed in the type of x as all but products is there (`stored`).
    rounded = x.astype(dtype).astype(x.dtype)
    square = kernel.reshape(side, side, x.shape[-1], -1).astype(dtype).astype(x.dtype)
    around = [(side // 2, side // 2)] * 2
    return lax.conv_general_dilated(
        rounded, square, (stride, stride), around, dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


class Convolution(nnx.Module):
    """A square convolution (B, H, W, C) with zeros around it, after a norm over the channels.

    Without `norm` there is none.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        side: int,
        model: ModelConfig,
        *,
        stride: int = 1,
        norm: bool = True,
    ):
        self.norm = LayerNorm(inputs, model.norm_eps, model.dtype) if norm else None
        self.kernel = table(side * side * inputs, outputs)
        self.bias = table(outputs)
        self.side = side
        self.stride = stride
        self.dtype = jnp.dtype(model.dtype)

    def __call__(self, x: Array) -> Array:
        if self.norm is not None:
            x = gelu(self.norm(x))
        x = x.astype(stored(self.dtype))
        x = convolved(x, self.kernel[...], self.side, self.stride, self.dtype)
        return x + self.bias[...].astype(x.dtype)[None, None, None]


class SlopeOutput(NamedTuple):
    """Differences (B, h, w, 2) of the depth to the right neighbour and to the one below.

    They are over LENGTH, and so are their deviations, whose logarithms are `log` (B, h, w, 2).
    """

    values: Array
    log: Array


class FieldDecoder(nnx.Module):
    """Patch tokens of several blocks, and a convolutional path from the pixels for sharp edges
    (after DPT).

    A deeper path on a grid of an eighth sees how far the contact reaches (after U-Net). A camera
    shows slopes. So the gradient of the depth is predicted and integrated (`fields.poisson`): a
    depth that is predicted directly falls back to the mean inside a flat contact.
    """

    def __init__(self, model: ModelConfig) -> None:
        few = model.fields
        many = 2 * model.fields
        most = 4 * model.fields
        width = STATES * model.touch.width
        self.read = Dense(width, many, model)
        self.aspect = Dense(1, many, model)
        self.stem = Convolution(6, few // 2, 5, model, stride=2, norm=False)
        self.down = Convolution(few // 2, few, 3, model, stride=2)
        self.middle1 = Convolution(many + few, many, 3, model)
        self.middle2 = Convolution(many, many, 3, model)
        self.deep = Convolution(many, most, 3, model, stride=2)
        self.deep1 = Convolution(most, most, 3, model)
        self.deep2 = Convolution(most, most, 3, model)
        self.deep3 = Convolution(most, most, 3, model)
        self.deep4 = Convolution(most, most, 3, model)
        self.light = Dense(most, most, model)
        self.up = Dense(most, many, model)
        self.fine1 = Convolution(many + few // 2, few, 3, model)
        self.fine2 = Convolution(few, few, 3, model)
        self.maps = Dense(few, 7, model)
        self.slope = Convolution(few, 4, 3, model, norm=False)
        self.press = Mlp(few + 1, few, model, gelu, outputs=2)
        self.whole = Mlp(width + many, 2 * many, model, gelu, outputs=8)
        self.special = 1 + model.sensor_tokens
        self.grid = model.image_size // model.patch

    def __call__(self, states: Array, clip: Array, aspect: Array) -> FieldOutput:
        """Return the fields of the last frame of clips.

        See `with_slope`.
        """
        return self.with_slope(states, clip, aspect)[0]

    def with_slope(
        self, states: Array, clip: Array, aspect: Array
    ) -> tuple[FieldOutput, SlopeOutput]:
        """Return the fields of the last frame of clips, and the gradient that was integrated.

        `states` are (B, 1 + S + N, STATES * D), `clip` is normalised (B, T, H, W, 3), and `aspect`
        (B,) the logarithm of the height over the width that the image shows.
        """
        tokens = self.read(states[:, self.special :]) + self.aspect(aspect[:, None])[:, None]
        # The change since the first frame shows how dots moved.
        sharp = self.stem(jnp.concatenate([clip[:, -1], clip[:, -1] - clip[:, 0]], -1))
        x = self.down(sharp)
        coarse = _resized(tokens.reshape(len(clip), self.grid, self.grid, tokens.shape[-1]), x)
        x = self.middle1(jnp.concatenate([coarse, x], -1))
        x = x + self.middle2(x)
        deep = self.deep(x)
        deep = deep + self.deep1(deep)
        deep = deep + self.deep2(deep)
        # The whole image shows the lights of the device.
        deep = deep + self.light(gelu(jnp.mean(deep, (1, 2))))[:, None, None]
        deep = deep + self.deep3(deep)
        deep = deep + self.deep4(deep)
        x = x + _resized(self.up(gelu(deep)), x)
        pooled = jnp.mean(x, (1, 2))
        x = self.fine1(jnp.concatenate([_resized(x, sharp), sharp], -1))
        x = x + self.fine2(x)
        x = gelu(x)
        maps = self.maps(x).astype(jnp.float32)
        slope = self.slope(x).astype(jnp.float32)
        differences = DIFFERENCE * slope[..., :2]
        depth = _filled(differences, maps[..., 0], maps[..., 3])
        # Pressure follows from the depth that is filled in.
        press = self.press(jnp.concatenate([x, depth[..., None].astype(x.dtype)], -1))
        contact = maps[..., 3] + press[..., 0].astype(jnp.float32)
        strength = maps[..., 4] + press[..., 1].astype(jnp.float32)
        both = jnp.concatenate([states[:, 0], pooled.astype(states.dtype)], -1)
        whole = self.whole(both).astype(jnp.float32)
        pressure = STRESS * jax.nn.softplus(strength) * jax.nn.sigmoid(contact)
        # The normal force is the integral of the pressure: there is none without contact.
        normal = jnp.mean(pressure, (1, 2)) * jnp.exp(aspect)
        force = jnp.concatenate([FORCE * whole[:, :2], normal[:, None]], -1)
        out = FieldOutput(
            depth=LENGTH * depth,
            shear=LENGTH * maps[..., 1:3],
            contact=contact,
            pressure=pressure,
            depth_log=maps[..., 5],
            shear_log=maps[..., 6],
            force=force,
            torque=TORQUE * whole[:, 2],
            slip=whole[:, 3],
            force_log=whole[:, 4:6],
            torque_log=whole[:, 6],
            slip_log=whole[:, 7],
        )
        return out, SlopeOutput(differences, slope[..., 2:])


def _filled(slope: Array, level: Array, contact: Array) -> Array:
    """Return the depth (B, h, w) whose gradient is `slope` (B, h, w, 2).

    Its constant is that of `level` (B, h, w) at the border of the image. Where nothing touches
    there, by the logits `contact` (B, h, w), the level is known best, as it is close to 0.
    """
    rise = integrate(slope)
    free = jax.nn.sigmoid(-lax.stop_gradient(contact)) + TOUCHED_BORDER
    weight = free * border(*level.shape[1:])[None]
    constant = jnp.sum(weight * (level - rise), (1, 2)) / jnp.sum(weight, (1, 2))
    return rise + constant[:, None, None]


def _resized(x: Array, other: Array) -> Array:
    """Resize maps (B, H, W, C) to the height and width of others."""
    return jax.image.resize(x, (*other.shape[:3], x.shape[-1]), "linear")
