"""Mesh of devices, sharding over it, and the processes of a run: joining, voting, losing one."""

import contextlib
import os
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.experimental.compilation_cache import compilation_cache
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from anytouch_jax.errors import ConfigError, Terminated, UserError
from anytouch_jax.files import cache_folder, remove_old
from anytouch_jax.train.optim import SMALL

Tree = Any
BATCH_AXES = ("data", "fsdp")
HEARTBEAT = 60  # seconds until a silent process counts as lost
PATIENCE = 10  # seconds for the other processes to meet the same mistake
_CONTINUE = "run the same command again to continue from the last complete checkpoint"
# How many processes there are: set by the user, by srun, by mpirun. All else is left to jax's own
# detection.
_COUNTS = ("JAX_NUM_PROCESSES", "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")


def make_mesh(
    data: int | None = None, fsdp: int = 1, devices: Sequence[jax.Device] | None = None
) -> Mesh:
    """Return a mesh with axes (data, fsdp).

    `data` None takes all devices. Raises ConfigError if there are too few.
    """
    devices = list(jax.devices() if devices is None else devices)
    if fsdp < 1 or (data is None and len(devices) % fsdp):
        raise ConfigError(f"--run.fsdp {fsdp} must be a divisor of the {len(devices)} devices")
    data = len(devices) // fsdp if data is None else data
    if not 0 < data * fsdp <= len(devices):
        raise ConfigError(
            f"a mesh of {data} x {fsdp} needs {data * fsdp} devices, but there are {len(devices)}"
        )
    # "auto" lets jit place the computation. With jax's default, explicit axes, every operation of
    # the network would have to name its sharding.
    auto = (AxisType.Auto, AxisType.Auto)
    return jax.make_mesh((data, fsdp), BATCH_AXES, axis_types=auto, devices=devices[: data * fsdp])


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Return the sharding of a batch: its rows over all devices."""
    return NamedSharding(mesh, PartitionSpec(BATCH_AXES))


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding that keeps a whole copy on each device."""
    return NamedSharding(mesh, PartitionSpec())


def state_sharding(abstract_state: Tree, mesh: Mesh, *, small: int = SMALL) -> Tree:
    """Return a sharding for each array of a state: its largest divisible axis over "fsdp".

    Vectors, arrays of fewer than `small` elements, and those without a divisible axis are copied to
    each device.
    """
    parts = mesh.shape["fsdp"]

    def place(leaf: Any) -> NamedSharding:
        divisible = [(size, axis) for axis, size in enumerate(leaf.shape) if size % parts == 0]
        is_small = len(leaf.shape) < 2 or np.prod(leaf.shape) < small
        # A small array costs more to gather than to keep.
        if parts == 1 or not divisible or is_small:
            return replicated(mesh)
        _, axis = max(divisible)
        return NamedSharding(mesh, PartitionSpec(*[None] * axis, "fsdp"))

    return jax.tree.map(place, abstract_state)


def put_state(tree: Tree, places: Tree) -> Tree:
    """Copy a host's tree, the same in every process, to the devices.

    No array is shared: a step donates its state.
    """
    # Through the host: `device_put` shares an array that is on one of several devices, whatever
    # `may_alias` is.
    host = jax.tree.map(np.asarray, tree)
    if jax.process_count() == 1:
        return jax.device_put(host, places, may_alias=False)
    # device_put would compare every array among all processes.
    return jax.tree.map(
        lambda x, place: jax.make_array_from_callback(x.shape, place, x.__getitem__), host, places
    )


def gathering(loss_fn: Callable[..., Any], mesh: Mesh) -> Callable[..., Any]:
    """Return `loss_fn(params, ...)` that gathers sharded parameters just before their use.

    This is ZeRO (Rajbhandari et al., 2020). XLA alone would shard activations along the axis of a
    parameter, and send twice the bytes.
    """
    if mesh.shape["fsdp"] == 1:
        return loss_fn

    def gathered(params: Tree, *rest: Any) -> Any:
        return loss_fn(jax.lax.with_sharding_constraint(params, replicated(mesh)), *rest)

    return gathered


def donated() -> tuple[int, ...]:
    """Return which arguments of a step are donated, for `jax.jit(donate_argnums=...)`.

    On an accelerator it is the state. On a CPU none is: XLA would copy every parameter and moment
    (`experiments/results/tried.md`).
    """
    if jax.default_backend() == "cpu":
        return ()
    return (0,)


def put_batch(batch: Tree, sharding: NamedSharding) -> Tree:
    """Send a host batch to the devices, its rows over all of them.

    Each process has its own part of the rows. Raises ConfigError for a remainder.
    """
    devices = sharding.num_devices
    processes = jax.process_count()
    for leaf in jax.tree.leaves(batch):
        rows = leaf.shape[0] * processes
        if rows % devices:
            raise ConfigError(
                f"{rows} rows cannot be divided among {devices} devices. Choose a multiple with "
                "--batch."
            )
    if processes == 1:
        return jax.device_put(batch, sharding)
    return jax.tree.map(
        lambda x: jax.make_array_from_process_local_data(sharding, np.asarray(x)), batch
    )


def enable_compilation_cache(folder: Path | str | None = None) -> Path | None:
    """Keep compiled programs on disk for 60 days, in `cache_folder`.

    Return the folder, None if it cannot be made.
    """
    folder = cache_folder() if folder is None else Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    remove_old(folder, "*-cache")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # jax decides at its first compilation whether it has a cache. A program compiled before would
    # have switched it off.
    compilation_cache.reset_cache()
    return folder


@dataclass(frozen=True)
class _Process:
    """This process among those of a run: number `index` of `count`."""

    count: int
    index: int

    def __str__(self) -> str:
        return f"process {self.index} of {self.count}"


def process_count(environ: Mapping[str, str] = os.environ) -> int:
    """Return how many processes the launcher started, 1 without a launcher. Raises ConfigError."""
    return next((_number(environ, name) for name in _COUNTS if environ.get(name)), 1)


@contextlib.contextmanager
def joined(environ: Mapping[str, str] = os.environ) -> Iterator[_Process | None]:
    """Join the other processes of a run while the block runs. A single process gets None.

    `jax.distributed.initialize` detects the launcher. By hand and on Kubernetes, set
    JAX_COORDINATOR_ADDRESS (host:port of process 0), JAX_NUM_PROCESSES and JAX_PROCESS_ID. Enter it
    before anything asks jax for a device. When the block fails, this process exits at once: with 2
    after a UserError, 130 after Ctrl-C, else 1.
    """
    if process_count(environ) < 2:
        yield None
        return
    process = None
    try:
        process = _initialize(environ)
        yield process
        jax.distributed.shutdown()
    except BaseException as error:
        message, status = _exit_message(error)
        # the reader of these streams may be gone
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.write(f"{process or 'this process'}: {message}\n")
            sys.stderr.flush()
        if process and isinstance(error, UserError):
            # All processes meet the same mistake. Wait for the others to report it, because jax
            # aborts a process whose coordinator leaves.
            thread = threading.Thread(target=_shutdown, daemon=True)
            thread.start()
            thread.join(PATIENCE)
        # jax's threads and exit handlers would wait for processes that have ended
        os._exit(status)


def _initialize(environ: Mapping[str, str]) -> _Process:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    # it would swallow SIGTERM, which `FlagReduction` shares
    jax.config.update("jax_enable_preemption_service", False)
    kwargs: dict[str, Any] = {"coordinator_address": environ.get("JAX_COORDINATOR_ADDRESS")}
    if environ.get("JAX_PROCESS_ID"):
        kwargs |= {
            "process_id": _number(environ, "JAX_PROCESS_ID"),
            "cluster_detection_method": "deactivate",
        }
    # SLURM_NTASKS, which jax reads, may be that of another job step
    count = process_count(environ)
    try:
        jax.distributed.initialize(
            num_processes=count, heartbeat_timeout_seconds=HEARTBEAT, **kwargs
        )
    except (RuntimeError, ValueError, KeyError) as error:
        raise UserError(
            f"cannot join the other processes ({_first_line(error)}). Set JAX_COORDINATOR_ADDRESS "
            "to host:port of process 0, JAX_NUM_PROCESSES and JAX_PROCESS_ID, start all processes, "
            "and open that port."
        ) from None
    return _Process(jax.process_count(), jax.process_index())


def _exit_message(error: BaseException) -> tuple[str, int]:
    """Return the report of the error that ends this process, and its exit status."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", 130
    if isinstance(error, Terminated):
        return "stopped by SIGTERM before the first step", 0
    if isinstance(error, UserError):
        return str(error), 2
    if isinstance(error, jax.errors.JaxRuntimeError):
        # a collective fails so when another process was lost
        return f"{_first_line(error)}; if another process was lost, {_CONTINUE}", 1
    return "".join(traceback.format_exception(error)) + _CONTINUE, 1


def _shutdown() -> None:
    with contextlib.suppress(Exception):
        jax.distributed.shutdown()


def _number(environ: Mapping[str, str], name: str) -> int:
    if not environ[name].isdigit():
        raise ConfigError(
            f"the environment variable {name} must be a whole number, not {environ[name]!r}"
        )
    return int(environ[name])


def _first_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


class FlagReduction:
    """All-reduce of two flags at each step: the signal a process received, its skipped samples.

    All processes must leave the loop after the same step, or the next collective waits for ever.
    The result is read a step later, so that no process waits for it.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._sharding = batch_sharding(mesh)
        # The devices of a process hold the same vote, which counts once.
        devices = self._sharding.num_devices // jax.process_count()
        self._count = jax.jit(
            lambda votes: (jnp.max(votes[:, 0]), jnp.sum(votes[:, 1]) // devices),
            out_shardings=replicated(mesh),
        )

    def cast(self, number: int, skipped: int) -> tuple[jax.Array, jax.Array]:
        """Return the largest `number` and the sum of `skipped` over the processes, both i32 ()."""
        shape = (self._sharding.num_devices, 2)
        vote = np.array([[number, skipped]], np.int32)
        return self._count(jax.make_array_from_callback(shape, self._sharding, lambda _: vote))


def gather(tree: Tree) -> Tree:
    """Return a tree of arrays as numpy, sharded over several processes or not.

    Every process must call it.
    """
    if jax.process_count() == 1:
        return tree
    return multihost_utils.process_allgather(tree, tiled=True)


def broadcast(number: int) -> int:
    """Return the number that process 0 passes. Every process must call it."""
    if jax.process_count() == 1:
        return number
    return int(multihost_utils.broadcast_one_to_all(np.int32(number)))


def check_shared(folder: Path) -> None:
    """Check that every process can see a folder that process 0 made.

    Raises UserError in every process.
    """
    if jax.process_count() == 1:
        return
    multihost_utils.sync_global_devices(f"{folder} is made")
    visible = multihost_utils.process_allgather(np.int32(folder.is_dir()))
    if not visible.all():
        blind = ", ".join(str(i) for i in np.flatnonzero(visible == 0))
        raise UserError(
            f"{folder} is not visible to process {blind}. Choose a run folder on a disk that all "
            "share."
        )
