"""Plain vision transformers, in the forms of other tactile encoders and of DINOv2, DINOv3, SigLIP,
MAE and DeiT.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array

from anytouch_jax.config import ModelConfig, Stack
from anytouch_jax.nn.layers import (
    Activation,
    Attention,
    Block,
    Dense,
    LayerNorm,
    Mlp,
    gelu,
    lean,
    product,
    rows_of,
    run_blocks,
    stacked_blocks,
    table,
)
from anytouch_jax.ops import tokens

Resample = Literal["none", "bicubic", "shifted", "antialias"]


@dataclass(frozen=True)
class VitConfig:
    """The form of a plain ViT: what `model` (widths, patch, frames, sensors, epsilon, arithmetic)
    does not say.

    The sequence is [class, registers, sensor tokens, patches, calibration patches]. The patches are
    in the order (time, row, column). `grid` is (time, rows, columns) of the stored positions.
    `resample` fits them to other images. It is torch's bicubic filter, the same with the scale (new
    + 0.1) / old of DINOv2's authors, or with antialiasing.
    """

    model: ModelConfig
    tubelet: int = 1  # Frames of one patch kernel.
    grid: tuple[int, int, int] | None = None  # None: positions are computed.
    axes: int = 2  # Axes of computed positions: rows and columns, with 3 also time.
    resample: Resample = "none"
    class_token: bool = True
    registers: int = 0
    patch_bias: bool = True
    layer_scale: bool = False
    pre_norm: bool = False  # A LayerNorm before the blocks (CLIP).
    trunk: int = 0  # Blocks after those of `model`, with their own epsilon (T3).
    trunk_eps: float = 1e-5
    calibration: int = 0  # Images of one second patch kernel (SITR).
    outputs: int = 0  # Values of a projection of the normed tokens. 0: there is none.
    output_bias: bool = False
    rotary: bool = False  # Patches turn queries and keys (DINOv3) and have no positions.
    tanh: bool = False  # GELU by tanh.
    # A learned query reads the normed tokens (SigLIP). Its output takes the place of a projection.
    pool: bool = False

    @property
    def start(self) -> int:
        """The number of tokens before the patches."""
        own = self.model.sensor_tokens if len(self.model.sensors) > 1 else 0
        return self.class_token + self.registers + own


class VitOutput(NamedTuple):
    """Tokens (B, S, D) without those of calibration: before the trunk, after the last block,
    normed, projected.
    """

    encoded: Array
    hidden: Array
    normed: Array
    projected: Array


class LayerScale(nnx.Module):
    """A learned factor of each channel."""

    def __init__(self, width: int) -> None:
        self.scale = table(width)

    def __call__(self, x: Array) -> Array:
        return x * jnp.expand_dims(self.scale[...], range(x.ndim - 1)).astype(x.dtype)


class ScaledBlock(Block):
    """A block whose two branches are scaled (Touvron et al., 2021, "Going deeper with image
    transformers").
    """

    def __init__(self, stack, model, eps, act) -> None:  # type: ignore[no-untyped-def]
        super().__init__(stack, model, eps, act)
        self.scale1 = LayerScale(stack.width)
        self.scale2 = LayerScale(stack.width)

    @lean
    def _after(self, x: Array, heads: Array) -> Array:
        x = x + self.scale1(self.attention.out(heads.reshape(x.shape)))
        return x + self.scale2(self.mlp(self.norm2(x)))


class AttentionPool(nnx.Module):
    """A learned query that attends to all tokens, then an MLP."""

    def __init__(self, stack: Stack, model: ModelConfig, act: Activation) -> None:
        self.probe = table(stack.width)
        self.attention = Attention(stack, model)
        self.norm = LayerNorm(stack.width, model.norm_eps, model.dtype)
        self.mlp = Mlp(stack.width, stack.mlp, model, act)

    def __call__(self, x: Array) -> Array:
        """Return (B, 1, D) of tokens (B, S, D)."""
        probe = jnp.broadcast_to(self.probe[...][None, None], (x.shape[0], 1, x.shape[2])).astype(
            x.dtype
        )
        heads = self.attention.attend(*self.attention.project(probe, x), causal=False, mask=None)
        y = self.attention.out(heads.reshape(probe.shape))
        return y + self.mlp(self.norm(y))


class TubePatch(nnx.Module):
    """Projection of a patch over `frames` frames: a kernel (frames, P*P*3, D)."""

    def __init__(self, frames: int, model: ModelConfig, *, bias: bool = True) -> None:
        self.kernel = table(frames, model.patch**2 * 3, model.touch.width)
        self.bias = table(model.touch.width) if bias else None
        self.patch = model.patch
        self.dtype = jnp.dtype(model.dtype)

    def __call__(self, clip: Array) -> Array:
        """Project (B, T, H, W, 3) to (B, T / frames * N, D), time first."""
        kernel = self.kernel[...]
        cut = tokens.patchify(clip, self.patch)
        matrix = kernel.reshape(-1, kernel.shape[-1])
        tubes = jnp.swapaxes(cut.reshape(*cut.shape[:2], -1, len(matrix)), 1, 2)
        x = product(tubes.reshape(-1, len(matrix)), matrix, self.dtype)
        x = x if self.bias is None else x + self.bias[...][None].astype(x.dtype)
        return x.reshape(cut.shape[0], -1, x.shape[-1])


class Vit(nnx.Module):
    """A ViT of the form of a VitConfig."""

    def __init__(self, form: VitConfig) -> None:
        model, stack = form.model, form.model.touch
        width = stack.width
        act = partial(jax.nn.gelu, approximate=True) if form.tanh else gelu
        eps = model.norm_eps
        kind = ScaledBlock if form.layer_scale else Block
        self.form = form
        self.patch = TubePatch(form.tubelet, model, bias=form.patch_bias)
        self.class_token = table(width) if form.class_token else None
        self.registers = table(form.registers, width) if form.registers else None
        own = model.sensor_tokens and len(model.sensors) > 1
        self.sensor_tokens = table(len(model.sensors), model.sensor_tokens, width) if own else None
        self.periods = table(width // stack.heads // 4) if form.rotary else None
        computed = form.grid is None and not form.rotary
        self.frequency = table(form.axes, -(-width // (2 * form.axes))) if computed else None
        self.position = (
            table(int(np.prod(form.grid)) + form.class_token, width) if form.grid else None
        )
        self.calibration = TubePatch(form.calibration, model) if form.calibration else None
        places = int(np.prod(form.grid)) if form.grid and form.calibration else 0
        self.calibration_position = table(places, width) if places else None
        self.pre_norm = LayerNorm(width, eps, model.dtype) if form.pre_norm else None
        self.blocks = stacked_blocks(stack, model, eps, act, kind)
        if form.trunk:
            stack = stack.__class__(width, form.trunk, stack.heads, stack.mlp)
            eps = form.trunk_eps
        self.trunk = stacked_blocks(stack, model, eps, act, kind) if form.trunk else None
        self.post_norm = LayerNorm(width, eps, model.dtype)
        self.projection = (
            Dense(width, form.outputs, model, bias=form.output_bias) if form.outputs else None
        )
        self.pool = AttentionPool(form.model.touch, model, act) if form.pool else None

    def __call__(self, clip: Array, sensor: Array, calibration: Array | None = None) -> VitOutput:
        """Return the tokens of prepared clips (B, T, H, W, 3) of sensor rows (B,).

        `calibration` (C, H, W, 3) are the prepared calibration images. T is a multiple of the
        tubelet.
        """
        form, remat = self.form, self.form.model.remat
        x = self.patch(clip)
        grid = (
            clip.shape[1] // form.tubelet,
            *(side // form.model.patch for side in clip.shape[2:4]),
        )
        position = None if form.rotary else self._positions(grid)
        x = x if position is None else x + position[None, -x.shape[1] :].astype(x.dtype)
        parts = []
        batch = x.shape[0]
        if self.class_token is not None:
            first = self.class_token[...]
            first = first if self.position is None or position is None else first + position[0]
            parts.append(jnp.broadcast_to(first[None, None], (batch, 1, x.shape[-1])))
        if self.registers is not None:
            parts.append(
                jnp.broadcast_to(self.registers[...][None], (batch, *self.registers[...].shape))
            )
        if self.sensor_tokens is not None:
            parts.append(rows_of(self.sensor_tokens[...], sensor))
        x = jnp.concatenate([*(part.astype(x.dtype) for part in parts), x], axis=1)
        length = x.shape[1]
        if self.calibration is not None and self.calibration_position is not None:
            assert calibration is not None
            more = self.calibration(calibration[None])
            more = more + self.calibration_position[...][None].astype(more.dtype)
            x = jnp.concatenate([x, jnp.broadcast_to(more, (batch, *more.shape[1:]))], axis=1)
        x = x if self.pre_norm is None else self.pre_norm(x)
        turn = partial(_turned, angles=self._angles(grid)) if form.rotary else None
        encoded = hidden = run_blocks(self.blocks, x, remat=remat, turn=turn)
        if self.trunk is not None:
            hidden = run_blocks(self.trunk, encoded, remat=remat)
        encoded = encoded[:, :length]
        hidden = hidden[:, :length]
        normed = self.post_norm(hidden)
        last = self.pool or self.projection
        return VitOutput(encoded, hidden, normed, normed if last is None else last(normed))

    def _angles(self, grid: tuple[int, ...]) -> Array:
        """Return the angles f32 (N, D / H / 2) of patches: 2 pi by their places in -1..1, over the
        periods.
        """
        assert self.periods is not None
        axes = [(np.arange(side, dtype=np.float32) + 0.5) / side * 2 - 1 for side in grid[1:]]
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2, 1)
        return jnp.asarray(2 * np.pi * places / self.periods[...][None, None]).reshape(
            len(places), -1
        )

    def _positions(self, grid: tuple[int, ...]) -> Array:
        """Return positions of a grid (time, rows, columns), after that of the class token if they
        are stored.
        """
        if (
            self.frequency is not None
        ):  # per axis [sines, cosines] of whole coordinates, cut at the width
            places = np.stack(np.meshgrid(*map(np.arange, grid), indexing="ij"), axis=-1).reshape(
                -1, 3
            )
            places = places[:, 3 - len(self.frequency[...]) :]
            angle = places[:, :, None].astype(np.float32) * self.frequency[...][None]
            waves = jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], axis=-1).reshape(
                len(places), -1
            )
            return waves[:, : self.form.model.touch.width]
        assert self.position is not None and self.form.grid is not None
        stored = self.position[...]
        (time, rows, columns) = self.form.grid
        if grid == self.form.grid:
            return stored
        if self.form.resample == "none" or grid[0] != time:
            asked, there = (" x ".join(map(str, sizes)) for sizes in (grid, self.form.grid))
            raise ValueError(
                f"the positions are those of {there} patches (time, rows, columns), not {asked}"
            )
        kernels = [
            cubic(*sizes, self.form.resample) for sizes in ((rows, grid[1]), (columns, grid[2]))
        ]
        first, table = jnp.split(stored, [len(stored) - time * rows * columns])
        table = jnp.einsum(
            "ir,jc,trcd->tijd",
            *kernels,
            table.reshape(time, rows, columns, -1),
            precision="highest",
        )
        return jnp.concatenate([first, table.reshape(-1, table.shape[-1])])


def _turned(x: Array, angles: Array) -> Array:
    """Return queries or keys (B, S, H, D) of which the last N tokens are turned by angles (N, D /
    2).
    """
    first, patches = jnp.split(x, [x.shape[1] - len(angles)], axis=1)
    cos, sin = (wave(angles)[None, :, None].astype(x.dtype) for wave in (jnp.cos, jnp.sin))
    one, two = jnp.split(patches, 2, axis=-1)
    return jnp.concatenate(
        [first, jnp.concatenate([one * cos - two * sin, two * cos + one * sin], axis=-1)], axis=1
    )


def cubic(old: int, new: int, resample: Resample = "bicubic") -> np.ndarray:
    """Return the matrix f64 (new, old) of torch's cubic filter for one axis (align_corners=False).

    "bicubic" has four taps. Those beyond the border fall on it.
    "shifted" has the scale (new + 0.1) / old.
    "antialias" widens the filter where the axis shrinks, and leaves out what is beyond the border.
    """
    wide = resample == "antialias"
    a, ratio = (-0.5, old / new) if wide else (-0.75, old / (new + 0.1 * (resample == "shifted")))
    zoom = max(ratio, 1.0) if wide else 1.0
    centre = (np.arange(new)[:, None] + 0.5) * ratio - 0.5
    taps = np.floor(centre).astype(int) + np.arange(-int(2 * zoom) - 1, int(2 * zoom) + 3)
    far = np.abs(centre - taps) / zoom
    weight = np.where(
        far <= 1,
        ((a + 2) * far - (a + 3)) * far**2 + 1,
        np.where(far < 2, a * (((far - 5) * far + 8) * far - 4), 0),
    )
    if wide:
        weight = np.where((taps >= 0) & (taps < old), weight, 0)
        weight = weight / weight.sum(axis=1, keepdims=True)
    matrix = np.zeros((new, old))
    np.add.at(matrix, (np.arange(new)[:, None], np.clip(taps, 0, old - 1)), weight)
    return matrix
