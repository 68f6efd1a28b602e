import ast
import math
import re
import shutil
import subprocess
import sys

import pytest
import synthetic
from markdown_it import MarkdownIt
from places import EXPERIMENTS, ROOT
from refused import refused

from anytouch_jax.errors import UserError
from experiments.pages import __main__ as results
from experiments.pages import page
from experiments.pages.page import Finding, Page
from experiments.records import read_records, write_record
from experiments.tables import plan
from experiments.values import Value, over_seeds, shared_difference

RESULTS = EXPERIMENTS / "results"
LEAVES = plan.leaves(plan.FULL)


@pytest.fixture(scope="module")
def committed() -> list[Page]:
    return results.pages(RESULTS)


def test_every_committed_page_is_what_its_data_give(committed):
    made = {f"{one.name}.md": page.text(one) for one in committed}
    made |= {"README.md": results.index(committed), "tried.md": results.tried(RESULTS)}
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
    assert data == {name for one in committed for name in one.record["data"]}


@pytest.mark.parametrize(
    "name", ["<img src=x onerror=alert(1)>", "[x](javascript:alert(1))", "x { onclick=alert(1) }"]
)
def test_a_name_of_the_data_is_text_on_a_page(name):
    value = Value(2.0, 1.0, 3.0)
    findings = [Finding(name, name, value, name), f"{name} is best."]
    table = page.Table(name, (name, page.Measure("score")), [(name, value)])
    made = Page("trust", [table], findings, answer=(name, "2"), words={"units": name})
    # as pages of the documentation are made
    trusting = MarkdownIt("commonmark", {"html": True}).enable("table")
    for text in (page.text(made), results.index([made])):
        shown = trusting.render(text)
        assert (
            "<img src=x" not in shown
            and 'href="javascript' not in shown
            and "{" not in text
            and "alert(1)" in shown
        )


def test_a_study_starts_only_as_a_script():
    """Modules define. Only a guard for scripts does something."""
    for path in EXPERIMENTS.rglob("*.py"):
        text = path.read_text()
        for node in ast.parse(text).body if "# %%" not in text else ():
            line = ast.unparse(node)
            harmless = isinstance(
                node, ast.Import | ast.ImportFrom | ast.FunctionDef | ast.ClassDef | ast.Assign
            )
            harmless |= isinstance(node, ast.AnnAssign | ast.AugAssign) or isinstance(
                getattr(node, "value", 0), ast.Constant
            )
            assert harmless or line.startswith(
                ("if __name__ ==", "if TYPE_CHECKING", "sys.path.insert(")
            ), (path, line)


@pytest.mark.parametrize(
    ("change", "words", "figure"),
    [
        (Value(4.2, 1.5, 6.9), "form: A is above B", "+4.2 [+1.5, +6.9] points"),
        (Value(-4.2, -6.9, -1.5), "form: A is below B", "-4.2 [-6.9, -1.5] points"),
        (
            Value(4.2, -1.5, 6.9),
            "form: no difference is shown between A and B",
            "+4.2 [-1.5, +6.9] points",
        ),
        (
            Value(4.2, 1.5, 6.9, seeds=2),
            "form: no difference is shown between A and B",
            "+4.2 [+1.5, +6.9] points",
        ),
        (Value(4.2), "form: no difference is shown between A and B", "+4.2 points"),
        (None, "form: no difference is shown between A and B", ""),
    ],
)
def test_what_is_said_of_a_difference(change, words, figure):
    found = Finding("A", "B", change, "form")
    assert (found.words, found.figure) == (words, figure)


def test_an_interval_over_seeds():
    # of two seeds the two values
    assert over_seeds([1.0, 3.0]) == (2.0, 1.0, 3.0, 2)
    mean, low, high, seeds = over_seeds([1.0, 2.0, 3.0])
    assert (mean, seeds) == (2.0, 3) and high - 2 == 2 - low == pytest.approx(
        4.303 / 3**0.5, rel=1e-3
    )
    assert over_seeds([1.0]) == (1.0, None, None, 1)
    assert shared_difference({0: 1.0, 1: 5.0, 2: 9.0}, {1: 1.0, 2: 2.0, 3: 0.0}) == (
        5.5,
        4.0,
        7.0,
        2,
    )
    assert shared_difference({0: 1.0}, {1: 1.0}) is None


SMALL = Page(
    "motion",
    [[("ours", "x", Value(2.0, 1.0, 3.0), 7.4), ("theirs", "x", None, None)]],
    [
        Finding("A", "B", Value(0.2, -1, 1)),
        *(Finding(f"A{i}", "B", Value(2.0, 1.0, 3.0)) for i in range(9)),
    ],
)


def test_a_page_has_at_most_five_findings_and_counts_the_others():
    assert page.sentences(SMALL) == [
        *(f"A{i} is above B, +2.0 [+1.0, +3.0] points." for i in range(4)),
        "1 of 10 comparisons show no difference.",
    ]
    assert page.answer(SMALL) == (
        "No difference is shown between A and B.",
        "+0.2 [-1.0, +1.0] points",
    )


def planted(gain):
    """Every seed has a level; `gain(question, name)` is what a model is better by, and there is
    noise of 0.3 points.
    """

    def mean(question, name, seed, view, task):
        noise = 0.003 * ((seed * 7 + len(name) * 5 + len(view) * 3 + len(task)) % 3 - 1)
        return 0.4 + 0.05 * seed + gain(question, name) + noise

    return mean


def of(tmp_path, question, gain=lambda question, name: 0.0) -> Page:
    wanted = (question, "q3") if question == "ablations" else (question,)
    leaves = [one for one in LEAVES if one.question in wanted]
    synthetic.write(tmp_path / "matrix.jsonl", leaves, planted(gain))
    return results.pages(tmp_path)[0]


def test_planted_differences_are_reported(tmp_path):
    made = of(tmp_path, "ablations", lambda question, name: 0.05 * (name != "no_text"))
    (text,) = [one for one in page.sentences(made) if "material: without text is" in one.lower()]
    assert (
        "below AnyTouch" in text
        and page.sentences(made)[-1] == "14 of 16 comparisons show no difference."
    )
    row = next(row for row in made.tables[0] if row[0] == "without text")
    assert row[2].high < 0 and row[2].mean == pytest.approx(-5, abs=0.5)


def test_runs_that_differ_give_no_page(tmp_path):
    of(tmp_path, "ablations")
    settings = plan.settings(plan.FULL) | {"steps1": 999}
    for change, words in (
        ({"simulator": 1}, "simulator version 1"),
        ({"settings": settings}, "steps1 400 and 999"),
    ):
        synthetic.change(tmp_path / "matrix.jsonl", "ablations-no_text-1", **change)
        refused(words, results.pages, tmp_path)


@pytest.mark.parametrize(
    ("name", "key", "values"),
    [
        ("translation", "digit-tac3d-anytouch-frozen-0", {"settings": {"size": 112}}),
        ("translation", "digit-tac3d-anytouch-frozen-0", {"settings": {"pairs": "others"}}),
        ("translation", "digit-tac3d-anytouch-frozen-0", {"settings": {"encoder": "another"}}),
        ("pouring", "anytouch-frozen-1", {"settings": {"demonstrations": 5}}),
        ("real", "pixels", {"data": "others"}),
    ],
)
def test_records_that_do_not_belong_together_give_no_page(name, key, values, tmp_path):
    for file in RESULTS.glob(f"{name}*.jsonl"):
        shutil.copy(file, tmp_path)
    path = tmp_path / f"{name}.jsonl"
    record = read_records(path)[key]
    merged = {
        field: record[field] | new if isinstance(new, dict) else new
        for field, new in values.items()
    }
    write_record(path, key, record | merged)
    with pytest.raises(UserError):
        results.PAGES[name][1](tmp_path)


def test_what_is_written_is_read_in_the_order_of_the_keys(tmp_path):
    path = tmp_path / "new" / "study.jsonl"
    assert read_records(path) == {}
    for key, value in (("b", 1), ("a", [1.5, None]), ("b", 2)):
        write_record(path, key, {"value": value})
    assert [*read_records(path).items()] == [("a", {"value": [1.5, None]}), ("b", {"value": 2})]
    assert len(path.read_text().splitlines()) == 2 and [*path.parent.iterdir()] == [path]


def test_processes_lose_no_record(tmp_path):
    path = tmp_path / "study.jsonl"
    code = "import sys; from pathlib import Path; from experiments.records import write_record\n"
    code += "for number in range(10):\n"
    code += "    write_record(Path(sys.argv[1]), f'{sys.argv[2]}{number}', {'value': number})"
    writers = [
        subprocess.Popen([sys.executable, "-c", code, str(path), name], cwd=ROOT) for name in "abc"
    ]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    assert len(read_records(path)) == 30


def test_a_broken_line_is_named_and_nan_is_refused(tmp_path):
    path = tmp_path / "study.jsonl"
    write_record(path, "a", {})
    with pytest.raises(ValueError, match="Out of range"):
        write_record(path, "b", {"value": math.nan})
    path.write_text(path.read_text() + '{"key": "b", "va')
    refused(r"study\.jsonl, line 2", read_records, path)
