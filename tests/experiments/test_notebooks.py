"""The notebooks: they run, and the committed ones are their sources with outputs and pictures."""

from __future__ import annotations

import runpy

import jupytext
import pytest

from anytouch_jax.sim.dataset import simulate
from anytouch_jax.sim.scene import Scenes
from experiments.notebooks.execute import sources

SOURCES = sources([])


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_a_committed_notebook_has_its_source_and_its_outputs(source):
    file = source.with_suffix(".ipynb")
    page, wanted = jupytext.read(file), jupytext.read(source)
    assert [(one.cell_type, one.source) for one in page.cells] == [(one.cell_type, one.source) for one in wanted.cells]
    outputs = [out for one in page.cells if one.cell_type == "code" for out in one.outputs]
    assert any("image/png" in out.get("data", {}) for out in outputs), "make notebooks"
    assert not any(out.output_type == "error" or out.get("name") == "stderr" for out in outputs)
    assert file.stat().st_size < 1e6
    assert page.cells[0].source.startswith("# ") and page.cells[0].source.splitlines()[0].endswith("?")
    assert page.cells[-2].source == "## Finding" and page.cells[-1].outputs[0].text.strip()


def test_there_are_seven():
    assert [path.stem[:2] for path in SOURCES] == [f"0{number}" for number in range(1, 8)]


@pytest.fixture(scope="session")
def few_scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    simulate(Scenes(touches=220, objects=60, size=128, frames=6), folder)
    return folder


@pytest.mark.parametrize(
    "source",
    [pytest.param(path, marks=[] if path.name.startswith("01") else pytest.mark.slow) for path in SOURCES],
    ids=lambda path: path.stem,
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_notebook_runs_from_top_to_bottom(source, monkeypatch, request, capsys):
    monkeypatch.setenv("MPLBACKEND", "agg")
    if not source.name.startswith(("01", "07")):
        monkeypatch.setenv("SCENES", str(request.getfixturevalue("few_scenes")))
    runpy.run_path(str(source))
    printed = capsys.readouterr().out
    assert printed.strip()
    if source.name.startswith("01"):  # needs no scenes: what is committed is what today's encoder gives
        cells = jupytext.read(source.with_suffix(".ipynb")).cells
        assert printed == "".join(out.get("text", "") for one in cells for out in one.get("outputs", ())), (
            "make notebooks"
        )
