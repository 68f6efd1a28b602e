"""How fast the loader feeds a step, by threads and by kind, on a made-up manifest; the bytes must not depend on it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from anytouch_jax.config import Config, preset
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from experiments.benchmarks.speed import interleaved

_SIDE = (320, 240)  # pixels of the made-up frames: width, height, those of a DIGIT
_FRAMES = 12  # of a recording
_BATCHES = 2  # of a measurement


@dataclass(frozen=True)
class Feed:
    """A way to load: seconds a batch, frames a second, and ratio of time and difference of bytes to one thread."""

    kind: str
    threads: int
    samples: int
    seconds: float
    seconds_iqr: float
    frames_per_second: float
    ratio: float
    difference: int


def measure(name: str, batch: int, *, rounds: int = 5) -> list[Feed]:
    """A row for each number of threads, stills and clips. Raises UserError where the folder cannot be written."""
    threads = sorted({1, 2, max(2, os.cpu_count() or 1)})
    with TemporaryDirectory() as folder:
        manifest = manifests.read([str(_world(Path(folder), max(4, batch // 4)))])
        return [row for kind in ("clip", "still") for row in _kind(manifest, name, kind, batch, rounds, threads)]


def _world(folder: Path, recordings: int) -> Path:
    """A manifest of recordings of smooth noise, as PNG files."""
    import cv2

    rng, lines = np.random.default_rng(0), ["path,sensor,sequence,frame_index,split"]
    try:
        for sequence in range(recordings):
            for frame in range(_FRAMES):
                small = rng.integers(0, 256, (12, 16, 3), np.uint8)
                name = f"{sequence:03d}_{frame:02d}.png"
                if not cv2.imwrite(str(folder / name), cv2.resize(small, _SIDE, interpolation=cv2.INTER_CUBIC)):
                    raise OSError(28, "the disk does not take it")
                lines.append(f"{name},digit,{sequence},{frame},train")
        (folder / "manifest.csv").write_text("\n".join(lines) + "\n")
    except OSError as error:
        raise UserError(f"cannot write frames to {folder}: {error.strerror}") from None
    return folder / "manifest.csv"


def _kind(manifest: Any, name: str, kind: str, batch: int, rounds: int, threads: Sequence[int]) -> list[Feed]:
    base = preset(name)

    def config(count: int) -> Config:
        share = 1.0 if kind == "clip" else 0.0
        return replace(base, data=replace(base.data, threads=count, batch_size=batch, order="random", clip_share=share))

    loaders = [Loader(manifest, config(count)) for count in threads]
    first = [next(iter(_batches(loader, 1))) for loader in loaders]
    times = interleaved([lambda loader=loader: _batches(loader, _BATCHES) for loader in loaders], rounds)  # type: ignore[misc]
    base_times = times[0][:, 0]
    rows = []
    for count, seconds, one in zip(threads, (t[:, 0] / _BATCHES for t in times), first, strict=True):
        low, middle, high = np.percentile(seconds, [25, 50, 75])
        frames = one.clip.shape[0] * one.clip.shape[1]
        rows.append(
            Feed(
                kind=kind,
                threads=count,
                samples=batch,
                seconds=float(middle),
                seconds_iqr=float(high - low),
                frames_per_second=float(frames / middle),
                ratio=float(np.median(seconds * _BATCHES / base_times)),
                difference=int(np.max(np.abs(one.clip.astype(int) - first[0].clip.astype(int)))),
            )
        )
    return rows


def _batches(loader: Loader, count: int) -> list[Any]:
    return [batch for _, batch, _ in loader.stream(0, count)]


def to_markdown(rows: Sequence[Feed]) -> str:
    """A line a way to load."""
    from anytouch_jax.evaluate.statistics import markdown

    heads = (
        "batches of",
        "threads",
        "batch",
        "time / one thread",
        "ms a batch (IQR)",
        "frames/s",
        "largest difference",
    )
    cells = [
        [
            f"{row.kind}s",
            str(row.threads),
            str(row.samples),
            f"{row.ratio:.2f}",
            f"{1e3 * row.seconds:.1f} ({1e3 * row.seconds_iqr:.1f})",
            f"{row.frames_per_second:.0f}",
            str(row.difference),
        ]
        for row in rows
    ]
    return markdown(heads, cells) + "\n"
