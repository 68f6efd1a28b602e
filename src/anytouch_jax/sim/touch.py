"""One touch by a simulated sensor: from a height map and a pose to a picture, depth, shear and force."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.sim.contact.mechanics import Fidelity
from anytouch_jax.sim.recorder import SPACING, ClipInput, simulate_clip
from anytouch_jax.sim.sensing.own import find_sensor
from anytouch_jax.sim.sensing.sensors import Unit, identity_unit

FIELDS = ("displacement", "shear", "pressure")


class SimulatedTouch(NamedTuple):
    """Pictures u8 (B, h, w, 3), the gel's `background`, and fields of B touches at the picture's pixels.

    `depth` (B, h, w) is the gel's displacement in mm. `shear` (B, h, w, 2) is in mm along x and y of the picture.
    `pressure` (B, h, w) is in kPa, `force` (B, 3) in N along x, y and into the gel, `torque` (B,) in N mm.
    """

    image: Any
    background: Any
    depth: Any
    shear: Any
    pressure: Any
    force: Any
    torque: Any


def simulate_touch(
    height_map: Any, pose: Any, sensor: str = "digit", *, drag: Any = (0.0, 0.0, 0.0), size: int = 224,
    modulus: float = 1e6, friction: float = 0.6, fidelity: Fidelity = "fast", unit: Unit | None = None,
) -> SimulatedTouch:  # fmt: skip
    """Press a surface into the gel of a sensor, and return what the camera sees and the gel feels.

    `height_map` (H, W) is in mm, with 0.1 mm between pixels, its highest part nearest to the gel. `pose` (B, 4) is the
    touched place x and y in mm from the map's centre, the turn in rad, and the depth in mm. `drag` (B, 3) mm, mm and
    rad moves the object over the gel under the whole pressure. `modulus` kPa and `friction` are the object's. `unit`
    is a device of the sensor (`sensors.draw_unit`), by default the nominal one without markers. With fidelity "fast"
    all but the pictures can be differentiated with respect to pose and drag. Use it under jit. Raises UserError for a
    sensor without a camera.
    """
    kind = find_sensor(sensor)
    if kind.kind != "image":
        raise UserError(f"{sensor} has no camera; name a sensor that has one")
    refuse_forked()
    pose, relief = jnp.atleast_2d(jnp.asarray(pose, jnp.float32)), jnp.asarray(height_map, jnp.float32)
    if relief.ndim != 2 or pose.shape[1] != 4:
        raise UserError(
            f"a height map is (H, W) mm with {SPACING} mm between pixels and a pose (B, 4), not {relief.shape} and "
            f"{pose.shape}"
        )
    moves = jnp.broadcast_to(jnp.atleast_2d(jnp.asarray(drag, jnp.float32)), (len(pose), 3))
    device = identity_unit(kind) if unit is None else unit

    def one(pose: jax.Array, drag: jax.Array) -> SimulatedTouch:
        clip = ClipInput(
            relief, pose[:2], jnp.stack([0.0 * pose[0], 0.0 * pose[0], pose[2]]), drag[None],
            pose[3:], jnp.zeros(2), jnp.float32(modulus), jnp.float32(friction), device,
            jnp.zeros((1, 3, 3)), jnp.uint32(0),
        )  # fmt: skip
        out = simulate_clip(clip, sensor=kind, fidelity=fidelity, size=size, fields=FIELDS)
        force = jnp.stack([out.labels[name][-1] for name in ("force_x", "force_y", "force")])
        field = out.field[-1]
        return SimulatedTouch(
            out.image[-1], out.background, field[..., 0], field[..., 1:3], field[..., 3], force,
            out.labels["torque"][-1],
        )  # fmt: skip

    return jax.vmap(one)(pose, moves)


def ball(diameter: float, pixels: int = 200) -> np.ndarray:
    """Return the height map (pixels, pixels) mm of a ball, 0 at its top."""
    line = (np.arange(pixels) - (pixels - 1) / 2) * SPACING
    away, radius = np.hypot(*np.meshgrid(line, line)), diameter / 2
    return (np.sqrt(np.maximum(radius**2 - away**2, 0.0)) - radius).astype(np.float32)
