import json

import cv2
import numpy as np
import pytest
from checked_world import columns
from task_world import simulated

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.evaluate import counterfactual as cf
from anytouch_jax.evaluate.feature_cache import FeatureSource, FeatureStore
from anytouch_jax.evaluate.probing import probe_tasks
from anytouch_jax.evaluate.statistics import paired_gain

WORLD = simulated(objects=16, each=1)


def test_shuffled_rows_are_others_of_the_same_sensor():
    rows = np.arange(0, len(WORLD), 3)
    partners = cf.shuffle_rows(WORLD, rows)
    sensor = WORLD.codes("sensor")
    assert sorted(partners) == sorted(rows) and (partners != rows).all()
    np.testing.assert_array_equal(sensor[partners], sensor[rows])


@pytest.mark.parametrize("frames", [1, 3])
def test_a_shifted_row_is_half_a_recording_later_in_the_same_recording(frames):
    ends = np.arange(len(WORLD)) if frames == 1 else WORLD.clips(frames)[:, -1]
    partners = cf.shift_in_time(WORLD, ends, frames)
    sequence = WORLD.codes("sequence", own=True)
    np.testing.assert_array_equal(sequence[partners], sequence[ends])
    number = np.asarray(WORLD.column("frame_index"))
    length, first = (5, 0) if frames == 1 else (3, 2)
    np.testing.assert_array_equal(
        number[partners], (number[ends] - first + length // 2) % length + first
    )


def test_touch_matters_where_only_touch_has_the_label():
    """Features have the material, and the recording's own number, which predicts nothing of other
    objects.
    """
    material = np.unique(WORLD.column("label.material").to_pylist(), return_inverse=True)[1]
    values = np.eye(4, dtype=np.float32)[material] + 0.1 * np.random.default_rng(0).standard_normal(
        (len(WORLD), 4)
    )
    real = FeatureStore(lambda rows, _: values[rows].astype(np.float32))
    sources = [
        FeatureSource(cf.REAL, real),
        FeatureSource(
            cf.SHUFFLED, FeatureStore(lambda rows, _: values[cf.shuffle_rows(WORLD, rows)])
        ),
        FeatureSource(cf.MEAN, FeatureStore(lambda rows, _: np.zeros((len(rows), 4), np.float32))),
    ]
    runs: dict = {}
    results = probe_tasks(
        sources, WORLD, ["material"], controls=False, seeds=2, keep=runs, log=lambda _: None
    )
    assert len(runs) == len(results["results"]) == 3
    gains = [
        {"task": key[1], "head": key[2], "protocol": key[3], "control": key[0]}
        | paired_gain(runs[cf.REAL, *key[1:]], several, regression=False)
        for key, several in runs.items()
        if key[0] != cf.REAL
    ]
    assert (
        min(gain["low"] for gain in gains) > 0 and min(gain["difference"] for gain in gains) > 0.3
    )
    (sentence,) = cf.verdicts(gains)
    assert sentence.startswith("Touch matters for material")
    assert "real above mean touch" in cf.gains_table(gains)
    json.dumps(gains)
    for gain in gains:
        gain["low"] = -0.1
    assert cf.verdicts(gains)[0].startswith("There is no sign that touch matters for material")


def test_the_background_alone_is_the_same_for_all_frames_of_a_gel(tmp_path, encoder):
    for name, grey in (("a", 40), ("b", 90), ("gel", 120)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((20, 20, 3), grey, np.uint8))
    files = {"path": ["a.png", "b.png"], "background_path": ["gel.png"] * 2}
    world = manifests.from_columns(columns(2, sequence=["a", "b"], **files), tmp_path / "m.parquet")
    sources = {
        source.name: source.store for source in cf.touch_sources(world, encoder, log=lambda _: None)
    }
    assert set(sources) == {cf.REAL, cf.SHUFFLED, cf.SHIFTED, cf.BACKGROUND, cf.MEAN}
    ids = np.arange(2)[:, None]
    real, shuffled, background, mean = (
        sources[n].get(ids, 1) for n in (cf.REAL, cf.SHUFFLED, cf.BACKGROUND, cf.MEAN)
    )
    np.testing.assert_array_equal(shuffled, real[::-1])
    np.testing.assert_array_equal(background[0], background[1])
    np.testing.assert_allclose(mean, np.repeat(real.mean(0)[None], 2, 0))
    assert not np.allclose(real[0], background[0])
