"""Touch in the observations of a gymnasium environment."""

import numpy as np
import pytest
from refused import refused

mujoco = pytest.importorskip("mujoco")
gymnasium = pytest.importorskip("gymnasium")

from gymnasium import spaces  # noqa: E402
from gymnasium.utils.env_checker import check_env  # noqa: E402

from anytouch_jax.sim.mujoco import TouchObservation, TouchSensor  # noqa: E402
from experiments.mujoco.scenes import SHAPES, loaded, pressing_scene  # noqa: E402


class Press(gymnasium.Env):
    """Presses a ball with the force of the action."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Box(0, 1, (1,), np.float32)

    def __init__(self):
        self.model, self.data = loaded(pressing_scene(SHAPES["ball"], "digit"))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        return self.data.qpos[2:3].copy(), {}

    def step(self, action):
        self.data.qfrc_applied[2] = -action[0]
        mujoco.mj_step(self.model, self.data, 200)
        return self.data.qpos[2:3].copy(), 0.0, False, False, {}


class Encoder:
    """The mean colour, as an encoder."""

    def preprocess(self, frame, background):
        return frame.astype(np.float32) - background

    def encode_touch(self, frames, sensor):
        assert sensor == "digit"
        return frames.mean((1, 2))


def wrapped(**options):
    env = Press()
    return TouchObservation(env, TouchSensor(env.model, "pad", size=48), **options)


def test_an_environment_with_touch_is_one_of_gymnasium():
    what = ("image", "features", "fields", "force")
    env = wrapped(what=what, encoder=Encoder())
    first, _ = env.reset(seed=1)
    assert set(first) == {"state", *(f"touch.pad.{one}" for one in what)}
    assert not first["touch.pad.force"].any()
    for _ in range(2):
        seen, *_ = env.step(np.array([0.5], np.float32))
    assert env.observation_space.contains(seen)
    np.testing.assert_allclose(seen["touch.pad.force"][2], 0.5, rtol=0.05)
    assert seen["touch.pad.fields"][..., 0].max() > 0.1
    assert abs(seen["touch.pad.features"]).max() > abs(first["touch.pad.features"]).max()
    again, _ = env.reset(seed=1)
    np.testing.assert_array_equal(again["touch.pad.image"], first["touch.pad.image"])
    with pytest.warns(UserWarning):
        check_env(env, skip_render_check=True)


def test_mistakes_are_told():
    refused("not 'smell'", wrapped, what=("smell",))
    refused("need an encoder", wrapped, what=("features",))
    env = Press()
    touch = TouchSensor(env.model, "pad", size=48)
    refused("two sensors are on the site pad", TouchObservation, env, [touch, touch])
