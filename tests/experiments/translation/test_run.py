import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from pair_world import make_pairs

from experiments.translation import run as translate
from experiments.translation.generator import load

pytestmark = pytest.mark.slow  # the fixture trains two translations

FIT = ("--steps", 2, "--batch", 4)


@pytest.fixture(scope="module")
def world_of_pairs(tmp_path_factory):
    return make_pairs(tmp_path_factory.mktemp("pairs"), {"train": 6, "test": 3})


@pytest.fixture(scope="module")
def run(tmp_path_factory, tiny_run, world_of_pairs):
    """A run that knows gelsight_mini -> duragel and digit -> tac3d."""
    folder = tmp_path_factory.mktemp("run") / "stage1"
    shutil.copytree(tiny_run, folder)
    for source, target in (("gelsight_mini", "duragel"), ("digit", "tac3d")):
        words = ["--fit", "--data", world_of_pairs, "--model", folder, "--source", source, "--target", target]
        assert translate.main([str(word) for word in (*words, *FIT)]) == 0
    return folder


def picture(world: Path, number: int = 0) -> Path:
    return world.parent / f"test{number}_1_gelsight_mini.png"


def test_a_translation_is_trained_scored_and_kept(run, world_of_pairs):
    home = run / "generators" / "gelsight_mini-duragel"
    report = json.loads((home / "report.json").read_text())
    assert report["test pairs"] == 6 and report["error"] > 0 and report["mean target"] > 0
    assert len(report["losses"]) == 2
    design = load(home).design
    assert (design.source, design.target, design.pairs, design.fit.batch) == ("gelsight_mini", "duragel", 12, 4)


def test_an_image_becomes_an_image(run, world_of_pairs, script, tmp_path):
    out = tmp_path / "new" / "a.png"
    words = ("--model", run, "--source", "gelsight_mini", "--target", "duragel", "--out", out)
    lines = script(translate, picture(world_of_pairs), *words)
    assert lines.status == 0 and lines.out.strip() == str(out)
    made = cv2.imread(str(out))[..., ::-1]
    given = cv2.imread(str(picture(world_of_pairs)))[..., ::-1]
    np.testing.assert_array_equal(made, load(run / "generators" / "gelsight_mini-duragel")(given[None])[0])


def test_several_images_and_fields(run, world_of_pairs, script, tmp_path):
    images = [picture(world_of_pairs, k) for k in range(2)]
    lines = script(translate, *images, "--model", run, "--out", tmp_path)
    assert lines.status == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == [f"{image.stem}_duragel.png" for image in images]
    lines = script(translate, images[0], "--model", run, "--source", "digit", "--target", "tac3d", "--out", tmp_path)
    assert lines.status == 0
    field = np.load(tmp_path / f"{images[0].stem}_tac3d.npy")
    assert field.shape == (20, 20, 6) and field.dtype == np.float32
