"""RGB images of the touched place: a shaded height map, with random view, light and background.

They are RGB images for the vision tower. Everything is a plane of float32, because a data set and
training make thousands of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.sim.world.objects import Object
from anytouch_jax.sim.world.shapes import Shape, base, floor, layers, unroll

Image = npt.NDArray[np.float32]  # (H, W) or (H, W, 3)
# x, y, z or red, green, blue: separate planes are faster than a last axis of 3
Planes = tuple[Image, Image, Image]
EXTENT = (30.0, 40.0)  # mm across the image


@dataclass(frozen=True)
class CameraView:
    """A camera and a lamp."""

    eye: npt.NDArray[np.float64]  # (3,) mm from the place
    axes: npt.NDArray[np.float64]  # (3, 3) unit vectors right, down, ahead
    extent: float  # mm across the image at the place
    light: npt.NDArray[np.float64]  # (3,) unit vector to the lamp


def seeded_photograph(job: tuple[Object, Any, Sequence[int]], size: int) -> np.ndarray:
    """Return `RGB image` of an object, a place and a seed, for a pool of processes."""
    thing, place, seed = job
    rng = np.random.default_rng([*seed, *np.asarray(place, np.float32).view(np.uint32)])
    return photograph(thing, place, rng, size)


def photograph(
    thing: Object, place_mm: Any, rng: np.random.Generator, size: int = 224
) -> np.ndarray:
    """Return an RGB RGB image u8 (size, size, 3) of an object.

    Args:
        thing: The object.
        place_mm: (x, y) mm in its frame, which is in the middle of the image.
        rng: Draws view, light and background. The image shows 30 to 40 mm.
        size: Pixels of a side.
    """
    place = np.asarray(place_mm, np.float64)
    shape = thing.shape
    view = _draw_view(rng)
    x, y, z, ray = _trace(shape, place, view, size)
    on_table = z <= floor(shape) + 0.25
    texture, grain = _fine(shape, x, y, ~on_table)
    normal = _normals(
        x, y, z - shape.texture_depth * (1 - texture) - shape.grain_depth * (1 - grain)
    )
    lit = np.clip(_dot(normal, view.light), 0, 1) * (1 - 0.75 * _shadow(shape, x, y, z, view.light))
    millimetre = size / view.extent
    # light does not reach into corners
    dip = np.clip(_blur(z, 1.2 * millimetre) - z, 0, 0.8)
    ambient = (1 - 0.45 * min(1.0, shape.texture_depth / 0.3) * (1 - texture)) * (1 - 0.7 * dip)
    ambient *= 0.55 + 0.45 * normal[2]
    mottle = thing.material.mottle
    blotch = _noise(rng, size, 10)
    skin = 1 + 0.3 * mottle * (grain - 0.6) + 0.12 * mottle * blotch - 0.08 * (1 - texture)
    skin = skin.astype(np.float32)
    sky = rng.uniform(0.25, 0.4)
    sun = rng.uniform(0.5, 0.75)
    lamp = (1.0, rng.uniform(0.88, 1.0), rng.uniform(0.75, 1.05))
    shine = np.where(on_table, np.float32(0), _shine(thing, normal, ray, view.light, lit))
    tint = thing.colour if thing.material.metallic else (1.0, 1.0, 1.0)
    planes = []
    for i, ground in enumerate(_table(rng, x, y, place)):
        colour = np.where(on_table, ground, skin * np.float32(thing.colour[i]))
        light = sky * ambient + (sun * lamp[i]) * lit
        # Colours are gamma-encoded, and light adds up linearly: hence the square.
        planes.append(colour * colour * light + tint[i] * shine)
    return _develop(planes, rng)


def _draw_view(rng: np.random.Generator) -> CameraView:
    """Draw a camera that looks at the place from above, and a lamp."""
    extent = rng.uniform(*EXTENT)
    turn = rng.uniform(-math.pi, math.pi)
    tilt = math.radians(rng.uniform(0, 38))
    roll = rng.uniform(-math.pi, math.pi)
    away = rng.uniform(1.8, 3.0) * extent
    ahead = -np.asarray(
        [math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), math.cos(tilt)]
    )
    right = np.cross(ahead, [math.cos(roll), math.sin(roll), 0.0])
    right /= np.linalg.norm(right)
    lamp_turn = rng.uniform(-math.pi, math.pi)
    lamp_height = math.radians(rng.uniform(28, 55))
    flat = math.cos(lamp_height)
    light = np.asarray(
        [flat * math.cos(lamp_turn), flat * math.sin(lamp_turn), math.sin(lamp_height)]
    )
    # Rows and y both point down: from above, (right, down, ahead) has the handedness of (x, y, -z).
    return CameraView(
        -away * ahead, np.stack([right, np.cross(right, ahead), ahead]), extent, light
    )


def _remap(image: Image, column: Image, row: Image) -> Image:
    return np.asarray(
        cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT), np.float32
    )


def _blur(image: Image, pixels: float) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), pixels), np.float32)


def _dot(a: Planes, b: Any) -> Image:
    return a[0] * np.float32(b[0]) + a[1] * np.float32(b[1]) + a[2] * np.float32(b[2])


def _trace(
    shape: Shape, place: Any, view: CameraView, size: int
) -> tuple[Image, Image, Image, Planes]:
    """Return where the ray of each pixel meets the bare primitive, and unit rays.

    The places are x, y, z mm in the object's frame. They are a fixed point: of a height z the ray
    is at x0 + lean z, where the primitive has the height z.
    """
    axis = ((np.arange(size) + 0.5) / size - 0.5).astype(np.float32)
    focal = float(np.linalg.norm(view.eye)) / view.extent
    right, down, ahead = view.axes
    ray = [
        axis[None, :] * np.float32(right[i])
        + axis[:, None] * np.float32(down[i])
        + np.float32(focal * ahead[i])
        for i in range(3)
    ]
    lean_x: Image = ray[0] / ray[2]
    lean_y: Image = ray[1] / ray[2]
    # The touched place, not the plane z = 0, is in the middle of the image.
    top = float(base(shape, np.float32(place[:1]), np.float32(place[1:]))[0])
    x0 = np.float32(place[0] + view.eye[0]) - lean_x * np.float32(view.eye[2] + top)
    y0 = np.float32(place[1] + view.eye[1]) - lean_y * np.float32(view.eye[2] + top)

    def step(z: Image, every: int, fraction: float) -> Image:
        """Return one step to the fixed point of z = base(ray at z), damped for steep sides."""
        rough = [a[::every, ::every] for a in (x0, y0, lean_x, lean_y)]
        return (1 - fraction) * z + fraction * base(
            shape, rough[0] + rough[2] * z, rough[1] + rough[3] * z
        )

    z = np.full(x0[::2, ::2].shape, top, np.float32)
    for _ in range(5):
        z = step(z, 2, 0.6)
    large = cv2.resize(z, (size, size), interpolation=cv2.INTER_LINEAR)
    z = step(np.asarray(large, np.float32), 1, 0.6)
    x = x0 + lean_x * z
    y = y0 + lean_y * z
    near: Image = 1 / np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
    return x, y, base(shape, x, y), (ray[0] * near, ray[1] * near, ray[2] * near)


def _fine(shape: Shape, x: Image, y: Image, where: npt.NDArray[np.bool_]) -> tuple[Image, Image]:
    """Return texture and grain at x, y, and 1 outside of `where`.

    They are computed on a raster of the unrolled surface and looked up there, because a random
    texture is a matrix product on a raster and a sum of cosines elsewhere.
    """
    ones = np.ones_like(x)
    plain = shape.texture == "smooth" and shape.grain == "none"
    if plain or not where.any():
        return ones, ones
    u, v = unroll(shape, x, y)
    finest = shape.texture_pitch
    if shape.grain != "none":
        finest = min(shape.grain_pitch, shape.texture_pitch)
    # mm, about one pixel of an RGB image of 224
    step = float(np.clip(finest / 6, 0.15, 0.25))
    axes = []
    places = []
    for at in (u, v):
        # At a grazing view a ray meets the surface far away. 80 mm are more than any object.
        low, high = (
            max(-80.0, min(80.0, float(end))) for end in (at[where].min(), at[where].max())
        )
        count = math.ceil((high - low) / step) + 3
        axes.append((low - step + step * np.arange(count)).astype(np.float32))
        places.append((at - np.float32(low - step)) / np.float32(step))
    rows = range(0, len(axes[1]), 32)  # strips fit the cache: twice as fast
    strips = [layers(shape, axes[0][None, :], axes[1][row : row + 32, None]) for row in rows]
    texture, grain = (
        np.where(where, _remap(np.concatenate(layer), places[0], places[1]), ones)
        for layer in zip(*strips, strict=True)
    )
    return texture, grain


def _slope(plane: Image, right: int, down: int) -> Image:
    """Return the derivative of a plane to the right or down."""
    # Replicated borders halve all three components, so the normal keeps its direction there.
    return np.asarray(
        cv2.Scharr(plane, cv2.CV_32F, right, down, borderType=cv2.BORDER_REPLICATE), np.float32
    )


def _normals(x: Image, y: Image, z: Image) -> Planes:
    """Return unit normals of the surface (x, y, z) over the pixels, facing up."""
    ax, ay, az = (_slope(p, 1, 0) for p in (x, y, z))
    bx, by, bz = (_slope(p, 0, 1) for p in (x, y, z))
    nx = ay * bz - az * by
    ny = az * bx - ax * bz
    nz = ax * by - ay * bx
    scale = np.where(nz < 0, np.float32(-1), np.float32(1)) / np.sqrt(
        nx * nx + ny * ny + nz * nz + np.float32(1e-12)
    )
    return nx * scale, ny * scale, nz * scale


def _shadow(shape: Shape, x: Image, y: Image, z: Image, light: Any) -> Image:
    """Return 0 in the light to 1 in the shade, at half resolution.

    Steps go toward the lamp over the primitive. What rises above the ray by a quarter of the way
    shades it fully, so shadows are soft, and softer farther away.
    """
    half = [np.ascontiguousarray(a[::2, ::2]) for a in (x, y, z)]
    dark = np.zeros_like(half[0])
    lamp = light.astype(np.float32)
    for away in np.asarray((0.7, 1.5, 2.6, 4.2, 6.5, 9.5), np.float32):
        above = base(shape, half[0] + away * lamp[0], half[1] + away * lamp[1])
        dark = np.maximum(dark, (above - half[2] - away * lamp[2]) / (np.float32(0.25) * away))
    dark = _blur(np.clip(dark, 0, 1), 1.5)
    return np.asarray(cv2.resize(dark, x.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def _noise(rng: np.random.Generator, size: int, cells: int) -> Image:
    """Return smooth noise (size, size) of about -1 to 1, with `cells` blobs across."""
    coarse = rng.standard_normal((cells, cells), dtype=np.float32) * 0.5
    return np.asarray(cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC), np.float32)


def _shine(thing: Object, normal: Planes, ray: Planes, light: Any, lit: Image) -> Image:
    """Return highlights: of the lamp, and on glossy objects of the sides of the room."""
    gloss = thing.material.gloss
    metallic = thing.material.metallic
    if gloss < 0.03:
        return np.zeros_like(lit)
    facing = 2 * _dot(ray, normal)
    mirrored = (
        ray[0] - facing * normal[0],
        ray[1] - facing * normal[1],
        ray[2] - facing * normal[2],
    )
    lamp = np.exp((8 + 80 * gloss) * (np.minimum(_dot(mirrored, light), 1) - 1)) * (lit > 0)
    room = 0.5 + 0.5 * np.sin(4 * mirrored[0] + 2.5 * mirrored[1] + 1)
    grazing = 1 - np.clip(mirrored[2], 0, 1)
    # Metal reflects at all angles, and everything else at a grazing one.
    if metallic:
        around = 0.45 * room - 0.1
    else:
        around = room * (0.05 + 0.35 * grazing * grazing * grazing)
    return np.asarray(gloss * (0.7 * lamp + around), np.float32)


def _table(rng: np.random.Generator, x: Image, y: Image, place: Any) -> Planes:
    """Return red, green and blue of the table: planks, cloth or paper with clutter."""
    # pixels, mm
    side = 160
    span = 110.0
    colour = rng.uniform(0.12, 0.85) * (1 + rng.uniform(-0.2, 0.2, 3))
    canvas = np.ones((side, side, 3), np.float32) * colour.astype(np.float32)
    for _ in range(int(rng.integers(0, 6))):
        ink = rng.uniform(0.05, 0.9, 3).tolist()
        centre = rng.integers(0, side, 2)
        if rng.random() < 0.5:
            axes = rng.integers(6, 40, 2).tolist()
            turn = float(rng.uniform(0, 180))
            cv2.ellipse(canvas, centre.tolist(), axes, turn, 0, 360, ink, -1, cv2.LINE_AA)
        else:
            end = centre + rng.integers(-90, 90, 2)
            width = int(rng.integers(2, 24))
            cv2.line(canvas, centre.tolist(), end.tolist(), ink, width, cv2.LINE_AA)
    canvas = _blur(canvas, rng.uniform(0.6, 2.0))
    if rng.random() < 0.5:  # fibres
        cells = int(rng.integers(20, 60))
        stretched = cv2.resize(_noise(rng, side, cells), (6 * side, side))
        weft = np.asarray(stretched[:, :side], np.float32)
    else:
        weft = _noise(rng, side, 64)
    canvas *= 1 + np.float32(rng.uniform(0, 0.25)) * weft[..., None]
    column, row = (
        (a - np.float32(b)) * (side / span) + side / 2 for a, b in ((x, place[0]), (y, place[1]))
    )
    red, green, blue = (_remap(np.ascontiguousarray(canvas[..., i]), column, row) for i in range(3))
    return red, green, blue


def _develop(planes: Sequence[Image], rng: np.random.Generator) -> np.ndarray:
    """Apply exposure, vignette, blur, noise and gamma to red, green and blue.

    Returns u8 (H, W, 3).
    """
    size = planes[0].shape[0]
    axis: Image = np.linspace(-1, 1, size, dtype=np.float32) ** 2
    brightness = np.float32(rng.uniform(0.85, 1.15))
    exposure = brightness * (1 - np.float32(rng.uniform(0, 0.12)) * (axis[:, None] + axis))
    # One plane for all channels: noise of brightness, not of colour.
    deviation = np.float32(255 * rng.uniform(0.004, 0.012))
    noise = deviation * rng.standard_normal((size, size), dtype=np.float32)
    channels = []
    for plane in planes:
        light = np.clip(_blur(plane * exposure, max(0.3, 0.6 * size / 224)), 0, None)
        # gamma, with a soft shoulder
        encoded = np.sqrt(light / (np.float32(0.75) + np.float32(0.35) * light))
        channels.append(np.clip(255 * encoded + noise + np.float32(0.5), 0, 255).astype(np.uint8))
    return np.asarray(cv2.merge(channels), np.uint8)
