"""The page that compares encoders, made from the records alone."""

from __future__ import annotations

from pathlib import Path

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import markdown_table
from experiments.benchmarks.machine import Machine
from experiments.records import read_records

_COSTS = (
    "The encoders are untrained copies of the released sizes, in float32.",
    "A row is one touch, with the family's own number of frames and pixels.",
    "The operations are those of matrix products.",
    "The memory holds the parameters and all arrays of one call.",
    "The processor time is that of all threads.",
)


def page(results: Path) -> str:
    """Return the page of a file of results. Raises UserError without one."""
    records = read_records(results)
    if not records:
        raise UserError(f"{results} has no record. Run `make compare` first.")
    costs = {key.partition("/")[2]: record for key, record in records.items() if record["kind"] == "cost"}
    lines = ["# Encoders compared", "", "Made by `make compare`.", ""]
    if costs:
        lines += ["## What a family costs", "", " ".join(_COSTS), ""]
        rows = [
            (
                name, f"{one['parameters'] / 1e6:.1f}", one["frames"], " x ".join(map(str, one["pixels"])),
                f"{one['flops'] / 1e9:.1f}", f"{one['prepare_ms']:.0f}", f"{one['encode_ms']:.0f}",
                f"{one['encode_cpu_ms']:.0f}", f"{one['memory'] / 2**20:.0f}",
            )
            for name, one in sorted(costs.items(), key=lambda item: item[1]["flops"])
        ]  # fmt: skip
        head = ("encoder", "million parameters", "frames", "pixels", "GFLOP", "ms to prepare a frame", "ms a touch")
        lines += [markdown_table((*head, "processor ms a touch", "MiB"), rows, "lrrlrrrrr"), ""]
        machines = {Machine(**one["machine"] | {"load": 0.0}) for one in costs.values()}
        loads = sorted(one["machine"]["load"] for one in costs.values())
        repeats = " or ".join(map(str, sorted({one["repeats"] for one in costs.values()})))
        names = ("processor", "cores", "GiB", "Python", "jax", "system")
        each = [(m.processor, m.cores, f"{m.memory_gib:.0f}", m.python, m.jax, m.system) for m in machines]
        lines += ["The machine:", "", markdown_table(names, sorted(each), "lrrlll")]
        lines += [
            "", f"Each was called {repeats} times. Other work ran on the machine, whose load was {loads[0]:.1f} to "
            f"{loads[-1]:.1f}. Times are the shortest of the calls, and processor times their median. Compare encoders "
            "by the processor time.", "",
        ]  # fmt: skip
    lines += ["## What an encoder knows", ""]
    scores = [record for record in records.values() if record["kind"] == "accuracy"]
    if not scores:
        lines += [
            "No weights of the families are in this repository. With your files you get the columns:", "",
            '    make compare ENCODERS="sparsh=FILE mine=runs/stage2" DATA=manifest.parquet LABEL=material', "",
        ]  # fmt: skip
        return "\n".join(lines)
    heads = sorted({head for record in scores for head in record["scores"]})
    columns = [(head, protocol) for protocol in ("honest", "published") for head in heads]
    rows = []
    for encoder, label in sorted({(record["encoder"], record["label"]) for record in scores}):
        own = {
            record["protocol"]: record["scores"]
            for record in scores
            if (record["encoder"], record["label"]) == (encoder, label)
        }
        cells = (own.get(protocol, {}).get(head) for head, protocol in columns)
        rows.append((encoder, label, *("" if cell is None else f"{100 * cell:.1f} %" for cell in cells)))
    titles = (f"{head}, {protocol}" for head, protocol in columns)
    lines += [markdown_table(("encoder", "label", *titles), rows, "ll" + "r" * len(columns)), ""]
    lines += ["The published protocol chooses the penalty on the test split. The honest one does not.", ""]
    return "\n".join(lines)
