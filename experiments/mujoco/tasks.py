"""Two tasks of a gripper that only touch can answer, and what acts in them.

*Hold*: grasp a can of unknown mass and friction, lift it, and press no harder than it needs.
*Align*: turn a held key by the wrist until it lies level, from an angle that only the gel shows.

Episodes run side by side. Their pads are read as one batch.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import mujoco
import numpy as np

from anytouch_jax.sim.mujoco import TouchSensor, nominal_unit
from experiments.mujoco.gripper import MM, gripper_scene

SENSOR = "gelsight_mini"
SIZE = 112
GRAVITY = 9.81
Array = np.ndarray


class Episodes(NamedTuple):
    """Episodes that run side by side."""

    models: list[Any]
    datas: list[Any]
    hidden: Array  # (n, k) what the oracle knows


class Task(NamedTuple):
    """A task: how it starts, moves, is seen and is judged."""

    name: str
    steps: int
    shown: int  # steps of a demonstration
    felt: Literal["force", "features"]  # what is read from a pad's image
    memory: int  # readings before, which a policy also knows
    rounds: int  # of demonstrations: in the first the oracle acts, then the policy itself
    demonstrations: int  # episodes of all rounds
    tested: int  # episodes of the test
    at_once: int  # episodes side by side
    begin: Callable[[np.random.Generator, int], Episodes]
    state: Callable[[Episodes, int], Array]  # (n, p) what a robot knows without touch
    oracle: Callable[[Episodes, int], Array]  # (n,) the right action
    act: Callable[[Episodes, int, Array], None]
    cost: Callable[[Episodes], Array]  # (n,)
    success: Callable[[Episodes], Array]  # (n,) bool


# --- Hold

CAN = (
    '<geom name="held" type="cylinder" size=".011 .02" mass=".08" friction=".6" contype="3" '
    'conaffinity="3" rgba=".85 .35 .2 1"/>'
)
HOLD_STEPS = 20  # of 100 ms
LIFTED = 5  # the step at which the gripper goes up
RISES = 7  # steps that it takes
CHANGE = 0.5  # of the logarithm of the grip in a step, at most
UP = 0.04  # m
LEAST, MOST = 0.1, 6.0  # N of grip
SAFE = 1.3  # the oracle's grip over what the can needs
DROPPED = 4.0  # the cost of a drop, in grips that would do


def needed(episodes: Episodes) -> Array:
    """Return the grip N of each can that just holds it: m g / (2 mu)."""
    mass, friction = episodes.hidden.T
    grip: Array = mass * GRAVITY / (2 * friction)
    return grip


def begin_hold(rng: np.random.Generator, count: int) -> Episodes:
    """Return cans of 25 to 200 g with a friction of 0.35 to 0.9, gripped too hard or too little."""
    first = mujoco.MjModel.from_xml_string(gripper_scene(SENSOR, CAN, half=11.0))
    mass = np.exp(rng.uniform(np.log(0.025), np.log(0.2), count))
    friction = np.exp(rng.uniform(np.log(0.35), np.log(0.9), count))
    models = []
    datas = []
    for one_mass, one_friction in zip(mass, friction, strict=True):
        model = copy.copy(first)
        can = model.geom("held").id
        body = model.body("object").id
        scale = one_mass / model.body_mass[body]
        model.body_mass[body] *= scale
        model.body_inertia[body] *= scale
        model.geom_friction[can, 0] = one_friction
        data = mujoco.MjData(model)
        data.ctrl[2:] = np.exp(rng.uniform(np.log(0.3), np.log(3.0)))
        models.append(model)
        datas.append(data)
    return Episodes(models, datas, np.stack([mass, friction], 1))


def _grip(episodes: Episodes) -> Array:
    return np.array([data.ctrl[2] for data in episodes.datas])


def hold_state(episodes: Episodes, step: int) -> Array:
    """Return the logarithm of the grip, how far the gripper is up, and the time."""
    count = len(episodes.datas)
    part = np.full(count, step / HOLD_STEPS)
    return np.stack([np.log(_grip(episodes)), np.full(count, _height(step) / UP), part], 1)


def _height(step: float) -> float:
    """Return the height m of the gripper, with no jump of its speed."""
    part = float(np.clip((step - LIFTED) / RISES, 0, 1))
    return UP * part**2 * (3 - 2 * part)


def hold_oracle(episodes: Episodes, step: int) -> Array:
    """Return the change of the logarithm of the grip towards what the can needs."""
    change: Array = np.clip(np.log(SAFE * needed(episodes) / _grip(episodes)), -CHANGE, CHANGE)
    return change


def hold_act(episodes: Episodes, step: int, action: Array) -> None:
    """Change the grips, and move on by 100 ms."""
    grip = np.clip(_grip(episodes) * np.exp(np.clip(action, -CHANGE, CHANGE)), LEAST, MOST)
    for model, data, one in zip(episodes.models, episodes.datas, grip, strict=True):
        data.ctrl[2:] = one
        for part in range(10):
            data.ctrl[0] = _height(step + part / 10)
            mujoco.mj_step(model, data, 5)


def hold_success(episodes: Episodes) -> Array:
    """Return whether each can is still within 15 mm of the pads' middle."""
    away = [data.body("object").xpos[2] - data.body("left").xpos[2] for data in episodes.datas]
    return np.abs(np.array(away)) < 0.015


def hold_cost(episodes: Episodes) -> Array:
    """Return the last grip over what the can needs, DROPPED for a drop."""
    excess = np.minimum(_grip(episodes) / needed(episodes), DROPPED)
    return np.where(hold_success(episodes), excess, DROPPED)


# --- Align

KEY = (
    '<geom name="held" type="box" size=".004 .016 .003" mass=".008" friction="1" contype="3" '
    'conaffinity="3" rgba=".8 .7 .2 1"/>'
)
ALIGN_STEPS = 10
WIDEST = np.deg2rad(25)
SPEED = np.deg2rad(6)  # at most in a step
LEVEL = 2.0  # degrees that are level


def begin_align(rng: np.random.Generator, count: int) -> Episodes:
    """Return keys that lie in the gripper at an angle and a place which only the gel shows."""
    model = mujoco.MjModel.from_xml_string(gripper_scene(SENSOR, KEY, half=4.0, gravity=0.0))
    start = model.jnt_qposadr[model.joint("object").id]
    angle = rng.uniform(-WIDEST, WIDEST, count)
    wrist = rng.uniform(-WIDEST, WIDEST, count)
    datas = []
    for one, turn in zip(angle, wrist, strict=True):
        data = mujoco.MjData(model)
        data.qpos[model.jnt_qposadr[model.joint("wrist").id]] = turn
        data.qpos[start + 1 : start + 3] += rng.uniform(-2.5, 2.5, 2) * MM
        half = (one + turn) / 2
        data.qpos[start + 3 : start + 7] = np.cos(half), np.sin(half), 0, 0
        data.ctrl[0] = UP
        data.qpos[model.jnt_qposadr[model.joint("lift").id]] = UP
        data.qpos[start + 2] += UP
        data.ctrl[1] = turn
        data.ctrl[2:] = rng.uniform(2.0, 4.0)
        mujoco.mj_step(model, data, 150)
        datas.append(data)
    return Episodes([model] * count, datas, angle[:, None])


def _level(episodes: Episodes) -> Array:
    """Return the angle (n,) rad of each key to the level."""
    turns = np.array([data.body("object").xmat for data in episodes.datas])
    angle: Array = np.arctan2(turns[:, 7], turns[:, 4])
    return angle


def _wrist(episodes: Episodes) -> Array:
    return np.array([data.ctrl[1] for data in episodes.datas])


def align_state(episodes: Episodes, step: int) -> Array:
    """Return the angle of the wrist."""
    return _wrist(episodes)[:, None]


def align_oracle(episodes: Episodes, step: int) -> Array:
    """Return the turn of the wrist, in units of the fastest one, that makes a key level."""
    turn: Array = np.clip(-_level(episodes) / SPEED, -1, 1)
    return turn


def align_act(episodes: Episodes, step: int, action: Array) -> None:
    """Turn the wrists, and move on by 100 ms."""
    wrist = _wrist(episodes) + np.clip(action, -1, 1) * SPEED
    for model, data, one in zip(episodes.models, episodes.datas, wrist, strict=True):
        data.ctrl[1] = one
        mujoco.mj_step(model, data, 50)


def align_cost(episodes: Episodes) -> Array:
    """Return how far each key is from level, in degrees."""
    off: Array = np.abs(np.rad2deg(_level(episodes)))
    return off


def align_success(episodes: Episodes) -> Array:
    """Return whether each key is level."""
    level: Array = align_cost(episodes) < LEVEL
    return level


TASKS = {
    "hold": Task(
        name="hold",
        steps=HOLD_STEPS,
        shown=HOLD_STEPS,
        felt="force",
        memory=3,  # a slip shows in how the force changes
        rounds=4,
        demonstrations=128,
        tested=64,
        at_once=32,
        begin=begin_hold,
        state=hold_state,
        oracle=hold_oracle,
        act=hold_act,
        cost=hold_cost,
        success=hold_success,
    ),
    "align": Task(
        name="align",
        steps=ALIGN_STEPS,
        shown=3,  # the imprint does not change as the wrist turns: other keys show more
        felt="features",
        memory=0,
        rounds=1,
        demonstrations=1280,
        tested=48,
        at_once=24,
        begin=begin_align,
        state=align_state,
        oracle=align_oracle,
        act=align_act,
        cost=align_cost,
        success=align_success,
    ),
}


def sensor_of(task: Task, episodes: Episodes) -> TouchSensor:
    """Return the sensor of the left pad of all episodes, with dots where shear matters."""
    unit = nominal_unit(SENSOR, dots=task.name == "hold")
    first, *others = episodes.models
    touch = TouchSensor(first, "left_pad", SENSOR, size=SIZE, unit=unit)
    for model in others:  # the pads of all scenes are as soft
        for name in ("geom_solref", "geom_solimp", "geom_solmix"):
            getattr(model, name)[:] = getattr(first, name)
    return touch
