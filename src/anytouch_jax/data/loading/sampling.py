"""Stateless sampling: what step k draws is a function of (data, seed, k).

No state passes from step to step. So a run that resumes at step k draws what it would have drawn,
threads may fill batches in any order, and each process of several knows what the others draw.

Every sampler here answers for any position, and makes the table or permutation that it needs when
it is first asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import gcd, lcm
from typing import NamedTuple

import numpy as np

from anytouch_jax.data.loading.matching import Matches, MatchKeys, is_shared_touch
from anytouch_jax.errors import UserError

__all__ = [
    "BOTH",
    "NEITHER",
    "TEXT",
    "VISION",
    "EpochSampler",
    "MatchKeys",
    "Matches",
    "PartSampler",
    "Shard",
    "StepSchedule",
    "StratumQuota",
    "is_shared_touch",
    "uniform_per_step",
]

# strata by modality, in the order in which `StratumQuota` lays them out
VISION = 0
BOTH = 1
TEXT = 2
NEITHER = 3

_GOLDEN = 0.6180339887
_TABLE = 1024  # steps of a first table; a longer one is made when it is needed
_SEEDS = 2**63  # numpy's generators take no negative seeds


def uniform_per_step(seed: int, tag: int, steps: np.ndarray) -> np.ndarray:
    """Return a number in [0, 1) for every step, f64 of the shape of `steps`.

    It is splitmix64 of (seed, tag, step): a hash, so that a million steps need no generators.

    Args:
        seed: That of the run.
        tag: Keeps the random streams of one seed apart.
        steps: i64, from 0.
    """
    # in arrays, because scalars warn when they overflow, and overflow is meant
    state = np.array([(seed ^ tag * 0xD1342543DE82EF95) % 2**64], np.uint64)
    x = _mix(state) + (steps.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    # the upper 53 bits, as a float64 holds
    return np.asarray((_mix(x) >> np.uint64(11)) * 2.0**-53)


def _mix(x: np.ndarray) -> np.ndarray:
    """Return the finaliser of splitmix64, u64."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


class StepSchedule:
    """The kind of each step's batch, and its rank among the batches of that kind.

    Stills and clips each go through their own epochs, so a batch of clips must know how many clip
    batches came before it.

    Args:
        choose: Maps steps i64 (n,) to their kinds, small codes (n,).
    """

    def __init__(self, choose: Callable[[np.ndarray], np.ndarray]) -> None:
        self._choose = choose
        self._table = (np.empty(0, np.int8), np.empty(0, np.int64))

    def at(self, step: int) -> tuple[int, int]:
        """Return (kind of `step`, number of earlier steps of that kind)."""
        if step < 0:
            raise ValueError(f"steps count from 0, not from {step}")
        kinds, rank = self._table
        if step >= len(kinds):
            # twice as long as needed, so that a long run makes few tables
            kinds = self._choose(np.arange(max(_TABLE, 2 * step))).astype(np.int8)
            rank = np.empty(len(kinds), np.int64)
            for kind in np.unique(kinds):
                rank[kinds == kind] = np.arange(np.count_nonzero(kinds == kind))
            self._table = (kinds, rank)
        return int(kinds[step]), int(rank[step])


class _Group(NamedTuple):
    """Items of one weight: each is drawn `times` times, and `more` of them once more."""

    ids: np.ndarray
    times: int
    more: int


class EpochSampler:
    """An endless sequence of item ids, epoch after epoch.

    Each epoch is a seeded permutation of `size` draws, made when it is first needed.

    Args:
        items: Number of items.
        seed: That of the run.
        tag: Keeps the random streams of one seed apart.
        weights: f64 (items,) above 0, how often an epoch draws each item: floor(w) times, and a
            seeded choice of the items of one weight once more. By default once each.
    """

    def __init__(self, items: int, seed: int, tag: int, weights: np.ndarray | None = None) -> None:
        self._seed = (seed % _SEEDS, tag)
        self._groups: list[_Group] = []
        self.size = items
        self._copies = 1  # draws of an item in an epoch, at most
        if weights is not None and (weights != 1).any():
            for weight in np.unique(weights):
                ids = np.flatnonzero(weights == weight)
                # a small weight of few items still draws one of them
                draws = max(1, round(weight * len(ids)))
                times = int(weight)
                self._groups.append(_Group(ids, times, draws - times * len(ids)))
                self._copies = max(self._copies, times + 1)
            self.size = sum(group.times * len(group.ids) + group.more for group in self._groups)
        self._epochs: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}

    def take(self, start: int, count: int) -> list[tuple[int, int]]:
        """Return (item, pass) of positions start .. start + count - 1 of the sequence.

        The pass seeds the augmentation. It is the epoch, or with weights another number for each
        draw of an item, so that two draws in one epoch look different.
        """
        draws = []
        for place in range(start, start + count):
            epoch, position = divmod(place, self.size)
            order, copy = self._epoch(epoch)
            number = epoch
            if copy is not None:
                number = epoch * self._copies + int(copy[position])
            draws.append((int(order[position]), number))
        return draws

    def _epoch(self, epoch: int) -> tuple[np.ndarray, np.ndarray | None]:
        if epoch not in self._epochs:
            # A batch may reach over the end of an epoch, and threads work ahead: three are kept.
            while len(self._epochs) > 2:
                self._epochs.pop(next(iter(self._epochs)))
            self._epochs[epoch] = self._permuted(np.random.default_rng([*self._seed, epoch]))
        return self._epochs[epoch]

    def _permuted(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the draws of an epoch.

        These are the items i64 (size,), and the number of the copy of each draw (None: all are 0).
        """
        if not self._groups:
            return rng.permutation(self.size), None
        items = []
        copies = []
        for group in self._groups:
            for copy in range(group.times):
                items.append(group.ids)
                copies.append(np.full(len(group.ids), copy))
            # A new choice in each epoch: over many of them every item comes equally often.
            chosen = rng.permutation(group.ids)[: group.more]
            items.append(chosen)
            copies.append(np.full(len(chosen), group.times))
        order = rng.permutation(self.size)
        return np.concatenate(items)[order], np.concatenate(copies)[order]


class PartSampler:
    """An endless sequence of item ids in batches, for data that lie in shards on several hosts.

    A shard is a file of many samples, and reading one costs as much as reading all of it. The
    shards are shared out to `parts` parts by size, each to the smallest so far. Slot i of a batch
    draws from part i * parts // batch, which goes through its shards in a seeded order, MIXED at a
    time: all items once, then again. So a host reads the shards of its slots alone, and any number
    of hosts that divides `parts` reads the same batches.

    Args:
        shard: i64 (items,), the shard of each item.
        batch: Samples of a batch.
        parts: Number of parts.
        seed: That of the run.
        tag: Keeps the random streams of one seed apart.

    Raises:
        UserError: For fewer shards than parts, and for a batch that the parts do not divide.
    """

    MIXED = 4  # shards whose items are mixed

    def __init__(self, shard: np.ndarray, batch: int, parts: int, seed: int, tag: int) -> None:
        if batch % parts:
            raise UserError(
                f"a batch of {batch} does not divide into --data.parts {parts}; change one of them"
            )
        self.size = len(shard)
        self._batch = batch
        self._seed = (seed % _SEEDS, tag)
        names, counts = np.unique(shard, return_counts=True)
        if len(names) < parts:
            raise UserError(
                f"--data.parts {parts} needs as many shards, and there are {len(names)}; lower it"
            )
        members: list[list[int]] = [[] for _ in range(parts)]
        sizes = np.zeros(parts, np.int64)
        # The largest first, so that the small ones level the parts.
        for at in np.argsort(-counts, kind="stable"):
            part = int(np.argmin(sizes))
            members[part].append(int(at))
            sizes[part] += counts[at]
        by_shard = np.argsort(shard, kind="stable")
        items_of = np.split(by_shard, np.cumsum(counts)[:-1])
        self._parts = [[items_of[at] for at in part] for part in members]
        self._sizes = sizes
        self._orders = dict[tuple[int, int], np.ndarray]()

    def take(self, start: int, count: int) -> list[tuple[int, int]]:
        """Return (item, epoch of its part) at positions start .. start + count - 1."""
        slots_of_part = self._batch // len(self._parts)
        draws = []
        for position in range(start, start + count):
            step, slot = divmod(position, self._batch)
            part, slot_in_part = divmod(slot, slots_of_part)
            # Parts differ in size, so each has epochs of its own.
            drawn = step * slots_of_part + slot_in_part
            epoch, place = divmod(drawn, int(self._sizes[part]))
            draws.append((int(self._order(part, epoch)[place]), epoch))
        return draws

    def _order(self, part: int, epoch: int) -> np.ndarray:
        """Return the items of a part in the order of an epoch."""
        if (part, epoch) not in self._orders:
            # this epoch of each part and the last one
            while len(self._orders) > 2 * len(self._parts):
                self._orders.pop(next(iter(self._orders)))
            rng = np.random.default_rng([*self._seed, part, epoch])
            shards = self._parts[part]
            order = rng.permutation(len(shards))
            items = []
            for start in range(0, len(order), self.MIXED):
                mixed = [shards[i] for i in order[start : start + self.MIXED]]
                items.append(rng.permutation(np.concatenate(mixed)))
            self._orders[part, epoch] = np.concatenate(items)
        return self._orders[part, epoch]


class StratumQuota:
    """How many rows of each stratum a batch takes, so that its image and text slots are full.

    A batch has a fixed number of image slots and of text slots, because each shape is compiled
    once. Rows drawn without regard to what they have would fill them more or less, and a slot too
    few would drop an image. So each batch takes a number of rows of each stratum (vision, both,
    text, neither).

    The strata are intervals of a line of length `batch`, as long as their average numbers of rows.
    A batch takes the points u, u + 1, u + 2, ... of the line, with an offset u below 1. Then each
    batch has `batch` rows, and each count is its exact average rounded down or up. The offset moves
    by the golden section from batch to batch, which spreads the offsets evenly, so that a rare
    stratum comes at even distances. All numbers are fractions with one denominator, `_unit`: with
    floats the counts of a long run would drift.

    Args:
        sizes: (4,), rows of each stratum.
        batch: Rows of a batch.
        multiple: Slots are a multiple of it, the number of devices.

    Attributes:
        images: Image slots of a batch: their average number, rounded up.
        texts: Text slots of a batch, likewise.
    """

    def __init__(self, sizes: Sequence[int], batch: int, multiple: int = 1) -> None:
        rows = sum(sizes)
        averages = [Fraction(batch * size, rows) for size in sizes]
        images = averages[VISION] + averages[BOTH]
        texts = averages[TEXT] + averages[BOTH]
        self.images = _slots(images, batch, multiple)
        self.texts = _slots(texts, batch, multiple)
        # Slots that are there for the sake of the devices may stay empty.
        averages = _fill(averages, _slots(images, batch, 1), _slots(texts, batch, 1))
        edges = [sum(averages[:end], Fraction(0)) for end in range(5)]
        self._unit = lcm(*(edge.denominator for edge in edges))
        self._edges = np.array([int(edge * self._unit) for edge in edges], np.int64)
        # A step without a common factor reaches each offset once in `_unit` batches, so that the
        # averages are exact.
        self._step = max(1, round(_GOLDEN * self._unit))
        while gcd(self._step, self._unit) > 1:
            self._step += 1
        self._table = np.zeros((1, 4), np.int64)

    def at(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows taken of each stratum before batch `k` and by it, i64 (4,) each.

        The first are the positions at which the samplers of the strata go on.
        """
        if k + 1 >= len(self._table):
            batches = max(_TABLE, 2 * k + 2)
            offsets = np.cumsum(np.full(batches, self._step) % self._unit) % self._unit
            # points below each edge: ceil((edge - offset) / unit)
            below = -((offsets[:, None] - self._edges) // self._unit)
            counts = np.diff(below, axis=1)
            first = np.zeros((1, 4), np.int64)
            self._table = np.concatenate([first, np.cumsum(counts, axis=0)])
        return self._table[k], self._table[k + 1] - self._table[k]


def _slots(average: Fraction, batch: int, multiple: int) -> int:
    """Return an average rounded up to a multiple, and a whole batch at most."""
    rounded_up = -(-average // multiple) * multiple
    return min(batch, rounded_up)


def _fill(averages: list[Fraction], images: int, texts: int) -> list[Fraction]:
    """Move rows to the strata that fill the slots.

    No stratum loses more than half of its natural share: a fraction of a slot must not keep rare
    rows out of the training.

    Args:
        averages: Rows of a batch by stratum.
        images: Image slots to be filled.
        texts: Text slots to be filled.
    """
    filled = list(averages)
    least = [average / 2 for average in averages]

    def move(source: int, target: int, wanted: Fraction) -> Fraction:
        """Move rows, and return how many are still wanted."""
        # a stratum without rows stays without
        if not filled[target]:
            return wanted
        amount = min(wanted, filled[source] - least[source])
        filled[source] -= amount
        filled[target] += amount
        return wanted - amount

    empty_images = images - filled[VISION] - filled[BOTH]
    empty_texts = texts - filled[TEXT] - filled[BOTH]
    # First rows that fill no slot, then rows that fill one slot and may fill two.
    empty_images = move(NEITHER, VISION, empty_images)
    empty_texts = move(NEITHER, TEXT, empty_texts)
    move(TEXT, BOTH, empty_images)
    move(VISION, BOTH, empty_texts)
    return filled


@dataclass(frozen=True)
class Shard:
    """Part `index` of `count` equal, contiguous parts of a batch: the slots of one process."""

    index: int
    count: int

    def check(self, slots: int, name: str) -> None:
        """Raise UserError unless `slots` divides into equal parts, and this is one of them."""
        if not 0 <= self.index < self.count:
            raise UserError(f"there is no shard {self.index} of {self.count}")
        if slots % self.count:
            raise UserError(
                f"{name} {slots} cannot be shared by {self.count} processes; choose a multiple of "
                "them"
            )

    def fraction(self, slots: int) -> int:
        """Return the number of slots of this part."""
        return slots // self.count

    def cut(self, array: np.ndarray) -> np.ndarray:
        """Return a view of this part of an array."""
        size = self.fraction(len(array))
        return array[self.index * size : (self.index + 1) * size]

    def place(self, slot: int | None, slots: int) -> int | None:
        """Return the position of `slot` of `slots` within this part.

        It is None for a slot of another part, and for None.
        """
        if slot is None:
            return None
        position = slot - self.index * self.fraction(slots)
        if 0 <= position < self.fraction(slots):
            return position
        return None
