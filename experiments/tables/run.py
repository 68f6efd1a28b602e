"""The matrix of experiments: `make experiments [QUICK=1]`, or `python -m experiments.tables.run`.

Makes the missing runs, one line of `matrix.jsonl` each, and then the pages of results.
`plan.py` lists the runs, and `--plan` prints them. Stop it at any time: the same command continues. The same command in
a second terminal shares the work.
The results of a question are of one version of the simulator and of one size. Give those of another a new folder with
`--out`.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import jax

from anytouch_jax.errors import UserError
from experiments.command import with_status
from experiments.pages import __main__ as pages
from experiments.tables import plan
from experiments.tables.execute import check_results, execute, is_done

ROOT = Path(__file__).resolve().parents[2]


def options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plan", action="store_true", help="print every run and stop")
    parser.add_argument("--render", action="store_true", help="only make the pages from matrix.jsonl")
    parser.add_argument("--quick", action="store_true", help="toy sizes: does it work?")
    parser.add_argument("--only", nargs="+", help="only these questions")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=N", help="sizes: steps1=400 own=600 seeds=0,1")
    parser.add_argument("--work", type=Path, help="folder of data and runs (default: runs/matrix)")
    about = "folder of the pages and of matrix.jsonl (default: experiments/results; with --quick or --set in --work)"
    parser.add_argument("--out", type=Path, help=about)
    return parser.parse_args(argv)


def size_of(quick: bool, changes: Sequence[str]) -> plan.Size:
    """The sizes asked for. Raises UserError for a name or a number that is none."""
    size: Any = plan.QUICK if quick else plan.FULL
    fields = {field.name: getattr(size, field.name) for field in dataclasses.fields(size)}
    kinds = get_type_hints(plan.Size)
    settable = [name for name in fields if name not in ("name", "stack", "decoder")]
    for change in changes:
        name, _, text = change.partition("=")
        if name not in settable:
            raise UserError(f"--set {change}: choose among {', '.join(settable)}")
        try:
            value = tuple(map(int, text.split(","))) if name == "seeds" else type(fields[name])(text)
        except ValueError:
            raise UserError(f"--set {change}: {text!r} is no number") from None
        choices = get_args(kinds[name])
        if isinstance(value, str) and value not in choices:
            raise UserError(f"--set {change}: choose among {', '.join(choices)}")
        if isinstance(value, int) and value < 1:
            raise UserError(f"--set {change}: 1 or more")
        if isinstance(value, tuple) and len(set(value)) < len(value):
            raise UserError(f"--set {change}: each seed once")
        size = dataclasses.replace(size, **{name: value})
    same = quick or plan.settings(size) == plan.settings(plan.FULL)
    return size if same else dataclasses.replace(size, name="changed")


def main(argv: Sequence[str] | None = None) -> int:
    asked = options(argv)

    def run() -> int:
        chosen = choose(asked)
        if asked.plan:
            return _print(chosen)
        if asked.render:
            return _render(chosen)
        check_results(chosen.leaves, chosen.out / "matrix.jsonl")
        return _execute(chosen)

    return with_status(run)


class Chosen(NamedTuple):
    """The runs asked for, and the folders of data and of results."""

    leaves: Sequence[plan.Leaf]
    folder: Path
    out: Path


def choose(asked: argparse.Namespace) -> Chosen:
    """What the command line asks for. Raises UserError for what is not there."""
    size = size_of(asked.quick, asked.set)
    folder = asked.work or ROOT / "runs" / ("matrix-quick" if asked.quick else "matrix")
    out = asked.out or (folder / "results" if asked.quick or asked.set else ROOT / "experiments" / "results")
    leaves = plan.leaves(size)
    if asked.only:
        known = list(dict.fromkeys(leaf.question for leaf in leaves))
        if wrong := sorted(set(asked.only) - set(known)):
            raise UserError(f"there is no question {wrong[0]!r}; choose among {', '.join(known)}")
        leaves = [leaf for leaf in leaves if leaf.question in asked.only]
    return Chosen(leaves, folder, out)


def _print(chosen: Chosen) -> int:
    for leaf in chosen.leaves:
        done = is_done(leaf, chosen.out / "matrix.jsonl")
        print(f"{leaf.question:11} {leaf.name:32} seed {leaf.seed}  {'done' if done else 'missing'}")
    return 0


def _render(chosen: Chosen) -> int:
    for path in pages.write(chosen.out):
        print(path)
    return 0


def _execute(chosen: Chosen) -> int:
    from anytouch_jax.train.mesh import enable_compilation_cache
    from experiments.tables.work import Work, check_objects

    for leaf in chosen.leaves[:1]:  # all are of one size
        check_objects(leaf.size)
    enable_compilation_cache()
    result = execute(chosen.leaves, Work(chosen.folder), chosen.out / "matrix.jsonl")
    print(f"{len(result.made)} runs made, {len(result.kept)} were there, {len(result.failed)} failed")
    for name, error in result.failed.items():
        print(f"failed: {name}: {error}", file=sys.stderr)
    _render(chosen)
    return 1 if result.failed else 0


if __name__ == "__main__":
    if "--quick" in sys.argv:
        jax.config.update("jax_disable_most_optimizations", True)  # a toy compiles for longer than it runs
    sys.exit(main())
