"""Recordings of live touch: frames in a folder, and rows in its manifest.parquet."""

from __future__ import annotations

import contextlib
import queue
import re
import shutil
import threading
import time
import unicodedata
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from anytouch_jax.config import UNIVERSAL
from anytouch_jax.data.images import encode
from anytouch_jax.data.manifest.schema import EMPTY
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.sensor_words import resolve_sensor
from anytouch_jax.errors import UserError
from anytouch_jax.files import read_arrays
from anytouch_jax.live.page.shared import SharedManifest

SCORE = "label.contact_score"
_QUICK = (cv2.IMWRITE_PNG_COMPRESSION, 1)
_WAITING = 64  # images that wait for the disk: more are dropped and counted


class _Recorded(NamedTuple):
    """A frame RGB u8 (h, w, 3), its contact score, NaN if unknown, and its features f32 (E,)."""

    image: Array
    score: float
    values: Array


def _sensors_of(features: Path) -> set[str]:
    """Return the sensors of a features file, none for one that is missing or damaged."""
    try:
        arrays = read_arrays(features, only="key/sensor".__eq__)
    except (OSError, ValueError):
        return set()
    return set(arrays["key/sensor"].tolist()) if "key/sensor" in arrays else set()


class LiveRecorder:
    """Writes frames of recordings into a folder, and then its manifest.parquet.

    The folder of a recording is hidden until it is whole.
    """

    def __init__(self, out: Path, sensor: str | None) -> None:
        self.out = out.expanduser().resolve()
        self.named = out
        # What the user calls the sensor may be its folder. Recordings have its name.
        self.word = sensor or UNIVERSAL
        self.sensor = resolve_sensor(self.word).name
        self.manifest = SharedManifest(self.out)
        self.file = self.manifest.file
        # of recorded frames, by their path in the manifest
        self.features: dict[str, Array] = {}
        self._queue: queue.Queue[_Recorded | None] | None = None
        self._thread: threading.Thread | None = None
        self._written = 0
        self._lost = 0
        self._name = ""
        self._done = ""

    def head_files(self) -> tuple[Path, Path]:
        """Return the files of a head on the recordings, and of its features.

        They are head.npz and features.npz, or head_SENSOR.npz and so on beside those of another
        sensor: two pages on different sensors may share the folder.
        """
        features = self.out / "features.npz"
        if _sensors_of(features) - {self.sensor}:
            return self.out / f"head_{self.sensor}.npz", self.out / f"features_{self.sensor}.npz"
        return self.out / "head.npz", features

    def state(self) -> dict[str, Any]:
        """Return the state for the page."""
        about = {
            "written": self._written,
            "lost": self._lost,
            "name": self._name,
            "done": self._done,
        }
        return about | {"on": self._queue is not None}

    def start(self, name: str, gel: Array | None) -> None:
        """Begin a recording of a touch called `name`. Raises UserError."""
        name = _plain(name)
        if not name:
            raise UserError("Type a name for what you touch first.")
        if name.lower() in EMPTY:
            # Manifests read such a word as a missing value.
            raise UserError(f"{name} is no name. Type another.")
        if self._queue is not None:
            raise UserError("A recording is on already. Stop it first.")
        self._join()
        part, target = self._new_folders(name)
        self._written = 0
        self._lost = 0
        self._name = name
        self._done = ""
        waiting: queue.Queue[_Recorded | None] = queue.Queue()
        # A second Ctrl-C must not end it, so it is no daemon.
        self._thread = threading.Thread(
            target=self._write, args=(waiting, part, target, gel), daemon=False
        )
        self._thread.start()
        self._queue = waiting

    def add(self, image: Array, score: float, values: Array) -> None:
        """Store a frame if a recording is on.

        Args:
            image: RGB u8 (h, w, 3).
            score: its contact score, NaN if unknown.
            values: its features f32 (E,).
        """
        waiting = self._queue
        if waiting is not None and waiting.qsize() < _WAITING:
            waiting.put(_Recorded(image, score, values))
        elif waiting is not None:
            self._lost += 1

    def stop(self) -> None:
        """End the recording, and wait until it is on the disk."""
        waiting = self._queue
        self._queue = None
        if waiting is not None:
            waiting.put(None)
        self._join()

    def _new_folders(self, name: str) -> tuple[Path, Path]:
        """Make the hidden folder of a new recording of `name`, and return it and its later name.

        Raises UserError if it cannot be made.
        """
        stem = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:40] or "touch"
        begun = f"{time.strftime('%Y%m%d_%H%M%S')}_{stem}"
        try:
            self.out.mkdir(parents=True, exist_ok=True)
            for target in (begun, *(f"{begun}_{number}" for number in range(2, 100))):
                part = self.out / f".{target}"
                # Another page may begin a recording of this name in the same second. Of two that
                # make a folder, one fails.
                with contextlib.suppress(FileExistsError):
                    part.mkdir()
                    if not (self.out / target).exists():
                        return part, self.out / target
                    part.rmdir()
        except OSError as error:
            raise UserError(f"The recording cannot begin: {error}") from None
        raise UserError(f"{self.out} has too many recordings of {begun}.")

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join()

    def _write(
        self, waiting: queue.Queue[_Recorded | None], part: Path, target: Path, gel: Array | None
    ) -> None:
        """Write what waits, up to None, into `part`, and rename it: the recorder's thread."""
        scores = list[float | None]()
        features = list[Array]()
        try:
            if gel is not None:
                (part / "background.png").write_bytes(encode(gel, ".png", *_QUICK))
            while (frame := waiting.get()) is not None:
                data = encode(frame.image, ".png", *_QUICK)
                (part / f"{self._written:06d}.png").write_bytes(data)
                is_unknown = frame.score != frame.score
                scores.append(None if is_unknown else round(frame.score, 3))
                features.append(frame.values)
                self._written += 1
            if not self._written:
                self._done = "No frame came, and nothing was written."
                return
            part.rename(target)
            self._add_rows(target.name, scores, gel is not None)
            self.features |= {
                f"{target.name}/{number:06d}.png": values for number, values in enumerate(features)
            }
            self._done = f"{self._written} frames of {self._name} are in {self.named / target.name}"
        except (OSError, UserError) as error:
            self._queue = None
            self._done = f"The recording failed: {error}"
            if self._written and part.exists():
                part.rename(target)
                self._done += (
                    f". Its first {self._written} frames are in {target}, without rows in a "
                    "manifest."
                )
        finally:
            shutil.rmtree(part, ignore_errors=True)

    def _add_rows(self, folder: str, scores: list[float | None], has_background: bool) -> None:
        count = len(scores)
        columns: dict[str, list[Any]] = {
            "path": [f"{folder}/{number:06d}.png" for number in range(count)],
            "sensor": [self.sensor] * count,
            "sequence": [folder] * count,
            "frame_index": list(range(count)),
            "split": ["train"] * count,
            "object": [self._name] * count,
            SCORE: scores,
            "background_path": [f"{folder}/background.png" if has_background else None] * count,
        }
        self.manifest.append(columns)


def _plain(name: str) -> str:
    """Return a name on one line, without what cannot be seen, and at most 100 letters long."""
    printed = "".join(one for one in name if one.isprintable() or one.isspace())
    return unicodedata.normalize("NFC", " ".join(printed.split())[:100].strip())
