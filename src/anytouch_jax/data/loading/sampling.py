"""Stateless sampling: the draw of step k is a function of (data, seed, k), and no state passes from
step to step.

Cross-sensor matching (Sec. 3.4): the anchors of a pool of rows, and draws of their positives and
negatives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import gcd, lcm
from typing import NamedTuple

import numpy as np

from anytouch_jax.errors import UserError

# strata by modality, in the order in which `StratumQuota` lays them out
VISION, BOTH, TEXT, NEITHER = range(4)


def uniform_per_step(seed: int, tag: int, steps: np.ndarray) -> np.ndarray:
    """Return a number in [0, 1) for every step, f64 of the shape of `steps`: splitmix64 of (seed,
    tag, step).
    """
    # arrays overflow without a warning
    state = np.array([(seed ^ tag * 0xD1342543DE82EF95) % 2**64], np.uint64)
    x = _mix(state) + (steps.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    return np.asarray((_mix(x) >> np.uint64(11)) * 2.0**-53)


def _mix(x: np.ndarray) -> np.ndarray:
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


class StepSchedule:
    """The kind of each step's batch, and its rank in that kind; `choose` maps i64 (n,) steps to
    small codes (n,).
    """

    def __init__(self, choose: Callable[[np.ndarray], np.ndarray]) -> None:
        self._choose = choose
        self._table = (np.empty(0, np.int8), np.empty(0, np.int64))

    def at(self, step: int) -> tuple[int, int]:
        """Return (kind of `step`, number of earlier steps of that kind)."""
        if step < 0:
            raise ValueError(f"steps count from 0, not from {step}")
        if step >= len(self._table[0]):
            kinds = self._choose(np.arange(max(1024, 2 * step))).astype(np.int8)
            rank = np.empty(len(kinds), np.int64)
            for kind in np.unique(kinds):
                rank[kinds == kind] = np.arange(np.count_nonzero(kinds == kind))
            self._table = (kinds, rank)
        kinds, rank = self._table
        return int(kinds[step]), int(rank[step])


class EpochSampler:
    """An endless sequence of item ids, epoch after epoch.

    Each epoch is a seeded permutation of `size` draws.

    `weights` f64 (items,) above 0 is how often an epoch draws each: floor(w) times, and a seeded
    choice of the items of one weight once more.
    """

    def __init__(self, items: int, seed: int, tag: int, weights: np.ndarray | None = None) -> None:
        self._seed = (seed % 2**63, tag)
        # ids of one weight, draws of each, further draws
        self._groups: list[tuple[np.ndarray, int, int]] = []
        self.size = items
        self._copies = 1
        if weights is not None and (weights != 1).any():
            for weight in np.unique(weights):
                ids = np.flatnonzero(weights == weight)
                draws = max(1, round(weight * len(ids)))
                times = int(weight)
                self._groups.append((ids, times, draws - times * len(ids)))
                self._copies = max(self._copies, times + 1)
            self.size = sum(times * len(ids) + more for ids, times, more in self._groups)
        self._epochs: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}

    def take(self, start: int, count: int) -> list[tuple[int, int]]:
        """Return (item, pass) of positions.

        The pass is the epoch, with weights another for each draw of an item.
        """
        draws = []
        for position in range(start, start + count):
            epoch, position = divmod(position, self.size)
            order, copy = self._epoch(epoch)
            number = epoch if copy is None else epoch * self._copies + int(copy[position])
            draws.append((int(order[position]), number))
        return draws

    def _epoch(self, epoch: int) -> tuple[np.ndarray, np.ndarray | None]:
        if epoch not in self._epochs:
            while len(self._epochs) > 2:
                self._epochs.pop(next(iter(self._epochs)))
            self._epochs[epoch] = self._permuted(np.random.default_rng([*self._seed, epoch]))
        return self._epochs[epoch]

    def _permuted(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the draws of an epoch: items i64 (size,), and the copy number of each draw (None:
        all are 0).
        """
        if not self._groups:
            return rng.permutation(self.size), None
        parts = []
        for ids, times, more in self._groups:
            parts += [(ids, copy) for copy in range(times)] + [(rng.permutation(ids)[:more], times)]
        items = np.concatenate([ids for ids, _ in parts])
        copy = np.repeat([number for _, number in parts], [len(ids) for ids, _ in parts])
        order = rng.permutation(self.size)
        return items[order], copy[order]


class PartSampler:
    """An endless sequence of item ids in batches, whose slots draw from `parts` parts of whole
    shards.

    `shard` i64 (items,) is the shard of each item. Shards go to the parts by size, each to the
    smallest. Slot i of a batch draws from part i * parts // batch, which goes through its shards in
    a seeded order, MIXED at a time: all items once, then again. So any number of hosts that divides
    `parts` reads the same batches. Raises UserError for too few shards.
    """

    MIXED = 4  # shards whose items are mixed

    def __init__(self, shard: np.ndarray, batch: int, parts: int, seed: int, tag: int) -> None:
        if batch % parts:
            raise UserError(
                f"a batch of {batch} does not divide into --data.parts {parts}; change one of them"
            )
        self.size = len(shard)
        self._batch = batch
        self._seed = (seed % 2**63, tag)
        names, counts = np.unique(shard, return_counts=True)
        if len(names) < parts:
            raise UserError(
                f"--data.parts {parts} needs as many shards, and there are {len(names)}; lower it"
            )
        members: list[list[int]] = [[] for _ in range(parts)]
        sizes = np.zeros(parts, np.int64)
        for at in np.argsort(-counts, kind="stable"):
            part = int(np.argmin(sizes))
            members[part].append(int(names[at]))
            sizes[part] += counts[at]
        order = np.argsort(shard, kind="stable")
        of = dict(zip(names.tolist(), np.split(order, np.cumsum(counts)[:-1]), strict=True))
        self._parts = [[of[name] for name in part] for part in members]
        self._sizes = sizes
        self._orders = dict[tuple[int, int], np.ndarray]()

    def take(self, start: int, count: int) -> list[tuple[int, int]]:
        """Return (item, epoch of its part) at positions start .. start + count - 1 of the
        sequence.
        """
        share = self._batch // len(self._parts)
        draws = []
        for position in range(start, start + count):
            step, slot = divmod(position, self._batch)
            part, place = divmod(slot, share)
            epoch, place = divmod(step * share + place, int(self._sizes[part]))
            draws.append((int(self._order(part, epoch)[place]), epoch))
        return draws

    def _order(self, part: int, epoch: int) -> np.ndarray:
        """Return the items of a part in the order of an epoch."""
        if (part, epoch) not in self._orders:
            while len(self._orders) > 2 * len(self._parts):
                self._orders.pop(next(iter(self._orders)))
            rng = np.random.default_rng([*self._seed, part, epoch])
            shards = self._parts[part]
            turn = rng.permutation(len(shards))
            groups = [turn[at : at + self.MIXED] for at in range(0, len(turn), self.MIXED)]
            items = [
                rng.permutation(np.concatenate([shards[i] for i in group])) for group in groups
            ]
            self._orders[part, epoch] = np.concatenate(items)
        return self._orders[part, epoch]


class StratumQuota:
    """How many rows of each stratum (vision, both, text, neither) a batch takes, so that its slots
    are full.

    `sizes` (4,) rows in each stratum. `images` and `texts` are the slots of a batch: the share of
    each modality, rounded up, also to a multiple of the devices. The strata are intervals of a line
    of length `batch`, and a batch takes the points u, u + 1, ... of it. So each count is its exact
    average rounded down or up. The offset u moves by the golden section from batch to batch, so
    that rare strata come at even distances.
    """

    def __init__(self, sizes: Sequence[int], batch: int, multiple: int = 1) -> None:
        rows = sum(sizes)
        shares = [Fraction(batch * size, rows) for size in sizes]
        images = shares[VISION] + shares[BOTH]
        texts = shares[TEXT] + shares[BOTH]
        self.images, self.texts = (_slots(share, batch, multiple) for share in (images, texts))
        shares = _fill(shares, _slots(images, batch, 1), _slots(texts, batch, 1))
        edges = [sum(shares[:end], Fraction(0)) for end in range(5)]
        self._unit = lcm(*(edge.denominator for edge in edges))
        self._edges = np.array([int(edge * self._unit) for edge in edges], np.int64)
        self._step = max(1, round(0.6180339887 * self._unit))
        while gcd(self._step, self._unit) > 1:
            self._step += 1
        self._table = np.zeros((1, 4), np.int64)

    def at(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows taken from each stratum before batch `k` and by batch `k`, i64 (4,)
        each.
        """
        if k + 1 >= len(self._table):
            u = np.cumsum(np.full(max(1024, 2 * k + 2), self._step) % self._unit) % self._unit
            # points below each edge: ceil((edge - u) / unit)
            below = -((u[:, None] - self._edges) // self._unit)
            self._table = np.concatenate(
                [np.zeros((1, 4), np.int64), np.cumsum(np.diff(below, axis=1), axis=0)]
            )
        return self._table[k], self._table[k + 1] - self._table[k]


def _slots(share: Fraction, batch: int, multiple: int) -> int:
    return min(batch, -(-share // multiple) * multiple)


def _fill(shares: list[Fraction], images: int, texts: int) -> list[Fraction]:
    """Move rows to the strata that fill the slots; no stratum loses more than half of its natural
    share.
    """
    shares, floor = list(shares), [share / 2 for share in shares]

    def move(source: int, target: int, wanted: Fraction) -> Fraction:
        if not shares[target]:
            return wanted
        amount = min(wanted, shares[source] - floor[source])
        shares[source] -= amount
        shares[target] += amount
        return wanted - amount

    no_image = images - shares[VISION] - shares[BOTH]
    no_text = texts - shares[TEXT] - shares[BOTH]
    no_image = move(NEITHER, VISION, no_image)
    no_text = move(NEITHER, TEXT, no_text)
    move(TEXT, BOTH, no_image)
    move(VISION, BOTH, no_text)
    return shares


@dataclass(frozen=True)
class Shard:
    """Part `index` of `count` equal, contiguous parts of a batch: the slots that one process
    fills.
    """

    index: int
    count: int

    def check(self, slots: int, name: str) -> None:
        """Raise UserError unless `slots` divides into `count` equal parts and this part is one of
        them.
        """
        if not 0 <= self.index < self.count:
            raise UserError(f"there is no shard {self.index} of {self.count}")
        if slots % self.count:
            raise UserError(
                f"{name} {slots} cannot be shared by {self.count} processes; choose a multiple of "
                "them"
            )

    def share(self, slots: int) -> int:
        """Return the number of slots of this part."""
        return slots // self.count

    def cut(self, array: np.ndarray) -> np.ndarray:
        """Return a view of this part of an array."""
        size = self.share(len(array))
        return array[self.index * size : (self.index + 1) * size]

    def place(self, slot: int | None, slots: int) -> int | None:
        """Return the position of `slot` of `slots` within this part, None if it is outside or
        None.
        """
        if slot is None:
            return None
        position = slot - self.index * self.share(slots)
        if 0 <= position < self.share(slots):
            return position
        return None


_TABLE = 16  # cells per row up to which a table of flags is used instead of a sort
_TRIES = 32  # uniform draws before the whole pool is searched


class MatchKeys(NamedTuple):
    """What distinguishes touches, codes (rows,), -1 for unknown: place, sensor, unit, object, data
    set.
    """

    touch: np.ndarray
    sensor: np.ndarray
    unit: np.ndarray
    object: np.ndarray
    dataset: np.ndarray


class Matches:
    """The matches in a pool of rows (ids i64).

    `anchors` are ids into `pool`: rows whose place another sensor, or else another unit, has
    touched too, and that have a negative. `one_object` is True if all of the pool is one known
    object. With `same_sensor` negatives are of the positive's sensor, which has another known
    place. With `other_object` negatives are of another object if there is one (the release), else
    of "any other object or location".
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
        # not stored: one copy of millions of rows is enough
        mine = MatchKeys(*(key[pool] for key in keys))
        touch = mine.touch
        obj = mine.object
        self._rows_of_sensor: dict[int, np.ndarray] = {}
        self._usable = (
            _distinct(mine.sensor, mine.touch) > 1 if same_sensor else np.ones(len(pool), bool)
        )
        self.one_object = len(obj) > 0 and bool((obj == obj[0]).all() and obj[0] >= 0)
        anchors = np.flatnonzero((touch >= 0) & _has_partner(mine, self._usable))
        del mine, obj
        order = np.argsort(touch, kind="stable")
        self._order = order.astype(np.int32) if len(order) < 1 << 31 else order
        self._sorted = touch[self._order]
        # With a single place, a row of an unknown place may be on it; a usable partner's sensor has
        # another place.
        known = same_sensor or np.searchsorted(self._sorted, 0) < np.searchsorted(
            self._sorted, touch.max(initial=-1)
        )
        self.anchors = anchors if known else anchors[self._have_negatives(anchors)]

    def _have_negatives(self, anchors: np.ndarray) -> np.ndarray:
        """Return which of these anchors, all at one place, have a negative; each object and data
        set is tried once.
        """
        rows = self.pool[anchors]
        things = np.stack([self._keys.object[rows], self._keys.dataset[rows]], 1)
        _, first, thing = np.unique(things, axis=0, return_index=True, return_inverse=True)
        return np.array([self._negatives(int(anchors[at])).size > 0 for at in first], bool)[
            thing.ravel()
        ]

    def place(self, anchor: int) -> int:
        """Return the code of the place of `anchor`."""
        return int(self._keys.touch[self.pool[anchor]])

    def draw(
        self, anchor: int, rng: np.random.Generator, sensor: int | None = None
    ) -> tuple[int, int]:
        """Return (positive, negative) ids for `anchor`: other sensor (`sensor` if there) or unit;
        other place.
        """
        keys = self._keys
        row = self.pool[anchor]
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
        if (
            not negatives.size and self.other_object
        ):  # fall back to another known place on the same object
            touch = self._keys.touch[self.pool[ids]]
            negatives = ids[(touch >= 0) & (touch != self.place(anchor))]
        return negatives

    def _of_sensor(self, sensor: int) -> np.ndarray:
        """Return the ids i64 of the pool of one sensor."""
        if sensor not in self._rows_of_sensor:
            self._rows_of_sensor[sensor] = np.flatnonzero(self._keys.sensor[self.pool] == sensor)
        return self._rows_of_sensor[sensor]

    def _elsewhere(self, anchor: int, ids: np.ndarray) -> np.ndarray:
        """Return which `ids` are surely at another place, and on another object with
        `other_object`, bool.
        """
        keys = self._keys
        rows = self.pool[ids]
        row = self.pool[anchor]

        def differs(key: np.ndarray) -> np.ndarray:
            return (key[rows] != key[row]) & (key[rows] >= 0) & (key[row] >= 0)

        unknown = keys.touch[rows] < 0
        elsewhere = differs(keys.touch) | (unknown & (differs(keys.object) | differs(keys.dataset)))
        if not self.other_object:
            return elsewhere
        return elsewhere & ~((keys.object[rows] == keys.object[row]) & (keys.object[row] >= 0))


def is_shared_touch(touch: np.ndarray, sensor: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return the rows whose touch (codes i64 (rows,)) two or more known sensors or units share,
    bool (rows,).
    """
    return (_distinct(touch, sensor) > 1) | (_distinct(touch, unit) > 1)


def _has_partner(keys: MatchKeys, usable: np.ndarray) -> np.ndarray:
    """Return which rows have a usable partner of another sensor at their place, or else of another
    unit.
    """
    sensors = _distinct(keys.touch, keys.sensor)
    units = _distinct(keys.touch, keys.unit)
    others = _distinct(keys.touch, np.where(usable, keys.sensor, -1)) - usable
    return np.where(sensors > 1, others > 0, (units > 1) & (keys.unit >= 0) & usable)


def _distinct(group: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return for every row how many known values (>= 0) its group has, 0 without a group (-1): i64
    (rows,).
    """
    known = (value >= 0) & (group >= 0)
    # the last group is that of -1
    width = int(value.max(initial=0)) + 1
    groups = int(group.max(initial=-1)) + 2
    pairs = group[known].astype(np.int64) * width + value[known]
    if width * groups <= _TABLE * len(
        group
    ):  # few values per group: millions of pairs need no sort
        flags = np.zeros(width * groups, bool)
        flags[pairs] = True
        count = np.count_nonzero(flags.reshape(groups, width), axis=1)
    else:
        pairs.sort()
        count = np.bincount(pairs[np.diff(pairs, prepend=-1) > 0] // width, minlength=groups)
    return count[group]
