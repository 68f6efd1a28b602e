"""`anytouch data simulate`: touch scenes on disk."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from anytouch_jax.bars import bar
from anytouch_jax.cli.output import log
from anytouch_jax.config.parsing import Below1, Count, NotNegative, Seed, Share, Threads

if TYPE_CHECKING:
    from anytouch_jax.sim.scene import Scenes


@dataclass(frozen=True)
class SimulateOptions:
    """Simulate touches felt by several sensors, with photographs, captions, forces and slip.

    Example: anytouch data simulate --out data/scenes --touches 400 --sensors gelsight_mini digit --seed 0

    Run the same command again to continue after an interruption.
    """

    out: Path  # Folder for images and manifest.parquet.
    touches: Count[int] = 400  # Number of places to touch. Every sensor feels each place once.
    sensors: tuple[str, ...] = ("gelsight_mini", "digit", "duragel")
    """Sensors: gelsight, gelsight_mini, gelslim, digit, 9dtact, duragel, tac3d (a force field), or your NAME.sensor."""
    seed: Seed = 0  # Random seed.
    grade: Literal["fine", "coarse"] = "fine"
    """fine repeats the motion frame by frame for all sensors; coarse shares only the place."""
    fidelity: Literal["fast", "exact"] = "fast"  # Solve contact in a few rounds, or to convergence.
    frames: Count[int] = 10  # Frames of a recording. They show a part of one gesture, with pauses and regrasps.
    objects: Count[int] = 200  # Number of objects.
    depth: NotNegative[tuple[float, float]] = (0.3, 1.0)  # Range of the deepest press, mm.
    vision: Share = 0.7  # Share of the recordings with a photograph.
    text: Share = 0.7  # Share of the recordings with a caption.
    held_out: Below1 = 0.25  # Share of the objects in the test split, by pairs of primitive and texture.
    first: NotNegative[int] = (
        0  # Number of the first touch. Another number gives other touches of the same objects and splits.
    )
    fields: tuple[str, ...] = ()  # Fields to write as .npy: displacement, pressure, shear.
    size: NotNegative[int] = 224  # Pixels of an image's shorter side. 0 keeps the sensor's resolution.
    units: Literal["each", "one"] = "each"
    """each simulates a new device for every recording; one uses one device of each sensor, mounted straight."""
    threads: Threads = 2  # Threads that render photographs and write files.


def run(options: SimulateOptions) -> int:
    """Simulate a data set, or finish one that was interrupted; 130 after Ctrl-C."""
    from anytouch_jax.sim.dataset import simulate
    from anytouch_jax.sim.scene import Scenes
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    scenes = Scenes(**{name: value for name, value in vars(options).items() if name not in ("out", "threads")})
    if missing := _missing_splits(scenes):
        log(f"no touch is in split {' or '.join(missing)}. Use more touches or about 16 objects or more.")
    last = -1
    with bar(options.touches, "touches") as advance, _exit_on_interrupt():

        def report(done: int, of: int) -> None:
            nonlocal last
            if last < 0 and done < of:
                log(f"compiling the contact solver for {', '.join(scenes.sensors)}: about a minute at first")
            elif not sys.stderr.isatty() and 10 * done // of > 10 * last // of:
                log(f"{done} of {of} touches")
            last = done
            advance(done)

        path = simulate(scenes, options.out, threads=options.threads, progress=report)
    log(f"{path}: {options.touches} touches by {', '.join(scenes.sensors)}{_unconverged(path)}")
    return 0


@contextmanager
def _exit_on_interrupt() -> Iterator[None]:
    """Exit at once on Ctrl-C: a thread that compiles would not react for a minute, and files are written atomically."""
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler:  # ignored, as in a script's background
        yield
        return

    def end(*_: Any) -> None:
        from rich.console import Console

        Console(stderr=True).show_cursor()  # which the bar hides
        log("interrupted: finished touches are kept. Run the same command again to continue.")
        os._exit(130)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _missing_splits(scenes: Scenes) -> list[str]:
    """Return the splits without a touch, where objects are held out."""
    from anytouch_jax.sim.scene import draw_touch, objects_and_splits

    splits = objects_and_splits(scenes)[1]
    numbers = range(scenes.first, scenes.first + min(scenes.touches, len(splits)))  # one turn of each object
    present = {draw_touch(scenes, number, splits).split for number in numbers}
    return [name for name in ("val", "test") if scenes.held_out and name not in present]


def _unconverged(manifest: Path) -> str:
    """Return how many frames of fidelity exact did not converge, in words; "" for none."""
    import pyarrow.parquet as pq

    if "label.converged" not in pq.read_schema(manifest).names:
        return ""
    column = pq.read_table(manifest, columns=["label.converged"])["label.converged"].drop_null().to_numpy()
    count = int((column < 1).sum())
    return f". {count} of {len(column)} frames did not converge (label.converged)" if count else ""
