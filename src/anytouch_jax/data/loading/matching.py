"""Triples for cross-sensor matching: which rows have a partner at the same place, and which are surely elsewhere."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_TABLE = 16  # cells of a table of flags that a row may take before pairs are sorted instead
_TRIES = 32  # uniform draws before the whole pool is searched


class MatchKeys(NamedTuple):
    """What tells touches apart, i64 codes (rows,), -1 for unknown: place, sensor, unit, object, data set."""

    touch: np.ndarray
    sensor: np.ndarray
    unit: np.ndarray
    object: np.ndarray
    dataset: np.ndarray


class Matches:
    """The pool of rows (ids i64) of matching: anchors with a partner, and the draws of partner and negative.

    `anchors` ids i64 into `pool`: rows whose touch was also felt by another sensor, or else by another unit, and
    that have a negative. `one_object`: all of the pool is one known object, so negatives are its other places.
    `same_sensor`: negatives are of the positive's sensor; a partner whose sensor felt no other known place is none.
    `other_object`: negatives are of another object where there is one (the release); else of "any other object or
    location" (Sec. 3.4).
    """

    def __init__(
        self, pool: np.ndarray, keys: MatchKeys, *, same_sensor: bool = False, other_object: bool = False
    ) -> None:
        self.pool, self.same_sensor, self.other_object, self._keys = pool, same_sensor, other_object, keys
        mine = MatchKeys(*(key[pool] for key in keys))  # not held: of millions of rows one copy is enough
        touch, thing = mine.touch, mine.object
        self._rows: dict[int, np.ndarray] = {}
        self._usable = _many_places(mine) if same_sensor else np.ones(len(pool), bool)
        self.one_object = len(thing) > 0 and bool((thing == thing[0]).all() and thing[0] >= 0)
        anchors = np.flatnonzero((touch >= 0) & _has_partner(mine, self._usable))
        del mine, thing
        order = np.argsort(touch, kind="stable")
        self._order = order.astype(np.int32) if len(order) < 1 << 31 else order
        self._sorted = touch[self._order]
        # With one place only, a row of an unknown place may be it; a usable partner's sensor felt another one.
        known = same_sensor or np.searchsorted(self._sorted, 0) < np.searchsorted(self._sorted, touch.max(initial=-1))
        self.anchors = anchors if known else anchors[self._with_negatives(anchors)]

    def _with_negatives(self, anchors: np.ndarray) -> np.ndarray:
        """Which of these anchors, all at one place, have a negative: looked up once for each object and data set."""
        rows = self.pool[anchors]
        things = np.stack([self._keys.object[rows], self._keys.dataset[rows]], 1)
        _, first, thing = np.unique(things, axis=0, return_index=True, return_inverse=True)
        return np.array([self._negatives(int(anchors[one])).size > 0 for one in first], bool)[thing.ravel()]

    def place(self, anchor: int) -> int:
        """The code of the place that `anchor` felt."""
        return int(self._keys.touch[self.pool[anchor]])

    def draw(self, anchor: int, rng: np.random.Generator, sensor: int | None = None) -> tuple[int, int]:
        """(positive, negative) for `anchor`, as ids into `pool`: partner of another sensor (of `sensor`, where that
        felt the place), or else another unit; and, uniformly, a row that is surely another place."""
        keys, row = self._keys, self.pool[anchor]
        low, high = np.searchsorted(self._sorted, keys.touch[row] + np.array([0, 1]))
        same = self._order[low:high]
        theirs = self.pool[same]
        others = same[(keys.sensor[theirs] != keys.sensor[row]) & self._usable[same]]
        if not others.size:
            others = same[(keys.unit[theirs] != keys.unit[row]) & (keys.unit[theirs] >= 0)]
        wanted = others[keys.sensor[self.pool[others]] == sensor]
        others = wanted if wanted.size else others
        positive = int(others[rng.integers(others.size)])
        theirs_alone = int(keys.sensor[self.pool[positive]]) if self.same_sensor else None
        if theirs_alone is None:
            tries = rng.integers(len(self.pool), size=_TRIES)
        else:
            tries = self._of_sensor(theirs_alone)
            tries = tries[rng.integers(len(tries), size=_TRIES)]
        fit = np.flatnonzero(self._elsewhere(anchor, tries))
        if fit.size:
            return positive, int(tries[fit[0]])
        negatives = self._negatives(anchor, theirs_alone)
        return positive, int(negatives[rng.integers(negatives.size)])

    def _negatives(self, anchor: int, sensor: int | None = None) -> np.ndarray:
        ids = np.arange(len(self.pool)) if sensor is None else self._of_sensor(sensor)
        found = ids[self._elsewhere(anchor, ids)]
        if not found.size and self.other_object:  # there is none: another known place of the same one
            touch = self._keys.touch[self.pool[ids]]
            found = ids[(touch >= 0) & (touch != self._keys.touch[self.pool[anchor]])]
        return found

    def _of_sensor(self, sensor: int) -> np.ndarray:
        """Ids i64 of the pool that a sensor felt."""
        if sensor not in self._rows:
            self._rows[sensor] = np.flatnonzero(self._keys.sensor[self.pool] == sensor)
        return self._rows[sensor]

    def _elsewhere(self, anchor: int, ids: np.ndarray) -> np.ndarray:
        """Which `ids` are surely another place, and, with `other_object`, not of the anchor's: bool of `ids`' shape."""
        keys, rows, row = self._keys, self.pool[ids], self.pool[anchor]

        def differs(key: np.ndarray) -> np.ndarray:
            return (key[rows] != key[row]) & (key[rows] >= 0) & (key[row] >= 0)

        unknown = keys.touch[rows] < 0
        place = differs(keys.touch) | (unknown & (differs(keys.object) | differs(keys.dataset)))
        if not self.other_object:
            return place
        return place & ~((keys.object[rows] == keys.object[row]) & (keys.object[row] >= 0))


def _has_partner(keys: MatchKeys, usable: np.ndarray) -> np.ndarray:
    """Which rows have a usable one of another sensor at their place, or else of another unit: bool (rows,)."""
    sensors, units = _distinct(keys.touch, keys.sensor), _distinct(keys.touch, keys.unit)
    others = _distinct(keys.touch, np.where(usable, keys.sensor, -1)) - usable
    return np.where(sensors > 1, others > 0, (units > 1) & (keys.unit >= 0) & usable)


def _many_places(keys: MatchKeys) -> np.ndarray:
    """Which rows are of a sensor that felt two known places or more: bool (rows,)."""
    return _distinct(keys.sensor, keys.touch) > 1


def is_shared_touch(touch: np.ndarray, sensor: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Rows whose touch, of codes i64 (rows,), was felt by two known sensors or units or more: bool (rows,)."""
    return (_distinct(touch, sensor) > 1) | (_distinct(touch, unit) > 1)


def _distinct(group: np.ndarray, value: np.ndarray) -> np.ndarray:
    """For every row, how many different known values (>= 0) its group has, 0 without a group (-1): i64 (rows,)."""
    known = (value >= 0) & (group >= 0)
    width, groups = int(value.max(initial=0)) + 1, int(group.max(initial=-1)) + 2  # the last group is that of -1: none
    pairs = group[known].astype(np.int64) * width + value[known]
    if width * groups <= _TABLE * len(group):  # a few values a group: no need to sort millions of pairs
        seen = np.zeros(width * groups, bool)
        seen[pairs] = True
        count = np.count_nonzero(seen.reshape(groups, width), axis=1)
    else:
        pairs.sort()
        count = np.bincount(pairs[np.diff(pairs, prepend=-1) > 0] // width, minlength=groups)
    return count[group]
