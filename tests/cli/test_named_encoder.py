import cv2
import numpy as np
import pytest

import anytouch_jax as at
from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.weights import registry


@pytest.fixture
def packaged(anytouch, tiny_run, tmp_path, monkeypatch):
    """A package whose only encoder is that of `tiny_run`, exported with a card."""
    notes = tmp_path / "notes.md"
    notes.write_text("## Limits\n\nIt is for a test.\n")
    folder = tmp_path / "package" / DEFAULT
    done = anytouch("export", "--card", folder, "--model", tiny_run, "--notes", notes)
    assert done.status == 0 and str(folder) in done.out, done.err
    assert "It is for a test." in (folder / "README.md").read_text()
    monkeypatch.setattr(registry, "FOLDER", folder.parent)
    registry._packaged.cache_clear()
    yield folder
    registry._packaged.cache_clear()


def test_embed_uses_it_and_reports_it(packaged, anytouch, tiny_run, tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    for i in range(3):
        cv2.imwrite(str(frames / f"{i}.png"), np.full((30, 40, 3), 60 * i, np.uint8))
    outs = {}
    for name, words in (("named", ("--model", tiny_run)), ("default", ())):
        outs[name] = tmp_path / f"{name}.npz"
        done = anytouch("embed", *words, "--data", frames, "--sensor", "digit", "--out", outs[name])
        assert done.status == 0 and (f"encoder: {DEFAULT}" in done.err) == (name == "default"), done.err
    named, default = (np.load(out)["features"] for out in outs.values())
    np.testing.assert_allclose(default, named, atol=2e-2 * np.abs(named).max())  # float16 in the package


def test_probe_uses_it(packaged, anytouch, world):
    done = anytouch("probe", "label", "--data", world, "--label", "object", "--no-controls", "--seeds", "0")
    assert f"encoder: {DEFAULT}" in done.err and f"{DEFAULT}: linear" in done.out


def test_info_lists_and_describes_it(packaged, anytouch):
    listed = anytouch("info", "encoders")
    assert listed.status == 0 and listed.out.startswith(f"{DEFAULT}: ") and "28 pixels" in listed.out
    assert "touch encoder: width 16" in anytouch("info", DEFAULT).out
    assert at.list_encoders() == [DEFAULT]


def test_a_folder_with_files_is_not_overwritten(anytouch, tiny_run, tmp_path):
    (tmp_path / "mine").write_text("precious")
    for folder in (tmp_path, tmp_path / "mine"):
        done = anytouch("export", "--card", folder, "--model", tiny_run)
        assert done.status == 2 and "not an empty folder" in done.err
    done = anytouch("export", "--card", tmp_path / "new", "--model", tiny_run, "--out", "x.bin")
    assert done.status == 2 and "--out has no effect with --card" in done.err
    assert anytouch("export", "--model", tiny_run).status == 2
