"""Live features of a camera or a video, frame by frame, with the latency of each part (`anytouch stream`).

A thread reads and preprocesses frames, and a mailbox of one slot holds the newest clip. A camera is never waited for:
frames that arrive while the encoder is busy are dropped, and a clip still has consecutive frames. Of a video, which
can wait, every frame is embedded.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

import cv2
import jax
import numpy as np

from anytouch_jax.encoder.embed import Join, Pooling
from anytouch_jax.encoder.encoder import Encoder, check_frames, touch_features
from anytouch_jax.encoder.preprocess import Preprocess
from anytouch_jax.errors import UserError

PARTS = ("decode", "resize", "copy", "encoder")
KEPT = 100_000  # last frames whose times are stored if their features are not
_PATIENCE = 2.0  # seconds to wait for a camera after the last frame


class Source(Protocol):
    """A camera or a video: the part of cv2.VideoCapture that is used."""

    def grab(self) -> bool:
        """Wait for the next frame. Return False at the end."""

    def retrieve(self) -> tuple[bool, np.ndarray]:
        """Return whether the frame could be decoded, and its pixels BGR u8 (h, w, 3)."""

    def release(self) -> None:
        """Release the device or the file."""


class Clip(NamedTuple):
    """Frames u8 (T, H, W, 3) up to frame `number`, the time when it was `read`, and the seconds of two parts."""

    number: int
    frames: np.ndarray
    read: float
    decode: float
    resize: float


class Embedded(NamedTuple):
    """Features f32 (E,) of the clip that ends with frame `number`.

    `at`: seconds from the start of the stream to the frame. `seconds`: those of PARTS. `age`: seconds from the grabbed
    frame to its features, with decoding and waiting. `started`: start of the stream in Unix seconds.
    """

    number: int
    at: float
    values: np.ndarray
    seconds: tuple[float, float, float, float]
    age: float
    started: float = 0.0


class Mailbox:
    """One slot between the reader and the encoder. With `replace` a newer clip replaces one that was not taken."""

    def __init__(self, *, replace: bool) -> None:
        self._replace, self._done = replace, False
        self._clip: Clip | None = None
        self._error: BaseException | None = None
        self._changed = threading.Condition()

    def put(self, clip: Clip) -> bool:
        """Leave a clip, after waiting for an empty slot unless it may be replaced. Return False once it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._replace or self._clip is None or self._done)
            if not self._done:
                self._clip = clip
            self._changed.notify_all()
            return not self._done

    def take(self) -> Clip | None:
        """Wait for a clip and return it, None after the last one. Raises the error of the reader."""
        with self._changed:
            self._changed.wait_for(lambda: self._clip is not None or self._done)
            clip, self._clip = self._clip, None
            self._changed.notify_all()
            if clip is None and self._error is not None:
                raise self._error
            return clip

    def close(self, error: BaseException | None = None) -> None:
        """End the stream, from either side. A clip in the slot can still be taken."""
        with self._changed:
            self._done, self._error = True, self._error or error
            self._changed.notify_all()


def open_source(name: str | Path) -> tuple[Source, bool]:
    """Return the source, and whether it is a camera, of a camera's number or a video file. Raises UserError."""
    live = str(name).isdecimal() and not Path(name).exists()
    if not live and not Path(name).is_file():
        raise UserError(f"there is no video {name}; give a video file, or the number of a camera, such as 0")
    source = cv2.VideoCapture(int(str(name)) if live else str(name))
    if not source.isOpened():
        raise UserError(f"camera {name} cannot be opened" if live else f"{name} is not a video that can be read")
    if live:
        source.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the driver's own queue would hold old frames
    return source, live


def rate_of(video: str | Path) -> float:
    """Return the frames per second of a video, 0 if its header has no rate."""
    source, _ = open_source(video)
    try:
        return max(0.0, float(cast(cv2.VideoCapture, source).get(cv2.CAP_PROP_FPS)))
    finally:
        source.release()


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
) -> Generator[Embedded]:
    """Yield features of the frames of `source`; the encoder is compiled before the first frame is read.

    A clip is the last `frames` frames, `stride` apart. `sensor` is a row of the table. `preprocess` is
    `Preprocess(encoder)` by default. With `live`, frames are dropped while the encoder is busy. Close the iterator to
    stop and to release the source. Raises UserError for a wrong length.
    """
    check_frames(encoder.config.model, frames)
    if stride < 1:
        raise UserError(f"the stride of a clip must be at least 1, not {stride}")
    embed = compile_for_one(encoder, sensor, frames, pooling, join)
    return _stream(embed, source, live, preprocess or Preprocess(encoder), frames, stride)


def compile_for_one(
    encoder: Encoder, sensor: int, frames: int, pooling: Pooling = "class", join: Join = "mean"
) -> Callable[[jax.Array], jax.Array]:
    """Return the encoder of one touch u8 (1, T, H, W, 3) of one sensor, compiled and warm, parameters on the device."""
    side = encoder.config.model.image_size
    run = jax.jit(partial(touch_features, net=encoder.net, pooling=pooling, join=join))
    given = jax.device_put((encoder.params, np.zeros((1, frames, side, side, 3), np.uint8), np.full(1, sensor, "i4")))
    compiled = run.lower(*given).compile()
    compiled(*given).block_until_ready()
    params, _, row = given
    return lambda clip: compiled(params, clip, row)


def _stream(
    embed: Callable[[jax.Array], jax.Array],
    source: Source,
    live: bool,
    preprocess: Preprocess,
    frames: int,
    stride: int,
) -> Generator[Embedded]:
    mailbox = Mailbox(replace=live)
    started, start = time.time(), time.perf_counter()
    reader = threading.Thread(target=_read, args=(source, live, preprocess, frames, stride, mailbox), daemon=True)
    reader.start()
    try:
        while (clip := mailbox.take()) is not None:
            begin = time.perf_counter()
            there = jax.device_put(clip.frames[None]).block_until_ready()
            copied = time.perf_counter()
            values = np.asarray(embed(there))[0]
            end = time.perf_counter()
            seconds = (clip.decode, clip.resize, copied - begin, end - copied)
            yield Embedded(clip.number, clip.read - start, values, seconds, end - clip.read, started)
    finally:
        mailbox.close()
        reader.join(_PATIENCE)
        if not reader.is_alive():  # releasing a camera that hangs would hang, too
            source.release()


def _read(source: Source, live: bool, preprocess: Preprocess, frames: int, stride: int, mailbox: Mailbox) -> None:
    """Read frames into a ring, and put the newest clip into the mailbox: the reader's thread."""
    ring: deque[np.ndarray] = deque(maxlen=(frames - 1) * stride + 1)
    number = 0
    try:
        wanted = True
        while wanted:
            begin = time.perf_counter()
            if not source.grab():
                break
            grabbed = time.perf_counter()  # waiting for a camera is not decoding
            there, frame = source.retrieve()
            if not there:
                break
            decoded = time.perf_counter()
            if frame.ndim != 3 or frame.shape[2] != 3:
                raise UserError(f"frame {number} has shape {frame.shape}; colour frames (height, width, 3) are wanted")
            ring.append(preprocess(frame[..., ::-1]))
            resized = time.perf_counter()
            if len(ring) == ring.maxlen:
                decode = decoded - (grabbed if live else begin)
                came = grabbed if live else begin  # the latency starts here: decoding is part of it
                clip = Clip(number, np.stack(list(ring)[::stride]), came, decode, resized - decoded)
                wanted = mailbox.put(clip)
            number += 1
        mailbox.close()
    except BaseException as error:
        mailbox.close(error)


class Result(NamedTuple):
    """Features f32 (n, E) of frames `numbers` (n,), with the other fields of `Embedded` as arrays.

    `total` frames were embedded; the arrays may have only the last of them. `interrupted`: Ctrl-C or SIGTERM ended the
    stream.
    """

    values: np.ndarray
    numbers: np.ndarray
    at: np.ndarray
    seconds: np.ndarray
    age: np.ndarray
    total: int
    interrupted: bool
    started: float = 0.0


def collect(embedded: Generator[Embedded], on_each: Callable[[Embedded], None] | None = None) -> Result:
    """Return the frames of a stream up to its end, Ctrl-C or SIGTERM.

    With `on_each`, features go there and are not stored, and only the last KEPT times are: a stream may run for weeks.
    """
    stored: deque[Embedded] = deque(maxlen=KEPT if on_each else None)
    total, interrupted = 0, False
    try:
        with contextlib.closing(embedded), _sigterm_as_ctrl_c():
            for frame in embedded:
                total += 1
                if on_each is not None:
                    on_each(frame)
                    frame = frame._replace(values=np.zeros(0, np.float32))
                stored.append(frame)
    except KeyboardInterrupt:
        interrupted = True
    return Result(
        np.stack([frame.values for frame in stored]) if stored else np.zeros((0, 0), np.float32),
        np.asarray([frame.number for frame in stored], np.int64),
        np.asarray([frame.at for frame in stored]),
        np.asarray([frame.seconds for frame in stored]).reshape(-1, len(PARTS)),
        np.asarray([frame.age for frame in stored]),
        total,
        interrupted,
        stored[-1].started if stored else 0.0,
    )


@contextlib.contextmanager
def _sigterm_as_ctrl_c() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt inside the block. Python has handlers in the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def budget(result: Result) -> list[str]:
    """Return lines with p50 and p99 of every part in ms, frames per second, and dropped frames."""
    lines = [f"{'part':20} {'p50 ms':>8} {'p99 ms':>8}"]
    parts: Sequence[tuple[str, Any]] = [*zip(PARTS, result.seconds.T, strict=True), ("frame to features", result.age)]
    for name, values in parts:
        middle, late = (1e3 * np.percentile(values, (50, 99))) if len(values) else (np.nan, np.nan)
        lines.append(f"{name:20} {middle:8.2f} {late:8.2f}")
    count = len(result.numbers)
    rate = (count - 1) / np.ptp(result.at + result.age) if count > 1 else np.nan
    dropped = int(np.ptp(result.numbers)) + 1 - count if count else 0
    last = "," if result.total == count else f"; of the last {count}:"
    return [*lines, f"{result.total} frames embedded{last} {dropped} dropped, {rate:.1f} frames/s"]
