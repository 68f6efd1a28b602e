"""The prose rules find what they name, and pass what is fine."""

import json
from pathlib import Path

import pytest
from places import ROOT

from tests.prose import check
from tests.prose.statistics import longest_without_heading, main, statistics

PAGE = Path("docs/page.md")
README = Path("README.md")
LONG = " ".join(["word"] * 31) + "."


def reasons(text: str, file: Path = PAGE) -> list[str]:
    return [fault.reason for fault in check.page_faults(file, text)]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (LONG, "31 words"),
        ("One idea; another idea.", "a semicolon"),
        ("It has 1, 2, 3 and 4 parts.", "more than 3 numbers"),
        ("The sensor told us so.", "the phrase 'told'"),
        ("| a | " + LONG + " |\n| --- | --- |", "a table cell of 31 words"),
        ("* an item\n* " + LONG, "31 words"),
        ("line one\ngoes " + LONG, "words, at most"),
    ],
)
def test_a_fault_is_found_with_its_line(text, reason):
    assert any(reason in found for found in reasons("# Title\n\n" + text))
    assert all(fault.line >= 3 for fault in check.page_faults(PAGE, "# Title\n\n" + text))


@pytest.mark.parametrize(
    "text",
    [
        " ".join(["word"] * 30) + ".",
        LONG[:40] + ". " + LONG[:40] + ".",
        "```\n" + LONG + "; 1 2 3 4 5\n```",
        "    " + LONG,
        "See `a; b; c` and [a page](x;y).",
        "`a` is " + LONG[:120] + ". `b` is " + LONG[:120] + ".",
        "By e.g. Eq. 3 of the paper, Sec. 4 holds. " + " ".join(["word"] * 25),
        "| 1 | 2 | 3 | 4 | 5 |",
        "---\ntitle: a; b\n---\nFine.",
    ],
)
def test_what_is_fine_passes(text):
    assert reasons(text) == []


def test_a_long_readme_is_a_fault_and_a_long_page_is_not():
    text = "Five short words stand here.\n\n" * 141
    assert reasons(text, README) == ["705 words, at most 700"] and reasons(text) == []


def test_docstrings_and_messages_are_checked_and_code_is_not():
    code = f"    >>> {LONG}\n\n        {LONG}\n"
    text = f'"""{LONG}"""\n\n\ndef f():\n    """It tells.\n\n{code}    """\n    return "{LONG} told"\n\n\n'
    text += f'raise UserError(f"{{x}} is it. {LONG}")\nlog("It tells.")\nname("It tells.")\nraise OSError\n'
    found = sorted((fault.line, fault.reason) for fault in check.code_faults(Path("a.py"), text))
    assert [line for line, _ in found] == [1, 5, 14, 15]
    assert all(
        word in reason for word, (_, reason) in zip((" words", "tells") * 2, found, strict=True)
    )


def test_the_text_of_a_notebook_is_checked_and_its_code_is_not():
    cells = [
        {"cell_type": "markdown", "source": ["# Title?\n", "\n", "Fine.\n", "\n", f"{LONG}\n"]},
        {"cell_type": "code", "source": f"# a; b\nx = 1  # {LONG}\n"},
    ]
    found = list(check.notebook_faults(Path("a.ipynb"), json.dumps({"cells": cells})))
    assert [(fault.line, "31 words" in fault.reason) for fault in found] == [(5, True)]


def test_the_exit_status_says_whether_there_are_faults(tmp_path, capsys):
    (tmp_path / "README.md").write_text("Fine.\n")
    assert check.main([str(tmp_path)]) == 0
    (tmp_path / "README.md").write_text("Not fine; here.\n")
    assert check.main([str(tmp_path)]) == 1
    assert capsys.readouterr().out.startswith("README.md:1: a semicolon")


def test_every_number_is_what_it_counts_and_long_sentences_and_missing_readers_break_the_limits():
    text = (
        "# Nine words of a heading that is no prose\n\nYou see two words. We have 3 eggs.\n\n| 1 | "
        "2 |\n"
    )
    found = statistics({PAGE: text})
    assert [one.value for one in found] == [4, 4, 100 / 8, 200 / 8, 8]
    assert [one.holds for one in found] == [True, True, False, True, True]
    found = statistics({PAGE: " ".join(["word"] * 26) + ".\n"})
    assert [one.holds for one in found] == [False, False, True, False, True]


def test_words_are_counted_from_heading_to_heading():
    assert longest_without_heading("a b c\n\n## d\n\ne f\n\n| x y z z z z |\n\ng\n") == 3
    assert longest_without_heading("a b\n\n" * 70) == 140


def test_the_pages_keep_the_limits(capsys):
    assert main([str(ROOT)]) == 0, capsys.readouterr().out
