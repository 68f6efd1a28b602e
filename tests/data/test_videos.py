"""Videos of any codec, name, rotation and shape of pixels: one rule for every decoder."""

import os
import struct
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from videos import write_video

from anytouch_jax.data import images

av = pytest.importorskip("av")
SHAPE = (96, 128)
RED, GREEN, BLUE, WHITE = (230, 20, 20), (20, 230, 20), (20, 20, 230), (230, 230, 230)
# OpenCV decodes the first, and PyAV the second.
CODECS = {"h264": "libx264", "av1": "libsvtav1"}
QUICKLY = {"libx264": {"crf": "5"}, "libsvtav1": {"crf": "10", "preset": "12"}}


def corners() -> np.ndarray:
    """An image RGB whose corners differ: from the left, above red and green, below blue, white."""
    image = np.full((*SHAPE, 3), 128, np.uint8)
    image[:32, :32] = RED
    image[:32, -32:] = GREEN
    image[-32:, :32] = BLUE
    image[-32:, -32:] = WHITE
    return image


def encoded(
    path: Path, codec: str, *, pixel: Fraction = Fraction(1), start: int = 0, wide: int = 1
):
    """Write four frames at 10 Hz. `wide` is 2 for the full range of colours, 1 for the narrow."""
    name = CODECS[codec]
    if name not in av.codecs_available:
        pytest.skip(f"this build of PyAV writes no {codec}")
    with av.open(str(path), "w") as out:
        stream = out.add_stream(name, rate=10, options=QUICKLY[name])
        stream.height, stream.width = SHAPE
        stream.pix_fmt = "yuv420p"
        stream.codec_context.color_range = wide
        stream.codec_context.sample_aspect_ratio = pixel
        for number in range(4):
            frame = av.VideoFrame.from_ndarray(corners(), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_color_range=wide)
            frame.pts = start + number
            frame.time_base = Fraction(1, 10)
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    return path


def turn(path: Path, degrees: int) -> None:
    """Write into an MP4 file by how much it is to be turned clockwise, as a phone does."""
    cos, sin = {90: (0, 1), 180: (-1, 0), 270: (0, -1)}[degrees]
    one = 1 << 16
    data = bytearray(path.read_bytes())
    # the track's header, version 0: 40 bytes stand before its matrix
    at = data.index(b"tkhd") + 4 + 40
    assert struct.unpack(">9i", data[at : at + 36]) == (one, 0, 0, 0, one, 0, 0, 0, 1 << 30)
    matrix = (cos * one, sin * one, 0, -sin * one, cos * one, 0, 0, 0, 1 << 30)
    data[at : at + 36] = struct.pack(">9i", *matrix)
    path.write_bytes(data)


def assert_corners(frame: np.ndarray, *wanted: tuple[int, int, int]) -> None:
    """Compare the corners of a frame: above left and right, below left and right."""
    found = [frame[9, 9], frame[9, -9], frame[-9, 9], frame[-9, -9]]
    np.testing.assert_allclose(found, wanted, atol=12)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    ("degrees", "wanted"),
    [
        (0, (RED, GREEN, BLUE, WHITE)),
        (90, (BLUE, RED, WHITE, GREEN)),
        (180, (WHITE, BLUE, GREEN, RED)),
        (270, (GREEN, WHITE, RED, BLUE)),
    ],
)
def test_a_turned_video_is_upright_whatever_its_codec(tmp_path, codec, degrees, wanted):
    path = encoded(tmp_path / "video.mp4", codec)
    if degrees:
        turn(path, degrees)
    height, width = SHAPE if degrees in (0, 180) else SHAPE[::-1]
    frames = list(images.frames_from_video(path))
    assert len(frames) == 4
    for frame in frames:
        assert frame.shape == (height, width, 3)
        assert_corners(frame, *wanted)
    video = images.open_video(path)
    sides = video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)
    assert sides == (width, height)
    assert video.grab() and video.retrieve()[1].shape == (height, width, 3)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("degrees", [0, 90])
@pytest.mark.parametrize("pixel", [Fraction(4, 3), Fraction(1, 2), Fraction(1)])
def test_pixels_are_square_as_the_video_is_meant_to_be_shown(tmp_path, codec, degrees, pixel):
    """The shape of a pixel is that before the turn."""
    path = encoded(tmp_path / "video.mp4", codec, pixel=pixel)
    if degrees:
        turn(path, degrees)
    height, width = SHAPE[0], round(SHAPE[1] * pixel)
    wanted = (width, height, 3) if degrees else (height, width, 3)
    frame = next(images.frames_from_video(path))
    assert frame.shape == wanted
    assert_corners(frame, *((BLUE, RED, WHITE, GREEN) if degrees else (RED, GREEN, BLUE, WHITE)))


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("ending", ["mp4", "mkv"])
def test_time_counts_from_the_start_of_a_video(tmp_path, codec, ending):
    path = encoded(tmp_path / f"video.{ending}", codec, start=50)
    times = [time for time, _ in images.timed_frames(path)]
    assert times == pytest.approx([0, 0.1, 0.2, 0.3], abs=0.01)


@pytest.mark.parametrize("wide", [1, 2])
def test_colours_are_the_same_in_both_ranges_and_by_both_decoders(tmp_path, wide):
    for codec in CODECS:
        frame = next(images.frames_from_video(encoded(tmp_path / "video.mp4", codec, wide=wide)))
        assert_corners(frame, RED, GREEN, BLUE, WHITE)


def test_a_shape_of_pixels_that_makes_a_strip_is_refused(tmp_path):
    """Muxers write none, so a damaged header is made up."""
    video = images.open_video(encoded(tmp_path / "video.mp4", "h264"))
    video._stretch = 200
    with pytest.raises(
        images.ImageError, match=r"video.mp4 has 25600 x 96 pixels: that is a strip"
    ):
        video.read()


@pytest.mark.parametrize("kind", ["avi", "av1"])
def test_names_that_are_not_utf_8_are_read(tmp_path, kind):
    """In a process of its own, because OpenCV ends the process for such a name."""
    if kind == "avi":
        made = write_video(tmp_path / "video.avi", [corners()[..., ::-1]] * 3)
    else:
        made = encoded(tmp_path / "video.mp4", "av1")
    folder = os.fsencode(tmp_path) + b"/Pr\xfcfstand"
    name = folder + b"/dr\xfccken" + os.fsencode(made.suffix)
    os.mkdir(folder)
    made.rename(os.fsdecode(name))
    code = (
        "import os, sys\n"
        "from anytouch_jax.data import images\n"
        "path = os.fsdecode(bytes.fromhex(sys.argv[1]))\n"
        "frames = list(images.frames_from_video(path))\n"
        "video = images.open_video(path)\n"
        "again = video.read()[0] and video.open(path) and video.read()[0]\n"
        "print(len(frames), frames[0].shape, images.count_frames(path), again)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, name.hex()], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    frames = 3 if kind == "avi" else 4
    assert done.stdout == f"{frames} {(*SHAPE, 3)} {frames} True\n"
    assert done.stderr == ""


def test_a_video_is_written_under_a_name_that_is_not_utf_8(tmp_path):
    """In a process of its own, for the same reason."""
    name = os.fsencode(tmp_path) + b"/gr\xfcn/video.mp4"
    code = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "import numpy as np\n"
        "from anytouch_jax.data.images import frames_from_video\n"
        "from anytouch_jax.fields.video import Video\n"
        "path = Path(os.fsdecode(bytes.fromhex(sys.argv[1])))\n"
        "path.parent.mkdir()\n"
        "video = Video(path)\n"
        "for grey in (50, 100, 150):\n"
        "    video.add(np.full((64, 64, 3), grey, np.uint8))\n"
        "video.finish()\n"
        "print([int(round(frame.mean(), -1)) for frame in frames_from_video(path)])\n"
        "print([file.name for file in path.parent.iterdir()])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, name.hex()], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["[50, 100, 150]", "['video.mp4']"]
