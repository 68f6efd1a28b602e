"""The table of encoders: costs, and the accuracy of a user's files."""

from __future__ import annotations

from collections.abc import Mapping

from experiments.pages.page import Measure, Table
from experiments.records import Record

COSTS = {
    "million parameters": ("parameters", 1e6, ".1f"),
    "GFLOP": ("flops", 1e9, ".1f"),
    "ms to prepare a frame": ("prepare_ms", 1, ".0f"),
    "ms a touch": ("encode_ms", 1, ".0f"),
    "processor ms": ("encode_cpu_ms", 1, ".0f"),
    "MiB": ("memory", 2**20, ".0f"),
}


def families_table(records: Mapping[str, Record]) -> Table:
    """Return the table of `make compare` from its records."""
    costs = {key.partition("/")[2]: one for key, one in records.items() if one["kind"] == "cost"}
    scores = {
        (one["encoder"], f"{head}, {one['protocol']}, %"): 100 * value
        for one in records.values()
        if one["kind"] == "accuracy"
        for head, value in one["scores"].items()
    }
    columns = sorted({column for _, column in scores})
    measures = [
        *(Measure(name, form) for name, (_, _, form) in COSTS.items()),
        *map(Measure, columns),
    ]
    rows = [
        (
            name,
            str(one["frames"]),
            " x ".join(map(str, one["pixels"])),
            *(one[key] / unit for key, unit, _ in COSTS.values()),
            *(scores.get((name, column)) for column in columns),
        )
        for name, one in sorted(costs.items(), key=lambda item: item[1]["flops"])
    ]
    return Table(
        "One touch by other families, untrained copies",
        ["encoder", "frames", "pixels", *measures],
        rows,
    )
