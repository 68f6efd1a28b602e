"""An encoder that is defined in one file, this one, and used where those of `load_encoder` are."""

import contextlib

import cv2
import numpy as np
import pytest
from tiny_models import touch_model
from videos import write_video

import anytouch_jax as at
from anytouch_jax.config import Config, DataConfig
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.arrays import rows_of_sensors, run_in_batches
from anytouch_jax.encoder.embed import embed_frames, embed_rows
from anytouch_jax.encoder.encoder import TouchEncoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.feature_cache import encoder_features
from anytouch_jax.live.stream import open_source, stream

SIDE = 28


class MeanColours(TouchEncoder):
    """Features are the mean colours of a touch, and the row of its sensor."""

    def __init__(self, background="keep"):
        self.config = Config(touch_model(image_size=SIDE), data=DataConfig(background=background))
        self.params = {}
        self.source = "mean colours"

    @property
    def fingerprint(self):
        return "00000000"

    @property
    def blank(self):
        return np.zeros((SIDE, SIDE, 3), np.uint8)

    def prepare(self, frame, background=None):
        if background is not None:
            frame = cv2.subtract(frame, background)
        return cv2.resize(frame, (SIDE, SIDE), interpolation=cv2.INTER_AREA)

    def encode_touch(self, frames, sensor="universal", *, pooling="class", aggregation="mean"):
        colours = np.asarray(frames, np.float32).mean((1, 2, 3)) / 255
        sensors = self.config.model.sensors
        rows = rows_of_sensors(sensor, len(frames), self.sensor_row, len(sensors))
        return np.concatenate([colours, rows[:, None]], axis=1, dtype=np.float32)


@pytest.fixture
def table(world):
    return manifests.read(world)


def test_it_embeds_rows_and_frames_in_batches(table, world):
    encoder = MeanColours()
    rows, values = embed_rows(encoder, table, np.arange(5), batch=2)
    assert rows.tolist() == [0, 1, 2, 3, 4] and values.shape == (5, 4)
    # gelsight_mini is row 3 of the table of sensors, digit row 1
    assert values[:, 3].tolist() == [1, 1, 1, 1, 3]
    images = [cv2.imread(str(world.parent / f"a{i}.png"))[..., ::-1] for i in range(4)]
    named = [(number, "", frame) for number, frame in enumerate(images)]
    clips = embed_frames(encoder, named, 1, length=3)
    assert clips.rows.tolist() == [2, 3]
    touches = (encoder.prepare(image)[None] for image in images)
    by_hand = run_in_batches(lambda part: encoder.encode_touch(part, "digit"), touches, size=3)
    np.testing.assert_allclose(by_hand, values[:4], atol=1e-6)


def test_probes_learn_from_its_features(table):
    store = encoder_features(MeanColours(), table)
    features = store.get(np.arange(len(table))[:, None], 1)
    things = table.text_column("object")
    # a ball is brighter than a cube
    split = np.where(np.arange(len(table)) < 8, "train", "test")
    result = at.probe_features(features, things, np.arange(len(table)), split, seeds=0)
    assert result.accuracy == 1.0


def test_a_stream_takes_it(tmp_path):
    encoder = MeanColours()
    video = write_video(
        tmp_path / "video.avi", [np.full((32, 32, 3), value, np.uint8) for value in (40, 180)]
    )
    source, live = open_source(str(video))
    with contextlib.closing(stream(encoder, source, live=live, sensor=1)) as frames:
        values = np.stack([frame.values for frame in frames])
    np.testing.assert_allclose(values[:, 0] * 255, [40, 180], atol=3)
    assert (values[:, 3] == 1).all()


def test_what_it_does_not_define_is_left_out_or_one_sentence():
    encoder = MeanColours()
    assert not encoder.measures and not encoder.runs_in_jax and encoder.exported(1) is None
    lines = []
    assert encoder.sensor_row("my_gel", lines.append) == encoder.config.model.universal_row
    assert "my_gel" in lines[0]
    for call, words in (
        (lambda: encoder.measure_of("digit"), "does not measure"),
        (encoder.traceable, "encode_touch"),
        (encoder.untrained, "without controls"),
        (lambda: encoder.sensor_row("DIGIT"), "did you mean digit"),
        (lambda: MeanColours("subtract").preprocess(encoder.blank), "untouched gel"),
    ):
        with pytest.raises(UserError, match=words):
            call()
    gel = np.full((40, 40, 3), 50, np.uint8)
    see = at.Preprocess(MeanColours("subtract"), gel)
    assert (see(gel) == 0).all() and see.background is not None
