"""Surfaces of objects in millimetres: a primitive, a texture on it, and the fine grain of its material."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.sim.world.primitives import PRIMITIVES, STROKES, floor
from anytouch_jax.sim.world.textures import GRAINS, TEXTURES, Array, namespace, warp


@dataclass(frozen=True)
class Shape:
    """A touchable surface. Lengths are in mm, angles in radians.

    `size` is the radius of a sphere, cylinder, screw, ring, flat face or cone's base, the rim's radius of an edge or
    corner, or the height of a letter. The texture is between 0 and -`texture_depth` under the primitive, rotated by
    `texture_angle`. `irregularity` bends a repeating texture by this share of its pitch. The `grain` is a second, finer
    texture. Raises UserError for an unknown name, a size or pitch of 0 or less, or a negative depth.
    """

    primitive: str
    texture: str = "smooth"
    size: float = 6.0
    texture_pitch: float = 1.5
    texture_depth: float = 0.25
    seed: int = 0
    texture_angle: float = 0.0
    irregularity: float = 0.0
    grain: str = "none"
    grain_pitch: float = 0.8
    grain_depth: float = 0.0
    letter: str = "A"

    def __post_init__(self) -> None:
        tables: tuple[tuple[str, Collection[str]], ...] = (
            ("primitive", PRIMITIVES), ("texture", TEXTURES), ("grain", GRAINS), ("letter", STROKES),
        )  # fmt: skip
        for field, table in tables:
            name = getattr(self, field)
            if name not in table:
                raise UserError(f"there is no {field} {name!r}; choose one of {', '.join(table)}")
        for field in ("size", "texture_pitch", "grain_pitch"):
            value = getattr(self, field)
            if not (math.isfinite(value) and value > 0):
                raise UserError(f"a shape's {field} must be above 0 mm, not {value}")
        for field in ("texture_depth", "irregularity", "grain_depth"):
            value = getattr(self, field)
            if not (math.isfinite(value) and value >= 0):
                raise UserError(f"a shape's {field} may not be below 0, as {value} is")
        if not math.isfinite(self.texture_angle) or self.seed < 0:
            raise UserError(
                f"a shape's texture_angle must be finite and its seed not negative, "
                f"not {self.texture_angle} and {self.seed}"
            )


def base(shape: Shape, x: Array, y: Array) -> Array:
    """Return heights in mm of the primitive at `x`, `y` mm, from 0 at its highest place down to the table."""
    return namespace(x).clip(PRIMITIVES[shape.primitive](shape, x, y), floor(shape), 0)


def unroll(shape: Shape, x: Array, y: Array) -> tuple[Array, Array]:
    """Return places (u, v) in mm on the flattened surface, in the frame of the texture."""
    xp, r = namespace(x), shape.size
    if shape.primitive in ("cylinder", "screw"):
        x = r * xp.arcsin(xp.clip(x / r, -1, 1))
    elif shape.primitive == "sphere":
        away = xp.clip(xp.hypot(x, y) / r, 1e-6, 1)
        stretch = xp.arcsin(away) / away
        x, y = x * stretch, y * stretch
    c, s = math.cos(shape.texture_angle), math.sin(shape.texture_angle)
    return c * x + s * y, c * y - s * x


def layers(shape: Shape, u: Array, v: Array) -> tuple[Array, Array]:
    """Return texture and grain at the unrolled places `u`, `v` mm, each from 0 (low) to 1 (high)."""
    if shape.texture in ("bark", "sand"):
        s, t = u, v  # random already
    else:
        s, t = warp(u, v, shape.texture_pitch, shape.irregularity, shape.seed)
    texture = TEXTURES[shape.texture](s, t, shape.texture_pitch, shape.seed)
    return texture, GRAINS[shape.grain](u, v, shape.grain_pitch, shape.seed + 100)


def height(shape: Shape, x: Array, y: Array) -> Array:
    """Return heights z mm toward the gel at `x`, `y` mm in the object's frame, numpy or JAX arrays of one shape.

    The highest place of the primitive is 0, and texture and grain only lower it. Float32, or float64 for such inputs.
    Raises UserError if the shapes of `x` and `y` differ.
    """
    x, y = _floating(x), _floating(y)
    if x.shape != y.shape:
        raise UserError(f"x and y must have one shape, not {x.shape} and {y.shape}")
    z = base(shape, x, y)
    textured = shape.texture != "smooth" and shape.texture_depth > 0
    grained = shape.grain != "none" and shape.grain_depth > 0
    if not (textured or grained):
        return z
    texture, grain = layers(shape, *unroll(shape, x, y))
    if textured:
        z = z - shape.texture_depth * (1 - texture)
    return z - shape.grain_depth * (1 - grain) if grained else z


def _floating(x: Array) -> Array:
    x = x if hasattr(x, "__array_namespace__") else np.asarray(x)
    return x if x.dtype in (np.float32, np.float64) else x.astype(np.float32)


def relief(shape: Shape, pixels: int, pitch: float) -> np.ndarray:
    """Return heights (pixels, pixels) f32 mm with `pitch` mm between pixels. The object's origin is in the centre.

    Raises UserError without pixels, or for a pitch of 0 or less.
    """
    if pixels < 1 or not (math.isfinite(pitch) and pitch > 0):
        raise UserError(f"a raster needs at least one pixel and a pitch above 0 mm, not {pixels} and {pitch}")
    axis = ((np.arange(pixels) - (pixels - 1) / 2) * pitch).astype(np.float32)
    x, y = np.meshgrid(axis, axis)
    return np.asarray(height(shape, x, y), np.float32)
