"""Rows of the benchmarks from their records: times of a step and of a touch, by kind of
processor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.pages.page import Measure, Table
from experiments.records import Record, read_records
from experiments.values import Value

WORKS = ("one touch", "stage1 clips", "stage2 align", "embed clips")  # in the order of their rows
HEAD = (
    "work",
    "way",
    Measure("ms"),
    Measure("time / ours in float32", ".2f"),
    Measure("error", ".0e"),
)
SIMULATED = (
    "device",
    "touches",
    Measure("frames/s", ",.0f"),
    Measure("processor ms a frame", ".2f"),
    Measure("roofline, %", ".0f"),
    Measure("mm", ".4f"),
    Measure("kPa", ".2f"),
    Measure("grey levels", ".2f"),
)
Rows = list[tuple[Any, ...]]


def _ratio(row: Mapping[str, Any]) -> Value:
    half = row.get("ratio_iqr", 0) / 2
    if half:
        return Value(row["ratio"], row["ratio"] - half, row["ratio"] + half)
    return Value(row["ratio"])


def rows_by_kind(folder: Path) -> dict[str, Rows]:
    """Return rows of HEAD by kind of processor: AVX2, AMX, or the name of another processor or a
    GPU.
    """
    result: dict[str, Rows] = {}

    def add(
        one: Record, work: str, way: str, seconds: float, row: Mapping[str, Any], error: float
    ) -> None:
        about = one["machine"]
        unknown = f"{about['processor']}, vector instructions not noted"
        kind = about["device"] if about["device"] != "cpu" else about.get("vectors") or unknown
        rows = result.setdefault(kind, [])
        if (work, way) not in [known[:2] for known in rows]:
            rows.append((work, way, 1e3 * seconds, _ratio(row), error))

    for one in read_records(folder / "engines.jsonl").values():
        if "p50_ms" in one and one["encoder"] == "anytouch-tiny":
            add(
                one,
                "one touch, anytouch-tiny",
                one["engine"],
                one["p50_ms"] / 1e3,
                one,
                one["error"],
            )
    for name in ("variants", "torch"):
        for one in read_records(folder / f"{name}.jsonl").values():
            for work, found in one["results"].items():
                for row in found["rows"] if isinstance(found, dict) else found:
                    way = row.get("name") or f"ours, {row['variant']}"
                    option = way.startswith("ours, float32, ") and one["machine"]["device"] == "cpu"
                    if (
                        (kind := work.partition(",")[0]) in WORKS
                        and not option
                        and not row.get("note")
                    ):
                        error = (
                            row.get("gradient")
                            or row.get("error_gradient")
                            or row.get("error_output")
                        )
                        add(
                            one,
                            f"{kind}, {one['preset']}",
                            way,
                            row["seconds"],
                            row,
                            error or row.get("output"),
                        )
    for rows in result.values():
        rows.sort(key=lambda row: (WORKS.index(row[0].partition(",")[0]), row[0]))
    return result


def simulated_table(folder: Path) -> Table:
    """Return the speed of the simulator and the error of "fast" against "exact": means of sensors,
    then sensors.
    """
    groups: dict[tuple[str, str], list[Record]] = {}
    for one in read_records(folder / "simulator.jsonl").values():
        device = one["machine"]["device"].replace("cpu", one["machine"].get("vectors", ""))
        kind = (
            f"{one['size']} pixels, {'stills' if one['frames'] == 1 else 'clips'}, "
            f"{one['fidelity']}"
        )
        groups.setdefault((device, kind), []).append(one)
        if one["sensor"] != "all" and (one["size"], one["frames"], one["fidelity"]) == (
            112,
            1,
            "fast",
        ):
            groups.setdefault((device, f"{kind}, {one['sensor']}"), []).append(one)
    names = ("frames_s", "processor_ms", "roofline", "mm", "kpa", "levels")
    rows = [
        (*key, *(_mean(found, name) for name in names)) for key, found in sorted(groups.items())
    ]
    return Table("Simulated touches", SIMULATED, rows)


def _mean(found: Sequence[Record], name: str) -> float | None:
    values = [one[name] for one in found if name in one]
    if values:
        return float(np.mean(values)) * (100 if name == "roofline" else 1)
    return None
