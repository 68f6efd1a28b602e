"""Probes of what captions name, at a toy size."""

from __future__ import annotations

import runpy

import pytest
from places import EXPERIMENTS

from experiments.records import read_records


def visit(monkeypatch, **environment):
    for key, value in environment.items():
        monkeypatch.setenv(key, str(value))
    return runpy.run_path(str(EXPERIMENTS / "tables/caption_probes.py"))


@pytest.mark.slow
def test_named(tmp_path, monkeypatch, capsys):
    """What is trained with labels tells its own frames better than the commonest answer does; it is done once."""
    size = {"QUICK": 1, "STEPS": 60, "OUT": tmp_path, "STUDY": tmp_path / "study"}
    visit(monkeypatch, **size)
    found = read_records(tmp_path / "named_quick.jsonl")["0"]
    assert found["scores"]["indenter"]["train"] > 0.15
    features = {"AnyTouch", "trained with labels", "untrained", "pixels", "commonest"}
    assert set(found["probes"]["hardness"]["right"]) == features
    network = found["convolutional, with labels"]
    assert network["scores"]["indenter"]["train"] > 0.15
    assert network["probes"]["hardness"]["objects"] == found["probes"]["hardness"]["objects"]
    page, before = (tmp_path / "named_quick.md").read_text(), (tmp_path / "named_quick.jsonl").stat().st_mtime_ns
    visit(monkeypatch, **size)
    assert (tmp_path / "named_quick.md").read_text() == page
    assert (tmp_path / "named_quick.jsonl").stat().st_mtime_ns == before
    visit(monkeypatch, CONVOLUTIONS=1, **size)  # other encoders, the same network
    inside = read_records(tmp_path / "named_convolutional_quick.jsonl")["0"]
    assert inside["anytouch"] != found["anytouch"] and inside["probes"] != found["probes"]
    assert inside["convolutional, with labels"] == network
    assert "convolutions inside its patches" in (tmp_path / "named_convolutional_quick.md").read_text()
    assert (tmp_path / "named_quick.md").read_text() == page
