"""Triples for cross-sensor matching: which rows have a partner at the same place, and which are surely elsewhere."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_TABLE = 16  # cells of a table of flags that a row may take before pairs are sorted instead
_TRIES = 32  # uniform draws before the whole pool is searched


class Keys(NamedTuple):
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
    """

    def __init__(self, pool: np.ndarray, keys: Keys, *, same_sensor: bool = False) -> None:
        self.pool, self.same_sensor = pool, same_sensor
        self._keys = Keys(*(key[pool] for key in keys))
        touch = self._keys.touch
        order = np.argsort(touch, kind="stable")
        self._order = order.astype(np.int32) if len(order) < 1 << 31 else order  # millions of them are held
        self._sorted = touch[self._order]
        self._rows: dict[int | None, np.ndarray] = {}
        self._usable = self._many_places() if same_sensor else np.ones(len(pool), bool)
        thing = self._keys.object
        self.one_object = len(thing) > 0 and bool((thing == thing[0]).all() and thing[0] >= 0)
        anchors = np.flatnonzero((touch >= 0) & self._has_partner())
        felt = touch[touch >= 0]
        many = felt.size > 0 and bool(
            (felt != felt[0]).any()
        )  # with one place only, a row of an unknown place may be it
        known = many or same_sensor  # a usable partner's sensor felt another place
        self.anchors = anchors if known else anchors[[self._negatives(int(a)).size > 0 for a in anchors]]

    def _has_partner(self) -> np.ndarray:
        touch, sensor, unit = self._keys.touch, self._keys.sensor, self._keys.unit
        sensors, units = _distinct(touch, sensor), _distinct(touch, unit)
        usable = _distinct(touch, np.where(self._usable, sensor, -1)) - self._usable
        return np.where(sensors > 1, usable > 0, (units > 1) & (unit >= 0) & self._usable)

    def _many_places(self) -> np.ndarray:
        """Which rows are of a sensor that felt two known places or more: bool (rows,)."""
        return _distinct(self._keys.sensor, self._keys.touch) > 1

    def draw(self, anchor: int, rng: np.random.Generator) -> tuple[int, int]:
        """(positive, negative) for `anchor`, as ids into `pool`: partner of another sensor, or else another unit;
        and, uniformly, a row that is surely another place, of another object where objects are known."""
        keys = self._keys
        low, high = np.searchsorted(self._sorted, keys.touch[anchor] + np.array([0, 1]))
        same = self._order[low:high]
        others = same[(keys.sensor[same] != keys.sensor[anchor]) & self._usable[same]]
        if not others.size:
            others = same[(keys.unit[same] != keys.unit[anchor]) & (keys.unit[same] >= 0)]
        positive = int(others[rng.integers(others.size)])
        sensor = int(keys.sensor[positive]) if self.same_sensor else None
        rows = self._of_sensor(sensor)
        tries = rows[rng.integers(len(rows), size=_TRIES)]
        fit = np.flatnonzero(self._elsewhere(anchor, tries))
        if fit.size:
            return positive, int(tries[fit[0]])
        negatives = self._negatives(anchor, sensor)
        return positive, int(negatives[rng.integers(negatives.size)])

    def _negatives(self, anchor: int, sensor: int | None = None) -> np.ndarray:
        rows = self._of_sensor(sensor)
        found = rows[self._elsewhere(anchor, rows)]
        if not found.size:  # no other object: another known place of the same one
            touch = self._keys.touch[rows]
            found = rows[(touch >= 0) & (touch != self._keys.touch[anchor])]
        return found

    def _of_sensor(self, sensor: int | None) -> np.ndarray:
        """Ids i64 of the pool that a sensor felt (None: all of them)."""
        if sensor not in self._rows:
            every = np.arange(len(self.pool))
            self._rows[sensor] = every if sensor is None else np.flatnonzero(self._keys.sensor == sensor)
        return self._rows[sensor]

    def _elsewhere(self, anchor: int, rows: np.ndarray) -> np.ndarray:
        """Which rows are surely another place, and not of the anchor's object: bool of the shape of `rows`."""
        keys = self._keys

        def differs(key: np.ndarray) -> np.ndarray:
            return (key[rows] != key[anchor]) & (key[rows] >= 0) & (key[anchor] >= 0)

        same_object = (keys.object[rows] == keys.object[anchor]) & (keys.object[anchor] >= 0)
        unknown = keys.touch[rows] < 0
        place = differs(keys.touch) | (unknown & (differs(keys.object) | differs(keys.dataset)))
        return place & ~same_object


def felt_twice(touch: np.ndarray, sensor: np.ndarray, unit: np.ndarray) -> np.ndarray:
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
