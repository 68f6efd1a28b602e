"""Run folder (config.json, metrics.jsonl, the lock), progress on a terminal, and signals."""

import contextlib
import dataclasses
import json
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from anytouch_jax.config import Config, from_json, parse_json, to_json
from anytouch_jax.errors import ConfigError, Terminated, UserError, handled
from anytouch_jax.files import atomic_write, lock
from anytouch_jax.weights.checkpoint import read_record, steps

Log = Callable[[str], None]
Advance = Callable[[Mapping[str, Any]], None]  # gets the line of metrics of each step
# (first step, last step) -> a function that shows the lines while the block runs
Display = Callable[[int, int], contextlib.AbstractContextManager[Advance]]
_WAIT_FRACTION = 0.05  # a run that waits for data longer than this fraction of its time reports it


def to_stderr(sentence: str) -> None:
    """Write a sentence to the error stream, which keeps the output free for results."""
    sys.stderr.write(sentence + "\n")
    sys.stderr.flush()


def silent(sentence: str) -> None:
    """Drop a sentence."""


@contextlib.contextmanager
def progress(start: int, stop: int, log: Log, *, curve: bool = False) -> Iterator[Advance]:
    """Give a function for the metrics of each step, which shows a bar or logs some twenty lines.

    The bar is on a terminal, with a `curve` of the loss above it.

    Args:
        start: step that the run begins with.
        stop: step after the last.
        log: takes a line where there is no terminal.
        curve: draw the loss above the bar.
    """
    if log is silent or not sys.stderr.isatty():
        every = max(1, (stop - start) // 20)

        def line(row: Mapping[str, Any]) -> None:
            done = row["step"] + 1
            if done == start + 1 or done == stop or (done - start) % every == 0:
                log(f"step {done}/{stop}  {summary(row)}")

        yield line
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    losses: list[float] = []

    class Bar(Progress):
        """A bar below the curve of the loss."""

        def get_renderables(self) -> Iterator[Any]:
            if curve and losses:
                yield Text(chart(losses))
            yield self.make_tasks_table(self.tasks)

    def advance(row: Mapping[str, Any]) -> None:
        if row["loss"] is not None:
            losses.append(row["loss"])
        bar.update(task, completed=row["step"] + 1, description=summary(row))

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    with Bar(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("compiling", total=stop, completed=start)
        yield advance


def chart(losses: Sequence[float], width: int = 64, height: int = 8) -> str:
    """Draw losses as text: a column is the mean of equally many steps.

    The scale is written on the left.
    """
    parts = np.array_split(np.asarray(losses), min(width, len(losses)))
    columns = [float(part.mean()) for part in parts]
    low = min(columns)
    high = max(columns)
    span = (high - low) or 1.0
    # A letter is 8 steps high, so a column is 1 to 8 * height of them.
    eighths = [1 + round((8 * height - 1) * (value - low) / span) for value in columns]
    lines = []
    for line in reversed(range(height)):
        mark = " " * 10
        if line == height - 1:
            mark = f"{high:9.4f} "
        elif line == 0:
            mark = f"{low:9.4f} "
        blocks = [" ▁▂▃▄▅▆▇█"[min(8, max(0, full - 8 * line))] for full in eighths]
        lines.append(mark + "".join(blocks))
    return "\n".join(lines)


def summary(row: Mapping[str, Any]) -> str:
    """Return the loss, the speed and the problems of a line of metrics."""
    loss = "not finite" if row["loss"] is None else f"{row['loss']:.4f}"
    parts = [f"loss {loss}", f"{row['samples_per_second']:.0f} samples/s"]
    if row["skipped_batches"]:
        parts.append(f"skipped {row['skipped_batches']}")
    if replaced := row.get("skipped_samples", 0):
        parts.append(f"{replaced:.0f} samples could not be read and were replaced")
    if row.get("wait_fraction", 0) >= _WAIT_FRACTION:
        parts.append(f"waits for data {row['wait_fraction']:.0%}")
    return "  ".join(parts)


@contextlib.contextmanager
def signals() -> Iterator[list[signal.Signals]]:
    """Yield a list that collects SIGTERM and Ctrl-C, which then do not end the process.

    A second Ctrl-C does.
    """
    received: list[signal.Signals] = []

    def note(number: int, frame: Any) -> None:
        received.append(signal.Signals(number))
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, earlier)

    earlier = signal.getsignal(signal.SIGINT)
    with handled(note, signal.SIGTERM, signal.SIGINT):
        yield received


@contextlib.contextmanager
def terminating() -> Iterator[None]:
    """Let SIGTERM raise `Terminated` while the block runs, so that it cleans up.

    `signals` takes over inside it.
    """

    def end(number: int, frame: Any) -> None:
        raise Terminated

    with handled(end, signal.SIGTERM):
        yield


# Settings that may change when a run continues: they decide where and how fast it runs, not its
# numbers. `pretrain` compares the content of the manifests, since a data set may have moved. The
# run folder has a copy of the tokenizer.
CHANGEABLE = {
    "data.cache",
    "data.manifests",
    "data.on_bad_sample",
    "data.prefetch",
    "data.threads",
    "data.tokenizer",
    "run.figure_every",
    "run.fsdp",
    "run.keep",
    "run.max_skipped",
    "run.save_every",
    "run.tensorboard",
}


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a failed write, such as a full disk, into a UserError."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(
            f"cannot write {path}: {reason}. Free some space or make the folder writable, then run "
            "the same command again to continue from the last complete checkpoint."
        ) from error


# (thread, folder): `pretrain` locks the folder before `fit` does, which would find it taken.
_locked: set[tuple[int, Path]] = set()


@contextlib.contextmanager
def alone_in(run_dir: Path) -> Iterator[None]:
    """Make and lock a run folder, except for the same thread.

    Raises UserError if another process trains there.
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
            raise UserError(
                f"another process trains in {run_dir}. Wait for it, or choose another folder with "
                "--run."
            )
        _locked.add(mine)
        stack.callback(_locked.discard, mine)
        yield


def begun_with(run_dir: Path) -> Config | None:
    """Return the settings that a run started with, or None without a complete checkpoint.

    Raises UserError.
    """
    path = run_dir / "config.json"
    done = steps(run_dir / "checkpoints")
    if not done:
        return None
    try:
        if path.exists():
            return from_json(path.read_text(encoding="utf-8"), allow_retired=False)
        path = run_dir / "checkpoints" / f"{done[-1]:08d}"
        return from_json(read_record(path)["config"], allow_retired=False)
    except (ConfigError, UnicodeDecodeError) as error:
        raise UserError(
            f"{path} cannot be read ({error}). Choose another run folder, or repair the file."
        ) from None


def open_run(run_dir: Path, config: Config) -> None:
    """Make a run folder with its config.json, or check that its run started with equal settings.

    Raises UserError.
    """
    path = run_dir / "config.json"
    with writing(path):
        (run_dir / "figures").mkdir(parents=True, exist_ok=True)
        if not continues(run_dir, config) or not path.exists():
            atomic_write(path, to_json(config) + "\n")


def continues(run_dir: Path, config: Config) -> bool:
    """Return whether a folder has a run to continue.

    Raises UserError for changed settings, but those CHANGEABLE.
    """
    begun = begun_with(run_dir)
    if begun is None:
        return False
    before = _flat(dataclasses.asdict(begun))
    now = _flat(dataclasses.asdict(config))
    changed = [
        f"{name} was {before.get(name)!r} and is now {now.get(name)!r}"
        for name in sorted(before.keys() | now.keys())
        if name not in CHANGEABLE and before.get(name) != now.get(name)
    ]
    if changed:
        advice = ""
        if before["run.steps"] != now["run.steps"]:
            advice = f", or start from its weights by --init {run_dir} and another --run folder"
        raise UserError(
            f"the run in {run_dir} was started with other settings: {'; '.join(changed)}. Use the "
            f"same settings to continue it, or choose another run folder{advice}."
        )
    return True


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested dict as {dotted name: value}, with lists as tuples."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        elif isinstance(value, list):
            flat[prefix + name] = tuple(value)
        else:
            flat[prefix + name] = value
    return flat


class Record:
    """metrics.jsonl from step `start` on. Later and incomplete lines, of a killed run, are removed.

    `skipped` counts the skipped steps so far, and `in_a_row` those at the end without a break.
    `losses` are those of every step, and `last` is the latest line. With `tensorboard` the numbers
    also go to an event file. Only the `lead` process writes, and nobody without a `run_dir`. Raises
    UserError for a full disk.
    """

    def __init__(
        self, run_dir: Path | None, start: int, *, tensorboard: bool = False, lead: bool = True
    ) -> None:
        self.skipped = 0
        self.in_a_row = 0
        self.losses: list[float] = []
        self.last: dict[str, Any] = {}
        self._board: Any = None
        self._file: TextIO | None = None
        if run_dir is None:
            return
        self.path = run_dir / "metrics.jsonl"
        if tensorboard and lead:
            self._board = _tensorboard(run_dir, start)
        with writing(self.path):
            for row in _cut(self.path, start, rewrite=lead):
                self._count(row)
            if lead:
                self._file = self.path.open("a", encoding="utf-8")

    def write(self, step: int, numbers: Mapping[str, Any]) -> dict[str, Any]:
        """Append the line of a step and return it.

        A number that is not finite becomes null, as JSON has no NaN.
        """
        row: dict[str, Any] = {"step": step}
        for name, value in numbers.items():
            if hasattr(value, "item"):
                value = value.item()
            if isinstance(value, float) and not math.isfinite(value):
                value = None
            row[name] = value
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
        loss = row.get("loss")
        self.losses.append(math.nan if loss is None else loss)
        self.last = dict(row)
        if row.get("skipped"):
            self.skipped += 1
            self.in_a_row += 1
        else:
            self.in_a_row = 0


def _cut(path: Path, start: int, *, rewrite: bool) -> list[dict[str, Any]]:
    """Remove the lines of step `start` and later, and incomplete ones, and return the rest."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True)
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
            "--run.tensorboard needs tensorboardX. Run pip install 'anytouch-jax[tensorboard]', or "
            "leave it off."
        ) from None
    return SummaryWriter(str(run_dir / "tensorboard"), purge_step=start)
