"""The matrix of experiments: `make experiments [QUICK=1] [MINUTES=75]`, or `python -m experiments.tables.run`.

Runs what is not done yet, one line of `matrix.jsonl` a run, and renders `experiments/results/README.md` from all lines.
What is run stands in `plan.py`, what it costs in `budget.py`; `--plan` prints both. The same command again goes on,
and the same command in another terminal helps: what one works on the other leaves to it. `--jobs` does just that, each
process on its own share of the cores.
The results of a question are of one version of the simulator and of one size: those of another go to a new folder,
`--out`, or are moved away first.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import jax

from anytouch_jax.errors import UserError
from experiments.tables import budget, plan, report
from experiments.tables.execute import check_results, execute, is_done

ROOT = Path(__file__).resolve().parents[2]


def options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plan", action="store_true", help="print every run with its minutes and stop")
    parser.add_argument("--render", action="store_true", help="only render the tables from matrix.jsonl")
    parser.add_argument("--quick", action="store_true", help="toy sizes: does it work?")
    parser.add_argument("--minutes", type=float, help="stop before a run that would not fit")
    parser.add_argument("--chunk", help="i/n: only part i of n, of about equal cost")
    parser.add_argument("--jobs", type=int, default=min(2, len(cores())), help="processes (default: 2 on two cores)")
    parser.add_argument("--only", nargs="+", help="only these questions")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=N", help="sizes: steps1=400 own=600 seeds=0,1")
    parser.add_argument("--work", type=Path, help="folder of data and runs (default: runs/matrix)")
    about = "folder of README.md and matrix.jsonl (default: experiments/results; with --quick or --set beside the data)"
    parser.add_argument("--out", type=Path, help=about)
    parser.add_argument("--real", type=Path, help="manifest of real touch (default: ../shared/real_touch/manifest.csv)")
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
    words = sys.argv[1:] if argv is None else list(argv)
    asked = options(words)
    try:
        if asked.jobs < 1:
            raise UserError(f"--jobs {asked.jobs}: 1 or more")
        if asked.minutes is not None and not asked.minutes > 0:
            raise UserError(f"--minutes {asked.minutes:g}: above 0")
        chosen = choose(asked)
        if asked.plan:
            return _print(chosen)
        if asked.render:
            return _render(chosen)
        check_results(chosen.leaves, chosen.out / "matrix.jsonl")
        report.check_page(chosen.out)
        _check_objects(chosen)
        return _execute(chosen, asked.minutes) if asked.jobs == 1 else _side_by_side(words, asked.jobs)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; the same command goes on", file=sys.stderr)
        return 130


def cores() -> list[int]:
    """Those that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def _side_by_side(words: Sequence[str], jobs: int) -> int:
    """The same command in `jobs` processes, each on cores of its own: pools of threads that share cores wait.

    A SIGTERM is passed on: each saves and ends, and the same command goes on.
    """
    again = [sys.executable, "-m", "experiments.tables.run", *words, "--jobs", "1"]
    helpers: list[subprocess.Popen[bytes]] = []
    ended: list[int] = []

    def end(number: int, frame: Any) -> None:
        ended.append(number)
        for helper in helpers:
            helper.terminate()

    before = signal.signal(signal.SIGTERM, end)
    try:
        while len(helpers) < jobs and not ended:
            helpers.append(subprocess.Popen(again))
        for helper in helpers if ended else ():  # one was being started
            helper.terminate()
        if hasattr(os, "sched_setaffinity") and jobs <= len(cores()):
            for number, helper in enumerate(helpers):
                os.sched_setaffinity(helper.pid, cores()[number::jobs])
        return max((abs(helper.wait()) for helper in helpers), default=130)  # a signal's number is negative
    finally:
        signal.signal(signal.SIGTERM, before)


class Chosen(NamedTuple):
    """The runs asked for, the folders of data and of results, and the manifest of real touch (it need not exist)."""

    leaves: Sequence[plan.Leaf]
    folder: Path
    out: Path
    real: Path


def choose(asked: argparse.Namespace) -> Chosen:
    """What the command line asks for. Raises UserError for what is not there."""
    size = size_of(asked.quick, asked.set)
    folder = asked.work or ROOT / "runs" / ("matrix-quick" if asked.quick else "matrix")
    out = asked.out or (folder / "results" if asked.quick or asked.set else ROOT / "experiments" / "results")
    real = (asked.real or ROOT.parent / "shared" / "real_touch" / "manifest.csv").resolve()
    leaves = plan.leaves(size, real=real.exists())
    if asked.only:
        wrong = sorted(set(asked.only) - {leaf.question for leaf in leaves})
        if wrong[:1] == [plan.REAL]:
            raise UserError(f"the question real needs real touch, and there is no {real}; name its manifest, REAL=")
        if wrong:
            raise UserError(f"there is no question {wrong[0]!r}; choose among {', '.join(budget.SCORES)}")
        leaves = [leaf for leaf in leaves if leaf.question in asked.only]
    if asked.chunk:
        number, _, of = asked.chunk.partition("/")
        if not (number.isdigit() and of.isdigit() and 1 <= int(number) <= int(of)):
            raise UserError(f"--chunk {asked.chunk}: write it as 2/4")
        leaves = budget.chunk(leaves, int(number), int(of))
    return Chosen(leaves, folder, out, real)


def _print(chosen: Chosen) -> int:
    done = {one.key for one in chosen.leaves if is_done(one, chosen.out / "matrix.jsonl")}
    print("\n".join(budget.lines(chosen.leaves, done)))
    return 0


def _check_objects(chosen: Chosen) -> None:
    from experiments.tables.work import check_objects

    for leaf in chosen.leaves[:1]:  # all are of one size
        check_objects(leaf.size)


def _render(chosen: Chosen) -> int:
    print(report.write(chosen.out / "matrix.jsonl", chosen.out))
    return 0


def _execute(chosen: Chosen, minutes: float | None) -> int:
    from anytouch_jax.train.mesh import enable_compilation_cache
    from experiments.tables.work import Work

    enable_compilation_cache()
    there = chosen.real.exists()
    if not there:
        print(f"there is no {chosen.real}: the question `real` is not run")
    work = Work(chosen.folder, real=chosen.real if there else None)
    result = execute(chosen.leaves, work, chosen.out / "matrix.jsonl", minutes=minutes)
    made, found, left = (len(part) for part in result[:3])
    print(f"{made} runs made, {found} were there, {left} left, {len(result.failed)} failed")
    for name, error in result.failed.items():
        print(f"failed: {name}: {error}", file=sys.stderr)
    _render(chosen)
    return 1 if result.failed else 0


if __name__ == "__main__":
    if "--quick" in sys.argv:
        jax.config.update("jax_disable_most_optimizations", True)  # a toy compiles for longer than it runs
    sys.exit(main())
