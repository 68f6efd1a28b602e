"""The study of two tasks in MuJoCo: who learns from what, without MuJoCo and its images."""

import json

import numpy as np
import pytest

pytest.importorskip("mujoco")

from experiments.mujoco import study
from experiments.mujoco.tasks import Episodes, Task

STEPS = 6


class World:
    """Numbers that shall become those that only touch knows, and what was done to them."""

    def __init__(self):
        self.began = 0

    def begin(self, rng, count):
        self.began += count
        self.step = 0
        return Episodes([None] * count, [np.zeros(1) for _ in range(count)], rng.normal(size=count))

    def at(self, episodes):
        return np.concatenate(episodes.datas)

    def act(self, episodes, step, action):
        for data, one in zip(episodes.datas, action, strict=True):
            data += one

    def cost(self, episodes):
        return np.abs(self.at(episodes) - episodes.hidden)

    def task(self, **changes):
        return Task(
            name="reach",
            steps=STEPS,
            shown=STEPS,
            felt="force",
            memory=1,
            rounds=2,
            demonstrations=80,
            tested=40,
            at_once=20,
            begin=self.begin,
            state=lambda episodes, step: self.at(episodes)[:, None],
            oracle=lambda episodes, step: 0.5 * (episodes.hidden - self.at(episodes)),
            act=self.act,
            cost=self.cost,
            success=lambda episodes: self.cost(episodes) < 0.2,
        )._replace(**changes)


class Eye:
    """Feels what the hidden number is."""

    def __init__(self):
        self.seen = 0

    def start(self, episodes):
        pass

    def look(self, episodes):
        self.seen += len(episodes.datas)
        return episodes.hidden[:, None]


def test_touch_learns_what_blind_and_shuffled_cannot(tmp_path):
    world = World()
    eye = Eye()
    options = study.Options(out=tmp_path / "out.jsonl")
    study.study(world.task(), eye, options, 0)
    records = [json.loads(line) for line in options.out.read_text().splitlines()]
    cost = {one["policy"]: np.mean(one["cost"]) for one in records}
    assert set(cost) == set(study.KINDS)
    assert cost["oracle"] < cost["touch"] < 0.4
    assert min(cost["blind"], cost["shuffled"]) > 0.5
    # The oracle's demonstrations are shared. A second round and the test are each policy's own.
    assert world.began == 40 + 3 * 40 + 4 * 40
    assert eye.seen == STEPS * (80 + 40)


def test_later_rounds_show_where_the_policy_itself_goes(monkeypatch):
    """A policy that stays is told again and again what would have been right there."""
    learned_from = []

    def stays(plays, seed):
        learned_from.append(len(plays))
        return lambda states, felt, right: np.zeros(len(states))

    monkeypatch.setattr(study, "fitted", stays)
    world = World()
    eye = Eye()
    task = world.task(rounds=3, demonstrations=180)
    rng = np.random.default_rng(0)
    shown = study.play(task, eye, study.act_right, eye.look, rng, 20, STEPS)
    assert np.abs(shown.states).max() > 0.5
    _, plays = study.learned(task, eye, shown, eye.look, 0)
    assert learned_from == [1, 2, 3]
    for play in plays[1:]:
        assert len(play.right) == 60 * STEPS and not play.states.any()
        np.testing.assert_allclose(play.right, play.felt[:, -1] / 2)


def test_a_memory_begins_with_the_first_value_repeated():
    recent = study.Recent(2)
    values = [recent(np.full((1, 1), number)).ravel().tolist() for number in range(5)]
    assert values == [[0, 0, 0], [0, 0, 1], [0, 1, 2], [1, 2, 3], [2, 3, 4]]
