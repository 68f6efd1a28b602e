"""The matrix of experiments: `make experiments [QUICK=1]`, or `python -m experiments.tables.run`.

Makes the missing runs, one line of `matrix.jsonl` each, and then the pages of results. `plan.py`
lists the runs, and `--plan` prints them. Stop it at any time: the same command continues. The same
command in a second terminal shares the work. The results of a question are of one version of the
simulator and of one size. Give those of another a new folder with `--out`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import jax

from anytouch_jax.config.parsing import check, read_value
from anytouch_jax.errors import UserError
from experiments.command import with_status
from experiments.pages import __main__ as pages
from experiments.tables import plan
from experiments.tables.execute import check_results, execute, is_done

ROOT = Path(__file__).resolve().parents[2]


def options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plan", action="store_true", help="print every run and stop")
    parser.add_argument(
        "--render", action="store_true", help="only make the pages from matrix.jsonl"
    )
    parser.add_argument("--quick", action="store_true", help="toy sizes: does it work?")
    parser.add_argument("--only", nargs="+", help="only these questions")
    parser.add_argument(
        "--set",
        nargs="+",
        default=[],
        metavar="NAME=N",
        help="sizes: steps1=400 own=600 seeds=[0,1]",
    )
    parser.add_argument("--work", type=Path, help="folder of data and runs (default: runs/matrix)")
    about = (
        "folder of the pages and of matrix.jsonl (default: experiments/results; with --quick or "
        "--set in --work)"
    )
    parser.add_argument("--out", type=Path, help=about)
    return parser.parse_args(argv)


def size_of(quick: bool, changes: Sequence[str]) -> plan.Size:
    """The sizes asked for. Raises UserError for a name or a number that is none."""
    size = plan.QUICK if quick else plan.FULL
    values = dataclasses.asdict(size)
    for change in changes:
        name, _, text = change.partition("=")
        try:
            values[name] = json.loads(text)
        except ValueError:
            values[name] = text
    size = read_value(plan.Size, values, "--set")
    check(size, "--set ")
    same = quick or plan.settings(size) == plan.settings(plan.FULL)
    if same:
        return size
    return dataclasses.replace(size, name="changed")


def main(argv: Sequence[str] | None = None) -> int:
    asked = options(argv)
    return with_status(lambda: run(asked))


def run(asked: argparse.Namespace) -> int:
    """Do what the command line asks for. Raises UserError for what is not there."""
    leaves = plan.leaves(size_of(asked.quick, asked.set))
    folder = asked.work or ROOT / "runs" / ("matrix-quick" if asked.quick else "matrix")
    out = asked.out or (
        folder / "results" if asked.quick or asked.set else ROOT / "experiments" / "results"
    )
    known = list(dict.fromkeys(leaf.question for leaf in leaves))
    if wrong := sorted(set(asked.only or ()) - set(known)):
        raise UserError(f"there is no question {wrong[0]!r}; choose among {', '.join(known)}")
    leaves = [leaf for leaf in leaves if leaf.question in (asked.only or known)]
    failed: dict[str, str] = {}
    if asked.plan:
        for leaf in leaves:
            state = "done" if is_done(leaf, out / "matrix.jsonl") else "missing"
            print(f"{leaf.question:11} {leaf.name:32} seed {leaf.seed}  {state}")
        return 0
    if not asked.render:
        from anytouch_jax.train.mesh import enable_compilation_cache
        from experiments.tables.work import Work, check_objects

        check_results(leaves, out / "matrix.jsonl")
        check_objects(leaves[0].size)  # all are of one size
        enable_compilation_cache()
        result = execute(leaves, Work(folder), out / "matrix.jsonl")
        failed = result.failed
        print(f"{len(result.made)} runs made, {len(result.kept)} were there, {len(failed)} failed")
        for name, error in failed.items():
            print(f"failed: {name}: {error}", file=sys.stderr)
    print(*pages.write(out), sep="\n")
    if failed:
        return 1
    return 0


if __name__ == "__main__":
    if "--quick" in sys.argv:
        # a toy compiles for longer than it runs
        jax.config.update("jax_disable_most_optimizations", True)
    sys.exit(main())
