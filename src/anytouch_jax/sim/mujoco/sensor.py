"""A touch sensor for MuJoCo scenes.

    touch = TouchSensor(model, site="left_pad", sensor="digit")
    mujoco.mj_step(model, data)
    reading = touch.read(data)

Where nothing touches, nothing is solved or rendered: the reading is the untouched gel with its
noise. Pads in contact are one batch, whose size is a power of two, so that few programs are
compiled.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from typing import Any, TypeAlias

import jax
import mujoco
import numpy as np

from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.sim.contact.mechanics import Fidelity
from anytouch_jax.sim.mujoco.gel import (
    GelContact,
    GelDevice,
    GelState,
    GelView,
    Load,
    TouchReading,
    device_of,
    feel,
    show_untouched,
    unloaded,
)
from anytouch_jax.sim.mujoco.pad import soften
from anytouch_jax.sim.mujoco.scene import Met, Pads
from anytouch_jax.sim.sensing.own import find_sensor
from anytouch_jax.sim.sensing.sensors import Sensor, Unit, identity_unit

State: TypeAlias = mujoco.MjData | Sequence[mujoco.MjData]


def nominal_unit(sensor: Sensor | str, *, dots: bool = False) -> Unit:
    """Return the nominal unit of a sensor, with the noise of its camera.

    With `dots` it has the printed markers of the sensor, if there are any: they show shear.
    """
    kind = find_sensor(sensor) if isinstance(sensor, str) else sensor
    return identity_unit(kind)._replace(
        noise=np.asarray(kind.noise, np.float32),
        marked=np.asarray(dots and kind.markers is not None, np.float32),
    )


class TouchSensor:
    """What the camera of a tactile sensor in a MuJoCo scene sees, and what its gel feels.

    A site of type box gives the plane and the size of the pad. Its frame is that of a camera behind
    the gel: x points right and y down in the image, z out of the gel. The geoms of its body that
    the site lies on are the pad.

    With `load` "force" the gel gives way until it bears MuJoCo's normal force, and its shear bears
    MuJoCo's friction. With "depth" the object is where the scene has it, for scenes that are moved
    by hand.

    Args:
        model: The scene. Its pad geoms are made as soft as the gel, unless `compliant` is false.
        site: The name of the pad's site, or several, which give readings a leading axis.
        sensor: A name, or a folder NAME.sensor.
        size: Short side of the image in pixels, 0 for the sensor's resolution.
        fidelity: How contact is solved, as in `simulate_touch`.
        load: "force" or "depth".
        unit: A device, by default `nominal_unit`.
        compliant: Whether `solref`, `solimp` and `solmix` of the pad geoms are set in the model.

    Raises:
        UserError: For a scene without the site, a pad without extent or off its geom, and a sensor
            without a camera.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        site: str | Sequence[str],
        sensor: str = "digit",
        *,
        size: int = 224,
        fidelity: Fidelity = "fast",
        load: Load = "force",
        unit: Unit | None = None,
        compliant: bool = True,
    ) -> None:
        kind = find_sensor(sensor)
        if kind.kind != "image":
            raise UserError(f"{sensor} has no camera; name a sensor that has one")
        for name, word, words in (
            ("load", load, ("force", "depth")),
            ("fidelity", fidelity, ("fast", "exact")),
        ):
            if word not in words:
                raise UserError(f'{name} is "{words[0]}" or "{words[1]}", not {word!r}')
        refuse_forked()
        self._unit = nominal_unit(kind) if unit is None else unit
        self.view = GelView(
            kind, size, fidelity, load, float(self._unit.thickness), float(self._unit.modulus)
        )
        self._model = model
        self._several = not isinstance(site, str)
        self._sites = (site,) if isinstance(site, str) else tuple(site)
        if not self._sites:
            raise UserError("name at least one site")
        self._scenes = [Pads(model, self._sites, self.view, self._unit)]
        if compliant:
            for pad in self._scenes[0].pads:
                soften(model, pad, self.view.gel)
        self.device = _device(self.view)(self._unit)
        self._states: list[GelState | None] = [None] * len(self._sites)
        self._count = 0
        # The noise of the background is that of one image that was taken before.
        before = np.full(2, 2**32 - 1, np.uint32)
        self.background = np.asarray(_untouched(self.view)(self.device, before))

    @property
    def sensor(self) -> Sensor:
        """The sensor."""
        return self.view.sensor

    @property
    def sites(self) -> tuple[str, ...]:
        """The sites of its pads."""
        return self._sites

    def meet(self, data: State) -> list[Met | None]:
        """Return what each pad meets, without solving it; the pads remember where it was.

        For `gel.feel` in a program of your own.
        """
        return self._meet([data] if isinstance(data, mujoco.MjData) else list(data))

    def reset(self) -> None:
        """Forget what has touched the pads, and start the noise again."""
        self._states = [None] * len(self._states)
        self._count = 0
        for scene in self._scenes:
            scene.forget()

    def read(self, data: State, key: jax.Array | None = None) -> TouchReading:
        """Return what the pads feel now, as numpy.

        Args:
            data: The state of the scene after `mj_step` or `mj_forward`, or those of B scenes of
                the same model, which are read by threads.
            key: Draws the noise of the images, by default from the number of the reading.

        Returns:
            The reading. Several scenes and several pads each add a leading axis, in this order.

        Raises:
            UserError: For NaN in a scene, an object deep inside a pad at the start, a flex, and
                the data of another model.
        """
        batched = not isinstance(data, mujoco.MjData)
        scenes: list[Any] = list(data) if batched else [data]
        met = self._meet(scenes)
        rows = len(met)
        keys = _key_data(key, self._count, rows)
        self._count += 1
        touched = [row for row, one in enumerate(met) if one is not None]
        readings = self._felt(touched, met, keys) if touched else {}
        nothing = set(range(rows)) - set(touched)
        for row in nothing:
            self._states[row] = None
            readings[row] = self._nothing(keys[row])
        ordered = [readings[row] for row in range(rows)]
        shape = (
            *([len(scenes)] if batched else []),
            *([len(self._sites)] if self._several else []),
        )
        if not shape:
            return ordered[0]
        return TouchReading(
            *(
                np.stack(values).reshape(*shape, *np.shape(values[0]))
                for values in zip(*ordered, strict=True)
            )
        )

    def _meet(self, scenes: list[mujoco.MjData]) -> list[Met | None]:
        """Return what each pad of each scene meets. Raises UserError for no scene."""
        if not scenes:
            raise UserError("there is no scene to read; give at least one MjData")
        while len(self._scenes) < len(scenes):
            self._scenes.append(Pads(self._model, self._sites, self.view, self._unit))
        if len(self._states) != len(scenes) * len(self._sites):
            self._states = [None] * (len(scenes) * len(self._sites))
        if len(scenes) == 1:
            return self._scenes[0].meet(scenes[0])
        # MuJoCo leaves the interpreter free while it shoots rays.
        met = _pool().map(lambda pads, one: pads.meet(one), self._scenes, scenes)
        return [one for pads in met for one in pads]

    def _felt(
        self, touched: list[int], met: list[Met | None], keys: np.ndarray
    ) -> dict[int, TouchReading]:
        """Return the readings of the pads in contact, and keep their states."""
        states = []
        contacts = []
        for row in touched:
            one = met[row]
            assert one is not None
            state = None if one.is_new else self._states[row]
            states.append(unloaded(self.view) if state is None else state)
            contacts.append(one.contact)
        count = 1 << (len(touched) - 1).bit_length()
        more = count - len(touched)
        stacked_states: GelState = _stack(states + states[-1:] * more)
        stacked: GelContact = _stack(contacts + contacts[-1:] * more)
        chosen = keys[touched + touched[-1:] * more]
        after, readings = _felt_program(self.view)(
            self.device, stacked_states, stacked, chosen, self.background
        )
        after, readings = jax.tree.map(np.asarray, (after, readings))
        result = {}
        for place, row in enumerate(touched):
            self._states[row] = jax.tree.map(lambda x, i=place: x[i], after)
            result[row] = jax.tree.map(lambda x, i=place: x[i], readings)
        return result

    def _nothing(self, key: np.ndarray) -> TouchReading:
        """Return the reading of a pad that nothing touches."""
        height, width = self.view.image
        flat = np.zeros((height, width), np.float32)
        image = self.background
        if self._unit.noise > 0:
            image = np.asarray(_untouched(self.view)(self.device, key))
        zero = np.zeros((), np.float32)
        return TouchReading(
            image=image,
            background=self.background,
            depth=flat,
            shear=np.zeros((height, width, 2), np.float32),
            pressure=flat,
            force=np.zeros(3, np.float32),
            torque=zero,
            slip=zero,
            indentation=zero,
            touched=np.zeros((), bool),
        )


@lru_cache(maxsize=32)
def _device(view: GelView) -> Callable[[Unit], GelDevice]:
    """Return the compiled `device_of`."""
    return jax.jit(partial(device_of, view))


@lru_cache(maxsize=32)
def _felt_program(view: GelView) -> Callable[..., tuple[GelState, TouchReading]]:
    """Return the compiled reading of a batch of pads."""

    def one(
        device: GelDevice, state: GelState, contact: GelContact, data: jax.Array, plain: jax.Array
    ) -> tuple[GelState, TouchReading]:
        return feel(device, state, contact, jax.random.wrap_key_data(data), plain, view)

    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0, 0, None)))


@lru_cache(maxsize=32)
def _untouched(view: GelView) -> Callable[..., jax.Array]:
    """Return the compiled image of a gel that nothing touches."""

    def one(device: GelDevice, data: jax.Array) -> jax.Array:
        return show_untouched(device, jax.random.wrap_key_data(data), view)

    return jax.jit(one)


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)))


def _key_data(key: jax.Array | None, count: int, rows: int) -> np.ndarray:
    """Return the words of a key for each row, by default of the reading and the row.

    A key is that of a single row, and is split for several.
    """
    if key is None:
        words = np.zeros((rows, 2), np.uint32)
        words[:, 0] = count
        words[:, 1] = np.arange(rows)
        return words
    keys = key[None] if rows == 1 else jax.random.split(key, rows)
    return np.asarray(jax.random.key_data(keys))


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)
