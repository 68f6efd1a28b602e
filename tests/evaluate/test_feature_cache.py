import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from checked_world import columns
from task_world import simulated
from tiny_models import tiny_config

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.datasets.shards import pack
from anytouch_jax.encoder.encoder import Encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import feature_cache
from anytouch_jax.evaluate.feature_cache import (
    encoder_digest,
    encoder_features,
    image_digest,
    principal_components,
    reorder_frames,
)

ROWS = np.arange(3)


@pytest.fixture(scope="module")
def subtracting() -> Encoder:
    config = tiny_config()
    return random_encoder(replace(config, data=replace(config.data, background="subtract")))


def paint(file: Path, grey: int) -> None:
    assert cv2.imwrite(str(file), np.full((28, 28, 3), grey, np.uint8))


def world(folder: Path, gel: int) -> Manifest:
    """Three touches over a gel of grey `gel`; images without compression, so that all are of one
    size.
    """
    folder.mkdir()
    files = {"path": [f"{i}.bmp" for i in ROWS], "background_path": ["background.bmp"] * 3}
    for i in ROWS:
        paint(folder / f"{i}.bmp", 100 + 20 * i)
    paint(folder / "background.bmp", gel)
    manifests.write(
        manifests.from_columns(columns(3, **files), folder / "m.parquet"), folder / "m.parquet"
    )
    return manifests.read(folder / "m.parquet")


def test_packs_of_one_table_with_other_backgrounds_fraction_no_features(tmp_path, subtracting):
    one, two = (
        manifests.read(pack(world(tmp_path / str(gel), gel), tmp_path / f"packed{gel}"))
        for gel in (100, 40)
    )
    assert one.content_hash == two.content_hash
    shards = [one_of.file(0).parent for one_of in (one, two)]
    for shard in shards:
        os.utime(shard, ns=(1, 1))
    assert shards[0].stat().st_size == shards[1].stat().st_size
    assert image_digest(one) != image_digest(two)
    first, second = (encoder_features(subtracting, table, folder=tmp_path) for table in (one, two))
    assert np.abs(first.get(ROWS, 1) - second.get(ROWS, 1)).max() > 1e-3
    before = image_digest(one)
    os.utime(shards[0], ns=(2, 2))  # a pack that was written again
    assert image_digest(one) != before


def test_another_image_of_the_gel_is_seen_in_the_same_process(tmp_path, subtracting):
    table = world(tmp_path / "world", 100)
    first = encoder_features(subtracting, table).get(ROWS, 1)
    paint(tmp_path / "world" / "background.bmp", 40)
    again = encoder_features(subtracting, table).get(ROWS, 1)
    assert np.abs(again - first).max() > 1e-3
    second = encoder_features(subtracting, world(tmp_path / "new", 40)).get(ROWS, 1)
    np.testing.assert_array_equal(again, second)


def test_the_cache_goes_by_content(encoder, images, tmp_path):
    plain: dict[str, Any] = {"folder": tmp_path}
    store = encoder_features(encoder, images, **plain)
    files = {store.file(1), store.file(3)}
    other = random_encoder(tiny_config(), seed=1)
    assert (
        encoder_digest(other)
        != encoder_digest(encoder)
        == encoder_digest(random_encoder(tiny_config()))
    )
    files.add(encoder_features(other, images, **plain).file(1))
    for change in (
        {"pooling": "mean"},
        {"aggregation": "concat"},
        {"order": "shuffled"},
        {"universal": True},
    ):
        files.add(encoder_features(encoder, images, **plain | change).file(1))
    files.add(encoder_features(encoder, simulated(objects=8), **plain).file(1))
    assert len(files) == 8
    copied = tmp_path / "elsewhere"
    copied.mkdir()
    for name in ["ground.png", *images.column("path").to_pylist()]:
        shutil.copy2(images.files[0].parent / name, copied / name)
    manifests.write(
        manifests.from_columns(images.table.to_pydict(), copied / "m.parquet"),
        copied / "m.parquet",
    )
    moved = manifests.read(copied / "m.parquet")
    assert encoder_features(encoder, moved, **plain).file(1) == store.file(1)
    middle = copied / images.value(len(images) // 2 + 1, "path")
    middle.write_bytes(middle.read_bytes()[:-1] + b"x")  # of the same size
    rewritten = encoder_features(encoder, moved, **plain).file(1)
    assert rewritten != store.file(1)
    (copied / images.value(0, "path")).write_bytes((copied / "ground.png").read_bytes())
    before = encoder_features(encoder, moved, **plain).file(1)
    assert before != rewritten  # an equal table of other images
    # another RGB image of the gel
    cv2.imwrite(str(copied / "ground.png"), np.full((32, 32, 3), 41, np.uint8))
    assert encoder_features(encoder, moved, **plain).file(1) != before


def test_a_broken_cache_is_made_again(passes, encoder, images, tmp_path):
    rows = np.arange(4)
    whole = encoder_features(encoder, images, folder=tmp_path)
    values = whole.get(rows[:, None], 1)
    whole.file(1).write_bytes(whole.file(1).read_bytes()[:200])
    again = encoder_features(encoder, images, folder=tmp_path)
    np.testing.assert_array_equal(again.get(rows[:, None], 1), values)
    assert passes == [4, 4]


def test_the_order_of_frames(encoder, images):
    clips = np.arange(24).reshape(8, 3)
    rows = np.arange(8)
    np.testing.assert_array_equal(reorder_frames(clips, rows, "right"), clips)
    np.testing.assert_array_equal(
        reorder_frames(clips, rows, "repeated"), np.repeat(clips[:, 2:], 3, 1)
    )
    mixed = reorder_frames(clips, rows, "shuffled")
    assert (np.sort(mixed, 1) == clips).all() and (mixed != clips).any(1).all()
    assert len({tuple(one - one.min()) for one in mixed}) > 2
    np.testing.assert_array_equal(reorder_frames(clips[3:5], rows[3:5], "shuffled"), mixed[3:5])
    np.testing.assert_array_equal(reorder_frames(clips[:, :1], rows, "shuffled"), clips[:, :1])
    with pytest.raises(UserError, match="backwards"):
        reorder_frames(clips, rows, "backwards")
    ends = images.clips(3)[:6, -1]
    stores = {
        o: encoder_features(encoder, images, order=o) for o in ("right", "shuffled", "repeated")
    }
    values = {name: store.get(ends[:, None], 3) for name, store in stores.items()}
    stills = stores["right"].get(ends[:, None], 1)
    np.testing.assert_allclose(values["repeated"], stills, atol=2e-5)
    assert np.abs(values["right"] - values["shuffled"]).max() > 1e-4
    assert np.abs(values["right"] - values["repeated"]).max() > 1e-4


HALF = 24 * 32 * 3


def noise(count: int, height: int = 48, width: int = 64, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, height, width, 3), np.uint8)


def raw_pixels(frames: np.ndarray, backgrounds: np.ndarray) -> np.ndarray:
    return np.stack(
        [feature_cache.raw_pixels(*one) for one in zip(frames, backgrounds, strict=True)]
    )


def test_pixels_are_block_means_in_colour() -> None:
    frames = noise(3)
    backgrounds = noise(3, seed=1)
    features = raw_pixels(frames, backgrounds)
    assert features.shape == (3, 2 * 24 * 32 * 3)
    pixels, behind = (
        (one / 255).reshape(3, 24, 2, 32, 2, 3).mean((2, 4)).reshape(3, -1)
        for one in (frames, backgrounds)
    )
    np.testing.assert_allclose(features[:, :HALF], pixels, atol=1e-6)
    np.testing.assert_allclose(features[:, HALF:], pixels - behind, atol=1e-6)
    turned = raw_pixels(frames[..., ::-1], backgrounds)
    assert np.abs(turned[:, :HALF] - features[:, :HALF]).mean() > 0.05, (
        "colour depends on slope and must be used"
    )


def test_components_are_those_of_train() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(60, 10)) * np.array([9, 5, *[0.1] * 8])
    train = np.arange(60) < 40
    kept = principal_components(features, train, 2)
    np.testing.assert_allclose(np.abs(np.corrcoef(kept[:, 0], features[:, 0])[0, 1]), 1, atol=0.02)
    assert np.abs(kept[train].mean(0)).max() < 1e-5
    wild = features.copy()
    wild[~train] *= 100
    np.testing.assert_allclose(principal_components(wild, train, 2)[train], kept[train], atol=1e-5)


def test_a_features_file_serves_its_rows_in_any_order(images, tmp_path):
    values = np.random.default_rng(0).normal(size=(9, 4)).astype(np.float32)
    rows = np.arange(20, 2, -2)
    np.savez(tmp_path / "f.npz", features=values, rows=rows)
    store = feature_cache.file_features(tmp_path / "f.npz", images)
    np.testing.assert_array_equal(store.get(np.array([[4], [20]]), 3), values[[8, 0]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rows": np.arange(12) + 1000}, "rows"),
        ({"rows": np.zeros(12, int)}, "rows"),
        ({}, "lacks 3 "),
        ({"key/path": np.array(["x.png"] * 12)}, "manifest"),
        ({"about/frames": np.array("3")}, "--frames 3"),
    ],
)
def test_a_features_file_that_does_not_fit_is_refused(images, tmp_path, change, words):
    arrays = {"features": np.ones((12, 4)), "rows": np.arange(12)} | change
    np.savez(tmp_path / "odd.npz", **arrays)
    with pytest.raises(UserError, match=f"odd.npz.*{words}"):
        feature_cache.file_features(tmp_path / "odd.npz", images).get(np.arange(15)[:, None], 1)
