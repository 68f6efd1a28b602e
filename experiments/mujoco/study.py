"""Does touch help? Two tasks in MuJoCo, by imitation of a scripted oracle.

    python -m experiments.mujoco.study [hold] [align] --seeds 3

Four policies act: *blind* knows what a robot knows without touch, *touch* also has what is read
from its left pad's image, *shuffled* has that of another moment of another episode, and the
*oracle* acts by the true state. In *Hold* the force that the field decoder reads is given, in
*Align* the encoder's features.

A policy is a small network that is fitted to the oracle's actions. It learns in rounds: first from
the oracle, whose actions noise disturbs, then also from what the oracle would have done in the
states that the policy itself comes to (DAgger, Ross 2011).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro
from sklearn.decomposition import PCA
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import anytouch_jax as at
from experiments.command import run_script
from experiments.mujoco.tasks import SENSOR, TASKS, Array, Episodes, Task, sensor_of
from experiments.records import write_record

RESULTS = Path(__file__).parents[1] / "results" / "mujoco_tasks.jsonl"
KINDS = ("blind", "touch", "shuffled", "oracle")
PARTS = 64  # principal components, where more numbers than these are felt
# What acts by states (n, p), what is felt (n, E) and the oracle's actions (n,), which only the
# oracle takes.
Act = Callable[[Array, Array, Array], Array]
Look = Callable[[Episodes], Array]  # what the pads of episodes feel, (n, E)


@dataclass(frozen=True)
class Options:
    """Two tasks in MuJoCo: blind, touch, shuffled touch and oracle."""

    tasks: tyro.conf.Positional[tuple[Literal["hold", "align"], ...]] = ("hold", "align")
    seeds: int = 3  # One after the other, from `first` on.
    first: int = 0
    model: str = "anytouch-tiny"
    out: Path = RESULTS


class Play(NamedTuple):
    """What happened in episodes: N readings of n episodes."""

    states: Array  # (N, p)
    felt: Array  # (N, E)
    right: Array  # (N,) the oracle's actions
    cost: Array  # (n,)
    success: Array  # (n,) bool


class Recent:
    """Joins values (n, p) with those of the readings before, the first ones repeated."""

    def __init__(self, memory: int) -> None:
        self._memory = memory
        self._values: list[Array] = []

    def __call__(self, value: Array) -> Array:
        """Return the values (n, (memory + 1) p) of the last readings, this one last."""
        before = self._values or [value] * self._memory
        self._values = [*before, value][-self._memory - 1 :]
        return np.concatenate(self._values, 1)


class Eye:
    """What is read from the images of the left pads of episodes."""

    def __init__(self, task: Task, encoder: Any) -> None:
        self._task = task
        self._encoder = encoder
        self._touch: Any = None
        self._recent = Recent(task.memory)

    def start(self, episodes: Episodes) -> None:
        """Take the pads of new episodes."""
        self._touch = sensor_of(self._task, episodes)
        self._recent = Recent(self._task.memory)

    def look(self, episodes: Episodes) -> Array:
        """Return what the pads feel now, and felt at the readings before, (n, E)."""
        images = self._touch.read(episodes.datas).image
        background = self._touch.background
        if self._task.felt == "force":
            return self._recent(self._encoder.measure(images, background, SENSOR).force)
        frames = [self._encoder.preprocess(one, background) for one in images]
        return self._recent(self._encoder.encode_touch(np.stack(frames), SENSOR, pooling="both"))


def look_at_nothing(episodes: Episodes) -> Array:
    """Return what a blind policy feels."""
    return np.zeros((len(episodes.datas), 0))


def act_right(states: Array, felt: Array, right: Array) -> Array:
    """Return the oracle's actions."""
    return right


def disturbed(rng: np.random.Generator) -> Act:
    """Return an oracle that for some steps does something wrong."""

    def act(states: Array, felt: Array, right: Array) -> Array:
        size = np.abs(right).max() + 0.1
        drift = rng.normal(0, 0.7 * size, len(right)) * (rng.random(len(right)) < 0.35)
        action: Array = right + drift
        return action

    return act


def fitted(plays: list[Play], seed: int) -> Act:
    """Return a policy fitted to the oracle's actions."""
    states = np.concatenate([play.states for play in plays])
    felt = np.concatenate([play.felt for play in plays])
    scale = StandardScaler().fit(states)
    parts = make_pipeline(StandardScaler())
    if felt.shape[1] > PARTS:
        parts = make_pipeline(StandardScaler(), PCA(PARTS, random_state=seed), StandardScaler())
    if felt.shape[1]:
        parts.fit(felt)

    def joined(states: Array, felt: Array) -> Array:
        known = parts.transform(felt) if felt.shape[1] else felt
        return np.concatenate([scale.transform(states), known], 1)

    network = MLPRegressor(
        hidden_layer_sizes=(64, 64),
        alpha=1e-2,
        early_stopping=True,
        max_iter=150,
        random_state=seed,
    ).fit(joined(states, felt), np.concatenate([play.right for play in plays]))

    def act(states: Array, felt: Array, right: Array) -> Array:
        action: Array = network.predict(joined(states, felt))
        return action

    return act


def play(
    task: Task, eye: Eye, act: Act, look: Look, rng: np.random.Generator, count: int, steps: int
) -> Play:
    """Return what happens in `count` episodes of some steps."""
    moments = []
    ends = []
    for first in range(0, count, task.at_once):
        episodes = task.begin(rng, min(task.at_once, count - first))
        eye.start(episodes)  # the pads are as soft for a policy that does not look
        recent = Recent(task.memory)
        for step in range(steps):
            state = recent(task.state(episodes, step))
            moment = (state, look(episodes), task.oracle(episodes, step))
            moments.append(moment)
            task.act(episodes, step, act(*moment))
        ends.append((task.cost(episodes), task.success(episodes)))
    states, felt, right = (np.concatenate(one) for one in zip(*moments, strict=True))
    cost, success = (np.concatenate(one) for one in zip(*ends, strict=True))
    return Play(states, felt, right, cost, success)


def learned(task: Task, eye: Eye, shown: Play, look: Look, seed: int) -> tuple[Act, list[Play]]:
    """Return a policy that looks like this, and what it has learned from.

    It is fitted to what the oracle has shown. In further rounds it acts itself, and is fitted to
    all that the oracle would have done.
    """
    rng = np.random.default_rng([seed, 5])
    plays = [shown]
    act = fitted(plays, seed)
    for _ in range(task.rounds - 1):
        count = task.demonstrations // task.rounds
        plays.append(play(task, eye, act, look, rng, count, task.shown))
        act = fitted(plays, seed)
    return act, plays


def study(task: Task, eye: Eye, options: Options, seed: int) -> None:
    """Fit and test all policies of a task with one seed, and write their records."""
    rng = np.random.default_rng([seed, 1])
    count = task.demonstrations // task.rounds
    shown = play(task, eye, disturbed(rng), eye.look, rng, count, task.shown)
    touch, plays = learned(task, eye, shown, eye.look, seed)
    felt = np.concatenate([one.felt for one in plays])
    mix = np.random.default_rng([seed, 3])

    def look_elsewhere(episodes: Episodes) -> Array:
        return felt[mix.integers(len(felt), size=len(episodes.datas))]

    mixed = shown._replace(felt=shown.felt[mix.permutation(len(shown.felt))])
    shuffled, _ = learned(task, eye, mixed, look_elsewhere, seed)
    unfelt = shown._replace(felt=shown.felt[:, :0])
    blind, _ = learned(task, eye, unfelt, look_at_nothing, seed)
    policies: dict[str, tuple[Act, Look]] = {
        "blind": (blind, look_at_nothing),
        "touch": (touch, eye.look),
        "shuffled": (shuffled, look_elsewhere),
        "oracle": (act_right, look_at_nothing),
    }
    for kind in KINDS:
        rng = np.random.default_rng([seed, 2])  # the same episodes for all
        test = play(task, eye, *policies[kind], rng, task.tested, task.steps)
        key = f"{task.name}, {kind}, {seed}"
        record = {
            "task": task.name,
            "policy": kind,
            "seed": seed,
            "cost": test.cost.round(4).tolist(),
            "success": test.success.astype(int).tolist(),
            "model": options.model,
            "demonstrations": task.demonstrations,
        }
        write_record(options.out, key, record)
        print(f"{key}: cost {test.cost.mean():.2f}, success {test.success.mean():.0%}", flush=True)


def run(options: Options) -> int:
    """Run the study."""
    encoder = at.load_encoder(options.model)
    for name in options.tasks:
        for seed in range(options.first, options.first + options.seeds):
            study(TASKS[name], Eye(TASKS[name], encoder), options, seed)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_script(Options, run))
