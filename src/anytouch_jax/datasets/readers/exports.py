"""Images that readers write: each folder of them belongs to one stream of one source, by a record
in it.

The record names the stream, the files of its source with size, time and SHA-256, and the images.
A changed source replaces its old images. Folders without a record, or with one of another stream,
are never changed.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.images import count_frames, encode, frames_from_video
from anytouch_jax.datasets.readers.common import EXPORT_RECORD, DatasetError, DatasetIndex
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write, part_path
from anytouch_jax.progress import tracked

_TRIES = 1000  # folders of one name


class Export:
    """The images of a stream in `folder`, which is final when `exported` ends; `is_new` if they
    must be written.
    """

    def __init__(self, folder: str, is_new: bool, place: Path) -> None:
        self.folder = folder
        self.is_new = is_new
        self.names = list[str]()
        self._place = place

    def save(self, name: str, image: np.ndarray | bytes) -> None:
        """Write an image RGB u8 (h, w, 3), or the bytes of its file.

        One that is there already is kept.
        """
        self.names.append(name)
        file = self._place / name
        if self.is_new or not file.is_file():
            data = image if isinstance(image, bytes) else encode(np.ascontiguousarray(image))
            atomic_write(file, data, sync=False)


@contextmanager
def exported(
    index: DatasetIndex, folder: str, stream: str, sources: Sequence[Path], which: object = None
) -> Iterator[Export]:
    """Give the images of `stream` in `folder`, or in a folder of a name like it if that holds
    something else.

    `sources` and `which` decide the images, which come to be as a whole when the block ends.
    Raises DatasetError if nothing can be written.

    Args:
        index: counts what is written, and knows ROOT.
        folder: below ROOT, for the images.
        stream: name of the stream in its source.
        sources: files that the images are read from. If one has changed, they are written
            again.
        which: what else decides the images, such as a range of frames.
    """
    place, record = find_export(index.root, folder, stream)
    is_new = record is None or not _is_same(record, sources, which)
    # two may be open at once
    part = part_path(index.root / f"{folder}.{zlib.crc32(stream.encode()):08x}")
    export = Export(place or folder, is_new, part if is_new else index.root / str(place))
    try:
        yield export
        if is_new and export.names:
            states = [(one, one.stat()) for one in sources]
            files = [
                (one.name, status.st_size, status.st_mtime_ns, _digest(one))
                for one, status in states
            ]
            state = {"stream": stream, "part": which, "sources": files, "pictures": export.names}
            part.joinpath(EXPORT_RECORD).write_text(json.dumps(state), encoding="utf-8")
            export.folder = _move(index, part, folder, place, record, export.names)
            index.written += len(export.names)
    except OSError as error:
        raise UserError(
            f"the images of {sources[0]} cannot be written to {index.root / folder}: "
            f"{error.strerror or error}; make its folder writable"
        ) from None
    finally:
        shutil.rmtree(part, ignore_errors=True)


def find_export(root: Path, folder: str, stream: str) -> tuple[str | None, dict[str, Any] | None]:
    """Return the folder that holds the images of a stream, and its record; (None, None) if there
    is none.
    """
    for name in _names(folder):
        if not (root / name).exists():
            return None, None
        if (record := _record(root / name)) and record["stream"] == stream:
            return name, record
    return None, None


def _names(folder: str) -> Iterator[str]:
    yield folder
    yield from (f"{folder}-{number}" for number in range(2, _TRIES))


def _record(folder: Path) -> dict[str, Any] | None:
    try:
        record = json.loads((folder / EXPORT_RECORD).read_text(encoding="utf-8"))
        return {name: record[name] for name in ("stream", "part", "sources", "pictures")}
    except (OSError, ValueError, KeyError, TypeError):
        return None


def is_current(record: dict[str, Any], sources: Sequence[Path]) -> bool:
    """Return whether the sources of an export are those of its record."""
    return _is_same(record, sources, record["part"])


def _is_same(record: dict[str, Any], sources: Sequence[Path], part: object) -> bool:
    """Return whether sources have the sizes and times of a record, or else its sizes and
    content.
    """
    old = record["sources"]
    if json.dumps(part) != json.dumps(record["part"]) or [name for name, *_ in old] != [
        one.name for one in sources
    ]:
        return False
    for (_, size, time, digest), file in zip(old, sources, strict=True):
        status = file.stat()
        if status.st_size != size or (status.st_mtime_ns != time and _digest(file) != digest):
            return False
    return True


def _digest(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _move(
    index: DatasetIndex,
    part: Path,
    folder: str,
    place: str | None,
    record: dict[str, Any] | None,
    names: list[str],
) -> str:
    """Move new images to their folder, and return it.

    Files of the user in a replaced folder stay in it.
    """
    if place is not None and record is not None:
        old = index.root / place
        ours = {EXPORT_RECORD, *record["pictures"]}
        own = [entry.name for entry in os.scandir(old) if entry.name not in ours]
        if both := sorted({*own} & {*names}):
            raise DatasetError(
                f"{old / both[0]} is a file of yours where an image has to go; move it elsewhere"
            )
        aside = part_path(old.with_name(f"{old.name}.old"))
        os.replace(old, aside)
        os.replace(part, old)
        for name in own:
            os.replace(aside / name, old / name)
        shutil.rmtree(aside, ignore_errors=True)
        return place
    for name in _names(folder):
        target = index.root / name
        if target.is_dir() and not any(target.iterdir()):
            target.rmdir()
        if not target.exists():
            os.replace(part, target)
            break
        if (
            target.is_dir() and _record(target) is None and _has_same(target, part, names)
        ):  # of an older version
            os.replace(part / EXPORT_RECORD, target / EXPORT_RECORD)
            break
    if name != folder:
        index.notes.append(f"{folder} holds something else: the images of its name are in {name}")
    return name


def _has_same(folder: Path, part: Path, names: list[str]) -> bool:
    pairs = [(folder / name, part / name) for name in names]
    return all(old.is_file() and old.read_bytes() == new.read_bytes() for old, new in pairs)


def export_video(index: DatasetIndex, video: str) -> str:
    """Write a video's frames as 000000.png.. into a folder of its name.

    Raises ImageError or DatasetError.
    """
    file = index.root / video
    with exported(index, video.removesuffix(file.suffix), file.name, [file]) as images:
        if images.is_new:
            declared = count_frames(file)
            for count, frame in enumerate(
                tracked(frames_from_video(file), "frames written", declared or None)
            ):
                images.save(f"{count:06d}.png", frame)
            if (
                0.98 * declared > (count := len(images.names)) + 2
            ):  # some containers only estimate it
                index.notes.append(
                    f"{video} declares {declared} frames and {count} could be read; is it whole?"
                )
    return images.folder
