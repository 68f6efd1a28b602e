"""Live touch for the page: contact, class, depth, force, nearest touches and recordings."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.live.cameras import CameraSettings, LoopedVideo, open_source
from anytouch_jax.live.examples import EXAMPLE, ExampleCamera
from anytouch_jax.live.page.frames import FrameReader
from anytouch_jax.live.page.naming import NearestTouches, name_touch
from anytouch_jax.live.page.packet import SIDE, Shown, describe_touch, layers_of, packet
from anytouch_jax.live.page.recorder import LiveRecorder
from anytouch_jax.live.page.teach import Teacher
from anytouch_jax.live.stream import Embedded, Source, StreamSettings, stream_with

if TYPE_CHECKING:
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.linear_head import Head
    from anytouch_jax.live.page.feature_map import FeatureMap

_KEPT = 600  # frames whose times make p50 and p99, as on the page
_LOOK = 0.005  # seconds between looks for a new packet


class Live:
    """The newest frame of a source, with everything that the page shows of it.

    `start` begins, `stop` ends.

    Args:
        source: what a user calls a camera, or a video.
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
        head: Head | None = None,
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
        self._row = encoder.sensor_row(self.recorder.word, log)
        self.frames = FrameReader(encoder, self.recorder.word, self._head_in_use, log)
        self._nearest = NearestTouches()
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
            "layers": layers_of(self._encoder.measures),
        }

    def start(self) -> None:
        """Open the source and begin. Raises UserError if it cannot be opened."""
        source: Source
        if self.source == EXAMPLE:
            source = ExampleCamera()
        else:
            source, live = open_source(self.source, self._camera, self._log)
            if not live and Path(self.source).is_file():
                source.release()
                source = LoopedVideo(Path(self.source))
        self._thread = threading.Thread(target=self._run, args=(source,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the stream, and the recording."""
        self._stopped = True
        self.teacher.longer.stop()
        self.recorder.stop()
        if self._thread is not None:
            self._thread.join(3)

    def _head_in_use(self) -> Head | None:
        return self.teacher.head or self._head

    def _named(self, frame: Embedded, prepared: np.ndarray) -> dict[str, Any]:
        """Return the name of a frame, by the encoder that was trained longer if there is one."""
        tuned = self.teacher.longer.tuned
        if tuned is None:
            return name_touch(self._head_in_use(), frame.values)
        return name_touch(tuned.head, tuned.features(prepared, self._row))

    async def packets(self, layer: str, side: int = SIDE) -> AsyncIterator[bytes]:
        """Yield each newest frame as a layer, with a long side of `side` pixels (see `packet`).

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
                yield await asyncio.to_thread(packet, newest, layer, side)

    def _run(self, source: Any) -> None:
        """Show what a source gives, up to its end: the camera's thread."""
        try:
            self.frames.warm_up(self._row)
            prepare: Any = self.frames
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
        kept = self.frames.last(frame.number)
        if not kept:
            # The reader is so far ahead that the image is gone.
            return
        image = kept[-1].turned
        setup = kept[-1].setup
        score = self.frames.score(kept[-1])
        fields = None
        if score == score:  # NaN: the background is not known yet
            fields = self.frames.measured(kept, self._row)
        self.recorder.add(image, score, frame.values)
        self.teacher.look()
        self._times.append((frame.seconds[-1], frame.age))
        encoder, age = 1e3 * np.percentile(np.asarray(self._times), (50, 99), axis=0).T
        about: dict[str, Any] = {
            "frame": frame.number,
            "grabbed": 1e3 * (frame.started + frame.at),
            "picture": frame.image,
            "gel": "captured" if setup.running is None else "estimated",
            "note": setup.note,
            "encoder": encoder.round(2).tolist(),
            "age": age.round(2).tolist(),
            "missed": frame.missed,
            "recording": self.recorder.state(),
            "taught": self.teacher.version,
        }
        about |= describe_touch(score, self.frames.threshold, fields)
        about |= self._named(frame, kept[-1].prepared)
        spaces = {"near": self._space, "recorded": self.teacher.space}
        about |= self._nearest(frame.values, spaces)
        self._newest = Shown(self._newest.number + 1, about, image, setup.small, fields)
