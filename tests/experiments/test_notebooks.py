import nbformat
import pytest
from markdown_it import MarkdownIt

import anytouch_jax as at
from anytouch_jax.sim.dataset import simulate
from anytouch_jax.sim.scene import Scenes
from docs.generate import api_page, tutorial
from experiments.notebooks.execute import notebooks

FILES = notebooks([])


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_a_committed_notebook_has_its_outputs(file):
    cells = nbformat.read(file, as_version=4).cells
    outputs = [out for one in cells if one.cell_type == "code" for out in one.outputs]
    assert any("image/png" in out.get("data", {}) for out in outputs), "make notebooks"
    # no HTML
    assert {kind for out in outputs for kind in out.get("data", {})} <= {"image/png", "text/plain"}
    assert not any(out.output_type == "error" or out.get("name") == "stderr" for out in outputs)
    assert file.stat().st_size < 1e6
    assert cells[0].source.startswith("# ") and cells[0].source.splitlines()[0].endswith("?")
    assert cells[-2].source == "## Finding" and cells[-1].outputs[0].text.strip()


@pytest.mark.parametrize(
    "name", ["<img src=x onerror=alert(1)>", "```\n<img src=x onerror=alert(1)>\n```"]
)
def test_what_a_notebook_shows_of_a_name_is_text(name, tmp_path):
    html = nbformat.v4.new_output("display_data", {"text/html": name})
    printed = nbformat.v4.new_output("stream", text=name)
    cell = nbformat.v4.new_code_cell("print(name)", outputs=[printed, html])
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), tmp_path / "mine.ipynb")
    page = MarkdownIt("commonmark", {"html": True}).render(
        tutorial(tmp_path / "mine.ipynb", tmp_path)
    )
    assert "&lt;img src=x" in page and "<img" not in page
    # a notebook shows their `repr`
    for one in (at.Manifest, at.Encoder, at.Preprocess, at.FamilyEncoder, at.Config):
        assert not {"_repr_html_", "_repr_markdown_", "_repr_svg_", "_repr_javascript_"} & {
            *dir(one)
        }


def test_every_public_name_has_a_place_in_the_reference():
    lines = api_page().splitlines()
    assert sum(line.startswith("::: ") for line in lines) == len(at.__all__)


@pytest.fixture(scope="session")
def few_scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    simulate(Scenes(touches=220, objects=60, size=128, frames=6), folder)
    return folder


@pytest.mark.parametrize(
    "file",
    [
        pytest.param(path, marks=[] if path.name.startswith("01") else pytest.mark.slow)
        for path in FILES
    ],
    ids=lambda path: path.stem,
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_notebook_runs_from_top_to_bottom(file, monkeypatch, request, capsys):
    monkeypatch.setenv("MPLBACKEND", "agg")
    if not file.name.startswith(("01", "05", "06", "07")):
        monkeypatch.setenv("SCENES", str(request.getfixturevalue("few_scenes")))
    cells = [cell for cell in nbformat.read(file, as_version=4).cells if cell.cell_type == "code"]
    exec("\n".join(cell.source for cell in cells), {"__name__": "__main__"})
    printed = capsys.readouterr().out
    assert printed.strip()
    if file.name.startswith(
        "01"
    ):  # needs no scenes: what is committed is what today's encoder gives
        assert printed == "".join(out.get("text", "") for one in cells for out in one.outputs), (
            "make notebooks"
        )
