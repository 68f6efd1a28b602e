"""Pouring beads out of a held cylinder: tilt, flow with chance, and the load that one finger's gel
bears (Sec. Q3).

Three frames of one body: `k` up the cylinder's axis, `d` across it toward the lip that dips, `t`
the axis of the tilt. The gel's normal lies between t and d. g, mm, s, N, rad; everything is a pure
function of one run, `jax.vmap` for more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from anytouch_jax.config.parsing import Above0, Count, Range, check
from anytouch_jax.errors import UserError
from anytouch_jax.sim.sensing.sensors import SENSORS, Unit, draw_unit

POUR = 0
WAIT = 1
RETRACT = 2
ACTIONS = ("pour", "wait", "retract")
GRAVITY = 9810.0  # mm / s^2
GLASS = 2.5e-3  # g / mm^3 of one bead
SLOTS = 49  # slices of the cylinder across `d`, for volumes and moments
# constants of the slot law; the margin is in bead diameters
FLOW = 1.03
MARGIN = 1.4
# moments in which the gripped cylinder still stands on the table; then it is lifted to its first
# tilt
STAND = 3
EXPOSURE = 1 / 60  # s of one frame: blows shorter than this are averaged
STEEPEST = math.radians(86)
# random streams of a state. Those of `advance` are 0, 1 and 2
SHOCKS = 101
PIXELS = 102
VERSION = 3  # of what a run gives for its seed


@dataclass(frozen=True)
class Task:
    """The paper's task: `beads` g in the cylinder, pour out `target` g, then retract.

    An action changes the tilt by `step` degrees, or not, `rate` times a second. A run ends when the
    tilt is `back` degrees below the highest reached and no bead flows any more, or after `limit`
    actions; the tilt stays below `most` degrees. `markers`: of the gel. Raises UserError for a task
    that cannot be done.
    """

    beads: Above0[float] = 100.0
    target: Above0[float] = 60.0
    step: Above0[float] = 0.25
    rate: Above0[float] = 5.0
    back: Above0[float] = 3.0
    limit: Count[int] = 400
    most: Annotated[float, Range(1, 180, "1 to 180")] = 125.0
    markers: bool = True

    def __post_init__(self) -> None:
        check(self)
        if self.target >= self.beads:
            raise UserError(
                f"the target of {self.target:g} g must be below the {self.beads:g} g in the "
                "cylinder"
            )


class Setup(NamedTuple):
    """What differs from run to run, f32 scalars (or stacked).

    `radius`, `height` mm of the cylinder and `empty` g of its mass; `bead` mm across; `bulk` g /
    mm^3; `repose` rad, the angle of repose; `tilt` rad at the start; `mount` rad from the tilt's
    axis to the gel's normal; `grip_height` mm of the fingers; `grip` N, which falls by the fraction
    `relax` within `relax_time` s; `fraction` of the load on the gel's finger; `friction` on the
    gel; `jolt` N of the arm's step; `place` (2,) mm, `yaw` rad, `lean` (slope) of the cylinder on
    the gel; `unit` of the sensor.
    """

    radius: Any
    height: Any
    empty: Any
    bead: Any
    bulk: Any
    repose: Any
    tilt: Any
    mount: Any
    grip_height: Any
    grip: Any
    relax: Any
    relax_time: Any
    fraction: Any
    friction: Any
    jolt: Any
    place: Any
    yaw: Any
    lean: Any
    unit: Unit


class State(NamedTuple):
    """A run at one moment: `mass` g left, `tilt` and the highest tilt, `slope` of the beads'
    surface against the cylinder's cross-section, `start` rad over the angle of repose at which they
    break loose, whether they are `flowing`, `rate` g/s of the last step, `steps` done, `moved` in
    the last one, `done`, and the random `key`.
    """

    mass: Array
    tilt: Array
    highest: Array
    slope: Array
    start: Array
    flowing: Array
    rate: Array
    steps: Array
    moved: Array
    done: Array
    key: Array


class Load(NamedTuple):
    """On the gel: `shear` (2,) N (x across the cylinder, y down its axis), `twist` N mm from x to
    y, `normal` N.
    """

    shear: Array
    twist: Array
    normal: Array


def draw_setup(task: Task, rng: np.random.Generator) -> Setup:
    """The parameters of a run, from `rng`; its first tilt is 3 to 20 degrees before the beads
    flow.
    """
    unit = draw_unit(SENSORS["gelsight_mini"], rng)._replace(marked=np.float32(task.markers))
    radius = rng.uniform(22, 28)
    bulk = rng.uniform(1.45e-3, 1.6e-3)
    fill = task.beads / bulk / (math.pi * radius**2)
    height = fill * rng.uniform(1.3, 1.7)
    repose = math.radians(rng.uniform(21, 31))
    # of the surface that reaches the lip
    full = math.atan((height - fill) / radius)
    values = {
        "radius": radius,
        "height": height,
        "empty": rng.uniform(30, 60),
        "bead": rng.uniform(2, 6),
        "bulk": bulk,
        "repose": repose,
        "tilt": max(full + repose - math.radians(rng.uniform(3, 20)), 0.0),
        "mount": math.radians(rng.uniform(20, 40)),
        "grip_height": fill * rng.uniform(0.6, 0.9),
        "grip": rng.uniform(5, 10),
        "relax": rng.uniform(0.02, 0.1),
        "relax_time": rng.uniform(5, 30),
        "fraction": rng.uniform(0.5, 0.65),
        "friction": rng.uniform(0.5, 0.9),
        "jolt": rng.uniform(0.002, 0.01),
        "place": rng.normal(0, 0.6, 2),
        "yaw": math.radians(rng.normal(0, 3)),
        "lean": math.tan(math.radians(rng.normal(0, 0.7))),
    }
    return Setup(
        **{name: np.asarray(value, np.float32) for name, value in values.items()}, unit=unit
    )


def begin(setup: Setup, task: Task, key: Array) -> State:
    """The full cylinder at its first tilt."""
    key, draw = jax.random.split(key)
    tilt = jnp.asarray(setup.tilt, jnp.float32)
    zero = jnp.zeros(())
    slope = jnp.maximum(tilt - setup.repose, 0)
    none = jnp.zeros((), bool)
    full = jnp.full((), task.beads)
    steps = jnp.zeros((), jnp.int32)
    return State(full, tilt, tilt, slope, _start(draw), none, zero, steps, none, none, key)


def _start(key: Array) -> Array:
    """How far over the angle of repose the next avalanche starts: the angle of maximal stability,
    by chance.
    """
    return jnp.deg2rad(jax.random.uniform(key, minval=0.4, maxval=2.0))


def advance(state: State, action: Array, setup: Setup, task: Task) -> State:
    """Return the state after one action and a fifth of a second; a finished run does not change.

    Beads break loose when their surface is steeper than the angle of maximal stability, and run out
    at the rate of a slot of the lip's width and the depth of what lies over the angle of repose
    (Myers and Sellers 1978, after Beverloo et al. 1961; see Nedderman 1992, ch. 10), in whole beads
    whose number scatters as Poisson's, until none comes.
    """
    key, flow_key, start_key = jax.random.split(state.key, 3)
    turn = jnp.deg2rad(task.step) * ((action == POUR) * 1.0 - (action == RETRACT) * 1.0)
    tilt = jnp.clip(state.tilt + turn, 0, math.radians(task.most))
    highest = jnp.maximum(state.highest, tilt)
    excess = state.mass - capacity(tilt - setup.repose, setup)
    loose = state.mass > capacity(tilt - setup.repose - state.start, setup)
    flowing = (state.flowing | loose) & (excess > 0)
    one = GLASS * math.pi / 6 * setup.bead**3
    expected = jnp.where(
        flowing, slot_rate(excess, tilt - setup.repose, setup) / task.rate / one, 0
    )
    # near Poisson's, and quick
    count = jnp.floor(expected + jnp.sqrt(expected) * jax.random.normal(flow_key) + 0.5)
    out = jnp.minimum(jnp.maximum(count, 0) * one, jnp.maximum(excess, 0))
    out = jnp.where(flowing, out, 0)
    flowing = flowing & (out > 0)
    start = jnp.where(state.flowing & ~flowing, _start(start_key), state.start)
    # the surface stays until it is too steep
    slope = jnp.clip(state.slope, tilt - setup.repose, tilt + setup.repose)
    steps = state.steps + 1
    back = (highest - tilt >= jnp.deg2rad(task.back) - 1e-6) & ~flowing
    done = back | (steps >= task.limit)
    rate = out * task.rate
    after = State(
        state.mass - out,
        tilt,
        highest,
        slope,
        start,
        flowing,
        rate,
        steps,
        tilt != state.tilt,
        done,
        key,
    )
    return jax.tree.map(lambda new, old: jnp.where(state.done, old, new), after, state)


def poured(state: State, task: Task) -> Array:
    """g that have left the cylinder."""
    return task.beads - state.mass


def _slices(setup: Setup) -> tuple[Array, Array]:
    """Places (SLOTS,) mm along `d` and the areas mm^2 of the cylinder's cross-section there."""
    angle = (jnp.arange(SLOTS) + 0.5) / SLOTS * math.pi
    return setup.radius * jnp.cos(angle), 2 * (setup.radius * jnp.sin(angle)) ** 2 * (
        math.pi / SLOTS
    )


def _steepness(slope: Array) -> Array:
    return jnp.tan(jnp.clip(slope, 0, STEEPEST))


def capacity(slope: Array, setup: Setup) -> Array:
    """g of beads that stay behind a surface of `slope` rad (against the cross-section) that just
    reaches the lip.
    """
    area, column = _behind(slope, setup)
    return setup.bulk * jnp.sum(area * column)


def _behind(slope: Array, setup: Setup) -> tuple[Array, Array]:
    """The slices' areas mm^2, and the height mm of the beads in each behind a surface of `slope`
    that meets the lip.
    """
    place, area = _slices(setup)
    return area, jnp.clip(
        setup.height - (setup.radius - place) * _steepness(slope), 0, setup.height
    )


def slot_rate(excess: Array, slope: Array, setup: Setup) -> Array:
    """g/s over the lip when `excess` g lie above the angle of repose.

    A slot as deep as the layer, which lies on the beads at rest (where they leave the bottom bare,
    on less than the whole ellipse), and as wide as the chord of the lip that the layer's surface
    cuts, a plane `depth` above the one that just meets the lip. The empty margin of 1.4 beads is
    left on the sides; the layer is open above, and its lower rim is beads.
    """
    inclined = jnp.clip(slope, 0, math.radians(75))
    area, column = _behind(slope, setup)
    covered = jnp.sum(jnp.where(column > 0, area, 0))
    depth = jnp.maximum(excess, 0) / setup.bulk / (covered / jnp.cos(inclined))
    sagitta = jnp.minimum(depth / jnp.maximum(jnp.sin(inclined), 1e-3), setup.radius)
    chord = 2 * jnp.sqrt(sagitta * (2 * setup.radius - sagitta))
    # a single file of beads passes
    width = jnp.maximum(chord - MARGIN * setup.bead, setup.bead)
    return FLOW * setup.bulk * math.sqrt(GRAVITY) * width * depth**1.5


def heap(mass: Array, slope: Array, setup: Setup) -> tuple[Array, Array]:
    """Where the middle of `mass` g of beads lies behind a surface of `slope`: mm along `d`, mm
    above the bottom.
    """
    place, area = _slices(setup)
    steep = _steepness(slope)
    volume = mass / setup.bulk
    reach = setup.radius * steep + setup.height

    def column(level: Array) -> Array:
        return jnp.clip(level + place * steep, 0, setup.height)

    def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        middle = (ends[0] + ends[1]) / 2
        low = jnp.sum(area * column(middle)) < volume
        return jnp.where(low, middle, ends[0]), jnp.where(low, ends[1], middle)

    low, high = jax.lax.fori_loop(0, 24, halve, (-reach, reach))
    z = column((low + high) / 2)
    total = jnp.maximum(jnp.sum(area * z), 1e-6)
    return jnp.sum(area * z * place) / total, jnp.sum(area * z * z) / 2 / total


def load(state: State, setup: Setup, task: Task, *, shocks: bool = True) -> Load:
    """What the gel bears: its fraction of weight and torque, and the grip, which the weight
    presses or eases.

    In the first STAND moments the table bears the weight. The fingers hold at `grip_height` on the
    axis; a moment about the line across the gel is taken up by more of the weight on one finger.
    `shocks`: blows of falling beads (their number in one exposure is Poisson's) and the arm's
    jolts, another draw for each state.
    """
    across, up = heap(state.mass, state.slope, setup)
    total = state.mass + setup.empty
    weight = jnp.where(state.steps < STAND, 0, total * GRAVITY * 1e-6)  # N
    arm = state.mass * across / total  # along d
    rise = (state.mass * up + setup.empty * setup.height / 2) / total - setup.grip_height
    c = jnp.cos(state.tilt)
    s = jnp.sin(state.tilt)
    inward = jnp.sin(setup.mount)
    sideward = jnp.cos(setup.mount)
    down = weight * c
    side = weight * s * sideward
    onto = weight * s * inward
    couple = (arm * inward * down + rise * onto) / (2 * setup.radius)
    shear = jnp.stack([setup.fraction * side, setup.fraction * down + couple])
    twist = setup.fraction * (arm * sideward * down + rise * side)
    seconds = state.steps / task.rate
    grip = setup.grip * (1 - setup.relax * (1 - jnp.exp(-seconds / setup.relax_time)))
    normal = grip + onto / 2
    if not shocks:
        return Load(shear, twist, normal)
    # N a bead
    blow = (
        GLASS * math.pi / 6 * setup.bead**3 * jnp.sqrt(2 * GRAVITY * setup.radius) * 1e-6 / EXPOSURE
    )
    beads = state.rate * EXPOSURE / (GLASS * math.pi / 6 * setup.bead**3)
    spread = jnp.sqrt(beads * blow**2 + (state.moved * setup.jolt) ** 2)
    draws = spread * jax.random.normal(jax.random.fold_in(state.key, SHOCKS), (4,))
    return Load(shear + draws[:2], twist + setup.radius / 2 * draws[2], normal + draws[3])
