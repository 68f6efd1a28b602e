"""Touch in the observations of a gymnasium environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Protocol

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from anytouch_jax.errors import UserError
from anytouch_jax.sim.mujoco.gel import TouchReading
from anytouch_jax.sim.mujoco.sensor import TouchSensor

What = Literal["image", "features", "fields", "force"]
Array = npt.NDArray[Any]


class EncodesTouch(Protocol):
    """What is asked of an encoder (`load_encoder`)."""

    def preprocess(self, frame: Array, background: Array | None) -> Array: ...

    def encode_touch(self, frames: Array, sensor: Any) -> Array: ...


class TouchObservation(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Adds what touch sensors read to the observations of a MuJoCo environment.

    Observations become a dict. Those that were none are under `state`. Those of a pad are under
    `touch.SITE.image` u8 (H, W, 3), `touch.SITE.features` (E,), `touch.SITE.fields` (H, W, 4),
    which are depth mm, shear x and y mm and pressure kPa, and `touch.SITE.force` (3,) N.

    Args:
        env: An environment with `model` and `data` of MuJoCo.
        sensors: Its touch sensors, each of one or several pads.
        what: Which of image, features, fields and force to add.
        encoder: For features, as of `load_encoder`.

    Raises:
        UserError: For an environment without MuJoCo, for an unknown word, for features without an
            encoder, and for a site that two sensors have.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        sensors: TouchSensor | Sequence[TouchSensor],
        *,
        what: Sequence[What] = ("image",),
        encoder: EncodesTouch | None = None,
    ) -> None:
        super().__init__(env)
        if not hasattr(env.unwrapped, "data"):
            raise UserError(f"{env} has no `data` of MuJoCo, so it has no scene to touch")
        for word in what:
            if word not in ("image", "features", "fields", "force"):
                raise UserError(f"what holds image, features, fields and force, not {word!r}")
        if "features" in what and encoder is None:
            raise UserError(
                "features need an encoder: TouchObservation(..., encoder=load_encoder())"
            )
        self._sensors = (sensors,) if isinstance(sensors, TouchSensor) else tuple(sensors)
        self._what = tuple(what)
        self._encoder = encoder
        sites = [site for sensor in self._sensors for site in sensor.sites]
        if twice := [site for site in sites if sites.count(site) > 1]:
            raise UserError(f"two sensors are on the site {twice[0]}")
        self._is_dict = isinstance(env.observation_space, spaces.Dict)
        own = env.observation_space
        known: dict[str, spaces.Space[Any]] = (
            dict(own.spaces) if isinstance(own, spaces.Dict) else {"state": own}
        )
        self.observation_space = spaces.Dict(known | self._spaces())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, and forget what has touched the pads."""
        for sensor in self._sensors:
            sensor.reset()
        return super().reset(seed=seed, options=options)

    def observation(self, observation: Any) -> dict[str, Any]:
        """Return an observation with what the sensors read."""
        result = dict(observation) if self._is_dict else {"state": observation}
        data = self.env.unwrapped.data  # type: ignore[attr-defined]
        for sensor in self._sensors:
            reading = sensor.read(data)
            for place, site in enumerate(sensor.sites):
                one = _pad(reading, place) if np.ndim(reading.touched) else reading
                result |= {
                    f"touch.{site}.{word}": self._value(word, one, sensor) for word in self._what
                }
        return result

    def _value(self, word: What, reading: TouchReading, sensor: TouchSensor) -> Array:
        """Return one value of an observation."""
        if word == "image":
            return np.asarray(reading.image)
        if word == "force":
            return np.asarray(reading.force, np.float32)
        if word == "fields":
            parts = [np.asarray(one) for one in (reading.depth, reading.shear, reading.pressure)]
            return np.concatenate([parts[0][..., None], parts[1], parts[2][..., None]], -1)
        assert self._encoder is not None
        frame = self._encoder.preprocess(np.asarray(reading.image), np.asarray(reading.background))
        encoded = self._encoder.encode_touch(frame[None], sensor.sensor.name)
        return np.asarray(encoded[0], np.float32)

    def _spaces(self) -> dict[str, spaces.Space[Any]]:
        """Return the spaces of what is added."""
        found: dict[str, spaces.Space[Any]] = {}
        for sensor in self._sensors:
            height, width = sensor.background.shape[:2]
            for site in sensor.sites:
                for word in self._what:
                    found[f"touch.{site}.{word}"] = self._space(word, (height, width), sensor)
        return found

    def _space(self, word: What, size: tuple[int, int], sensor: TouchSensor) -> spaces.Space[Any]:
        """Return the space of one value."""
        if word == "image":
            return spaces.Box(0, 255, (*size, 3), np.uint8)
        shape: tuple[int, ...] = (3,)
        if word == "fields":
            shape = (*size, 4)
        elif word == "features":
            assert self._encoder is not None
            frame = self._encoder.preprocess(sensor.background, sensor.background)
            shape = np.shape(self._encoder.encode_touch(frame[None], sensor.sensor.name))[1:]
        return spaces.Box(-np.inf, np.inf, shape, np.float32)


def _pad(reading: TouchReading, place: int) -> TouchReading:
    """Return the reading of one of several pads."""
    return TouchReading(*(value[place] for value in reading))
