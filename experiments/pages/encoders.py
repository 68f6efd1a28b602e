"""Rows and findings of the encoders in the package: real recordings, look-alikes, motion and
trust.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.weights.registry import DEFAULT
from experiments.pages.page import Finding, Page
from experiments.real.scores import HEADS, TASKS, TRAINED, Score
from experiments.records import Record, check_alike, read_records
from experiments.values import Value, percent

UNTRAINED = "untrained:"
FINGER = "object, other finger"


def _score(one: Record, task: str) -> Score | None:
    found = one["tasks"].get(task)
    return found and Score(
        np.array(found["correct"], bool), np.array(found["groups"]), found["option"]
    )


def _minus(score: Score | None, other: Score | None) -> Value | None:
    if score is None or other is None or score is other:
        return None
    return percent(score.minus(other))


def _fraction(score: Score | None) -> Value | None:
    if score is None:
        return None
    return percent((score.fraction, *score.interval()))


def real(folder: Path) -> Page:
    """Encoders on real recordings, with and without images of the untouched gel."""
    path = folder / "real.jsonl"
    records = read_records(path)
    check_alike(path, [{"data": one["data"]} for one in records.values()])
    rows: list[Any] = []
    findings: list[Finding] = []
    readme: dict[str, Value] = {}
    for task in (FINGER, *(task for task in TASKS if task != FINGER)):
        scores = {
            name: [_score(one, f"{task}, {head}") for head in (*HEADS, TRAINED)]
            for name, one in records.items()
        }
        found = []
        for name, (linear, near, trained) in scores.items():
            end = name.removeprefix(
                plain := name.removesuffix(f", {records[name].get('untouched')}")
            )
            fresh = scores.get(f"{UNTRAINED}{plain}", scores.get(f"{UNTRAINED}{DEFAULT}", [None]))[
                0
            ]
            learned = UNTRAINED not in name
            pixels = scores.get(f"pixels{end}", [None])[0]
            against = (pixels, None if end else fresh) if learned else (None, None)
            against = (*against, scores[plain][0] if end else None)
            changes = [_minus(linear, other) for other in against]
            found.append((task, name, _fraction(linear or trained), _fraction(near), *changes))
            if records[name]["kind"] == "encoder" and learned:
                others = (f"pixels{end}", "an untrained encoder", f"`{plain}` by the rule")
                findings += [
                    Finding(f"`{name}`", *pair, task)
                    for pair in zip(others, changes, strict=True)
                    if pair[1]
                ]
        rows += sorted((row for row in found if row[2] is not None), key=lambda row: -row[2].mean)
        readme |= {
            row[1].removesuffix(f":{DEFAULT}"): row[2]
            for row in found
            if task == FINGER and row[2] is not None
        }
    findings.sort(key=lambda one: one.first != f"`{DEFAULT}`")
    return Page("real", [rows], findings, readme=readme)


def motion(folder: Path) -> Page:
    """The sign of a turn and the direction of a slide, from frozen tokens."""
    rows = []
    findings = []
    for name, record in read_records(folder / "motion.jsonl").items():
        scores = record["scores"]
        own = [
            (
                name,
                row,
                *(
                    percent([found[k]["fraction"], *found[k]["interval"]])
                    for k in ("turn", "slide")
                ),
            )
            for row, found in scores.items()
        ]
        findings.append(
            f"`{name}`: the head names {own[0][2].mean:.0f} % of turns of new objects. A linear "
            f"probe on the mean token names {100 * record['pooled']:.0f} %."
        )
        rows += own
    answer = "A small head on the patch tokens names this fraction of turns of new objects."
    return Page("motion", [rows], findings, (answer, f"{rows[0][2].shown()} %"))


def measure(folder: Path) -> Page:
    """Errors of depth, shear and force, simulated and on real balls."""
    sensors = read_records(folder / "measure.jsonl")
    fractions = {
        name: {part: 100 * value for part, value in one.items() if isinstance(value, float)}
        for name, one in sensors.items()
    }
    rows = [
        (name, one["depth"], *map(fractions[name].get, ("iou", "force", "inside", "covered")))
        for name, one in sensors.items()
    ]
    others = ("dots_shear", "drag", "shear", "false_contact", "false_force")
    along = [(name, *map(one.get, others)) for name, one in fractions.items()]
    balls = {
        name: one for name, one in read_records(folder / "balls.jsonl").items() if "centre" in one
    }
    real = [
        (
            name,
            *(
                percent(one["radius"]) if part == "radius" else Value(*one[part])
                for part in ("radius", "centre", "profile")
            ),
        )
        for name, one in balls.items()
    ]
    flats = read_records(folder / "flats.jsonl")
    objects = [
        (
            name,
            one["deepest"],
            one["read"],
            *(100 * one[part] for part in ("filled", "iou", "force_bias", "force", "force_in_2")),
        )
        for name, one in flats.items()
        if "filled" in one
    ]
    devices, held = _devices(folder)
    states = _states(folder)
    low, high = (bound(row[1] for row in rows) for bound in (min, max))
    studs = flats["studs"]
    findings = [
        f"A grid of flat studs: the depth in contact is {100 * studs['filled']:.0f} % of the true "
        f"one, of a coin {100 * flats['coin']['filled']:.0f} %.",
        f"Simulated: depth in contact is off by {low:.2f} to {high:.2f} mm, by sensor.",
        *(
            f"{name}: the radius is off by {100 * one['radius'][0]:.0f} %, the centre by "
            f"{one['centre'][0]:.2f} mm."
            for name, one in balls.items()
        ),
    ]
    answer = "On new simulated units the depth in contact is off by this much."
    tables = [real, devices, held, rows, objects, along, states]
    return Page("measure", tables, findings, (answer, f"{low:.2f} to {high:.2f} mm"))


def _devices(folder: Path) -> tuple[list[Any], list[Any]]:
    """Return the rows of real circles, and those of intervals of force."""
    circles = read_records(folder / "circles.jsonl")
    rows = [
        (
            "GelSight of another lab",
            "one device",
            name,
            *map(one.get, ("centre", "radius", "depth")),
        )
        for name, one in circles.items()
    ]
    cases = {
        "calibrated": "calibrated by three presses of one object, others pressed",
        "family": "of a known kind, not calibrated",
        "unknown": "of an unknown kind, not calibrated",
    }
    held = [
        (cases[name], "16 simulated devices", 100 * one["covered"], 100 * one["median_off"])
        for name, one in read_records(folder / "intervals.jsonl").items()
    ]
    return rows, held


def _states(folder: Path) -> list[Any]:
    """Return the confusion matrix of the condition of a sensor, in percent of each state."""
    rows: list[Any] = []
    for record in read_records(folder / "states.jsonl").values():
        for state, counts in zip(record["states"], record["counts"], strict=True):
            rows.append((state, *(100 * count / sum(counts) for count in counts)))
    return rows


def lookalikes(folder: Path) -> Page:
    """The same touch by another sensor, among 50 that resemble it."""
    rows = []
    findings = []
    readme = dict[str, Value]()
    records = read_records(folder / "lookalikes.jsonl")
    curve = records.pop("training", None)
    for key, record in records.items():
        grade = f"{key} alignment"
        scores = {
            name: percent([one["fraction"], *one["interval"]])
            for name, one in record["scores"].items()
        }
        scores = dict(sorted(scores.items(), key=lambda item: -item[1].mean))
        rows += [(grade, name, value) for name, value in scores.items()]
        parts = ", ".join(
            f"`{name}` finds {scores[name].mean:.0f} %"
            for name in scores
            if name in record["encoders"]
        )
        findings.append(f"{grade}: {parts}, and pixels {scores['pixels'].mean:.0f} %.")
        readme = scores if key == "fine" else readme
    if not (best := next(iter(readme), "")):
        return Page("lookalikes", [rows], findings)
    answer = (
        f"`{best}` finds this fraction first of 50, and raw pixels {readme['pixels'].mean:.1f} %."
    )
    learned = (
        [list(zip(curve["pairs"], (100 * fraction for fraction in curve["recall"]), strict=True))]
        if curve
        else []
    )
    return Page(
        "lookalikes",
        [rows, *learned],
        findings,
        (answer, f"{readme[best].shown()} %"),
        readme=readme,
    )


def new_sensor(folder: Path) -> Page:
    """Look-alikes, real objects, depth and force asked by a known sensor as if it was new."""
    kinds = {
        "universal": "universal tokens",
        "adapted": "adapted by simulation",
        "own": "its own tokens",
    }
    rows = []
    gains = []

    def value(record: Record, part: str, kind: str, unit: float) -> Value | None:
        one = record.get(part, {}).get(kind)
        return one and Value(one["fraction"], *one["interval"]).times(unit)

    for key, record in read_records(folder / "new_sensor.jsonl").items():
        steps = record["simulated"][0] if record["simulated"] else 0
        for kind, words in kinds.items():
            values = [
                value(record, part, kind, unit)
                for part, unit in (("scores", 100), ("depth", 1), ("force", 100))
            ]
            rows.append((key, words, steps if kind == "adapted" else None, *values))
        found = {kind: value(record, "scores", kind, 100) for kind in kinds}
        refused = "" if steps else " (refused: the universal tokens stay)"
        gains.append(
            f"{key}: {found['universal'].mean:.0f} % with universal tokens, "
            f"{found['adapted'].mean:.0f} % adapted{refused}, {found['own'].mean:.0f} % with its "
            "own."
        )
    return Page("new_sensor", [rows], gains)


def trust(folder: Path) -> Page:
    """Calibration, coverage and novelty of heads, and health of sensor units."""
    by_kind: dict[str, dict[str, Mapping[str, Any]]] = {}
    for key, one in read_records(folder / "trust.jsonl").items():
        by_kind.setdefault(key.partition("/")[0], {})[key.partition("/")[2]] = one
    if lost := {"trust", "health"} - by_kind.keys():
        raise UserError(
            f"{folder / 'trust.jsonl'} has no record of {min(lost)}. Run experiments.real.trust "
            "first."
        )
    rows = []
    findings = []
    units = by_kind["health"]
    for name, one in by_kind["trust"].items():
        hardest = min((found["auroc"] for found in one["sensors"].values()), default=None)
        both = (
            None if value is None else percent(value)
            for value in (one["never_met"].get("novelty"), hardest)
        )
        figures = (percent(one[key]) for key in ("accuracy", "ece", "coverage", "decided", "novel"))
        rows.append((name, *figures, one["size"], *both))
        findings.append(
            f"{name}: sets hold the class in {rows[-1][3].mean:.1f} %, and "
            f"{100 * one['asked']:.0f} % were asked for."
        )
    counts = {
        fault: np.sum([one["faults"][fault] for one in units.values()], 0)
        for fault in next(iter(units.values()))["faults"]
    }
    faults = [(fault, f"{one[0]} of {one[1]}", f"{one[2]}") for fault, one in counts.items()]
    reported, made = (sum(one[i] for one in counts.values()) for i in (0, 1))
    alarmed = sum(
        len({alarm.partition(":")[0] for alarm in one["alarms"]}) for one in units.values()
    )
    findings.append(f"{reported} of {made} made faults of sensor units are reported.")
    findings.append(
        f"{alarmed} of {sum(one['units'] for one in units.values())} good units raise an alarm."
    )
    answer = f"Of sets that should hold the class in 90 %, this fraction does. {findings[-2]}"
    return Page(
        "trust",
        [rows, faults],
        findings,
        (answer, f"{rows[0][3].shown()} %"),
        words={"units": ", ".join(name.replace(",", "") for name in units)},
    )
