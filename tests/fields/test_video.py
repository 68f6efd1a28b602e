import errno
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.fields import video as videos
from anytouch_jax.fields.video import Video


def images(count: int = 12) -> list[np.ndarray]:
    return [np.full((48, 64, 3), 10 * number, np.uint8) for number in range(count)]


def read(path) -> tuple[float, list[float]]:
    """Return the rate of a video and the mean of each frame."""
    video = cv2.VideoCapture(str(path))
    rate = video.get(cv2.CAP_PROP_FPS)
    frames = []
    while True:
        whole, frame = video.read()
        if not whole:
            return rate, frames
        frames.append(float(frame.mean()))


@pytest.mark.parametrize("name", ["shown.avi", "shown.mp4"])
def test_a_video_has_the_rate_and_the_frames_that_it_was_given(tmp_path, name):
    video = Video(tmp_path / name, 12.5)
    for image in images():
        video.add(image)
    assert not (tmp_path / name).exists(), "it is moved to its place when it is whole"
    video.finish()
    rate, frames = read(tmp_path / name)
    assert rate == pytest.approx(12.5, rel=1e-3) and len(frames) == 12
    np.testing.assert_allclose(frames, 10 * np.arange(12), atol=6)
    video.close()
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_what_is_not_finished_leaves_an_earlier_video_alone(tmp_path):
    path = tmp_path / "shown.avi"
    path.write_bytes(b"an earlier film")
    video = Video(path)
    video.add(images()[0])
    video.close()
    assert path.read_bytes() == b"an earlier film" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["shown.avi", "shown.mp4"])
@pytest.mark.parametrize("kept", [0.0, 0.5, 0.95])
def test_a_video_that_is_cut_short_is_an_error(tmp_path, monkeypatch, name, kept):
    """OpenCV writes what the disk takes, and says nothing about the rest."""
    path = tmp_path / name
    rng = np.random.default_rng(0)
    for free, error in ((0, OSError), (1 << 30, UserError)):
        video = Video(path)
        for _ in range(40):
            video.add(rng.integers(0, 256, (120, 160, 3), np.uint8))
        writer = video._writer

        class Cut:
            def release(self, writer=writer, part=video._part):
                writer.release()
                data = part.read_bytes()
                part.write_bytes(data[: int(kept * len(data))])

        video._writer = Cut()
        usage = SimpleNamespace(free=free)
        monkeypatch.setattr(videos.shutil, "disk_usage", lambda _, usage=usage: usage)
        with pytest.raises(error, match="No space left" if error is OSError else "whole") as told:
            video.finish()
        if error is OSError:
            assert told.value.errno == errno.ENOSPC and told.value.filename == str(path)
        video.close()
        assert list(tmp_path.iterdir()) == []
