"""The pages of `experiments/`, each from top to bottom: over made-up results, and (slow) with a tiny run."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest
import synthetic
from places import ROOT
from scripts import visit

from anytouch_jax.errors import UserError
from experiments.tables import page, plan

PAGES = {
    "q1_sensors": "q1", "q2_space": "q2", "q3_perception": "q3", "ablations": "ablations", "new_sensor": "new_sensor",
    "dynamics": "dynamics", "real_probes": "real",
}  # fmt: skip


def show(name, monkeypatch, results, figures):
    return visit(monkeypatch, f"tables/{name}.py", RESULTS=results, FIGURES=figures)


@pytest.fixture(scope="module")
def made_up(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made_up")
    synthetic.write(folder / "matrix.jsonl", plan.leaves(plan.FULL))
    return folder / "matrix.jsonl"


@pytest.mark.parametrize(
    "name", ["q2_space", *(pytest.param(one, marks=pytest.mark.slow) for one in PAGES if one != "q2_space")]
)
def test_a_page_shows_its_picture_and_its_finding(name, made_up, tmp_path, monkeypatch, capsys):
    result = show(name, monkeypatch, made_up, tmp_path)
    out = capsys.readouterr().out
    assert result["path"] == tmp_path / f"{PAGES[name]}.png" and result["path"].stat().st_size > 5000
    assert (result["text"] in out and "3 seeds" in out) or name == "new_sensor"
    assert len(out.splitlines()) > 12


def test_a_page_without_results_says_what_to_do(tmp_path, monkeypatch, capsys):
    show("ablations", monkeypatch, tmp_path / "matrix.jsonl", tmp_path)
    assert "`make experiments ONLY=ablations` makes them" in capsys.readouterr().out


def test_accuracies_alone_are_averaged(tmp_path, monkeypatch, capsys):
    leaves = [leaf for leaf in plan.leaves(plan.FULL) if leaf.question == "q3"]
    synthetic.write(
        tmp_path / "matrix.jsonl",
        leaves,
        lambda question, name, seed, view, task: 0.9 * (task == "force") * (name == "t3"),
    )
    monkeypatch.setattr("experiments.tables.pictures.draw_all", lambda runs, folder: [])
    show("q3_perception", monkeypatch, tmp_path / "matrix.jsonl", tmp_path)
    result = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("T3-style ")]
    assert result == [["T3-style", "static", "+0.0"], ["T3-style", "dynamic", "+0.0"]]


def test_a_run_of_yours_is_asked_for_in_one_line(monkeypatch, capsys, tmp_path):
    monkeypatch.delenv("RUN", raising=False)
    assert page.yours("q2", []) == [] and len(capsys.readouterr().out.splitlines()) == 1
    monkeypatch.setenv("RUN", str(tmp_path / "none"))
    with pytest.raises(UserError, match=r"there is no run .*none"):
        page.yours("q2", [])


@pytest.mark.slow
def test_a_run_of_yours_is_scored_next_to_ours(tmp_path, monkeypatch, capsys, tiny_run):
    size = replace(plan.QUICK, own=24, fine=24, coarse=24, other=24, objects=24, frames=6)
    monkeypatch.setattr(page, "SIZE", size)
    monkeypatch.setenv("RUN", str(tiny_run))
    monkeypatch.setenv("DATA", str(tmp_path / "data"))
    synthetic.write(tmp_path / "made.jsonl", plan.leaves(plan.FULL))
    monkeypatch.setattr("experiments.tables.pictures.draw_all", lambda runs, folder: [])
    for name, least in (("q2_space", 6), ("q1_sensors", 8), ("dynamics", 19)):
        mine = show(name, monkeypatch, tmp_path / "made.jsonl", tmp_path)["mine"]
        out = capsys.readouterr().out
        assert len(mine) >= least and all(f"| {row['view']} | {row['task']} |" in out for row in mine)
        assert f"{mine[0]['mean']:.3f}" in out and "| 0.500 |" in out  # ours
    assert "is made, about" not in out  # the data sets of the first page serve the others


@pytest.mark.slow
def test_pages_become_notebooks_and_html(made_up, tmp_path, monkeypatch):
    monkeypatch.setenv("RESULTS", str(made_up))
    monkeypatch.setenv("FIGURES", str(tmp_path))
    source = ROOT / "experiments" / "tables" / "q2_space.py"
    notebook = tmp_path / "q2_space.ipynb"
    subprocess.run(
        [sys.executable, "-m", "jupytext", "--to", "ipynb", "--output", notebook, source],
        check=True,
        capture_output=True,
    )
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    words = ["--to", "html", "--execute", "--ExecutePreprocessor.timeout=300", notebook]
    subprocess.run([sys.executable, "-m", "nbconvert", *words], check=True, capture_output=True)
    html = (tmp_path / "q2_space.html").read_text()
    assert "data:image/png;base64" in html and "matching mixes them" in html
