"""Pages of results: every committed page is what its records give, and records that disagree give no page."""

from __future__ import annotations

import ast
import shutil
from pathlib import Path

import pytest
import synthetic
from places import EXPERIMENTS
from scripts import visit

from anytouch_jax.errors import UserError
from experiments.real import page as real
from experiments.records import read_records, write_record
from experiments.tables import report
from experiments.tables.results import read

RESULTS = EXPERIMENTS / "results"
PAGES: dict[str, tuple[str, dict[str, str]]] = {
    "long_clips": ("tables/long_clips.py", {"RUN": "nowhere", "DATA": "nowhere"}),
    "named": ("tables/caption_probes.py", {}),
    "named_convolutional": ("tables/caption_probes.py", {"CONVOLUTIONS": "1"}),
    "teaching": ("tables/teaching.py", {}),
    "teaching_convolutional": ("tables/teaching.py", {"CONVOLUTIONS": "1"}),
    "pouring": ("pouring/study.py", {}),
    "pouring_200": ("pouring/study.py", {"NAME": "pouring_200", "DEMOS": "200"}),
    "translation": ("translation/study.py", {}),
    "translation_3000": ("translation/study.py", {"STEPS1": "3000"}),
}


@pytest.fixture
def render(tmp_path, monkeypatch, capsys):
    """render(name): make a page in `tmp_path` from its records alone."""
    (tmp_path / "figures").mkdir()

    def run(name: str) -> str:
        script, settings = PAGES[name]
        if not (tmp_path / f"{name}.jsonl").exists():
            shutil.copy(RESULTS / f"{name}.jsonl", tmp_path)
        for picture in (RESULTS / "figures").glob(f"{name}*"):
            (tmp_path / "figures" / picture.name).touch()  # a page lists the pictures that are there
        (tmp_path / "figures" / "pouring.gif").touch()
        visit(monkeypatch, script, **({"TABLE": 1, "OUT": tmp_path} | settings))
        return (tmp_path / f"{name}.md").read_text()

    return run


@pytest.mark.parametrize("name", sorted(PAGES))
def test_a_committed_page_is_what_its_records_give(name, render):
    assert render(name) == (RESULTS / f"{name}.md").read_text()


def test_the_page_of_the_matrix_is_what_its_records_give():
    figures = [RESULTS / "figures" / f"{name}.png" for name in report.parts([])]
    again = report.whole(read(RESULTS / "matrix.jsonl"), [path for path in figures if path.exists()], RESULTS)
    assert (RESULTS / "README.md").read_text() == again, "render it again: make experiments RENDER=1"


def test_a_study_starts_only_as_a_script():
    """Modules define; notebooks, with their cells, and a guard for scripts alone do something."""
    for path in EXPERIMENTS.rglob("*.py"):
        text = path.read_text()
        for node in ast.parse(text).body if "# %%" not in text else ():
            line = ast.unparse(node)
            harmless = isinstance(node, ast.Import | ast.ImportFrom | ast.FunctionDef | ast.ClassDef | ast.Assign)
            harmless |= isinstance(node, ast.AnnAssign | ast.AugAssign) or isinstance(
                getattr(node, "value", 0), ast.Constant
            )
            assert harmless or line.startswith(("if __name__ ==", "sys.path.insert(")), (path, line)


def test_every_file_of_results_has_a_page():
    assert {path.stem for path in RESULTS.glob("*.jsonl")} == {*PAGES, "matrix", "real"}


def test_the_page_of_real_recordings_is_what_its_records_give():
    assert (RESULTS / "real.md").read_text() == real.page(RESULTS / "real.jsonl")


def drop(path: Path, key: str) -> None:
    lines = path.read_text().splitlines()
    path.write_text("".join(f"{line}\n" for line in lines if not line.startswith(f'{{"key": "{key}"')))


@pytest.mark.parametrize(
    ("name", "key", "field", "value"),
    [
        ("teaching", "fine-1", "settings", {"steps": [600, 1000]}),
        ("translation", "digit-tac3d-anytouch-frozen-0", "settings", {"size": 112}),
        ("translation", "digit-tac3d-anytouch-frozen-0", "settings", {"subtracts": False}),
        ("translation", "digit-tac3d-anytouch-frozen-0", "settings", {"pairs": "others"}),
        ("translation", "digit-tac3d-anytouch-frozen-0", "settings", {"encoder": "another"}),
        ("pouring", "anytouch-frozen-1", "settings", {"demonstrations": 5}),
    ],
)
def test_records_of_other_settings_give_no_page(name, key, field, value, tmp_path, render):
    shutil.copy(RESULTS / f"{name}.jsonl", tmp_path)
    results = tmp_path / f"{name}.jsonl"
    synthetic.change(results, key, **{field: read_records(results)[key][field] | value})
    with pytest.raises(UserError):
        render(name)


def test_records_of_other_data_give_no_page(tmp_path, render):
    shutil.copy(RESULTS / "teaching.jsonl", tmp_path)
    record = read_records(tmp_path / "teaching.jsonl")["fine-1"]
    record["retrieval"]["top1"]["objects"]["an object of other data"] = 1
    write_record(tmp_path / "teaching.jsonl", "fine-1", record)
    with pytest.raises(UserError, match="different data"):
        render("teaching")


@pytest.mark.parametrize(("name", "key"), [("teaching", "fine-1"), ("long_clips", "7-sum")])
def test_a_missing_record_is_named(name, key, tmp_path, render):
    shutil.copy(RESULTS / f"{name}.jsonl", tmp_path)
    drop(tmp_path / f"{name}.jsonl", key)
    with pytest.raises(UserError, match=key):
        render(name)
