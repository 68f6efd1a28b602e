"""Which part of a batch a process fills, when several share the work."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from anytouch_jax.errors import UserError


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
