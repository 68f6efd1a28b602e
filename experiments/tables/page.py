"""Notebooks of the tables: their results, pictures and texts, and the scores of a checkpoint of yours.

`RESULTS=` and `FIGURES=` in the environment name where results are read and pictures are written. `RUN=` names a run
folder or weights file to score, and `DATA=` the data to score it on: a folder of simulated data sets as the matrix
makes them, or a manifest of real touch.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import markdown_table
from experiments.tables import pictures, plan, report, scores
from experiments.tables.results import Run, differences, read
from experiments.tables.work import Work

ROOT = Path(__file__).resolve().parents[2]
DEFAULT = ROOT / "experiments" / "results" / "matrix.jsonl"
# The run whose row a checkpoint is compared with, and the size whose rows and refits it is scored with.
COMPARED = {"q1": "+".join(plan.SENSORS), "q2": "matched", "new_sensor": "left_out"}
SIZE = plan.FULL


def runs(question: str) -> list[Run]:
    """Return the runs of a question. Without any, print how to make them."""
    results = Path(os.environ.get("RESULTS") or DEFAULT)
    result = [run for run in read(results) if run.question == question]
    if not result:
        text(f"**{results} holds no result of `{question}`: `make experiments ONLY={question}` makes them.**")
    if wrong := differences([run.about for run in result]):
        text(f"**The results of `{question}` in {results} cannot be compared ({wrong}): none is shown.**")
        return []
    print(len(result), "runs,", len({run.seed for run in result}), "seeds")
    return result


def show(path: Path) -> None:
    """Show a picture in a notebook; else say where it is."""
    if _in_jupyter():
        from IPython.display import Image, display

        display(Image(filename=str(path)))
    else:
        print(path)


def picture(several: list[Run]) -> Path | None:
    """Draw and show the picture of a question's runs. Return None without a run."""
    folder = Path(os.environ.get("FIGURES") or tempfile.mkdtemp(prefix="anytouch-"))
    for path in pictures.draw_all(several, folder):
        show(path)
        return path
    return None


def finding(question: str, several: list[Run]) -> str:
    """Show and return the tables of a question and its signs."""
    part = report.parts(several)[question]
    text(part.text)
    return part.text


class Given(Work):
    """Work whose every training is the run `run`."""

    def __init__(self, run: Path, folder: Path, real: Path) -> None:
        super().__init__(folder, real=real)
        self.run = run

    def run_of(self, one: plan.Training) -> Path:
        return self.run


def yours(question: str, several: list[Run]) -> list[dict[str, object]]:
    """Score the run `RUN` on the question as the matrix does, show it next to our rows, and return its rows.

    Scoring takes minutes on a CPU. Simulated data sets that are missing in DATA (default: runs/matrix) are made there.
    Raises UserError for a missing run or manifest of real touch.
    """
    data = os.environ.get("DATA", "")
    if not os.environ.get("RUN"):
        text("`RUN=folder DATA=folder` in the environment scores a checkpoint of yours on this question.")
        return []
    run = Path(os.environ["RUN"])
    if not run.exists():
        raise UserError(f"there is no run {run}; RUN= is a run folder or a weights file")
    folder, real = Path(data or ROOT / "runs" / "matrix"), ROOT.parent / "shared" / "real_touch" / "manifest.csv"
    if question == plan.REAL:
        folder, real = Path(tempfile.mkdtemp(prefix="anytouch-")), Path(data or real)
        if not real.exists():
            raise UserError(f"there is no {real}; DATA= is the manifest of real touch")
    work, name = Given(run, folder, real), COMPARED.get(question, "anytouch")
    leaf = plan.Leaf(question, name, 0, plan.training(SIZE, "anytouch", 0), SIZE)
    for one in plan.scenes(SIZE) if question != plan.REAL else ():
        if not work.made(one, SIZE):
            text(f"{folder / one.name} is simulated first, which takes minutes.")
            work.make(one, SIZE)
    result = scores.score(leaf, work)["rows"]
    text(f"{run}, and the mean over seeds of `{name}` in the results. Other data give other numbers:")
    head = ("view", "task", "metric", "protocol", "yours", "95 %", "ours")
    text(markdown_table(head, _compared(result, several, name)))
    return list(result)


def _compared(result: list[dict[str, object]], several: list[Run], name: str) -> list[tuple[str, ...]]:
    """A line for each row: its value and interval, and the mean of the rows of `name` that measure the same."""
    keys = ("view", "task", "metric", "protocol")
    ours: dict[tuple[object, ...], list[float]] = {}
    for row in (row for run in several if run.name == name for row in run.about["rows"]):
        if row["mean"] is not None:
            ours.setdefault(tuple(row[key] for key in keys), []).append(row["mean"])
    lines = []
    for row in result:
        low, high, same = row.get("low"), row.get("high"), ours.get(tuple(row[key] for key in keys))
        between = "-" if low is None or high is None else f"{low:.3f} to {high:.3f}"
        mean = "-" if row["mean"] is None else f"{row['mean']:.3f}"
        lines.append((*(str(row[key]) for key in keys), mean, between, f"{np.mean(same):.3f}" if same else "-"))
    return lines


def text(words: str) -> None:
    """Show Markdown."""
    if _in_jupyter():
        from IPython.display import Markdown, display

        display(Markdown(words))
    else:
        print(words)


def _in_jupyter() -> bool:
    try:
        from IPython import get_ipython
    except ImportError:
        return False
    return get_ipython() is not None
