"""Random changes of touches that a gel can show, and rates that fall with the distance from the
features.
"""

import jax
import numpy as np
import pytest
from tiny_models import touch_model

from anytouch_jax.finetuning import images, rates
from anytouch_jax.finetuning.options import Recipe
from anytouch_jax.nn.functional import build
from anytouch_jax.weights.tree import flatten

changed = jax.jit(images.changed)


def clips():
    return np.random.default_rng(0).integers(0, 256, (3, 2, 20, 24, 3), np.uint8)


def test_without_strength_nothing_changes(monkeypatch):
    for name in ("SHIFT", "ZOOM", "GAIN"):
        monkeypatch.setattr(images, name, 0.0)
    same = jax.jit(lambda key, clip: images.changed(key, clip))(jax.random.key(0), clips())
    np.testing.assert_allclose(same, clips(), atol=1e-3)


def test_frames_of_a_clip_change_alike_and_touches_apart():
    one = np.repeat(clips()[:1, :1], 2, axis=1)
    several = np.repeat(one, 3, axis=0)
    out = np.asarray(changed(jax.random.key(1), several))
    np.testing.assert_array_equal(out[:, 0], out[:, 1])
    assert np.abs(out[0] - out[1]).max() > 1
    assert out.min() >= 0 and out.max() <= 255


def test_a_gradient_keeps_its_direction():
    """Never turned nor mirrored: what rises to the right and downwards still does."""
    ramp = np.add.outer(np.arange(32) * 2, np.arange(32) * 4)
    clip = np.broadcast_to(ramp[None, None, :, :, None], (16, 1, 32, 32, 3)).astype(np.uint8)
    out = np.asarray(changed(jax.random.key(2), clip))[:, 0, 8:24, 8:24]
    assert (np.diff(out, axis=1).mean((1, 2)) > 0).all()
    assert (np.diff(out, axis=2).mean((1, 2)) > 0).all()


def test_a_flat_gel_stays_flat():
    grey = np.full((4, 1, 16, 16, 3), 128, np.uint8)
    np.testing.assert_allclose(changed(jax.random.key(3), grey), 128, atol=1e-3)


def test_rates_fall_from_the_features_down():
    model = touch_model()
    names = {name: x.shape for name, x in flatten(build(model).abstract()).items()}
    names = {name: shape for name, shape in names.items() if name.startswith("touch/")}
    recipe = Recipe(rate=1.0, head_rate=5.0, depth_decay=0.5)

    def rate(name, shape=(1,)):
        return rates.depth_factor(name, shape, recipe, model, {})

    assert rate("head/kernel") == 5.0
    assert rate("touch/projection/kernel") == rate("touch/post_norm/scale") == 1.0
    blocks = rate("touch/blocks/norm1/scale", names["touch/blocks/norm1/scale"])
    assert np.ravel(blocks).tolist() == [0.5, 1.0]
    assert rate("touch/patch/kernel") == rate("touch/position") == 0.25


def test_another_trunk_has_rates_by_the_numbers_of_its_blocks():
    model = touch_model(sight=4)
    names = [name for name in flatten(build(model).abstract()) if name.startswith("touch/")]
    depths = rates.trunk_depths(names)
    assert depths == {"touch/sight/trunk/block": 11}
    recipe = Recipe(depth_decay=0.5)
    found = {name: rates.depth_factor(name, (1,), recipe, model, depths) for name in names}
    assert found["touch/sight/trunk/block10/narrow/kernel"] == 1.0
    assert found["touch/sight/trunk/block8/depth/bias"] == 0.25
    assert found["touch/sight/trunk/stem/kernel"] == 0.5**11
    assert found["touch/sight/read/kernel"] == found["touch/projection/kernel"] == 1.0


@pytest.mark.parametrize(("mean", "wanted"), [(0.0, 1.0), (3.0, 10**-0.5)])
def test_features_that_hardly_vary_are_moved_slowly(mean, wanted):
    found = rates.steadiness(np.full(5, mean), np.ones(5))
    assert found == pytest.approx(wanted)
