"""The page `experiments/tables/datasets.py`, from top to bottom."""

from __future__ import annotations

import runpy

import cv2
from places import EXPERIMENTS

from anytouch_jax.data.manifest.files import close_shards

PAGE = EXPERIMENTS / "tables" / "datasets.py"


def test_from_a_download_to_a_batch(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("FOLDER", str(tmp_path))
    result = runpy.run_path(str(PAGE))
    close_shards()
    assert len(result["manifest"]) == 96 and 30 < len(result["checked"].scan.files) < 80
    assert result["still"].clip.shape == (6, 1, 112, 112, 3) and result["clip"].clip.shape == (6, 4, 112, 112, 3)
    for name, shape in (("stills.png", (696, 116)), ("clips.png", (696, 464)), ("contact.png", None)):
        picture = cv2.imread(str(tmp_path / name))
        assert picture.std() > 10 and (shape is None or picture.shape[:2] == shape)
    out = capsys.readouterr().out
    assert "183,000 in the paper" in out and "No fault was found" in out
