"""Pages of results: every committed page is what its data give, and data that disagree give no page."""

from __future__ import annotations

import ast
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
from PIL import Image
from places import EXPERIMENTS

from anytouch_jax.errors import UserError
from experiments.pages import __main__ as results
from experiments.pages import matrix, page, speed
from experiments.pages.page import Measure, Page, Value, compare, over_seeds
from experiments.records import read_records, write_record
from experiments.tables import plan
from experiments.tables.results import read

RESULTS = EXPERIMENTS / "results"
LEAVES = plan.leaves(plan.FULL)


@pytest.fixture(scope="module")
def committed() -> list[Page]:
    return results.pages(RESULTS)


def test_every_committed_page_is_what_its_data_give(committed):
    made = {f"{one.name}.md": page.text(one) for one in committed} | {"README.md": results.index(committed)}
    assert {file.name: file.read_text() for file in RESULTS.glob("*.md")} == made, "make results"


def test_the_readme_has_the_values_of_the_pages(committed):
    text = results.README.read_text()
    assert results.readme(text, committed) == text, "make results"
    changed, counts = re.subn(r"` [\d.]+ %", "` 0.5 %", text)
    assert counts == 5 and results.readme(changed, committed) == text


def test_every_page_has_one_figure_and_every_file_of_data_a_page(committed):
    figures = {file.stem for file in (RESULTS / "figures").iterdir()}
    assert figures == {one.name for one in committed}
    data = {file.name for file in RESULTS.iterdir() if file.suffix in (".json", ".jsonl")}
    assert data == {name for one in committed for name in one.data}


def test_a_study_starts_only_as_a_script():
    """Modules define. Only a guard for scripts does something."""
    for path in EXPERIMENTS.rglob("*.py"):
        text = path.read_text()
        for node in ast.parse(text).body if "# %%" not in text else ():
            line = ast.unparse(node)
            harmless = isinstance(node, ast.Import | ast.ImportFrom | ast.FunctionDef | ast.ClassDef | ast.Assign)
            harmless |= isinstance(node, ast.AnnAssign | ast.AugAssign) or isinstance(
                getattr(node, "value", 0), ast.Constant
            )
            assert harmless or line.startswith(("if __name__ ==", "sys.path.insert(")), (path, line)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (Value(4.2, 1.5, 6.9), "form: A is 4.2 points above B (1.5 to 6.9)."),
        (Value(-4.2, -6.9, -1.5), "form: A is 4.2 points below B (1.5 to 6.9)."),
        (Value(4.2, -1.5, 6.9), "form: no difference is shown between A and B."),
        (Value(4.2, 1.5, 6.9, seeds=2), "form: there are too few seeds to compare A with B."),
        (None, "form: A was not compared with B."),
    ],
)
def test_what_is_said_of_a_difference(change, words):
    assert compare("A", "B", change, "form") == words


def test_an_interval_over_seeds():
    assert over_seeds([1.0, 3.0]) == (2.0, 1.0, 3.0, 2)  # of two seeds the two values
    mean, low, high, seeds = over_seeds([1.0, 2.0, 3.0])
    assert (mean, seeds) == (2.0, 3) and high - 2 == 2 - low == pytest.approx(4.303 / 3**0.5, rel=1e-3)
    assert over_seeds([1.0]) == (1.0, None, None, 1)


SMALL = Page(
    "small", "A question?", "About it.", ("model", Measure("score, %"), Measure("ms", ".0f", False)),
    [("ours", Value(2.0, 1.0, 3.0), 7.4), ("theirs", None, None)], ["ours is above."], ("a.jsonl",), "make it",
)  # fmt: skip


def test_a_page_has_its_intervals_in_columns():
    text = page.text(SMALL)
    assert "| model | score, % | from | to | ms |" in text
    assert "| ours | 2.0 | 1.0 | 3.0 | 7 |\n| theirs | - | - | - | - |" in text
    assert "* Ours is above." in text and text.startswith("# A question?\n\nAbout it.")


def test_the_rows_are_drawn(tmp_path):
    page.draw(SMALL, tmp_path / "a.png")
    page.draw(replace(SMALL, rows=[("ours", Value(9.0, 1.0, 30.0), 7.4), SMALL.rows[1]]), tmp_path / "b.png")
    a, b = (np.asarray(Image.open(tmp_path / f"{name}.png")) for name in "ab")
    assert a.shape[1] > 300 and (a.shape != b.shape or (a != b).any())


def planted(gain):
    """Every seed has a level; `gain(question, name)` is what a model is better by, and there is noise of 0.3 points."""

    def mean(question, name, seed, view, task):
        noise = 0.003 * ((seed * 7 + len(name) * 5 + len(view) * 3 + len(task)) % 3 - 1)
        return 0.4 + 0.05 * seed + gain(question, name) + noise

    return mean


def of(tmp_path, question, gain=lambda question, name: 0.0) -> Page:
    synthetic.write(tmp_path / matrix.NAME, [one for one in LEAVES if one.question == question], planted(gain))
    return matrix.pages(tmp_path / matrix.NAME)[0]


def test_planted_differences_are_reported(tmp_path):
    made = of(tmp_path, "ablations", lambda question, name: 0.05 * (name != "no_text"))
    sentences = {one.split(" is ")[0]: one for one in made.findings}
    assert "points below AnyTouch" in sentences["material: without text"]
    assert sum("no difference is shown" in one for one in made.findings) == len(made.findings) - 1
    row = next(row for row in made.rows if row[0] == "without text")
    assert row[2].high < 0 and row[2].mean == pytest.approx(-5, abs=0.5)


def test_more_sensors_help_on_the_page_of_sensors(tmp_path):
    made = of(tmp_path, "q1", lambda question, name: 0.02 * name.count("+"))
    assert made.findings[0].startswith("material: an encoder of all four sensors is 6.")
    assert "no difference is shown" in made.findings[1]


def test_what_is_not_trained_is_one_number_for_every_seed(tmp_path):
    made = of(tmp_path, "q2", lambda question, name: 0.1 * (name == "matched"))
    pixels = next(row for row in made.rows if row[0] == "raw pixels")
    assert pixels[1].low is None
    assert any("matching added is" in one and "above raw pixels" in one for one in made.findings)


def test_every_question_of_the_matrix_has_a_page(tmp_path):
    synthetic.write(tmp_path / matrix.NAME, LEAVES)
    made = matrix.pages(tmp_path / matrix.NAME)
    assert len(made) == len(matrix.OF) and all(one.findings and one.rows for one in made)


def test_runs_that_differ_give_no_page(tmp_path):
    of(tmp_path, "ablations")
    settings = plan.settings(plan.FULL) | {"steps1": 999}
    for change, words in (({"simulator": 1}, "simulator version 1"), ({"settings": settings}, "steps1 400 and 999")):
        synthetic.change(tmp_path / matrix.NAME, "ablations-no_text-1", **change)
        with pytest.raises(UserError, match=words):
            matrix.pages(tmp_path / matrix.NAME)


def test_a_record_that_is_no_run_is_named(tmp_path):
    (tmp_path / matrix.NAME).write_text('{"key": "q1-x-0", "question": "q1"}\n')
    with pytest.raises(UserError, match=r"matrix\.jsonl: q1-x-0"):
        read(tmp_path / matrix.NAME)


@pytest.mark.parametrize(
    ("name", "key", "values"),
    [
        ("teaching", "fine-1", {"settings": {"steps": [600, 1000]}}),
        ("translation", "digit-tac3d-anytouch-frozen-0", {"settings": {"size": 112}}),
        ("translation", "digit-tac3d-anytouch-frozen-0", {"settings": {"pairs": "others"}}),
        ("translation", "digit-tac3d-anytouch-frozen-0", {"settings": {"encoder": "another"}}),
        ("pouring", "anytouch-frozen-1", {"settings": {"demonstrations": 5}}),
        ("real", "pixels", {"data": "others"}),
        ("long_clips", "7-sum", None),
        ("teaching", "fine-1", None),
    ],
)
def test_records_that_do_not_belong_together_give_no_page(name, key, values, tmp_path):
    for file in RESULTS.glob(f"{name}*.jsonl"):
        shutil.copy(file, tmp_path)
    path = tmp_path / f"{name}.jsonl"
    record = read_records(path)[key]
    if values is None:
        lines = path.read_text().splitlines()
        path.write_text("".join(f"{line}\n" for line in lines if not line.startswith(f'{{"key": "{key}"')))
    else:
        merged = {field: record[field] | new if isinstance(new, dict) else new for field, new in values.items()}
        write_record(path, key, record | merged)
    with pytest.raises(UserError):
        results.STUDIES[name][1](tmp_path)


def test_the_table_of_variants_has_the_numbers_of_its_file(tmp_path):
    made = speed.variants(Path(RESULTS))
    row = next(row for row in made.rows if row[:4] == ("AMX", "small", "stage1 clips", "bfloat16"))
    assert row[4] == pytest.approx(2668.9, abs=0.1) and row[5].mean == pytest.approx(0.6018, abs=1e-3)
