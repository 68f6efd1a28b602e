"""Live touch for the page: a camera or a film in its place, with contact, class, nearest touches
and recordings.
"""

import asyncio
import contextlib
import json
import struct
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from anytouch_jax.config import UNIVERSAL
from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.background.estimate import UntouchedGel
from anytouch_jax.data.background.rule import RunningGel, other_unit, same_unit
from anytouch_jax.data.images import encode, open_video
from anytouch_jax.data.transforms import Flip, orient_frame
from anytouch_jax.encoder.arrays import Array, unit_rows
from anytouch_jax.encoder.base import Preprocess
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.encoder.linear_head import LinearHead
from anytouch_jax.errors import UserError
from anytouch_jax.fields.measure import Fields, Measure
from anytouch_jax.live.cameras import CameraSettings, open_source
from anytouch_jax.live.page import tables
from anytouch_jax.live.page.tables import FeatureMap
from anytouch_jax.live.page.teach import LiveRecorder, Teacher
from anytouch_jax.live.stream import Embedded, stream

_KEPT = 600  # frames whose times make p50 and p99, as on the page
_SEARCH = 0.5  # seconds between searches for the nearest touches
_LOOK = 0.005  # seconds between looks for a new packet


class LoopedFilm:
    """A film in place of a camera, again and again; late frames are lost.

    Raises UserError for one without frames.
    """

    def __init__(self, path: Path) -> None:
        self._path = path.absolute()
        self._video = open_video(path)
        self._due = 0.0
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


class _Shown(NamedTuple):
    """What the page shows of a frame: its picture, turned, the untouched gel, what is known, and
    what was measured.
    """

    number: int = 0
    about: Mapping[str, Any] = {}
    picture: Array | None = None
    gel: tuple[Array, UntouchedGel] | None = None
    fields: Fields | None = None


class _Setup(NamedTuple):
    """How frames are read. A frame is read by one of them, whatever the page asks for meanwhile."""

    rotate: int
    flip: Flip
    running: RunningGel | None  # None if a picture of the untouched gel was given
    gel: Array | None
    small: tuple[Array, UntouchedGel] | None
    preprocess: Preprocess
    measure: Measure | None

    def turned(self, picture: Array) -> Array:
        return np.ascontiguousarray(orient_frame(picture, self.rotate, self.flip))


class _Kept(NamedTuple):
    """One of the last frames: its number, its picture as read, turned and prepared, and how."""

    number: int
    raw: Array
    turned: Array
    prepared: Array
    setup: _Setup


class Live:
    """The newest frame of a source, with everything that the page shows of it.

    `start` begins, `stop` ends.

    `space` holds known touches of the encoder. A head can be taught in the folder `out`, and
    replaces `head`.
    """

    kind = "live"

    def __init__(
        self,
        source: str,
        encoder: Encoder,
        *,
        sensor: str | None,
        head: LinearHead | None = None,
        space: FeatureMap | None = None,
        out: Path,
        camera: CameraSettings | None = None,
        log: Callable[[str], None] = print,
    ) -> None:
        if space is not None:
            space.index.check(encoder.source, encoder.fingerprint)
        self.name = f"camera {source}" if source.isdecimal() else Path(source).stem
        self.source = source
        self._encoder = encoder
        self._head = head
        self._space = space
        self._sensor = sensor
        self._camera = camera
        self._log = log
        self._row = encoder.sensor_row(sensor or UNIVERSAL, log)
        self._looker = ThreadPoolExecutor(1)
        self._looking: Future[None] | None = None
        self._lock = threading.Lock()  # the page and the camera both set up
        self._setup = self._with_gel(0, "none", None)
        self._kept: deque[_Kept] = deque(maxlen=8)
        self._count = 0
        self._near: tuple[dict[str, Any], float] = ({}, 0.0)
        self._times: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        self._newest = _Shown()
        self._stopped = False
        self._thread: threading.Thread | None = None
        self.recorder = LiveRecorder(out, sensor)
        self.teacher = Teacher(
            encoder, self.recorder, "class" if head is None else head.pooling, log
        )

    def about(self) -> dict[str, Any]:
        """Return what the page can offer."""
        return {
            "encoder": self._encoder.source,
            "sensor": self._sensor,
            "head": self._head and self._head.label,
            "source": self.source,
            "table": self._space and self._space.table,
            "layers": [
                name
                for name in tables.LAYERS
                if self._encoder.measures or name not in tables.MEASURED
            ],
        }

    def start(self) -> None:
        """Open the source and begin. Raises UserError if it cannot be opened."""
        source, live = open_source(self.source, self._camera, self._log)
        if not live and Path(self.source).is_file():
            source.release()
            source = LoopedFilm(Path(self.source))
        self._thread = threading.Thread(target=self._run, args=(source,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the stream, and the recording."""
        self._stopped = True
        self.recorder.stop()
        if self._thread is not None:
            self._thread.join(3)

    def orient(self, rotate: int, flip: Flip) -> None:
        """Turn the frames clockwise by `rotate` degrees, then mirror them.

        The untouched gel is estimated again.
        """
        with self._lock:
            self._setup = self._with_gel(rotate, flip, None)

    @property
    def gel(self) -> Array | None:
        """The untouched gel in use, RGB u8 (h, w, 3), turned as frames are."""
        return self._setup.gel

    def capture_background(self) -> None:
        """Take the newest frame as the untouched gel."""
        if self._kept:
            self.set_background(self._setup.turned(self._kept[-1].raw))

    async def packets(self, layer: str) -> AsyncIterator[bytes]:
        """Yield each newest frame as a layer: length u32, JSON, length u32, JPEG, little endian.

        It takes no thread.
        """
        seen = 0
        while not self._stopped:
            newest = self._newest
            if newest.number == seen:
                await asyncio.sleep(_LOOK)
            else:
                seen = newest.number
                yield await asyncio.to_thread(_packet, newest, layer)

    def set_background(self, picture: Array | None) -> None:
        """Take a picture RGB u8 (h, w, 3) as the untouched gel, or None to estimate it from the
        next frames.
        """
        with self._lock:
            self._setup = self._with_gel(self._setup.rotate, self._setup.flip, picture)

    def _with_gel(
        self, rotate: int, flip: Flip, gel: Array | None, running: RunningGel | None = None
    ) -> _Setup:
        estimate = running or RunningGel() if gel is None or running else None
        small = None if gel is None else (tables.scale_down(gel), UntouchedGel(gel))
        known = self._sensor or UNIVERSAL, gel
        measure = (
            self._encoder.measure_of(*known, log=lambda _: None) if self._encoder.measures else None
        )
        # Frames are turned before, so the encoder's preprocessing does not.
        return _Setup(rotate, flip, estimate, gel, small, Preprocess(self._encoder, gel), measure)

    def _find_gel(self, setup: _Setup, picture: Array) -> _Setup:
        """Look for the untouched gel by the rule of `data.gels`: that of the head's unit, or a
        running estimate.
        """
        running = setup.running
        head = self.teacher.head or self._head
        if running is None:
            return setup
        if not self._count and head is not None and head.gels:
            known, why = same_unit(head.gels, picture)
            if known is not None and not why:
                return self._replace(setup, known, None)
            self._log(other_unit(why))
        if (
            self._looking is None or self._looking.done()
        ):  # an estimate takes longer than a frame may be old
            self._looking = self._looker.submit(running.add, picture)
            if running.picture is None:
                self._looking.result()
        if running.picture is setup.gel:
            return setup
        return self._replace(setup, running.picture, running)

    def _replace(self, setup: _Setup, gel: Array | None, running: RunningGel | None) -> _Setup:
        """Return a setup with another untouched gel, and use it if the page has not asked for
        another meanwhile.
        """
        new = self._with_gel(setup.rotate, setup.flip, gel, running)
        with self._lock:
            if self._setup is setup:
                self._setup = new
        return new

    def _prepare(self, picture: Any) -> Array:
        """Keep the picture of a frame and return it for the encoder: frames come here one by one,
        from 0.
        """
        setup = self._setup
        turned = setup.turned(picture)
        setup = self._find_gel(setup, turned)
        prepared = setup.preprocess(turned)
        self._kept.append(_Kept(self._count, picture, turned, prepared, setup))
        self._count += 1
        return prepared

    def _run(self, source: Any) -> None:
        try:
            if (measure := self._setup.measure) is not None:  # compiled before the first frame
                self._fields(measure, self._encoder.blank, [self._encoder.blank])
                self.set_background(self.gel)
            prepare: Any = self._prepare
            frames = stream(
                self._encoder,
                source,
                prepare,
                live=True,
                sensor=self._row,
                log=self._log,
                pooling="class" if self._head is None else self._head.pooling,
            )
            with contextlib.closing(frames):
                for frame in frames:
                    if self._stopped:
                        return
                    self._show(frame)
        except UserError as error:
            self._newest = _Shown(self._newest.number + 1, {"error": str(error)})

    def _show(self, frame: Embedded) -> None:
        kept = [one for one in tuple(self._kept) if one.number <= frame.number]
        if not kept or kept[-1].number != frame.number:
            return
        *_, picture, _, setup = kept[-1]
        threshold = THRESHOLDS.get(self._sensor or UNIVERSAL, DEFAULT_THRESHOLD)
        score = tables.touch_layer(picture, setup.small, threshold, "frame")[1]
        fields = None
        if score == score and setup.measure is not None:
            like = [
                one.prepared
                for one in kept
                if (one.setup.rotate, one.setup.flip) == (setup.rotate, setup.flip)
            ]
            fields = self._fields(setup.measure, picture, like)
        measured = {} if fields is None else tables.field_numbers(fields)
        self.recorder.add(picture, score, frame.values)
        self._times.append((frame.seconds[-1], frame.age))
        encoder, age = 1e3 * np.percentile(np.asarray(self._times), (50, 99), axis=0).T
        about: dict[str, Any] = {
            "frame": frame.number,
            "grabbed": 1e3 * (frame.started + frame.at),
            "picture": frame.picture,
            "contact": None if score != score else bool(score > threshold),
            "threshold": threshold,
            "gel": "captured" if setup.running is None else "estimated",
            "curves": {}
            if score != score
            else {"contact": round(score, 2)} | measured.get("curves", {}),
            "fields": measured or None,
            "encoder": encoder.round(2).tolist(),
            "age": age.round(2).tolist(),
            "missed": frame.missed,
            "recording": self.recorder.state(),
            "taught": self.teacher.version,
        }
        about |= self._classify(frame.values) | self._nearest(frame.values)
        self._newest = _Shown(self._newest.number + 1, about, picture, setup.small, fields)

    def _fields(self, measure: Measure, picture: Array, prepared: list[Array]) -> Fields:
        """Measure a picture, the last of some prepared frames."""
        clip = tables.last_clip(prepared, self._encoder.config.model.frames)
        row = np.array([self._row], np.int32)
        aspect = np.log([picture.shape[0] / picture.shape[1]]).astype(np.float32)
        return measure(self._encoder.encode_and_measure(clip[None], row, aspect)[1], [picture])

    def _classify(self, values: Array) -> dict[str, Any]:
        if (head := self.teacher.head or self._head) is None:
            return {}
        if head.calibration is None:
            (label,), p = head(values[None])
            return {"label": str(label), "p": round(float(p.max()), 3)}
        one = head.assess(values[None])
        return {
            "label": str(one.label[0]),
            "p": round(float(one.p.max()), 3),
            "novel": bool(one.novel[0]),
            "set": head.classes[one.in_set[0]].tolist(),
            "novelty": round(float(one.novelty[0]), 3),
            "limit": round(limit, 3) if (limit := head.calibration.novelty_limit) < 1e9 else None,
        }

    def _nearest(self, values: Array) -> dict[str, Any]:
        """Return the nearest known touches, and the nearest recorded one."""
        found, at = self._near
        if time.perf_counter() - at > _SEARCH:
            unit = unit_rows(values[None])[0]
            near = {"near": self._space, "recorded": self.teacher.space}
            found = {
                name: space.near(unit, count=5) for name, space in near.items() if space is not None
            }
            self._near = found, time.perf_counter()
        return found


def _packet(shown: _Shown, layer: str) -> bytes:
    """Return a frame for the page (see `Live.packets`)."""
    about = {"layer": layer, "sent": 1e3 * time.time(), **shown.about}
    jpeg = b""
    if shown.picture is not None:
        # its score is known already
        gel = shown.gel if layer != tables.LAYERS[0] else None
        view, score = tables.touch_layer(shown.picture, gel, about["threshold"], layer)
        about["layer"] = (
            "frame"
            if score != score or (layer in tables.MEASURED and shown.fields is None)
            else layer
        )
        if shown.fields is not None and about["layer"] in tables.MEASURED:
            view = tables.measured_layer(view, shown.fields, layer)
        jpeg = encode(view, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 85)
    text = json.dumps(about).encode()
    return struct.pack("<I", len(text)) + text + struct.pack("<I", len(jpeg)) + jpeg
