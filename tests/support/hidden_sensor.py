"""Images of a simulated device with hidden parameters, as if a user had taken them."""

from __future__ import annotations

from functools import cache, partial
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.sim import endless
from anytouch_jax.sim.recorder import RELIEF, View, ball, simulate_clip
from anytouch_jax.sim.scene import Scenes
from anytouch_jax.sim.sensing.optics import tilt
from anytouch_jax.sim.sensing.sensors import POWERS, SENSORS, draw_unit

SHAPE = 120, 160  # pixels of an image, or upright
FRACTION = 0.8  # of the touches that press


class Hidden(NamedTuple):
    """Images u8 (N, h, w, 3), the device, and the numbers of its family.

    An image shows `width` mm.
    """

    frames: Any
    background: Any
    unit: Any
    numbers: Any
    width: float


@cache
def _program(shape: tuple[int, int]) -> Any:
    def one(clip: Any, numbers: Any, pitch: Any) -> Any:
        view = View((endless.GRID, endless.GRID), pitch, shape, numbers.photometry, True)
        return simulate_clip(clip, sensor=endless.as_sensor(numbers), fidelity="fast", view=view)

    return jax.jit(jax.vmap(one))


@cache
def _drawn(name: str, count: int) -> Any:
    things = endless.objects_of(Scenes(objects=48, seed=7, depth=(0.3, 1.0)))[:24]
    world = endless.make_world(things, (name,))
    sampling = endless.Sampling(takes=1, depth=(0.3, 1.0), free=1 - FRACTION)
    draw = jax.jit(partial(endless.draw_touches, sampling=sampling, count=count))
    return partial(draw, world=world)


def hidden_images(
    name: str,
    seed: int,
    count: int = 20,
    *,
    ball_mm: float | None = None,
    marked: float = 0.0,
    noise: float = 0.8,
    turned: bool = True,
    deepest: float = 1.0,
    **unit_values: Any,
) -> Hidden:
    """Return images of a device of a known family whose lights have changed places and whose
    parameters are drawn.
    """
    rng = np.random.default_rng([seed, 59])
    shape = SHAPE if SENSORS[name].field[0] < SENSORS[name].field[1] else SHAPE[::-1]
    touches = jax.device_get(_drawn(name, count)(jax.random.key(seed)))
    clip, numbers = jax.tree.map(lambda x: np.array(x[:, 0]), (touches.clip, touches.numbers))
    family = endless.family(SENSORS[name])
    order = rng.permutation(3) if turned else np.arange(3)
    light = family.photometry._replace(
        normal=family.photometry.normal[..., order], halo=family.photometry.halo[..., order]
    )
    family = family._replace(photometry=light)
    base = draw_unit(SENSORS[name], rng)
    unit = base._replace(
        base=np.asarray(endless.untouched(SENSORS[name])[0]),
        marked=np.float32(marked),
        mirror=np.ones(2, np.float32),
        noise=np.float32(noise),
        grain=np.array([0.5, seed], np.float32),
        zoom=np.float32(rng.uniform(0.8, 1.0)),
        rotation=np.float32(0),
        offset=np.zeros(2, np.float32),
    )._replace(**{key: np.asarray(value, np.float32) for key, value in unit_values.items()})
    unit = unit._replace(window=np.zeros(2, np.float32))
    many = jax.tree.map(
        lambda x: np.broadcast_to(np.asarray(x, np.float32), (count, *np.shape(x))), unit
    )
    clip = clip._replace(unit=many)
    numbers = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), (count, *np.shape(x))), family)
    if ball_mm:
        relief = np.full((RELIEF, RELIEF), -ball_mm / 2, np.float32)
        size = RELIEF // 2
        relief[size // 2 : -size // 2, size // 2 : -size // 2] = ball(ball_mm, size)
        half = (
            0.3 * SENSORS[name].field[1] * float(unit.zoom),
            0.3 * SENSORS[name].field[0] * float(unit.zoom),
        )
        spots = rng.uniform(-1, 1, (count, 2)) * half
        depth = np.where(np.arange(count) % 5 == 4, -1.0, rng.uniform(0.3, deepest, count))
        clip = clip._replace(
            relief=np.broadcast_to(relief, (count, RELIEF, RELIEF)),
            place=np.zeros((count, 2), np.float32),
            start=np.concatenate([spots, np.zeros((count, 1))], 1).astype(np.float32),
            motion=np.zeros((count, 1, 3), np.float32),
            depth=depth[:, None].astype(np.float32),
            tilt=np.zeros((count, 2), np.float32),
            modulus=np.full(count, 1e6, np.float32),
        )
    pitch = np.full(count, max(SENSORS[name].field) / endless.GRID, np.float32)
    out = jax.device_get(_program(shape)(clip, numbers, pitch))
    return Hidden(
        out.image[:, 0], out.background[0], unit, family, float(unit.zoom) * SENSORS[name].field[1]
    )


def colours_of_dents(look: Any, halo_mm: Any, gain: Any = 1.0, angle: float = 0.0) -> np.ndarray:
    """Return the colours (3, 3) that an image shows in its middle: by slope along x and y, and by
    mm of depth.

    They are the least squares fit to round dents of several widths.
    """
    line = (np.arange(97) - 48) * 0.1
    x, y = np.meshgrid(line, line)
    rows = []
    changes = []
    for wide in (0.5, 1.0, 2.0):
        dent = 0.8 * wide * np.exp(-(x**2 + y**2) / (2 * wide**2))
        soft = cv2.GaussianBlur(dent, (0, 0), float(halo_mm) / 0.1)
        sy, sx = np.gradient(dent, 0.1)
        hy, hx = np.gradient(soft, 0.1)
        c = np.cos(angle)
        s = np.sin(angle)
        nx, ny = (
            a.ravel()
            for a in tilt(jnp.asarray(c * sx - s * sy), jnp.asarray(s * sx + c * sy), look.steepest)
        )
        glow = np.stack([c * hx - s * hy, s * hx + c * hy, soft], -1).reshape(-1, 3)
        glow = np.clip(glow, -np.asarray(look.widest), np.asarray(look.widest))
        powers = np.stack([np.asarray(nx) ** i * np.asarray(ny) ** j for i, j in POWERS], 1)
        changes.append(
            (powers @ np.asarray(look.normal)[:, 0] + glow @ np.asarray(look.halo)[:, 0]) * gain
        )
        rows.append(np.stack([sx.ravel(), sy.ravel(), dent.ravel()], 1))
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(changes), rcond=None)[0]


def true_colours(hidden: Hidden) -> np.ndarray:
    """Return the colours (3, 3) of a device's dents in the middle of its image."""
    u, v = np.asarray(hidden.unit.lights)[:2]
    terms = np.array([1, u, v, u * u, u * v, v * v])
    light = hidden.numbers.photometry
    normal = np.einsum("kpc,p->kc", np.asarray(light.normal), terms)[:, None]
    halo = np.einsum("kpc,p->kc", np.asarray(light.halo), terms[:3])[:, None]
    shade = hidden.unit.tint * (1 + terms[1:] @ np.asarray(hidden.unit.uneven))
    return colours_of_dents(
        light._replace(normal=normal, halo=halo),
        hidden.numbers.shade[3],
        hidden.unit.gain * shade,
        float(hidden.unit.light_angle),
    )
