"""Simulated data sets on disk: images, fields, RGB images and a manifest.

A group's files are written first, then its table in `parts/`. When all parts exist they become
`manifest.parquet` in one rename. A folder without it is unfinished, and the same command continues
it.
"""

from __future__ import annotations

import dataclasses
import io
import json
import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from anytouch_jax.config import parse_json
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, atomic_write, lock
from anytouch_jax.sim import scene
from anytouch_jax.sim.draws import Leaf
from anytouch_jax.sim.recorder import ClipOutput, Recorder
from anytouch_jax.sim.scene import Recording, Scenes
from anytouch_jax.sim.sensing import photo
from anytouch_jax.sim.sensing.own import find_sensor
from anytouch_jax.sim.world import objects

MANIFEST = "manifest.parquet"
SETTINGS = "dataset.json"
PARTS = "parts"
GROUP = 8  # touches in a part
VERSION = 7  # a change of the simulator that changes the data of a seed raises it
Row = dict[str, Any]


def simulate(
    scenes: Scenes,
    out: str | Path,
    *,
    threads: int = 2,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Path:
    """Simulate a data set, or continue one that was interrupted.

    A seed gives the same bytes on the same machine.

    Args:
        scenes: What to simulate.
        out: Folder to write.
        threads: That render RGB images and write files.
        progress: Called with the number of finished touches and of all.

    Returns:
        The path of the manifest.

    Raises:
        UserError: If `out` has other contents or cannot be written.
    """
    # pyarrow reads a leading ~ and a colon in its own way
    out = Path(out).expanduser().resolve()
    if threads < 1:
        raise UserError(f"threads must be at least 1, not {threads}")
    # may fail, so it comes before the folder is made
    things, splits = scene.objects_and_splits(scenes)
    try:
        _claim(scenes, out)
        with lock(out / SETTINGS) as free:
            if not free:
                raise UserError(
                    f"another process simulates into {out}: wait for it, or give another folder"
                )
            return _simulate(scenes, things, splits, out, threads, progress)
    except (FileExistsError, NotADirectoryError) as error:
        raise UserError(f"{error.filename or out} is a file; give a folder") from None
    except OSError as error:
        raise UserError(
            f"{error.filename or out}: {error.strerror or error}; finished touches are kept, "
            "repeat to continue"
        ) from None


def _simulate(
    scenes: Scenes,
    things: Sequence[objects.Object],
    splits: Sequence[str],
    out: Path,
    threads: int,
    progress: Callable[[int, int], None],
) -> Path:
    """Simulate all groups that are not finished yet, and return the manifest's path."""
    target = out / MANIFEST
    if target.exists():
        # left by a kill after the rename
        shutil.rmtree(out / PARTS, ignore_errors=True)
        return target
    (out / PARTS).mkdir(parents=True, exist_ok=True)
    end = scenes.first + scenes.touches
    groups = [range(start, min(start + GROUP, end)) for start in range(scenes.first, end, GROUP)]
    files = [out / PARTS / f"{i:05d}.parquet" for i in range(len(groups))]
    finished = {file for file in files if _is_readable(file)}
    done = sum(len(group) for group, file in zip(groups, files, strict=True) if file in finished)
    progress(done, scenes.touches)
    recorder = Recorder(scenes, things, GROUP)
    # Two sensors at a time: the small operations of a program leave a core idle, and compilation
    # takes one core.
    with ThreadPoolExecutor(threads) as pool, ThreadPoolExecutor(min(2, threads)) as solving:
        for group, file in zip(groups, files, strict=True):
            if file in finished:
                continue
            touches = [scene.draw_touch(scenes, number, splits) for number in group]
            by_sensor = [
                [scene.draw_recording(scenes, touch, name) for touch in touches]
                for name in scenes.sensors
            ]
            clips = solving.map(recorder.record, by_sensor)
            futures = []
            for recordings, takes in zip(by_sensor, clips, strict=True):
                for recording, take in zip(recordings, takes, strict=True):
                    thing = things[recording.touch.object]
                    futures.append(
                        pool.submit(_write_recording, scenes, thing, recording, take, out)
                    )
            _write_table([row for future in futures for row in future.result()], file)
            done += len(group)
            progress(done, scenes.touches)
    table = pa.concat_tables([pq.read_table(file) for file in files], promote_options="permissive")
    columns = {name: table[name].combine_chunks() for name in table.column_names}
    manifests.write(manifests.from_columns(columns, target), target)
    shutil.rmtree(out / PARTS)
    return target


def _claim(scenes: Scenes, out: Path) -> None:
    """Write the settings into the folder, or check that they equal those of the folder."""
    settings = {"version": VERSION} | dataclasses.asdict(scenes)
    # data sets from before these settings continue
    for name, default in (("units", "each"), ("first", 0)):
        if settings[name] == default:
            del settings[name]
    text = json.dumps(settings, indent=2) + "\n"
    file = out / SETTINGS
    if file.exists():
        old = _read_settings(file)
        new = json.loads(text)
        changes = [
            f"{name} {old.get(name)!r}, not {new.get(name)!r}"
            for name in dict.fromkeys((*new, *old))
            if old.get(name) != new.get(name)
        ]
        if not changes:
            return
        raise UserError(
            f"{out} holds a data set with {'; '.join(changes)}: give another folder, or the same "
            "options"
        )
    if out.is_dir() and any(path.name != f"{SETTINGS}.tmp" for path in out.iterdir()):
        raise UserError(f"{out} is not empty and holds no simulated data set: give another folder")
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(file, text, part=out / f"{SETTINGS}.tmp")


def _read_settings(file: Path) -> dict[str, Any]:
    """Return the settings of a data set. Raises UserError for another file."""
    try:
        settings = parse_json(file.read_bytes())
    except ValueError:
        settings = None
    if not isinstance(settings, dict) or "version" not in settings:
        raise UserError(
            f"{file} does not hold the settings of a simulated data set: give another folder"
        )
    return settings


def _write_recording(
    scenes: Scenes, thing: objects.Object, recording: Recording, take: ClipOutput, out: Path
) -> list[Row]:
    """Write the files of one recording. Returns the rows of its frames and of its background."""
    touch = recording.touch
    sensor = find_sensor(recording.sensor)
    is_field = sensor.kind == "field"
    name = f"{touch.number:06d}-{sensor.name}"
    folder = Path(sensor.name) / f"{touch.number:06d}"
    (out / folder).mkdir(parents=True, exist_ok=True)
    photograph = _write_photograph(scenes, thing, recording, folder, out)
    background = None if is_field else folder / "background.jpg"
    common = _common_row(scenes, thing, recording, sensor.name) | {
        "sequence": name,
        "image_path": _posix(photograph),
        "text": _caption(scenes, thing, recording),
        "background_path": _posix(background),
    }
    quality = int(recording.unit.quality)
    rows = []
    for t in range(scenes.frames):
        path = folder / f"{t:03d}{'.npy' if is_field else '.jpg'}"
        field = folder / f"{t:03d}.npy" if scenes.fields or is_field else None
        if take.image is not None:
            _write_image(out / path, take.image[t], quality)
        if field is not None:
            assert take.field is not None
            _write_array(out / field, take.field[t])
        row = common | {
            "path": path.as_posix(),
            "frame_index": t,
            "field_path": _posix(field),
        }
        for label, values in take.labels.items():
            row[f"label.{label}"] = float(np.float32(values[t]))
        if not recording.depth[t] > 0:
            row["touch"] = None  # no place is touched in this frame
        rows.append(row)
    if background is not None:
        assert take.background is not None
        _write_image(out / background, take.background, quality)
        own = {"path": background.as_posix(), "sequence": f"{name}-background", "frame_index": 0}
        nothing = {"split": "background", "touch": None, "text": None, "image_path": None}
        rows.append(common | own | nothing)
    return rows


def _write_photograph(
    scenes: Scenes, thing: objects.Object, recording: Recording, folder: Path, out: Path
) -> Path | None:
    """Write the RGB image of a recording that has one, and return its path below `out`."""
    if not recording.has_photo:
        return None
    path = folder / "photo.jpg"
    rng = np.random.default_rng([scenes.seed, scene.PHOTO, recording.seed])
    _write_image(
        out / path, photo.photograph(thing, recording.touch.place, rng, scenes.size or 224)
    )
    return path


def _caption(scenes: Scenes, thing: objects.Object, recording: Recording) -> str | None:
    """Return the caption of a recording that has one."""
    if not recording.has_text:
        return None
    rng = np.random.default_rng([scenes.seed, scene.CAPTION, recording.seed])
    return objects.caption(thing, rng)


def _posix(path: Path | None) -> str | None:
    return None if path is None else path.as_posix()


def _common_row(scenes: Scenes, thing: objects.Object, recording: Recording, sensor: str) -> Row:
    """Return the columns that all frames of a recording share."""
    touch = recording.touch
    # The unit is a column that splits keep together: a new device for every touch, or one for all.
    unit = f"{sensor}-{scenes.seed}"
    if scenes.units == "each":
        unit = f"{sensor}-{touch.split}-{touch.number:06d}"
    return {
        "sensor": sensor,
        "split": touch.split,
        "dataset": f"simulated-{scenes.grade}",
        "unit": unit,
        "stride": 1,
        "touch": f"{touch.number:06d}",
        "object": thing.name,
        "license": "CC0-1.0",
        "commercial": True,
        "grade": scenes.grade,
        "label.object": thing.name,
        "label.material": thing.material.name,
        "label.hardness": objects.hardness_of(thing),
        "label.roughness": objects.roughness_of(thing),
        "label.indenter": thing.shape.primitive,
        "label.texture": thing.shape.texture,
    } | scene.directions(recording)


def _write_table(rows: list[Row], file: Path) -> None:
    """Write the table of a part, after the files that it lists are on the disk."""
    names = dict.fromkeys(name for row in rows for name in row)
    table = pa.table({name: [row.get(name) for row in rows] for name in names})
    # Once a part is cheaper than once an image.
    os.sync()
    with atomic_path(file, part=file.with_suffix(".tmp")) as part:
        pq.write_table(table, part)


def _is_readable(part: Path) -> bool:
    """Return whether a part exists and can be read.

    A power cut may leave a name without its bytes.
    """
    try:
        return part.exists() and pq.read_metadata(part).num_rows > 0
    except (pa.ArrowException, OSError):
        return False


def _write_array(path: Path, array: Leaf) -> None:
    data = io.BytesIO()
    np.save(data, array, allow_pickle=False)
    _write_bytes(path, data.getvalue())


def _write_image(path: Path, image: Leaf, quality: int = 95) -> None:
    bgr = np.asarray(image)[..., ::-1]
    good, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not good:
        raise RuntimeError(f"OpenCV could not encode {path}")
    _write_bytes(path, data.tobytes())


def _write_bytes(path: Path, data: bytes) -> None:
    """Write a file without waiting for the disk, which `_write_table` does once a part."""
    atomic_write(path, data, sync=False, part=path.with_name(path.name + ".tmp"))
