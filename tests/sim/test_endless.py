from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from scipy import stats

from anytouch_jax.errors import UserError
from anytouch_jax.sim import endless, scene
from anytouch_jax.sim.draws import Draws
from anytouch_jax.sim.recorder import View, simulate_clip
from anytouch_jax.sim.scene import Scenes
from anytouch_jax.sim.sensing.sensors import SENSORS, draw_drift, draw_unit, look

SCENES = Scenes(objects=60, seed=41, depth=(0.15, 1.0))
COUNT = 3000


def flat(tree):
    return {
        jax.tree_util.keystr(path): leaf
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]
    }


def gesture(rng):
    one = scene.draw_gesture(SCENES.depth, rng)
    return one, scene.draw_place(rng), scene.draw_by_hand(SCENES.depth, rng, one, 0.0)


@pytest.mark.parametrize(
    ("draw", "most"),
    [
        (partial(draw_unit, SENSORS["gelsight_mini"]), 2048),
        (gesture, 128),
        (partial(draw_drift, 3), 128),
    ],
    ids=["unit", "gesture", "drift"],
)
def test_both_kinds_of_draws_have_one_distribution(draw, most):
    keys = jax.random.split(jax.random.key(3), COUNT)
    ours = flat(jax.device_get(jax.jit(jax.vmap(lambda key: draw(Draws(key, most))))(keys)))
    by_numpy = (draw(np.random.default_rng([5, n])) for n in range(COUNT))
    theirs = flat(jax.tree.map(lambda *x: np.stack(x), *by_numpy))
    assert ours.keys() == theirs.keys()
    for name, values in ours.items():
        one, other = (np.asarray(x, np.float64).reshape(COUNT, -1) for x in (values, theirs[name]))
        for column in range(0, one.shape[1], max(1, one.shape[1] // 6)):
            p = stats.ks_2samp(one[:, column], other[:, column]).pvalue
            assert p > 1e-5, (name, column, p, one[:, column].mean(), other[:, column].mean())


@pytest.fixture(scope="module")
def world():
    return endless.make_world(endless.objects_of(SCENES)[:3], ("digit", "gelsight_mini"), places=2)


SAMPLING = endless.Sampling(
    frames=1, takes=2, size=32, vision=0.5, fields=("displacement",), field_size=16
)


@pytest.fixture(scope="module")
def drawn(world):
    return jax.device_get(
        jax.jit(endless.draw_touches, static_argnums=(2, 3))(jax.random.key(1), world, SAMPLING, 12)
    )


@pytest.fixture(scope="module")
def touches(world):
    return jax.device_get(
        jax.jit(endless.sample_touches, static_argnums=(2, 3))(
            jax.random.key(1), world, SAMPLING, 12
        )
    )


def test_touches_have_their_shapes_and_a_key_decides_them(world, touches, drawn):
    assert touches.clip.shape == (12, 2, 1, 32, 32, 3) and touches.clip.dtype == np.uint8
    assert touches.fields.shape == (12, 2, 16, 16, 1)
    assert set(touches.sensor.ravel()) == {0, 1} and set(touches.object) <= {0, 1, 2}
    assert -1 in touches.photo and set(touches.photo) <= {-1, 0, 1} and max(touches.photo) >= 0
    assert np.all(touches.labels["depth"].max(-1) > 0), "every still shows a touch"
    photographed = touches.photo >= 0
    place = drawn.clip.place[photographed]
    np.testing.assert_array_equal(
        place[:, 0], world.places[touches.object[photographed], touches.photo[photographed]]
    )


def test_one_program_for_all_sensors_equals_the_program_of_a_sensor(touches, drawn):
    """The numbers of the sensor are traced in the one, and constants of `SENSORS` in the other."""
    for row, take in ((0, 0), (1, 1), (2, 0)):
        clip, numbers, pitch = jax.tree.map(lambda x, at=(row, take): x[at], drawn[3:])
        name = ("digit", "gelsight_mini")[touches.sensor[row, take]]
        field = tuple(float(x) for x in numbers.field)
        sensor = replace(SENSORS[name], field=field)
        view = View(
            (endless.GRID,) * 2, float(pitch), (32, 32), look(SENSORS[name]), True, (16, 16)
        )
        out = jax.jit(
            partial(
                simulate_clip, sensor=sensor, fidelity="fast", fields=("displacement",), view=view
            )
        )(clip)
        np.testing.assert_allclose(out.field[-1], touches.fields[row, take], atol=2e-5)
        assert np.abs(np.asarray(out.image, int) - touches.clip[row, take]).max() <= 1
        np.testing.assert_allclose(
            out.labels["force"], touches.labels["force"][row, take], rtol=1e-3, atol=1e-5
        )


def test_kinds_that_are_held_out_never_occur():
    kinds = {
        split: {thing.kind for thing in endless.objects_of(SCENES, split, variants=3)}
        for split in ("train", "test")
    }
    assert kinds["train"] and kinds["test"] and not kinds["train"] & kinds["test"]
    own = endless.objects_of(SCENES)
    more = endless.objects_of(SCENES, variants=2)
    assert more[: len(own)] == own and {thing.name for thing in more} >= {
        thing.name for thing in own
    }
    assert len({thing.seed for thing in more}) == len(more)
    with pytest.raises(UserError, match="no object of 5"):
        endless.objects_of(Scenes(objects=5), "test")


def test_the_width_is_that_of_the_image_which_shows_a_part_of_the_field(touches, drawn):
    """A unit's camera may show less than the gel: `width` turns lengths of the image into mm."""
    zoom = drawn.clip.unit.zoom
    across, down = drawn.numbers.field[..., 1], drawn.numbers.field[..., 0]
    assert zoom.min() < 0.9, "some cameras show a part"
    np.testing.assert_allclose(touches.width, across * zoom, rtol=1e-6)
    np.testing.assert_allclose(np.exp(touches.aspect), down / across, rtol=1e-6)
