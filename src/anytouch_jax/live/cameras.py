"""Cameras: those that are connected, with their names, sizes and rates, and opening of one by what
a user calls it.

Linux lists them in a folder, and their drivers answer questions of V4L2 (linux/videodev2.h) without
starting them.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from anytouch_jax.data.images import QUIET, open_video
from anytouch_jax.errors import UserError

SYSTEM = Path("/sys/class/video4linux")
DEVICES = Path("/dev")
ADDRESSES = ("http://", "https://", "rtsp://", "rtmp://", "udp://", "tcp://")
# VIDIOC_ENUM_FMT, _FRAMESIZES, _FRAMEINTERVALS
_FORMATS = 0xC0405602
_SIZES = 0xC02C564A
_INTERVALS = 0xC034564B
# a buffer of pictures; a size or interval that is one of a list
_CAPTURE = 1
_DISCRETE = 1
_PATIENCE = 10_000  # milliseconds to wait for an address


class CameraSettings(NamedTuple):
    """What a camera is asked for: width and height in pixels, frames a second, and four letters
    such as MJPG.
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


class Camera(NamedTuple):
    """A connected camera; `modes` are empty if its driver does not list them."""

    number: int
    name: str
    serial: str
    modes: tuple[Mode, ...]

    def __str__(self) -> str:
        return f"{self.number} ({self.name}{f', serial {self.serial}' if self.serial else ''})"

    def lines(self) -> list[str]:
        """Return a line with its name, and one for each of its formats."""
        lines = [f"camera {self}"]
        for form in dict.fromkeys(mode.format for mode in self.modes):
            sizes = (
                f"{mode.width} x {mode.height}"
                + (
                    f" at {', '.join(f'{rate:g}' for rate in mode.rates)} frames/s"
                    if mode.rates
                    else ""
                )
                for mode in self.modes
                if mode.format == form
            )
            lines.append(f"  {form}: {'; '.join(sizes)}")
        return lines


def list_cameras() -> list[Camera]:
    """Return the cameras that are connected. A device that only gives metadata is left out."""
    found = []
    for place in SYSTEM.glob("video*"):
        modes = tuple(_modes(DEVICES / place.name))
        digits = place.name.removeprefix("video")
        if digits.isdecimal() and (modes or _text(place / "index") in ("", "0")):
            # of USB an interface, in the folder of its device
            device = (place / "device").resolve()
            serial = _text(device / "serial") or _text(device.parent / "serial")
            found.append(Camera(int(digits), _text(place / "name") or place.name, serial, modes))
    return sorted(found)


def camera_of(source: str | Path) -> int | str | None:
    """Return the number or the address of a camera, None for a film.

    `source` is a file, a number, /dev/videoN or a link to it, an address (ADDRESSES), the serial
    number of a camera, or a part of its name. A file comes first. Raises UserError for a name that
    several cameras have.
    """
    text = str(source)
    path = Path(source)
    if text.lower().startswith(ADDRESSES):
        return text
    if path.is_char_device():
        path = path.resolve()
    elif path.exists():
        return None
    if number := re.fullmatch(r"(?:/dev/video)?(\d{1,6})", str(path)):
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
    """Return a cv2.VideoCapture of a camera or film, and whether it is a camera (`asked` for
    settings).
    """
    camera = camera_of(name)
    if camera is None and Path(name).is_dir():
        raise UserError(
            f"{name} is a folder, not a video or a camera. `anytouch embed` takes folders."
        )
    if camera is None and not Path(name).is_file():
        raise UserError(f"there is no video and no camera {name}; {_connected()}")
    source: Any
    with QUIET:
        if isinstance(camera, str):
            limits = [
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                _PATIENCE,
                cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                _PATIENCE,
            ]
            source = cv2.VideoCapture(camera, cv2.CAP_FFMPEG, limits)
        else:
            source = open_video(name) if camera is None else cv2.VideoCapture(camera)
    if not source.isOpened():
        if camera is None:
            raise UserError(f"{name} is not a video that can be read; convert it first")
        if isinstance(camera, str):
            raise UserError(
                f"{name} cannot be opened; check the address, and that its server is on"
            )
        device = DEVICES / f"video{camera}"
        advice = _connected()
        if device.exists() and not os.access(device, os.R_OK | os.W_OK):
            advice = f"you may not read {device}: become a member of the group video"
        raise UserError(f"camera {name} cannot be opened; {advice}")
    if camera is None or (isinstance(camera, str) and source.get(cv2.CAP_PROP_FRAME_COUNT) > 0):
        return source, False
    if isinstance(camera, int):
        # the driver's own queue would hold old frames
        source.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        _ask(source, asked or CameraSettings())
    if log is not None:
        log(f"camera {name}: {_given(source, camera, asked or CameraSettings())}")
    return source, True


def format_of(source: Any) -> str:
    """Return the four letters of a source's format, "" if it does not have them."""
    code = source.get(cv2.CAP_PROP_FOURCC)
    letters = int(code).to_bytes(4, "little").decode("latin1").strip() if 0 < code < 2**32 else ""
    if letters.isascii() and letters.isprintable():
        return letters
    return ""


def _ask(source: Any, asked: CameraSettings) -> None:
    code = None if asked.format is None else cv2.VideoWriter.fourcc(*asked.format.upper())
    names = (
        cv2.CAP_PROP_FOURCC,
        cv2.CAP_PROP_FRAME_WIDTH,
        cv2.CAP_PROP_FRAME_HEIGHT,
        cv2.CAP_PROP_FPS,
    )
    for name, value in zip(names, (code, *(asked.size or (None, None)), asked.fps), strict=True):
        if value is not None:  # the format first: it decides which sizes and rates there are
            source.set(name, value)


def _given(source: Any, camera: int | str, asked: CameraSettings) -> str:
    """Return what a camera gives, where that is not what it was asked for, and a format that is
    faster.
    """
    size = int(source.get(cv2.CAP_PROP_FRAME_WIDTH)), int(source.get(cv2.CAP_PROP_FRAME_HEIGHT))
    rate = source.get(cv2.CAP_PROP_FPS)
    form = format_of(source)
    words = (
        f"{size[0]} x {size[1]} pixels"
        + (f", {rate:g} frames/s" if rate > 0 else "")
        + (f", {form}" * bool(form))
    )
    missed = (
        [f"{asked.size[0]} x {asked.size[1]} pixels"] if asked.size and asked.size != size else []
    )
    missed += (
        [f"{asked.fps:g} frames/s"] if asked.fps is not None and abs(asked.fps - rate) > 0.5 else []
    )
    missed += (
        [asked.format.upper()] if asked.format is not None and asked.format.upper() != form else []
    )
    words += f", not {' and '.join(missed)} as asked for" if missed else ""
    modes = _modes(DEVICES / f"video{camera}") if isinstance(camera, int) else ()
    others = [
        (max(mode.rates), mode.format)
        for mode in modes
        if mode.rates and size == (mode.width, mode.height)
    ]
    fastest, best = max(others, default=(0.0, ""))
    return words + (
        f". With format {best} it gives {fastest:g}" if best != form and fastest > rate + 1 else ""
    )


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
                # the largest of a range
                width, height = size[3:5] if size[2] == _DISCRETE else (size[4], size[7])
                intervals = _answers(handle, _INTERVALS, form[11], width, height)
                # of a range the fastest
                rates = {round(one[6] / one[5], 2) for one in intervals if one[5]}
                yield Mode(letters, width, height, tuple(sorted(rates, reverse=True)))
    finally:
        os.close(handle)


def _answers(handle: int, code: int, *question: int) -> Iterator[tuple[int, ...]]:
    """Yield the answers of a driver as words of 32 bits, number 0 first, until there are no
    more.
    """
    import fcntl

    count = (code >> 16 & 0x3FFF) // 4
    for number in range(256):
        words = bytearray(
            struct.pack("=64I", number, *question, *[0] * (63 - len(question)))[: 4 * count]
        )
        try:
            fcntl.ioctl(handle, code, words)
        except OSError:
            return
        yield struct.unpack(f"={count}I", words)
