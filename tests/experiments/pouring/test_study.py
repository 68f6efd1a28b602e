"""The pouring study at a toy size, and its page again from the records."""

from __future__ import annotations

import runpy

import pytest
from places import EXPERIMENTS

from experiments.records import read_records


def visit(monkeypatch, **environment):
    for key, value in environment.items():
        monkeypatch.setenv(key, str(value))
    return runpy.run_path(str(EXPERIMENTS / "pouring/study.py"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_pouring(tmp_path, tiny_run, monkeypatch, capsys):
    size = {"QUICK": 1, "TRIALS": 2, "DEMOS": 2, "TUNE": 1, "MODES": "frozen,fine-tuned", "OUT": tmp_path}
    visit(monkeypatch, RUNS=f"anytouch={tiny_run}", **size)
    out = capsys.readouterr().out
    assert "no run is given for row t3: it is left out" in out
    results = tmp_path / "pouring-quick.jsonl"
    learned = {f"{name}-{mode}-0" for name in ("none", "static", "anytouch") for mode in ("frozen", "fine-tuned")}
    assert {*read_records(results)} == learned | {"blind-bound-0", "count-bound-0", "load-bound-0", "expert-bound-0"}
    page = (tmp_path / "pouring-quick.md").read_text()
    assert (tmp_path / "figures" / "pouring.gif").exists() and "expert" in page
    before = results.stat().st_mtime_ns
    visit(monkeypatch, TABLE=1)
    assert (tmp_path / "pouring-quick.md").read_text() == page and results.stat().st_mtime_ns == before
