"""What the pads of a MuJoCo scene meet in one reading, as arrays for the gel.

The contacts that MuJoCo has found already are the distance query: a pad without one costs nothing
more. Friction, load and pull are those of MuJoCo's contacts, so the gel and the scene agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.sim.mujoco.gel import GelContact, GelView
from anytouch_jax.sim.mujoco.pad import MM, Array, Pad, RayGrid, Rays, find_pad
from anytouch_jax.sim.recorder import SPACING
from anytouch_jax.sim.sensing.sensors import Unit

BAD = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
LEAST_FORCE = 1e-5  # N
JUMP = 1e-3  # m that an object may move between readings beyond what its velocity explains
TURN = 0.2  # rad, likewise
EDGE = 5e-4  # m by which a contact may lie beside the image


CLIFF = 1.0  # rise per mm between neighbours that is an edge
_LINE = (np.arange(4) - 1.5) / 4 * SPACING
OFFSETS = tuple(line.ravel() for line in np.meshgrid(_LINE, _LINE))  # mm, of 16 rays to a point
Map = npt.NDArray[np.float32]


class Past(NamedTuple):
    """Where an object was over a pad, at the reading before."""

    body: int
    turn: Array  # (3, 3), from the object's frame to the pad's
    place: Array  # (3,) m of the object's origin in the pad's frame
    speed: tuple[float, float]  # m/s and rad/s over the pad
    time: float


class Met(NamedTuple):
    """What a pad meets. `is_new` is a contact without a history."""

    contact: GelContact
    past: Past
    is_new: bool


class Pads:
    """Pads of one scene, and what they met before."""

    def __init__(
        self, model: mujoco.MjModel, sites: Sequence[str], view: GelView, unit: Unit
    ) -> None:
        grid = _grid(view, unit)
        self._model = model
        self._view = view
        self._unit = unit
        self._grid = grid
        self.pads = tuple(find_pad(model, site, view.sensor, grid) for site in sites)
        self._rays = Rays(model)
        self._pad_of = np.full(model.ngeom + 1, -1)  # the last one is for flexes, which are -1
        for number, pad in enumerate(self.pads):
            if taken := [geom for geom in pad.geoms if self._pad_of[geom] >= 0]:
                raise UserError(
                    f"the sites {self.pads[self._pad_of[taken[0]]].name} and {pad.name} are on one "
                    "geom; give each pad its own"
                )
            self._pad_of[list(pad.geoms)] = number
        self.forget()

    def forget(self) -> None:
        """Forget what the pads met before."""
        self._past: list[Past | None] = [None] * len(self.pads)
        self._warned: int | None = None
        self._is_first = True

    def meet(self, data: mujoco.MjData) -> list[Met | None]:
        """Return what each pad meets, None for nothing.

        Raises UserError for NaN in the scene, for an object deep inside a pad at the start, and for
        what rays cannot read.
        """
        self._check(data)
        found: list[Met | None] = [None] * len(self.pads)
        if data.ncon:
            for number, contacts in self._contacts(data).items():
                found[number] = self._met(data, number, contacts)
        self._past = [None if one is None else one.past for one in found]
        self._is_first = False
        return found

    def _check(self, data: mujoco.MjData) -> None:
        """Raise UserError for a scene with NaN, also if MuJoCo has reset it meanwhile."""
        sizes = (len(data.qpos), len(data.geom_xpos), len(data.site_xpos))
        if sizes != (self._model.nq, self._model.ngeom, self._model.nsite):
            raise UserError("these data are of another model than the touch sensor")
        # A mocap body has no state, and MuJoCo finds no contact of what has no place or size.
        parts = {
            "state": (data.qpos, data.qvel),
            "poses": (data.geom_xpos, data.geom_xmat, data.site_xpos, data.site_xmat),
            "sizes": (data.model.geom_size,),
        }
        for name, values in parts.items():
            if not all(np.isfinite(value).all() for value in values):
                raise UserError(
                    f"the scene has NaN in its {name} at {data.time:g} s, so what the pads feel is "
                    "unknown: take a smaller timestep, or reset it"
                )
        warned = sum(int(data.warning[one].number) for one in BAD)
        before = self._warned
        self._warned = warned
        if warned > (before or 0):
            raise UserError(
                "the scene became unstable (NaN or huge values) and MuJoCo has reset it: take a "
                "smaller timestep, then reset the scene and the touch sensor"
            )

    def _contacts(self, data: mujoco.MjData) -> dict[int, list[tuple[int, int, int]]]:
        """Return (contact, the pad's geom first or second, other geom) by the number of the pad."""
        geoms = data.contact.geom
        pads = self._pad_of[geoms]
        rows: dict[int, list[tuple[int, int, int]]] = {}
        for row, side in zip(*np.nonzero(pads >= 0), strict=True):
            other = int(geoms[row, 1 - side])
            number = int(pads[row, side])
            if other < 0:
                raise UserError(
                    f"a flex touches the pad {self.pads[number].name}; rays read geoms only, so "
                    "make its surface of geoms"
                )
            rows.setdefault(number, []).append((int(row), int(side), other))
        return rows

    def _met(
        self, data: mujoco.MjData, number: int, contacts: list[tuple[int, int, int]]
    ) -> Met | None:
        """Return what one pad meets by its contacts."""
        pad = self.pads[number]
        if self._is_first and self._view.load == "force":
            # Before the force: an object around a pad is pushed anywhere, maybe not out of the gel.
            self._check_depth(data, pad, contacts, -np.inf)
        frame = data.site_xmat[pad.site].reshape(3, 3)
        push, by_body, friction = self._pushed(data, pad, frame, contacts)
        load = -float(push[2])
        if self._view.load == "force" and not load > LEAST_FORCE:
            return None
        touching = {other for _, _, other in contacts}
        heights, below, cover = self._heights(data, pad, touching)
        top = float(heights.max())
        if self._view.load == "depth":
            self._check_depth(data, pad, contacts, top)
        if not np.isfinite(top) or (self._view.load == "depth" and top <= 0):
            return None  # it touches beside the image
        past = self._place(data, pad, frame, max(by_body, key=lambda one: by_body[one]))
        motion = self._motion(self._past[number], past)
        unit = self._unit
        c = float(np.cos(unit.rotation))
        s = float(np.sin(unit.rotation))
        turned = np.array([[c, -s], [s, c]])
        moved = np.zeros(3) if motion is None else motion
        contact = GelContact(
            heights=heights,
            below=below,
            cover=cover,
            load=np.asarray(load, np.float32),
            pull=(turned @ push[:2]).astype(np.float32),
            motion=np.array([*(turned @ moved[:2]), moved[2]], np.float32),
            friction=np.asarray(friction, np.float32),
        )
        return Met(contact, past, motion is None)

    def _pushed(
        self,
        data: mujoco.MjData,
        pad: Pad,
        frame: Array,
        contacts: list[tuple[int, int, int]],
    ) -> tuple[Array, dict[int, float], float]:
        """Return the force (3,) N on a pad in its frame, its norm by body, and the friction.

        Friction is the mean of the contacts by their force. A contact beside the image is left
        out: another part of the gel bears it.
        """
        total = np.zeros(3)
        by_body: dict[int, float] = {}
        weights = 0.0
        slippery = 0.0
        wrench = np.zeros(6)
        room = np.array([np.abs(self._grid.x).max(), np.abs(self._grid.y).max()]) + EDGE
        for row, side, other in contacts:
            contact = data.contact[row]
            place = frame.T @ (contact.pos - data.site_xpos[pad.site])
            if (np.abs(place[:2]) > room).any():
                continue
            mujoco.mj_contactForce(self._model, data, row, wrench)
            if not np.isfinite(wrench).all():
                raise UserError(
                    f"the force on the pad {pad.name} is NaN at {data.time:g} s: take a smaller "
                    "timestep, or reset the scene"
                )
            # MuJoCo's normal points from the first geom to the second, which it pushes.
            force = contact.frame.reshape(3, 3).T @ wrench[:3] * (1 if side else -1)
            total += frame.T @ force
            size = float(wrench[0])
            body = int(self._model.geom_bodyid[other])
            by_body[body] = by_body.get(body, 0.0) + size
            weights += size + 1e-12
            slippery += (size + 1e-12) * float(contact.friction[0])
        if not by_body:
            return total, {0: 0.0}, 0.0
        return total, by_body, slippery / weights

    def _heights(self, data: mujoco.MjData, pad: Pad, touching: set[int]) -> tuple[Map, Map, Map]:
        """Return `heights`, `below` and `cover` of `GelContact`.

        Besides the geoms in contact those of the same bodies nearby are read: the gel gives way
        more than MuJoCo's contacts, and may meet them too.
        """
        geoms = touching | self._near(data, pad, touching)
        along, met = self._rays.along(data, pad.site, sorted(geoms), self._grid)
        with np.errstate(invalid="ignore"):
            behind = set(np.unique(met[along < -self._view.gel.thickness]).tolist()) - touching
        if behind:
            # What lies behind the finger would hide the rest.
            geoms -= behind
            along, _ = self._rays.along(data, pad.site, sorted(geoms), self._grid)
        heights = _or_nothing(pad.relief - along)
        below = np.full_like(heights, -np.inf)
        cover = np.ones_like(heights)
        row, column = np.nonzero(_cliffs(heights, self._view) & np.isfinite(pad.relief))
        if len(row):
            # A point at a cliff is the mean over a square as wide as the pixels of a height map of
            # `simulate_touch`, so edges have places between those of the grid.
            points = (
                self._grid.x[row, column][:, None] + OFFSETS[0] / MM,
                self._grid.y[row, column][:, None] + OFFSETS[1] / MM,
            )
            parts, _ = self._rays.along(data, pad.site, sorted(geoms), points)
            own = _or_nothing(pad.relief[row, column][:, None] - parts)
            heights[row, column], below[row, column], cover[row, column] = _sides(own)
        return heights, below, cover

    def _near(self, data: mujoco.MjData, pad: Pad, touching: set[int]) -> set[int]:
        """Return geoms of the bodies in contact that the gel may meet."""
        model = self._model
        bodies = np.unique(model.geom_bodyid[sorted(touching)])
        same = np.flatnonzero(pad.touchable & np.isin(model.geom_bodyid, bodies))
        apart = np.linalg.norm(data.geom_xpos[same] - data.site_xpos[pad.site], axis=1)
        reach = model.geom_rbound[same] + pad.radius + self._view.gel.thickness / MM
        return set(same[apart < reach].tolist())

    def _check_depth(
        self,
        data: mujoco.MjData,
        pad: Pad,
        contacts: list[tuple[int, int, int]],
        top: float,
    ) -> None:
        """Raise UserError for an object that is deeper in a pad than its gel is thick."""
        deepest = min(contacts, key=lambda one: float(data.contact[one[0]].dist))
        depth = -float(data.contact[deepest[0]].dist) * MM
        if self._view.load == "depth" and np.isfinite(top):
            depth = max(top, 0.0)
        if depth >= self._view.gel.thickness:
            name = self._model.geom(deepest[2]).name or f"geom {deepest[2]}"
            start = " at the start" if self._is_first else ""
            raise UserError(
                f"{name} is {depth:.2g} mm inside the pad {pad.name}{start}, whose gel is "
                f"{self._view.gel.thickness:g} mm thick: move it out"
            )

    def _place(self, data: mujoco.MjData, pad: Pad, frame: Array, body: int) -> Past:
        """Return where an object is over a pad, and how fast."""
        turn = frame.T @ data.xmat[body].reshape(3, 3)
        away = data.xpos[body] - data.site_xpos[pad.site]
        moving = np.zeros((2, 6))
        for row, one in zip(moving, (body, pad.body), strict=True):
            mujoco.mj_objectVelocity(self._model, data, mujoco.mjtObj.mjOBJ_XBODY, one, row, 0)
        middle = data.site_xpos[pad.site]
        at_pad = [
            v[3:] + np.cross(v[:3], middle - data.xpos[one])
            for v, one in zip(moving, (body, pad.body), strict=True)
        ]
        speed = float(np.linalg.norm(at_pad[0] - at_pad[1]))
        spin = float(np.linalg.norm(moving[0, :3] - moving[1, :3]))
        return Past(body, turn, frame.T @ away, (speed, spin), float(data.time))

    def _motion(self, before: Past | None, now: Past) -> Array | None:
        """Return the motion (3,) mm, mm, rad of an object over a pad since the reading before.

        It is None where there is no history: at a first contact, by another object, after time has
        gone back, and after a jump that the velocities do not explain.
        """
        if before is None or before.body != now.body or now.time < before.time:
            return None
        turned = now.turn @ before.turn.T
        # The point of the object that was at the middle of the pad is here now.
        moved = now.place - turned @ before.place
        angle = float(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
        span = now.time - before.time
        most = [2 * max(pair) * span for pair in zip(before.speed, now.speed, strict=True)]
        if float(np.linalg.norm(moved)) > JUMP + most[0] or angle > TURN + most[1]:
            return None
        twist = float(np.arctan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1]))
        return np.array([moved[0] * MM, moved[1] * MM, twist])


def _grid(view: GelView, unit: Unit) -> RayGrid:
    """Return the points of the height map in the pad's frame, as the unit is mounted."""
    (rows, columns), pitch = view.grid
    y, x = np.meshgrid(
        *((np.arange(n) - (n - 1) / 2) * pitch for n in (rows, columns)), indexing="ij"
    )
    x = x - float(unit.offset[0])
    y = y - float(unit.offset[1])
    c = float(np.cos(unit.rotation))
    s = float(np.sin(unit.rotation))
    return RayGrid((c * x + s * y) / MM, (c * y - s * x) / MM)


def _or_nothing(heights: Map) -> Map:
    """Return heights with -inf for NaN."""
    return np.where(np.isfinite(heights), heights, -np.inf).astype(np.float32)


def _cliffs(heights: Map, view: GelView) -> npt.NDArray[np.bool_]:
    """Return the points (h, w) beside a cliff whose upper side the gel may reach."""
    _, pitch = view.grid
    deepest = 2 * float(view.gel.thickness)
    lowest = float(heights.max()) - deepest
    if not np.isfinite(lowest):
        return np.zeros(heights.shape, bool)
    cut = np.pad(np.maximum(heights, lowest), 1, mode="edge")
    around = (cut[:-2, 1:-1], cut[2:, 1:-1], cut[1:-1, :-2], cut[1:-1, 2:])
    apart = np.max([np.abs(one - cut[1:-1, 1:-1]) for one in around], axis=0)
    upper = np.max([*around, cut[1:-1, 1:-1]], axis=0)
    # What is more than a gel's thickness below the top is not reached.
    cliff: npt.NDArray[np.bool_] = (apart > CLIFF * pitch) & (upper > lowest + deepest / 2)
    return cliff


def _sides(parts: Map) -> tuple[Map, Map, Map]:
    """Return the upper height, the lower one and the fraction of the upper one of points (n, k)."""
    top = parts.max(1, keepdims=True)
    with np.errstate(invalid="ignore"):
        above = parts >= top - CLIFF * SPACING
    above |= ~np.isfinite(top)
    count = above.sum(1)
    upper = np.where(above, parts, 0).sum(1) / count
    # Where nothing is met it is as deep as any gel, so that the mean stays finite.
    rest = np.where(above, 0, np.maximum(parts, top - 100)).sum(1) / np.maximum(16 - count, 1)
    lower = np.where(count < 16, rest, -np.inf)
    return upper, lower, (count / 16).astype(np.float32)
