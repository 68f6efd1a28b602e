"""Execution of the plan: runs that are missing are made, and each leaves a record.

Several processes may work in one folder. Each leaves to the others what they have claimed, and
waits only when there is nothing else to do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from anytouch_jax.errors import UserError
from experiments.records import differences, read_records, write_record
from experiments.tables import plan
from experiments.tables.plan import Leaf, Scenes, Training
from experiments.tables.results import compared, simulated

if TYPE_CHECKING:
    from experiments.tables.work import Work

PAUSE = 5.0  # s between two looks at what others work on


class Outcome(NamedTuple):
    """Keys of the runs made in this call and of those made before it, and {key: error} of those
    that failed.
    """

    made: list[str]
    kept: list[str]
    failed: dict[str, str]


def is_done(leaf: Leaf, out: Path) -> bool:
    """Return whether the file of results `out` has a record of this very run."""
    return bool(read_records(out).get(leaf.key, {}).get("identity") == leaf.identity)


def check_results(leaves: Sequence[Leaf], out: Path) -> None:
    """Raise UserError where `out` has results of these questions by another simulator or other
    settings.
    """
    if not leaves:
        return
    size = leaves[0].size
    questions = {leaf.question for leaf in leaves}
    ours = {"simulator": plan.simulator(), "settings": plan.settings(size)}
    for theirs in read_records(out).values():
        if theirs.get("question") not in questions:
            continue
        if simulated(theirs) != ours["simulator"]:
            what = (
                f"version {simulated(theirs)} of the simulator, and these runs are of version "
                f"{ours['simulator']}"
            )
        elif wrong := differences(
            compared([theirs, ours | {"scoring": plan.scoring(theirs["question"])}])
        ):
            what = f"other settings than these runs ({wrong})"
        else:
            continue
        raise UserError(
            f"{out} holds results of {theirs['question']} of {what}: give a new folder, for "
            f"example make experiments OUT=runs/study, or remove the lines of {theirs['question']} "
            "to run them again"
        )


def execute(
    leaves: Sequence[Leaf],
    work: Work,
    out: Path,
    *,
    log: Callable[[str], None] = print,
    pause: Callable[[float], None] = time.sleep,
) -> Outcome:
    """Make the missing runs in order, a record each.

    A run that fails is logged, and the others go on.
    """
    result = Outcome([], [], {})
    waiting = list(leaves)
    while waiting:
        # another process works on these, or on what they need
        later: list[Leaf] = []
        for leaf in waiting:
            if is_done(leaf, out):
                result.kept.append(leaf.key)
                continue
            with work.claim(leaf.key) as mine:
                try:
                    done = mine and (is_done(leaf, out) or _make(leaf, work, out, log))
                except (UserError, RuntimeError, MemoryError) as error:  # XLA's are RuntimeErrors
                    what = (
                        str(error)
                        if isinstance(error, UserError)
                        else f"{type(error).__name__}: {error}"
                    )
                    log(f"{leaf.key} failed: {what}")
                    result.failed[leaf.key] = what
                    continue
            if done:
                result.made.append(leaf.key)
            else:
                later.append(leaf)
        if len(later) == len(waiting):
            pause(PAUSE)
        waiting = later
    return result


def missing(leaf: Leaf, ready: set[str]) -> tuple[list[Scenes], list[Training]]:
    """Return the data sets and trainings that a run needs and that are not `ready`, in order."""
    sets = [one for one in plan.scenes(leaf.size) if one.name not in ready]
    return sets, [one for one in leaf.trainings if one.key not in ready]


def _make(leaf: Leaf, work: Work, out: Path, log: Callable[[str], None]) -> bool:
    """Make what a run needs, then the run; False where another process is about to make a part of
    it.
    """
    for one in missing(leaf, work.ready(leaf))[0]:
        with work.claim(one.name) as mine:
            if mine and one.name not in work.ready(leaf):
                work.make(one, leaf.size)
    sets, trainings = missing(leaf, work.ready(leaf))
    if sets:
        return False
    for training in trainings:
        with work.claim(training.key) as mine:
            if not mine:
                return False
            if training.key not in work.ready(leaf):
                work.train(training)
    log(leaf.key)
    about: dict[str, Any] = {"question": leaf.question, "name": leaf.name, "seed": leaf.seed}
    about |= {
        "identity": leaf.identity,
        "simulator": plan.simulator(),
        "scoring": plan.scoring(leaf.question),
    }
    write_record(out, leaf.key, about | work.score(leaf))
    return True
