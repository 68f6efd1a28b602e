"""Does touch help? Two tasks in MuJoCo, by behaviour cloning from a scripted oracle.

    python -m experiments.mujoco.study [hold] [align] --seeds 3

Four policies act: *blind* knows what a robot knows without touch, *touch* also has the features of
its left pad's picture, *shuffled* has those of another moment of another episode, and the *oracle*
acts by the true state. A policy is a small network that is fitted to the oracle's actions, in
states that noise has moved away from the oracle's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

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
AT_ONCE = 24  # episodes side by side
PARTS = 64  # principal components of the features
Act = Callable[[Array, Array], Array]  # state (n, p) and features (n, E) to actions (n,)


@dataclass(frozen=True)
class Options:
    """Two tasks in MuJoCo: blind, touch, shuffled touch and oracle."""

    tasks: tyro.conf.Positional[tuple[Literal["hold", "align"], ...]] = ("hold", "align")
    seeds: int = 3
    readings: int = 3840  # of all demonstrations of a seed
    episodes: int = 48  # of the test
    model: str = "anytouch-tiny"
    out: Path = RESULTS


class Eye:
    """Features of the left pads of episodes."""

    def __init__(self, task: Task, encoder: Any) -> None:
        self._task = task
        self._encoder = encoder
        self._touch: Any = None

    def start(self, episodes: Episodes) -> None:
        """Take the pads of new episodes."""
        self._touch = sensor_of(self._task, episodes)

    def features(self, episodes: Episodes) -> Array:
        """Return features (n, E) of what the pads feel now."""
        reading = self._touch.read(episodes.datas)
        frames = [self._encoder.preprocess(one, self._touch.background) for one in reading.image]
        encoded: Array = self._encoder.encode_touch(np.stack(frames), SENSOR, pooling="both")
        return encoded


def demonstrate(
    task: Task, eye: Eye, rng: np.random.Generator, count: int
) -> tuple[Array, Array, Array]:
    """Return states, features and the oracle's actions of demonstrations.

    What is done is the oracle's action with noise, or for some steps a wrong one, so that the
    policy sees the states that its own mistakes lead to.
    """
    states = []
    features = []
    actions = []
    for first in range(0, count, AT_ONCE):
        episodes = task.begin(rng, min(AT_ONCE, count - first))
        eye.start(episodes)
        for step in range(task.shown):
            right = task.oracle(episodes, step)
            states.append(task.state(episodes, step))
            features.append(eye.features(episodes))
            actions.append(right)
            size = np.abs(right).max() + 0.1
            drift = rng.normal(0, 0.7 * size, len(right)) * (rng.random(len(right)) < 0.35)
            task.act(episodes, step, right + drift)
    return np.concatenate(states), np.concatenate(features), np.concatenate(actions)


def fitted(states: Array, features: Array | None, actions: Array, seed: int) -> Act:
    """Return a policy fitted to the oracle's actions, of states alone or with features."""
    scale = StandardScaler().fit(states)
    parts = None
    inputs = scale.transform(states)
    if features is not None:
        parts = make_pipeline(StandardScaler(), PCA(PARTS, random_state=seed), StandardScaler())
        inputs = np.concatenate([inputs, parts.fit_transform(features)], 1)
    network = MLPRegressor(
        hidden_layer_sizes=(64, 64),
        alpha=1e-2,
        early_stopping=True,
        max_iter=150,
        random_state=seed,
    ).fit(inputs, actions)

    def act(states: Array, features: Array) -> Array:
        given = scale.transform(states)
        if parts is not None:
            given = np.concatenate([given, parts.transform(features)], 1)
        action: Array = network.predict(given)
        return action

    return act


def tested(
    task: Task,
    act: Act | None,
    look: Callable[[Episodes], Array] | None,
    start: Callable[[Episodes], Any],
    rng: np.random.Generator,
    count: int,
) -> tuple[Array, Array]:
    """Return costs and successes (count,) of a policy, of the oracle if there is none.

    `look` returns features, if the policy has any.
    """
    costs = []
    good = []
    for first in range(0, count, AT_ONCE):
        episodes = task.begin(rng, min(AT_ONCE, count - first))
        start(episodes)
        for step in range(task.steps):
            if act is None:
                action = task.oracle(episodes, step)
            else:
                seen = np.zeros((len(episodes.datas), 0)) if look is None else look(episodes)
                action = act(task.state(episodes, step), seen)
            task.act(episodes, step, action)
        costs.append(task.cost(episodes))
        good.append(task.success(episodes))
    return np.concatenate(costs), np.concatenate(good)


def study(task: Task, encoder: Any, options: Options, seed: int) -> None:
    """Fit and test all policies of a task with one seed, and write their records."""
    eye = Eye(task, encoder)
    states, features, actions = demonstrate(
        task, eye, np.random.default_rng([seed, 1]), options.readings // task.shown
    )
    mix = np.random.default_rng([seed, 3])
    shuffled = features[mix.permutation(len(features))]

    def any_moment(episodes: Episodes) -> Array:
        return features[mix.integers(len(features), size=len(episodes.datas))]

    def act_of(kind: str) -> Act | None:
        given = {"blind": None, "touch": features, "shuffled": shuffled}
        return None if kind == "oracle" else fitted(states, given[kind], actions, seed)

    looks = {"blind": None, "touch": eye.features, "shuffled": any_moment, "oracle": None}
    for kind in KINDS:
        rng = np.random.default_rng([seed, 2])  # the same episodes for all
        # The pads are as soft for a policy that does not look.
        cost, good = tested(task, act_of(kind), looks[kind], eye.start, rng, options.episodes)
        key = f"{task.name}, {kind}, {seed}"
        record = {
            "task": task.name,
            "policy": kind,
            "seed": seed,
            "cost": cost.round(4).tolist(),
            "success": good.astype(int).tolist(),
            "model": options.model,
            "demonstrations": options.readings // task.shown,
        }
        write_record(options.out, key, record)
        print(f"{key}: cost {cost.mean():.2f}, success {good.mean():.0%}", flush=True)


def run(options: Options) -> int:
    """Run the study."""
    encoder = at.load_encoder(options.model)
    for name in options.tasks:
        for seed in range(options.seeds):
            study(TASKS[name], encoder, options, seed)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_script(Options, run))
