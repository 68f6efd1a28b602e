"""Running the plan: what is finished is not done again, what does not fit in the time is left for the next call."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from anytouch_jax.config import UserError
from anytouch_jax.train.record import write_atomic

from . import budget
from .plan import Leaf, Scenes, Size, Training

Say = Callable[[str], None]


class Work(Protocol):
    """What a run is made of (`work.Work`; tests give another). Each of the first two leaves its result on disk."""

    def ready(self, leaf: Leaf) -> set[str]:
        """Names of the data sets and keys of the trainings that are finished."""

    def make(self, one: Scenes, size: Size) -> None:
        """Make a data set, or finish it."""

    def train(self, one: Training) -> None:
        """Train a stage, or finish it."""

    def score(self, leaf: Leaf) -> dict[str, Any]:
        """The record of a run whose model is there."""


class Outcome(NamedTuple):
    """Files of the runs: finished in this call, found finished, left for want of time, and {file: what went wrong}."""

    made: list[str]
    found: list[str]
    left: list[str]
    failed: dict[str, str]


def is_done(leaf: Leaf, out: Path) -> bool:
    """Whether `out` has the JSON of just this run."""
    try:
        return bool(json.loads((out / leaf.file).read_text(encoding="utf-8")).get("identity") == leaf.identity)
    except (OSError, ValueError):
        return False


def execute(
    leaves: Sequence[Leaf],
    work: Work,
    out: Path,
    *,
    minutes: float | None = None,
    say: Say = print,
    clock: Callable[[], float] = time.monotonic,
) -> Outcome:
    """Do the runs in order, a JSON each; stop before one that would not fit in `minutes`.

    How long things take is estimated by `budget`, corrected by what they took in this call. A run that fails is told
    and left out; the others go on. Raises UserError when not even the first run fits.
    """
    start = clock()
    planned = 0.0
    result = Outcome([], [], [], {})
    for number, leaf in enumerate(leaves):
        if is_done(leaf, out):
            result.found.append(leaf.file)
            continue
        expected = budget.cost(leaf, work.ready(leaf))
        spent = clock() - start
        pace = max(1.0, spent / planned) if planned else 1.0
        if minutes is not None and spent + pace * expected > 60 * minutes:
            rest = [one.file for one in leaves[number:] if not is_done(one, out)]
            if not result.made and not result.failed:
                raise UserError(
                    f"{leaf.file} takes about {expected / 60:.0f} minutes with what it needs, and MINUTES is "
                    f"{minutes:g}; give more"
                )
            say(f"{spent / 60:.0f} of {minutes:g} minutes are spent: {len(rest)} runs are left for the next call")
            return result._replace(left=rest)
        say(f"{leaf.file}: about {pace * expected / 60:.1f} min")
        try:
            _one(leaf, work, out)
            result.made.append(leaf.file)
        except UserError as error:
            say(f"{leaf.file} failed: {error}")
            result.failed[leaf.file] = str(error)
        planned += expected
    return result


def _one(leaf: Leaf, work: Work, out: Path) -> None:
    sets, trainings = budget.missing(leaf, work.ready(leaf))
    for one in sets:
        work.make(one, leaf.size)
    for training in trainings:
        work.train(training)
    about = {"question": leaf.question, "name": leaf.name, "seed": leaf.seed, "identity": leaf.identity}
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(out / leaf.file, json.dumps(about | work.score(leaf), indent=1, allow_nan=False) + "\n")
