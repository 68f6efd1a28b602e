import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.sim.scene import Scenes, draw_touch
from anytouch_jax.sim.world import shapes
from anytouch_jax.sim.world.objects import catalogue
from anytouch_jax.sim.world.shapes import PRIMITIVES, TEXTURES, Shape, base, floor, height, relief


def axes(count, pitch):
    axis = (np.arange(count) - (count - 1) / 2) * pitch
    return np.meshgrid(axis, axis)


@pytest.mark.parametrize(
    ("primitive", "texture"),
    [(p, t) for i, p in enumerate(PRIMITIVES) for t in [*TEXTURES][i % 3 :: 3]],
)
def test_heights_lie_between_the_table_and_the_top(primitive, texture):
    shape = Shape(
        primitive, texture, 6.0, 1.5, 0.3, seed=4, irregularity=0.1, grain="pores", grain_depth=0.05
    )
    z = relief(shape, 96, 0.25)
    assert z.dtype == np.float32 and z.shape == (96, 96) and np.isfinite(z).all()
    assert z.max() <= 0 and z.min() >= floor(shape) - 0.35 - 1e-5
    assert z.max() > -0.36  # textures take away at most their depth
    np.testing.assert_array_equal(z, relief(shape, 96, 0.25))


def test_the_ball_and_the_rod_are_round():
    x, y = axes(41, 0.1)
    r2 = x * x + y * y
    np.testing.assert_allclose(
        height(Shape("sphere", size=7.0), x, y), np.sqrt(49 - r2) - 7, atol=1e-12
    )
    np.testing.assert_allclose(
        height(Shape("cylinder", size=4.0), x, y), np.sqrt(16 - x * x) - 4, atol=1e-12
    )


def test_the_ring_is_a_torus():
    shape = Shape("ring", size=5.0)  # bar of radius 1.5
    angle = np.linspace(0, 6, 9)
    for off, want in ((0.0, 0.0), (0.9, -0.3), (-0.9, -0.3)):
        z = height(shape, (5 + off) * np.cos(angle), (5 + off) * np.sin(angle))
        np.testing.assert_allclose(z, want, atol=1e-9)
    assert height(shape, np.zeros(1), np.zeros(1))[0] == floor(shape) == -1.5


def test_the_thread_winds():
    shape = Shape("screw", size=4.0)
    pitch = shapes.thread_pitch(4.0)
    y = np.linspace(-3, 3, 200)
    crest = height(shape, np.zeros(200), y)
    np.testing.assert_allclose(height(shape, np.zeros(200), y + pitch), crest, atol=1e-9)
    assert np.ptp(crest) == pytest.approx(0.5 * pitch, rel=0.01)
    # A turn about the axis by asin(x / r) moves the thread by that fraction of the pitch; the rod's
    # own fall aside.
    x = 2.0
    moved = pitch * math.asin(x / 4) / (2 * math.pi)
    side = height(shape, np.full(200, x), y + moved) - (math.sqrt(16 - x * x) - 4)
    np.testing.assert_allclose(side, crest, atol=1e-9)


@pytest.mark.parametrize("primitive", PRIMITIVES)
def test_jax_arrays_give_what_numpy_gives(primitive):
    texture = list(TEXTURES)[list(PRIMITIVES).index(primitive) % len(TEXTURES)]
    shape = Shape(
        primitive, texture, 6.0, seed=3, irregularity=0.05, grain="streaks", grain_depth=0.04
    )
    x, y = (a.astype(np.float32) for a in axes(12, 0.4))
    z = jax.jit(lambda x, y: height(shape, x, y))(x, y)
    assert isinstance(z, jax.Array) and z.dtype == jnp.float32
    np.testing.assert_allclose(z, height(shape, x, y), atol=2e-4)


@pytest.mark.parametrize("thing", catalogue(5, 48)[::4], ids=lambda thing: thing.name)
def test_the_places_of_scenes_meet_the_object(thing):
    x, y = axes(60, 0.2)
    scenes = Scenes(touches=8, objects=1)
    for a, b in (draw_touch(scenes, number, ("train",)).place for number in range(8)):
        z = base(thing.shape, x + a, y + b)
        assert (z > z.max() - 0.3).mean() > 0.004 and z.max() > -0.2


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("primitive", "cube"),
        ("texture", "velvet"),
        ("grain", "velvet"),
        ("letter", "Q"),
        ("size", -1.0),
        ("size", math.nan),
        ("texture_pitch", 0.0),
        ("grain_pitch", 0.0),
        ("texture_depth", -0.1),
        ("grain_depth", math.nan),
        ("irregularity", -0.1),
        ("texture_angle", math.inf),
        ("seed", -1),
    ],
)
def test_impossible_shapes_are_named(name, value):
    with pytest.raises(UserError, match=value if isinstance(value, str) else name):
        dataclasses.replace(Shape("sphere"), **{name: value})
