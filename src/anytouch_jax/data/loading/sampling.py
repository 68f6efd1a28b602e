"""Stateless sampling: what step k draws is a function of (data, seed, k); nothing is carried from step to step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import gcd, lcm
from typing import NamedTuple

import numpy as np

from anytouch_jax.errors import UserError

VISION, BOTH, TEXT, NEITHER = range(4)  # the strata of alignment, in this order along the line (see `StratumQuota`)


def uniform(seed: int, tag: int, steps: np.ndarray) -> np.ndarray:
    """A number in [0, 1) for every step, f64 of the shape of `steps`: splitmix64 of (seed, tag, step)."""
    state = np.array([(seed ^ tag * 0xD1342543DE82EF95) % 2**64], np.uint64)  # an array, so that it may overflow
    x = _mix(state) + (steps.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    return np.asarray((_mix(x) >> np.uint64(11)) * 2.0**-53)


def _mix(x: np.ndarray) -> np.ndarray:
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


class StepSchedule:
    """Which kind of batch each step takes, and how many earlier steps took the same kind.

    `choose` maps step numbers i64 (n,) to small codes (n,); it must depend on the step alone.
    """

    def __init__(self, choose: Callable[[np.ndarray], np.ndarray]) -> None:
        self._choose = choose
        self._known = (np.empty(0, np.int8), np.empty(0, np.int64))

    def at(self, step: int) -> tuple[int, int]:
        """(kind of `step`, number of earlier steps of that kind)."""
        if step < 0:
            raise ValueError(f"a step is counted from 0, not {step}")
        if step >= len(self._known[0]):
            kinds = self._choose(np.arange(max(1024, 2 * step))).astype(np.int8)
            rank = np.empty(len(kinds), np.int64)
            for kind in np.unique(kinds):
                here = kinds == kind
                rank[here] = np.arange(np.count_nonzero(here))
            self._known = (kinds, rank)
        kinds, rank = self._known
        return int(kinds[step]), int(rank[step])


class EpochSampler:
    """An endless stream over `things` things: epoch after epoch, each a seeded permutation of `size` draws.

    `weights` f64 (things,) above 0: how often each is drawn in an epoch; without them each once, so `size` is `things`.
    Things of one weight w come floor(w) times each, and a seeded choice of them once more (one draw at least).
    """

    def __init__(self, things: int, seed: int, tag: int, weights: np.ndarray | None = None) -> None:
        self._seed = (seed % 2**63, tag)
        self._groups: list[tuple[np.ndarray, int, int]] = []  # things of one weight, times each, how many once more
        self.size, self._copies = things, 1
        if weights is not None and (weights != 1).any():
            for weight in np.unique(weights):
                ids = np.flatnonzero(weights == weight)
                draws, times = max(1, round(weight * len(ids))), int(weight)
                self._groups.append((ids, times, draws - times * len(ids)))
                self._copies = max(self._copies, times + 1)
            self.size = sum(times * len(ids) + more for ids, times, more in self._groups)
        self._epochs: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}

    def take(self, start: int, count: int) -> list[tuple[int, int]]:
        """(thing, pass) at places start .. start + count - 1 of the stream; fewer draws than `count` come again.

        The pass is the epoch, or with weights another number for each time that an epoch draws the thing.
        """
        found = []
        for place in range(start, start + count):
            epoch, place = divmod(place, self.size)
            order, copy = self._epoch(epoch)
            found.append((int(order[place]), epoch if copy is None else epoch * self._copies + int(copy[place])))
        return found

    def _epoch(self, epoch: int) -> tuple[np.ndarray, np.ndarray | None]:
        if epoch not in self._epochs:
            while len(self._epochs) > 2:
                self._epochs.pop(next(iter(self._epochs)))
            self._epochs[epoch] = self._order(np.random.default_rng([*self._seed, epoch]))
        return self._epochs[epoch]

    def _order(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray | None]:
        """The draws of an epoch in order: things i64 (size,), and which time each is drawn (None: once)."""
        if not self._groups:
            return rng.permutation(self.size), None
        parts = []
        for ids, times, more in self._groups:
            parts += [(ids, copy) for copy in range(times)] + [(rng.permutation(ids)[:more], times)]
        things = np.concatenate([ids for ids, _ in parts])
        copy = np.repeat([number for _, number in parts], [len(ids) for ids, _ in parts])
        order = rng.permutation(self.size)
        return things[order], copy[order]


class StratumQuota:
    """How many rows of each stratum (vision, both, text, neither) a batch takes, so that its slots are full.

    `sizes` (4,) rows in each stratum; `images`, `texts` are the slots of a batch: the share of each modality, rounded
    up to a whole number, and this to a multiple of `multiple`, at most `batch`. `multiple` is the number of devices,
    which may change in a run: what a batch takes does not depend on it, and fewer than `multiple` slots stay unused.

    The strata lie on a line of length `batch`, each as long as the rows it gives on average; a batch takes the points
    u, u + 1, ... of that line, so every count is its average rounded down or up, and so is the number of images
    (vision + both) and of texts (both + text), which lie together on the line. u moves by the golden section from
    batch to batch, in whole units of the line's common denominator: every stratum is visited, in its exact share.
    """

    def __init__(self, sizes: Sequence[int], batch: int, multiple: int = 1) -> None:
        rows = sum(sizes)
        shares = [Fraction(batch * size, rows) for size in sizes]
        images, texts = shares[VISION] + shares[BOTH], shares[TEXT] + shares[BOTH]
        self.images, self.texts = (_slots(share, batch, multiple) for share in (images, texts))
        shares = _fill(shares, _slots(images, batch, 1), _slots(texts, batch, 1))
        edges = [sum(shares[:end], Fraction(0)) for end in range(5)]
        self._unit = lcm(*(edge.denominator for edge in edges))
        self._edges = np.array([int(edge * self._unit) for edge in edges], np.int64)
        self._step = max(1, round(0.6180339887 * self._unit))
        while gcd(self._step, self._unit) > 1:
            self._step += 1
        self._known = np.zeros((1, 4), np.int64)

    def at(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """(rows taken from each stratum before batch `k`, rows that batch `k` takes): i64 (4,), i64 (4,)."""
        if k + 1 >= len(self._known):
            u = np.cumsum(np.full(max(1024, 2 * k + 2), self._step) % self._unit) % self._unit
            upto = -((u[:, None] - self._edges) // self._unit)  # points below each edge: ceil((edge - u) / unit)
            self._known = np.concatenate([np.zeros((1, 4), np.int64), np.cumsum(np.diff(upto, axis=1), axis=0)])
        return self._known[k], self._known[k + 1] - self._known[k]


def _slots(share: Fraction, batch: int, multiple: int) -> int:
    return min(batch, -(-share // multiple) * multiple)


def _fill(shares: list[Fraction], images: int, texts: int) -> list[Fraction]:
    """Move rows towards the strata that fill the slots; no stratum loses more than half of its natural share."""
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


class Slots(NamedTuple):
    """Where this shard keeps a sample's touch, picture and caption; None for what it has no part in."""

    touch: int | None
    image: int | None
    text: int | None


@dataclass(frozen=True)
class Shard:
    """Part `index` of `count` equal, contiguous parts of every axis of slots."""

    index: int
    count: int

    def check(self, slots: int, what: str) -> None:
        """Raises UserError when `slots` cannot be cut into `count` equal parts, or there is no such part."""
        if not 0 <= self.index < self.count:
            raise UserError(f"there is no shard {self.index} of {self.count}")
        if slots % self.count:
            raise UserError(f"{what} {slots} cannot be shared by {self.count} processes; choose a multiple of them")

    def share(self, slots: int) -> int:
        """Slots of this part."""
        return slots // self.count

    def cut(self, array: np.ndarray) -> np.ndarray:
        """This part of an array, a view."""
        size = self.share(len(array))
        return array[self.index * size : (self.index + 1) * size]

    def place(self, slot: int | None, slots: int) -> int | None:
        """Where slot `slot` of `slots` lies in this part; None where it lies in another (or is None)."""
        if slot is None:
            return None
        here = slot - self.index * self.share(slots)
        return here if 0 <= here < self.share(slots) else None
