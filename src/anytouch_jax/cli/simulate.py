"""`anytouch simulate`: touch scenes on disk."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from anytouch_jax.cli.options import Simulate
from anytouch_jax.cli.words import log

if TYPE_CHECKING:
    from rich.progress import Progress

    from anytouch_jax.sim.scene import Scenes


def run(options: Simulate) -> int:
    """Simulate a data set, or finish one that was begun; 130 after Ctrl-C (what is finished is kept)."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from anytouch_jax.sim.dataset import simulate
    from anytouch_jax.sim.scene import Scenes
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    scenes = Scenes(
        touches=options.touches,
        sensors=_names(options.sensors),
        seed=options.seed,
        grade=options.grade,
        fidelity=options.fidelity,
        frames=options.frames,
        objects=options.objects,
        depth=options.depth,
        vision=options.vision,
        text=options.text,
        held_out=options.held_out,
        fields=_names(options.fields),
        size=options.size,
        units=options.units,
        first=options.first,
    )
    if missing := _missing(scenes):
        log(f"no touch is of split {' and '.join(missing)}: more touches or more objects (some 16) give some")
    columns = TextColumn("touches"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar, _ended_by_interrupt(bar):
        told = _teller(bar, scenes.sensors)
        path = simulate(scenes, options.out, threads=options.threads, progress=told)
    log(f"{path}: {options.touches} touches by {', '.join(scenes.sensors)}{_unconverged(path)}")
    return 0


@contextmanager
def _ended_by_interrupt(bar: Progress) -> Iterator[None]:
    """Ctrl-C ends the process at once: a thread that compiles hears of nothing for a minute, and no file is there half
    written. Nothing changes where Ctrl-C is ignored or another program's, and outside the main thread."""
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler or threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(*_: Any) -> None:
        bar.stop()
        log("interrupted: what is finished is kept, the same command goes on")
        os._exit(130)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _missing(scenes: Scenes) -> list[str]:
    """The splits that no touch is of, where objects are held out."""
    from anytouch_jax.sim.scene import draw_touch, objects_and_splits

    splits = objects_and_splits(scenes)[1]
    numbers = range(scenes.first, scenes.first + min(scenes.touches, len(splits)))  # by then each object had its turn
    there = {draw_touch(scenes, number, splits).split for number in numbers}
    return [name for name in ("val", "test") if scenes.held_out and name not in there]


def _unconverged(manifest: Path) -> str:
    """How many frames of fidelity exact did not converge, in words; "" for none."""
    import pyarrow.parquet as pq

    if "label.converged" not in pq.read_schema(manifest).names:
        return ""
    column = pq.read_table(manifest, columns=["label.converged"])["label.converged"].drop_null().to_numpy()
    few = int((column < 1).sum())
    return f"; {few} of {len(column)} frames did not converge (label.converged)" if few else ""


def _teller(bar: Progress, sensors: tuple[str, ...]) -> Callable[[int, int], None]:
    """What is told of (touches done, touches): a bar on a terminal, a line every tenth of them elsewhere."""
    task, last = bar.add_task("touches"), -1

    def tell(done: int, of: int) -> None:
        nonlocal last
        line = ""
        if last < 0 and done < of:
            line = f"compiling the contact solver for {', '.join(sensors)}: about a minute the first time"
        elif bar.disable and 10 * done // of > 10 * last // of:
            line = f"{done} of {of} touches"
        if line:
            bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
        last = done
        bar.update(task, completed=done, total=of)

    return tell


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())
