"""One reading of a gel: a pure function of a height map, a load, a motion, the state and a key.

A rigid-body simulator knows how hard an object presses and how it moves, but not how a gel gives
way. So the depth is solved such that the gel's pressure sums to the simulator's normal force, and
the shear such that its traction sums to the simulator's friction, as far as friction can hold.
`GelState` carries what earlier motion has left, so a scan over readings is a history.

Everything here works under jit and vmap, and knows no simulator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from anytouch_jax.sim.contact import mechanics, shear
from anytouch_jax.sim.contact.mechanics import KPA_MM2, Fidelity, Gel, PressResult
from anytouch_jax.sim.draws import Leaf
from anytouch_jax.sim.recorder import solve_grid
from anytouch_jax.sim.sensing import optics
from anytouch_jax.sim.sensing.sensors import Sensor, Unit

RIGID = 1e6  # kPa, an object that does not give way; `simulate_touch` has the same default
DEEPEST = 0.95  # of the gel's thickness: a linear layer means nothing beyond
SHALLOWEST = 1e-3  # mm
COARSE = 5  # secants on the coarse grid
FINE = 2  # presses on the whole grid
CORRECTIONS = 2  # of a motion to the simulator's friction
Load = Literal["force", "depth"]
Tree = TypeVar("Tree")


@dataclass(frozen=True)
class GelView:
    """What is solved and shown. It is static under jit."""

    sensor: Sensor
    size: int = 224  # pixels of the image's short side, 0 for the sensor's resolution
    fidelity: Fidelity = "fast"
    # "force" solves the depth to the load; "depth" takes the height map where it is
    load: Load = "force"
    thickness: float = 1.0  # of the unit, relative to the sensor's
    modulus: float = 1.0

    @property
    def grid(self) -> tuple[tuple[int, int], float]:
        """(rows, columns) of the height map, and mm between its points."""
        return solve_grid(self.sensor, self.size, self.fidelity)

    @property
    def image(self) -> tuple[int, int]:
        """(height, width) of the image."""
        return optics.image_size(self.sensor, self.size)

    @property
    def gel(self) -> Gel:
        """The gel. Its numbers are known before the program runs, so numpy makes its tables."""
        nominal = self.sensor.gel
        return Gel(
            nominal.modulus * self.modulus, nominal.poisson, nominal.thickness * self.thickness
        )


class GelDevice(NamedTuple):
    """A unit of a sensor, with what all its images share."""

    unit: Unit
    behind: Array  # (3, H, W) of `optics.backdrop`


class GelContact(NamedTuple):
    """What a pad meets in one reading. Every array may have a leading batch axis."""

    heights: Leaf  # (h, w) mm of the object above the untouched gel, -inf where there is none
    # At a cliff a point is part of the upper side and part of the lower one: its lower height
    # (h, w), and the fraction of the upper one. Without cliffs these are -inf and 1.
    below: Leaf
    cover: Leaf
    load: Leaf  # N into the gel
    pull: Leaf  # (2,) N of friction on the gel, along x and y; NaN leaves the shear to the motion
    motion: Leaf  # (3,) mm, mm, rad of the object over the gel since the reading before
    friction: Leaf  # Coulomb's coefficient


class GelState(NamedTuple):
    """What earlier readings have left in the gel."""

    traction: Leaf  # (h, w, 2) kPa
    squeezed: Leaf  # (h', w', 2) mm of sideways motion by pressing, on the coarse grid


class TouchReading(NamedTuple):
    """What the camera sees and the gel feels, at the image's pixels (H, W).

    x points right and y down in the image. Several pads have a leading axis.
    """

    image: Leaf  # u8 (H, W, 3)
    background: Leaf  # u8 (H, W, 3) of the untouched gel
    depth: Leaf  # (H, W) mm, the gel's displacement
    shear: Leaf  # (H, W, 2) mm along x and y
    pressure: Leaf  # (H, W) kPa
    force: Leaf  # (3,) N along x, y and into the gel
    torque: Leaf  # N mm about the centre of pressure
    slip: Leaf  # fraction of the contact that slides
    indentation: Leaf  # mm by which the highest point is pressed in, the depth of `simulate_touch`
    touched: Leaf  # bool


def unloaded(view: GelView) -> GelState:
    """Return the state of a gel that nothing has touched."""
    (rows, columns), _ = view.grid
    coarse = _coarse(view)
    return GelState(np.zeros((rows, columns, 2), np.float32), np.zeros((*coarse, 2), np.float32))


def device_of(view: GelView, unit: Unit) -> GelDevice:
    """Return a unit with its backdrop, computed once for all readings."""
    return GelDevice(unit, optics.backdrop(view.sensor, unit, view.image))


def show_untouched(device: GelDevice, key: Array, view: GelView) -> Array:
    """Return the image u8 (H, W, 3) of a gel that nothing touches, with its noise."""
    rendering = optics.Rendering(view.sensor, device.unit, view.image)
    return optics.show(None, rendering, key, behind=device.behind)


def feel(
    device: GelDevice,
    state: GelState,
    contact: GelContact,
    key: Array,
    background: Leaf,
    view: GelView,
) -> tuple[GelState, TouchReading]:
    """Return the next state of a gel and the reading of what touches it now.

    Args:
        device: The unit.
        state: That after the reading before, or `unloaded`.
        contact: What touches the gel.
        key: Draws the noise of the image.
        background: u8 (H, W, 3), passed on.
        view: What is solved and shown, static under jit.

    Returns:
        The state, and the reading with one pad's shapes.
    """
    _, pitch = view.grid
    gel = view.gel
    highest = jnp.max(contact.heights)
    top = jnp.where(jnp.isfinite(highest), highest, 0)
    surface = _Surface(
        jnp.asarray(contact.heights) - top,
        jnp.asarray(contact.below) - top,
        jnp.asarray(contact.cover),
    )
    if view.load == "force":
        press, depth = pressed_to(surface, contact.load, view)
    else:
        depth = jnp.maximum(highest, 0)
        press = _pressed(surface, depth, view)
    squeezed = mechanics.sideways(press.pressure, gel, pitch, fidelity=view.fidelity, coarse=True)
    change = squeezed - state.squeezed
    sheared = _sheared(state, press, contact, change, device.unit, view)
    moved = sheared.displacement + squeezed
    rendering = optics.Rendering(view.sensor, device.unit, view.image)
    skin = optics.Skin(press.displacement, moved, pitch)
    mirror = jnp.asarray(device.unit.mirror)
    force = jnp.stack([*(sheared.force * mirror), press.force])
    onto = partial(
        optics.onto_image,
        pitch=pitch,
        sensor=view.sensor,
        unit=device.unit,
        resolution=view.image,
    )
    reading = TouchReading(
        image=optics.show(skin, rendering, key, behind=device.behind),
        background=jnp.asarray(background),
        depth=onto(press.displacement[..., None])[..., 0],
        shear=onto(moved, vectors=True, grid=view.grid[0]),
        # A spline overshoots at an edge.
        pressure=jnp.maximum(onto(press.pressure[..., None])[..., 0], 0),
        force=force,
        torque=sheared.twist_torque * mirror[0] * mirror[1],
        slip=sheared.slip_fraction,
        indentation=depth,
        touched=press.force > 0,
    )
    return GelState(sheared.traction, squeezed), reading


class _Surface(NamedTuple):
    """An object's surface (h, w) mm, its highest point at 0, as in `GelContact`."""

    heights: Array
    below: Array
    cover: Array

    def cut(self, depth: Leaf) -> Array:
        """Return the surface without what lies farther below than twice the depth.

        The gel never reaches it, so how deep it is may not matter (`recorder.user_surfaces`).
        """
        upper = jnp.maximum(self.heights, -2 * depth)
        return self.cover * upper + (1 - self.cover) * jnp.maximum(self.below, -2 * depth)


def pressed_to(surface: _Surface, load: Leaf, view: GelView) -> tuple[PressResult, Array]:
    """Press a surface into the gel until its pressure sums to `load`.

    Force grows as a power of depth, of 1 (a punch) to 2 (a cone), so its logarithm is nearly
    straight, and secants on it converge in a few steps. They run on a grid of half the size, where
    a step costs a sixth. Two steps on the whole grid follow, and the pressure is scaled by the
    percent that is left.

    Args:
        surface: What is pressed.
        load: N.
        view: What is solved.

    Returns:
        The press, and its depth in mm. Its force is the load, unless the gel would be pressed
        through.
    """
    _, pitch = view.grid
    gel = view.gel
    deepest = DEEPEST * float(gel.thickness)
    load = jnp.maximum(jnp.asarray(load, jnp.float32), 1e-6)

    def coarse_force(depth: Array) -> Array:
        return mechanics.press(
            mechanics.halved(surface.cut(depth)),
            depth,
            gel,
            2 * pitch,
            fidelity="fast",
            modulus_object=RIGID,
        ).force

    def deeper(depth: Array, force: Array, power: Array) -> Array:
        # A pin that the coarse grid does not see has no force there: then the step is cut.
        ratio = (load / jnp.maximum(force, 1e-9)) ** (1 / power)
        return jnp.clip(depth * jnp.clip(ratio, 0.25, 4.0), SHALLOWEST, deepest)

    def secant(_: int, carry: tuple[Array, Array, Array, Array]) -> tuple[Array, ...]:
        depth, before, force_before, power = carry
        force = coarse_force(depth)
        rise = jnp.log(jnp.maximum(force, 1e-9)) - jnp.log(jnp.maximum(force_before, 1e-9))
        run = jnp.log(depth) - jnp.log(before)
        moved = jnp.abs(run) > 1e-4
        power = jnp.where(moved, jnp.clip(rise / jnp.where(moved, run, 1), 0.8, 4.0), power)
        return deeper(depth, force, power), depth, force, power

    first = jnp.float32(0.2 * float(gel.thickness))
    carry = (first, first, jnp.float32(1.0), jnp.float32(1.6))
    depth, *_, power = jax.lax.fori_loop(0, COARSE, secant, carry)

    def refine(number: Array, carry: tuple[Array, PressResult]) -> tuple[Array, PressResult]:
        depth, before = carry
        depth = jnp.where(number > 0, deeper(depth, before.force, power), depth)
        return depth, _pressed(surface, depth, view)

    # A loop, so that the press is compiled once.
    none = _zeros_like(lambda depth: _pressed(surface, depth, view), depth)
    depth, press = jax.lax.fori_loop(0, FINE, refine, (depth, none))
    left = jnp.where(press.force > 0, load / jnp.maximum(press.force, 1e-9), 1)
    left = jnp.clip(left, 0.9, 1.1)
    scaled = press._replace(pressure=press.pressure * left, force=press.force * left)
    return scaled, depth


def _pressed(surface: _Surface, depth: Array, view: GelView) -> PressResult:
    """Return a press to a depth."""
    return mechanics.press(
        surface.cut(depth),
        depth,
        view.gel,
        view.grid[1],
        fidelity=view.fidelity,
        modulus_object=RIGID,
    )


def _sheared(
    state: GelState,
    press: PressResult,
    contact: GelContact,
    change: Array,
    unit: Unit,
    view: GelView,
) -> shear.Shear:
    """Return the tangential state after a motion, corrected to the simulator's friction.

    Rigid contacts that stick do not move, though a gel under the same pull shears by some tenths of
    a millimetre. So the motion is completed by what the pull adds: two secant steps along each
    axis, from the stiffness of a sticking circle on a layer. Where all slips nothing is added,
    because the traction is at its limit.
    """
    _, pitch = view.grid
    gel = view.gel
    interface = shear.Interface(
        gel,
        pitch,
        jnp.asarray(contact.friction),
        fidelity=view.fidelity,
        modulus_object=RIGID,
        centre=unit.offset,
        coarse=True,
    )
    before = shear.at_rest((press.pressure.shape[0], press.pressure.shape[1]))
    before = before._replace(traction=jnp.asarray(state.traction))

    def slid(motion: Array) -> shear.Shear:
        return shear.slide(before, press, motion, interface, change)

    motion = jnp.asarray(contact.motion, jnp.float32)
    if view.load == "depth":
        return slid(motion)
    # More than friction holds cannot be reached, and would only drive the motion away.
    pull = jnp.asarray(contact.pull)
    limit = 0.999 * contact.friction * press.force
    goal = pull * jnp.minimum(1, limit / jnp.maximum(jnp.linalg.norm(pull), 1e-9))

    def correct(number: Array, carry: _Correction) -> _Correction:
        gained = carry.sheared.force - carry.force
        # The first round has no force to compare with, the second one no step.
        known = (number > 1) & (jnp.abs(carry.step) > 1e-6)
        found = gained / jnp.where(known, carry.step, 1)
        slope = jnp.where(known, jnp.clip(found, 0.3 * carry.slope, 3 * carry.slope), carry.slope)
        step = jnp.where(number > 0, (goal - carry.sheared.force) / slope, 0)
        step = jnp.where(jnp.isfinite(goal), step, 0)
        further = carry.motion + jnp.concatenate([step, jnp.zeros(1)])
        return _Correction(further, step, slope, carry.sheared.force, slid(further))

    # A loop, so that the step is compiled once.
    start = _Correction(
        motion,
        jnp.zeros(2),
        jnp.full(2, _stiffness(press, gel, pitch)),
        jnp.zeros(2),
        _zeros_like(slid, motion),
    )
    return jax.lax.fori_loop(0, 1 + CORRECTIONS, correct, start).sheared


class _Correction(NamedTuple):
    """State of the search for the motion whose friction is the simulator's."""

    motion: Array  # (3,)
    step: Array  # (2,) mm, the last one
    slope: Array  # (2,) N/mm
    force: Array  # (2,) N before the last step
    sheared: shear.Shear


def _zeros_like(function: Callable[[Array], Tree], value: Array) -> Tree:
    """Return zeros of the shapes that a function returns."""
    zeros: Tree = jax.tree.map(
        lambda one: jnp.zeros(one.shape, one.dtype), jax.eval_shape(function, value)
    )
    return zeros


def _stiffness(press: PressResult, gel: Gel, pitch: float) -> Array:
    """Return the tangential stiffness of a sticking contact in N/mm.

    It is that of a circle of its area on a half-space (Mindlin 1949), and of a sheared column of
    the layer below.
    """
    touching = jnp.maximum(mechanics.area(press.pressure, pitch), pitch**2)
    modulus = gel.modulus / (2 * (1 + gel.poisson))
    circle = 8 * modulus * jnp.sqrt(touching / jnp.pi) / (2 - gel.poisson)
    return jnp.asarray((circle + modulus * touching / gel.thickness) * KPA_MM2)


def _coarse(view: GelView) -> tuple[int, int]:
    """Return the size of the grid of the sideways motion, as `mechanics.sideways` leaves it."""
    (rows, columns), _ = view.grid
    if view.fidelity == "exact":
        return rows, columns
    plan = mechanics.grids((rows, columns))[-1]
    return plan.rows, plan.columns
