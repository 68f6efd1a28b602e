"""The loader that keeps the pictures on the device: the rows and pixels of `Loader`, and partners of the same place."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from touch_world import make_touches

from anytouch_jax.config import preset
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import manifest as manifests
from experiments.encoders.resident import ResidentLoader, gather


@pytest.fixture(scope="module")
def loaders(tmp_path_factory):
    """Both loaders of one small data set, without augmentation."""
    data = make_touches(tmp_path_factory.mktemp("touches") / "data", touches={"train": 9}, frames=2)
    table = manifests.read([data])
    config = preset("tiny", stage=2).with_settings({
        "data.manifests": (str(data),), "data.batch_size": 8, "data.flip": 0.0, "data.clip_share": 0.0,
        "data.jitter": (0.0,) * 4, "data.background": "subtract", "model.match_head": "cosine",
        "model.image_size": 28, "model.text": None, "model.image": None,
    })  # fmt: skip
    ResidentLoader.processes = 1
    return Loader(table, config), ResidentLoader(table, config)


def test_rows_and_pixels_are_those_of_the_plain_loader(loaders):
    plain, resident = loaders
    for step, batch, _ in resident.stream(0, 3):
        same = plain.batch(step).align
        mine, theirs = (np.asarray(one.clip, int).reshape(8, -1) for one in (batch.align, same))
        distance = np.abs(mine[:, None] - theirs[None]).max(-1)  # slots may come in another order
        assert sorted(distance.argmin(1)) == list(range(8)) and distance.min(1).max() <= 2
        assert sorted(batch.align.sensor.tolist()) == sorted(same.sensor.tolist())


def test_partners_touch_the_same_place_with_another_sensor(loaders):
    _, resident = loaders
    pool = resident._match_pools[0]
    for _, batch, _ in resident.stream(0, 3):
        match = batch.match
        assert (np.asarray(match.sensor) != np.asarray(match.positive_sensor)).all()
        frames = np.asarray(resident._frames).reshape(len(resident._frames), -1).astype(int)
        for clips in (match.clip, match.positive):
            rows = np.abs(np.asarray(clips, int).reshape(8, 1, -1) - frames).max(-1).argmin(1)
            windows = np.array([np.flatnonzero(resident._place == row)[0] for row in rows])
            assert (pool.matches._keys.touch[windows] == match.place).all()


def test_a_warp_moves_a_spot_as_the_map_says():
    frames = jnp.zeros((1, 41, 41, 3), jnp.uint8).at[0, 20, 30].set(255)
    rows, key = jnp.zeros((64, 1), jnp.int32), jax.random.key(0)
    turned = np.asarray(gather(frames, rows, key, 0, 0, flip=0.0, affine=(90.0, 0.0, 0.0)), float)[:, 0, :, :, 0]
    y, x = np.mgrid[:41, :41] - 20
    total = turned.sum((1, 2))
    radius = np.hypot((turned * y).sum((1, 2)) / total, (turned * x).sum((1, 2)) / total)
    assert np.allclose(radius, 10, atol=0.5)  # it stays on its circle
    assert np.ptp((turned * y).sum((1, 2)) / total) > 10  # at many angles
    assert np.array_equal(gather(frames, rows, key, 0, 0, flip=0.0, affine=(0.0, 0.0, 0.0))[5, 0], frames[0])
