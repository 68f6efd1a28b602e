"""Cameras: those that are connected, and opening one by what a user calls it.

Linux lists them in a folder, and their drivers answer questions of V4L2 (linux/videodev2.h) without
starting them.
"""

from __future__ import annotations

import os
import re
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from anytouch_jax.data.images import QUIET, open_video
from anytouch_jax.errors import UserError
from anytouch_jax.live.freshness import measure_rate

SYSTEM = Path("/sys/class/video4linux")
DEVICES = Path("/dev")
ADDRESSES = ("http://", "https://", "rtsp://", "rtmp://", "udp://", "tcp://")
# The requests VIDIOC_ENUM_FMT, VIDIOC_ENUM_FRAMESIZES and VIDIOC_ENUM_FRAMEINTERVALS. Bits 16 to
# 29 of each are the bytes of its structure.
_FORMATS = 0xC0405602
_SIZES = 0xC02C564A
_INTERVALS = 0xC034564B
_CAPTURE = 1  # the type of a buffer of images
_DISCRETE = 1  # the type of a size or an interval that is one of a list
_PATIENCE = 10_000  # milliseconds to wait for an address


class CameraSettings(NamedTuple):
    """What a camera is asked for.

    Attributes:
        size: width and height in pixels.
        fps: frames a second.
        format: four letters such as MJPG.
    """

    size: tuple[int, int] | None = None
    fps: float | None = None
    format: str | None = None


class Mode(NamedTuple):
    """A size that a camera has in a format, with its rates in frames a second."""

    format: str
    width: int
    height: int
    rates: tuple[float, ...]

    def __str__(self) -> str:
        size = f"{self.width} x {self.height}"
        if not self.rates:
            return size
        return f"{size} at {', '.join(f'{rate:g}' for rate in self.rates)} frames/s"


class Camera(NamedTuple):
    """A connected camera; `modes` are empty if its driver does not list them."""

    number: int
    name: str
    serial: str
    modes: tuple[Mode, ...]

    def __str__(self) -> str:
        serial = f", serial {self.serial}" if self.serial else ""
        return f"{self.number} ({self.name}{serial})"

    def lines(self) -> list[str]:
        """Return a line with its name, and one for each of its formats."""
        lines = [f"camera {self}"]
        for form in dict.fromkeys(mode.format for mode in self.modes):
            sizes = [str(mode) for mode in self.modes if mode.format == form]
            lines.append(f"  {form}: {'; '.join(sizes)}")
        return lines


def list_cameras() -> list[Camera]:
    """Return the cameras that are connected. A device that only gives metadata is left out."""
    found = []
    for place in SYSTEM.glob("video*"):
        modes = tuple(_modes(DEVICES / place.name))
        digits = place.name.removeprefix("video")
        # A camera has a second device for metadata, which has no modes and the index 1.
        if digits.isdecimal() and (modes or _text(place / "index") in ("", "0")):
            # Of USB this is an interface, and the serial number lies in the folder of its device.
            device = (place / "device").resolve()
            serial = _text(device / "serial") or _text(device.parent / "serial")
            found.append(Camera(int(digits), _text(place / "name") or place.name, serial, modes))
    return sorted(found)


def describe_cameras() -> list[str]:
    """Return lines on each connected camera: its name, its formats, and what it gives now.

    It is read for a second, because many give fewer frames than they say.
    """
    lines = []
    for camera in list_cameras():
        lines += camera.lines()
        with QUIET:
            source = cv2.VideoCapture(camera.number)
        if not source.isOpened():
            lines.append("  it cannot be opened now: another program may use it")
            continue
        rate = measure_rate(source)
        source.release()
        lines.append(f"  gives {rate}")
        if rate.warning():
            lines.append(f"  {rate.warning()}")
    return lines


def camera_of(source: str | Path) -> int | str | None:
    """Return the number or the address of a camera, None for a video.

    `source` is a file, a number, /dev/videoN or a link to it, an address (ADDRESSES), the serial
    number of a camera, or a part of its name. A file comes first. Raises UserError for a name that
    several cameras have.
    """
    text = str(source)
    path = Path(source)
    if text.lower().startswith(ADDRESSES):
        return text
    if path.is_char_device():
        # udev makes links such as /dev/v4l/by-id/..., whose numbers change at every start.
        path = path.resolve()
    elif path.exists():
        return None
    number = re.fullmatch(r"(?:/dev/video)?(\d{1,6})", str(path))
    if number is not None:
        return int(number[1])
    word = text.strip().lower()
    cameras = [
        one
        for one in list_cameras()
        if word and (word in one.name.lower() or word == one.serial.lower())
    ]
    if len(cameras) > 1:
        listed = ", ".join(map(str, cameras))
        raise UserError(
            f"{text} is the name of {len(cameras)} cameras, {listed}: give a number or a serial"
        )
    if cameras:
        return cameras[0].number
    return None


def open_source(
    name: str | Path, asked: CameraSettings | None = None, log: Callable[[str], None] | None = None
) -> tuple[Any, bool]:
    """Return a cv2.VideoCapture of a camera or a video, and whether it is a camera.

    Args:
        name: what a user calls it (see `camera_of`).
        asked: settings of a camera.
        log: gets a sentence on what the camera gives.

    Raises:
        UserError: nothing of that name can be opened.
    """
    camera = camera_of(name)
    if camera is None and Path(name).is_dir():
        raise UserError(
            f"{name} is a folder, not a video or a camera. `anytouch embed` takes folders."
        )
    if camera is None and not Path(name).is_file():
        raise UserError(f"there is no video and no camera {name}; {_connected()}")
    with QUIET:
        source = _capture(name, camera)
    if not source.isOpened():
        raise UserError(_unopened(name, camera))
    # An address may be that of a video, which has an end.
    is_video = camera is None or (
        isinstance(camera, str) and source.get(cv2.CAP_PROP_FRAME_COUNT) > 0
    )
    if camera is None or is_video:
        return source, False
    if isinstance(camera, int):
        # The driver's own queue would hold old frames.
        source.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        _ask(source, asked or CameraSettings())
    if log is not None:
        log(f"camera {name}: {_given(source, camera, asked or CameraSettings())}")
    return source, True


def _capture(name: str | Path, camera: int | str | None) -> Any:
    """Return the cv2.VideoCapture of a video, a number or an address, which may not be open."""
    if camera is None:
        return open_video(name)
    if isinstance(camera, int):
        return cv2.VideoCapture(camera)
    limits = [
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
        _PATIENCE,
        cv2.CAP_PROP_READ_TIMEOUT_MSEC,
        _PATIENCE,
    ]
    return cv2.VideoCapture(camera, cv2.CAP_FFMPEG, limits)


def _unopened(name: str | Path, camera: int | str | None) -> str:
    """Return the sentence on a source that cannot be opened."""
    if camera is None:
        return f"{name} is not a video that can be read; convert it first"
    if isinstance(camera, str):
        return f"{name} cannot be opened; check the address, and that its server is on"
    device = DEVICES / f"video{camera}"
    advice = _connected()
    if device.exists() and not os.access(device, os.R_OK | os.W_OK):
        advice = f"you may not read {device}: become a member of the group video"
    return f"camera {name} cannot be opened; {advice}"


class LoopedVideo:
    """A video in place of a camera, again and again; late frames are lost.

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


def format_of(source: Any) -> str:
    """Return the four letters of a source's format, "" if it does not have them."""
    code = source.get(cv2.CAP_PROP_FOURCC)
    if not 0 < code < 2**32:
        return ""
    letters = int(code).to_bytes(4, "little").decode("latin1").strip()
    if letters.isascii() and letters.isprintable():
        return letters
    return ""


def _ask(source: Any, asked: CameraSettings) -> None:
    """Ask a camera for settings. It gives what it can."""
    # The format comes first, because it decides which sizes and rates there are.
    if asked.format is not None:
        source.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*asked.format.upper()))
    if asked.size is not None:
        width, height = asked.size
        source.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        source.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
    if asked.fps is not None:
        source.set(cv2.CAP_PROP_FPS, asked.fps)


def _given(source: Any, camera: int | str, asked: CameraSettings) -> str:
    """Return what a camera gives, what it was asked for instead, and a format that is faster."""
    size = int(source.get(cv2.CAP_PROP_FRAME_WIDTH)), int(source.get(cv2.CAP_PROP_FRAME_HEIGHT))
    rate = source.get(cv2.CAP_PROP_FPS)
    form = format_of(source)
    words = f"{size[0]} x {size[1]} pixels"
    if rate > 0:
        words += f", {rate:g} frames/s"
    if form:
        words += f", {form}"
    missed = []
    if asked.size is not None and asked.size != size:
        missed.append(f"{asked.size[0]} x {asked.size[1]} pixels")
    if asked.fps is not None and abs(asked.fps - rate) > 0.5:
        missed.append(f"{asked.fps:g} frames/s")
    if asked.format is not None and asked.format.upper() != form:
        missed.append(asked.format.upper())
    if missed:
        words += f", not {' and '.join(missed)} as asked for"
    # Uncompressed images of a large size do not fit through USB at the full rate.
    modes = _modes(DEVICES / f"video{camera}") if isinstance(camera, int) else ()
    others = [
        (max(mode.rates), mode.format)
        for mode in modes
        if mode.rates and size == (mode.width, mode.height)
    ]
    fastest, best = max(others, default=(0.0, ""))
    if best != form and fastest > rate + 1:
        words += f". With format {best} it gives {fastest:g}"
    return words


def _connected() -> str:
    cameras = list_cameras()
    if cameras:
        return f"connected are {', '.join(map(str, cameras))}"
    return "no camera is connected"


def _text(file: Path) -> str:
    """Return the text of a file of the system, "" if it cannot be read."""
    try:
        return file.read_text(errors="replace").strip()
    except OSError:
        return ""


def _modes(device: Path) -> Iterator[Mode]:
    """Yield what the driver of a device lists: formats, their sizes, and the rates of each."""
    try:
        handle = os.open(device, os.O_RDWR | os.O_NONBLOCK)
    except OSError:
        return
    try:
        for form in _answers(handle, _FORMATS, _CAPTURE):
            letters = form[11].to_bytes(4, "little").decode("latin1").strip()
            for size in _answers(handle, _SIZES, form[11]):
                if size[2] == _DISCRETE:
                    width, height = size[3:5]
                else:
                    # Of a range, the largest.
                    width, height = size[4], size[7]
                intervals = _answers(handle, _INTERVALS, form[11], width, height)
                # The numbers are seconds as a fraction. Those of a range begin with the fastest.
                rates = {round(one[6] / one[5], 2) for one in intervals if one[5]}
                yield Mode(letters, width, height, tuple(sorted(rates, reverse=True)))
    finally:
        os.close(handle)


def _answers(handle: int, code: int, *question: int) -> Iterator[tuple[int, ...]]:
    """Yield the answers of a driver as words of 32 bits, the first of each its number.

    Args:
        handle: of the open device.
        code: the request.
        question: words after the number: what is listed.
    """
    import fcntl

    count = (code >> 16 & 0x3FFF) // 4  # words of the structure
    for number in range(256):
        # The driver writes its answer over the question.
        words = bytearray(
            struct.pack(f"={count}I", number, *question, *[0] * (count - 1 - len(question)))
        )
        try:
            fcntl.ioctl(handle, code, words)
        except OSError:
            return
        yield struct.unpack(f"={count}I", words)
