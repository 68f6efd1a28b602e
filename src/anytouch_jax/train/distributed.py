"""Runs of several processes: how they find each other, agree to stop, and end when one of them is lost."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
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
HEARTBEAT = 60  # seconds until a process that is silent counts as lost, where no collective has told before
PATIENCE = 10  # seconds for the others to find the mistake that this one has found
_GO_ON = "the same command goes on from the last complete checkpoint"
# What libraries say when a collective or the coordination between processes has failed.
_PEERS = re.compile(r"gloo|nccl|rccl|peer|connection|unavailable|coordination|heartbeat|barrier|deadline", re.I)
_MOURNER = "import sys; sys.stdin.buffer.read() == b'.' or sys.stderr.write(sys.argv[1])"
# launcher -> how many processes it started, which of them this one is, which of those on this machine
_LAUNCHERS = {
    "slurm": ("SLURM_STEP_NUM_TASKS", "SLURM_PROCID", "SLURM_LOCALID"),
    "ompi": ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_LOCAL_RANK"),
}


@dataclass(frozen=True)
class Place:
    """This process among those of a run: number `index` of `count`, number `local` on its machine (None: not known).

    `coordinator` is host:port of process 0; without it jax asks the `launcher` ("slurm", "ompi").
    """

    count: int
    index: int
    local: int | None = None
    coordinator: str | None = None
    launcher: str | None = None

    def __str__(self) -> str:
        return f"process {self.index} of {self.count}"


def find_place(environ: Mapping[str, str] = os.environ) -> Place | None:
    """What the environment says of a run of several processes; None for one process alone.

    By hand or on Kubernetes: JAX_COORDINATOR_ADDRESS (host:port), JAX_NUM_PROCESSES and JAX_PROCESS_ID. Under `srun`
    and Open MPI's `mpirun` the launcher gives the numbers, and where jax can ask it, the address. Raises ConfigError.
    """
    coordinator = environ.get("JAX_COORDINATOR_ADDRESS") or None
    launcher = next((name for name, names in _LAUNCHERS.items() if all(n in environ for n in names)), None)
    if coordinator and (launcher is None or "JAX_PROCESS_ID" in environ):
        count, index = (_number(environ, name) for name in ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID"))
        place = Place(count, index, None, coordinator)
    elif launcher:
        count, index, local = (_number(environ, name) for name in _LAUNCHERS[launcher])
        place = Place(count, index, local, coordinator, launcher)
    elif environ.get("JAX_NUM_PROCESSES", "1") != "1":  # else each of them would train alone, in one folder
        raise ConfigError("JAX_NUM_PROCESSES needs JAX_COORDINATOR_ADDRESS=host:port too, of the process of number 0")
    else:
        return None
    if not index < max(count, 1):
        raise ConfigError(f"JAX_PROCESS_ID must be below JAX_NUM_PROCESSES={count}, not {index}")
    if count > 1 and launcher == "ompi" and coordinator is None and "OMPI_MCA_orte_hnp_uri" not in environ:
        raise ConfigError(
            "this Open MPI does not tell where its first process runs; add -x JAX_COORDINATOR_ADDRESS=host:port to "
            "mpirun, with the host of process 0 and a free port there"
        )
    return place if count > 1 else None


def _number(environ: Mapping[str, str], name: str) -> int:
    value = environ.get(name, "")
    if not value.isdigit():
        raise ConfigError(f"JAX_COORDINATOR_ADDRESS is set, so {name} must be a number, not {value!r}")
    return int(value)


@contextlib.contextmanager
def joined(environ: Mapping[str, str] = os.environ) -> Iterator[Place | None]:
    """Join the other processes of a run while the block runs; where `find_place` finds one alone, nothing happens.

    Must be entered before anything asks jax for a device. When the block fails, or another process is lost, this one
    says so in one sentence and ends at once with status 1 (130 after Ctrl-C): it must not wait for the others, but
    `PATIENCE` seconds after a mistake that they are likely to find as well.
    """
    place = find_place(environ)
    if place is None:
        yield None
        return
    speaker = _last_words(place)
    try:
        _initialize(place)
        yield place
        jax.distributed.shutdown()
    except BaseException as error:
        sentence, status = _farewell(error, place)
        with contextlib.suppress(OSError):  # whoever read this may be gone, too
            speaker.communicate(b".")
            sys.stdout.flush()
            sys.stderr.write(f"{sentence}\n")
            sys.stderr.flush()
        if isinstance(error, UserError):
            _leave_together()
        os._exit(status)  # the threads and exit handlers of jax would wait for processes that are no more
    speaker.communicate(b".")


def _initialize(place: Place) -> None:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_enable_preemption_service", False)  # it would keep SIGTERM to itself; see `Ballot`
    found: dict[str, Any] = {"cluster_detection_method": place.launcher}
    if place.coordinator is not None:
        found = {"cluster_detection_method": "deactivate"}
        if place.local is not None and "JAX_LOCAL_DEVICE_IDS" not in os.environ:
            found["local_device_ids"] = place.local  # one accelerator each, as jax does where it asks the launcher
    try:
        jax.distributed.initialize(
            place.coordinator, place.count, place.index, heartbeat_timeout_seconds=HEARTBEAT, **found
        )
    except (RuntimeError, ValueError) as error:
        where = place.coordinator or f"the address that {place.launcher} gives"
        raise UserError(
            f"could not join the other processes at {where} ({_short(error)}); see that all of them were started and "
            "that this port is free there and open from here"
        ) from None


def _farewell(error: BaseException, place: Place) -> tuple[str, int]:
    """What to say of the error that ends this process, and its exit status."""
    if isinstance(error, KeyboardInterrupt):
        return f"{place} was interrupted", 130
    if isinstance(error, Terminated):
        return f"{place} was stopped by SIGTERM before a step was under way", 0
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, jax.errors.JaxRuntimeError) and _PEERS.search(str(cause)):
            return f"{place} ends because another one was lost ({_short(cause)}); {_GO_ON}", 1
        cause = cause.__cause__ or cause.__context__
    if isinstance(error, UserError):
        return f"{place}: {error}", 1
    return "".join(traceback.format_exception(error)) + f"{place} ends for the error above; {_GO_ON}", 1


def _leave_together() -> None:
    """Wait for those who found the same mistake: jax aborts a process whose coordinator leaves before it."""

    def leave() -> None:
        with contextlib.suppress(Exception):
            jax.distributed.shutdown()

    leaving = threading.Thread(target=leave, daemon=True)
    leaving.start()
    leaving.join(PATIENCE)


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


def _last_words(place: Place) -> subprocess.Popen[bytes]:
    """A child process that speaks for this one if it is killed, or aborted by a library that noticed a lost one.

    It waits for the end of its input, and is silent when a dot comes first.
    """
    sentence = f"{place} was killed, or gave up because another one was lost; {_GO_ON}\n"
    command = [sys.executable, "-S", "-E", "-c", _MOURNER, sentence]
    return subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)


class Ballot:
    """What the processes tell each other of a step: has one been told to stop, how many samples were skipped by all?

    Cast at every step and read a step later, so that no step waits for it.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._place = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
        own = self._place.num_devices // jax.process_count()  # devices of a process: all cast the same
        self._count = jax.jit(
            lambda votes: (jnp.max(votes[:, 0]), jnp.sum(votes[:, 1]) // own),
            out_shardings=NamedSharding(mesh, PartitionSpec()),
        )

    def cast(self, number: int, skipped: int) -> tuple[jax.Array, jax.Array]:
        """The largest `number` and the sum of `skipped` over the processes at this turn, i32 (): to be read later."""
        shape, vote = (self._place.num_devices, 2), np.array([[number, skipped]], np.int32)
        return self._count(jax.make_array_from_callback(shape, self._place, lambda _: vote))


def whole(tree: Tree) -> Tree:
    """A tree of arrays that lie on the devices of several processes as numpy; of one process: as it is.

    Every process must call it.
    """
    return tree if jax.process_count() == 1 else multihost_utils.process_allgather(tree, tiled=True)


def told_by_first(number: int) -> int:
    """The number that process 0 has; every process must call it."""
    return number if jax.process_count() == 1 else int(multihost_utils.broadcast_one_to_all(np.int32(number)))


def check_shared(folder: Path) -> None:
    """Raise UserError in every process when a folder that process 0 has made cannot be seen by all of them."""
    if jax.process_count() == 1:
        return
    multihost_utils.sync_global_devices(f"{folder} is made")
    seen = multihost_utils.process_allgather(np.int32(folder.is_dir()))
    if not seen.all():
        blind = ", ".join(str(i) for i in np.flatnonzero(seen == 0))
        raise UserError(f"{folder} is not seen by process {blind}: give a folder on a disk that all processes share")
