"""A simulated data set on disk: images, fields, photographs and a manifest, in parts that survive an interruption.

Touches are simulated in groups; a group's files are written first, then its table under `parts/`. When all parts are
there they become `manifest.parquet` in one rename: a folder without it is not finished, and the same command goes on.
"""

from __future__ import annotations

import dataclasses
import io
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, atomic_write, lock
from anytouch_jax.sim import scene
from anytouch_jax.sim.recorder import Recorder, Take
from anytouch_jax.sim.scene import Recording, Scenes
from anytouch_jax.sim.sensing import photo
from anytouch_jax.sim.sensing.sensors import SENSORS
from anytouch_jax.sim.world import captions, objects

MANIFEST, SETTINGS, PARTS = "manifest.parquet", "dataset.json", "parts"
GROUP = 8  # touches a part
VERSION = 3  # of what a seed gives; a change of the simulator raises it
NEWER = {"tac3d": 4}  # sensors that a change of their own has made newer: recordings of the others are as before
Row = dict[str, Any]


def simulate(
    scenes: Scenes,
    out: str | Path,
    *,
    threads: int = 2,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Path:
    """Simulate `scenes` in the folder `out`, or finish what was begun there; gives back the manifest's path.

    `progress(touches done, touches)` is called as parts are finished. The files are the same byte for byte for a seed
    and a machine. Raises UserError when `out` holds something else, or cannot be written.
    """
    out = Path(out).expanduser().resolve()  # pyarrow reads a leading ~ and a colon in its own way
    if threads < 1:
        raise UserError(f"threads must be at least 1, not {threads}")
    things, splits = scene.cast(scenes)  # before the folder is taken: what cannot be simulated leaves nothing
    try:
        _claim(scenes, out)
        with lock(out / SETTINGS) as mine:
            if not mine:
                raise UserError(f"another process simulates into {out}: wait for it, or give another folder")
            return _simulate(scenes, things, splits, out, threads, progress)
    except (FileExistsError, NotADirectoryError) as error:
        raise UserError(f"{error.filename or out} is a file; give a folder") from None
    except OSError as error:
        raise UserError(
            f"{error.filename or out}: {error.strerror or error}; what is finished is kept, the same command goes on"
        ) from None


def version(sensors: Sequence[str]) -> int:
    """The version of what a seed gives for these sensors."""
    return max(NEWER.get(name, VERSION) for name in sensors)


def _simulate(
    scenes: Scenes, things: Any, splits: Sequence[str], out: Path, threads: int, progress: Callable[[int, int], None]
) -> Path:
    target = out / MANIFEST
    if target.exists():
        shutil.rmtree(out / PARTS, ignore_errors=True)  # left by a kill in the last moment
        return target
    (out / PARTS).mkdir(parents=True, exist_ok=True)
    end = scenes.first + scenes.touches
    groups = [range(start, min(start + GROUP, end)) for start in range(scenes.first, end, GROUP)]
    files = [out / PARTS / f"{i:05d}.parquet" for i in range(len(groups))]
    whole = {file for file in files if _is_whole(file)}
    done = sum(len(group) for group, file in zip(groups, files, strict=True) if file in whole)
    progress(done, scenes.touches)
    recorder = Recorder(scenes, things, GROUP)
    # Two sensors at once: a program's small operations leave a core idle, and compiling takes one.
    with ThreadPoolExecutor(threads) as pool, ThreadPoolExecutor(min(2, threads)) as solving:
        for group, file in zip(groups, files, strict=True):
            if file in whole:
                continue
            touches = [scene.draw_touch(scenes, number, splits) for number in group]
            rows = _write_group(scenes, things, touches, partial(solving.map, recorder.record), out, pool)
            _write_table(rows, file)
            done += len(group)
            progress(done, scenes.touches)
    _write_manifest(files, target)
    shutil.rmtree(out / PARTS)
    return target


def _claim(scenes: Scenes, out: Path) -> None:
    """Note the settings in the folder, or check that they are those of the folder."""
    settings = {"version": version(scenes.sensors)} | dataclasses.asdict(scenes)
    for name, default in (("units", "each"), ("first", 0)):  # data sets older than these settings go on
        if settings[name] == default:
            del settings[name]
    text, file = json.dumps(settings, indent=2) + "\n", out / SETTINGS
    if file.exists():
        held, now = _read_settings(file), json.loads(text)
        pairs = {name: (held.get(name), now.get(name)) for name in (*now, *held)}
        other = [f"{name} {one!r}, not {two!r}" for name, (one, two) in pairs.items() if one != two]
        if not other:
            return
        raise UserError(f"{out} holds a data set with {'; '.join(other)}: give another folder, or the same options")
    if out.is_dir() and any(path.name != f"{SETTINGS}.tmp" for path in out.iterdir()):
        raise UserError(f"{out} is not empty and holds no simulated data set: give another folder")
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(file, text, part=out / f"{SETTINGS}.tmp")


def _read_settings(file: Path) -> dict[str, Any]:
    """Raises UserError where they are not those of a data set."""
    try:
        held = json.loads(file.read_text())
    except ValueError:
        held = None
    if not isinstance(held, dict) or "version" not in held:
        raise UserError(f"{file} does not hold the settings of a simulated data set: give another folder")
    return held


def _write_group(
    scenes: Scenes, things: Any, touches: list[scene.Touch], record: Callable[..., Iterator[list[Take]]], out: Path,
    pool: ThreadPoolExecutor,
) -> list[Row]:  # fmt: skip
    """Simulate and write the recordings of a few touches, sensor by sensor; their manifest rows."""
    found = []
    asked = [[scene.draw_recording(scenes, touch, sensor) for touch in touches] for sensor in scenes.sensors]
    for recordings, takes in zip(asked, record(asked), strict=True):
        found += [
            pool.submit(_write_recording, scenes, things[recording.touch.object], recording, take, out)
            for recording, take in zip(recordings, takes, strict=True)
        ]
    return [row for future in found for row in future.result()]


def _write_recording(scenes: Scenes, thing: objects.Object, recording: Recording, take: Take, out: Path) -> list[Row]:
    """Write the files of one recording; the rows of its frames and of its background."""
    touch, kind = recording.touch, SENSORS[recording.sensor].kind
    name = f"{touch.number:06d}-{recording.sensor}"
    common = _common_row(scenes, thing, recording) | {"sequence": name}
    folder = Path(recording.sensor) / f"{touch.number:06d}"
    (out / folder).mkdir(parents=True, exist_ok=True)
    picture = caption = None
    if recording.has_photo:
        picture = folder / "photo.jpg"
        image = photo.photograph(thing, touch.place, scene.photo_rng(scenes, recording), scenes.size or 224)
        _write_image(out / picture, image)
    if recording.has_text:
        caption = captions.caption(thing, scene.caption_rng(scenes, recording))
    background = None if kind == "field" else folder / "background.jpg"
    common |= {
        "image_path": picture and picture.as_posix(),
        "text": caption,
        "background_path": background and background.as_posix(),
    }
    rows = []
    for t in range(scenes.frames):
        path = folder / f"{t:03d}{'.npy' if kind == 'field' else '.jpg'}"
        field = folder / f"{t:03d}.npy" if scenes.fields or kind == "field" else None
        if kind != "field":
            _write_image(out / path, take.image[t])
        if field is not None:
            _write_array(out / field, take.field[t])
        rows.append(
            common
            | {"path": path.as_posix(), "frame_index": t, "field_path": field and field.as_posix()}
            | {f"label.{name}": float(np.float32(values[t])) for name, values in take.labels.items()}
        )
    if background is not None:
        _write_image(out / background, take.background)
        lock = {"path": background.as_posix(), "sequence": f"{name}-background", "frame_index": 0}
        rows.append(common | lock | {"split": "background", "touch": None, "text": None, "image_path": None})
    return rows


def _common_row(scenes: Scenes, thing: objects.Object, recording: Recording) -> Row:
    """What all frames of a recording share."""
    touch = recording.touch
    return {
        "sensor": recording.sensor,
        "split": touch.split,
        "dataset": f"simulated-{scenes.grade}",
        "unit": f"{recording.sensor}-{f'{touch.split}-{touch.number:06d}' if scenes.units == 'each' else scenes.seed}",
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
    names = dict.fromkeys(name for row in rows for name in row)
    table = pa.table({name: [row.get(name) for row in rows] for name in names})
    os.sync()  # the files that it vouches for, once a part instead of once a picture
    with atomic_path(file, part=file.with_suffix(".tmp")) as part:
        pq.write_table(table, part)


def _is_whole(part: Path) -> bool:
    """Whether a part is there and can be read: a power cut may leave a name without its bytes."""
    try:
        return part.exists() and pq.read_metadata(part).num_rows > 0
    except (pa.ArrowException, OSError):
        return False


def _write_manifest(parts: list[Path], target: Path) -> None:
    table = pa.concat_tables([pq.read_table(part) for part in parts], promote_options="permissive")
    whole = manifests.from_columns({name: table[name].combine_chunks() for name in table.column_names}, target)
    manifests.write(whole, target)


def _write_image(path: Path, image: np.ndarray) -> None:
    good, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    if not good:
        raise RuntimeError(f"OpenCV could not encode {path}")
    _write_bytes(path, data.tobytes())


def _write_array(path: Path, array: np.ndarray) -> None:
    data = io.BytesIO()
    np.save(data, array, allow_pickle=False)
    _write_bytes(path, data.getvalue())


def _write_bytes(path: Path, data: bytes) -> None:
    """Not waiting for the disk: that is done once a part (`_write_table`)."""
    atomic_write(path, data, sync=False, part=path.with_name(path.name + ".tmp"))
