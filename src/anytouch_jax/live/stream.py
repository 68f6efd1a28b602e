"""Live features of a camera or a video, frame by frame, with the latency of each part (`anytouch
stream`).

A thread reads and preprocesses frames, and a mailbox of one slot holds the newest clip. A camera is
never waited for: frames that arrive while the encoder is busy are dropped, and a clip still has
consecutive frames. None of a video's frames is dropped, and its end ends the stream. A missed read
of a camera is tried again.
"""

import contextlib
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np

from anytouch_jax.data.images import QUIET, frame_time, to_rgb
from anytouch_jax.encoder.arrays import Join, Log, Pooling, check_features, warn
from anytouch_jax.encoder.base import Preprocess, precision
from anytouch_jax.encoder.encoder import Encoder, check_frames
from anytouch_jax.errors import UserError, handled
from anytouch_jax.fields.measure import Fields, Measure

# callers find it next to `stream`
from anytouch_jax.live.cameras import open_source as open_source
from anytouch_jax.shown import shown_short

PARTS = ("decode", "resize", "copy", "encoder")
KEPT = 100_000  # last frames whose times are stored if their features are not
RETRY = 2.0  # seconds in which a missed read of a camera is tried again
HANG = 20.0  # seconds to wait for a read that does not return; V4L2 itself gives up after 10
# seconds of the same bytes, or of black, until they are reported: the noise of a sensor never
# repeats
STUCK = 0.3
BLACK = 8.0  # mean pixel below which a picture is black; untouched gels have 30 and more
CELL = 14  # pixels of a side over which a change is averaged
# bytes of parameters that are laid out for the processor when one touch is compiled
CONSTANT = 32_000_000
# changes from which the noise of a camera is known, at first and later
LEARNED = 30
CHANGES = 1000
_PATIENCE = 2.0  # seconds to wait for the reader after the last frame
_PAUSE = 0.01  # seconds from a missed read to the next


# a cv2.VideoCapture, or another object with its methods grab, retrieve, get (of videos) and release
Source = Any


class CameraError(UserError):
    """A camera that delivers no frames any more."""


@shown_short
class Frame(NamedTuple):
    """Pixels RGB u8 (h, w, 3) of frame `number`, the clock when it was `read`, and the seconds of
    decoding.

    `time`: its time stamp in a video. `picture`: "ok", "frozen" or "black". `missed`: missed reads
    so far.
    """

    number: int
    pixels: np.ndarray
    read: float
    decode: float
    time: float | None = None
    picture: str = "ok"
    missed: int = 0


@shown_short
class Clip(NamedTuple):
    """Frames u8 (T, H, W, 3) up to frame `last`, the seconds of resizing it, and its contact: 1, 0
    or NaN.
    """

    last: Frame
    frames: np.ndarray
    resize: float
    contact: float = float("nan")
    estimated: bool = False


@shown_short
class Embedded(NamedTuple):
    """Features f32 (E,) of the clip that ends with frame `number`.

    `at`: seconds from the start of the stream to the frame. `seconds`: those of PARTS. `age`:
    seconds from the grabbed frame to its features. `started`: start of the stream in Unix seconds.
    `time`: the time stamp of a video's frame, or `at` of a camera's. `contact`: 1, 0 or NaN
    (unknown). `reused`: see `Reuse`. `estimated`: the untouched gel is a running estimate, which
    may still improve. `fields` is what was measured.
    """

    number: int
    at: float
    values: np.ndarray
    seconds: tuple[float, float, float, float]
    age: float
    started: float = 0.0
    time: float = 0.0
    picture: str = "ok"
    missed: int = 0
    contact: float = float("nan")
    reused: bool = False
    estimated: bool = False
    fields: Fields | None = None


class Mailbox:
    """One slot between the reader and the encoder, in which a newer clip may `replace` one that was
    not taken.
    """

    def __init__(self, *, replace: bool) -> None:
        self.is_closed = False
        self.alive = time.perf_counter()
        self._replace = replace
        self._changed = threading.Condition()
        self._clip: Clip | None = None
        self._error: BaseException | None = None

    def put(self, clip: Clip) -> bool:
        """Leave a clip, after waiting for an empty slot unless it may be replaced.

        Return False once it is closed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._replace or self._clip is None or self.is_closed)
            if not self.is_closed:
                self._clip = clip
            self._changed.notify_all()
            return not self.is_closed

    def take(self, hang: float | None = None) -> Clip | None:
        """Wait for a clip and return it, None after the last one.

        Raises the error of the reader, and CameraError after `hang` seconds in which the reader did
        not come back.
        """
        with self._changed:
            while not self._changed.wait_for(
                lambda: self._clip is not None or self.is_closed, hang
            ):
                if hang is not None and time.perf_counter() - self.alive > hang:
                    raise CameraError(
                        f"the camera has not answered for {hang:g} s. Check its cable, and start "
                        "again."
                    )
            clip = self._clip
            self._clip = None
            self._changed.notify_all()
            if clip is None and self._error is not None:
                raise self._error
            return clip

    def close(self, error: BaseException | None = None) -> None:
        """End the stream, from either side. A clip in the slot can still be taken."""
        with self._changed:
            self.is_closed = True
            self._error = self._error or error
            self._changed.notify_all()


def stream(
    encoder: Encoder,
    source: Source,
    preprocess: Preprocess | None = None,
    *,
    live: bool,
    sensor: int,
    frames: int = 1,
    stride: int = 1,
    pooling: Pooling = "class",
    join: Join = "mean",
    log: Log = warn,
    contact: Callable[[np.ndarray], float] | None = None,
    reuse: float = 0.0,
    measure: Measure | None = None,
) -> Generator[Embedded]:
    """Yield features of the frames of `source`; the encoder is compiled before the first frame is
    read.

    A clip is the last `frames` frames, `stride` apart. `sensor` is a row of the table. `preprocess`
    is `Preprocess(encoder)` by default. With `live`, frames are dropped while the encoder is busy,
    and `log` gets one sentence each about a missed read, a frozen and a black picture. `contact`
    decides contact of a frame, as `ContactGate` does. `reuse` is the factor of `Reuse`. `measure`,
    of `Encoder.measure_of`, measures in the same pass. Close the iterator to stop and to release
    the source. Raises UserError for a wrong length or factor, and CameraError after RETRY seconds
    without a frame.
    """
    check_frames(encoder.config.model, frames)
    if stride < 1:
        raise UserError(f"the stride of a clip must be at least 1, not {stride}")
    is_served = Reuse(reuse)
    if measure is not None and frames not in (1, encoder.config.model.frames):
        raise UserError(
            f"fields are measured on 1 frame or clips of {encoder.config.model.frames}, not of "
            f"{frames}"
        )
    embed = compile_for_one(encoder, sensor, frames, pooling, join, measures=measure is not None)
    mailbox = Mailbox(replace=live)
    arrived = _camera_frames(source, mailbox, log) if live else _video_frames(source)
    arguments = (arrived, preprocess or Preprocess(encoder), frames, stride, mailbox, contact)
    reader = threading.Thread(target=_read, args=arguments, daemon=True)

    def embedded() -> Generator[Embedded]:
        started = time.time()
        start = time.perf_counter()
        measured = None
        try:
            reader.start()  # Ctrl-C may come already while the thread starts
            while (clip := mailbox.take(HANG if live else None)) is not None:
                begin = copied = time.perf_counter()
                if not (reused := is_served(clip.frames)):
                    there = jax.device_put(clip.frames[None]).block_until_ready()
                    copied = time.perf_counter()
                    if measure is None:
                        out = embed(there)
                    else:
                        picture = measure.oriented(clip.last.pixels)
                        aspect = np.log(picture.shape[0] / picture.shape[1])
                        out, raw = embed(there, np.full(1, aspect, np.float32))
                        measured = measure(raw, [picture])
                    values = check_features(np.asarray(out)[0])
                end = time.perf_counter()
                last, at = clip.last, clip.last.read - start
                seconds = (last.decode, clip.resize, copied - begin, end - copied)
                stamp = at if last.time is None else last.time
                age = end - last.read
                about = (last.picture, last.missed, clip.contact, reused, clip.estimated, measured)
                yield Embedded(last.number, at, values, seconds, age, started, stamp, *about)
        finally:
            mailbox.close()
            if reader.ident is not None:
                reader.join(_PATIENCE)
            if not reader.is_alive():  # releasing a camera that hangs would hang, too
                source.release()

    return embedded()


class Reuse:
    """Whether the features of the last embedded clip serve a clip: no place changed by more than
    noise.

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
        if self._factor and len(last) and (change := largest_change(clip, last)):
            self._changes.append(change)
        served = np.array_equal(clip, self._embedded)
        if not served and len(self._changes) > LEARNED:
            noise = np.quantile(self._changes, 0.1)
            # changes must not add up
            served = bool(largest_change(clip, self._embedded) <= self._factor * noise)
        self._embedded = self._embedded if served else clip
        return served


def largest_change(clip: np.ndarray, other: np.ndarray) -> float:
    """Return the largest mean absolute difference, over cells of CELL pixels, of two clips (T, H,
    W, 3).
    """
    rows = clip.shape[0] * clip.shape[1]
    width = clip.shape[2]
    change = cv2.absdiff(*(one.reshape(rows, -1) for one in (clip, other))).astype(np.float32)
    cells = max(width // CELL, 1), max(rows // CELL, 1)
    # of bytes it would round to 0
    return float(cv2.resize(change, cells, interpolation=cv2.INTER_AREA).max())


def compile_for_one(
    encoder: Encoder,
    sensor: int,
    frames: int,
    pooling: Pooling = "class",
    join: Join = "mean",
    *,
    measures: bool = False,
) -> Callable[..., Any]:
    """Return the encoder of one touch u8 (1, T, H, W, 3) of one sensor, compiled and warm,
    parameters on the device.

    If it `measures`, it takes the aspect f32 (1,) too, and returns the features and the fields.
    """
    touch = np.tile(encoder.blank, (1, frames, 1, 1, 1))
    row = np.full(1, sensor, np.int32)
    if measures:
        encoder.encode_and_measure(touch, row, np.zeros(1, np.float32), pooling)
        return lambda clip, aspect: encoder.encode_and_measure(clip, row, aspect, pooling)
    if not encoder.runs_in_jax or encoder.exported(frames, pooling) is not None:
        call = partial(encoder.encode_touch, sensor=np.full(1, sensor), pooling=pooling, join=join)
        call(touch)
        return call
    run = encoder.traceable(pooling, join)
    with precision(encoder.config):
        params, *given = jax.device_put((encoder.params, touch, np.full(1, sensor, "i4")))
        compiled: Any
        if sum(leaf.nbytes for leaf in jax.tree.leaves(params)) <= CONSTANT:
            compiled = jax.jit(partial(run, params)).lower(*given).compile()
        else:
            compiled = partial(jax.jit(run).lower(params, *given).compile(), params)
    compiled(*given).block_until_ready()
    return lambda clip: compiled(clip, given[1])


def _read(
    arrived: Iterator[Frame],
    preprocess: Preprocess,
    frames: int,
    stride: int,
    mailbox: Mailbox,
    contact: Callable[[np.ndarray], float] | None = None,
) -> None:
    """Put the newest clip of preprocessed frames into the mailbox: the reader's thread.

    No clip has a missed read.
    """
    ring: deque[np.ndarray] = deque(maxlen=(frames - 1) * stride + 1)
    missed = 0
    try:
        for frame in arrived:
            if frame.missed > missed:
                ring.clear()
                missed = frame.missed
            begin = time.perf_counter()
            ring.append(preprocess(frame.pixels))
            resize = time.perf_counter() - begin
            touched = float("nan") if contact is None else contact(frame.pixels)
            clip = np.stack(list(ring)[::stride])
            made = Clip(frame, clip, resize, touched, getattr(preprocess, "estimated", False))
            if len(ring) == ring.maxlen and not mailbox.put(made):
                break
        mailbox.close()
    except BaseException as error:
        mailbox.close(error)


def _video_frames(source: Source) -> Iterator[Frame]:
    """Yield the frames of a video with their time stamps.

    Raises UserError for pixels that cannot be used.
    """
    number = 0
    last = -1.0
    while True:
        begin = time.perf_counter()
        try:
            with QUIET:
                whole, pixels = source.retrieve() if source.grab() else (False, None)
        except cv2.error as error:
            raise UserError(
                f"frame {number} of the video cannot be decoded: {' '.join(str(error).split())}"
            ) from None
        if not whole or pixels is None:
            return
        last = frame_time(source, number, last)
        pixels = to_rgb(pixels, f"frame {number}")[..., ::-1]
        # decoding is part of the latency
        yield Frame(number, pixels, begin, time.perf_counter() - begin, last)
        number += 1


def _camera_frames(source: Source, mailbox: Mailbox, log: Log) -> Iterator[Frame]:
    """Yield the frames of a camera until the mailbox is closed; a read that fails or changes shape
    is tried again.

    Raises CameraError after RETRY seconds without a frame, and UserError for pixels that cannot be
    used.
    """
    number = 0
    missed = 0
    failing = None
    fault = ""
    shape = None
    watch = _Watch(log)
    while True:
        pixels = None
        reason = "the camera delivers nothing"
        grabbed = time.perf_counter()
        try:
            if source.grab():
                grabbed = time.perf_counter()  # waiting for a camera is not decoding
                # the decoder of a camera that sends JPEG
                with QUIET:
                    whole, pixels = source.retrieve()
                pixels = pixels if whole else None
        except cv2.error as error:
            reason = " ".join(str(error).split())
        mailbox.alive = decoded = time.perf_counter()
        if mailbox.is_closed:
            return
        if pixels is not None and shape not in (None, pixels.shape):
            reason = f"its pictures have shape {pixels.shape}, and the first had {shape}"
            pixels = None
        if pixels is None:
            missed += 1
            failing, fault = (decoded, reason) if failing is None else (failing, fault)
            if decoded - failing > RETRY:
                raise CameraError(
                    f"no frame of the camera could be read for {RETRY:g} s after {number} frames: "
                    f"{fault}. "
                    "Check its cable and other programs that use it, and start again."
                )
            time.sleep(_PAUSE)
            continue
        if failing is not None:
            watch.report(
                "missed",
                f"a read of the camera was missed after {number} frames and tried again: {fault}",
            )
        failing = None
        shape = pixels.shape
        picture = watch.look(number, pixels, decoded)
        rgb = to_rgb(pixels, f"frame {number}")[..., ::-1]
        yield Frame(number, rgb, grabbed, decoded - grabbed, None, picture, missed)
        number += 1


class _Watch:
    """Whether the pictures of a camera are frozen or black. Each kind of fault is logged once."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._last = b""
        self._logged: set[str] = set()
        self._since: dict[str, float] = {}

    def report(self, kind: str, sentence: str) -> None:
        """Log the first sentence of its kind."""
        if kind not in self._logged:
            self._logged.add(kind)
            self._log(sentence)

    def look(self, number: int, pixels: np.ndarray, now: float) -> str:
        """Return "black" or "frozen" if the picture has been so for STUCK seconds, else "ok"."""
        last = self._last
        self._last = pixels.tobytes()
        for kind, is_so, advice in (
            ("black", pixels[::8, ::8].mean() < BLACK, "Check its light and its cover."),
            ("frozen", self._last == last, "It repeats the same bytes: check its cable."),
        ):
            if not is_so:
                self._since.pop(kind, None)
            elif now - self._since.setdefault(kind, now) >= STUCK:
                self.report(
                    kind, f"the picture of the camera is {kind} at frame {number}. {advice}"
                )
                return kind
        return "ok"


@shown_short
class Result(NamedTuple):
    """Features f32 (n, E) of frames `numbers` (n,), with the other fields of `Embedded` as arrays.

    `total` frames have features: the arrays may have only the last ones. `frozen` and `black` count
    such pictures. `interrupted` by Ctrl-C or SIGTERM. `error`: a camera that delivers nothing.
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
    # numbers of each frame by name, as in a line of `Fields.summary`
    fields: dict[str, np.ndarray] | None = None


def collect(
    embedded: Generator[Embedded], on_each: Callable[[Embedded], None] | None = None
) -> Result:
    """Return the frames of a stream up to its end, Ctrl-C, SIGTERM or the failure of the camera.

    With `on_each`, features go there, and only the last KEPT times are stored: a stream may run for
    weeks.
    """
    stored: deque[Embedded] = deque(maxlen=KEPT if on_each else None)
    total = 0
    interrupted = False
    failure = None
    pictures: Counter[str] = Counter()
    names = list[str]()
    summaries = list[list[float]]()
    try:
        # as Ctrl-C
        with contextlib.closing(embedded), handled(signal.default_int_handler, signal.SIGTERM):
            for frame in embedded:
                total += 1
                pictures[frame.picture] += 1
                if on_each is not None:
                    on_each(frame)
                elif frame.fields is not None:
                    # maps of every frame would fill the memory
                    summary = frame.fields.summary()
                    summaries.append(
                        [np.nan if value is None else value for value in summary.values()]
                    )
                    names = list(summary)
                frame = frame._replace(fields=None)
                if on_each is not None:
                    frame = frame._replace(values=np.zeros(0, np.float32))
                stored.append(frame)
    except KeyboardInterrupt:
        interrupted = True
    except CameraError as error:
        failure = error
    numbers, at, seconds, age, times, contact, reused, estimated = (
        np.asarray([getattr(frame, name) for frame in stored])
        for name in ("number", "at", "seconds", "age", "time", "contact", "reused", "estimated")
    )
    return Result(
        np.stack([frame.values for frame in stored]) if stored else np.zeros((0, 0), np.float32),
        numbers.astype(np.int64),
        at,
        seconds.reshape(-1, len(PARTS)),
        age,
        total,
        interrupted,
        stored[-1].started if stored else 0.0,
        times,
        stored[-1].missed if stored else 0,
        pictures["frozen"],
        pictures["black"],
        failure,
        contact,
        reused.astype(bool),
        estimated.astype(bool),
        dict(zip(names, np.transpose(summaries), strict=True)) if names else None,
    )


def budget(result: Result) -> list[str]:
    """Return lines with p50 and p99 of every part in ms, frames per second, and dropped frames."""
    lines = [f"{'part':20} {'p50 ms':>8} {'p99 ms':>8}"]
    parts: Sequence[tuple[str, Any]] = [
        *zip(PARTS, result.seconds.T, strict=True),
        ("frame to features", result.age),
    ]
    for name, values in parts:
        middle, late = (1e3 * np.percentile(values, (50, 99))) if len(values) else (np.nan, np.nan)
        lines.append(f"{name:20} {middle:8.2f} {late:8.2f}")
    count = len(result.numbers)
    rate = (count - 1) / np.ptp(result.at + result.age) if count > 1 else np.nan
    dropped = int(np.ptp(result.numbers)) + 1 - count if count else 0
    last = "," if result.total == count else f"; of the last {count}:"
    faults = {
        "missed reads": result.missed,
        "frozen pictures": result.frozen,
        "black pictures": result.black,
    }
    faults |= {"reused": int(result.reused.sum())}
    known = "".join(f", {count} {name}" for name, count in faults.items() if count)
    return [
        *lines,
        f"{result.total} frames embedded{last} {dropped} dropped, {rate:.1f} frames/s{known}",
    ]
