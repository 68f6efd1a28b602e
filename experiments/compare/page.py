"""The page that compares encoders, made from the records alone."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from anytouch_jax.errors import UserError
from experiments.pages.page import Measure, Page
from experiments.records import read_records

NAME = "compare.jsonl"
_COSTS = (
    ("million parameters", "parameters", 1e6, ".1f"),
    ("GFLOP", "flops", 1e9, ".1f"),
    ("ms to prepare a frame", "prepare_ms", 1, ".0f"),
    ("ms a touch", "encode_ms", 1, ".0f"),
    ("processor ms", "encode_cpu_ms", 1, ".0f"),
    ("MiB", "memory", 2**20, ".0f"),
)
_ABOUT = (
    "A row is one touch, with the family's own number of frames and pixels. "
    "The operations are those of matrix products. "
    "The memory holds the parameters and all arrays of one call. "
    "Each was called three times. A time is the shortest of the calls. "
    "Compare encoders by the processor time, the median over the calls of the sum over the threads. "
    "Accuracy is that of probes, by the honest protocol and by the published one."
)


def compare_encoders(folder: Path, data: str = NAME) -> Page:
    """Return the page of a file of results: costs, and the accuracy of a user's files. Raises UserError without one."""
    records = read_records(folder / data)
    costs = {key.partition("/")[2]: one for key, one in records.items() if one["kind"] == "cost"}
    if not costs:
        raise UserError(f"{folder / data} has no record of costs. Run `make compare` first.")
    scores = {
        (one["encoder"], one["protocol"], head): 100 * value
        for one in records.values()
        if one["kind"] == "accuracy"
        for head, value in one["scores"].items()
    }
    columns = sorted({(protocol, head) for _, protocol, head in scores})
    head = ["encoder", "frames", "pixels", *(Measure(title, form, interval=False) for title, _, _, form in _COSTS)]
    head += [Measure(f"{name}, {protocol}, %", interval=False) for protocol, name in columns]
    rows = [
        (
            name, str(one["frames"]), " x ".join(map(str, one["pixels"])),
            *(one[key] / unit for _, key, unit, _ in _COSTS),
            *(scores.get((name, *column)) for column in columns),
        )
        for name, one in sorted(costs.items(), key=lambda item: item[1]["flops"])
    ]  # fmt: skip
    machines = sorted({f"{one['machine']['processor']}, {one['machine']['cores']} cores" for one in costs.values()})
    loads = sorted(one["machine"]["load"] for one in costs.values())
    rates = sorted(one["flops"] / one["encode_cpu_ms"] / 1e6 for one in costs.values())
    findings = [
        f"{rows[0][0]} needs the fewest operations for a touch, and {rows[-1][0]} the most.",
        f"A second of one core does {rates[0]:.0f} to {rates[-1]:.0f} GFLOP of these encoders.",
    ]
    if not scores:
        findings.append(
            "No weights of the families are in this repository. With your files you get columns of accuracy: "
            '`make compare ENCODERS="a=FILE b=FILE" DATA=manifest.parquet LABEL=material`.'
        )
    about = "those of your files" if scores else "untrained copies of the released sizes"
    return Page(
        "compare",
        "What does each family of encoders cost, and what does it know?",
        f"The encoders are {about}, in float32. {_ABOUT} The machine is {' or '.join(machines)}. Other work ran on it, "
        f"and its load was {loads[0]:.0f} to {loads[-1]:.0f}.",
        head, rows, findings, (data,), "make compare",
        "Operations of a touch and the processor time that it takes.", partial(_draw, costs),
    )  # fmt: skip


def _draw(costs: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure

    from anytouch_jax.evaluate.plots import write_figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    for name, one in costs.items():
        place = (one["flops"] / 1e9, one["encode_cpu_ms"])
        axis.scatter(*place, s=22)
        axis.annotate(name, place, fontsize=6, xytext=(3, 3), textcoords="offset points")
    axis.set(xscale="log", yscale="log", xlabel="GFLOP a touch", ylabel="processor ms a touch")
    axis.grid(alpha=0.25)
    write_figure(path, figure)
