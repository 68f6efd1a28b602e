"""The table of speed against error as Markdown and JSON. Imports nothing that a bare accelerator image lacks."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from anytouch_jax.evaluate.statistics import markdown, plain
from anytouch_jax.files import atomic_write
from experiments.benchmarks.speed import Row

_HEADS = (
    "variant",
    "samples",
    "time / baseline (IQR)",
    "ms",
    "samples/s",
    "GFLOP/s",
    "of its peak",
    "of float32 peak",
    "error: output",
    "loss",
    "gradient",
    "MiB",
    "temporary MiB",
    "copies",
    "trace s",
    "compile s",
)

NOTES = """A time is a median over rounds in which all rows of a table, and the matrix products of the peak, take turns;
the ratio is to the first row of the same round, IQR its interquartile range. GFLOP/s counts useful operations only: the
matrix products of the formula in `evaluate/flops.py`, not what is computed twice or for empty slots. "Of its peak" is
the share of a large square product of the variant's own type in the same rounds. Errors are relative, L2 over all
elements, against the same parameters and batch in float64. MiB: arguments, results and temporaries of the compiled
program. Compile times are cold."""


def to_markdown(rows: Sequence[Row]) -> str:
    """A table a workload, and one of latencies for what was timed one sample at a time."""
    parts, names = [], list(dict.fromkeys(row.workload for row in rows))
    for name in names:
        members = [_cells(row) for row in rows if row.workload == name]
        parts.append((f"### {name}\n\n" if len(names) > 1 else "") + markdown(_HEADS, members) + "\n")
    single = [row for row in rows if row.samples == 1 and not row.note]
    if single:
        cells = [
            [r.workload, r.variant, f"{1e3 * r.p50:.2f}", f"{1e3 * r.p99:.2f}", str(r.calls), error(r.error_output)]
            for r in single
        ]
        heads = ("latency of one sample", "variant", "p50 ms", "p99 ms", "calls", "error")
        parts.append(markdown(heads, cells) + "\n")
    return "\n".join(parts)


def _cells(row: Row) -> list[str]:
    if row.note:
        return [row.variant, str(row.samples), row.note, *[""] * (len(_HEADS) - 3)]
    return [
        row.variant,
        str(row.samples),
        f"{row.ratio:.2f} ({row.ratio_iqr:.2f})",
        f"{1e3 * row.seconds:.1f}",
        f"{row.samples_per_second:.4g}",
        f"{row.gflops:.1f}",
        f"{100 * row.peak_share:.0f} %",
        f"{100 * row.float32_share:.0f} %",
        *(error(value) for value in (row.error_output, row.error_loss, row.error_gradient)),
        f"{row.peak_bytes / 2**20:.0f}",
        f"{row.temp_bytes / 2**20:.0f}",
        str(row.copies),
        f"{row.trace_seconds:.1f}",
        f"{row.compile_seconds:.1f}",
    ]


def error(value: float | None) -> str:
    """A relative error for a table."""
    return "" if value is None else f"{value:.1e}"


def points(rows: Sequence[Row]) -> dict[str, tuple[float, float]]:
    """(time ratio, error) of the rows that have both, for `plots.pareto`: of the gradient, or of the output."""
    found = {}
    for row in rows:
        wrong = row.error_output if row.error_gradient is None else row.error_gradient
        if wrong is not None and wrong > 0 and math.isfinite(row.ratio):
            found[row.variant] = (row.ratio, wrong)
    return found


def as_dict(row: Any) -> dict[str, Any]:
    """A record as JSON takes it: a number that is not finite is null."""
    values: dict[str, Any] = plain(row._asdict() if isinstance(row, tuple) else row)  # type: ignore[attr-defined]
    if isinstance(row, Row):
        values |= plain({"samples_per_second": row.samples_per_second, "gflops": row.gflops})
    return values


def write(folder: Path, name: str, text: str, numbers: Mapping[str, Any]) -> Path:
    """Write `name`.md and `name`.json in a folder, each in one move. Raises OSError."""
    for suffix, content in ((".json", json.dumps(numbers, indent=2, allow_nan=False) + "\n"), (".md", text)):
        path = folder / f"{name}{suffix}"
        atomic_write(path, content)
    return path
