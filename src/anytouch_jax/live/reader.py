"""Frames of a camera or a video, read in a thread, and the mailbox that hands the newest clip on.

A camera is never waited for: frames that arrive while the encoder is busy are dropped, and a clip
still has consecutive frames. None of a video's frames is dropped. A missed read of a camera is
tried again.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np

from anytouch_jax.data.images import QUIET, frame_time, to_rgb
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.encoder.base import Preprocess
from anytouch_jax.errors import UserError
from anytouch_jax.live.freshness import WINDOW, Rate, capture_age, nominal_rate
from anytouch_jax.shown import shown_short

RETRY = 2.0  # seconds in which a missed read of a camera is tried again
# Seconds of the same bytes, or of black, until they are reported. The noise of a sensor never
# repeats.
STUCK = 0.3
BLACK = 8.0  # mean pixel below which an image is black; untouched gels have 30 and more
_PAUSE = 0.01  # seconds from a missed read to the next


class Source(Protocol):
    """A cv2.VideoCapture, or another object with these methods. `get` is asked of videos only."""

    def grab(self) -> bool:
        """Wait for the next frame, and return whether there is one."""
        ...

    def retrieve(self) -> tuple[bool, Any]:
        """Return whether the grabbed frame could be decoded, and its pixels BGR u8 (h, w, 3)."""
        ...

    def release(self) -> None:
        """Close it."""
        ...


class CameraError(UserError):
    """A camera that delivers no frames any more."""


@shown_short
class Frame(NamedTuple):
    """A frame of a camera or a video.

    Attributes:
        number: from 0.
        pixels: RGB u8 (h, w, 3).
        read: the clock, in seconds, when it was read.
        decode: seconds of decoding.
        time: its time stamp in a video, in seconds.
        image: "ok", "frozen" or "black".
        missed: missed reads so far.
        repeated: frames so far with the bytes of the frame before.
        waited: seconds from its capture to its reading, NaN if the driver does not tell.
    """

    number: int
    pixels: np.ndarray
    read: float
    decode: float
    time: float | None = None
    image: str = "ok"
    missed: int = 0
    repeated: int = 0
    waited: float = float("nan")


@shown_short
class Clip(NamedTuple):
    """Preprocessed frames up to a frame.

    Attributes:
        last: the newest frame, as read.
        frames: u8 (T, H, W, 3).
        resize: seconds of preprocessing the newest one.
        contact: 1, 0 or NaN (unknown) of the newest one.
        estimated: whether the background is a running estimate.
        decide: seconds in which its contact was decided.
    """

    last: Frame
    frames: np.ndarray
    resize: float
    contact: float = float("nan")
    estimated: bool = False
    decide: float = 0.0


class Mailbox:
    """One slot between the reader and the encoder.

    With `replace`, a newer clip takes the place of one that was not taken. Without, the reader
    waits for an empty slot.
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
                # The reader may have come back without a clip: a missed read, or a short clip.
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


def read_clips(
    arrived: Iterator[Frame],
    preprocess: Preprocess,
    frames: int,
    stride: int,
    mailbox: Mailbox,
    contact: Callable[[np.ndarray], float] | None = None,
) -> None:
    """Put the newest clip of preprocessed frames into the mailbox: the reader's thread.

    No clip spans a missed read, because its frames would not be consecutive.

    Args:
        arrived: frames, one after the other.
        preprocess: makes the network's input u8 (H, W, 3) of an image.
        frames: those of a clip.
        stride: frames from one of a clip to the next.
        mailbox: where clips, or the error of the reader, are left.
        contact: 1, 0 or NaN of an image RGB u8 (h, w, 3).
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
            resized = time.perf_counter()
            # The gate is asked about every frame, also before the first whole clip: it learns.
            touched = float("nan") if contact is None else contact(frame.pixels)
            decided = time.perf_counter()
            if len(ring) < (frames - 1) * stride + 1:
                continue
            clip = np.stack(list(ring)[::stride])
            estimated = getattr(preprocess, "estimated", False)
            made = Clip(
                last=frame,
                frames=clip,
                resize=resized - begin,
                contact=touched,
                estimated=estimated,
                decide=decided - resized,
            )
            if not mailbox.put(made):
                break
        mailbox.close()
    except BaseException as error:
        # Whatever ends this thread is raised where clips are taken.
        mailbox.close(error)


def video_frames(source: Any) -> Iterator[Frame]:
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
        # A video's frame is at hand from the start, so that decoding is part of its latency.
        yield Frame(number, pixels, begin, time.perf_counter() - begin, last)
        number += 1


def camera_frames(source: Source, mailbox: Mailbox, log: Log) -> Iterator[Frame]:
    """Yield the frames of a camera until the mailbox is closed.

    A read that fails, or whose image has another shape, is missed and tried again. Raises
    CameraError after RETRY seconds without a frame, and UserError for pixels that cannot be used.
    """
    number = 0
    missed = 0
    failing: float | None = None  # when the first of the reads failed that have failed since
    fault = ""
    shape = None
    watch = _Watch(log, nominal_rate(source))
    while True:
        pixels, grabbed, reason = _read_camera(source)
        waited = capture_age(source)
        mailbox.alive = decoded = time.perf_counter()
        if mailbox.is_closed:
            return
        if pixels is not None and shape not in (None, pixels.shape):
            reason = f"its images have shape {pixels.shape}, and the first had {shape}"
            pixels = None
        if pixels is None:
            missed += 1
            if failing is None:
                failing = decoded
                fault = reason
            if decoded - failing > RETRY:
                raise CameraError(
                    f"no frame of the camera could be read for {RETRY:g} s after {number} frames: "
                    f"{fault}. Check its cable and other programs that use it, and start again."
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
        image = watch.look(number, pixels, decoded)
        rgb = to_rgb(pixels, f"frame {number}")[..., ::-1]
        yield Frame(
            number=number,
            pixels=rgb,
            read=grabbed,
            decode=decoded - grabbed,
            image=image,
            missed=missed,
            repeated=watch.repeated,
            waited=waited - (decoded - grabbed),
        )
        number += 1


def _read_camera(source: Source) -> tuple[np.ndarray | None, float, str]:
    """Return pixels BGR of the next frame or None, the clock when it came, and the fault."""
    grabbed = time.perf_counter()
    try:
        if not source.grab():
            return None, grabbed, "the camera delivers nothing"
        # Waiting for a camera is not decoding.
        grabbed = time.perf_counter()
        # The decoder of a camera that sends JPEG prints what it does not like.
        with QUIET:
            whole, pixels = source.retrieve()
    except cv2.error as error:
        return None, grabbed, " ".join(str(error).split())
    return pixels if whole else None, grabbed, "the camera delivers nothing"


class _Watch:
    """Whether the images of a camera are frozen, black or too few.

    Each kind of fault is logged once.
    """

    def __init__(self, log: Log, nominal: float) -> None:
        self.repeated = 0  # frames with the bytes of the frame before
        self._log = log
        self._nominal = nominal
        self._window: tuple[float, int] | None = None  # its begin, and fresh frames until then
        self._last = b""
        self._logged: set[str] = set()
        self._since: dict[str, float] = {}

    def report(self, kind: str, sentence: str) -> None:
        """Log the first sentence of its kind."""
        if kind not in self._logged:
            self._logged.add(kind)
            self._log(sentence)

    def look(self, number: int, pixels: np.ndarray, now: float) -> str:
        """Return "black" or "frozen" if the image has been so for STUCK seconds, else "ok"."""
        last = self._last
        self._last = pixels.tobytes()
        self.repeated += self._last == last
        self._judge(number + 1 - self.repeated, now)
        for kind, is_so, advice in (
            ("black", pixels[::8, ::8].mean() < BLACK, "Check its light and its cover."),
            ("frozen", self._last == last, "It repeats the same bytes: check its cable."),
        ):
            if not is_so:
                self._since.pop(kind, None)
            elif now - self._since.setdefault(kind, now) >= STUCK:
                self.report(kind, f"the image of the camera is {kind} at frame {number}. {advice}")
                return kind
        return "ok"

    def _judge(self, fresh: int, now: float) -> None:
        """Compare the rate of `fresh` frames with the nominal one, a window at a time."""
        if self._window is None:
            self._window = now, fresh
            return
        begin, before = self._window
        if now - begin < WINDOW:
            return
        rate = Rate((fresh - before) / (now - begin), self._nominal)
        if rate.warning():
            self.report("slow", rate.warning())
        self._window = now, fresh
