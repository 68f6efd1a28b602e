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
from anytouch_jax.sim.world.shapes import PRIMITIVES, STROKES, Shape, base, floor, height, layers, relief, unroll
from anytouch_jax.sim.world.textures import TEXTURES


def axes(count, pitch):
    axis = (np.arange(count) - (count - 1) / 2) * pitch
    return np.meshgrid(axis, axis)


@pytest.mark.parametrize("primitive", PRIMITIVES)
@pytest.mark.parametrize("texture", TEXTURES)
def test_heights_lie_between_the_table_and_the_top(primitive, texture):
    shape = Shape(primitive, texture, 6.0, 1.5, 0.3, seed=4, irregularity=0.1, grain="pores", grain_depth=0.05)
    z = relief(shape, 96, 0.25)
    assert z.dtype == np.float32 and z.shape == (96, 96) and np.isfinite(z).all()
    assert z.max() <= 0 and z.min() >= floor(shape) - 0.35 - 1e-5
    assert z.max() > -0.36  # textures take away at most their depth
    np.testing.assert_array_equal(z, relief(shape, 96, 0.25))


@pytest.mark.parametrize("texture", [t for t in TEXTURES if t != "smooth"])
def test_the_seed_moves_the_texture_and_smooth_has_none(texture):
    one, two = (relief(Shape("flat", texture, 40, seed=s), 48, 0.2) for s in (1, 2))
    assert np.abs(one - two).max() > 0.05
    assert relief(Shape("flat", "smooth", 40, seed=1), 48, 0.2).any() == False  # noqa: E712
    assert relief(Shape("flat", texture, 40, texture_depth=0.0), 8, 0.2).any() == False  # noqa: E712


@pytest.mark.parametrize("primitive", PRIMITIVES)
def test_the_top_of_a_bare_primitive_is_zero(primitive):
    z = relief(Shape(primitive, size=5.0), 201, 0.1)
    assert z.max() == pytest.approx(0, abs=1e-3)
    assert z.min() >= floor(Shape(primitive, size=5.0)) - 1e-5


def test_the_ball_and_the_rod_are_round():
    x, y = axes(41, 0.1)
    r2 = x * x + y * y
    np.testing.assert_allclose(height(Shape("sphere", size=7.0), x, y), np.sqrt(49 - r2) - 7, atol=1e-12)
    np.testing.assert_allclose(height(Shape("cylinder", size=4.0), x, y), np.sqrt(16 - x * x) - 4, atol=1e-12)


def test_plates_are_level_up_to_their_rims():
    x, y = axes(121, 0.1)
    flat = height(Shape("flat", size=5.0), x, y)
    r = np.hypot(x, y)
    assert not flat[r < 4.5].any() and (flat[r > 4.52] < 0).all() and flat[r > 5].max() < -0.2
    edge = height(Shape("edge", size=1.0), x, y)
    assert not edge[x < -1].any() and (edge[x > -0.98] < 0).all() and edge[x > 1.5].max() < -2
    assert np.ptp(edge, axis=0).max() == 0  # the rim is straight along y
    corner = height(Shape("corner", size=1.0), x, y)
    inside = (x < -1) & (y < -1)
    assert not corner[inside].any() and (corner[~inside & (np.maximum(x, y) > -0.98)] < 0).all()
    np.testing.assert_allclose(corner, corner.T, atol=1e-12)


def test_rims_are_round_with_their_radius():
    """A fall of a quarter circle: t mm past its start, a rim of radius r has dropped r - sqrt(r^2 - t^2)."""
    t = np.linspace(0, 1.5, 16)
    z = height(Shape("edge", size=2.0), t - 2.0, 0 * t)
    np.testing.assert_allclose(z, np.sqrt(4 - t * t) - 2, atol=1e-12)


def test_the_cone_has_a_rounded_tip_and_straight_sides():
    shape = Shape("cone", size=5.0)
    h = 1e-3
    z = height(shape, np.array([0.0, h, 2.0, 3.0]), np.zeros(4))
    radius = h**2 / (2 * (z[0] - z[1]))
    assert z[0] == 0 and radius == pytest.approx(0.0625 * 5, rel=0.001)
    assert z[2] - z[3] == pytest.approx(4 / 5, rel=0.01)


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
    # A turn about the axis by asin(x / r) moves the thread by that share of the pitch; the rod's own fall aside.
    x = 2.0
    moved = pitch * math.asin(x / 4) / (2 * math.pi)
    side = height(shape, np.full(200, x), y + moved) - (math.sqrt(16 - x * x) - 4)
    np.testing.assert_allclose(side, crest, atol=1e-9)


@pytest.mark.parametrize("letter", STROKES)
def test_letters_stand_on_a_plate(letter):
    shape = Shape("letters", size=10.0, letter=letter)
    z = relief(shape, 128, 0.15)
    assert z.max() == 0 and z[0, 0] == pytest.approx(-shapes.STROKE_RISE, abs=0.01)
    share = (z > -0.1).mean()
    assert 0.03 < share < 0.2
    others = [relief(dataclasses.replace(shape, letter=o), 128, 0.15) for o in STROKES if o != letter]
    assert min((abs(z - o) > 0.4).mean() for o in others) > 0.01
    rows, columns = np.nonzero(z > -0.1)
    assert 10 < (np.ptp(rows) + 1) * 0.15 < 12 and (np.ptp(columns) + 1) * 0.15 < 10  # size, and a stroke's width


@pytest.mark.parametrize("primitive", ["sphere", "cylinder", "edge", "ring"])
def test_the_texture_rides_on_the_primitive(primitive):
    shape = Shape(primitive, "dots", 6.0, 1.4, 0.3, seed=2, grain="grit", grain_depth=0.04, texture_angle=0.4)
    x, y = axes(40, 0.2)
    texture, grain = layers(shape, *unroll(shape, x, y))
    want = base(shape, x, y) - 0.3 * (1 - texture) - 0.04 * (1 - grain)
    np.testing.assert_allclose(height(shape, x, y), want, atol=1e-12)
    assert np.ptp(texture) > 0.9 and np.ptp(grain) > 0.8


def test_the_texture_keeps_its_pitch_along_a_curved_surface():
    angle = np.linspace(0, 1.4, 8)
    for primitive in ("sphere", "cylinder"):
        u, v = unroll(Shape(primitive, size=5.0), 5 * np.sin(angle), 0 * angle)
        np.testing.assert_allclose(u, 5 * angle, atol=1e-6)
        assert not v.any()
    u, v = unroll(Shape("sphere", size=5.0), 3 * np.sin(angle), 4 * np.sin(angle))
    np.testing.assert_allclose(np.hypot(u, v), 5 * angle, atol=1e-6)


def test_the_angle_turns_the_texture():
    still = Shape("flat", "ridges", 50, 1.6, 0.3, seed=7)
    x, y = axes(32, 0.2)
    c, s = math.cos(0.7), math.sin(0.7)
    turned = height(dataclasses.replace(still, texture_angle=0.7), c * x - s * y, s * x + c * y)
    np.testing.assert_allclose(turned, height(still, x, y), atol=1e-9)


@pytest.mark.parametrize("primitive", PRIMITIVES)
def test_jax_arrays_give_what_numpy_gives(primitive):
    texture = list(TEXTURES)[list(PRIMITIVES).index(primitive) % len(TEXTURES)]
    shape = Shape(primitive, texture, 6.0, seed=3, irregularity=0.05, grain="streaks", grain_depth=0.04)
    x, y = (a.astype(np.float32) for a in axes(12, 0.4))
    z = jax.jit(lambda x, y: height(shape, x, y))(x, y)
    assert isinstance(z, jax.Array) and z.dtype == jnp.float32
    np.testing.assert_allclose(z, height(shape, x, y), atol=2e-4)


def test_precision_follows_the_inputs():
    shape = Shape("sphere", "sand", 6.0, grain="pebbles", grain_depth=0.03, irregularity=0.1)
    x, y = axes(8, 0.5)
    assert height(shape, x, y).dtype == np.float64
    assert height(shape, x.astype(np.float32), y.astype(np.float32)).dtype == np.float32
    assert height(shape, np.arange(3), np.arange(3)).dtype == np.float32


@pytest.mark.parametrize("thing", catalogue(5, 48), ids=lambda thing: thing.name)
def test_the_places_of_scenes_meet_the_object(thing):
    x, y = axes(60, 0.2)
    scenes = Scenes(touches=8, objects=1)
    for a, b in (draw_touch(scenes, number, ("train",)).place for number in range(8)):
        z = base(thing.shape, x + a, y + b)
        assert (z > z.max() - 0.3).mean() > 0.004 and z.max() > -0.2


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"primitive": "cube"}, "cube"),
        ({"texture": "velvet"}, "velvet"),
        ({"grain": "velvet"}, "velvet"),
        ({"letter": "Q"}, "'Q'"),
        ({"size": 0.0}, "size"),
        ({"size": -1.0}, "size"),
        ({"size": math.nan}, "size"),
        ({"size": math.inf}, "size"),
        ({"texture_pitch": 0.0}, "texture_pitch"),
        ({"grain_pitch": 0.0}, "grain_pitch"),
        ({"texture_depth": -0.1}, "texture_depth"),
        ({"grain_depth": math.nan}, "grain_depth"),
        ({"irregularity": -0.1}, "irregularity"),
        ({"texture_angle": math.inf}, "texture_angle"),
        ({"seed": -1}, "seed"),
    ],
)
def test_impossible_shapes_are_named(change, word):
    with pytest.raises(UserError, match=word):
        dataclasses.replace(Shape("sphere"), **change)


def test_impossible_rasters_are_named():
    for pixels, pitch in ((0, 0.1), (4, 0.0), (4, math.nan)):
        with pytest.raises(UserError, match="raster"):
            relief(Shape("sphere"), pixels, pitch)
    with pytest.raises(UserError, match="one shape"):
        height(Shape("sphere"), np.zeros(3), np.zeros(4))
