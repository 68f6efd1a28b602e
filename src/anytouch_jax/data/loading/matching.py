"""Cross-sensor matching: the anchors of a pool of rows, and draws of their positives and negatives (Sec. 3.4)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_TABLE = 16  # cells per row up to which a table of flags is used instead of a sort
_TRIES = 32  # uniform draws before the whole pool is searched


class MatchKeys(NamedTuple):
    """What distinguishes touches, codes (rows,), -1 for unknown: place, sensor, unit, object, data set."""

    touch: np.ndarray
    sensor: np.ndarray
    unit: np.ndarray
    object: np.ndarray
    dataset: np.ndarray


class Matches:
    """The matches in a pool of rows (ids i64).

    `anchors` are ids i64 into `pool`: rows whose place another sensor, or else another unit, has touched too, and that
    have a negative. `one_object` is True if all of the pool is one known object, so that negatives are other places on
    it. With `same_sensor` negatives are of the positive's sensor, and a partner needs a sensor with another known
    place. With `other_object` negatives are of another object if there is one (the release), else of "any other object
    or location".
    """

    def __init__(
        self, pool: np.ndarray, keys: MatchKeys, *, same_sensor: bool = False, other_object: bool = False
    ) -> None:
        self.pool, self.same_sensor, self.other_object, self._keys = pool, same_sensor, other_object, keys
        mine = MatchKeys(*(key[pool] for key in keys))  # not stored: one copy of millions of rows is enough
        touch, obj = mine.touch, mine.object
        self._rows_of_sensor: dict[int, np.ndarray] = {}
        self._usable = _distinct(mine.sensor, mine.touch) > 1 if same_sensor else np.ones(len(pool), bool)
        self.one_object = len(obj) > 0 and bool((obj == obj[0]).all() and obj[0] >= 0)
        anchors = np.flatnonzero((touch >= 0) & _has_partner(mine, self._usable))
        del mine, obj
        order = np.argsort(touch, kind="stable")
        self._order = order.astype(np.int32) if len(order) < 1 << 31 else order
        self._sorted = touch[self._order]
        # With a single place, a row of an unknown place may be on it; a usable partner's sensor has another place.
        known = same_sensor or np.searchsorted(self._sorted, 0) < np.searchsorted(self._sorted, touch.max(initial=-1))
        self.anchors = anchors if known else anchors[self._have_negatives(anchors)]

    def _have_negatives(self, anchors: np.ndarray) -> np.ndarray:
        """Return which of these anchors, all at one place, have a negative; each object and data set is tried once."""
        rows = self.pool[anchors]
        things = np.stack([self._keys.object[rows], self._keys.dataset[rows]], 1)
        _, first, thing = np.unique(things, axis=0, return_index=True, return_inverse=True)
        return np.array([self._negatives(int(anchors[at])).size > 0 for at in first], bool)[thing.ravel()]

    def place(self, anchor: int) -> int:
        """Return the code of the place of `anchor`."""
        return int(self._keys.touch[self.pool[anchor]])

    def draw(self, anchor: int, rng: np.random.Generator, sensor: int | None = None) -> tuple[int, int]:
        """Return (positive, negative) for `anchor`, as ids into `pool`.

        The positive is of another sensor (of `sensor` if that has touched the place), or else of another unit. The
        negative is uniform among the rows that are surely at another place.
        """
        keys, row = self._keys, self.pool[anchor]
        low, high = np.searchsorted(self._sorted, keys.touch[row] + np.array([0, 1]))
        same_place = self._order[low:high]
        rows = self.pool[same_place]
        partners = same_place[(keys.sensor[rows] != keys.sensor[row]) & self._usable[same_place]]
        if not partners.size:
            partners = same_place[(keys.unit[rows] != keys.unit[row]) & (keys.unit[rows] >= 0)]
        preferred = partners[keys.sensor[self.pool[partners]] == sensor]
        partners = preferred if preferred.size else partners
        positive = int(partners[rng.integers(partners.size)])
        of_sensor = int(keys.sensor[self.pool[positive]]) if self.same_sensor else None
        if of_sensor is None:
            tries = rng.integers(len(self.pool), size=_TRIES)
        else:
            tries = self._of_sensor(of_sensor)
            tries = tries[rng.integers(len(tries), size=_TRIES)]
        fit = np.flatnonzero(self._elsewhere(anchor, tries))
        if fit.size:
            return positive, int(tries[fit[0]])
        negatives = self._negatives(anchor, of_sensor)
        return positive, int(negatives[rng.integers(negatives.size)])

    def _negatives(self, anchor: int, sensor: int | None = None) -> np.ndarray:
        ids = np.arange(len(self.pool)) if sensor is None else self._of_sensor(sensor)
        negatives = ids[self._elsewhere(anchor, ids)]
        if not negatives.size and self.other_object:  # fall back to another known place on the same object
            touch = self._keys.touch[self.pool[ids]]
            negatives = ids[(touch >= 0) & (touch != self.place(anchor))]
        return negatives

    def _of_sensor(self, sensor: int) -> np.ndarray:
        """Return the ids i64 of the pool of one sensor."""
        if sensor not in self._rows_of_sensor:
            self._rows_of_sensor[sensor] = np.flatnonzero(self._keys.sensor[self.pool] == sensor)
        return self._rows_of_sensor[sensor]

    def _elsewhere(self, anchor: int, ids: np.ndarray) -> np.ndarray:
        """Return which `ids` are surely at another place, and on another object with `other_object`, bool."""
        keys, rows, row = self._keys, self.pool[ids], self.pool[anchor]

        def differs(key: np.ndarray) -> np.ndarray:
            return (key[rows] != key[row]) & (key[rows] >= 0) & (key[row] >= 0)

        unknown = keys.touch[rows] < 0
        elsewhere = differs(keys.touch) | (unknown & (differs(keys.object) | differs(keys.dataset)))
        if not self.other_object:
            return elsewhere
        return elsewhere & ~((keys.object[rows] == keys.object[row]) & (keys.object[row] >= 0))


def is_shared_touch(touch: np.ndarray, sensor: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return the rows whose touch (codes i64 (rows,)) two or more known sensors or units share, bool (rows,)."""
    return (_distinct(touch, sensor) > 1) | (_distinct(touch, unit) > 1)


def _has_partner(keys: MatchKeys, usable: np.ndarray) -> np.ndarray:
    """Return which rows have a usable partner of another sensor at their place, or else of another unit."""
    sensors, units = _distinct(keys.touch, keys.sensor), _distinct(keys.touch, keys.unit)
    others = _distinct(keys.touch, np.where(usable, keys.sensor, -1)) - usable
    return np.where(sensors > 1, others > 0, (units > 1) & (keys.unit >= 0) & usable)


def _distinct(group: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return for every row how many known values (>= 0) its group has, 0 without a group (-1): i64 (rows,)."""
    known = (value >= 0) & (group >= 0)
    width, groups = int(value.max(initial=0)) + 1, int(group.max(initial=-1)) + 2  # the last group is that of -1
    pairs = group[known].astype(np.int64) * width + value[known]
    if width * groups <= _TABLE * len(group):  # few values per group: millions of pairs need no sort
        flags = np.zeros(width * groups, bool)
        flags[pairs] = True
        count = np.count_nonzero(flags.reshape(groups, width), axis=1)
    else:
        pairs.sort()
        count = np.bincount(pairs[np.diff(pairs, prepend=-1) > 0] // width, minlength=groups)
    return count[group]
