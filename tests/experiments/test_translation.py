import json
import shutil
from dataclasses import replace
from typing import Any

import cv2
import jax
import numpy as np
import pytest
from pair_world import arrays, make_pairs, row
from refused import refused
from tiny_models import tiny_config

from anytouch_jax.config import Stack
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import random_encoder
from experiments.translation import pairs, training
from experiments.translation import run as translate
from experiments.translation.generator import GENERATOR, Fit, load, save
from experiments.translation.networks import Translation

A = "gelsight_mini"
B = "duragel"


def table(rows: list[dict[str, Any]], name: str = "m.parquet") -> manifests.Manifest:
    return manifests.from_columns(
        {key: [one[key] for one in rows] for key in rows[0]}, f"/nowhere/{name}"
    )


def felt(
    sensor: str, split: str, number: int, frames: int = 3, **changes: Any
) -> list[dict[str, Any]]:
    return [
        row(f"{sensor}{split}{number}{t}.png", sensor, split, number, t) | changes
        for t in range(frames)
    ]


def plain() -> list[dict[str, Any]]:
    return [
        r
        for s in (A, B, "digit")
        for split in ("train", "test")
        for n in range(4)
        for r in felt(s, split, n)
    ]


def test_a_pair_is_one_frame_of_one_touch_by_two_sensors():
    rows = plain()
    rows = [rows[i] for i in np.random.default_rng(0).permutation(len(rows))]
    result = table(rows)
    split = pairs.find_pairs(result, A, B)
    for part, name in ((split.train, "train"), (split.test, "test")):
        assert (
            len(part.source)
            == len(part.target)
            == 12
            == len(set(part.source))
            == len(set(part.target))
        )
        for first, second in zip(part.source, part.target, strict=True):
            one = rows[first]
            two = rows[second]
            assert (one["sensor"], two["sensor"], one["split"], two["split"]) == (A, B, name, name)
            assert (one["touch"], one["frame_index"]) == (two["touch"], two["frame_index"])
    objects = [{rows[i]["object"] for i in part.source} for part in split]
    assert not objects[0] & objects[2] and not len(split.val.source)
    rows += felt(A, "val", 0) + felt(B, "val", 0)
    assert len(pairs.find_pairs(table(rows), A, B).val.target) == 3


@pytest.mark.parametrize("split", ["train", "val"])
def test_an_object_on_both_sides_is_refused(split):
    rows = plain() + [
        one | {"object": "test thing 3"} for sensor in (A, B) for one in felt(sensor, split, 9)
    ]
    refused(
        f"'test thing 3' is in the splits {split} and test", pairs.find_pairs, table(rows), A, B
    )
    rows[0]["object"] = None
    refused(r"row 0 of .* has no object", pairs.find_pairs, table(rows), A, B)


def test_pixels_and_fields_come_in_the_order_of_the_rows(tmp_path):
    result = manifests.read(make_pairs(tmp_path, {"train": 5, "test": 2}))
    split = pairs.find_pairs(result, A, B)
    x, y = pairs.read_pairs(result, split.train, 14)
    assert x.shape == y.shape == (10, 14, 14, 3) and x.dtype == np.uint8
    for part, images in ((split.train.source, x), (split.train.target, y)):
        for k in (0, 7, 9):
            image = cv2.imread(str(result.file(int(part[k]))))[..., ::-1]
            np.testing.assert_array_equal(
                images[k], cv2.resize(image, (14, 14), interpolation=cv2.INTER_AREA)
            )
    field_pairs = pairs.find_pairs(result, "digit", "tac3d").test
    x, y = pairs.read_pairs(result, field_pairs, 14)
    assert y.shape == (4, 20, 20, 6) and y.dtype == np.float32 and len(x) == 4
    np.testing.assert_array_equal(
        y[3], np.load(result.file(int(field_pairs.target[3]), "field_path"))
    )


@pytest.fixture(scope="module")
def world_of_pairs(tmp_path_factory):
    return make_pairs(tmp_path_factory.mktemp("pairs"), {"train": 6, "test": 3})


@pytest.fixture(scope="module")
def run(tmp_path_factory, tiny_run, world_of_pairs):
    """A run that knows gelsight_mini -> duragel and digit -> tac3d."""
    folder = tmp_path_factory.mktemp("run") / "stage1"
    shutil.copytree(tiny_run, folder)
    for source, target in (("gelsight_mini", "duragel"), ("digit", "tac3d")):
        words = [
            "--fit",
            "--data",
            world_of_pairs,
            "--model",
            folder,
            "--source",
            source,
            "--target",
            target,
        ]
        assert translate.main([*map(str, words), "--steps", "2", "--batch", "4"]) == 0
    return folder


@pytest.mark.slow
def test_a_translation_is_trained_scored_and_kept(run):
    home = run / "generators" / "gelsight_mini-duragel"
    report = json.loads((home / "report.json").read_text())
    assert (
        report["test pairs"] == 6
        and min(report["error"], report["mean target"]) > 0
        and len(report["losses"]) == 2
    )
    design = load(home).design
    assert (design.source, design.target, design.pairs, design.fit.batch) == (
        "gelsight_mini",
        "duragel",
        12,
        4,
    )


@pytest.mark.slow
def test_images_become_images_or_fields(run, world_of_pairs, script, tmp_path):
    images = [world_of_pairs.parent / f"test{number}_1_gelsight_mini.png" for number in range(2)]
    lines = script(translate, *images, "--model", run, "--out", tmp_path)
    files = [tmp_path / f"{image.stem}_duragel.png" for image in images]
    assert lines.status == 0 and lines.out.split() == [str(file) for file in files]
    given, made = (
        np.stack([cv2.imread(str(path))[..., ::-1] for path in paths]) for paths in (images, files)
    )
    np.testing.assert_array_equal(made, load(run / "generators" / "gelsight_mini-duragel")(given))
    lines = script(
        translate,
        images[0],
        "--model",
        run,
        "--source",
        "digit",
        "--target",
        "tac3d",
        "--out",
        tmp_path,
    )
    field = np.load(tmp_path / f"{images[0].stem}_tac3d.npy")
    assert lines.status == 0 and field.shape == (20, 20, 6) and field.dtype == np.float32


X, Y, FIELDS = arrays(24)
ENCODER = random_encoder(tiny_config())
MODEL = ENCODER.config.model
IMAGE = Translation(MODEL, decoder=Stack(16, 1, 2, 32), hidden=16, channels=(4, 8, 8))
FIELD = replace(IMAGE, field=(20, 20, 6))
SENSORS = {"source": "gelsight_mini", "target": "duragel"}


@pytest.mark.slow
def test_the_state_that_does_best_on_other_objects_is_kept():
    """What is right for the training pairs is wrong for these: the first state is the best, and it
    is the one kept.
    """
    options = Fit(steps=40, batch=8, learning_rate=1e-2)
    val = X[:8], FIELDS[:8]
    result, losses = training.fit(
        None, X[:8], -FIELDS[:8], **SENSORS, val=val, options=options, shape=FIELD
    )
    reported = [line["val"] for line in losses]
    assert reported[-1] > 1.02 * min(reported) and len(reported) == 20
    np.testing.assert_allclose(training.errors(result, *val).mean(), min(reported), rtol=1e-5)
    empty = X[:0], FIELDS[:0]
    assert (
        "val"
        not in training.fit(None, X, FIELDS, **SENSORS, val=empty, options=options, shape=FIELD)[1][
            -1
        ]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "shape", "wanted"), [("duragel", IMAGE, Y), ("tac3d", FIELD, FIELDS)]
)
def test_a_saved_generator_comes_back_and_its_frozen_encoder_is_unchanged_bit_for_bit(
    tmp_path, target, shape, wanted
):
    sensors = {"source": "gelsight_mini", "target": target}
    made, _ = training.fit(
        ENCODER, X, wanted, **sensors, options=Fit(steps=2, batch=8), shape=shape
    )
    jax.tree.map(np.testing.assert_array_equal, made.params["encoder"], ENCODER.params)
    save(made, tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == [GENERATOR]
    back = load(tmp_path)
    assert back.design == made.design == load(tmp_path / GENERATOR).design
    jax.tree.map(np.testing.assert_array_equal, back.params, jax.tree.map(np.asarray, made.params))
    np.testing.assert_array_equal(back(X), made(X))
