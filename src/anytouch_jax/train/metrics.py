"""Files of a run folder: config.json, metrics.jsonl with one line a step, and the lock."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

from anytouch_jax.config import Config, from_json, parse_json, to_json
from anytouch_jax.errors import ConfigError, UserError
from anytouch_jax.files import atomic_write, lock
from anytouch_jax.weights.checkpoint import read_record, steps

# Settings that may change when a run continues: they decide where and how fast it runs, not its numbers. `pretrain`
# compares the content of the manifests, since a data set may have moved. The run folder has a copy of the tokenizer.
CHANGEABLE = {f"data.{name}" for name in ("cache", "manifests", "on_bad_sample", "prefetch", "threads", "tokenizer")}
CHANGEABLE |= {f"run.{n}" for n in ("figure_every", "fsdp", "keep", "max_skipped", "save_every", "tensorboard")}


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a failed write, such as a full disk, into a UserError."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(
            f"cannot write {path}: {reason}. Free some space or make the folder writable, then run the same command "
            "again to continue from the last complete checkpoint."
        ) from error


_locked: set[tuple[int, Path]] = set()


@contextlib.contextmanager
def alone_in(run_dir: Path) -> Iterator[None]:
    """Make and lock a run folder, so that no other process trains in it. The same thread may enter it twice.

    Raises UserError if another process trains there, or if the folder cannot be written.
    """
    mine = (threading.get_ident(), run_dir.resolve())
    if mine in _locked:
        yield
        return
    with writing(run_dir):
        run_dir.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        with writing(run_dir):
            free = stack.enter_context(lock(run_dir / ".lock"))
        if not free:
            raise UserError(f"another process trains in {run_dir}. Wait for it, or choose another folder with --run.")
        _locked.add(mine)
        stack.callback(_locked.discard, mine)
        yield


def begun_with(run_dir: Path) -> Config | None:
    """Return the settings that the run in a folder started with, or None without a complete checkpoint.

    A folder without one was left by a start that failed. If config.json is lost, the latest checkpoint has the
    settings. Raises UserError when they cannot be read.
    """
    path, done = run_dir / "config.json", steps(run_dir / "checkpoints")
    if not done:
        return None
    try:
        if path.exists():
            return from_json(path.read_text(encoding="utf-8"), allow_retired=False)
        path = run_dir / "checkpoints" / f"{done[-1]:08d}"
        return from_json(read_record(path)["config"], allow_retired=False)
    except (ConfigError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read ({error}). Choose another run folder, or repair the file.") from None


def open_run(run_dir: Path, config: Config) -> None:
    """Make a run folder with its config.json, or check that its run started with the same settings.

    A folder without a complete checkpoint starts again. Raises UserError as `continues` does, and for a full disk.
    """
    path = run_dir / "config.json"
    with writing(path):
        (run_dir / "figures").mkdir(parents=True, exist_ok=True)
        if not continues(run_dir, config) or not path.exists():
            atomic_write(path, to_json(config) + "\n")


def continues(run_dir: Path, config: Config) -> bool:
    """Return whether a folder has a run to continue. Its settings must be equal, except for `CHANGEABLE`.

    Raises UserError that names every changed setting with both values.
    """
    if (begun := begun_with(run_dir)) is None:
        return False
    before, now = _flat(dataclasses.asdict(begun)), _flat(dataclasses.asdict(config))
    changed = [
        f"{name} was {before.get(name)!r} and is now {now.get(name)!r}"
        for name in sorted(before.keys() | now.keys())
        if name not in CHANGEABLE and before.get(name) != now.get(name)
    ]
    if changed:
        longer = f", or start from its weights by --init {run_dir} and another --run folder"
        raise UserError(
            f"the run in {run_dir} was started with other settings: {'; '.join(changed)}. Use the same settings to "
            f"continue it, or choose another run folder{longer if before['run.steps'] != now['run.steps'] else ''}."
        )
    return True


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested dict as {dotted name: value}, with lists as tuples."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        value = tuple(value) if isinstance(value, list) else value
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
    return flat


class Record:
    """metrics.jsonl from step `start` on. Earlier lines stay. Later and incomplete lines, of a killed run, are removed.

    `skipped` counts the skipped steps so far, and `in_a_row` those at the end without a break. With `tensorboard` the
    numbers also go to an event file. Only the `lead` process writes, the others count. Raises UserError for a full
    disk.
    """

    def __init__(self, run_dir: Path, start: int, *, tensorboard: bool = False, lead: bool = True) -> None:
        self.path = run_dir / "metrics.jsonl"
        self.skipped = self.in_a_row = 0
        self._board = _tensorboard(run_dir, start) if tensorboard and lead else None
        with writing(self.path):
            for row in _cut(self.path, start, rewrite=lead):
                self._count(row)
            self._file: TextIO | None = self.path.open("a", encoding="utf-8") if lead else None

    def write(self, step: int, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Append the line of a step and return it. A number that is not finite becomes null, as JSON has no NaN."""
        row: dict[str, Any] = {"step": step}
        for name, value in numbers.items():
            value = value.item() if hasattr(value, "item") else value
            row[name] = None if isinstance(value, float) and not math.isfinite(value) else value
        self._count(row)
        row["skipped_batches"] = self.skipped
        if self._file:
            with writing(self.path):
                self._file.write(json.dumps(row, allow_nan=False) + "\n")
                self._file.flush()
        if self._board is not None:
            for name, value in row.items():
                if name != "step" and isinstance(value, int | float):
                    self._board.add_scalar(name, value, step)
        return row

    def sync(self) -> None:
        """Flush the lines to disk, so that a checkpoint never has steps that are missing here."""
        if self._file:
            with writing(self.path):
                os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the files. `write` has reported what could not be written."""
        for file in (self._file, self._board):
            with contextlib.suppress(OSError):
                if file is not None:
                    file.close()

    def _count(self, row: Mapping[str, Any]) -> None:
        self.in_a_row = self.in_a_row + 1 if row.get("skipped") else 0
        self.skipped += bool(row.get("skipped"))


def _cut(path: Path, start: int, *, rewrite: bool) -> list[dict[str, Any]]:
    """Remove the lines of step `start` and later, and incomplete ones, and return the rest."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True) if path.exists() else []
    rows: dict[str, dict[str, Any]] = {}
    for line in lines:
        with contextlib.suppress(ValueError):
            row = parse_json(line)
            step = row.get("step") if isinstance(row, dict) else None
            if line.endswith("\n") and isinstance(step, int) and step < start:
                rows[line] = row
    if rewrite and len(rows) < len(lines):
        atomic_write(path, "".join(rows))
    return list(rows.values())


def _tensorboard(run_dir: Path, start: int) -> Any:
    """Return a writer of TensorBoard events, from step `start` on."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise UserError(
            "--run.tensorboard needs tensorboardX. Run pip install 'anytouch-jax[tensorboard]', or leave it off."
        ) from None
    return SummaryWriter(str(run_dir / "tensorboard"), purge_step=start)
