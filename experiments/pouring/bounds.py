"""Bounds of pouring by touch: policies with the same MLP that get the time, or the load on the
gel.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from experiments.pouring import physics, policy
from experiments.pouring.physics import ACTIONS, WAIT, Setup, State, Task
from experiments.pouring.trials import FRAMES, START, Controller, Expert, Trials, draw_runs, run

Array = npt.NDArray[Any]


def blind_inputs(actions: Array) -> Array:
    """Time and counts of the own actions so far (S, B, 4), from actions (S, B); nothing of the run
    itself.
    """
    chosen = np.eye(len(ACTIONS), dtype=np.float32)[actions]
    before = np.cumsum(chosen, 0) - chosen
    time = np.broadcast_to(
        np.arange(len(actions), dtype=np.float32)[:, None, None], (*actions.shape, 1)
    )
    return np.concatenate([time, before], -1) / 100


class Blind:
    """A policy with the same MLP that gets only the time and its own actions."""

    looks = False

    def __init__(self, head: policy.Head) -> None:
        self._head = head

    def begin(self, count: int) -> None:
        """Time is 0 again."""
        self._x: Array = np.zeros((count, 1 + len(ACTIONS)), np.float32)

    def act(self, frames: Array | None, state: State) -> Array:
        """Actions (B,) from the time and the counts of its actions."""
        chosen = policy.log_probabilities(self._head, self._x).argmax(-1)
        chosen = np.where(self._x[:, 0] * 100 < START - 0.5, WAIT, chosen)
        self._x = (
            self._x
            + np.concatenate([np.ones((len(chosen), 1)), np.eye(len(ACTIONS))[chosen]], 1) / 100
        )
        self._x = self._x.astype(np.float32)
        return chosen


def learn_blind(task: Task, seed: int, count: int, learning: policy.Learning) -> Blind:
    """A blind policy from `count` demonstrations of an expert that never waits.

    To wait is to answer what is seen: a blind policy would learn that it has poured too early to
    stop, as it never waited.
    """
    trials = policy.demonstrate(task, seed, count, side=None, patient=False, chunk=count)
    return Blind(imitate_plainly(trials, blind_inputs(trials.actions)[START:], learning))


def imitate_plainly(trials: Trials, x: Array, learning: policy.Learning) -> policy.Head:
    """Return the MLP over inputs x (S - START, B, d), trained without dropout: they are few and
    without noise.
    """
    return policy.imitate(*policy.moments(trials, x), replace(learning, dropout=0.0))[0]


@partial(jax.jit, static_argnames=("task",))
def _loads(state: State, setups: Setup, *, task: Task) -> jax.Array:
    """Shear and normal force N, and a tenth of the twist N mm, on the gels of stacked runs (B,
    4).
    """

    def one(state: State, setup: Setup) -> jax.Array:
        load = physics.load(state, setup, task)
        return jnp.stack([*load.shear, load.twist / 10, load.normal])

    return jax.vmap(one)(state, setups)


class Scales:
    """Notes the load of stacked runs `setups` while another controller acts, or acts on it with the
    MLP `head`.

    It gets the load on the gel, with blows and jolts, and no image. No touch of this gel holds
    more information.
    """

    looks = False

    def __init__(self, task: Task, setups: Setup, inner: Controller | policy.Head) -> None:
        self._task = task
        self._setups = setups
        self._inner = inner

    def begin(self, count: int) -> None:
        """Forget the loads of the last runs."""
        self.loads: list[Array] = []
        if not isinstance(self._inner, policy.Head):
            self._inner.begin(count)

    def segments(self) -> Array:
        """The mean loads (S, B, 4) of the last FRAMES moments, from the third moment on."""
        return np.stack(
            [np.mean(self.loads[i : i + FRAMES], 0) for i in range(len(self.loads) - FRAMES + 1)]
        )

    def act(self, frames: Array | None, state: State) -> Array:
        """Actions (B,) of this moment."""
        self.loads.append(np.asarray(_loads(state, self._setups, task=self._task)))
        if not isinstance(self._inner, policy.Head):
            return self._inner.act(frames, state)
        if len(self.loads) <= START:
            return np.full(len(state.mass), WAIT)
        z = self.segments()
        x = policy.inputs(
            z[-1], z[max(len(z) - 1 - policy.LAG, policy.LIFTED)], z[policy.LIFTED], z[0]
        )
        return policy.log_probabilities(self._inner, x).argmax(-1)


def learn_loads(task: Task, seed: int, count: int, learning: policy.Learning) -> policy.Head:
    """The MLP over the loads themselves, from the demonstrations that `policy.demonstrate` gives
    for the same seed.
    """
    setups, keys = draw_runs(task, seed, count)
    noting = Scales(task, setups, Expert(task))
    trials = run(task, setups, keys, noting, late=policy.late_hands(seed, count))
    return imitate_plainly(trials, policy.input_table(noting.segments()), learning)
