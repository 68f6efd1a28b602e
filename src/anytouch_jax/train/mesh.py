"""Device mesh, and the sharding of batches and parameters over it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from anytouch_jax.errors import ConfigError
from anytouch_jax.files import cache_folder, remove_old
from anytouch_jax.train.optim import SMALL

Tree = Any
BATCH_AXES = ("data", "fsdp")


def make_mesh(data: int | None = None, fsdp: int = 1, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """Return a mesh with axes (data, fsdp). `data` None takes all devices. Raises ConfigError if there are too few."""
    devices = list(jax.devices() if devices is None else devices)
    if fsdp < 1 or (data is None and len(devices) % fsdp):
        raise ConfigError(f"--run.fsdp {fsdp} must be a divisor of the {len(devices)} devices")
    data = len(devices) // fsdp if data is None else data
    if not 0 < data * fsdp <= len(devices):
        raise ConfigError(f"a mesh of {data} x {fsdp} needs {data * fsdp} devices, but there are {len(devices)}")
    auto = (AxisType.Auto, AxisType.Auto)  # jit places the computation: the default is explicit axes
    return jax.make_mesh((data, fsdp), BATCH_AXES, axis_types=auto, devices=devices[: data * fsdp])


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Return the sharding of a batch: its rows over all devices."""
    return NamedSharding(mesh, PartitionSpec(BATCH_AXES))


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding that keeps a whole copy on each device."""
    return NamedSharding(mesh, PartitionSpec())


def state_sharding(abstract_state: Tree, mesh: Mesh, *, small: int = SMALL) -> Tree:
    """Return a sharding for each array of a state: its largest divisible axis over "fsdp".

    Vectors (a long one has many small arrays, see `optim.packing`), arrays of fewer than `small` elements, and those
    without a divisible axis are copied to each device.
    """
    parts = mesh.shape["fsdp"]

    def place(leaf: Any) -> NamedSharding:
        divisible = [(size, axis) for axis, size in enumerate(leaf.shape) if size % parts == 0]
        if parts == 1 or not divisible or len(leaf.shape) < 2 or np.prod(leaf.shape) < small:
            return replicated(mesh)
        return NamedSharding(mesh, PartitionSpec(*[None] * max(divisible)[1], "fsdp"))

    return jax.tree.map(place, abstract_state)


def put_state(tree: Tree, places: Tree) -> Tree:
    """Copy a host's tree to the devices, each array by its sharding. Every process passes the same tree.

    Arrays are never shared with the caller, because the step donates its state.
    """
    # Through the host: `device_put` shares an array that is on one of several devices, whatever `may_alias` is.
    host = jax.tree.map(np.asarray, tree)
    if jax.process_count() == 1:
        return jax.device_put(host, places, may_alias=False)
    # device_put would compare every array among all processes.
    return jax.tree.map(lambda x, place: jax.make_array_from_callback(x.shape, place, x.__getitem__), host, places)


def gathering(loss_fn: Callable[..., Any], mesh: Mesh) -> Callable[..., Any]:
    """Return `loss_fn(params, ...)` that gathers sharded parameters just before their use.

    State and optimiser stay sharded (ZeRO, Rajbhandari et al., 2020). XLA alone would shard activations along the axis
    of a parameter, and send twice the bytes.
    """
    if mesh.shape["fsdp"] == 1:
        return loss_fn

    def gathered(params: Tree, *rest: Any) -> Any:
        return loss_fn(jax.lax.with_sharding_constraint(params, replicated(mesh)), *rest)

    return gathered


def donated() -> tuple[int, ...]:
    """Return the arguments of a step that are donated, for `jax.jit(donate_argnums=...)`: the state, on an accelerator.

    On a CPU none is: XLA would copy every parameter and moment (`experiments/results/tried.md`).
    """
    return () if jax.default_backend() == "cpu" else (0,)


def put_batch(batch: Tree, sharding: NamedSharding) -> Tree:
    """Send a host batch to the devices. Each of several processes passes its own share of the rows.

    Raises ConfigError if the rows cannot be divided evenly.
    """
    devices, processes = sharding.num_devices, jax.process_count()
    for leaf in jax.tree.leaves(batch):
        rows = leaf.shape[0] * processes
        if rows % devices:
            raise ConfigError(f"{rows} rows cannot be divided among {devices} devices. Choose a multiple with --batch.")
    if processes == 1:
        return jax.device_put(batch, sharding)
    return jax.tree.map(lambda x: jax.make_array_from_process_local_data(sharding, np.asarray(x)), batch)


def enable_compilation_cache(folder: Path | str | None = None) -> Path | None:
    """Keep compiled programs on disk for the next start. Return the folder, or None if it cannot be made.

    The default is `cache_folder`. Programs older than 60 days are removed.
    """
    folder = cache_folder() if folder is None else Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    remove_old(folder, "*-cache")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    compilation_cache.reset_cache()  # a program compiled before would have switched the cache off
    return folder
