"""Surfaces of objects in millimetres: a primitive, a texture that rides on it, and the fine grain of its material."""

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
    """A touchable surface; lengths in mm, angles in radians.

    `size` is the radius of a sphere, cylinder, screw, ring, flat face or cone's base, the rim's radius of an edge or
    corner, the height of a letter. The texture lies between 0 and -`texture_depth` under the primitive, turned by
    `texture_angle`; `irregularity` bends a repeating texture by this share of its pitch. The `grain` is a second,
    finer texture of `grain_depth` and `grain_pitch`. Raises UserError on an unknown name, a size or pitch that is not
    positive, or a negative depth.
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
        tables: dict[str, Collection[str]] = {
            "primitive": PRIMITIVES,
            "texture": TEXTURES,
            "grain": GRAINS,
            "letter": STROKES,
        }
        for field, table in tables.items():
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
    """Heights in mm of the bare primitive at `x`, `y` mm; 0 at its highest place, the table at the lowest."""
    return namespace(x).clip(PRIMITIVES[shape.primitive](shape, x, y), floor(shape), 0)


def unroll(shape: Shape, x: Array, y: Array) -> tuple[Array, Array]:
    """Places (u, v) in mm on the surface laid flat, turned into the frame of the texture."""
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
    """Texture and grain at the unrolled places `u`, `v` mm, each from 0 (low) to 1 (high)."""
    if shape.texture in ("bark", "sand"):
        s, t = u, v  # random already
    else:
        s, t = warp(u, v, shape.texture_pitch, shape.irregularity, shape.seed)
    texture = TEXTURES[shape.texture](s, t, shape.texture_pitch, shape.seed)
    return texture, GRAINS[shape.grain](u, v, shape.grain_pitch, shape.seed + 100)


def height(shape: Shape, x: Array, y: Array) -> Array:
    """Heights z in mm toward the gel at `x`, `y` mm in the object's frame (arrays of one shape, numpy's or JAX's).

    0 at the highest place of the primitive; texture and grain only take away. Float32, or float64 when the inputs
    are. Raises UserError when the shapes of `x` and `y` differ.
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
    """The heights as a raster (pixels, pixels) f32 mm of `pitch` mm a pixel, the object's origin in its centre.

    Raises UserError when there is no pixel or the pitch is not positive.
    """
    if pixels < 1 or not (math.isfinite(pitch) and pitch > 0):
        raise UserError(f"a raster needs at least one pixel and a pitch above 0 mm, not {pixels} and {pitch}")
    axis = ((np.arange(pixels) - (pixels - 1) / 2) * pitch).astype(np.float32)
    x, y = np.meshgrid(axis, axis)
    return np.asarray(height(shape, x, y), np.float32)
