"""Live touch for the page: contact, class, depth, force, nearest touches and recordings."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.encoder.arrays import Array, unit_rows
from anytouch_jax.errors import UserError
from anytouch_jax.live.cameras import LoopedFilm, open_source
from anytouch_jax.live.page.layers import LAYERS, MEASURED, field_numbers, touch_layer
from anytouch_jax.live.page.packet import Shown, packet
from anytouch_jax.live.page.recorder import LiveRecorder
from anytouch_jax.live.page.setup import Setup, known_gel, make_setup, measure_last
from anytouch_jax.live.page.teach import Teacher
from anytouch_jax.live.stream import Embedded, StreamSettings, stream_with

if TYPE_CHECKING:
    from anytouch_jax.data.background.rule import RunningGel
    from anytouch_jax.data.transforms import Flip
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.linear_head import LinearHead
    from anytouch_jax.encoder.measured import Fields, Measure
    from anytouch_jax.live.cameras import CameraSettings
    from anytouch_jax.live.page.feature_map import FeatureMap

_KEPT = 600  # frames whose times make p50 and p99, as on the page
_SEARCH = 0.5  # seconds between searches for the nearest touches
_LOOK = 0.005  # seconds between looks for a new packet


class _Kept(NamedTuple):
    """One of the last frames: its number, its picture as read, turned and prepared, and how."""

    number: int
    raw: Array
    turned: Array
    prepared: Array
    setup: Setup


class Live:
    """The newest frame of a source, with everything that the page shows of it.

    `start` begins, `stop` ends.

    Args:
        source: what a user calls a camera, or a film.
        encoder: a loaded encoder.
        sensor: its name, None for the universal tokens.
        head: names live touch. One that is taught in the folder `out` replaces it.
        space: known touches of the encoder, of which the nearest are shown.
        out: folder of recordings, with their manifest, and of the head that they teach.
        camera: what a camera is asked for.
        log: gets a sentence about each thing that is noticed.
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
        self.recorder = LiveRecorder(out, sensor)
        pooling = "class" if head is None else head.pooling
        self.teacher = Teacher(encoder, self.recorder, pooling, log)
        self._row = encoder.sensor_row(self.recorder.sensor, log)
        self._looker = ThreadPoolExecutor(1)
        self._looking: Future[None] | None = None
        self._lock = threading.Lock()  # both the page and the camera set up
        self._setup = make_setup(encoder, sensor, 0, "none", None)
        self._kept: deque[_Kept] = deque(maxlen=8)
        self._count = 0
        self._near: tuple[dict[str, Any], float] = ({}, 0.0)
        self._times: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        self._newest = Shown()
        self._stopped = False
        self._thread: threading.Thread | None = None

    def about(self) -> dict[str, Any]:
        """Return what the page can offer."""
        return {
            "encoder": self._encoder.source,
            "sensor": self._sensor,
            "head": self._head and self._head.label,
            "source": self.source,
            "table": self._space and self._space.table,
            "layers": list(LAYERS if self._encoder.measures else LAYERS[: -len(MEASURED)]),
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

        The background is estimated again.
        """
        with self._lock:
            self._setup = make_setup(self._encoder, self._sensor, rotate, flip, None)

    @property
    def gel(self) -> Array | None:
        """The untouched gel in use, RGB u8 (h, w, 3), turned as frames are."""
        return self._setup.gel

    def capture_background(self) -> None:
        """Take the newest frame as the untouched gel."""
        if self._kept:
            self.set_background(self._setup.turned(self._kept[-1].raw))

    async def packets(self, layer: str) -> AsyncIterator[bytes]:
        """Yield each newest frame as a layer (see `packet`).

        Between frames it takes no thread: the server has 40, and a page that is left open keeps its
        stream.
        """
        seen = 0
        while not self._stopped:
            newest = self._newest
            if newest.number == seen:
                await asyncio.sleep(_LOOK)
            else:
                seen = newest.number
                yield await asyncio.to_thread(packet, newest, layer)

    def set_background(self, picture: Array | None) -> None:
        """Take a picture RGB u8 (h, w, 3) as the background, or None to estimate it again."""
        with self._lock:
            now = self._setup
            self._setup = make_setup(self._encoder, self._sensor, now.rotate, now.flip, picture)

    def _find_gel(self, setup: Setup, picture: Array) -> Setup:
        """Look for the background by the rule of `data.background`.

        It is that of the head's sensor instance, or a running estimate.
        """
        running = setup.running
        if running is None:
            return setup
        head = self.teacher.head or self._head
        if not self._count and head is not None and head.gels:
            known = known_gel(head.gels, picture, self._log)
            if known is not None:
                return self._replace(setup, known, None)
        # An estimate takes longer than a frame may be old, so another thread makes it.
        if self._looking is None or self._looking.done():
            self._looking = self._looker.submit(running.add, picture)
            if running.picture is None:
                self._looking.result()
        if running.picture is setup.gel:
            return setup
        return self._replace(setup, running.picture, running)

    def _replace(self, setup: Setup, gel: Array | None, running: RunningGel | None) -> Setup:
        """Return a setup with another background.

        It is used unless the page has asked for another meanwhile.
        """
        new = make_setup(self._encoder, self._sensor, setup.rotate, setup.flip, gel, running)
        with self._lock:
            if self._setup is setup:
                self._setup = new
        return new

    def _prepare(self, picture: Any) -> Array:
        """Keep the picture of a frame, and return it for the encoder.

        Frames come here one by one, from 0, so that they can be counted.
        """
        setup = self._setup
        turned = setup.turned(picture)
        setup = self._find_gel(setup, turned)
        prepared = setup.preprocess(turned)
        self._kept.append(_Kept(self._count, picture, turned, prepared, setup))
        self._count += 1
        return prepared

    def _run(self, source: Any) -> None:
        """Show what a source gives, up to its end: the camera's thread."""
        try:
            measure = self._setup.measure
            if measure is not None:
                # It is compiled before the first frame, and the background stays as it was.
                self._fields(measure, self._encoder.blank, [self._encoder.blank])
                self.set_background(self.gel)
            prepare: Any = self._prepare
            settings = StreamSettings(
                live=True,
                sensor=self._row,
                pooling="class" if self._head is None else self._head.pooling,
                preprocess=prepare,
                log=self._log,
            )
            frames = stream_with(self._encoder, source, settings)
            with contextlib.closing(frames):
                for frame in frames:
                    if self._stopped:
                        return
                    self._show(frame)
        except UserError as error:
            self._newest = Shown(self._newest.number + 1, {"error": str(error)})

    def _show(self, frame: Embedded) -> None:
        """Make the newest packet of an embedded frame."""
        kept = [one for one in tuple(self._kept) if one.number <= frame.number]
        if not kept or kept[-1].number != frame.number:
            # The reader is so far ahead that the picture is gone.
            return
        picture = kept[-1].turned
        setup = kept[-1].setup
        threshold = THRESHOLDS.get(self.recorder.sensor, DEFAULT_THRESHOLD)
        score = touch_layer(picture, setup.small, threshold, LAYERS[0])[1]
        is_known = score == score  # NaN: the background is not known yet
        fields = None
        if is_known and setup.measure is not None:
            # What came before the picture was turned is no motion.
            clip = [one.prepared for one in kept if one.setup.is_turned_as(setup)]
            fields = self._fields(setup.measure, picture, clip)
        measured = None if fields is None else field_numbers(fields)
        curves = {}
        if is_known:
            curves["contact"] = round(score, 2)
        if measured is not None:
            curves |= measured["curves"]
        self.recorder.add(picture, score, frame.values)
        self._times.append((frame.seconds[-1], frame.age))
        encoder, age = 1e3 * np.percentile(np.asarray(self._times), (50, 99), axis=0).T
        about: dict[str, Any] = {
            "frame": frame.number,
            "grabbed": 1e3 * (frame.started + frame.at),
            "picture": frame.picture,
            "contact": bool(score > threshold) if is_known else None,
            "threshold": threshold,
            "gel": "captured" if setup.running is None else "estimated",
            "curves": curves,
            "fields": measured,
            "encoder": encoder.round(2).tolist(),
            "age": age.round(2).tolist(),
            "missed": frame.missed,
            "recording": self.recorder.state(),
            "taught": self.teacher.version,
        }
        about |= self._classify(frame.values) | self._nearest(frame.values)
        self._newest = Shown(self._newest.number + 1, about, picture, setup.small, fields)

    def _fields(self, measure: Measure, picture: Array, prepared: list[Array]) -> Fields:
        """Measure a picture, the last of some prepared frames."""
        return measure_last(self._encoder, measure, self._row, picture, prepared)

    def _classify(self, values: Array) -> dict[str, Any]:
        """Return the name of features (E,), and whether to believe it."""
        head = self.teacher.head or self._head
        if head is None:
            return {}
        if head.calibration is None:
            (label,), p = head(values[None])
            return {"label": str(label), "p": round(float(p.max()), 3)}
        one = head.assess(values[None])
        limit = head.calibration.novelty_limit
        return {
            "label": str(one.label[0]),
            "p": round(float(one.p.max()), 3),
            "novel": bool(one.novel[0]),
            "set": head.classes[one.in_set[0]].tolist(),
            "novelty": round(float(one.novelty[0]), 3),
            # JSON has no infinity: of few recordings nothing is novel.
            "limit": round(limit, 3) if limit < 1e9 else None,
        }

    def _nearest(self, values: Array) -> dict[str, Any]:
        """Return the nearest known touches, and the nearest recorded one."""
        found, at = self._near
        if time.perf_counter() - at > _SEARCH:
            unit = unit_rows(values[None])[0]
            spaces = {"near": self._space, "recorded": self.teacher.space}
            found = {}
            for name, space in spaces.items():
                if space is not None:
                    found[name] = space.near(unit, count=5)
            self._near = found, time.perf_counter()
        return found
