"""Benchmarks of the loader: plain decoding, augmentations, threads, and opening a manifest of millions of rows.

Variants run in turns, so that a busy machine slows all of them alike; the figures are medians over the rounds.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from anytouch_jax.config import Config, preset
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError

SIZES = ((320, 240), (640, 480))
PLAIN, PLAIN_LINEAR = "decode + resize", "decode + linear resize"
NO_JITTER, ALL, ONE_THREAD = "no colour jitter", "all augmentations", "all augmentations, one thread"
_OFF = {"flip": 0.0, "jitter": (0.0, 0.0, 0.0, 0.0)}
_JITTER = {"brightness": 0, "contrast": 1, "saturation": 2, "hue": 3}
_FRAMES = 200  # frames of a video in the large manifest


@dataclass(frozen=True)
class LoaderSpeed:
    """Images a second of one variant on pictures of `size`, and its share of plain decoding in the same round.

    `cpu_share` compares processor time, which other programs on the machine disturb less than the clock. `threads` of
    the loader; `pixels` a side of its pictures.
    """

    size: tuple[int, int]
    variant: str
    images_per_second: float
    share: float
    cpu_share: float
    threads: int
    pixels: int


@dataclass(frozen=True)
class Opened:
    """A manifest of `rows` opened by a fresh process: seconds to read it, to prepare the loader and to fill the first
    batch; the process's largest memory in MB after reading and after the first batch."""

    rows: int
    stage: int
    read: float
    prepare: float
    first_batch: float
    read_mb: float
    peak_mb: float


def measure_loading(
    folder: str | Path,
    *,
    sizes: Sequence[tuple[int, int]] = SIZES,
    pictures: int = 128,
    rounds: int = 7,
    threads: int = 2,
    pixels: int = 224,
    rows: int = 2_500_000,
    stages: Sequence[int] = (1, 2),
    log: Callable[[str], None] = lambda _: None,
) -> dict[str, list[LoaderSpeed] | list[Opened]]:
    """Measure in `folder`, which gets `pictures` files of every size and, if `rows`, a manifest of so many rows.

    Raises UserError for sizes that make no sense.
    """
    if min(pictures, rounds, threads, pixels) < 1 or rows < 0 or pixels % 14:
        raise UserError("pictures, rounds, threads and pixels must be at least 1, and pixels a multiple of 14")
    root = Path(folder)
    speeds: list[LoaderSpeed] = []
    for size in sizes:
        log(f"loading: {size[0]} x {size[1]}, {rounds} rounds of {pictures} pictures")
        manifest = write_pictures(root / f"{size[0]}x{size[1]}", size, pictures)
        speeds += _speeds(manifest, size, rounds, threads, pixels)
    opened = []
    if rows:
        path = write_large(root / "large", rows, sizes[0])
        for stage in stages:
            log(f"loading: a manifest of {rows:,} rows, stage {stage}")
            opened.append(open_large(path, stage, threads))
    return {"loader": speeds, "large manifest": opened}


def write_pictures(folder: Path, size: tuple[int, int], count: int) -> Path:
    """A manifest of `count` pictures (width, height), smooth shades with noise like those of a gel, as JPEG."""
    rng = np.random.default_rng(0)
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    names = [f"frames/{i:010d}.jpg" for i in range(count)]
    for name in names:
        shade = cv2.resize(rng.uniform(40, 215, (5, 6, 3)).astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
        noisy = shade + rng.normal(0, 3, shade.shape)
        cv2.imwrite(str(folder / name), np.clip(noisy, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])
    columns = {
        "path": names, "sensor": ["gelsight"] * count, "sequence": [f"s{i}" for i in range(count)],
        "frame_index": [0] * count, "split": ["train"] * count,
    }  # fmt: skip
    path = folder / "manifest.parquet"
    manifests.write(manifests.from_columns(columns, path), path)
    return path


# Throughput ---------------------------------------------------------------------------------------------------------


def _speeds(path: Path, size: tuple[int, int], rounds: int, threads: int, pixels: int) -> list[LoaderSpeed]:
    manifest = manifests.read(path)
    files = [manifest.file(row) for row in range(len(manifest))]
    variants: dict[str, Callable[[], None]] = {
        PLAIN: lambda: _plain(files, pixels, threads, None),
        PLAIN_LINEAR: lambda: _plain(files, pixels, threads, cv2.INTER_LINEAR),
    }
    for name, changes in _augmentations().items():
        variants[name] = _Pass(Loader(manifest, _config(len(files), threads, pixels, changes)))
    variants[ONE_THREAD] = _Pass(Loader(manifest, _config(len(files), 1, pixels, {})))
    seconds: dict[str, list[np.ndarray]] = {name: [] for name in variants}
    for turn in range(rounds + 1):
        for name, run in variants.items():
            start = np.array([time.perf_counter(), time.process_time()])
            run()
            if turn:  # the first one warms up
                seconds[name].append(np.array([time.perf_counter(), time.process_time()]) - start)
    plain = np.array(seconds[PLAIN])
    rows = []
    for name, taken in seconds.items():
        wall, cpu = np.median(plain / np.array(taken), axis=0).tolist()
        rate = len(files) / float(np.median(taken, axis=0)[0])
        rows.append(LoaderSpeed(size, name, rate, wall, cpu, 1 if name == ONE_THREAD else threads, pixels))
    return rows


def _augmentations() -> dict[str, dict[str, object]]:
    """What every variant of the loader changes in the configuration of stage 1."""
    jitter = preset("small").data.jitter
    single = {
        f"only {name}": _OFF | {"jitter": tuple(value if at == place else 0.0 for place, value in enumerate(jitter))}
        for name, at in _JITTER.items()
    }
    return {"loader, no augmentation": _OFF, NO_JITTER: {"jitter": _OFF["jitter"]}, **single, ALL: {}}


def _config(batch: int, threads: int, pixels: int, changes: dict[str, object]) -> Config:
    config = preset("small")
    data = replace(config.data, batch_size=batch, threads=threads, **changes)  # type: ignore[arg-type]
    return replace(config, model=replace(config.model, image_size=pixels), data=data)


class _Pass:
    """One batch of all pictures after another, each with its own augmentation."""

    def __init__(self, loader: Loader) -> None:
        self.loader, self.step = loader, 0

    def __call__(self) -> None:
        for _ in self.loader.stream(self.step, self.step + 1):
            self.step += 1


def _plain(files: Sequence[Path], pixels: int, threads: int, interpolation: int | None) -> None:
    """Read, decode and resize each file as a loop in any project would; by default as the loader resizes."""
    out = np.empty((len(files), pixels, pixels, 3), np.uint8)

    def one(at: int) -> None:
        picture = cv2.imdecode(np.frombuffer(files[at].read_bytes(), np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise UserError(f"{files[at]} is not a picture")
        usual = cv2.INTER_AREA if min(picture.shape[:2]) > pixels else cv2.INTER_LINEAR
        cv2.resize(
            picture, (pixels, pixels), dst=out[at], interpolation=usual if interpolation is None else interpolation
        )

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(one, range(len(files))))


# Opening ------------------------------------------------------------------------------------------------------------


def write_large(folder: Path, rows: int, size: tuple[int, int] = SIZES[0]) -> Path:
    """A manifest of `rows` frames of many videos, with photographs, captions and touches; all show the same few files.

    Videos are links to one folder, so that every path is another one, as in a real data set.
    """
    frames = folder / "frames"
    write_pictures(folder, size, min(rows, _FRAMES))
    number = np.arange(rows)
    video, frame = number // _FRAMES, number % _FRAMES
    for one in range(int(video.max()) + 1):
        link = folder / "dataset" / f"video_{one}"
        if not link.is_symlink():
            link.parent.mkdir(exist_ok=True)
            link.symlink_to(os.path.relpath(frames, link.parent), target_is_directory=True)

    def text(values: np.ndarray) -> pa.Array:
        return pa.array(values).cast(pa.string())

    def join(*parts: str | pa.Array) -> pa.Array:
        return pc.binary_join_element_wise(*parts, "")

    def some(there: np.ndarray, values: pa.Array) -> pa.Array:
        return pc.if_else(pa.array(there), values, pa.scalar(None, pa.string()))

    path = join("dataset/video_", text(video), "/", pc.utf8_lpad(text(frame), 10, "0"), ".jpg")
    columns = {
        "path": path,
        "sensor": pa.array(np.array(["gelsight", "digit", "gelslim"])[video % 3]),
        "sequence": join("video_", text(video)),
        "frame_index": pa.array(frame),
        "split": pa.array(np.array(["train", "train", "train", "val", "test"])[video % 5]),
        "dataset": pa.array(np.array(["touch_and_go", "ycb_slide", "objectfolder_real"])[video % 3]),
        "touch": some(video % 10 < 2, join("touch ", text(video // 20), ".", text(frame))),
        "object": join("object ", text(video // 50)),
        "image_path": path,
        "text": some(video % 2 == 0, join("a rough surface, number ", text(video % 900), ", that gives way")),
        "license": pa.array(["MIT"]).take(pa.array(np.zeros(rows, np.int64))),
        "label.material": pa.array(video % 20),
    }
    target = folder / "large.parquet"
    pa.parquet.write_table(pa.table(columns), target)
    return target


def open_large(path: Path, stage: int = 1, threads: int = 2) -> Opened:
    """Open the manifest in a fresh process, up to the first batch of preset tiny. Raises UserError when that fails."""
    code = f"from experiments.benchmarks import loading; loading.open_here({str(path)!r}, {stage}, {threads})"
    paths = os.pathsep.join(one for one in sys.path if one)
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
        check=False,
    )
    if done.returncode:
        raise UserError(f"{path} could not be opened: {(done.stderr.strip().splitlines() or ['no reason given'])[-1]}")
    return Opened(**json.loads(done.stdout.splitlines()[-1]))


def open_here(path: str, stage: int, threads: int) -> None:
    """Open the manifest in this process and print the figures as one line of JSON."""
    import resource

    def memory() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3

    times = [time.perf_counter()]
    manifest = manifests.read(path)
    times.append(time.perf_counter())
    read_mb = memory()
    config = preset("tiny", stage=2 if stage == 2 else 1)
    loader = Loader(manifest, replace(config, data=replace(config.data, threads=threads)))
    times.append(time.perf_counter())
    for _ in loader.stream(0, 1):
        times.append(time.perf_counter())
    read, prepare, batch = np.diff(times).round(3).tolist()
    opened = Opened(len(manifest), stage, read, prepare, batch, round(read_mb), round(memory()))
    sys.stdout.write(json.dumps(asdict(opened)) + "\n")
