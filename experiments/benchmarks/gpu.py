"""ViT-L/14 on an accelerator: steps of both stages, speed against error, memory against batch size.

    make bench-gpu PYTHON=python3

Needs jax, flax, optax and numpy, nothing else; the package is read from src, not installed.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "src"))

import jax

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import statistics
from experiments.benchmarks import machine, speed
from experiments.benchmarks.variants import variants_of
from experiments.benchmarks.workloads import Workload, workloads

BATCHES = (8, 16, 32, 64, 128, 256, 512)


def fastest(rows: list[speed.SpeedRow]) -> str:
    """The variant that a user of an accelerator wants, among those that ran."""
    return min((row for row in rows if not row.note), key=lambda row: row.seconds).variant


def sweep(work: Workload, rows: list[speed.SpeedRow], batches: tuple[int, ...], rounds: int) -> list[list[str]]:
    """Speed and memory of the fastest variant, and of the one with remat, for every batch that fits."""
    names = dict.fromkeys([fastest(rows), *(row.variant for row in rows if "remat" in row.variant and not row.note)])
    lines = []
    for variant in variants_of(work, jax.default_backend()):
        if variant.name not in names:
            continue
        for row in speed.batch_sweep(variant, work, batches, rounds):
            gib = f"{row.peak_bytes / 2**30:.2f}"
            figures = [f"{row.samples_per_second:.4g}", f"{100 * row.peak_share:.0f} %", gib] if not row.note else []
            lines.append([row.workload, variant.name, str(row.samples), *(figures or [row.note[:80], "", ""])])
            print("  ".join(lines[-1]), file=sys.stderr, flush=True)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["stage1", "stage2", "embed"])
    parser.add_argument("--preset", default="large", choices=("tiny", "small", "base", "large"))
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--batches", type=int, nargs="*", default=list(BATCHES), help="of the memory sweep")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--variants", nargs="*", default=[], help="names of rows to measure; all if none is named")
    parser.add_argument("--no-errors", action="store_true", help="leave out the float64 reference, which compiles long")
    parser.add_argument("--peak-size", type=int, help="side of the matrices of the peak")
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    options = parser.parse_args()
    if unknown := set(options.what) - {"stage1", "stage2", "embed"}:
        parser.error(f"{', '.join(sorted(unknown))}: choose among stage1, stage2, embed")
    here = machine.describe()
    print(here.sentence(), file=sys.stderr)
    rows: list[speed.SpeedRow] = []
    swept: list[list[str]] = []

    def save() -> Path:
        """After every workload: a machine that is only lent may go away."""
        heads = ("workload", "variant", "batch", "samples/s", "of its peak", "GiB")
        text = f"# Speed against error, preset {options.preset}\n\n{here.sentence()}\n\n{speed.NOTES}\n\n"
        text += speed.speed_table(rows)
        text += f"\n## Memory against batch size\n\n{statistics.markdown_table(heads, swept)}\n" if swept else ""
        numbers = {"machine": dataclasses.asdict(here), "preset": options.preset, "sweep": swept}
        return speed.write_page(options.out, "gpu", text, numbers | {"rows": [speed.record_of(row) for row in rows]})

    def log(sentence: str) -> None:
        print(sentence, file=sys.stderr, flush=True)

    works = [work for what in options.what for work in workloads(what, options.preset, options.batch)]
    rows_of = {work.name: variants_of(work, jax.default_backend()) for work in works}
    names = {one.name for several in rows_of.values() for one in several}
    if unknown := set(options.variants) - names:
        parser.error(f"{', '.join(sorted(unknown))}: choose among {'; '.join(sorted(names))}")
    for work in works:
        try:
            chosen = [one for one in rows_of[work.name] if one.name in (options.variants or names)]
            if not chosen:
                continue
            result = speed.measure(
                work, chosen, rounds=options.rounds, with_errors=not options.no_errors, peak_size=options.peak_size,
                log=log,
            )  # fmt: skip
        except (UserError, RuntimeError) as error:  # the other workloads are still worth their time
            result = [speed.SpeedRow(work.name, "none", work.samples, note=str(error).splitlines()[0])]
        rows += result
        print(speed.speed_table(result), flush=True)
        save()
    for work in works:
        if work.trains and options.batches:
            mine = [row for row in rows if row.workload == work.name]
            if all(row.note for row in mine):
                continue
            swept += sweep(work, mine, tuple(options.batches), max(2, options.rounds // 3))
            save()
    print(save())


if __name__ == "__main__":
    main()
