"""Checkpoints of a run: the one file that knows Orbax (its v1 API), and the record that each
checkpoint has of itself.

A checkpoint is a folder `<checkpoints>/<step>` that appears whole or not at all: it is written
under another name, then renamed. Its `checkpoint.json` stores config, metadata, metrics, and the
size and checksum of every file, and a folder is read only if its files match. Arrays are stored by
name: parameters can be read without the optimiser.
"""

# Orbax's `training.Checkpointer` renames a folder itself once the arrays are written. Our record
# needs the checksums of the written files, and must be in the folder before that rename: a kill
# between the two left a checkpoint that could not be verified. So the rename is ours.

from __future__ import annotations

import errno
import json
import logging
import math
import os
import re
import shutil
import sys
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from anytouch_jax.config import parse_json
from anytouch_jax.errors import UserError
from anytouch_jax.weights.tree import flatten, nest

Tree = Any

RECORD = "checkpoint.json"
FORMAT = "anytouch_jax.checkpoint.1"
PARTIAL = "partial"  # a metric of checkpoints whose loss covers fewer steps than that of others
_STEP = re.compile(r"\d{8,}")
# being written or removed, by us or by Orbax
_UNFINISHED = re.compile(r"\d{8,}\.(writing|deleted)(\..+)?")
_AVERAGE = "opt_state/ema/"  # runs of an older version may have an average of the parameters
_LISTED = 5  # names in one error message
_LINGER = 5.0  # seconds for threads of a failed save
_TRIES = 3  # to read the latest checkpoint of a running run
_PATIENCE = 30.0  # seconds for a save whose other processes may be lost
_CHUNK = 1 << 22
# Orbax allows one running operation a process: a load during a save ends the save
_ORBAX = threading.Lock()


class CheckpointError(UserError):
    """A checkpoint that cannot be written or read; the message is one sentence that names the
    path.
    """


def quiet_hook(hook: Callable[..., Any]) -> Callable[..., Any]:
    """Return an exception hook without what Tensorstore's threads raise for each write after the
    first failed one.
    """

    def quiet(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if kind is not RuntimeError or str(error) != "Event loop is closed":
            hook(kind, error, trace)

    return quiet


_is_quiet = False


def _quieten() -> None:
    """Let errors of Orbax be told once, by us. It is done when Orbax is first used."""
    global _is_quiet
    if _is_quiet:
        return
    _is_quiet = True
    # Orbax logs the traceback of every error in its threads, which it raises too.
    absl = logging.getLogger("absl")
    absl.addFilter(lambda record: "_SignalingThread" not in record.getMessage())
    sys.excepthook = quiet_hook(sys.excepthook)


class Checkpoints:
    """The checkpoints of one run: asynchronous saves, of which the last `keep` and the best (lowest
    `loss`) are kept.

    `config_json` and `metadata` (JSON values) are stored with every checkpoint. Leftovers of a
    killed run in `folder` are removed. Every process of a multi-process run makes one; process 0
    renames and removes.
    """

    def __init__(
        self, folder: str | Path, *, keep: int, config_json: str, metadata: dict[str, Any]
    ) -> None:
        self.folder = Path(folder).absolute()
        self._keep = keep
        self._described = {"config": config_json, "metadata": metadata}
        self._worker = ThreadPoolExecutor(1, "checkpoint")
        self._pending: tuple[Path, Future[None], Callable[[], None]] | None = None
        with self._one_sentence(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        self._sweep()

    def check_space(self, state: Tree) -> None:
        """Raise CheckpointError if the disk has less space than `state` takes: a save would find
        out late.
        """
        needed = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
        disk = shutil.disk_usage(self.folder)
        if disk.total and disk.free < needed and jax.process_count() == 1:
            raise CheckpointError(
                f"cannot write a checkpoint in {self.folder}: the disk is full. It needs "
                f"{needed:,} bytes and has {disk.free:,}. Free some space and run the same command "
                "again. Older checkpoints are untouched."
            )

    def save(self, step: int, state: Tree, metrics: Mapping[str, Any]) -> None:
        """Start saving `state`, a pytree of arrays; it may be donated or changed as soon as this
        returns.

        Waits for the previous save first, and raises its CheckpointError. A step that was saved
        before is replaced when the new one is complete.
        """
        self.wait()
        self._sweep()  # threads of a failed save may have written on
        target = self.folder / f"{step:08d}"
        # A numpy array may be written to while the save runs.
        leaves = {
            n: x if isinstance(x, jax.Array) else np.array(x) for n, x in flatten(state).items()
        }
        self.check_space(leaves)
        content = {
            **self._described,
            "step": int(step),
            "metrics": {
                name: float(value) if math.isfinite(value) else None
                for name, value in metrics.items()
            },
            "arrays": {name: [list(leaf.shape), str(leaf.dtype)] for name, leaf in leaves.items()},
        }
        # Orbax refuses arrays of size zero
        arrays = {name: leaf for name, leaf in leaves.items() if leaf.size}
        context = ocp.Context()
        # trained weights do not shrink, and a save takes twice as long
        context.array.saving.use_compression = False
        # Smaller ones are not cut among devices: each cut is a program to compile.
        context.array.saving.min_slice_bytes_for_replica_parallel = 1 << 20
        release = _acquire_orbax()
        try:
            with self._one_sentence(target), context:
                response = ocp.save_async(_writing(target), nest(arrays))
            self._pending = (
                target,
                self._worker.submit(self._finish, target, response, content, release),
                release,
            )
        except BaseException:
            release()
            raise

    def wait(self) -> None:
        """Block until the running save is on disk.

        Raises CheckpointError if it failed (a full disk).
        """
        if self._pending is None:
            return
        (target, future, _) = self._pending
        self._pending = None
        with self._one_sentence(target):
            try:
                future.result()
            # Also after a failure: the other processes are waiting for process 0 to rename.
            finally:
                if jax.process_count() > 1:
                    from jax.experimental import multihost_utils

                    multihost_utils.sync_global_devices(f"saved {target.name}")

    def latest(self) -> int | None:
        """Return the last complete step on disk, or None."""
        return max(steps(self.folder), default=None)

    def restore(self, abstract_state: Tree, step: int | None = None) -> Tree:
        """Return the state of `step` (None: the latest), with the structure and shardings of
        `abstract_state`.

        `abstract_state` is a tree of `jax.ShapeDtypeStruct` or arrays. A leaf without sharding goes
        to the first device. Raises CheckpointError if the checkpoint is missing or damaged, or if
        names, shapes or types differ.
        """
        self.wait()
        folder = find_checkpoint(self.folder, step)
        record = checked(folder)
        first = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
        wanted = {
            name: jax.ShapeDtypeStruct(
                leaf.shape, leaf.dtype, sharding=getattr(leaf, "sharding", None) or first
            )
            for name, leaf in flatten(abstract_state).items()
        }
        _compare(folder, wanted, _forms(record))
        empty = {n: x for n, x in wanted.items() if not math.prod(x.shape)}
        arrays = _load(folder, wanted) | {
            n: jax.device_put(np.zeros(x.shape, x.dtype), x.sharding) for n, x in empty.items()
        }
        return jax.tree.unflatten(
            jax.tree.structure(abstract_state), [arrays[name] for name in wanted]
        )

    def close(self) -> None:
        """Finish the running save and its housekeeping.

        Raises CheckpointError if the save failed.
        """
        self.wait()
        self._worker.shutdown()

    def leave(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """`close` at the end of a context; after an error in one of several processes, wait at most
        half a minute.
        """
        if error is None or jax.process_count() == 1:
            self.close()
            return
        if self._pending is not None:
            with suppress(Exception):
                self._pending[1].result(
                    0 if isinstance(error, jax.errors.JaxRuntimeError) else _PATIENCE
                )
            # a save that never ends, or was cancelled, must not block a load
            self._pending[2]()
        self._worker.shutdown(wait=False, cancel_futures=True)

    def _finish(
        self, target: Path, response: Any, content: dict[str, Any], release: Callable[[], None]
    ) -> None:
        """Write the record once the arrays are on disk, rename, and remove old checkpoints (on the
        worker thread).
        """
        try:
            response.result()
        finally:
            release()
        if jax.process_index() != 0:
            return
        write_record(_writing(target), content)
        if target.exists():
            _discard(target)
        _writing(target).rename(target)
        present = steps(self.folder)
        for step in set(present) - {best_of(self.folder), *present[-self._keep :]}:
            _discard(self.folder / f"{step:08d}")

    def _sweep(self) -> None:
        """Remove what is unfinished."""
        if jax.process_index() == 0:
            for entry in self.folder.glob("*.*"):
                if _UNFINISHED.fullmatch(entry.name):
                    shutil.rmtree(entry, ignore_errors=True)

    @contextmanager
    def _one_sentence(self, path: Path) -> Iterator[None]:
        """Turn an error of the storage layers while writing into a CheckpointError, and remove the
        debris.
        """
        try:
            yield
        except Exception as error:  # Orbax and tensorstore wrap OSError in several types
            for thread in threading.enumerate():
                if (
                    thread.name == "serialize_shardings"
                ):  # Orbax's, which would write on into a removed folder
                    thread.join(_LINGER)
            self._sweep()
            reason = " ".join(str(error).split())[:300]
            full = getattr(error, "errno", None) == errno.ENOSPC or "No space left" in str(error)
            advice = (
                "the disk is full, free some space and run the same command again"
                if full
                else reason
            )
            raise CheckpointError(
                f"could not write checkpoint {path}: {advice}; older ones are untouched"
            ) from error


def read_metadata(folder: str | Path, step: int | None = None) -> dict[str, Any]:
    """Return metadata, `step`, `config` (JSON) and `metrics` of a run or checkpoint.

    Raises CheckpointError.
    """
    return _description(read_record(find_checkpoint(Path(folder), step)))


def load_params(
    folder: str | Path, step: int | None = None
) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """Return (parameters as a nested dict of numpy arrays, config JSON, metadata) of a checkpoint.

    `folder` is a run, its checkpoints folder, or one checkpoint. If a running run removes the
    latest meanwhile, the next one is read. Raises CheckpointError.
    """
    for _ in range(_TRIES if step is None else 1):
        target = find_checkpoint(Path(folder), step)
        try:
            record = checked(target)
            parts = ("trainable/", "frozen/", _AVERAGE)
            forms = {name: like for name, like in _forms(record).items() if name.startswith(parts)}
            if not forms:
                raise CheckpointError(
                    f"checkpoint {target} has no parameters (nothing under trainable/ or frozen/)"
                )
            wanted = {
                name: np.broadcast_to(np.zeros((), like.dtype), like.shape)
                for name, like in forms.items()
            }
            arrays = wanted | _load(target, wanted)
        except (CheckpointError, OSError):
            if target.is_dir():
                raise
        else:
            params = {
                n.split("/", 1)[1]: leaf for n, leaf in arrays.items() if not n.startswith(_AVERAGE)
            }
            params |= {
                n.removeprefix(_AVERAGE): leaf
                for n, leaf in arrays.items()
                if n.startswith(_AVERAGE)
            }
            return nest(params), record["config"], _description(record)
    raise CheckpointError(
        f"checkpoint {target} was removed while it was read; read the latest one, or another step"
    )


def _acquire_orbax() -> Callable[[], None]:
    """Wait until no other operation of Orbax runs; return its release, which any thread may call,
    also twice.
    """
    _quieten()
    stack = ExitStack()
    stack.callback(_ORBAX.release)
    _ORBAX.acquire()
    return stack.close


def _writing(target: Path) -> Path:
    return target.with_name(f"{target.name}.writing")


def _discard(target: Path) -> None:
    """Remove a checkpoint: renamed first, so that a kill halfway leaves nothing that looks
    complete.
    """
    doomed = target.with_name(f"{target.name}.deleted")
    shutil.rmtree(doomed, ignore_errors=True)
    target.rename(doomed)
    shutil.rmtree(doomed, ignore_errors=True)


def _load(folder: Path, wanted: Mapping[str, Any]) -> dict[str, Any]:
    """Return the named arrays that are not empty, of the types of `wanted`.

    Raises CheckpointError for other shapes.
    """
    _quieten()
    # a wrong JAX_PLATFORMS is no fault of the checkpoint
    jax.local_devices()
    context = ocp.Context()
    context.pytree.loading.partial_load = True
    wanted = {name: like for name, like in wanted.items() if math.prod(like.shape)}
    try:
        with _ORBAX, context:
            stored = flatten(ocp.metadata(folder).metadata)
            # before memory is taken for them
            for name, like in wanted.items():
                form = stored.get(name)
                if form is None or (tuple(form.shape), np.dtype(form.dtype)) != (
                    like.shape,
                    np.dtype(like.dtype),
                ):
                    raise ValueError(f"{name[:200]} is not stored as {like.dtype} {like.shape}")
            if wanted:
                return flatten(ocp.load(folder, nest(wanted)))
            return {}
    except Exception as error:  # its files are whole, so this is another Orbax or a lack of memory
        reason = " ".join(str(error).split())[:300]
        raise CheckpointError(
            f"could not read checkpoint {folder} ({type(error).__name__}: {reason})"
        ) from error


def _forms(record: Mapping[str, Any]) -> dict[str, jax.ShapeDtypeStruct]:
    return {
        n: jax.ShapeDtypeStruct(tuple(shape), np.dtype(kind))
        for n, (shape, kind) in record["arrays"].items()
    }


def _compare(folder: Path, wanted: Mapping[str, Any], stored: Mapping[str, Any]) -> None:
    """Raise CheckpointError that names up to five entries if a checkpoint does not have the wanted
    form.
    """

    def form(like: Any) -> str:
        if like is None:
            return "nothing"
        return f"{tuple(like.shape)} {np.dtype(like.dtype)}"

    pairs = {
        name: (form(stored.get(name)), form(wanted.get(name)))
        for name in sorted({*wanted, *stored})
    }
    differing = [
        f"{name}: {theirs} stored, {ours} wanted"
        for name, (theirs, ours) in pairs.items()
        if theirs != ours
    ]
    if differing:
        raise CheckpointError(
            f"checkpoint {folder} does not fit this configuration, use the preset and settings it "
            f"was trained with; {len(differing)} entries differ "
            f"({'; '.join(differing[:_LISTED])}{'; ...' * (len(differing) > _LISTED)})"
        )


def _description(record: Mapping[str, Any]) -> dict[str, Any]:
    return {
        **record["metadata"],
        "step": record["step"],
        "config": record["config"],
        "metrics": record["metrics"],
    }


def best_of(folder: Path) -> int | None:
    """Return the step of lowest loss over many steps in a folder, the latest of equals; None if no
    loss is known.
    """
    losses: dict[int, float] = {}
    for step in steps(folder):
        # `restore` reports a damaged one
        with suppress(CheckpointError):
            metrics = read_record(folder / f"{step:08d}")["metrics"]
            if metrics.get("loss") is not None and not metrics.get(PARTIAL):
                losses[step] = metrics["loss"]
    return min(losses, key=lambda step: (losses[step], -step), default=None)


def steps(folder: str | Path) -> list[int]:
    """Return the complete steps in a folder of checkpoints, in ascending order."""
    folder = Path(folder)
    if not folder.is_dir():
        return []
    return sorted(
        int(entry.name)
        for entry in folder.iterdir()
        if _STEP.fullmatch(entry.name) and entry.is_dir()
    )


def is_run(folder: Path) -> bool:
    """Return whether a folder is that of a run, of checkpoints or of one checkpoint."""
    return (folder / "checkpoints").is_dir() or bool(
        steps(folder) or _STEP.fullmatch(folder.absolute().name)
    )


def find_checkpoint(folder: Path, step: int | None) -> Path:
    """Return the folder of one checkpoint, from a run, a folder of checkpoints or that folder
    itself.
    """
    folder = folder.absolute()
    if (folder / "checkpoints").is_dir():
        folder = folder / "checkpoints"
    elif _STEP.fullmatch(folder.name) and folder.is_dir() and not steps(folder):
        if step in (None, int(folder.name)):
            return folder
        raise CheckpointError(
            f"{folder} is the checkpoint of step {int(folder.name)}, not of step {step}"
        )
    if folder.is_file():
        raise CheckpointError(
            f"{folder} is a file; give the folder of a run, which has checkpoints"
        )
    if not (present := steps(folder)):
        raise CheckpointError(
            f"there is no complete checkpoint in {folder}; train first, or give another folder"
        )
    if step not in (None, *present):
        listed = ", ".join(map(str, present[-10:]))
        raise CheckpointError(f"there is no checkpoint of step {step} in {folder}; it has {listed}")
    return folder / f"{present[-1] if step is None else step:08d}"


def write_record(folder: Path, content: Mapping[str, Any]) -> None:
    """Write `content` (JSON values) and every file's size and CRC-32: the last file of a save."""
    files = {
        path.relative_to(folder).as_posix(): [path.stat().st_size, _checksum(path)]
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != RECORD
    }
    plain = json.loads(json.dumps({"format": FORMAT, **content, "files": files}, allow_nan=False))
    body = json.dumps(plain, sort_keys=True)
    with open(folder / RECORD, "w", encoding="utf-8") as file:
        file.write(f'{{"checksum": {zlib.crc32(body.encode())}, "record": {body}}}\n')
        file.flush()
        os.fsync(file.fileno())


def read_record(folder: Path) -> dict[str, Any]:
    """Return the record of a checkpoint folder.

    Raises CheckpointError if it is missing, foreign or damaged.
    """
    path = folder / RECORD
    if not path.is_file():
        raise CheckpointError(f"{folder} is not a checkpoint of this program: it has no {RECORD}")
    try:
        outer = parse_json(path.read_bytes())
        record = outer["record"]
        whole = outer["checksum"] == zlib.crc32(json.dumps(record, sort_keys=True).encode())
    except (
        ValueError,
        KeyError,
        TypeError,
    ):  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise CheckpointError(f"checkpoint {folder} is damaged: {RECORD} cannot be read") from None
    if not whole or not isinstance(record, dict):
        raise CheckpointError(f"checkpoint {folder} is damaged: {RECORD} was altered")
    if record.get("format") != FORMAT:
        stored = repr(record.get("format"))[:100]
        raise CheckpointError(
            f"checkpoint {folder} has format {stored}; this program reads {FORMAT!r}"
        )
    for field, (kind, valid) in _FIELDS.items():
        value = record.get(field)
        items: Any = value.items() if isinstance(value, dict) else ()
        if type(value) is not kind or not all(valid(*item) for item in items):
            raise CheckpointError(
                f"checkpoint {folder} is damaged: {field} in {RECORD} is missing or of another type"
            )
    return record


def _is_size(value: Any) -> bool:
    return type(value) is int and 0 <= value < 1 << 48


def _is_form(value: Any) -> bool:
    """Return whether a value is the shape and type of an array, of less than 2^48 bytes."""
    match value:
        case [list(shape), str(kind)] if len(shape) <= 16 and all(map(_is_size, shape)):
            return math.prod(shape) < 1 << 45 and _TYPES.fullmatch(kind) is not None
    return False


def _is_file(name: str, value: Any) -> bool:
    """Return whether a name stays in the folder, and a value is a size and a checksum."""
    inside = not Path(name).is_absolute() and ".." not in Path(name).parts and "\0" not in name
    return inside and isinstance(value, list) and len(value) == 2 and all(map(_is_size, value))


# The fields of a record: the type of each, and the check of its values by name.
_TYPES = re.compile(
    r"bool|u?int(4|8|16|32|64)|b?float(16|32|64)|float[48]_e\dm\d\w*|complex(64|128)"
)
_METADATA: dict[str, Callable[[Any], bool]] = {  # of a run, that its readers use
    "seen": lambda value: isinstance(value, list) and all(isinstance(name, str) for name in value),
    "source": lambda value: (
        isinstance(value, dict) and ("sensor" not in value or {"run", "frames"} <= value.keys())
    ),
    "data": lambda value: isinstance(value, str),
}
_FIELDS: dict[str, tuple[type, Callable[[str, Any], bool]]] = {
    "config": (str, lambda name, value: True),
    "metadata": (dict, lambda name, value: name not in _METADATA or _METADATA[name](value)),
    "step": (int, lambda name, value: True),
    "metrics": (dict, lambda name, value: value is None or type(value) in (int, float)),
    "arrays": (dict, lambda name, value: _is_form(value)),
    "files": (dict, _is_file),
}


def checked(folder: Path) -> dict[str, Any]:
    """Return the record of a checkpoint whose files are whole; an error names an older step that
    is.
    """
    try:
        return _verified(folder)
    except CheckpointError as error:
        advice = "no older checkpoint is intact"
        for step in steps(folder.parent):
            with suppress(CheckpointError):
                if step < int(folder.name) and _verified(folder.parent / f"{step:08d}"):
                    advice = f"step {step} is intact, remove {folder.name} to go on from there"
        raise CheckpointError(f"{error}; {advice}") from None


def _verified(folder: Path) -> dict[str, Any]:
    """Return the record after comparing every file with it.

    Raises CheckpointError that names the first bad file.
    """
    record = read_record(folder)
    for name, (size, checksum) in record["files"].items():
        path = folder / name
        problem = None
        if not path.is_file():
            problem = "is missing"
        elif path.stat().st_size != size:
            problem = f"has {path.stat().st_size} bytes instead of {size}"
        elif _checksum(path) != checksum:
            problem = "was altered"
        if problem:
            raise CheckpointError(f"checkpoint {folder} is damaged: its file {name} {problem}")
    return record


def _checksum(path: Path) -> int:
    value = 0
    with open(path, "rb") as file:
        while chunk := file.read(_CHUNK):
            value = zlib.crc32(chunk, value)
    return value
