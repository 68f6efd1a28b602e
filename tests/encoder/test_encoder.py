import zipfile
from dataclasses import replace

import jax
import numpy as np
import pytest

from anytouch_jax.config import DataConfig, to_json
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.transforms import touch_evaluation
from anytouch_jax.encoder.base import Preprocess
from anytouch_jax.encoder.embed import Features, embed_rows, save_npz
from anytouch_jax.encoder.encoder import load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import checkpoint, convert, safetensors

RNG = np.random.default_rng(0)
CLIPS = RNG.integers(0, 256, (2, 7, 28, 28, 3), np.uint8)


def test_shapes_of_what_is_embedded(encoder):
    still = CLIPS[:, 0]
    z = encoder.encode_touch(still, "digit")
    assert z.shape == (2, 12) and z.dtype == np.float32 and np.isfinite(z).all()
    np.testing.assert_array_equal(encoder.encode_touch(still[:, None], "digit"), z)
    np.testing.assert_allclose(encoder.encode_touch(still[0], "digit"), z[:1], atol=1e-5)
    mean = encoder.encode_touch(still, "digit", pooling="mean")
    assert mean.shape == (2, 12) and np.abs(mean - z).max() > 1e-3
    both = encoder.encode_touch(still, "digit", pooling="both")
    np.testing.assert_allclose(both, np.concatenate([z, mean], axis=1), atol=1e-6)
    assert encoder.encode_touch(still[:0], "digit").shape == (0, 12)


def test_what_cannot_be_embedded_is_one_sentence(encoder):
    for clips, word in (
        (CLIPS.astype(np.float32), r"float32.*np\.asarray\(frames, np\.uint8\)"),
        (CLIPS[:, 0].tolist(), r"int64.*np\.asarray\(frames, np\.uint8\)"),
        ([CLIPS[0, 0], CLIPS[0, 0, :5]], "differ in size"),
        (CLIPS[:, :, :27], "28 x 28"),
        (CLIPS[..., :1], r"preprocess"),
        (CLIPS[:, :0], "a clip needs 3 frames"),
        (CLIPS[:, :2], "a clip needs 3 frames"),
        (CLIPS[0, 0, 0], "28 x 28"),
    ):
        with pytest.raises(UserError, match=word):
            encoder.encode_touch(clips, "digit")
    for ids, word in (([0, 10], "0 to 9"), ([-1, 0], "0 to 9"), ([0], "2 touches")):
        with pytest.raises(UserError, match=word):
            encoder.encode_touch(CLIPS[:, 0], np.asarray(ids))


def test_a_sensor_of_the_table_that_training_never_used_is_reported(encoder, tmp_path):
    assert encoder.trained_sensors == ("digit", "gelsight_mini") and encoder.universal_drawn
    lines = []
    assert [encoder.sensor_row(name, lines.append) for name in ("digit", "universal", "tacto")] == [
        1,
        9,
        7,
    ]
    (line,) = lines
    assert (
        "'tacto' was not in training, which had digit, gelsight_mini: using the universal tokens"
        in line
    )
    with pytest.warns(UserWarning, match="'tacto'"):
        np.testing.assert_array_equal(
            encoder.encode_touch(CLIPS[:, 0], "tacto"), encoder.encode_touch(CLIPS[:, 0])
        )
    # without universal tokens the mean of the others serves, also where the universal ones are
    # asked for
    own = replace(encoder, universal_drawn=False)
    lines = []
    assert [
        own.sensor_row(name, lines.append) for name in ("digit", "tacto", "universal", "mine")
    ] == [1, 7, 9, 9]
    assert len(lines) == 3 and all(
        "using the mean of the trained sensors' tokens" in line for line in lines
    )
    about = {safetensors.MODEL_KEY: to_json(encoder.config.model), safetensors.SEEN_KEY: "digit"}
    params = build(encoder.config.model).init(jax.random.key(0))
    safetensors.write_safetensors(
        tmp_path / "w.safetensors", convert.to_release(params, encoder.config.model), about
    )
    assert load_encoder(tmp_path / "w.safetensors").trained_sensors == ("digit",)


def test_an_encoder_of_a_run_keeps_the_touch_encoder_only(encoder, tiny_run):
    assert set(encoder.params) == {"touch"} and encoder.source == str(tiny_run)
    assert (
        "array" not in repr(encoder) and "kernel" not in repr(encoder) and len(repr(encoder)) < 400
    )
    wanted = load_encoder(tiny_run / "checkpoints", step=2).encode_touch(CLIPS[:, 0], "digit")
    np.testing.assert_array_equal(wanted, encoder.encode_touch(CLIPS[:, 0], "digit"))


def test_a_manifest_gives_what_its_images_give(encoder, world):
    manifest = manifests.read(world)
    lines = []
    rows, values = embed_rows(encoder, manifest, np.asarray([9, 0, 5]), batch=2, log=lines.append)
    order = np.argsort(rows)
    assert rows[order].tolist() == [0, 5, 9] and lines == []
    for row, value in zip(rows, values, strict=True):
        image = touch_evaluation([decode(manifest.file(int(row)))], 28)
        wanted = encoder.encode_touch(image[None], manifest.value(int(row), "sensor"))
        np.testing.assert_allclose(value, wanted[0], atol=1e-5)


def test_clips_of_a_manifest_end_at_their_rows(encoder, world):
    manifest = manifests.read(world)
    rows, values = embed_rows(encoder, manifest, np.asarray([3, 6]), 3, "both", batch=8)
    assert rows.tolist() == [3, 6] and values.shape == (2, 24)
    clip = touch_evaluation([decode(world.parent / f"a{i}.png") for i in (1, 2, 3)], 28)
    np.testing.assert_allclose(
        values[0], encoder.encode_touch(clip[None], "digit", pooling="both")[0], atol=1e-5
    )
    with pytest.raises(UserError, match="clip of 3 frames"):
        embed_rows(encoder, manifest, np.asarray([1]), 3)
    with pytest.raises(UserError, match="no rows"):
        embed_rows(encoder, manifest, np.asarray([], np.int64))


def test_features_are_written_with_their_keys(tmp_path):
    features = Features(
        np.ones((2, 3), np.float32), np.asarray([4, 7]), {"path": np.asarray(["a.png", "b.png"])}
    )
    path = tmp_path / "f.npz"
    save_npz(path, features, {"encoder": "runs/one"})
    with np.load(path) as file:
        assert set(file.files) == {"features", "rows", "key/path", "about/encoder"}
        np.testing.assert_array_equal(file["features"], features.values)
        assert file["rows"].tolist() == [4, 7] and file["key/path"].tolist() == ["a.png", "b.png"]
        assert str(file["about/encoder"]) == "runs/one"
    assert zipfile.is_zipfile(path) and [p.name for p in tmp_path.iterdir()] == ["f.npz"]


def test_a_run_of_cudnn_can_be_used_where_there_is_none(encoder, monkeypatch, tiny_run):
    """The configuration of a run trained on a GPU asks for cuDNN's attention."""
    stored = replace(encoder.config, model=replace(encoder.config.model, attention="cudnn"))
    real = checkpoint.load_params
    monkeypatch.setattr(
        checkpoint, "load_params", lambda *a: (real(*a)[0], to_json(stored), real(*a)[2])
    )
    result = load_encoder(tiny_run)
    assert result.config.model.attention == "auto"
    np.testing.assert_array_equal(
        result.encode_touch(CLIPS[:, 0], "digit"), encoder.encode_touch(CLIPS[:, 0], "digit")
    )


def test_a_run_that_keeps_an_average_is_used_by_it(tmp_path):
    saver = checkpoint.Checkpoints(tmp_path / "checkpoints", keep=1, config_json="{}", metadata={})
    state = {
        "trainable": {"touch": {"a": np.ones(3, "f4")}},
        "frozen": {"decoder": {"b": np.full(2, 5, "f4")}},
        "opt_state": {"ema": {"touch": {"a": np.full(3, 7, "f4")}}, "mu": {"x": np.zeros(3, "f4")}},
    }
    saver.save(1, state, {"loss": 1})
    saver.close()
    params, _, _ = checkpoint.load_params(tmp_path)
    assert params["touch"]["a"].tolist() == [7, 7, 7] and params["decoder"]["b"].tolist() == [5, 5]
    assert set(params) == {"touch", "decoder"}


def test_frames_of_other_types_are_seen_as_embed_reads_them(tiny_run):
    """OpenCV writes a resized frame of another type elsewhere, and leaves what was in memory."""
    encoder = load_encoder(tiny_run)
    see = Preprocess(encoder)
    rgb = np.random.default_rng(0).integers(0, 256, (40, 52, 3), np.uint8)
    grey = rgb[..., :1]
    alpha = np.concatenate([rgb, grey], -1)
    wanted = see(rgb)
    of_grey = see(np.repeat(grey, 3, -1))
    for other in (
        alpha,
        rgb.astype(np.uint16) * 257,
        rgb.astype(np.float32) / 255,
        rgb / 255.0,
        rgb.tolist(),
    ):
        other = np.asarray(other, np.uint8) if isinstance(other, list) else other
        np.testing.assert_array_equal(see(other), wanted)
    for other in (grey, grey[..., 0], grey[..., 0].astype(np.float64) / 255):
        np.testing.assert_array_equal(see(other), of_grey)
    for bad, words in (
        (rgb.astype(np.float32), "the frame has.*divide them by 255"),
        (rgb - 300.0, "the frame has.*scale them"),
        (rgb.tolist(), r"the frame has.*np\.asarray\(frame, np\.uint8\)"),
        ([rgb[0], rgb[1, :3]], "differ in size"),
        (rgb[None], "the frame has"),
        (np.zeros((0, 4, 3), np.uint8), "the frame has"),
    ):
        with pytest.raises(UserError, match=words):
            see(bad)
    less = Preprocess(
        replace(encoder, config=replace(encoder.config, data=DataConfig(background="subtract"))),
        grey[..., 0],
    )
    assert (less(grey) == 128).all()
    for bad in (grey, alpha, rgb.astype(np.float32)):
        with pytest.raises(UserError, match="a frame must be RGB uint8"):
            touch_evaluation([bad], 28)


def test_features_do_not_depend_on_the_precision_of_jax(tiny_run):
    def features():
        encoder = load_encoder(tiny_run)
        fresh = random_encoder(encoder.config, 3)
        return [
            encoder.encode_touch(CLIPS[:, :3], "digit", pooling="both"),
            fresh.encode_touch(CLIPS[:, 0], "digit"),
        ]

    plain = features()
    with jax.enable_x64(True):
        wide = features()
    for one, other in zip(plain, wide, strict=True):
        np.testing.assert_array_equal(one, other)
        assert other.dtype == np.float32
