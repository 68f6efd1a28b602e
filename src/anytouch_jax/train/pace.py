"""Pace of a run: how much of it is done, and when it ends."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import jax
import numpy as np


class Pace(Protocol):
    """The course of a run: its progress before each step, and its end after one.

    Progress is None where the number of steps is given, because a step then knows its own.
    """

    @property
    def total(self) -> int | None:
        """Steps after which the run ends, or None if the pace does not know."""

    def progress(self, done: int) -> np.float32 | None:
        """Return the ratio of the run that is done before the step of number `done`."""

    def stepped(self, done: int, metrics: Mapping[str, jax.Array]) -> bool:
        """Note that `done` steps were started, the last with these metrics; True ends the run."""

    def numbers(self) -> dict[str, Any]:
        """Return what a line of metrics says of the pace."""

    def resume(self, row: Mapping[str, Any]) -> None:
        """Continue from the last line of metrics of an earlier part of the run."""


class StepPace:
    """A run of the number of steps that the configuration gives."""

    total = None

    def progress(self, done: int) -> np.float32 | None:
        """Return None: the step knows."""
        return None

    def stepped(self, done: int, metrics: Mapping[str, jax.Array]) -> bool:
        """Return False: the batches end."""
        return False

    def numbers(self) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def resume(self, row: Mapping[str, Any]) -> None:
        """Do nothing."""


class Deadline(StepPace):
    """A run that ends at a time of `time.monotonic`, which the schedule then follows.

    The time begins when the first step has ended, because compiling is not training.
    """

    def __init__(self, until: float) -> None:
        self.until = until
        self._begun: float | None = None

    def progress(self, done: int) -> np.float32 | None:
        """Return the ratio of the time that has passed."""
        if self._begun is None:
            return np.float32(0)
        passed = time.monotonic() - self._begun
        return np.float32(min(passed / max(self.until - self._begun, 1e-3), 1.0))

    def stepped(self, done: int, metrics: Mapping[str, jax.Array]) -> bool:
        """Return whether the time is over."""
        if self._begun is None:
            jax.block_until_ready(metrics)
            self._begun = time.monotonic()
        return time.monotonic() >= self.until


class Budget(Deadline):
    """A run that ends at a time, after so many steps, or when it is told to, whatever is first.

    The schedule follows the nearer of both ends, so that the rate is 0 when the run ends.
    """

    def __init__(self, until: float, steps: int, ended: Callable[[], bool] = lambda: False) -> None:
        super().__init__(until)
        self._steps = steps
        self._ended = ended

    def progress(self, done: int) -> np.float32 | None:
        """Return the larger of the ratios of time and steps."""
        by_time = super().progress(done)
        return np.float32(max(float(by_time or 0), min(done / self._steps, 1.0)))

    def stepped(self, done: int, metrics: Mapping[str, jax.Array]) -> bool:
        """Return whether time or steps are over, or the run was told to end."""
        is_late = super().stepped(done, metrics)
        return is_late or done >= self._steps or self._ended()


class MeasuredPace:
    """A run of about `seconds`: the speed of its first steps decides how many there are.

    Unlike with a deadline, the number of steps is then fixed and stored, so a run that was
    interrupted and continues equals an undisturbed one.
    """

    def __init__(self, seconds: float, *, timed: int) -> None:
        self.seconds = seconds
        self.total: int | None = None
        self._timed = timed
        self._ends: list[float] = []

    def progress(self, done: int) -> np.float32 | None:
        """Return the ratio of the steps, 0 before their number is known."""
        if self.total is None:
            return np.float32(0)
        return np.float32(done / self.total)

    def stepped(self, done: int, metrics: Mapping[str, jax.Array]) -> bool:
        """Return whether all steps are done."""
        if self.total is None:
            # Steps are dispatched ahead of the device, so their ends must be waited for. The
            # first one starts the clock: it was compiled.
            jax.block_until_ready(metrics)
            self._ends.append(time.monotonic())
            elapsed = self._ends[-1] - self._ends[0]
            if len(self._ends) > self._timed or elapsed >= self.seconds:
                steps = self.seconds * (len(self._ends) - 1) / max(elapsed, 1e-9)
                self.total = max(done, round(steps))
        return self.total is not None and done >= self.total

    def numbers(self) -> dict[str, Any]:
        """Return the number of steps once it is known."""
        return {} if self.total is None else {"total_steps": self.total}

    def resume(self, row: Mapping[str, Any]) -> None:
        """Take the number of steps from the line of an earlier part."""
        self.total = row.get("total_steps")
