"""The page of speed: what to choose on a kind of processor, with the error of each time."""

from __future__ import annotations

from pathlib import Path

from experiments.benchmarks.table import HEAD, Rows, rows_by_kind, simulated_table
from experiments.compare.table import families_table
from experiments.pages.page import Page, Table
from experiments.records import read_records


def _choice(kind: str, rows: Rows) -> tuple[str, str]:
    """Return what to choose on a kind of processor, and the figures of that."""
    words = []
    figures = []
    for preset in dict.fromkeys(
        row[0].partition(", ")[2] for row in rows if row[1] == "ours, bfloat16"
    ):
        half = [
            row[3].mean
            for row in rows
            if row[0].endswith(f", {preset}") and row[1] == "ours, bfloat16"
        ]
        words.append(f"preset {preset} in {'bfloat16' if max(half) < 0.95 else 'float32'}")
        figures.append(f"bfloat16 at {preset}: {min(half):.2f} to {max(half):.2f} of the time.")
    if engines := [row for row in rows if row[0].startswith("one touch") and row[4] < 1e-4]:
        best = min(engines, key=lambda row: row[3].mean)
        words.append(f"one touch by `{best[1]}`")
        figures.append(f"`{best[1]}`: {best[3].mean:.2f} of the time of XLA.")
    if torch := [row[3].mean for row in rows if row[1].startswith("PyTorch")]:
        figures.append(f"PyTorch: {min(torch):.2f} to {max(torch):.2f} of our time in float32.")
    return f"On {kind}: {', '.join(words)}.", " ".join(figures)


def speed(folder: Path) -> Page:
    """What to choose, by kind of processor."""
    by_kind = dict(sorted(rows_by_kind(folder).items(), key=lambda item: item[0] != "AVX2"))
    choices = [_choice(kind, rows) for kind, rows in by_kind.items()]
    names = ("tried", "compare", "variants")
    tried, families, variants = (read_records(folder / f"{name}.jsonl") for name in names)
    spent = [
        (one["question"], one["answer"], one["figure"])
        for one in tried.values()
        if one.get("speed")
    ]
    gpu = any(one["machine"]["device"] != "cpu" for one in variants.values())
    words = {"gpu": "" if gpu else "No step is measured on a GPU. `make bench-gpu` measures yours."}
    own = [Table(f"On {kind}", HEAD, rows) for kind, rows in by_kind.items()]
    tables = [*own, simulated_table(folder), spent, families_table(families)]
    return Page(
        "speed",
        tables,
        [f"{one} {figure[0].upper()}{figure[1:]}" for one, figure in choices],
        choices[0],
        words=words,
    )
