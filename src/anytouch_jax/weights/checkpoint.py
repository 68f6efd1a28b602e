"""Checkpoints of a run: the one file that knows Orbax (its v1 API), and a flat safetensors export.

A checkpoint is a folder `<checkpoints>/<step>` that appears whole or not at all: everything is written under another
name, then renamed. It describes itself (io/record.py): the run's config as JSON, the caller's metadata (sensors by
name, preprocessing, source) and the metrics. Arrays are stored by name, so that parameters can be read without the
optimiser that trained them, and on another number of devices.
"""

from __future__ import annotations

import errno
import json
import math
import re
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from anytouch_jax.weights.echoes import echo_less
from anytouch_jax.weights.record import CheckpointError, checked, read_record, resolve, steps, write_record
from anytouch_jax.weights.tensors import write_safetensors
from anytouch_jax.weights.tree import flatten, nest

__all__ = [
    "CheckpointError",
    "Checkpoints",
    "export_safetensors",
    "load_params",
    "read_metadata",
    "steps",
]

Tree = Any

_UNFINISHED = re.compile(r"\d{8,}\.(writing|deleted)(\..+)?")  # being written or removed, by us or by Orbax
_AVERAGE = "opt_state/ema/"
_SHOWN = 5  # names listed in one error message
_TRIES = 3  # to read the latest checkpoint of a run that goes on
_PATIENCE = 30.0  # seconds for a save whose other processes may be lost


PARTIAL = "partial"  # among a checkpoint's metrics: its loss is of fewer steps than those of others
_ONE = threading.Lock()  # Orbax keeps one running operation a process: a load beside a save ends the save
echo_less()


class Checkpoints:
    """The checkpoints of one run: asynchronous saves; the last `keep` and the best (lowest `loss`) are kept.

    `config_json` and `metadata` (JSON values) are stored with every checkpoint. Leftovers of a killed run in `folder`
    are removed. Every process of a multi-process run makes one; process 0 does the housekeeping.
    """

    def __init__(self, folder: str | Path, *, keep: int, config_json: str, metadata: dict[str, Any]) -> None:
        if keep < 1:
            raise CheckpointError(f"a run must keep at least one checkpoint, not {keep}")
        self.folder = Path(folder).absolute()
        self._keep = keep
        try:
            json.dumps(metadata, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise CheckpointError(f"the metadata of a checkpoint must be plain JSON values: {error}") from None
        self._described = {"config": config_json, "metadata": metadata}
        self._worker = ThreadPoolExecutor(1, "checkpoint")
        self._pending: tuple[Path, Future[None], Callable[[], None]] | None = None
        self._saved: set[int] = set()
        self._losses: dict[int, float] = {}
        with self._sentence(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        self._sweep()

    def save(self, step: int, state: Tree, metrics: Mapping[str, Any]) -> None:
        """Start saving `state`, a pytree of arrays; it may be donated or changed as soon as this returns.

        Waits for the previous save first, and raises its CheckpointError. A step that this object has saved already
        is left alone; one from an earlier life of the run is replaced when the new one is complete.
        """
        self.wait()
        if step in self._saved:
            return
        target = self.folder / f"{step:08d}"
        leaves = {name: _owned(leaf) for name, leaf in flatten(state).items()}
        numbers = {name: float(value) for name, value in metrics.items()}
        content = {
            **self._described,
            "step": int(step),
            "metrics": {name: value if math.isfinite(value) else None for name, value in numbers.items()},
            "arrays": {name: [list(leaf.shape), str(leaf.dtype)] for name, leaf in leaves.items()},
        }
        arrays = {name: leaf for name, leaf in leaves.items() if leaf.size}  # Orbax refuses arrays of size zero
        context = ocp.Context()
        context.array.saving.use_compression = False  # trained weights do not shrink, and a save takes twice as long
        end_turn = _turn()
        try:
            with self._sentence(target), context:
                response = ocp.save_async(_writing(target), nest(arrays))
            self._pending = target, self._worker.submit(self._finish, target, response, content, end_turn), end_turn
        except BaseException:
            end_turn()
            raise

    def wait(self) -> None:
        """Block until the running save is on disk. Raises CheckpointError when it failed (a full disk)."""
        if self._pending is None:
            return
        (target, future, _), self._pending = self._pending, None
        with self._sentence(target):
            try:
                future.result()
            finally:  # also after a failure: the other processes are waiting
                _barrier(f"saved {target.name}")
        self._saved.add(int(target.name))

    def latest(self) -> int | None:
        """The last complete step on disk, or None."""
        return max(steps(self.folder), default=None)

    def restore(self, abstract_state: Tree, step: int | None = None) -> Tree:
        """The state of `step` (None: the latest), with the structure and shardings of `abstract_state`.

        `abstract_state` is a tree of `jax.ShapeDtypeStruct` (or arrays); a leaf without sharding goes to the first
        device. Raises CheckpointError when there is no such checkpoint, when it is damaged, or when names, shapes
        or types differ from those wanted.
        """
        self.wait()
        folder = resolve(self.folder, step)
        record = checked(folder)
        wanted = {name: _abstract(leaf) for name, leaf in flatten(abstract_state).items()}
        _compare(folder, wanted, _forms(record))
        found = _load(folder, {name: like for name, like in wanted.items() if math.prod(like.shape)})
        leaves = [
            found[name] if name in found else jax.device_put(np.zeros(like.shape, like.dtype), like.sharding)
            for name, like in wanted.items()
        ]
        return jax.tree.unflatten(jax.tree.structure(abstract_state), leaves)

    def close(self) -> None:
        """Finish the running save and its housekeeping. Raises CheckpointError when the save failed."""
        self.wait()
        self._worker.shutdown()

    def leave(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """`close` at the end of a context; after an error in one of several processes, without waiting for the others.

        Its running save is then given half a minute, or nothing where another process is lost: it could not end.
        """
        if error is None or jax.process_count() == 1:
            self.close()
            return
        if self._pending is not None and not isinstance(error, jax.errors.JaxRuntimeError):
            with suppress(Exception):
                self._pending[1].result(timeout=_PATIENCE)
        self._worker.shutdown(wait=False, cancel_futures=True)
        if self._pending is not None:
            self._pending[2]()  # what never ends, or was cancelled, keeps nobody from reading

    def _finish(self, target: Path, response: Any, content: dict[str, Any], end_turn: Callable[[], None]) -> None:
        """On the worker thread: when the arrays are on disk, write the record, rename, remove what is not kept."""
        try:
            response.result()
        finally:
            end_turn()
        if jax.process_index() != 0:
            return
        writing = _writing(target)
        write_record(writing, content)
        if target.exists():
            _discard(target)
        writing.rename(target)
        self._losses[int(target.name)] = _loss(target)
        self._prune()

    def _prune(self) -> None:
        present = steps(self.folder)
        for step in set(present) - set(self._losses):
            self._losses[step] = _loss(self.folder / f"{step:08d}")
        best = min(present, key=lambda step: (self._losses[step], -step))
        kept = {best, *present[-self._keep :]} if math.isfinite(self._losses[best]) else set(present[-self._keep :])
        for step in set(present) - kept:
            _discard(self.folder / f"{step:08d}")

    def _sweep(self) -> None:
        if jax.process_index() == 0 and self.folder.is_dir():
            for entry in self.folder.iterdir():
                if entry.is_dir() and _UNFINISHED.fullmatch(entry.name):
                    shutil.rmtree(entry, ignore_errors=True)

    @contextmanager
    def _sentence(self, path: Path) -> Iterator[None]:
        """Turn an error of the storage layers while writing into a CheckpointError; the debris is removed."""
        try:
            yield
        except Exception as error:  # Orbax and tensorstore wrap OSError in several kinds
            self._sweep()
            reason = " ".join(str(error).split())[:300]
            full = getattr(error, "errno", None) == errno.ENOSPC or "No space left" in str(error)
            advice = "the disk is full, free some space and run the same command again" if full else reason
            raise CheckpointError(f"could not write checkpoint {path}: {advice}; older ones are untouched") from error


def read_metadata(folder: str | Path, step: int | None = None) -> dict[str, Any]:
    """What a checkpoint says of itself: `step`, `config` (JSON), `metrics` and the metadata given when it was saved.

    `folder` is a run, its checkpoints folder, or one checkpoint. Raises CheckpointError.
    """
    return _description(read_record(resolve(Path(folder), step)))


def load_params(folder: str | Path, step: int | None = None) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """(parameters as a nested dict of numpy arrays, config JSON, metadata) of a checkpoint.

    `folder` is a run, its checkpoints folder, or one checkpoint. The parameters are `trainable` and `frozen`
    of the state together, their average where the run keeps one (optim.ema); the optimiser's other arrays are not read.
    Where the run goes on meanwhile and removes the latest, that after it is read. Raises CheckpointError.
    """
    for _ in range(_TRIES if step is None else 1):
        target = resolve(Path(folder), step)
        try:
            return _params_of(target)
        except (CheckpointError, OSError):
            if target.is_dir():
                raise
    raise CheckpointError(f"checkpoint {target} was removed while it was read; read the latest one, or another step")


def _params_of(target: Path) -> tuple[dict[str, Any], str, dict[str, Any]]:
    record = checked(target)
    chosen = {
        name: np.zeros(like.shape, like.dtype)
        for name, like in _forms(record).items()
        if name.startswith(("trainable/", "frozen/", _AVERAGE))
    }
    if not chosen:
        raise CheckpointError(f"checkpoint {target} holds no parameters (nothing under trainable/ or frozen/)")
    found = chosen | _load(target, {name: like for name, like in chosen.items() if like.size})
    trained = {name.split("/", 1)[1]: leaf for name, leaf in found.items() if not name.startswith(_AVERAGE)}
    averaged = {name.removeprefix(_AVERAGE): leaf for name, leaf in found.items() if name.startswith(_AVERAGE)}
    return nest(trained | averaged), record["config"], _description(record)


def export_safetensors(path: str | Path, params: Tree, metadata: Mapping[str, str]) -> None:
    """Write a parameter tree to one safetensors file, names joined with "/"; whole or not at all."""
    write_safetensors(path, {name: np.asarray(leaf) for name, leaf in flatten(params).items()}, metadata)


def _turn() -> Callable[[], None]:
    """Wait until no other operation of Orbax runs; gives what ends this one's turn, on any thread, and may be called
    again."""
    _ONE.acquire()
    turn = ExitStack()
    turn.callback(_ONE.release)
    return turn.close


def _owned(leaf: Any) -> Any:
    """The leaf, safe against later changes: a numpy array may be written to while the save runs."""
    return leaf if isinstance(leaf, jax.Array) else np.array(leaf)


def _writing(target: Path) -> Path:
    return target.with_name(f"{target.name}.writing")


def _discard(target: Path) -> None:
    """Remove a checkpoint: renamed first, so that a kill halfway leaves nothing that looks complete."""
    doomed = target.with_name(f"{target.name}.deleted")
    shutil.rmtree(doomed, ignore_errors=True)
    target.rename(doomed)
    shutil.rmtree(doomed, ignore_errors=True)


def _barrier(name: str) -> None:
    """In a multi-process run: no process goes on before process 0 has renamed the folder."""
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices(name)


def _load(folder: Path, abstract: Mapping[str, Any]) -> dict[str, Any]:
    """The named arrays; any others in the checkpoint are not read. The kind of the abstract leaf decides the kind."""
    if not abstract:
        return {}
    context = ocp.Context()
    context.pytree.loading.partial_load = True
    try:
        with _ONE, context:
            return flatten(ocp.load(folder, nest(abstract)))
    except Exception as error:  # its files are whole, so this is another Orbax or a lack of memory
        reason = " ".join(str(error).split())[:300]
        raise CheckpointError(f"could not read checkpoint {folder} ({type(error).__name__}: {reason})") from error


def _forms(record: Mapping[str, Any]) -> dict[str, jax.ShapeDtypeStruct]:
    return {n: jax.ShapeDtypeStruct(tuple(shape), np.dtype(kind)) for n, (shape, kind) in record["arrays"].items()}


def _compare(folder: Path, wanted: Mapping[str, Any], stored: Mapping[str, Any]) -> None:
    """Raise CheckpointError that names up to five entries when a checkpoint is not of the wanted form."""

    def form(like: Any) -> str:
        return "nothing" if like is None else f"{tuple(like.shape)} {np.dtype(like.dtype)}"

    differing = [
        f"{name}: {form(stored.get(name))} stored, {form(wanted.get(name))} wanted"
        for name in sorted({*wanted, *stored})
        if form(wanted.get(name)) != form(stored.get(name))
    ]
    if differing:
        raise CheckpointError(
            f"checkpoint {folder} does not fit this configuration, use the preset and settings it was trained with; "
            f"{len(differing)} entries differ ({'; '.join(differing[:_SHOWN])}{'; ...' * (len(differing) > _SHOWN)})"
        )


def _abstract(leaf: Any) -> jax.ShapeDtypeStruct:
    sharding = getattr(leaf, "sharding", None) or jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.ShapeDtypeStruct(tuple(leaf.shape), leaf.dtype, sharding=sharding)


def _description(record: Mapping[str, Any]) -> dict[str, Any]:
    return {**record["metadata"], "step": record["step"], "config": record["config"], "metrics": record["metrics"]}


def _loss(folder: Path) -> float:
    """The loss a checkpoint was saved with; infinite when unknown or of few steps, so that it is never the best."""
    try:
        metrics = read_record(folder)["metrics"]
    except CheckpointError:  # a damaged one is left for `restore` to report
        return math.inf
    loss = metrics.get("loss")
    return math.inf if loss is None or metrics.get(PARTIAL) else loss


def best_of(folder: Path) -> int | None:
    """The step of the checkpoint of lowest loss in a folder of them; None where none is known."""
    losses = {step: _loss(folder / f"{step:08d}") for step in steps(folder)}
    best = min(losses, key=lambda step: (losses[step], -step), default=None)
    return best if best is not None and math.isfinite(losses[best]) else None
