"""Runs of several processes: joining, one decision a step, and the end when a process is lost."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from anytouch_jax.errors import ConfigError, UserError
from anytouch_jax.train.progress import Terminated

Tree = Any
HEARTBEAT = 60  # seconds until a silent process counts as lost
PATIENCE = 10  # seconds for the other processes to meet the same mistake
_CONTINUE = "run the same command again to continue from the last complete checkpoint"
# How many processes there are: set by the user, by srun, by mpirun. All else is left to jax's own detection.
_COUNTS = ("JAX_NUM_PROCESSES", "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")


@dataclass(frozen=True)
class Process:
    """This process among those of a run: number `index` of `count`."""

    count: int
    index: int

    def __str__(self) -> str:
        return f"process {self.index} of {self.count}"


def process_count(environ: Mapping[str, str] = os.environ) -> int:
    """Return how many processes the launcher started, 1 without a launcher. Raises ConfigError."""
    return next((_number(environ, name) for name in _COUNTS if environ.get(name)), 1)


@contextlib.contextmanager
def joined(environ: Mapping[str, str] = os.environ) -> Iterator[Process | None]:
    """Join the other processes of a run while the block runs. A single process gets None.

    `jax.distributed.initialize` detects the launcher. By hand and on Kubernetes, set JAX_COORDINATOR_ADDRESS (host:port
    of process 0), JAX_NUM_PROCESSES and JAX_PROCESS_ID. Enter it before anything asks jax for a device. When the block
    fails, this process reports the error and exits at once: with 2 after a UserError, 130 after Ctrl-C, else 1.
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
        with contextlib.suppress(OSError):  # the reader of these streams may be gone
            sys.stdout.flush()
            sys.stderr.write(f"{process or 'this process'}: {message}\n")
            sys.stderr.flush()
        if process and isinstance(error, UserError):  # wait for the others: jax aborts one whose coordinator leaves
            (thread := threading.Thread(target=_shutdown, daemon=True)).start()
            thread.join(PATIENCE)
        os._exit(status)  # jax's threads and exit handlers would wait for processes that have ended


def _initialize(environ: Mapping[str, str]) -> Process:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_enable_preemption_service", False)  # it would swallow SIGTERM, which `Ballot` shares
    kwargs: dict[str, Any] = {"coordinator_address": environ.get("JAX_COORDINATOR_ADDRESS")}
    if environ.get("JAX_PROCESS_ID"):
        kwargs |= {"process_id": _number(environ, "JAX_PROCESS_ID"), "cluster_detection_method": "deactivate"}
    count = process_count(environ)  # SLURM_NTASKS, which jax reads, may be that of another job step
    try:
        jax.distributed.initialize(num_processes=count, heartbeat_timeout_seconds=HEARTBEAT, **kwargs)
    except (RuntimeError, ValueError, KeyError) as error:
        raise UserError(
            f"cannot join the other processes ({_first_line(error)}). Set JAX_COORDINATOR_ADDRESS to host:port of "
            "process 0, JAX_NUM_PROCESSES and JAX_PROCESS_ID, start all processes, and open that port."
        ) from None
    return Process(jax.process_count(), jax.process_index())


def _exit_message(error: BaseException) -> tuple[str, int]:
    """Return the report of the error that ends this process, and its exit status."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", 130
    if isinstance(error, Terminated):
        return "stopped by SIGTERM before the first step", 0
    if isinstance(error, UserError):
        return str(error), 2
    if isinstance(error, jax.errors.JaxRuntimeError):  # a collective fails so when another process was lost
        return f"{_first_line(error)}; if another process was lost, {_CONTINUE}", 1
    return "".join(traceback.format_exception(error)) + _CONTINUE, 1


def _shutdown() -> None:
    with contextlib.suppress(Exception):
        jax.distributed.shutdown()


def _number(environ: Mapping[str, str], name: str) -> int:
    if not environ[name].isdigit():
        raise ConfigError(f"the environment variable {name} must be a whole number, not {environ[name]!r}")
    return int(environ[name])


def _first_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


class Ballot:
    """One vote of each process at each step: the signal it received, and how many samples it skipped.

    The result is read a step later, so that no step waits for it.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._sharding = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
        devices = self._sharding.num_devices // jax.process_count()  # of one process: all cast the same vote
        self._count = jax.jit(
            lambda votes: (jnp.max(votes[:, 0]), jnp.sum(votes[:, 1]) // devices),
            out_shardings=NamedSharding(mesh, PartitionSpec()),
        )

    def cast(self, number: int, skipped: int) -> tuple[jax.Array, jax.Array]:
        """Return the largest `number` and the sum of `skipped` over the processes, both i32 ()."""
        shape, vote = (self._sharding.num_devices, 2), np.array([[number, skipped]], np.int32)
        return self._count(jax.make_array_from_callback(shape, self._sharding, lambda _: vote))


def gather(tree: Tree) -> Tree:
    """Return a tree of arrays sharded over several processes as numpy. Every process must call it.

    In a run of one process the tree is returned unchanged.
    """
    return tree if jax.process_count() == 1 else multihost_utils.process_allgather(tree, tiled=True)


def broadcast(number: int) -> int:
    """Return the number that process 0 passes. Every process must call it."""
    return number if jax.process_count() == 1 else int(multihost_utils.broadcast_one_to_all(np.int32(number)))


def check_shared(folder: Path) -> None:
    """Check that every process can see a folder that process 0 made. Raises UserError in every process."""
    if jax.process_count() == 1:
        return
    multihost_utils.sync_global_devices(f"{folder} is made")
    visible = multihost_utils.process_allgather(np.int32(folder.is_dir()))
    if not visible.all():
        blind = ", ".join(str(i) for i in np.flatnonzero(visible == 0))
        raise UserError(f"{folder} is not visible to process {blind}. Choose a run folder on a disk that all share.")
