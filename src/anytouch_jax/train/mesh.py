"""Devices: the mesh, and how batches and parameters are laid out on it."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from anytouch_jax.errors import ConfigError
from anytouch_jax.train.pack import SMALL

Tree = Any
BATCH_AXES = ("data", "fsdp")
CACHE_DAYS = 60  # a compiled program is kept


def make_mesh(data: int | None = None, fsdp: int = 1, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """A mesh with axes (data, fsdp). `data` None takes all devices. Raises ConfigError when there are too few.

    Axes are of type Auto, so that jit places the computation; `jax.make_mesh` would choose explicit ones.
    """
    devices = list(jax.devices() if devices is None else devices)
    if fsdp < 1 or (data is None and len(devices) % fsdp):
        raise ConfigError(f"--run.fsdp {fsdp} must be a divisor of the {len(devices)} devices")
    data = len(devices) // fsdp if data is None else data
    if not 0 < data * fsdp <= len(devices):
        raise ConfigError(f"a mesh of {data} x {fsdp} needs {data * fsdp} devices, but there are {len(devices)}")
    return jax.make_mesh(
        (data, fsdp), BATCH_AXES, axis_types=(AxisType.Auto, AxisType.Auto), devices=devices[: data * fsdp]
    )


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Rows of a batch over all devices."""
    return NamedSharding(mesh, PartitionSpec(BATCH_AXES))


def replicated(mesh: Mesh) -> NamedSharding:
    """A whole copy on each device."""
    return NamedSharding(mesh, PartitionSpec())


def state_sharding(abstract_state: Tree, mesh: Mesh, *, small: int = SMALL) -> Tree:
    """A sharding for each array of a state: over "fsdp" on its largest divisible axis; copies where that axis is 1.

    Arrays of fewer than `small` elements, or without a divisible axis, are copied to each device. So are vectors:
    a long one is the optimiser's, packed from many small arrays (`pack`), and to cut it would send each of them about.
    """
    parts = mesh.shape["fsdp"]

    def place(leaf: Any) -> NamedSharding:
        divisible = [(size, axis) for axis, size in enumerate(leaf.shape) if size % parts == 0]
        if parts == 1 or not divisible or len(leaf.shape) < 2 or np.prod(leaf.shape) < small:
            return replicated(mesh)
        _, axis = max(divisible)
        return NamedSharding(mesh, PartitionSpec(*[None] * axis, "fsdp"))

    return jax.tree.map(place, abstract_state)


def put_state(tree: Tree, places: Tree) -> Tree:
    """Copy a host's tree to the devices, each array to its place; every process has the same tree and gives its part.

    A copy also where it could be shared, and by way of the host: the step donates its state, and must not delete the
    caller's own arrays, but `device_put` shares one that lies on one of several devices whatever `may_alias` says.
    """
    host = jax.tree.map(np.asarray, tree)
    if jax.process_count() == 1:
        return jax.device_put(host, places, may_alias=False)
    # Not device_put: it would compare every array among all processes.
    return jax.tree.map(lambda x, place: jax.make_array_from_callback(x.shape, place, x.__getitem__), host, places)


def gathering(loss_fn: Callable[..., Any], mesh: Mesh) -> Callable[..., Any]:
    """`loss_fn(params, ...)` with sharded parameters made whole just before their use; as it is without "fsdp".

    Else XLA's partitioner cuts activations along the axis of a parameter, and exchanges those: twice the bytes. State
    and optimiser stay cut (ZeRO, Rajbhandari et al., 2020); whole parameters and gradients are there during a step.
    """
    if mesh.shape["fsdp"] == 1:
        return loss_fn

    def gathered(params: Tree, *rest: Any) -> Any:
        return loss_fn(jax.lax.with_sharding_constraint(params, replicated(mesh)), *rest)

    return gathered


def donated() -> tuple[int, ...]:
    """Which arguments of a step its compiled program may overwrite, for `jax.jit(donate_argnums=...)`: the state.

    On a CPU none: XLA copies a donated array that several of its kernels read before it is overwritten, which is every
    parameter and moment, and the step takes longer (`python -m experiments.benchmarks.run stage1` has both).
    """
    return () if jax.default_backend() == "cpu" else (0,)


def put_batch(batch: Tree, sharding: NamedSharding) -> Tree:
    """Send a host batch to the devices; with several processes each gives its own share of the rows.

    Raises ConfigError when the rows cannot be shared out evenly.
    """
    devices, processes = sharding.num_devices, jax.process_count()
    for leaf in jax.tree.leaves(batch):
        rows = leaf.shape[0] * processes
        if rows % devices:
            raise ConfigError(f"a batch axis of {rows} rows cannot be shared by {devices} devices; choose a multiple")
    if processes == 1:
        return jax.device_put(batch, sharding)
    return jax.tree.map(lambda x: jax.make_array_from_process_local_data(sharding, np.asarray(x)), batch)


def enable_compilation_cache(folder: Path | str | None = None) -> Path | None:
    """Keep compiled programs on disk, so that the next start of the same run need not compile again.

    The default folder is anytouch_jax under $XDG_CACHE_HOME or ~/.cache; programs of more than CACHE_DAYS ago are
    removed from it. Returns it, or None where it cannot be made.
    """
    if folder is None:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "anytouch_jax"
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    old = time.time() - CACHE_DAYS * 86400
    for file in folder.glob("*-cache"):
        with contextlib.suppress(OSError):  # another process removes it, or it is somebody else's
            if file.stat().st_mtime < old:
                file.unlink()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    compilation_cache.reset_cache()  # else a program compiled before would have switched it off for good
    return folder
