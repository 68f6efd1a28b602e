"""The measurement of loading, at a tiny size: what it compares, and that it opens a large manifest in a process."""

from __future__ import annotations

import numpy as np
import pytest

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from experiments.benchmarks import loading as m


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loading")
    result = m.measure_loading(
        folder, sizes=((32, 24), (48, 40)), pictures=5, rounds=2, pixels=28, rows=450, stages=(1, 2)
    )
    return folder, result


def test_every_variant_is_compared_with_plain_decoding(measured):
    _, rows = measured
    speeds = rows["loader"]
    names = [one.variant for one in speeds if one.size == (32, 24)]
    assert names[:2] == [m.PLAIN, m.PLAIN_LINEAR] and m.NO_JITTER in names and names[-2:] == [m.ALL, m.ONE_THREAD]
    assert {f"only {name}" for name in ("brightness", "contrast", "saturation", "hue")} < set(names)
    assert len(speeds) == 2 * len(names) and all(one.images_per_second > 0 for one in speeds)
    shares = {(one.size, one.variant): one.share for one in speeds}
    assert shares[(48, 40), m.PLAIN] == 1.0 and shares[(32, 24), m.ALL] > 0


def test_a_large_manifest_is_opened_up_to_its_first_batch(measured):
    folder, rows = measured
    opened = rows["large manifest"]
    assert [(one.rows, one.stage) for one in opened] == [(450, 1), (450, 2)]
    for one in opened:
        assert min(one.read, one.prepare, one.first_batch) > 0 and 20 < one.read_mb <= one.peak_mb
    large = manifests.read(folder / "large" / "large.parquet")
    assert len(set(large.column("path").to_pylist())) == 450 and set(large.column("split").to_pylist()) == {"train"}
    np.testing.assert_array_equal(decode(large.file(7)), decode(large.file(207)))
    assert large.clips(4)[-1].tolist() == [446, 447, 448, 449]


def test_the_augmentations_are_those_of_stage_one():
    changes = m._augmentations()
    config = m._config(4, 2, 28, changes[m.ALL])
    assert config.data.jitter == (0.4, 0.4, 0.5, 0.3) and config.data.flip == 0.5 and config.model.image_size == 28
    assert m._config(4, 2, 28, changes[m.NO_JITTER]).data.flip == 0.5
    assert changes["only hue"] == {"flip": 0.0, "jitter": (0.0, 0.0, 0.0, 0.3)}


def test_pictures_are_many_and_different(tmp_path):
    manifest = manifests.read(m.write_pictures(tmp_path, (40, 30), 3))
    pictures = [decode(manifest.file(row)) for row in range(3)]
    assert all(picture.shape == (30, 40, 3) and picture.std() > 10 for picture in pictures)
    assert np.abs(pictures[0].astype(int) - pictures[1]).mean() > 5


def test_mistakes(tmp_path):
    for bad in ({"pictures": 0}, {"pixels": 30}, {"rows": -1}):
        with pytest.raises(UserError, match="must be at least 1"):
            m.measure_loading(tmp_path, **bad)
    with pytest.raises(UserError, match=r"could not be opened: .*no manifest"):
        m.open_large(tmp_path / "no.parquet")
