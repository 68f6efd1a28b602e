"""Touch scenes: surfaces, contact, optics and recordings of several sensors, from one seed."""

from types import ModuleType


def __getattr__(name: str) -> ModuleType:
    """Return the room `mujoco`, which is imported when it is first used: it needs an extra."""
    if name == "mujoco":
        import anytouch_jax.sim.mujoco as room

        return room
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
