"""Films among one's own recordings: their frames as pictures in a folder of the film's name."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.images import ImageError, count_frames, frames_from_video
from anytouch_jax.data.readers.common import Notes, walk
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_folder

SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv")


def write_video_frames(root: Path, notes: Notes) -> None:
    """Write the frames of every film below `root` as 000000.png, ... into a folder of its name beside it, whole or not
    at all; a film whose folder is there is left alone. A film that cannot be read is counted. Raises UserError where
    nothing can be written.
    """
    for folder, folders, files in list(walk(root, Notes())):  # before any folder is made
        there = set(folders)
        for name in files:
            film = root / folder / name
            if film.suffix.lower() not in SUFFIXES or film.stem in there:
                continue
            there.add(film.stem)
            try:
                _write(film, notes)
            except ImageError:
                notes.skip("film that cannot be read", str(film))
            except OSError as error:
                raise UserError(f"the frames of {film} cannot be written beside it: {error.strerror}") from None


def _write(film: Path, notes: Notes) -> None:
    count = 0
    with atomic_folder(film.with_suffix("")) as target:
        for frame in frames_from_video(film):
            data = cv2.imencode(".png", np.ascontiguousarray(frame[..., ::-1]))[1].tobytes()
            (target / f"{count:06d}.png").write_bytes(data)
            count += 1
    if 0.98 * (told := count_frames(film)) > count + 2:  # some containers only estimate it
        notes.log(f"{film} tells of {told} frames and {count} could be read; is it whole?")
