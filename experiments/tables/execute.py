"""Running the plan: what is finished is not done again, what does not fit in the time is left for the next call.

Several processes may run it in one folder at once: what one has claimed the others leave to it, and they wait only when
there is nothing else to do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from anytouch_jax.errors import UserError
from experiments.records import read_records, write_record
from experiments.tables import budget, plan
from experiments.tables.plan import Leaf, Scenes, Size, Training
from experiments.tables.results import differences, simulated

Log = Callable[[str], None]
PAUSE = 5.0  # s until what others work on is looked at again


class Work(Protocol):
    """What a run is made of (`work.Work`; tests give another). Each of the first two leaves its result on disk."""

    def ready(self, leaf: Leaf) -> set[str]:
        """Names of the data sets and keys of the trainings that are finished."""

    def claim(self, name: str) -> AbstractContextManager[bool]:
        """Keep other processes from `name` meanwhile; False where one of them works on it."""

    def make(self, one: Scenes, size: Size) -> None:
        """Make a data set, or finish it."""

    def train(self, one: Training) -> None:
        """Train a stage, or finish it."""

    def score(self, leaf: Leaf) -> dict[str, Any]:
        """The record of a run whose model is there."""


class Outcome(NamedTuple):
    """Keys of the runs: finished in this call, found finished, left for want of time, and {key: what went wrong}."""

    made: list[str]
    found: list[str]
    left: list[str]
    failed: dict[str, str]


def is_done(leaf: Leaf, out: Path) -> bool:
    """Return whether the file of results `out` has a record of this very run."""
    return bool(read_records(out).get(leaf.key, {}).get("identity") == leaf.identity)


def check_results(leaves: Sequence[Leaf], out: Path) -> None:
    """Raise UserError where `out` holds results of one of these questions of another simulator or of other settings.

    They would stand in one table, and a part of what is there would be written over.
    """
    if not leaves:
        return
    size, questions = leaves[0].size, {leaf.question for leaf in leaves}
    ours = {"simulator": plan.simulator(), "settings": plan.settings(size), "size": size.name}
    for theirs in read_records(out).values():
        if theirs.get("question") not in questions:
            continue
        if simulated(theirs) != ours["simulator"]:
            what = f"version {simulated(theirs)} of the simulator, and these runs are of version {ours['simulator']}"
        elif wrong := differences([theirs, ours | {"scoring": plan.scoring(theirs["question"])}]):
            what = f"other settings than these runs ({wrong})"
        else:
            continue
        raise UserError(
            f"{out} holds results of {theirs['question']} of {what}: give a new folder, for example "
            f"make experiments OUT=runs/study, or remove the lines of {theirs['question']} to run them again"
        )


def execute(
    leaves: Sequence[Leaf],
    work: Work,
    out: Path,
    *,
    minutes: float | None = None,
    log: Log = print,
    clock: Callable[[], float] = time.monotonic,
    pause: Callable[[float], None] = time.sleep,
) -> Outcome:
    """Do the runs in order, a record each; stop before one that would not fit in `minutes`.

    How long things take is estimated by `budget`, corrected by what they took in this call. A run that fails is logged
    and left out; the others go on. Raises UserError when not even the first run fits.
    """
    start, planned, waited = clock(), 0.0, 0.0
    result = Outcome([], [], [], {})
    waiting, announced = list(leaves), set[str]()
    while waiting:
        later: list[Leaf] = []  # another process works on these, or on what they need
        for leaf in waiting:
            if is_done(leaf, out):
                result.found.append(leaf.key)
                continue
            expected, spent = budget.cost(leaf, work.ready(leaf)), clock() - start
            seconds = expected * (max(1.0, (spent - waited) / planned) if planned else 1.0)
            if minutes is not None and spent + seconds > 60 * minutes:
                if not (result.made or result.failed or announced):
                    raise UserError(
                        f"{leaf.key} takes about {expected / 60:.0f} minutes with what it needs, and MINUTES is "
                        f"{minutes:g}; give more"
                    )
                rest = [one.key for one in leaves if one.key not in result.failed and not is_done(one, out)]
                log(f"{spent / 60:.0f} of {minutes:g} minutes are spent: {len(rest)} runs are left for the next call")
                return result._replace(left=rest)

            def begin(leaf: Leaf = leaf, seconds: float = seconds) -> None:
                if leaf.key not in announced:
                    log(f"{leaf.key}: about {seconds / 60:.1f} min")
                    announced.add(leaf.key)

            with work.claim(leaf.key) as mine:
                try:
                    done = mine and (is_done(leaf, out) or _one(leaf, work, out, begin))
                except (UserError, RuntimeError, MemoryError) as error:  # XLA's are RuntimeErrors
                    what = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
                    log(f"{leaf.key} failed: {what}")
                    result.failed[leaf.key] = what
                    done = None
            planned += expected - (0.0 if done else budget.cost(leaf, work.ready(leaf)))
            if done:
                result.made.append(leaf.key)
            elif done is not None:
                later.append(leaf)
        if len(later) == len(waiting):
            since = clock()
            pause(PAUSE)
            waited += clock() - since
        waiting = later
    return result


def _one(leaf: Leaf, work: Work, out: Path, begin: Callable[[], None]) -> bool:
    """Make what a run still needs, then the run; False where another process is about to make a part of it.

    `begin` is called before there is something to do.
    """
    for one in budget.missing(leaf, work.ready(leaf))[0]:
        with work.claim(one.name) as mine:
            if mine and one.name not in work.ready(leaf):
                begin()
                work.make(one, leaf.size)
    sets, trainings = budget.missing(leaf, work.ready(leaf))
    if sets:
        return False
    for training in trainings:
        with work.claim(training.key) as mine:
            if not mine:
                return False
            if training.key not in work.ready(leaf):
                begin()
                work.train(training)
    begin()
    about: dict[str, Any] = {"question": leaf.question, "name": leaf.name, "seed": leaf.seed}
    about |= {"identity": leaf.identity, "simulator": plan.simulator(), "scoring": plan.scoring(leaf.question)}
    write_record(out, leaf.key, about | work.score(leaf))
    return True
