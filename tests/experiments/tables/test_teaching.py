"""Simulated scenes as teachers, at a toy size."""

from __future__ import annotations

import runpy

import pytest
from places import EXPERIMENTS


def visit(monkeypatch, **environment):
    for key, value in environment.items():
        monkeypatch.setenv(key, str(value))
    return runpy.run_path(str(EXPERIMENTS / "tables/teaching.py"))


@pytest.mark.slow
def test_a_trial_from_data_to_page(tmp_path, monkeypatch, capsys):
    small = {"TOUCHES": 220, "MORE": 8, "OBJECTS": 60, "STEPS1": 1, "STEPS2": 1, "SEEDS": 0, "GRADES": "fine"}
    visit(monkeypatch, WORK=tmp_path / "work", OUT=tmp_path / "out", **small)
    page = (tmp_path / "out" / "teaching.md").read_text()
    assert "TOUCHES=220 MORE=8 OBJECTS=60 STEPS1=1 STEPS2=1 SEEDS=0 GRADES=fine" in page and "| indenter |" in page
    written = (tmp_path / "out" / "teaching.jsonl").stat().st_mtime_ns
    visit(monkeypatch, WORK=tmp_path / "work", OUT=tmp_path / "out", **small)  # what is there is not done again
    assert (tmp_path / "out" / "teaching.jsonl").stat().st_mtime_ns == written
