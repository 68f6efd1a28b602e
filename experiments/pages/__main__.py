"""Make the pages of results again from their data: `python -m experiments.pages [FOLDER]`.

FOLDER has the data, and gets the pages and figures. The default is experiments/results, whose
values the README gets too.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write
from experiments.pages import encoders, page, paper, simulators, speed
from experiments.pages.page import Page, Table
from experiments.records import read_records

RESULTS = Path(__file__).resolve().parents[1] / "results"
README = RESULTS.parents[1] / "README.md"
TRIED = "tried.jsonl"
# A page is made for the file of its data and, in that of the matrix, for the runs of its question.
PAGES: Mapping[str, tuple[str, Callable[[Path], Page]]] = {
    "real": ("real.jsonl", encoders.real),
    "lookalikes": ("lookalikes.jsonl", encoders.lookalikes),
    "new_sensor": ("new_sensor.jsonl", encoders.new_sensor),
    "motion": ("motion.jsonl", encoders.motion),
    "measure": ("measure.jsonl", encoders.measure),
    "trust": ("trust.jsonl", encoders.trust),
    "sensors": ("matrix.jsonl/q1", paper.sensors),
    "space": ("matrix.jsonl/q2", paper.space),
    "ablations": ("matrix.jsonl/ablations", paper.ablations),
    "pouring": ("pouring.jsonl", paper.pouring),
    "translation": ("translation.jsonl", paper.translation),
    "mujoco": ("mujoco.jsonl", simulators.mujoco),
    "speed": ("variants.jsonl", speed.speed),
}


def pages(folder: Path) -> list[Page]:
    """Return the pages of a folder, for the data that are there.

    Raises UserError for data that make no page.
    """
    made = []
    for data, make in PAGES.values():
        name, _, question = data.partition("/")
        records = read_records(folder / name)
        if records and (
            not question or any(one.get("question") == question for one in records.values())
        ):
            made.append(make(folder))
    return made


def index(several: list[Page]) -> str:
    """Return the front page: a row a page."""
    rows = [
        (one.record["question"], *page.answer(one), f"[{one.name}]({one.name}.md)")
        for one in several
    ]
    table = page.markdown(Table("", ("question", "answer", "figure", "page"), rows))
    table = re.sub(r"\[(\w+)]\\\(\1\.md\)", r"[\1](\1.md)", table)
    return (
        "# Results\n\nEach page answers one question. It is made from its data alone, by `make "
        "results`. An interval "
        f"is one of 95 %.\n\n{table}\n\n[What was tried](tried.md) lists studies that have left.\n"
    )


def tried(folder: Path) -> str:
    """Return the page of studies that have answered their question."""
    rows = [
        (one["question"], one["answer"], one["figure"], f"`{one['commit']}`")
        for one in read_records(folder / TRIED).values()
    ]
    table = page.markdown(Table("", ("question", "answer", "figure", "code at"), rows))
    return (
        "# What was tried\n\nThese studies have answered their question, and their code has left. "
        "It last ran at the "
        "commit in the last column. Differences are in points, with intervals of 95 "
        f"%.\n\n{table}\n"
    )


def readme(text: str, several: list[Page]) -> str:
    """Return the README with the values of the pages that its table links to, written as `name` 1.2
    %.
    """
    lines = text.splitlines(keepends=True)
    for one in several:
        for name, value in one.readme.items():
            pattern = re.compile(rf"(?<={re.escape(name)}`) [\d.]+ %")
            lines = [
                pattern.sub(f" {value.mean:.1f} %", line) if f"/{one.name}.md" in line else line
                for line in lines
            ]
    return "".join(lines)


def write(folder: Path) -> list[Path]:
    """Write the pages, their figures and the front page of a folder, and return the pages.

    Raises UserError.
    """
    several = pages(folder)
    texts = {one.name: page.text(one) for one in several} | {"README": index(several)}
    if (folder / TRIED).exists():
        texts["tried"] = tried(folder)
    for one in several:
        page.draw(one, folder / "figures" / f"{one.name}.png")
    for name, text in texts.items():
        atomic_write(folder / f"{name}.md", text)
    if folder == RESULTS:
        atomic_write(README, readme(README.read_text(encoding="utf-8"), several))
    return [folder / f"{name}.md" for name in texts]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=RESULTS, help="data of the pages")
    try:
        for path in write(parser.parse_args().folder):
            print(path)
    except UserError as error:
        sys.exit(str(error))
