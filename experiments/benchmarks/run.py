"""Benchmarks of steps and embeddings: a line of JSON, and a table.

    python -m experiments.benchmarks.run stage1 embed --preset small

The variants take turns in one process. Quiet the machine first. Only jax, flax, optax and numpy are
needed. What is done is stored at once. With `--out experiments/results/variants.jsonl` the page of
speed has the times.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "src"))

import jax

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.tables import markdown_table, plain
from anytouch_jax.train.progress import to_stderr as log
from experiments.benchmarks import machine, speed
from experiments.benchmarks.variants import variants_of
from experiments.benchmarks.workloads import workloads
from experiments.command import with_status
from experiments.records import read_records, write_record

WHAT = ("stage1", "stage2", "embed")
QUICK = {"rounds": 2, "batch": 2, "peak_size": 512}
SHOWN = (
    "variant",
    "name",
    "samples",
    "ratio",
    "seconds",
    "peak_fraction",
    "error_gradient",
    "error_output",
    "gradient",
    "output",
    "peak_bytes",
    "note",
)
Rows = Sequence[Any]


def parse(args: Sequence[str] | None) -> argparse.Namespace:
    """Return the options. Raises UserError for numbers below 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "what", nargs="*", help=f"what to measure: {', '.join(WHAT)} (default: all)"
    )
    parser.add_argument("--preset", default="tiny", choices=("tiny", "small", "base", "large"))
    parser.add_argument(
        "--batch", type=int, help="samples a step (default: 16, 16, 8, 4 by preset)"
    )
    parser.add_argument(
        "--rounds", type=int, default=9, help="rounds in which all variants take turns"
    )
    parser.add_argument(
        "--variants", nargs="*", default=[], help="names of variants (default: all)"
    )
    parser.add_argument(
        "--no-errors",
        action="store_true",
        help="leave out the float64 reference, which compiles long",
    )
    parser.add_argument("--peak-size", type=int, help="side of the matrices of the peak")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/bench/bench.jsonl"), help="file of results"
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="two rounds of tiny batches, to see that everything works",
    )
    options = parser.parse_args(args)
    if unknown := set(options.what) - {*WHAT}:
        raise UserError(
            f"There is nothing to measure as {min(unknown)}. Choose among {', '.join(WHAT)}."
        )
    for name, value in (QUICK if options.quick else {}).items():
        setattr(options, name, value if name == "rounds" else getattr(options, name) or value)
    for name, value in (("rounds", options.rounds), ("batch", options.batch)):
        if value is not None and value < 1:
            raise UserError(f"--{name} must be 1 or more, not {value}.")
    return options


def network(options: argparse.Namespace, what: str) -> Iterator[tuple[str, Rows]]:
    """Measure the workloads of a part, each variant against float64."""
    for work in workloads(what, options.preset, options.batch):
        known = variants_of(work, jax.default_backend())
        chosen = [one for one in known if not options.variants or one.name in options.variants]
        if not chosen:
            raise UserError(
                f"{work.name} has no such variant. Choose among "
                f"{'; '.join(one.name for one in known)}."
            )
        try:
            rows = speed.measure(
                work,
                chosen,
                rounds=options.rounds,
                with_errors=not options.no_errors,
                peak_size=options.peak_size,
                log=log,
            )
        except (UserError, RuntimeError) as error:  # the other workloads are still worth their time
            yield (
                work.name,
                [speed.SpeedRow(work.name, "none", work.samples, note=str(error).splitlines()[0])],
            )
            continue
        yield f"{work.name}, preset {options.preset}", rows


def run(options: argparse.Namespace) -> int:
    """Measure, store each section at once and print its table."""
    parts = chain(*(network(options, what) for what in dict.fromkeys(options.what) or WHAT))
    store(
        ((options.preset, title, [speed.record_of(row) for row in rows]) for title, rows in parts),
        options,
        rounds=options.rounds,
    )
    return 0


def store(
    sections: Iterable[tuple[str, str, list[Any]]], options: argparse.Namespace, **about: Any
) -> None:
    """Store each section (preset, title, records) as it comes, and print its table."""
    here = machine.describe()
    log(here.sentence())
    about |= {"machine": plain(here), "quick": options.quick}
    for preset, title, records in sections:
        key = (
            f"{preset}, "
            f"{here.vectors if here.device == 'cpu' else here.device}{', quick' * options.quick}"
        )
        before = read_records(options.out).get(key, {}).get("results", {})
        write_record(
            options.out, key, about | {"preset": preset, "results": before | {title: records}}
        )
        print(f"### {title}\n\n{table_of(records)}\n", flush=True)
        log(f"{options.out}, {key}")


def table_of(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of records: the columns of steps, or all that are words and numbers."""
    known = {
        name: type(value) for one in records for name, value in one.items() if value is not None
    }
    names = (
        [name for name in SHOWN if name in known]
        if "ratio" in known
        else [name for name, kind in known.items() if kind in (str, int, float)]
    )
    rows = [
        [
            f"{value:.3g}" if isinstance(value := one.get(name), float) else value or ""
            for name in names
        ]
        for one in records
    ]
    return markdown_table(names, rows)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line `args` and return the exit status."""
    return with_status(lambda: run(parse(args)))


if __name__ == "__main__":
    sys.exit(main())
