"""The camera of LeRobot: found by LeRobot's rules, oriented and subtracted images, features."""

import importlib
import sys
import tomllib
from contextlib import contextmanager

import numpy as np
import pytest
from measuring import gel, measuring_weights
from places import ROOT
from videos import write_video

from anytouch_jax import load_encoder
from tests.support import lerobot_interface
from tests.weights.test_start import mae

PACKAGE = ROOT / "integrations" / "lerobot_camera_anytouch"


@pytest.fixture
def plugin(monkeypatch):
    """The package, imported as LeRobot does: by the name of the distribution."""
    name = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]["name"]
    assert name.startswith("lerobot_camera_")
    for module, content in lerobot_interface.modules().items():
        monkeypatch.setitem(sys.modules, module, content)
    monkeypatch.syspath_prepend(str(PACKAGE))
    yield importlib.import_module(name)
    for module in [one for one in sys.modules if one.startswith(name)]:
        del sys.modules[module]


@pytest.fixture
def video(monkeypatch):
    """Four images of 40 x 60: an even gel, then a press that grows in the upper left corner."""
    frames = [np.full((40, 60, 3), 90, np.uint8) for _ in range(4)]
    for i, frame in enumerate(frames):
        frame[:10, :10] += 20 * i
    monkeypatch.setattr(lerobot_interface.VideoCamera, "frames", frames)
    return frames


def test_lerobot_finds_the_camera_and_its_images_are_oriented_and_subtracted(plugin, video):
    kind = lerobot_interface.CameraConfig.known["anytouch"]
    config = kind(index_or_path=0, width=40, height=60, rotate=90)
    camera = lerobot_interface.device_class(config)(config)
    assert not camera.is_connected and (
        camera._camera.config.width,
        camera._camera.config.height,
    ) == (60, 40)
    with camera_open(camera):
        assert camera.is_connected and (camera.width, camera.height, camera.fps) == (40, 60, 30)
        first = camera.read()
        second = camera.async_read(100)
        latest = camera.read_latest()
        assert first.shape == (60, 40, 3) and first.dtype == np.uint8
        # turned clockwise
        assert first[0, -1].tolist() == [148] * 3 and first[-1, 0].tolist() == [128] * 3
        assert second[0, -1].tolist() == [168] * 3 and np.array_equal(latest, second)
        camera.async_read(100)
        with pytest.raises(TimeoutError):
            camera.async_read(1)
    assert not camera.is_connected
    assert camera.find_cameras() == [{"name": "video", "type": "anytouch", "id": 0}]


@contextmanager
def camera_open(camera):
    """Connect and disconnect, as LeRobot's base class does in a with statement."""
    camera.connect()
    try:
        yield
    finally:
        camera.disconnect()


def test_features_are_those_of_the_encoder(plugin, video, tmp_path):
    file = mae(tmp_path / "mae")
    camera = plugin.AnyTouchCamera(
        plugin.AnyTouchCameraConfig(index_or_path=0, encoder=str(file), subtract=False)
    )
    with camera_open(camera):
        frame = camera.read()
        encoder = load_encoder(file)
        assert np.array_equal(frame, video[1])  # not subtracted
        np.testing.assert_array_equal(
            camera.features(), encoder.encode_touch(encoder.preprocess(video[1]))[0]
        )


def test_a_video_never_ends_and_its_depth_is_a_grey_image(plugin, tmp_path):
    """LeRobot's own camera reads a video as fast as it can, and then its thread is over."""
    path = tmp_path / "video.avi"
    weights = measuring_weights(tmp_path / "weights.safetensors")
    frames = [gel() for _ in range(4)]
    for number, image in enumerate(frames):
        image[10:30, 10 : 20 + 8 * number] += 60
    write_video(path, (image[..., ::-1] for image in frames), 100)
    settings = {"index_or_path": path, "encoder": str(weights), "sensor": "tacto", "width_mm": 12.0}
    camera = plugin.AnyTouchCamera(
        plugin.AnyTouchCameraConfig(**settings, depth=True, white_mm=0.1, rotate=90)
    )
    with camera_open(camera):
        assert (camera.width, camera.height, camera.fps) == (48, 64, 100)
        images = [camera.read() for _ in range(6)] + [camera.async_read(), camera.read_latest()]
        assert all(one.shape == (64, 48, 3) and one.dtype == np.uint8 for one in images)
        assert len({one.tobytes() for one in images}) > 2 and np.ptp(images[0]) > 20
        assert (images[0] == images[0][..., :1]).all() and camera.features().shape == (12,)
        measured = camera.fields()
        assert measured.width_mm == 12 and measured.force.shape == (1, 3) and not measured.faults
    assert not camera.is_connected
    camera = plugin.AnyTouchCamera(
        plugin.AnyTouchCameraConfig(**settings | {"width_mm": None}, depth=True)
    )
    with pytest.raises(ValueError, match="width_mm"):
        camera.connect()


@pytest.mark.parametrize("wrong", [{"rotate": 45}, {"flip": "up"}, {"white_mm": 0.0}])
def test_wrong_settings_are_one_sentence(plugin, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        plugin.AnyTouchCameraConfig(index_or_path=0, **wrong)
