"""Cross-sensor matching (Sec. 3.4): which touches match, and draws of positives and negatives.

A positive of a touch is one of the same place (column `touch`) by another sensor, or else by
another unit of the sensor. A negative is one of surely another place: a row whose place is unknown
might be of the same one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_TABLE = 16  # cells per row up to which a table of flags is used instead of a sort
_TRIES = 32  # uniform draws before the whole pool is searched


class MatchKeys(NamedTuple):
    """What distinguishes touches, codes (rows,), -1 for unknown."""

    touch: np.ndarray
    sensor: np.ndarray
    unit: np.ndarray
    object: np.ndarray
    dataset: np.ndarray


class Matches:
    """The matches in a pool of rows.

    Args:
        pool: Row ids i64, the last rows of stills or clips. What follows are ids into it.
        keys: Of all rows of the manifest.
        same_sensor: Negatives are of the positive's sensor, which must have another known place.
            Otherwise a head can tell a negative by its sensor.
        other_object: Negatives are of another object if there is one, as in the release. The paper
            says "any other object or location".

    Attributes:
        anchors: Ids of rows whose place another sensor, or else another unit, has touched too, and
            that have a negative.
        one_object: Whether all of the pool is one known object.
    """

    def __init__(
        self,
        pool: np.ndarray,
        keys: MatchKeys,
        *,
        same_sensor: bool = False,
        other_object: bool = False,
    ) -> None:
        self.pool = pool
        self.same_sensor = same_sensor
        self.other_object = other_object
        self._keys = keys
        # Not stored: one copy of millions of rows is enough.
        mine = MatchKeys(*(key[pool] for key in keys))
        self._rows_of_sensor: dict[int, np.ndarray] = {}
        # which rows can be positives: those whose sensor has a negative
        self._usable = np.ones(len(pool), bool)
        if same_sensor:
            self._usable = _distinct(mine.sensor, mine.touch) > 1
        obj = mine.object
        self.one_object = len(obj) > 0 and bool((obj == obj[0]).all() and obj[0] >= 0)
        touch = mine.touch
        anchors = np.flatnonzero((touch >= 0) & _has_partner(mine, self._usable))
        del mine, obj
        # Rows by place: the rows of one place are found by bisection.
        order = np.argsort(touch, kind="stable")
        self._order = order.astype(np.int32) if len(order) < 1 << 31 else order
        self._sorted = touch[self._order]
        # Where there are two known places, each anchor has a negative, and a usable partner's
        # sensor has another place. With a single place the negatives are rows of unknown place,
        # which must be of another object or data set.
        last_place = touch.max(initial=-1)
        has_two_places = np.searchsorted(self._sorted, 0) < np.searchsorted(
            self._sorted, last_place
        )
        if not (same_sensor or has_two_places):
            anchors = anchors[self._have_negatives(anchors)]
        self.anchors = anchors

    def _have_negatives(self, anchors: np.ndarray) -> np.ndarray:
        """Return which of these anchors, all at one place, have a negative, bool.

        It depends on their object and data set alone, so each pair of these is tried once.
        """
        rows = self.pool[anchors]
        things = np.stack([self._keys.object[rows], self._keys.dataset[rows]], 1)
        _, first, thing = np.unique(things, axis=0, return_index=True, return_inverse=True)
        found = [self._negatives(int(anchors[at])).size > 0 for at in first]
        return np.array(found, bool)[thing.ravel()]

    def place(self, anchor: int) -> int:
        """Return the code of the place of `anchor`."""
        return int(self._keys.touch[self.pool[anchor]])

    def draw(
        self, anchor: int, rng: np.random.Generator, sensor: int | None = None
    ) -> tuple[int, int]:
        """Return ids of a positive and of a negative of an anchor.

        Args:
            anchor: One of `anchors`.
            rng: Of the triple, so that a draw does not depend on others.
            sensor: The positive is of this sensor if the place has one of it.
        """
        positive = self._draw_positive(anchor, rng, sensor)
        of_sensor = None
        if self.same_sensor:
            of_sensor = int(self._keys.sensor[self.pool[positive]])
        # Most rows are elsewhere, so some uniform draws find one without a look at all rows.
        if of_sensor is None:
            tries = rng.integers(len(self.pool), size=_TRIES)
        else:
            ids = self._of_sensor(of_sensor)
            tries = ids[rng.integers(len(ids), size=_TRIES)]
        fit = np.flatnonzero(self._elsewhere(anchor, tries))
        if fit.size:
            return positive, int(tries[fit[0]])
        negatives = self._negatives(anchor, of_sensor)
        return positive, int(negatives[rng.integers(negatives.size)])

    def _draw_positive(self, anchor: int, rng: np.random.Generator, sensor: int | None) -> int:
        keys = self._keys
        row = self.pool[anchor]
        place = keys.touch[row]
        low, high = np.searchsorted(self._sorted, place + np.array([0, 1]))
        same_place = self._order[low:high]
        rows = self.pool[same_place]
        other_sensor = (keys.sensor[rows] != keys.sensor[row]) & self._usable[same_place]
        partners = same_place[other_sensor]
        if not partners.size:
            other_unit = (keys.unit[rows] != keys.unit[row]) & (keys.unit[rows] >= 0)
            partners = same_place[other_unit]
        preferred = partners[keys.sensor[self.pool[partners]] == sensor]
        if preferred.size:
            partners = preferred
        return int(partners[rng.integers(partners.size)])

    def _negatives(self, anchor: int, sensor: int | None = None) -> np.ndarray:
        """Return all negatives of an anchor, ids i64, of one sensor if it is given."""
        ids = np.arange(len(self.pool)) if sensor is None else self._of_sensor(sensor)
        negatives = ids[self._elsewhere(anchor, ids)]
        # Without another object: another known place on the same one.
        if not negatives.size and self.other_object:
            touch = self._keys.touch[self.pool[ids]]
            negatives = ids[(touch >= 0) & (touch != self.place(anchor))]
        return negatives

    def _of_sensor(self, sensor: int) -> np.ndarray:
        """Return the ids i64 of the pool of one sensor."""
        if sensor not in self._rows_of_sensor:
            self._rows_of_sensor[sensor] = np.flatnonzero(self._keys.sensor[self.pool] == sensor)
        return self._rows_of_sensor[sensor]

    def _elsewhere(self, anchor: int, ids: np.ndarray) -> np.ndarray:
        """Return which `ids` are surely at another place, bool.

        With `other_object` they are not of the anchor's object either.
        """
        keys = self._keys
        rows = self.pool[ids]
        row = self.pool[anchor]

        def differs(key: np.ndarray) -> np.ndarray:
            # two unknown values, or a known and an unknown one, may be equal
            return (key[rows] != key[row]) & (key[rows] >= 0) & (key[row] >= 0)

        unknown = keys.touch[rows] < 0
        elsewhere = differs(keys.touch) | (unknown & (differs(keys.object) | differs(keys.dataset)))
        if not self.other_object:
            return elsewhere
        same_object = (keys.object[rows] == keys.object[row]) & (keys.object[row] >= 0)
        return elsewhere & ~same_object


def is_shared_touch(touch: np.ndarray, sensor: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return the rows whose touch two or more known sensors or units share, bool (rows,).

    The arguments are codes i64 (rows,), -1 for unknown.
    """
    return (_distinct(touch, sensor) > 1) | (_distinct(touch, unit) > 1)


def _has_partner(keys: MatchKeys, usable: np.ndarray) -> np.ndarray:
    """Return which rows have a usable partner at their place, bool (rows,).

    That is one of another sensor, or else, where the place has one sensor only, of another unit.
    """
    sensors = _distinct(keys.touch, keys.sensor)
    units = _distinct(keys.touch, keys.unit)
    usable_sensors = _distinct(keys.touch, np.where(usable, keys.sensor, -1))
    # without the row's own
    others = usable_sensors - usable
    has_other_unit = (units > 1) & (keys.unit >= 0) & usable
    return np.where(sensors > 1, others > 0, has_other_unit)


def _distinct(group: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return for every row how many known values (>= 0) its group has, i64 (rows,).

    It is 0 without a group (-1).
    """
    known = (value >= 0) & (group >= 0)
    width = int(value.max(initial=0)) + 1
    # one more, which stays empty: code -1 reads it
    groups = int(group.max(initial=-1)) + 2
    pairs = group[known].astype(np.int64) * width + value[known]
    # With few values a group, millions of pairs need no sort.
    if width * groups <= _TABLE * len(group):
        flags = np.zeros(width * groups, bool)
        flags[pairs] = True
        count = np.count_nonzero(flags.reshape(groups, width), axis=1)
    else:
        pairs.sort()
        is_first = np.diff(pairs, prepend=-1) > 0
        count = np.bincount(pairs[is_first] // width, minlength=groups)
    return count[group]
