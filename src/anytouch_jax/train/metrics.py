"""What a run leaves on disk beside its checkpoints: config.json, and metrics.jsonl with one line a step."""

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

from anytouch_jax.config import Config, from_json, to_json
from anytouch_jax.errors import ConfigError, UserError
from anytouch_jax.files import atomic_write, lock
from anytouch_jax.weights.checkpoint import read_record, steps

# Settings that may change between the parts of a run: they decide where and how fast it runs, not what it computes.
HARMLESS = {
    "data.cache",
    "data.manifests",  # their content is compared (`pretrain`): a data set may have moved
    "data.on_bad_sample",
    "data.prefetch",
    "data.threads",
    "data.tokenizer",  # a run has its own copy
    "run.figure_every",
    "run.fsdp",
    "run.keep",
    "run.max_skipped",
    "run.save_every",
    "run.tensorboard",
}


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a failed write (disk full, no permission) into one sentence."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(
            f"cannot write {path}: {reason}; free some space or mend the folder, then run the same command again: "
            "it goes on from the last complete checkpoint"
        ) from error


_held: set[tuple[int, Path]] = set()


@contextlib.contextmanager
def alone_in(run_dir: Path) -> Iterator[None]:
    """Keep other processes from training in a run folder, which is made; a thread may ask for it again inside.

    Raises UserError where another one trains there, and for a folder that cannot be written.
    """
    mine = (threading.get_ident(), run_dir.resolve())
    if mine in _held:
        yield
        return
    with writing(run_dir):
        run_dir.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        with writing(run_dir):
            free = stack.enter_context(lock(run_dir / ".lock"))
        if not free:
            raise UserError(f"another process trains {run_dir}: wait for it, or name another folder with --run")
        _held.add(mine)
        stack.callback(_held.discard, mine)
        yield


def begun_with(run_dir: Path) -> Config | None:
    """The settings that the run in a folder was begun with, None without a complete checkpoint: what lies in such a
    folder was left by a start that failed, or is not ours. Where config.json is lost the latest checkpoint tells them.
    Raises UserError when they cannot be read."""
    path, done = run_dir / "config.json", steps(run_dir / "checkpoints")
    if not done:
        return None
    try:
        if not path.exists():
            path = run_dir / "checkpoints" / f"{done[-1]:08d}"
        text = read_record(path)["config"] if path.is_dir() else path.read_text(encoding="utf-8")
        config: Config = from_json(text, allow_retired=False)
    except (ConfigError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read ({error}); choose another run folder, or mend it") from None
    return config


def open_run(run_dir: Path, config: Config) -> None:
    """Make a run folder with its config.json, or check that the one there was started with the same settings.

    A folder without a complete checkpoint was left by a start that failed, and is begun anew. Raises UserError as
    `goes_on`, and for a full disk.
    """
    path = run_dir / "config.json"
    with writing(path):
        (run_dir / "figures").mkdir(parents=True, exist_ok=True)
        if not goes_on(run_dir, config) or not path.exists():
            atomic_write(path, to_json(config) + "\n")


def goes_on(run_dir: Path, config: Config) -> bool:
    """Whether a folder holds a run that was begun, with the same settings; those in `HARMLESS` may differ.

    Raises UserError that names each other setting with both values.
    """
    begun = begun_with(run_dir)
    if begun is None:
        return False
    before = _flat(dataclasses.asdict(begun))
    now = _flat(dataclasses.asdict(config))
    changed = [
        f"{name} was {before.get(name)!r} and is now {now.get(name)!r}"
        for name in sorted(before.keys() | now.keys())
        if name not in HARMLESS and before.get(name) != now.get(name)
    ]
    if changed:
        longer = f"; --init {run_dir} with another --run folder goes on from what it learned"
        raise UserError(
            f"the run in {run_dir} was started with other settings: {'; '.join(changed)}. "
            "Use the same settings to go on with it, or choose another run folder"
            + (longer if before["run.steps"] != now["run.steps"] else "")
        )
    return True


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested dict as {dotted name: value}; sequences compare as tuples."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = tuple(value) if isinstance(value, list) else value
    return flat


class Record:
    """metrics.jsonl from step `start` on: earlier lines stay, later ones (of a killed run) and torn ones are cut off.

    `skipped` counts the skipped steps so far and `in_a_row` those without a break at the end, as the lines tell.
    With `tensorboard` the numbers also go to an event file. Without `lead` (all processes of a run but the first)
    it counts and writes nothing. Raises UserError when the disk is full.
    """

    def __init__(self, run_dir: Path, start: int, *, tensorboard: bool = False, lead: bool = True) -> None:
        self.path = run_dir / "metrics.jsonl"
        self.skipped = self.in_a_row = 0
        self._board = _tensorboard(run_dir, start) if tensorboard and lead else None
        with writing(self.path):
            for row in _cut(self.path, start, rewrite=lead):
                self._count(row)
            place = self.path if lead else Path(os.devnull)
            self._file: TextIO = place.open("a", encoding="utf-8")

    def write(self, step: int, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Append the line of a step and return it; what is not finite becomes null, as JSON has no NaN."""
        row = {"step": step} | {name: _plain(value) for name, value in numbers.items()}
        self._count(row)
        row["skipped_batches"] = self.skipped
        with writing(self.path):
            self._file.write(json.dumps(row, allow_nan=False) + "\n")
            self._file.flush()
        if self._board is not None:
            for name, value in row.items():
                if name != "step" and isinstance(value, int | float):
                    self._board.add_scalar(name, value, step)
        return row

    def sync(self) -> None:
        """Put the lines on the disk itself, before a checkpoint that follows them."""
        if self._file.name == str(self.path):  # the null device has no disk below it
            with writing(self.path):
                os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the files; what could not be written was reported by `write`."""
        with contextlib.suppress(OSError):
            self._file.close()
        if self._board is not None:
            self._board.close()

    def _count(self, row: Mapping[str, Any]) -> None:
        self.in_a_row = self.in_a_row + 1 if row.get("skipped") else 0
        self.skipped += bool(row.get("skipped"))


def _plain(value: Any) -> Any:
    """A number as JSON can hold it."""
    value = value.item() if hasattr(value, "item") else value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _cut(path: Path, start: int, *, rewrite: bool) -> list[dict[str, Any]]:
    """Drop the lines of step `start` and later, and torn ones; return the rest."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
    rows: list[dict[str, Any]] = []
    kept: list[str] = []
    for line in lines:
        with contextlib.suppress(ValueError):
            row = json.loads(line)
            if line.endswith("\n") and isinstance(row, dict) and row.get("step", start) < start:
                rows.append(row)
                kept.append(line)
    if rewrite and len(kept) < len(lines):
        atomic_write(path, "".join(kept))
    return rows


def _tensorboard(run_dir: Path, start: int) -> Any:
    """A writer of TensorBoard events, from step `start` on."""
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        raise UserError(
            "run.tensorboard needs tensorboardX: pip install 'anytouch-jax[tensorboard]', or leave it off"
        ) from None
    return SummaryWriter(str(run_dir / "tensorboard"), purge_step=start)
