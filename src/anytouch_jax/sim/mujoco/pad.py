"""The pad of a sensor in a MuJoCo scene: its plane, its geoms, what it meets, and its softness.

The frame of a pad is that of its site, which is that of a camera behind the gel: x points right and
y down in the image, z out of the gel. MuJoCo's lengths are m, those of the gel are mm.

Height maps are read by rays. `mj_multiRay` shoots them all from one point, so that point lies
`FAR` behind the pad, and they are parallel to within a hundredth of a millimetre. In a copy of the
model all geoms but those to read are in another group, so the rays pass through them.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.sim.contact.mechanics import Gel
from anytouch_jax.sim.sensing.sensors import Sensor

Array = npt.NDArray[np.float64]
MM = 1e3  # mm in a m
FAR = 100.0  # m from which rays are shot
READ = 5  # the group of geoms that rays meet; in the copy of the model all others are in group 0
GROUPS = np.array([group == READ for group in range(6)], np.uint8)
ON_SURFACE = 0.5  # mm by which a site may lie off the surface of its geom
SIDES = (0.5, 2.0)  # of a pad, relative to the gel of its sensor
LEAST_PART = 0.2  # of the image that must show gel
BALL = 5.0  # mm, radius of the ball whose contact sets the softness of a pad
PRESSED = 0.2  # of the gel's thickness, the depth of that contact
IMPEDANCE = 0.9


class Pad(NamedTuple):
    """A pad of a scene."""

    site: int
    name: str
    body: int
    geoms: tuple[int, ...]  # those whose surface is the gel
    touchable: npt.NDArray[np.bool_]  # (ngeom,) geoms that can collide with it
    relief: npt.NDArray[np.float32]  # (h, w) mm of its surface along z, NaN without gel
    radius: float  # m from its middle to its corner


class RayGrid(NamedTuple):
    """Points of a height map in the pad's frame."""

    x: Array  # (h, w) m
    y: Array


def widen(model: mujoco.MjModel) -> None:
    """Make the bounds of bodies so wide that rays meet all their geoms.

    `mj_multiRay` passes by a body outside its bounds, and these leave out geoms that collide by a
    pair alone, or not at all.
    """
    roots = model.body_bvhadr[model.body_bvhnum > 0]
    model.bvh_aabb[roots, 3:] = np.maximum(model.bvh_aabb[roots, 3:], FAR)


class Rays:
    """Reads height maps of a scene. Each thread needs its own."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._live = model
        self._model = copy.copy(model)
        # An invisible geom is passed by rays, but it is touched like any other.
        self._model.geom_rgba[:, 3] = 1
        self._model.geom_matid[:] = -1
        widen(self._model)

    def along(
        self,
        data: mujoco.MjData,
        site: int,
        geoms: Sequence[int],
        points: tuple[Array, Array],
        towards: int = 1,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """Return where rays first meet `geoms`.

        Args:
            data: The state of the scene.
            site: Of the pad.
            geoms: Numbers of the geoms to read.
            points: x and y m in the pad's frame, of any shape.
            towards: 1 shoots along the pad's z, from inside; -1 from its front.

        Returns:
            Places along z in mm, NaN where no geom is met, and the geoms there.
        """
        model = self._model
        # Sizes of the scene may have been changed since, to vary them.
        model.geom_size[:] = self._live.geom_size
        model.geom_rbound[:] = self._live.geom_rbound
        model.geom_aabb[:] = self._live.geom_aabb
        model.geom_group[:] = 0
        model.geom_group[list(geoms)] = READ
        frame = data.site_xmat[site].reshape(3, 3)
        start = data.site_xpos[site] - towards * FAR * frame[:, 2]
        x, y = (at.reshape(-1, 1) for at in points)
        # A ray of this length ends in the pad's plane, at a part of 1.
        ways = towards * FAR * frame[:, 2] + x * frame[:, 0] + y * frame[:, 1]
        count = len(ways)
        met = np.full(count, -1, np.int32)
        part = np.zeros(count)
        mujoco.mj_multiRay(
            model, data, start, ways.reshape(-1), GROUPS, True, -1, met, part, None, count, 1e10
        )
        along = np.where(met >= 0, (part - 1) * towards * FAR * MM, np.nan)
        shape = points[0].shape
        return along.astype(np.float32).reshape(shape), met.reshape(shape)


def find_pad(model: mujoco.MjModel, name: str, sensor: Sensor, grid: RayGrid) -> Pad:
    """Return the pad at a site.

    Raises UserError for a scene without that site, for a site that is no box or has another size
    than the gel, and for one that does not lie on the surface of a geom of its body.

    Args:
        model: The scene.
        name: Of the site.
        sensor: Whose gel must have the site's size.
        grid: Points of the gel where rays meet the object.
    """
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
    if site < 0:
        known = [model.site(number).name for number in range(model.nsite)]
        raise UserError(
            f"the scene has no site {name}; it has {', '.join(filter(None, known)) or 'none'}"
        )
    width, height = _checked_size(model, site, name, sensor)
    body = int(model.site_bodyid[site])
    own = _own_geoms(model, body)
    if not len(own):
        raise UserError(
            f"the site {name} is on the body {model.body(body).name}, which has no geom that "
            "collides: give it the pad's geom"
        )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    relief, met = Rays(model).along(data, site, own.tolist(), grid, -1)
    inside = (np.abs(grid.x) <= width / 2 + 1e-6) & (np.abs(grid.y) <= height / 2 + 1e-6)
    _check_surface(model, name, sensor, np.where(inside, relief, np.nan))
    # Beyond the gel's thickness it is another part of the finger.
    gel = inside & (np.abs(np.nan_to_num(relief, nan=np.inf)) < sensor.gel.thickness)
    geoms = tuple(int(one) for one in np.unique(met[gel]))
    return Pad(
        site,
        name,
        body,
        geoms,
        _touchable(model, geoms),
        np.where(gel, relief, np.nan).astype(np.float32),
        float(np.hypot(width, height)) / 2,
    )


def _checked_size(
    model: mujoco.MjModel, site: int, name: str, sensor: Sensor
) -> tuple[float, float]:
    """Return width and height of a pad in m, after a check. Raises UserError."""
    width, height = (2 * float(half) for half in model.site_size[site, :2])
    half = " ".join(f"{side / 2 / MM:.5f}" for side in sensor.field[::-1])
    wanted = f'type="box" size="{half} 0.0005"'
    if model.site_type[site] != mujoco.mjtGeom.mjGEOM_BOX or min(width, height) <= 0:
        raise UserError(
            f"the site {name} has no extent: make it a box whose x and y span the pad, {wanted} "
            f"for a {sensor.name}"
        )
    ratios = (height * MM / sensor.field[0], width * MM / sensor.field[1])
    if not (SIDES[0] <= min(ratios) and max(ratios) <= SIDES[1]):
        raise UserError(
            f"the pad {name} is {width * MM:g} x {height * MM:g} mm, but the gel of "
            f"{sensor.name} is {sensor.field[1]:g} x {sensor.field[0]:g} mm: make the site {wanted}"
        )
    return width, height


def _own_geoms(model: mujoco.MjModel, body: int) -> npt.NDArray[np.int64]:
    """Return the geoms of a body that collide, or of what is welded to it."""
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    own = np.flatnonzero(collides & (model.geom_bodyid == body))
    if not len(own) and model.body_weldid[body]:
        welded = model.body_weldid[model.geom_bodyid] == model.body_weldid[body]
        own = np.flatnonzero(collides & welded)
    return own


def _check_surface(
    model: mujoco.MjModel, name: str, sensor: Sensor, relief: npt.NDArray[np.float32]
) -> None:
    """Raise UserError if the site's plane is not the surface of the pad."""
    rows, columns = relief.shape
    middle = relief[rows // 2 - 1 : rows // 2 + 1, columns // 2 - 1 : columns // 2 + 1]
    off = float(np.nanmean(middle)) if np.isfinite(middle).any() else float("nan")
    if not abs(off) <= ON_SURFACE:
        where = "no surface of its body lies below its middle"
        if np.isfinite(off):
            side = "behind" if off > 0 else "in front of"
            where = f"it lies {abs(off):.2g} mm {side} the surface of its body"
        raise UserError(
            f"the site {name} is not on a pad: {where}; move it onto the pad, with its z axis "
            "pointing out of the gel"
        )
    part = np.mean(np.abs(np.nan_to_num(relief, nan=np.inf)) < sensor.gel.thickness)
    if part < LEAST_PART:
        raise UserError(
            f"the geoms below the site {name} are the pad of only {part:.0%} of the image of a "
            f"{sensor.name}: make them as large as its gel"
        )


def _touchable(model: mujoco.MjModel, geoms: Sequence[int]) -> npt.NDArray[np.bool_]:
    """Return (ngeom,) whether a geom can collide with one of `geoms`, by MuJoCo's masks."""
    kinds = model.geom_contype[:, None] & model.geom_conaffinity[list(geoms)][None]
    others = model.geom_conaffinity[:, None] & model.geom_contype[list(geoms)][None]
    can: npt.NDArray[np.bool_] = ((kinds | others) != 0).any(1)
    can[list(geoms)] = False
    return can


def gel_stiffness(gel: Gel) -> float:
    """Return the stiffness in N/m of a gel under a ball of 10 mm at a fifth of its thickness.

    A layer bonded to its plate is stiffer than a half-space by a polynomial in the contact's radius
    over the thickness (Dimitriadis et al., Biophysical Journal 82, 2002, for an incompressible
    layer).
    """
    depth = PRESSED * gel.thickness
    radius = np.sqrt(BALL * depth)
    chi = radius / gel.thickness
    layer = 1 + 1.133 * chi + 1.283 * chi**2 + 0.769 * chi**3 + 0.0975 * chi**4
    # kPa mm is N/m.
    return float(16 / 9 * gel.modulus * radius * layer)


def soften(model: mujoco.MjModel, pad: Pad, gel: Gel) -> None:
    """Make the geoms of a pad as compliant in MuJoCo as its gel, by their solref and solimp.

    MuJoCo's contacts are springs in units of acceleration. With a constant impedance d a contact
    of inverse mass A gives way by `A (1 - d) / k` for each newton, so the stiffness K of the gel
    wants `k = K A (1 - d)`. A is that of the pad and the median of what can touch it. `solmix`
    makes these values win over those of the object, and leaves its friction.
    """
    inverse = model.body_invweight0[:, 0]
    others = model.geom_bodyid[pad.touchable]
    movable = inverse[others][inverse[others] > 0]
    mass = float(inverse[pad.body]) + (float(np.median(movable)) if len(movable) else 0.0)
    if mass <= 0:
        return  # nothing can move, so there is no force to shape
    stiffness = gel_stiffness(gel) * mass * (1 - IMPEDANCE)
    for geom in pad.geoms:
        model.geom_solref[geom] = (-stiffness, -2 * np.sqrt(stiffness))  # critically damped
        model.geom_solimp[geom] = (IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2)
        model.geom_solmix[geom] = 1e6
