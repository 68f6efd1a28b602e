"""Triples for cross-sensor matching: which rows have a partner at the same place, and which are surely elsewhere."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
    """

    def __init__(self, pool: np.ndarray, keys: Keys) -> None:
        self.pool = pool
        self._keys = Keys(*(key[pool] for key in keys))
        touch = self._keys.touch
        self._order = np.argsort(touch, kind="stable")
        self._sorted = touch[self._order]
        objects = np.unique(self._keys.object)
        self.one_object = len(objects) == 1 and objects[0] >= 0
        anchors = np.flatnonzero((touch >= 0) & self._has_partner())
        many = len(np.unique(touch[touch >= 0])) > 1  # with one place only, a row of an unknown place may be it
        self.anchors = anchors if many else anchors[[self._negatives(int(a)).size > 0 for a in anchors]]

    def _has_partner(self) -> np.ndarray:
        touch, sensor, unit = self._keys.touch, self._keys.sensor, self._keys.unit
        sensors, units = _distinct(touch, sensor), _distinct(touch, unit)
        return (sensors > 1) | ((units > 1) & (unit >= 0))

    def draw(self, anchor: int, rng: np.random.Generator) -> tuple[int, int]:
        """(positive, negative) for `anchor`, as ids into `pool`: partner of another sensor, or else another unit;
        and, uniformly, a row that is surely another place, of another object where objects are known."""
        keys = self._keys
        low, high = np.searchsorted(self._sorted, keys.touch[anchor] + np.array([0, 1]))
        same = self._order[low:high]
        others = same[keys.sensor[same] != keys.sensor[anchor]]
        if not others.size:
            others = same[(keys.unit[same] != keys.unit[anchor]) & (keys.unit[same] >= 0)]
        positive = int(others[rng.integers(others.size)])
        tries = rng.integers(len(self.pool), size=_TRIES)
        fit = np.flatnonzero(self._elsewhere(anchor, tries))
        if fit.size:
            return positive, int(tries[fit[0]])
        negatives = self._negatives(anchor)
        return positive, int(negatives[rng.integers(negatives.size)])

    def _negatives(self, anchor: int) -> np.ndarray:
        rows = np.arange(len(self.pool))
        found = np.flatnonzero(self._elsewhere(anchor, rows))
        if not found.size:  # no other object: another known place of the same one
            touch = self._keys.touch
            found = np.flatnonzero((touch >= 0) & (touch != touch[anchor]))
        return found

    def _elsewhere(self, anchor: int, rows: np.ndarray) -> np.ndarray:
        """Which rows are surely another place, and not of the anchor's object: bool of the shape of `rows`."""
        keys = self._keys

        def differs(key: np.ndarray) -> np.ndarray:
            return (key[rows] != key[anchor]) & (key[rows] >= 0) & (key[anchor] >= 0)

        same_object = (keys.object[rows] == keys.object[anchor]) & (keys.object[anchor] >= 0)
        unknown = keys.touch[rows] < 0
        place = differs(keys.touch) | (unknown & (differs(keys.object) | differs(keys.dataset)))
        return place & ~same_object


def _distinct(group: np.ndarray, value: np.ndarray) -> np.ndarray:
    """For every row, how many different known values (>= 0) its group has: i64 (rows,)."""
    _, group = np.unique(group, return_inverse=True)
    known = value >= 0
    pairs = np.unique(np.stack([group[known], value[known]], 1), axis=0)
    return np.bincount(pairs[:, 0], minlength=group.max(initial=-1) + 1)[group]
