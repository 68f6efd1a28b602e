"""Live features of a camera or a video, frame by frame, with the latency of each part.

A thread reads and preprocesses frames, and a mailbox of one slot holds the newest clip (see
`live.reader`). `anytouch stream` prints what comes out. The end of a video ends the stream.
"""

import contextlib
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np

from anytouch_jax.encoder.arrays import Aggregation, Log, Pooling, check_features, warn
from anytouch_jax.encoder.base import Preprocess, precision
from anytouch_jax.encoder.encoder import Encoder, check_frames
from anytouch_jax.encoder.measured import Fields, Measure
from anytouch_jax.errors import UserError, handled

# Callers find these next to `stream`.
from anytouch_jax.live.cameras import open_source as open_source
from anytouch_jax.live.freshness import Rate
from anytouch_jax.live.reader import BLACK as BLACK
from anytouch_jax.live.reader import RETRY as RETRY
from anytouch_jax.live.reader import CameraError as CameraError
from anytouch_jax.live.reader import (
    Clip,
    Mailbox,
    Source,
    camera_frames,
    read_clips,
    video_frames,
)
from anytouch_jax.shown import shown_short

# What the time from a frame to its features is made of. Its rest is the wait, for the encoder to be
# done with an earlier frame.
PARTS = ("decode", "resize", "contact", "wait", "copy", "encoder")
KEPT = 100_000  # last frames whose times are stored if their features are not
HANG = 20.0  # seconds to wait for a read that does not return; V4L2 itself gives up after 10
CELL = 14  # pixels of a side over which a change is averaged
# Bytes of parameters up to which XLA may lay them out for the processor when it compiles a touch.
CONSTANT = 32_000_000
# Changes from which the noise of a camera is known, at first and later.
LEARNED = 30
CHANGES = 1000
_PATIENCE = 2.0  # seconds to wait for the reader after the last frame


@shown_short
class Embedded(NamedTuple):
    """Features of the clip that ends with a frame, and what is known of that frame.

    Attributes:
        number: of the frame, from 0.
        at: seconds from the start of the stream to the frame.
        values: the features f32 (E,).
        seconds: those of PARTS, whose sum is the age.
        age: seconds from the grabbed frame to its features.
        started: start of the stream in Unix seconds.
        time: the time stamp of a video's frame in seconds, or `at` of a camera's.
        image: "ok", "frozen" or "black".
        missed: missed reads so far.
        contact: 1, 0 or NaN (unknown).
        reused: see `Reuse`.
        estimated: the background is a running estimate, which may still improve.
        fields: what was measured, if anything.
        repeated: frames of the camera so far with the bytes of the frame before.
        waited: seconds from the capture of the frame to its reading, NaN if unknown.
    """

    number: int
    at: float
    values: np.ndarray
    seconds: tuple[float, ...]
    age: float
    started: float = 0.0
    time: float = 0.0
    image: str = "ok"
    missed: int = 0
    contact: float = float("nan")
    reused: bool = False
    estimated: bool = False
    fields: Fields | None = None
    repeated: int = 0
    waited: float = float("nan")


@dataclass(frozen=True, kw_only=True, eq=False)
class StreamSettings:
    """How a stream is read and embedded.

    Attributes:
        live: the source is a camera. Frames are dropped while the encoder is busy.
        sensor: row of the encoder's table of sensors.
        frames: those of a clip, the last ones.
        stride: frames from one of a clip to the next.
        pooling: that of the features.
        aggregation: temporal aggregation of a long clip.
        preprocess: makes the network's input of an image, `Preprocess(encoder)` by default.
        contact: decides contact of an image RGB u8 (h, w, 3), as `ContactGate` does.
        reuse: the factor of `Reuse`.
        measure: of `Encoder.measure_of`, measures fields in the same pass.
        log: gets one sentence each about a missed read, a frozen and a black image.
    """

    live: bool
    sensor: int
    frames: int = 1
    stride: int = 1
    pooling: Pooling = "class"
    aggregation: Aggregation = "mean"
    preprocess: Preprocess | None = None
    contact: Callable[[np.ndarray], float] | None = None
    reuse: float = 0.0
    measure: Measure | None = None
    log: Log = warn

    def check(self, encoder: Encoder) -> None:
        """Raise UserError for lengths that the encoder, or its fields, cannot read."""
        known = encoder.config.model
        check_frames(known, self.frames)
        if self.stride < 1:
            raise UserError(f"the stride of a clip must be at least 1, not {self.stride}")
        if self.measure is not None and self.frames not in (1, known.frames):
            raise UserError(
                f"fields are measured on 1 frame or clips of {known.frames}, not of {self.frames}"
            )


def stream(  # noqa: PLR0913  the call of version 0.2; `stream_with` takes the record
    encoder: Encoder,
    source: Source,
    preprocess: Preprocess | None = None,
    *,
    live: bool,
    sensor: int,
    frames: int = 1,
    stride: int = 1,
    pooling: Pooling = "class",
    aggregation: Aggregation = "mean",
    log: Log = warn,
    contact: Callable[[np.ndarray], float] | None = None,
    reuse: float = 0.0,
    measure: Measure | None = None,
) -> Generator[Embedded]:
    """Yield features of the frames of `source`, as `stream_with`, of the same settings."""
    settings = StreamSettings(
        live=live,
        sensor=sensor,
        frames=frames,
        stride=stride,
        pooling=pooling,
        aggregation=aggregation,
        preprocess=preprocess,
        contact=contact,
        reuse=reuse,
        measure=measure,
        log=log,
    )
    return stream_with(encoder, source, settings)


def stream_with(encoder: Encoder, source: Source, settings: StreamSettings) -> Generator[Embedded]:
    """Yield features of the frames of `source`.

    The encoder is compiled here, before the first frame is read. Close the iterator to stop and to
    release the source.

    Args:
        encoder: a loaded encoder.
        source: a cv2.VideoCapture, or another object with its methods (see `reader.Source`).
        settings: how frames are read and embedded.

    Raises:
        UserError: a wrong length or factor, or pixels that cannot be used.
        CameraError: no frame of a camera for `reader.RETRY` seconds.
    """
    settings.check(encoder)
    is_served = Reuse(settings.reuse)
    embed = _Embedder(encoder, settings)
    mailbox = Mailbox(replace=settings.live)
    if settings.live:
        arrived = camera_frames(source, mailbox, settings.log)
    else:
        arrived = video_frames(source)
    preprocess = settings.preprocess or Preprocess(encoder)
    reader = threading.Thread(
        target=read_clips,
        args=(arrived, preprocess, settings.frames, settings.stride, mailbox, settings.contact),
        daemon=True,
    )

    def embedded() -> Generator[Embedded]:
        started = time.time()
        start = time.perf_counter()
        hang = HANG if settings.live else None
        try:
            reader.start()  # Ctrl-C may come already while the thread starts
            while (clip := mailbox.take(hang)) is not None:
                begin = time.perf_counter()
                reused = is_served(clip.frames)
                # What is reused was copied by the end of the comparison.
                copied = begin if reused else embed(clip)
                end = time.perf_counter()
                last = clip.last
                at = last.read - start
                wait = begin - last.read - last.decode - clip.resize - clip.decide
                seconds = (
                    last.decode,
                    clip.resize,
                    clip.decide,
                    # Clocks are read one after the other, so an empty wait may be just below 0.
                    max(0.0, wait),
                    copied - begin,
                    end - copied,
                )
                yield Embedded(
                    number=last.number,
                    at=at,
                    values=embed.values,
                    seconds=seconds,
                    age=end - last.read,
                    started=started,
                    time=at if last.time is None else last.time,
                    image=last.image,
                    missed=last.missed,
                    contact=clip.contact,
                    reused=reused,
                    estimated=clip.estimated,
                    fields=embed.fields,
                    repeated=last.repeated,
                    waited=last.waited,
                )
        finally:
            mailbox.close()
            if reader.ident is not None:
                reader.join(_PATIENCE)
            # Releasing a camera that hangs would hang, too.
            if not reader.is_alive():
                source.release()

    return embedded()


class _Embedder:
    """The compiled encoder, and what it gave last: features f32 (E,), and fields if measured."""

    def __init__(self, encoder: Encoder, settings: StreamSettings) -> None:
        self.values = np.zeros(0, np.float32)
        self.fields: Fields | None = None
        self._measure = settings.measure
        self._run = compile_for_one(
            encoder,
            settings.sensor,
            settings.frames,
            settings.pooling,
            settings.aggregation,
            measures=settings.measure is not None,
        )

    def __call__(self, clip: Clip) -> float:
        """Embed a clip. Return the clock when it was on the device."""
        there = jax.device_put(clip.frames[None]).block_until_ready()
        copied = time.perf_counter()
        if self._measure is None:
            out = self._run(there)
        else:
            image = self._measure.oriented(clip.last.pixels)
            # The network sees square images: the head needs to know how wide they were.
            aspect = np.log(image.shape[0] / image.shape[1])
            out, raw = self._run(there, np.full(1, aspect, np.float32))
            self.fields = self._measure(raw, [image])
        self.values = check_features(np.asarray(out)[0])
        return copied


class Reuse:
    """Decides whether a clip may reuse the last features: no place changed by more than noise.

    Clips are arrays (T, H, W, 3) of one shape. The noise is what a tenth of the last CHANGES from
    one clip to the next stay below, known after LEARNED of them. A clip is served if its largest
    change is at most `factor` times the noise, and with a factor of 0 if it is equal. Raises
    UserError for a negative factor.
    """

    def __init__(self, factor: float) -> None:
        if not factor >= 0:
            raise UserError(f"the factor of the noise must be 0 or more, not {factor:g}")
        self._factor = factor
        self._changes = deque[float](maxlen=CHANGES)
        self._last = self._embedded = np.zeros(0)

    def __call__(self, clip: np.ndarray) -> bool:
        last = self._last
        self._last = clip
        if self._factor and len(last):
            change = largest_change(clip, last)
            # Equal bytes are a camera that repeats itself, which says nothing about its noise.
            if change:
                self._changes.append(change)
        served = np.array_equal(clip, self._embedded)
        if not served and len(self._changes) > LEARNED:
            noise = np.quantile(self._changes, 0.1)
            # It is compared with the clip that was embedded, not with the last one: small changes
            # must not add up unseen.
            served = bool(largest_change(clip, self._embedded) <= self._factor * noise)
        if not served:
            self._embedded = clip
        return served


def largest_change(clip: np.ndarray, other: np.ndarray) -> float:
    """Return the largest mean absolute difference of two clips u8 (T, H, W, 3).

    Means are over cells of CELL pixels, which touch moves and the noise of single pixels does not.
    """
    rows = clip.shape[0] * clip.shape[1]
    width = clip.shape[2]
    change = cv2.absdiff(clip.reshape(rows, -1), other.reshape(rows, -1))
    cells = max(width // CELL, 1), max(rows // CELL, 1)
    # The mean of bytes would be rounded to 0, so it is taken of floats.
    means = cv2.resize(change.astype(np.float32), cells, interpolation=cv2.INTER_AREA)
    return float(means.max())


def compile_for_one(
    encoder: Encoder,
    sensor: int,
    frames: int,
    pooling: Pooling = "class",
    aggregation: Aggregation = "mean",
    *,
    measures: bool = False,
) -> Callable[..., Any]:
    """Return the encoder of one touch u8 (1, T, H, W, 3), compiled and warm.

    Args:
        encoder: a loaded encoder. Its parameters are put on the device.
        sensor: row of its table of sensors.
        frames: T, those of a clip.
        pooling: that of the features.
        aggregation: temporal aggregation of a clip that is longer than the encoder's.
        measures: the function takes log(height / width) f32 (1,) of the image, too, and returns
            the features and the raw fields.
    """
    touch = np.tile(encoder.blank, (1, frames, 1, 1, 1))
    row = np.full(1, sensor, np.int32)
    if measures:
        encoder.encode_and_measure(touch, row, np.zeros(1, np.float32), pooling)
        return lambda clip, aspect: encoder.encode_and_measure(clip, row, aspect, pooling)
    if not encoder.runs_in_jax or encoder.exported(frames, pooling) is not None:
        call = partial(
            encoder.encode_touch,
            sensor=np.full(1, sensor),
            pooling=pooling,
            aggregation=aggregation,
        )
        call(touch)
        return call
    run = encoder.traceable(pooling, aggregation)
    with precision(encoder.config):
        params, *given = jax.device_put((encoder.params, touch, np.full(1, sensor, "i4")))
        compiled: Any
        # Parameters that are constants of the program are laid out for the processor, once. Of a
        # large encoder that takes minutes and twice the memory.
        if sum(leaf.nbytes for leaf in jax.tree.leaves(params)) <= CONSTANT:
            compiled = jax.jit(partial(run, params)).lower(*given).compile()
        else:
            compiled = partial(jax.jit(run).lower(params, *given).compile(), params)
    compiled(*given).block_until_ready()
    return lambda clip: compiled(clip, given[1])


@shown_short
class Result(NamedTuple):
    """What a stream gave: the fields of its `Embedded` as arrays, and counts.

    Attributes:
        values: features f32 (n, E) of frames `numbers` (n,).
        total: frames that have features. The arrays may have only the last ones.
        interrupted: by Ctrl-C or SIGTERM.
        missed: missed reads.
        frozen: images that were frozen.
        black: images that were black.
        error: a camera that delivers nothing any more.
        fields: numbers (n,) by name, as in a line of `Fields.summary`.
        repeated: frames of the camera so far with the bytes of the frame before (n,).
        waited: seconds (n,) from the capture of a frame to its reading.
    """

    values: np.ndarray
    numbers: np.ndarray
    at: np.ndarray
    seconds: np.ndarray
    age: np.ndarray
    total: int
    interrupted: bool
    started: float = 0.0
    time: np.ndarray = np.zeros(0)
    missed: int = 0
    frozen: int = 0
    black: int = 0
    error: CameraError | None = None
    contact: np.ndarray = np.zeros(0)
    reused: np.ndarray = np.zeros(0, bool)
    estimated: np.ndarray = np.zeros(0, bool)
    fields: dict[str, np.ndarray] | None = None
    repeated: np.ndarray = np.zeros(0, int)
    waited: np.ndarray = np.zeros(0)

    def rate(self, nominal: float = float("nan")) -> Rate | None:
        """Return what the camera gave, whatever was dropped; None of less than two frames.

        `nominal` is what it says, in frames a second.
        """
        if len(self.numbers) < 2 or not np.ptp(self.at) > 0:
            return None
        count = int(np.ptp(self.numbers))
        repeated = int(np.ptp(self.repeated))
        known = self.waited[~np.isnan(self.waited)]
        return Rate(
            fresh=(count - repeated) / float(np.ptp(self.at)),
            nominal=nominal,
            repeated=repeated / count,
            age=float(np.median(known)) if len(known) else float("nan"),
        )


def collect(
    embedded: Generator[Embedded], on_each: Callable[[Embedded], None] | None = None
) -> Result:
    """Return what a stream gives up to its end, Ctrl-C, SIGTERM or the failure of the camera.

    With `on_each`, features go there, and only the last KEPT times are stored: a stream may run for
    weeks.
    """
    stored: deque[Embedded] = deque(maxlen=KEPT if on_each else None)
    total = 0
    interrupted = False
    failure = None
    images: Counter[str] = Counter()
    names = list[str]()
    summaries = list[list[float]]()
    try:
        # SIGTERM ends it as Ctrl-C does, so that a service that is stopped saves, too.
        with contextlib.closing(embedded), handled(signal.default_int_handler, signal.SIGTERM):
            for frame in embedded:
                total += 1
                images[frame.image] += 1
                if on_each is not None:
                    on_each(frame)
                    frame = frame._replace(values=np.zeros(0, np.float32))
                elif frame.fields is not None:
                    summary = frame.fields.summary()
                    names = list(summary)
                    summaries.append([_or_nan(value) for value in summary.values()])
                # Maps of every frame would fill the memory: their summary stays.
                stored.append(frame._replace(fields=None))
    except KeyboardInterrupt:
        interrupted = True
    except CameraError as error:
        failure = error
    measured = None
    if names:
        measured = dict(zip(names, np.transpose(summaries), strict=True))
    values = np.zeros((0, 0), np.float32)
    if stored:
        values = np.stack([frame.values for frame in stored])
    return Result(
        values=values,
        numbers=_column(stored, "number").astype(np.int64),
        at=_column(stored, "at"),
        seconds=_column(stored, "seconds").reshape(-1, len(PARTS)),
        age=_column(stored, "age"),
        total=total,
        interrupted=interrupted,
        started=stored[-1].started if stored else 0.0,
        time=_column(stored, "time"),
        missed=stored[-1].missed if stored else 0,
        frozen=images["frozen"],
        black=images["black"],
        error=failure,
        contact=_column(stored, "contact"),
        reused=_column(stored, "reused").astype(bool),
        estimated=_column(stored, "estimated").astype(bool),
        fields=measured,
        repeated=_column(stored, "repeated").astype(int),
        waited=_column(stored, "waited").astype(float),
    )


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value


def _column(frames: Sequence[Embedded], name: str) -> np.ndarray:
    """Return a field of all frames as an array (n, ...)."""
    return np.asarray([getattr(frame, name) for frame in frames])


def budget(result: Result) -> list[str]:
    """Return lines with p50 and p99 of every part in ms, frames a second, and dropped frames."""
    lines = [f"{'part':20} {'p50 ms':>8} {'p99 ms':>8}"]
    parts = [*zip(PARTS, result.seconds.T, strict=True), ("frame to features", result.age)]
    for name, values in parts:
        middle, late = _percentiles(values)
        lines.append(f"{name:20} {1e3 * middle:8.2f} {1e3 * late:8.2f}")
    count = len(result.numbers)
    rate = float("nan")
    if count > 1:
        rate = (count - 1) / np.ptp(result.at + result.age)
    dropped = 0
    if count:
        # Numbers of dropped frames are missing between the first and the last.
        dropped = int(np.ptp(result.numbers)) + 1 - count
    last = "," if result.total == count else f"; of the last {count}:"
    faults = {
        "missed reads": result.missed,
        "frozen images": result.frozen,
        "black images": result.black,
        "reused": int(result.reused.sum()),
    }
    known = "".join(f", {number} {name}" for name, number in faults.items() if number)
    return [
        *lines,
        f"{result.total} frames embedded{last} {dropped} dropped, {rate:.1f} frames/s{known}",
    ]


def _percentiles(values: np.ndarray) -> tuple[float, float]:
    """Return the median and the 99th percentile, NaN of nothing."""
    if not len(values):
        return float("nan"), float("nan")
    middle, late = np.percentile(values, (50, 99))
    return float(middle), float(late)
