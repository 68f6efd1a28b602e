"""Touch in MuJoCo scenes: the camera's image and the gel's fields of a pad, as the scene moves.

`TouchSensor` reads pads, `TouchObservation` adds them to a gymnasium environment, and
`LeRobotWriter` writes them as a data set. They need the extra `mujoco`.
"""

from typing import Any

from anytouch_jax.doors import Door, enter

_HOMES = {
    "TouchSensor": "sensor",
    "nominal_unit": "sensor",
    "TouchReading": "gel",
    "TouchObservation": "observation",
    "LeRobotWriter": "lerobot",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Return a public name, imported when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return enter(Door(f"sim.mujoco.{_HOMES[name]}:{name}", "mujoco"))


def __dir__() -> list[str]:
    return __all__
