"""Who is fitted on, who chooses, who is tested: whole groups on one side, dealt anew by every seed."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.choices import dealt
from anytouch_jax.evaluate.statistics import Protocol

Array = npt.NDArray[Any]


class Cut(NamedTuple):
    """Row numbers to fit on, to choose on (none: published), and to test on."""

    fit: Array
    val: Array
    test: Array


class Rows(NamedTuple):
    """What a deal needs of each row: `y`, `groups`; bool (n,): whether by the manifest's split it may teach (`pool`:
    train and val) or be tested (`test`), and by its sensor and unit likewise (`fits`, `tests`).

    `measured`: y is a number, not a class.
    """

    y: Array
    groups: Array
    pool: Array
    test: Array
    fits: Array
    tests: Array
    measured: bool = False


def scheme(rows: Rows) -> tuple[Literal["split", "folds"], Array, str]:
    """How honest tests are cut: by the manifest's split, or in folds over the returned rows bool (n,); and why.

    The split is kept where it parts the groups. Where classes of test are never learned (objects left out), the test
    rows alone are cut in folds; where groups are on both sides, all rows are.
    """
    learned, tested = rows.pool & rows.fits, rows.test & rows.tests
    if rows.measured and not learned.any():
        return (
            "folds",
            rows.test,
            "train has no row of what is fitted on: folds over the test rows, whole groups left out",
        )
    if not rows.measured and not np.isin(rows.y[tested], rows.y[learned]).any():
        return "folds", rows.test, "no class of test is in train: folds over the test rows, whole groups left out"
    shared = np.intersect1d(rows.groups[learned], rows.groups[tested])
    if len(shared):
        why = f"{len(shared)} groups are in train and test: folds over all rows instead, whole groups left out"
        return "folds", rows.pool | rows.test, why
    return "split", rows.pool | rows.test, ""


def cuts(rows: Rows, seed: int, protocol: Protocol) -> list[Cut]:
    """The cuts of one seed: one by the manifest's split, or FOLDS that test every row once.

    honest: a fifth of the groups that may teach chooses, the rest is fitted on. published: the manifest's own split,
    whatever it shares, and all that may teach is fitted on; where it shares no class, the folds, chosen on test.
    Raises UserError with too few groups.
    """
    if protocol not in ("honest", "published"):
        raise UserError(f"unknown protocol {protocol!r}; choose honest or published")
    rng = np.random.default_rng([11, seed])
    how, used, _ = scheme(rows)
    if how == "split" or (protocol == "published" and np.any(used & rows.pool)):
        learned, tested = np.flatnonzero(rows.pool & rows.fits), np.flatnonzero(rows.test & rows.tests)
        return [_parted(rows, learned, tested, rng, protocol)]
    numbers = np.flatnonzero(used & (rows.fits | rows.tests))
    fold, found = _dealt(rows, numbers, rng), []
    for one in range(int(fold.max()) + 1):
        learned, tested = numbers[(fold != one) & rows.fits[numbers]], numbers[(fold == one) & rows.tests[numbers]]
        if len(learned) and len(tested):
            found.append(_parted(rows, learned, tested, rng, protocol))
    return found


def _parted(rows: Rows, pool: Array, test: Array, rng: np.random.Generator, protocol: Protocol) -> Cut:
    if protocol == "published":
        return Cut(pool, pool[:0], test)
    fold = _dealt(rows, pool, rng)
    return Cut(pool[fold != 0], pool[fold == 0], test)


def _dealt(rows: Rows, numbers: Array, rng: np.random.Generator) -> Array:
    return dealt(rows.groups[numbers], None if rows.measured else rows.y[numbers], rng)
