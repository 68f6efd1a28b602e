"""Pages on trust: calibration and novelty of heads, and health of sensor units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from anytouch_jax.errors import UserError
from experiments.pages.page import Measure, Page, Value
from experiments.records import Record, read_records

NAME = "trust.jsonl"
COMMAND = "python -m experiments.real.trust NAME MANIFEST"


def _of_kind(folder: Path, kind: str) -> dict[str, Record]:
    records = read_records(folder / NAME)
    chosen = {key.partition("/")[2]: one for key, one in records.items() if key.startswith(kind)}
    if not chosen:
        raise UserError(f"{folder / NAME} has no record of {kind}. Run experiments.real.trust first.")
    return chosen


def _percent(values: list[float]) -> Value:
    return Value(values[0], values[1], values[2]).times(100)


def trust(folder: Path) -> Page:
    """Calibration, coverage and novelty."""
    rows: list[Any] = []
    findings = []
    for name, one in _of_kind(folder, "trust").items():
        figures = {
            "right": "accuracy", "calibration error before": "ece_before", "calibration error": "ece",
            f"sets hold the class, {one['asked']:.0%} asked": "coverage", "decided": "decided",
            f"known called novel, {one['false_alarms']:.0%} asked": "novel",
        }  # fmt: skip
        rows += [(name, title, _percent(one[key])) for title, key in figures.items()]
        rows += [(name, f"AUROC of {score}, classes never met", _percent(value))
                 for score, value in one["never_met"].items()]  # fmt: skip
        for sensor, found in one["sensors"].items():
            rows.append((name, f"AUROC of novelty, {sensor} never met", _percent(found["auroc"])))
            rows.append((name, f"called novel, {sensor} never met", Value(100 * found["novel"])))
        covered, asked = _percent(one["coverage"]), 100 * one["asked"]
        findings.append(
            f"{name}: sets hold the class in {covered.mean:.1f} %, and {asked:.0f} % was asked. "
            f"The calibration error is {one['ece'][0]:.3f}. A set has {one['size']:.1f} of {one['classes']} classes."
        )
        if value := one["never_met"].get("novelty"):
            words = "is higher" if value[1] > 0.5 else "is not shown to be higher"
            findings.append(f"{name}: the novelty of classes never met {words}, with an AUROC of {value[0]:.2f}.")
        if one["sensors"]:
            least = min(found["auroc"][0] for found in one["sensors"].values())
            findings.append(f"{name}: of sensors never met, the novelty of the hardest has an AUROC of {least:.2f}.")
    return Page(
        "trust", "Does a head know when it does not know?",
        "A linear head on features of `anytouch-tiny` is calibrated, and then tested on recordings that it never met. "
        "Recordings are split at random, again and again: 60 % to fit, 20 % to calibrate, 20 % to test. Parts of the "
        "60 % are left out in turn and calibrate too. Every recording has the same weight. Intervals are "
        "over recordings, or over objects where those are left out. An AUROC of 50 % is chance.",
        ("data", "figure", Measure("value, %")),
        rows, findings, (NAME,), f"{COMMAND} --features FEATURES",
    )  # fmt: skip


def health(folder: Path) -> Page:
    """False alarms, and made faults that the right check reports."""
    records = _of_kind(folder, "health")
    rows: list[Any] = []
    findings = []
    for name, one in records.items():
        alarmed = len({alarm.partition(":")[0] for alarm in one["alarms"]})
        reported, made = (sum(counts[i] for counts in one["faults"].values()) for i in (0, 1))
        findings.append(
            f"{name}: {reported} of {made} made faults are reported ({100 * reported / made:.1f} %). "
            f"{alarmed} of {one['units']} good units raise an alarm."
        )
        findings += [f"{name}, false alarm: {alarm}." for alarm in one["alarms"]]
    for fault in next(iter(records.values()))["faults"]:
        counts = [one["faults"][fault] for one in records.values()]
        reported, made, undecided = map(sum, zip(*counts, strict=True))
        parts = ", ".join(f"{count[0]} of {count[1]}" for count in counts)
        rows.append((fault, parts, Value(100 * reported / made), undecided))
    return Page(
        "health", "Does the health check find faults, and spare good sensors?",
        "Sixteen faults are made from the pictures of each good unit. A fault counts if the check that is responsible "
        "for it gives an alarm. Some checks cannot decide on some units, for instance without a picture of the "
        f"untouched gel. These are not counted as reported or missed. The counts are of {' | '.join(records)}.",
        ("made fault", "reported", Measure("reported, %"), Measure("units not decided", ".0f", False)),
        rows, findings, (NAME,), f"{COMMAND} --health",
        "Share of the made faults that are reported.",
    )  # fmt: skip
