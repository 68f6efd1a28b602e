"""The cache of features tells other pictures under an equal table apart: packed ones, and those replaced meanwhile."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_models import tiny_config

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.prepare.shards import pack
from anytouch_jax.encoder.encoder import Encoder, random_encoder
from anytouch_jax.evaluate.battery_features import encoded, pictures

ROWS = np.arange(3)


@pytest.fixture(scope="module")
def encoder(compiled_once) -> Encoder:
    config = tiny_config()
    return random_encoder(replace(config, data=replace(config.data, background="subtract")))


def paint(file: Path, grey: int) -> None:
    assert cv2.imwrite(str(file), np.full((28, 28, 3), grey, np.uint8))


def world(folder: Path, gel: int) -> Manifest:
    """Three touches over a gel of grey `gel`; pictures without compression, so that all are of one size."""
    folder.mkdir()
    columns = {
        "path": [f"{i}.bmp" for i in ROWS],
        "sensor": ["digit"] * 3,
        "sequence": ["a"] * 3,
        "frame_index": ROWS.tolist(),
        "split": ["test"] * 3,
        "background_path": ["background.bmp"] * 3,
    }
    for i in ROWS:
        paint(folder / f"{i}.bmp", 100 + 20 * i)
    paint(folder / "background.bmp", gel)
    manifests.write(manifests.from_columns(columns, folder / "m.parquet"), folder / "m.parquet")
    return manifests.read(folder / "m.parquet")


def test_packs_of_one_table_with_other_gels_share_no_features(tmp_path, encoder):
    one, two = (manifests.read(pack(world(tmp_path / str(gel), gel), tmp_path / f"packed{gel}")) for gel in (100, 40))
    assert one.content_hash == two.content_hash
    shards = [one_of.file(0).parent for one_of in (one, two)]
    for shard in shards:
        os.utime(shard, ns=(1, 1))
    assert shards[0].suffix == ".parquet" and shards[0].stat().st_size == shards[1].stat().st_size
    assert pictures(one) != pictures(two)
    first, second = (encoded(encoder, table, pooling="class", join="mean", folder=tmp_path) for table in (one, two))
    assert np.abs(first.get(ROWS, 1) - second.get(ROWS, 1)).max() > 1e-3
    before = pictures(one)
    os.utime(shards[0], ns=(2, 2))  # a pack that was written anew
    assert pictures(one) != before


def test_another_picture_of_the_gel_is_seen_in_the_same_process(tmp_path, encoder):
    table = world(tmp_path / "world", 100)
    first = encoded(encoder, table, pooling="class", join="mean").get(ROWS, 1)
    paint(tmp_path / "world" / "background.bmp", 40)
    again = encoded(encoder, table, pooling="class", join="mean").get(ROWS, 1)
    assert np.abs(again - first).max() > 1e-3
    second = encoded(encoder, world(tmp_path / "new", 40), pooling="class", join="mean").get(ROWS, 1)
    np.testing.assert_array_equal(again, second)
