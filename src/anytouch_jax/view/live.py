"""Live touch for the page: a camera or a film in its place, with contact, class, nearest touches and a recorder."""

from __future__ import annotations

import asyncio
import contextlib
import json
import queue
import re
import shutil
import struct
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa

from anytouch_jax.config import UNIVERSAL
from anytouch_jax.data.cameras import CameraSettings, open_source
from anytouch_jax.data.images import encode, open_video
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.prepare.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.prepare.untouched_gel import UntouchedGel
from anytouch_jax.data.transforms import Flip, orient_frame
from anytouch_jax.encoder.arrays import unit_rows
from anytouch_jax.encoder.base import Preprocess
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.encoder.linear_head import LinearHead
from anytouch_jax.encoder.stream import Embedded, stream
from anytouch_jax.errors import UserError
from anytouch_jax.view.space import FeatureMap
from anytouch_jax.view.tables import scale_down, touch_panels

Array = npt.NDArray[Any]
_KEPT = 600  # frames whose times make p50 and p99, as on the page
_SEARCH = 0.5  # seconds between searches for the nearest touches
_QUICK = (cv2.IMWRITE_PNG_COMPRESSION, 1)
_LOOK = 0.005  # seconds between looks for a new packet
_WAITING = 64  # pictures that wait for the disk: more are dropped and counted


class LoopedFilm:
    """A film that takes the place of a camera: frames come at its frame rate, again and again.

    Frames that are not fetched in time are lost, as with a camera. Raises UserError for a film without frames.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._video, self._due = path.absolute(), open_video(path), 0.0
        rate = self._video.get(cv2.CAP_PROP_FPS)
        self._period = 1 / rate if 1 <= rate <= 240 else 1 / 30

    def grab(self) -> bool:
        """Wait for the next frame."""
        now = time.perf_counter()
        self._due = max(self._due + self._period, now - self._period)
        time.sleep(max(0.0, self._due - now))
        return self._video.grab() or (self._video.open(str(self._path)) and self._video.grab())

    def retrieve(self) -> tuple[bool, Any]:
        return self._video.retrieve()

    def get(self, name: int) -> float:
        return float(self._video.get(name))

    def release(self) -> None:
        self._video.release()


class Live:
    """The newest frame of a source, with everything that the page shows of it. `start` begins, `stop` ends.

    `space` holds known touches of the same encoder. Recordings go into the folder `out`.
    """

    kind = "live"

    def __init__(
        self, source: str, encoder: Encoder, *, sensor: str | None, head: LinearHead | None = None,
        space: FeatureMap | None = None, out: Path | None = None, camera: CameraSettings | None = None,
        log: Callable[[str], None] = print,
    ) -> None:  # fmt: skip
        if space is not None:
            space.index.check(encoder.source, encoder.fingerprint)
        self.name, self._source = Path(source).name, source
        self._encoder, self._head, self._space = encoder, head, space
        self._sensor, self._camera, self._log = sensor, camera, log
        self._row = encoder.sensor_row(sensor or UNIVERSAL, log)
        self._rotate = 0
        self._flip: Flip = "none"
        self.background: Array | None = None  # the captured picture of the untouched gel, RGB u8 (h, w, 3)
        self._gel: tuple[Array | None, Any] = None, None  # a picture, and what the panels need of it
        self._preprocess = self._preprocessing(None)
        self._raw: deque[tuple[int, Array]] = deque(maxlen=8)  # the last pictures by the number of their frame
        self._count = 0
        self._near: tuple[list[dict[str, Any]], float] = ([], 0.0)
        self._times: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        self._newest = (0, b"")  # the number of a packet, and the packet
        self._stopped = False
        self._thread: threading.Thread | None = None
        self.recorder = None if out is None else LiveRecorder(out, sensor)

    def about(self) -> dict[str, Any]:
        """Return what the page can offer."""
        return {
            "encoder": self._encoder.source, "sensor": self._sensor, "head": self._head and self._head.label,
            "table": self._space and self._space.table, "record": self.recorder is not None,
        }  # fmt: skip

    def start(self) -> None:
        """Open the source and begin. Raises UserError if it cannot be opened."""
        source, live = open_source(self._source, self._camera, self._log)
        if not live and Path(self._source).is_file():
            source.release()
            source = LoopedFilm(Path(self._source))
        self._thread = threading.Thread(target=self._run, args=(source,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the stream, and the recording."""
        self._stopped = True
        if self.recorder is not None:
            self.recorder.stop()
        if self._thread is not None:
            self._thread.join(3)

    def orient(self, rotate: int, flip: Flip) -> None:
        """Turn the frames clockwise by `rotate` degrees, then mirror them. The background is dropped."""
        self._rotate, self._flip = rotate, flip
        self.set_background(None)

    def capture_background(self) -> None:
        """Take the newest frame as the untouched gel."""
        if self._raw:
            self.set_background(self._oriented(self._raw[-1][1]))

    async def packets(self) -> AsyncIterator[bytes]:
        """Yield each newest frame for one page: length u32, JSON, length u32, JPEG, little endian.

        It waits without a thread: pages that wait for a stopped camera must not take those of other requests.
        """
        seen = 0
        while not self._stopped:
            number, packet = self._newest
            if number == seen:
                await asyncio.sleep(_LOOK)
            else:
                seen = number
                yield packet

    def set_background(self, picture: Array | None) -> None:
        """Take a picture RGB u8 (h, w, 3) as the untouched gel, or go on without one."""
        # Frames are turned before, so the encoder's preprocessing does not.
        self.background = picture
        self._preprocess = self._preprocessing(picture)

    def _preprocessing(self, picture: Array | None) -> Preprocess:
        known = {} if self._head is None else self._head.gels
        return Preprocess(self._encoder, picture, known=known, log=self._log)

    def _oriented(self, picture: Array) -> Array:
        return np.ascontiguousarray(orient_frame(picture, self._rotate, self._flip))

    def _prepare(self, picture: Any) -> Array:
        """Keep the picture of a frame and return it for the encoder: frames come here one by one, from 0."""
        self._raw.append((self._count, picture))
        self._count += 1
        return self._preprocess(self._oriented(picture))

    def _run(self, source: Any) -> None:
        try:
            prepare: Any = self._prepare
            frames = stream(
                self._encoder, source, prepare, live=True, sensor=self._row, log=self._log,
                pooling="class" if self._head is None else self._head.pooling,
            )  # fmt: skip
            with contextlib.closing(frames):
                for frame in frames:
                    if self._stopped:
                        return
                    self._show(frame)
        except UserError as error:
            self._publish({"error": str(error)}, b"")

    def _show(self, frame: Embedded) -> None:
        pictures = [picture for number, picture in tuple(self._raw) if number == frame.number]
        if not pictures:
            return
        picture = self._oriented(pictures[0])
        threshold = THRESHOLDS.get(self._sensor or UNIVERSAL, DEFAULT_THRESHOLD)
        gel = self._preprocess.background
        if gel is not self._gel[0]:
            self._gel = gel, None if gel is None else (scale_down(gel), UntouchedGel(gel))
        view, score = touch_panels(picture, self._gel[1], threshold)
        if self.recorder is not None:
            self.recorder.add(picture)
        self._times.append((frame.seconds[-1], frame.age))
        encoder, age = 1e3 * np.percentile(np.asarray(self._times), (50, 99), axis=0).T
        about: dict[str, Any] = {
            "frame": frame.number, "grabbed": 1e3 * (frame.started + frame.at), "picture": frame.picture,
            "panels": 1 if score != score else 3, "score": None if score != score else round(score, 2),
            "threshold": threshold, "contact": None if score != score else bool(score > threshold),
            "encoder": encoder.round(2).tolist(), "age": age.round(2).tolist(), "missed": frame.missed,
            "recording": None if self.recorder is None else self.recorder.state(),
        } | ({"background": "estimated"} if frame.estimated else {})  # fmt: skip
        about |= self._classify(frame.values) | {"near": self._nearest(frame.values)}
        self._publish(about, encode(view, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 85))

    def _classify(self, values: Array) -> dict[str, Any]:
        if self._head is None:
            return {}
        if self._head.calibration is None:
            (label,), p = self._head(values[None])
            return {"label": str(label), "p": round(float(p.max()), 3)}
        one = self._head.assess(values[None])
        return {
            "label": str(one.label[0]), "p": round(float(one.p.max()), 3), "novel": bool(one.novel[0]),
            "set": self._head.classes[one.in_set[0]].tolist(), "novelty": round(float(one.novelty[0]), 3),
            "limit": round(limit, 3) if (limit := self._head.calibration.novelty_limit) < 1e9 else None,
        }  # fmt: skip

    def _nearest(self, values: Array) -> list[dict[str, Any]]:
        found, at = self._near
        if self._space is not None and time.perf_counter() - at > _SEARCH:
            found = self._space.near(unit_rows(values[None])[0], count=5)
            self._near = found, time.perf_counter()
        return found

    def _publish(self, about: dict[str, Any], picture: bytes) -> None:
        text = json.dumps(about | {"sent": 1e3 * time.time()}).encode()
        packet = struct.pack("<I", len(text)) + text + struct.pack("<I", len(picture)) + picture
        self._newest = (self._newest[0] + 1, packet)


class LiveRecorder:
    """Writes frames of recordings into a folder, and after each recording its manifest.parquet.

    An unfinished recording is in a hidden folder. The manifest has whole recordings only. Frames of a recording that
    fails stay in its folder.
    """

    def __init__(self, out: Path, sensor: str | None) -> None:
        self._out, self._sensor = out.expanduser().resolve(), sensor
        self._queue: queue.Queue[Array | None] | None = None
        self._thread: threading.Thread | None = None
        self._written, self._lost, self._done = 0, 0, ""

    def state(self) -> dict[str, Any]:
        """Return the state for the page."""
        about = {"written": self._written, "lost": self._lost, "done": self._done}
        return about | {"on": self._queue is not None, "out": str(self._out)}

    def start(self, name: str, split: Literal["train", "val", "test", "unused"], gel: Array | None) -> None:
        """Begin a recording of an object called `name` ("" if unknown). Raises UserError."""
        if self._sensor is None:
            raise UserError("A recording needs the name of its sensor. Start again with --sensor.")
        if self._queue is not None:
            raise UserError("A recording is on already. Stop it first.")
        name = " ".join(name.split())[:100]
        stem = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:40] or "touch"
        begun = f"{time.strftime('%Y%m%d_%H%M%S')}_{stem}"
        names = (begun, *(f"{begun}_{number}" for number in range(2, 100)))
        target = next(self._out / each for each in names if not (self._out / each).exists())
        self._written, self._lost, self._done = 0, 0, ""
        waiting: queue.Queue[Array | None] = queue.Queue()
        self._thread = threading.Thread(target=self._write, args=(waiting, target, name, split, gel), daemon=True)
        self._thread.start()
        self._queue = waiting

    def add(self, picture: Array) -> None:
        """Store a frame if a recording is on."""
        waiting = self._queue
        if waiting is not None and waiting.qsize() < _WAITING:
            waiting.put(picture)
        elif waiting is not None:
            self._lost += 1

    def stop(self) -> None:
        """End the recording, and wait until it is on the disk."""
        waiting, self._queue = self._queue, None
        if waiting is not None and self._thread is not None:
            waiting.put(None)
            self._thread.join()

    def _write(self, waiting: Any, target: Path, name: str, split: str, gel: Array | None) -> None:
        part = target.with_name(f".{target.name}")
        try:
            part.mkdir(parents=True)
            if gel is not None:
                (part / "background.png").write_bytes(encode(gel, ".png", *_QUICK))
            while (picture := waiting.get()) is not None:
                (part / f"{self._written:06d}.png").write_bytes(encode(picture, ".png", *_QUICK))
                self._written += 1
            if not self._written:
                self._done = "No frame came, and nothing was written."
                return
            part.rename(target)
            self._add_rows(target.name, name, split, gel is not None)
            self._done = f"{self._written} frames in {target}, rows in {self._out / 'manifest.parquet'}"
        except (OSError, UserError) as error:
            self._queue, self._done = None, f"The recording failed: {error}"
            if self._written and part.exists():
                part.rename(target)
                self._done += f". Its first {self._written} frames are in {target}, without rows in a manifest."
        finally:
            shutil.rmtree(part, ignore_errors=True)

    def _add_rows(self, folder: str, name: str, split: str, has_background: bool) -> None:
        file, count = self._out / "manifest.parquet", self._written
        columns: dict[str, list[Any]] = {
            "path": [f"{folder}/{number:06d}.png" for number in range(count)], "sensor": [self._sensor] * count,
            "sequence": [folder] * count, "frame_index": list(range(count)), "split": [split] * count,
            "object": [name or None] * count,
            "background_path": [f"{folder}/background.png" if has_background else None] * count,
        }  # fmt: skip
        if file.exists():
            tables = [manifests.read(file).table, manifests.from_columns(columns, file).table]
            columns = pa.concat_tables(tables, promote_options="permissive").to_pydict()
        manifests.write(manifests.from_columns(columns, file), file)
