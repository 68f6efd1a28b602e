import cv2
import numpy as np
import pytest
from checked_world import finding_rows

from anytouch_jax.data.manifest.manifest import replace_column
from anytouch_jax.datasets.verify import verify


def _recording(make, count=12, shape=(48, 64), seed=0):
    """A recording of a coloured gel, darker to the right and to the bottom, with noise and a dent
    that moves.
    """
    loose = make([{"sequence": "s", "frame_index": i, "unit": "u"} for i in range(count)])
    rng = np.random.default_rng(seed)
    ramp = np.add.outer(np.arange(shape[0]) / shape[0] * 40, np.arange(shape[1]) / shape[1] * 60)
    # BGR
    gel = np.array([90, 130, 200]) - ramp[..., None] * [0.6, 1.0, 0.8]
    for i in range(count):
        dent = np.zeros(shape)
        cv2.circle(dent, (10 + 3 * i, 20), 6, 30, -1)
        frame = gel + dent[..., None] + rng.normal(0, 2, (*shape, 3))
        cv2.imwrite(str(loose.file(i)), np.clip(frame, 0, 255).astype(np.uint8))
    return loose


def _cut_jpeg(image):
    """The image as a decoder gives it from a JPEG file with a lost end and an end marker."""
    data = cv2.imencode(".jpg", image)[1].tobytes()
    return cv2.imdecode(
        np.frombuffer(data[: len(data) // 2] + b"\xff\xd9", np.uint8), cv2.IMREAD_COLOR
    )


def _with_bars(image):
    image[:4] = image[-4:] = 0
    return image


SPOILS = {
    "flat": lambda image: np.full_like(image, 77),
    "cut": _cut_jpeg,
    "border": _with_bars,
    "noise": lambda image: np.random.default_rng(1).integers(0, 256, image.shape, np.uint8),
    "grey": lambda image: np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8),
    "dark": lambda image: image // 8,
    "inverted": lambda image: 255 - image,
    "channels": lambda image: image[..., ::-1],
    "turned": lambda image: image[::-1, ::-1],
    "wrong_size": lambda image: image[::2, ::2],
}


@pytest.mark.parametrize("kind", SPOILS)
def test_a_image_that_cannot_be_right_is_named(make, kind):
    loose = _recording(make)
    assert verify(loose).findings == ()
    image = cv2.imread(str(loose.file(7)))
    cv2.imwrite(str(loose.file(7)), SPOILS[kind](image.copy()))
    report = verify(loose)
    assert finding_rows(report) == {kind: [7]} and report.ok
    assert "'f7.png'" in report.findings[0].examples[0]


def test_a_mirrored_image_is_turned(make):
    for spoil in (
        lambda image: image[:, ::-1],
        lambda image: cv2.resize(np.rot90(image), (64, 48)),
    ):
        loose = _recording(make)
        cv2.imwrite(str(loose.file(3)), spoil(cv2.imread(str(loose.file(3)))))
        assert finding_rows(verify(loose)) == {"turned": [3]}


def test_a_camera_that_hangs_repeats_its_image(make):
    loose = _recording(make)
    # other bytes, equal pixels
    for row in (5, 6, 7):
        params = [cv2.IMWRITE_PNG_COMPRESSION, row]
        cv2.imwrite(str(loose.file(row)), cv2.imread(str(loose.file(4))), params)
    assert finding_rows(verify(loose))["frozen"] == [5, 6, 7]


@pytest.mark.parametrize("sensors", [2, 3, 4])
def test_a_sequence_of_several_sensors_is_noticed(make, sensors):
    loose = _recording(make, 16)
    for row in range(16):
        image = cv2.imread(str(loose.file(row))).astype(int)
        cv2.imwrite(
            str(loose.file(row)), np.clip(image + 12 * (row % sensors), 0, 255).astype(np.uint8)
        )
    assert finding_rows(verify(loose)) == {"alternating": list(range(16))}


def test_a_image_that_is_odd_in_its_sequence_only_has_a_wrong_size(make):
    loose = _recording(make, 9)
    for row in range(9):
        image = cv2.imread(str(loose.file(row)))
        cv2.imwrite(str(loose.file(row)), image if row != 2 else image[::2, ::2])
    two = replace_column(loose, "sequence", ["a"] * 3 + ["b"] * 6)
    assert finding_rows(verify(two)) == {"wrong_size": [2]}
