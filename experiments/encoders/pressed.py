"""Height maps of what people press: studs, nuts, keys, coins, threads, cloth, stairs, small balls.

The objects of `sim.world` are balls, rods and textures: few of them are flat inside of the image,
and none is smaller than 4 mm. These are for training the decoder of fields alone, beside those. A
map is (RELIEF, RELIEF) mm with `SPACING` mm between pixels and its highest place at 0. Like real
parts none has a quite sharp edge.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.sim.recorder import RELIEF, SPACING

Map = npt.NDArray[np.float32]
Rng = np.random.Generator
FLOOR = 5.0  # mm below the highest place, where there is nothing
_LINE = ((np.arange(RELIEF) - (RELIEF - 1) / 2) * SPACING).astype(np.float32)
_FONTS = (cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SIMPLEX)


def _places(rng: Rng, away: float) -> tuple[Map, Map]:
    """Return x and y mm of a turned frame whose origin is up to `away` mm off the middle."""
    angle = rng.uniform(0, 2 * math.pi)
    distance = away * math.sqrt(rng.uniform())
    towards = rng.uniform(0, 2 * math.pi)
    x = _LINE[None] - np.float32(distance * math.cos(towards))
    y = _LINE[:, None] - np.float32(distance * math.sin(towards))
    c = np.float32(math.cos(angle))
    s = np.float32(math.sin(angle))
    return c * x + s * y, c * y - s * x


def _flat(outside: Map, height: float) -> Map:
    """Return a flat top where the distance `outside` mm is below 0, with a steep side."""
    return -np.clip(4 * outside, 0, height).astype(np.float32)


def _box(x: Map, y: Map, half: tuple[float, float]) -> Map:
    """Return the distance mm from a rectangle, negative inside."""
    over = np.stack([np.abs(x) - half[0] + 0 * y, np.abs(y) - half[1] + 0 * x])
    return np.hypot(*np.maximum(over, 0)) + np.minimum(over.max(0), 0)


def _polygon(x: Map, y: Map, sides: int, radius: float) -> Map:
    """Return the distance mm from the sides of a regular polygon of an inner radius."""
    angles = 2 * math.pi * np.arange(sides) / sides
    return np.max([x * math.cos(a) + y * math.sin(a) for a in angles], axis=0) - radius


def _rounded(rng: Rng, surface: Map, most: float = 0.25) -> Map:
    """Return the surface with edges rounded over a random length."""
    return cv2.GaussianBlur(surface, (0, 0), rng.uniform(0.08, most) / SPACING)


def studs(rng: Rng) -> Map:
    """Flat round or square studs in a grid, as on building bricks."""
    x, y = _places(rng, 3)
    radius = rng.uniform(0.7, 3.2)
    pitch = radius * rng.uniform(2.5, 4.5)
    row = np.round(y / pitch)
    shift = rng.choice([0.0, 0.5])
    u = x + shift * pitch * (row % 2)
    u = u - pitch * np.round(u / pitch)
    v = y - pitch * row
    outside = np.hypot(u, v) - radius if rng.random() < 0.7 else _box(u, v, (radius, radius))
    return _rounded(rng, _flat(outside, rng.uniform(0.3, 2.5)))


def stamp(rng: Rng) -> Map:
    """One flat face: a punch, a plate, a nut or a washer."""
    x, y = _places(rng, 5)
    size = rng.uniform(1.0, 6.0)
    kind = rng.integers(4)
    if kind == 0:
        outside = np.hypot(x, y) - size
    elif kind == 1:
        outside = _box(x, y, (size, size * rng.uniform(0.3, 1.0)))
    else:
        outside = _polygon(x, y, int(rng.choice([3, 5, 6, 8])), size)
    if rng.random() < 0.4:
        outside = np.maximum(outside, size * rng.uniform(0.3, 0.75) - np.hypot(x, y))
    return _rounded(rng, _flat(outside, FLOOR), 0.4)


def stairs(rng: Rng) -> Map:
    """Flat levels side by side, with steps of different heights and a slight tilt."""
    x, _ = _places(rng, 2)
    edges = np.cumsum(rng.uniform(1.5, 5.0, 6)) - 8
    steps = rng.uniform(0.08, 0.8, 6) * rng.choice([-1, 1], 6)
    if rng.random() < 0.5:
        steps = -np.abs(steps)
    surface = sum(s * np.clip(4 * (x - e), 0, 1) for s, e in zip(steps, edges, strict=True))
    return _rounded(rng, np.asarray(surface, np.float32))


def ledge(rng: Rng) -> Map:
    """A plate that ends, a corner, or flat bars beside each other."""
    x, y = _places(rng, 4)
    kind = rng.integers(3)
    if kind == 0:
        outside = x
    elif kind == 1:
        outside = np.maximum(x, y)
    else:
        width = rng.uniform(0.4, 3.0)
        pitch = 2 * width + rng.uniform(0.5, 5.0)
        outside = np.abs(x - pitch * np.round(x / pitch)) - width + 0 * y
    return _rounded(rng, _flat(outside, rng.choice([0.3, 0.6, 1.0, 2.0, FLOOR])), 0.5)


def thread(rng: Rng) -> Map:
    """A threaded rod with flat or sharp crests."""
    x, y = _places(rng, 4)
    radius = rng.uniform(1.5, 8.0)
    pitch = rng.uniform(0.5, 2.0)
    turn = np.arcsin(np.clip(x / radius, -1, 1)) / (2 * math.pi)
    wave = np.abs((y / pitch - turn) % 1 - 0.5) * 2
    crest = np.clip((wave - rng.uniform(0, 0.4)) * 1.5, 0, 1)
    dome = np.sqrt(np.clip(radius**2 - x**2, 0, None)) - radius + 0 * y
    return _rounded(rng, np.float32(dome - 0.55 * pitch * crest), 0.15)


def key(rng: Rng) -> Map:
    """A flat key: a bow with a hole, a blade with teeth and a groove."""
    x, y = _places(rng, 5)
    half = rng.uniform(1.5, 4.0)
    tooth = rng.uniform(1.2, 3.0)
    phase = rng.uniform(0, 1)
    cells = np.floor(x / tooth + phase).astype(int)
    cuts = rng.uniform(0, 0.6, 64) * half
    teeth = cuts[cells % 64] + (cuts[(cells + 1) % 64] - cuts[cells % 64]) * np.clip(
        3 * ((x / tooth + phase) % 1) - 1, 0, 1
    )
    blade = np.maximum(np.abs(y) - half, y - (half - teeth))
    bow = np.hypot(x + 14, y) - rng.uniform(6, 9)
    outside = np.maximum(np.minimum(blade, bow), 1.5 - np.hypot(x + 17, y))
    surface = _flat(outside, rng.uniform(1.0, 2.5))
    groove = np.abs(y + rng.uniform(0, 0.4) * half) - rng.uniform(0.2, 0.5)
    surface = surface - rng.uniform(0.0, 0.6) * np.clip(0.5 - 3 * groove, 0, 1)
    return _rounded(rng, np.float32(surface), 0.2)


def coin(rng: Rng) -> Map:
    """A coin: a rim, a figure and letters raised over a flat face, or sunk into it."""
    x, y = _places(rng, 6)
    radius = rng.uniform(6.0, 13.0)
    away = np.hypot(x, y)
    drawn = np.zeros((RELIEF, RELIEF), np.uint8)
    for _ in range(int(rng.integers(3, 9))):
        at = (RELIEF / 2 + rng.uniform(-0.6, 0.6, 2) * radius / SPACING).astype(int).tolist()
        text = "".join(rng.choice(list("ABCDEGHKMNPRSTUXZ0123456789&"), int(rng.integers(1, 4))))
        size = rng.uniform(0.6, 3.0) * radius / 10
        font = int(rng.choice(_FONTS))
        cv2.putText(drawn, text, at, font, size, 255, int(rng.integers(2, 8)), cv2.LINE_AA)
    figure = cv2.GaussianBlur(drawn.astype(np.float32) / 255, (0, 0), rng.uniform(1, 4))
    if rng.random() < 0.5:
        noise = cv2.GaussianBlur(rng.standard_normal(figure.shape).astype(np.float32), (0, 0), 8)
        figure = figure + np.clip(8 * noise, -0.5, 1)
    deep = rng.uniform(0.04, 0.35)
    rim = np.clip(4 * (away - radius + rng.uniform(0.5, 1.5)), 0, 1)
    raised = np.maximum(figure * rng.choice([-1, 1, 1]), rim)
    surface = deep * raised - np.clip(4 * (away - radius), 0, FLOOR)
    return _rounded(rng, np.float32(surface), 0.15)


def cloth(rng: Rng) -> Map:
    """Woven threads, or cords in one direction, finer than those of `sim.world`."""
    x, y = _places(rng, 3)
    pitch = rng.uniform(0.45, 1.6)
    warp = np.cos(math.pi * (y / pitch + np.round(x / pitch)))
    weft = -np.cos(math.pi * (x / pitch + np.round(y / pitch)))
    across = np.sqrt(np.clip(1 - (2 * (x / pitch - np.round(x / pitch))) ** 2, 0, 1)) + 0 * y
    along = np.sqrt(np.clip(1 - (2 * (y / pitch - np.round(y / pitch))) ** 2, 0, 1)) + 0 * x
    surface = across if rng.random() < 0.3 else np.maximum(across + 0.6 * warp, along + 0.6 * weft)
    surface = surface * rng.uniform(0.12, 0.35) * pitch
    folds = cv2.GaussianBlur(rng.standard_normal(surface.shape).astype(np.float32), (0, 0), 25)
    return _rounded(rng, np.float32(surface + rng.uniform(0, 8) * folds), 0.15)


def blobs(rng: Rng) -> Map:
    """Several balls of different sizes and heights beside each other, or one."""
    surface = np.full((RELIEF, RELIEF), -FLOOR, np.float32)
    count = int(rng.choice([1, 1, 2, 3, 5, 8]))
    for _ in range(count):
        x, y = _places(rng, 2 if count == 1 else 8)
        radius = rng.uniform(1.0, 6.0)
        y = y * rng.choice([1.0, rng.uniform(0.4, 1.0)])
        dome = np.sqrt(np.clip(radius**2 - x**2 - y**2, 0, None)) - radius
        surface = np.maximum(surface, dome - rng.uniform(0, 0.4))
    return np.asarray(surface, np.float32)


def ball(rng: Rng) -> Map:
    """One ball of 2 to 12 mm diameter, which may leave the image."""
    x, y = _places(rng, rng.choice([1.0, 6.0]))
    radius = math.exp(rng.uniform(math.log(1.3), math.log(6.0)))
    return np.float32(np.sqrt(np.clip(radius**2 - x**2 - y**2, 0, None)) - radius)


# Nine of fourteen have flat tops.
FAMILIES: tuple[Callable[[Rng], Map], ...] = (
    *(studs, studs, stamp, stamp, ledge, stairs, key, coin, coin),
    *(thread, cloth, blobs, ball, ball),
)


def draw_maps(count: int, seed: int) -> npt.NDArray[np.float16]:
    """Return `count` maps (count, RELIEF, RELIEF) of the families in turn."""
    maps = []
    for number in range(count):
        surface = FAMILIES[number % len(FAMILIES)](np.random.default_rng([seed, number, 73]))
        surface = np.broadcast_to(surface, (RELIEF, RELIEF))
        maps.append(np.clip(surface - surface.max(), -FLOOR, 0).astype(np.float16))
    return np.stack(maps)
