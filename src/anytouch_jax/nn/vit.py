"""Plain vision transformers in the forms of other encoders: DINOv2, DINOv3, SigLIP, MAE, DeiT."""

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
    product,
    remat,
    rows_of,
    run_blocks,
    stacked_blocks,
    table,
)
from anytouch_jax.ops import tokens

Resample = Literal["none", "bicubic", "shifted", "antialias"]


@dataclass(frozen=True)
class VitConfig:
    """The form of a plain ViT: what `model` does not say of it.

    `model` has widths, patch, frames, sensors, epsilon and arithmetic. The sequence is [class,
    registers, sensor tokens, patches, calibration patches], with patches in the order (time, row,
    column). `grid` is (time, rows, columns) of the stored positions. `resample` fits them to other
    images. It is torch's bicubic filter, the same with the scale (new + 0.1) / old of DINOv2's
    authors, or with antialiasing.
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
        return self.class_token + self.registers + self.sensor_tokens

    @property
    def sensor_tokens(self) -> int:
        """The number of tokens of a sensor: none where all sensors are one."""
        return self.model.sensor_tokens if len(self.model.sensors) > 1 else 0


class VitOutput(NamedTuple):
    """Tokens (B, S, D) without those of calibration.

    They are those before the trunk, after the last block, normed, and projected.
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
    """A block whose two branches are scaled (CaiT, Touvron et al., 2021)."""

    def __init__(self, stack: Stack, model: ModelConfig, eps: float, act: Activation) -> None:
        super().__init__(stack, model, eps, act)
        self.scale1 = LayerScale(stack.width)
        self.scale2 = LayerScale(stack.width)

    @remat
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
        one = jnp.broadcast_to(self.probe[...][None, None], (x.shape[0], 1, x.shape[2]))
        probe = one.astype(x.dtype)
        q, k, v = self.attention.project(probe, x)
        heads = self.attention.attend(q, k, v, causal=False, mask=None)
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
        # (B, N, T / frames, frames * P*P*3), then time first
        tubes = jnp.swapaxes(cut.reshape(*cut.shape[:2], -1, len(matrix)), 1, 2)
        x = product(tubes.reshape(-1, len(matrix)), matrix, self.dtype)
        if self.bias is not None:
            x = x + self.bias[...][None].astype(x.dtype)
        return x.reshape(cut.shape[0], -1, x.shape[-1])


class Vit(nnx.Module):
    """A ViT of the form of a VitConfig. A part that the form lacks is None."""

    def __init__(self, form: VitConfig) -> None:
        model, stack = form.model, form.model.touch
        width = stack.width
        eps = model.norm_eps
        act: Activation = gelu
        if form.tanh:
            act = partial(jax.nn.gelu, approximate=True)
        kind = ScaledBlock if form.layer_scale else Block
        self.form = form
        self.patch = TubePatch(form.tubelet, model, bias=form.patch_bias)
        self.class_token = table(width) if form.class_token else None
        self.registers = table(form.registers, width) if form.registers else None
        rows = len(model.sensors)
        # Each attribute is set once: nnx keeps an attribute that was None as a static one.
        self.sensor_tokens = table(rows, model.sensor_tokens, width) if form.sensor_tokens else None
        self._make_positions(form, width)
        self.pre_norm = LayerNorm(width, eps, model.dtype) if form.pre_norm else None
        self.blocks = stacked_blocks(stack, model, eps, act, kind)
        trunk = Stack(width, form.trunk, stack.heads, stack.mlp)
        if form.trunk:
            eps = form.trunk_eps
        self.trunk = stacked_blocks(trunk, model, eps, act, kind) if form.trunk else None
        self.post_norm = LayerNorm(width, eps, model.dtype)
        projects = form.outputs > 0
        self.projection = (
            Dense(width, form.outputs, model, bias=form.output_bias) if projects else None
        )
        self.pool = AttentionPool(stack, model, act) if form.pool else None

    def _make_positions(self, form: VitConfig, width: int) -> None:
        """Make the parameters that tell one patch from another: stored, computed or rotary."""
        is_stored = form.grid is not None
        places = int(np.prod(form.grid)) if form.grid is not None else 0
        heads = form.model.touch.heads
        self.periods = table(width // heads // 4) if form.rotary else None
        is_computed = not form.rotary and not is_stored
        self.frequency = table(form.axes, -(-width // (2 * form.axes))) if is_computed else None
        self.position = table(places + form.class_token, width) if is_stored else None
        has_images = form.calibration > 0
        self.calibration = TubePatch(form.calibration, form.model) if has_images else None
        self.calibration_position = table(places, width) if has_images and is_stored else None

    def __call__(self, clip: Array, sensor: Array, calibration: Array | None = None) -> VitOutput:
        """Return the tokens of prepared clips (B, T, H, W, 3) of sensor rows (B,).

        `calibration` (C, H, W, 3) are the prepared calibration images. T is a multiple of the
        tubelet.
        """
        form = self.form
        remat = form.model.remat
        rows, columns = (side // form.model.patch for side in clip.shape[2:4])
        grid = (clip.shape[1] // form.tubelet, rows, columns)
        x = self._sequence(clip, sensor, grid)
        length = x.shape[1]
        if self.calibration is not None and self.calibration_position is not None:
            assert calibration is not None
            more = self.calibration(calibration[None])
            more = more + self.calibration_position[...][None].astype(more.dtype)
            x = jnp.concatenate([x, jnp.broadcast_to(more, (x.shape[0], *more.shape[1:]))], axis=1)
        if self.pre_norm is not None:
            x = self.pre_norm(x)
        turn = None
        if form.rotary:
            turn = partial(_rotated, angles=self._angles(grid))
        encoded = run_blocks(self.blocks, x, remat=remat, turn=turn)
        hidden = encoded
        if self.trunk is not None:
            hidden = run_blocks(self.trunk, encoded, remat=remat)
        # The images of calibration were read, and have no outputs of their own.
        encoded = encoded[:, :length]
        hidden = hidden[:, :length]
        normed = self.post_norm(hidden)
        last = self.pool or self.projection
        projected = normed if last is None else last(normed)
        return VitOutput(encoded, hidden, normed, projected)

    def _sequence(self, clip: Array, sensor: Array, grid: tuple[int, int, int]) -> Array:
        """Return [class, registers, sensor tokens, patches] (B, S, D) with their positions."""
        x = self.patch(clip)
        batch, _, width = x.shape
        # A stored table has the position of the class token first; a computed one has none.
        position = None if self.form.rotary else self._positions(grid)
        if position is not None:
            x = x + position[None, -x.shape[1] :].astype(x.dtype)
        parts = []
        if self.class_token is not None:
            first = self.class_token[...]
            if self.position is not None and position is not None:
                first = first + position[0]
            parts.append(jnp.broadcast_to(first[None, None], (batch, 1, width)))
        if self.registers is not None:
            registers = self.registers[...]
            parts.append(jnp.broadcast_to(registers[None], (batch, *registers.shape)))
        if self.sensor_tokens is not None:
            parts.append(rows_of(self.sensor_tokens[...], sensor))
        return jnp.concatenate([*(part.astype(x.dtype) for part in parts), x], axis=1)

    def _angles(self, grid: tuple[int, ...]) -> Array:
        """Return the angles f32 (N, D / H / 2) of rotary positions (DINOv3).

        They are 2 pi times the places of the patches in -1..1, over the periods.
        """
        assert self.periods is not None
        axes = [(np.arange(side, dtype=np.float32) + 0.5) / side * 2 - 1 for side in grid[1:]]
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2, 1)
        angles = jnp.asarray(2 * np.pi * places / self.periods[...][None, None])
        return angles.reshape(len(places), -1)

    def _positions(self, grid: tuple[int, int, int]) -> Array:
        """Return positions of a grid (time, rows, columns).

        Stored ones come after that of the class token, and are resized to the grid.
        """
        if self.frequency is not None:
            return self._waves(grid)
        assert self.position is not None and self.form.grid is not None
        stored = self.position[...]
        time, rows, columns = self.form.grid
        if grid == self.form.grid:
            return stored
        if self.form.resample == "none" or grid[0] != time:
            asked = " x ".join(map(str, grid))
            there = " x ".join(map(str, self.form.grid))
            raise ValueError(
                f"the positions are those of {there} patches (time, rows, columns), not {asked}"
            )
        down = cubic(rows, grid[1], self.form.resample)
        across = cubic(columns, grid[2], self.form.resample)
        first, patches = jnp.split(stored, [len(stored) - time * rows * columns])
        patches = patches.reshape(time, rows, columns, -1)
        # Exactly the authors' filter, so not in the reduced precision of an accelerator.
        resized = jnp.einsum("ir,jc,trcd->tijd", down, across, patches, precision="highest")
        return jnp.concatenate([first, resized.reshape(-1, resized.shape[-1])])

    def _waves(self, grid: tuple[int, int, int]) -> Array:
        """Return computed positions (N, D): per axis [sines, cosines] of whole coordinates."""
        assert self.frequency is not None
        frequency = self.frequency[...]
        axes = [np.arange(side) for side in grid]
        places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        # rows and columns, or time before them
        places = places[:, 3 - len(frequency) :]
        angle = places[:, :, None].astype(np.float32) * frequency[None]
        waves = jnp.concatenate([jnp.sin(angle), jnp.cos(angle)], axis=-1)
        # A width that the axes do not divide is cut.
        return waves.reshape(len(places), -1)[:, : self.form.model.touch.width]


def _rotated(x: Array, angles: Array) -> Array:
    """Return queries or keys (B, S, H, D) with rotary positions (Su et al., 2021).

    The last N tokens are rotated by `angles` (N, D / 2); those before are no patches.
    """
    first, patches = jnp.split(x, [x.shape[1] - len(angles)], axis=1)
    cos = jnp.cos(angles)[None, :, None].astype(x.dtype)
    sin = jnp.sin(angles)[None, :, None].astype(x.dtype)
    # DINOv3 pairs channel i with channel i + D / 2.
    one, two = jnp.split(patches, 2, axis=-1)
    rotated = jnp.concatenate([one * cos - two * sin, two * cos + one * sin], axis=-1)
    return jnp.concatenate([first, rotated], axis=1)


def cubic(old: int, new: int, resample: Resample = "bicubic") -> np.ndarray:
    """Return the matrix f64 (new, old) of torch's cubic filter for one axis (align_corners=False).

    "bicubic" has four taps. Those beyond the border fall on it.
    "shifted" has the scale (new + 0.1) / old.
    "antialias" widens the filter where the axis shrinks, and leaves out what is beyond the border.
    """
    wide = resample == "antialias"
    if wide:
        # PIL's coefficient, which torch takes with antialiasing
        a = -0.5
        ratio = old / new
        zoom = max(ratio, 1.0)
    else:
        a = -0.75
        ratio = old / (new + 0.1 * (resample == "shifted"))
        zoom = 1.0
    # the centre of each new cell in old cells, and the old cells that the filter may reach
    centre = (np.arange(new)[:, None] + 0.5) * ratio - 0.5
    taps = np.floor(centre).astype(int) + np.arange(-int(2 * zoom) - 1, int(2 * zoom) + 3)
    far = np.abs(centre - taps) / zoom
    # Keys' cubic (1981): one polynomial up to a distance of 1, another up to 2, then nothing.
    near_weight = ((a + 2) * far - (a + 3)) * far**2 + 1
    far_weight = a * (((far - 5) * far + 8) * far - 4)
    weight = np.where(far <= 1, near_weight, np.where(far < 2, far_weight, 0))
    if wide:
        weight = np.where((taps >= 0) & (taps < old), weight, 0)
        weight = weight / weight.sum(axis=1, keepdims=True)
    matrix = np.zeros((new, old))
    # add.at, because taps beyond the border fall on one cell
    np.add.at(matrix, (np.arange(new)[:, None], np.clip(taps, 0, old - 1)), weight)
    return matrix
