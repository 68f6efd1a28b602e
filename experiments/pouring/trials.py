"""Runs of the pouring task in batches: who chooses the actions, demonstrations of an expert, and
errors.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.sim.recorder import stack_trees
from experiments.pouring import physics, render
from experiments.pouring.physics import POUR, RETRACT, STAND, WAIT, Setup, State, Task
from experiments.values import Value

Array = npt.NDArray[Any]
SENSOR = render.SENSOR.name
FRAMES = 3  # of a segment
# the first moment of choice: a segment of the lifted cylinder is complete
START = STAND + FRAMES - 1


class Controller(Protocol):
    """Who chooses the actions of a batch of runs; `looks`: it is given the frames u8 (B, side,
    side, 3), else None.
    """

    looks: bool

    def begin(self, count: int) -> None:
        """Forget everything: `count` runs begin."""

    def act(self, frames: Array | None, state: State) -> Array:
        """Actions (B,) of this moment. Only an expert may look at the state."""


class Trials(NamedTuple):
    """What happened in B runs of up to S actions: `poured` (B,) g, `steps` (B,) taken, `choices`
    and `actions` (S, B), which differ only where a late hand went on, `mass` g, `tilt` degrees and
    `rate` g/s (S, B) before each action, and the `frames` u8 (S, F, side, side, 3) of those F runs,
    the first ones, that were filmed, or None.
    """

    poured: Array
    steps: Array
    choices: Array
    actions: Array
    mass: Array
    tilt: Array
    rate: Array
    frames: Array | None

    @property
    def taken(self) -> Array:
        """(S, B) bool: the moments before a run's end."""
        return np.arange(len(self.actions))[:, None] < self.steps


class Expert:
    """Sees the scales: pours, waits while much is under way (if `patient`), goes back just before
    the target.
    """

    looks = False

    def __init__(self, task: Task, *, patient: bool = True) -> None:
        self._task = task
        self._patient = patient

    def begin(self, count: int) -> None:
        """Nothing to forget."""

    def act(self, frames: Array | None, state: State) -> Array:
        """Actions (B,) from the mass, the flow and whether the cylinder has been on its way
        back.
        """
        mass, rate, tilt, highest = jax.device_get(
            (state.mass, state.rate, state.tilt, state.highest)
        )
        left = self._task.target - (self._task.beads - mass)
        back = (left <= 0.3 + 0.35 * rate) | (highest > tilt + 1e-6)
        return np.where(
            back, RETRACT, np.where((rate > 0.8 + 0.2 * left) & self._patient, WAIT, POUR)
        )


class Replay:
    """Does again what was done: `actions` (S, B)."""

    looks = False

    def __init__(self, actions: Array) -> None:
        self._actions = actions

    def begin(self, count: int) -> None:
        """Time is 0 again."""
        self._step = -1

    def act(self, frames: Array | None, state: State) -> Array:
        """Actions (B,) of this moment; the last ones for ever."""
        self._step += 1
        return self._actions[min(self._step, len(self._actions) - 1)]


def draw_runs(task: Task, seed: int, count: int) -> tuple[Setup, jax.Array]:
    """`count` runs drawn from `seed`: their stacked parameters and keys (count,).

    No run depends on the others.
    """
    setups = [
        physics.draw_setup(task, np.random.default_rng([seed % 2**63, number]))
        for number in range(count)
    ]
    keys = jax.vmap(partial(jax.random.fold_in, jax.random.key(seed)))(jnp.arange(count))
    return stack_trees(setups), keys


@partial(jax.jit, static_argnames=("task",))
def _begin(setups: Setup, keys: jax.Array, *, task: Task) -> State:
    return jax.vmap(lambda setup, key: physics.begin(setup, task, key))(setups, keys)


@partial(jax.jit, static_argnames=("task",))
def _advance(state: State, actions: jax.Array, setups: Setup, *, task: Task) -> State:
    return jax.vmap(lambda state, action, setup: physics.advance(state, action, setup, task))(
        state, actions, setups
    )


def hold(setups: Setup, *, side: int) -> render.Grasp:
    """The grasps of stacked runs, for images of `side` pixels."""
    render.prepare()
    return _hold(setups, side=side)


@partial(jax.jit, static_argnames=("side",))
def _hold(setups: Setup, *, side: int) -> render.Grasp:
    return jax.vmap(lambda setup: render.hold(setup, side)[0])(setups)


@partial(jax.jit, static_argnames=("task", "side"))
def look(state: State, setups: Setup, grasps: render.Grasp, *, task: Task, side: int) -> jax.Array:
    """The frames u8 (B, side, side, 3) of stacked runs at this moment."""

    def one(state: State, setup: Setup, grasp: render.Grasp) -> jax.Array:
        noise = jax.random.fold_in(state.key, physics.PIXELS)
        return render.image(grasp, setup, physics.load(state, setup, task), noise, side)

    return jax.vmap(one)(state, setups, grasps)


def run(
    task: Task,
    setups: Setup,
    keys: jax.Array,
    controller: Controller,
    *,
    side: int = 112,
    video: int = 0,
    late: Array | None = None,
    grasps: render.Grasp | None = None,
) -> Trials:
    """Run the batch to its end under `controller`; frames are drawn only if it looks at them, or to
    `video` runs.

    `video`: of so many runs, the first ones, the frames are kept.

    `grasps`: those of `hold` for these runs and `side`, where they are at hand. `late` (B,): a hand
    that goes on pouring for so many moments after the controller retracts, which then stays the
    choice. So demonstrations show what to do where the target is already passed.
    """
    drawn = controller.looks or video > 0
    if drawn and grasps is None:
        grasps = hold(setups, side=side)
    state = _begin(setups, keys, task=task)
    count = len(state.mass)
    controller.begin(count)
    history: list[tuple[Array, ...]] = []
    frames: list[Array] = []
    steps = np.zeros(count, np.int64)
    waited = np.zeros(count, np.int64)
    while not np.asarray(state.done).all():
        shown = np.asarray(look(state, setups, grasps, task=task, side=side)) if drawn else None
        choices = np.asarray(controller.act(shown if controller.looks else None, state), np.int32)
        if len(history) < START:
            choices = np.full_like(choices, WAIT)
        actions = choices
        if late is not None:
            choices = np.where(waited > 0, RETRACT, choices)
            waited += choices == RETRACT
            actions = np.where((choices == RETRACT) & (waited <= late), POUR, choices)
        history.append(
            (choices, actions, *jax.device_get((state.mass, jnp.rad2deg(state.tilt), state.rate)))
        )
        steps += ~np.asarray(state.done)
        if shown is not None and video:
            frames.append(shown[:video].copy())
        state = _advance(state, actions, setups, task=task)
    choices, actions, mass, tilt, rate = (np.stack(one) for one in zip(*history, strict=True))
    out = np.asarray(physics.poured(state, task))
    return Trials(
        out, steps, choices, actions, mass, tilt, rate, np.stack(frames) if video else None
    )


def error(poured: Array, target: float) -> Value:
    """The mean of |poured - target| over runs `poured` (n,) g, with a bootstrap interval (None for
    a single run).
    """
    wrong = np.abs(np.asarray(poured, np.float64) - target)
    return Value(float(wrong.mean()), *mean_interval(wrong, np.arange(len(wrong))))
