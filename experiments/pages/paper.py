"""Rows and findings of the paper's tables: sensors, space, parts, pouring and translation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from experiments.pages.page import RECORDS, Finding, Page, Row
from experiments.pouring import table as pours
from experiments.records import check_alike, read_records
from experiments.tables import images, paper
from experiments.tables.columns import FORM, FOUR, MOVING, SIX, title
from experiments.tables.results import Column, Matrix
from experiments.translation.settings import PIXELS, TRANSLATIONS, TRANSLATORS, TUNES, shared
from experiments.values import Seeds, Value, over_seeds, shared_difference

NAMES = {
    [*paper.TABLE1][-1]: "an encoder of all four sensors",
    "gelsight": "an encoder of GelSight alone",
}


def finding(
    of: Matrix, first: str, second: str, columns: Sequence[Column], what: str = "", **form: str
) -> Finding:
    """Return what the seeds say of two models, on `what`."""
    names = (NAMES.get(name, title(name)) for name in (first, second))
    return Finding(*names, of.change(first, second, columns), what, **form)


def sensors(folder: Path) -> Page:
    """Table 1."""
    of = Matrix(folder / "matrix.jsonl", "q1")
    rows = []
    findings = []
    one = [*paper.TABLE1][1]
    every = [*paper.TABLE1][-1]
    theirs = {name: float(np.mean(row[2:])) for name, row in paper.TABLE1.items()}  # type: ignore[arg-type]
    for label, columns in (("material", FOUR[2:]), ("indenter", FORM[2:])):
        for name in paper.TABLE1:
            paper_change = (
                theirs[name] - theirs[one] if label == "material" and name != one else None
            )
            change = of.change(name, one, columns)
            rows.append((label, title(name), of.value(name, columns), change, paper_change))
        findings += [
            finding(of, every, one, columns, label),
            finding(of, one, "no_pretraining", columns, label),
        ]
    return Page("sensors", [rows], findings)


def space(folder: Path) -> Page:
    """Figure 4."""
    of = Matrix(folder / "matrix.jsonl", "q2")
    names = ("pixels", "contact", "untrained", "masked", "aligned", "matched", "matched_mlp")
    top = [Column("class token", "top-1", "fraction")]
    sensor, thing = (
        [Column("class token", f"silhouette by {one}", f"silhouette by {one}", 1.0)]
        for one in ("sensor", "object")
    )
    findings = [
        finding(of, "matched", other, top, "retrieval")
        for other in ("untrained", "aligned", "pixels")
    ]
    pairs = (
        ("matched", "aligned", sensor),
        ("masked", "untrained", sensor),
        ("aligned", "masked", sensor),
        ("matched", "aligned", thing),
    )
    findings += [
        finding(of, a, b, columns, columns[0].task, unit="", form=".3f") for a, b, columns in pairs
    ]
    rows = [(title(name), *(of.value(name, one) for one in (top, sensor, thing))) for name in names]
    return Page("space", [rows], findings, figure=partial(images.q2, of.runs))


def ablations(folder: Path) -> Page:
    """Table 6, and the models of Tables 2 and 3."""
    of = Matrix(folder / "matrix.jsonl", "ablations")
    whole = paper.TABLE6["anytouch"]
    rows: list[Row] = [
        (
            title(name),
            of.value(name, FOUR),
            of.change(name, "anytouch", FOUR),
            of.change(name, "anytouch", FORM),
            None if name == "anytouch" else float(np.mean(np.subtract(theirs, whole))),
        )  # type: ignore[arg-type]
        for name, theirs in paper.TABLE6.items()
    ]
    parts = sorted(
        [name for name in paper.TABLE6 if name != "anytouch"], key=lambda name: name != "no_stage2"
    )
    labels = (("material", FOUR), ("indenter", FORM))
    findings = [
        finding(of, name, "anytouch", columns, label) for name in parts for label, columns in labels
    ]
    q3 = Matrix(folder / "matrix.jsonl", "q3")
    names = (
        "pixels",
        "untrained",
        "no_pretraining",
        "unitouch",
        "tlv_link",
        "t3",
        "static_only",
        "anytouch",
    )
    others: list[Row] = [
        (
            title(name),
            *(
                cell
                for columns in (SIX, MOVING)
                for cell in (q3.value(name, columns), q3.change("anytouch", name, columns))
            ),
        )
        for name in names
    ]
    frames, words = next_frames(folder / "next_frame.jsonl")
    tables: list[list[Row]] = [rows, others]
    if frames:
        tables.append(frames)
    return Page("ablations", tables, findings, words={"next_frame": words})


def next_frames(file: Path) -> tuple[list[Row], str]:
    """Return the rows on prediction of the next frame, and what they say in words."""
    rows: list[Row] = []
    better = []
    for name, record in read_records(file).items():
        for part, clips in (("all", "in contact"), ("moving", "the moving half")):
            one = record[part]
            low, high = one["interval"]
            gain = Value(one["gain"], low, high)
            rows.append((name, clips, record["steps"], one["error"], one["copy"], gain))
            better.append(low > 0)
    if not rows:
        return rows, ""
    words = " No prediction of the next frame is better than a copy of the last one"
    if any(better):
        words = " Some predictions of the next frame are better than a copy of the last one"
    why = (
        ", on objects that are held out, trained from the encoder in the package by `python -m "
        "experiments.encoders.next_frame`. A gel hardly changes between two frames, so a copy is "
        "nearly right, and a network of this size that paints every pixel anew is not. `residual` "
        "predicts what changes alone."
    )
    return rows, words + why


def pouring(folder: Path) -> Page:
    """Table 4: pouring by touch alone."""
    files = zip(
        RECORDS["pouring"]["data"], ("1000 demonstrations", "200 demonstrations"), strict=True
    )
    several = [pours.compared(folder / file, data) for file, data in files]
    return Page(
        "pouring",
        [[row for rows, _ in several for row in rows]],
        [one for _, found in several for one in found],
    )


def translation(folder: Path) -> Page:
    """Table 7: one sensor's touch as another would feel it."""
    rows = []
    findings = []
    for file, steps in zip(
        RECORDS["translation"]["data"], ("3000 steps", "400 steps"), strict=True
    ):
        runs = [*read_records(folder / file).values()]
        check_alike(folder / file, [shared(one["settings"]) for one in runs])
        errors: dict[tuple[str, str], dict[str, Seeds]] = {}
        for one in runs:
            about = one["settings"]
            tasks = errors.setdefault(
                (about["name"], "scratch" if about["name"] == PIXELS else about["fit"]["tune"]), {}
            )
            tasks.setdefault(f"{about['from']}-{about['to']}", {})[about["fit"]["seed"]] = one[
                "error"
            ]
        for (encoder, tune), tasks in sorted(errors.items()):
            each = (
                over_seeds([*tasks[task].values()]) if task in tasks else None
                for task in TRANSLATIONS
            )
            rows.append((steps, TRANSLATORS.get(encoder, encoder), TUNES[tune], *each))
            for task, words in TRANSLATIONS.items() if encoder == "anytouch" else ():
                change = shared_difference(
                    tasks.get(task, {}), errors.get(("t3", tune), {}).get(task, {})
                )
                what = f"error, {words}, {TUNES[tune]}, {steps}"
                findings.append(Finding("AnyTouch", "T3-style", change, what, "", ".4f"))
    return Page("translation", [rows], findings)
