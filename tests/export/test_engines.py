import json
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest
from measuring import measuring_weights
from tiny_models import touch_model

from anytouch_jax.config import Config
from anytouch_jax.encoder.encoder import load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.export import engines
from anytouch_jax.export.encoder import EngineEncoder
from anytouch_jax.export.export import describes, export, load, read_checked
from anytouch_jax.fields.measure import fields_of

pytest.importorskip("onnxruntime")
RNG = np.random.default_rng(0)
CLIPS = RNG.integers(0, 256, (5, 4, 28, 28, 3), np.uint8)
ROWS = np.asarray([1, 0, 9, 3, 1], np.int32)


def perturbed(encoder, seed=0):
    """The encoder with biases and scales that are not 0 and 1, so that a forgotten one shows."""
    rng = np.random.default_rng(seed)
    moved = lambda x: np.asarray(x) + 0.1 * rng.standard_normal(x.shape).astype(np.float32)  # noqa: E731
    return replace(encoder, params=jax.tree.map(moved, encoder.params))


@pytest.fixture(scope="module")
def encoder():
    return perturbed(random_encoder(Config(touch_model())))


@pytest.fixture(scope="module")
def calibration():
    """200 touches u8 and their sensor rows."""
    return RNG.integers(0, 256, (200, 3, 28, 28, 3), np.uint8), RNG.integers(0, 10, 200).astype(
        np.int32
    )


@pytest.fixture(scope="module")
def exported(tmp_path_factory, encoder, calibration):
    """Paths of clips of three frames, float32 and int8."""
    folder = tmp_path_factory.mktemp("engines")
    export(encoder, folder / "f32.onnx", frames=3, form="onnx")
    export(encoder, folder / "int8.onnx", frames=3, form="onnx", calibration=calibration)
    return folder / "f32.onnx", folder / "int8.onnx"


@pytest.mark.parametrize(
    ("changes", "frames", "pooling"),
    [
        ({}, 1, "class"),
        ({"dtype": "bfloat16"}, 3, "both"),
        ({"activation": "quick_gelu"}, 1, "mean"),
        ({"patch_encoder": "sensor", "pre_norm": False}, 1, "class"),
        ({"patch_encoder": "sensor"}, 3, "both"),
    ],
)
def test_the_graph_gives_the_features_of_the_live_model(changes, frames, pooling):
    encoder = perturbed(random_encoder(Config(touch_model(**changes))).computed_in("float32"))
    data = engines.touch_graph(encoder.params, encoder.config.model, frames, pooling)
    run = engines.session(data)
    for count in (1, 5):
        touches = CLIPS[:count, :frames]
        rows = ROWS[:count]
        live = encoder.encode_touch(touches, rows, pooling=pooling)
        assert np.abs(run(touches, rows) - live).max() < 1e-5 * np.abs(live).max()


def test_an_exported_encoder_takes_the_place_of_the_live_one(exported, encoder):
    run = load(exported[0])
    own = load_encoder(exported[0])
    assert isinstance(own, EngineEncoder) and own.fingerprint == encoder.fingerprint
    # else features of one were taken for the other's
    assert own.contract != load_encoder(exported[1]).contract
    live = encoder.encode_touch(CLIPS[:, :3], "digit")
    for features in (run(CLIPS[:, :3], "digit"), own.encode_touch(CLIPS[:, :3], "digit")):
        np.testing.assert_allclose(features, live, atol=1e-5 * np.abs(live).max())
    assert own.encode_touch(CLIPS[:0, :3], ROWS[:0]).shape == (0, 12)
    about = json.loads(describes(exported[0]).read_text())
    assert about["platforms"] == ["cpu"] and about["worst_difference"] < 1e-5
    space = {"frames": CLIPS[:, :3], "sensor": ROWS}
    exec(about["example"].replace("f32.onnx", str(exported[0])), space)
    np.testing.assert_allclose(
        space["features"], encoder.encode_touch(CLIPS[:, :3], ROWS), atol=1e-5
    )


def test_the_example_of_fields_gives_mm_and_newtons(tmp_path):
    measuring = load_encoder(
        measuring_weights(
            tmp_path / "w.safetensors", {"depth": 1.5, "normal": 0.7, "modulus": {"digit": 80.0}}
        )
    )
    export(measuring, tmp_path / "m.onnx", frames=3, form="onnx", fields=True)
    about = json.loads(describes(tmp_path / "m.onnx").read_text())
    of_sensor = about["fields"]["sensors"]
    assert of_sensor["digit"] == {"width_mm": 14.25, "modulus_kpa": 80.0, "aspect": 0.2877}
    assert "universal" not in of_sensor
    first = next(iter(of_sensor))
    space = {"frames": CLIPS[:, :3], "sensor": ROWS}
    exec(about["example"].replace("m.onnx", str(tmp_path / "m.onnx")), space)
    aspect = np.full(5, of_sensor[first]["aspect"], np.float32)
    features, out = measuring.encode_and_measure(CLIPS[:, :3], ROWS, aspect)
    scale = measuring.measure_of(first).scale
    wanted = fields_of(out, scale, shape=scale.shape)
    np.testing.assert_allclose(space["features"], features, atol=3e-5)
    np.testing.assert_allclose(space["depth"], wanted.depth, atol=1e-4)
    np.testing.assert_allclose(space["force"], wanted.force, atol=1e-3)
    # every formula, in the words of the file
    functions = {name: getattr(np, name) for name in ("sqrt", "exp", "tanh", "minimum")}
    functions |= out._asdict() | of_sensor[first]
    functions["deviation"] = lambda x: eval(about["fields"]["deviation(x)"], functions | {"x": x})
    values = {
        name: eval(one["formula"], functions) for name, one in about["fields"]["units"].items()
    }
    touched = wanted.area > 0
    for name, value in values.items():
        if name == "tangential_std":
            ours = wanted.force_std[:, :1]
        elif name == "normal_std":
            ours = wanted.force_std[:, 2:]
        elif name == "pressure":
            ours = scale.modulus * out.pressure
        else:
            ours = getattr(wanted, name)
        rows = touched if name.startswith("slip") else slice(None)
        np.testing.assert_allclose(value[rows], ours[rows], rtol=1e-4, atol=1e-6, err_msg=name)


def test_int8_is_calibrated_on_the_touches(exported, encoder, calibration):
    import onnx

    _, about = read_checked(exported[1])
    live = encoder.encode_touch(*calibration)
    error = np.abs(load(exported[1])(*calibration) - live).max() / np.abs(live).max()
    assert 1e-4 < error < 0.1 and about["int8"]["worst_difference"] == pytest.approx(
        error, rel=1e-3
    )
    assert about["int8"]["touches"] == 200 and about["int8"]["cosine"] > 0.99
    weights = {one.name: one for one in onnx.load(exported[1]).graph.initializer}
    small = [
        one
        for one in weights.values()
        if one.data_type == onnx.TensorProto.INT8 and len(one.dims) == 2
    ]
    # the last block asks with its own product
    assert len(small) == 1 + 4 * encoder.config.model.touch.depth
    assert all(
        list(weights[one.name.replace("quantized", "scale")].dims) == one.dims[1:] for one in small
    )
    # ranges of other touches do not serve these
    narrow = (calibration[0] // 64 + 96, calibration[1])
    other = engines.quantised(engines.touch_graph(encoder.params, encoder.config.model, 3), *narrow)
    assert (
        np.abs(engines.session(other)(*calibration) - live).max() / np.abs(live).max() > 2 * error
    )


def test_what_cannot_be_run_is_one_sentence(exported, encoder, calibration, tmp_path, monkeypatch):
    own = load_encoder(exported[0])
    clips = CLIPS[:, :3]
    for call, word in (
        (lambda: load(exported[0], "xla"), "runs on onnxruntime or openvino, not on xla"),
        (
            lambda: load_encoder(exported[0], engine="xla"),
            "runs on onnxruntime or openvino, not on xla",
        ),
        (lambda: own.encode_touch(clips, pooling="mean"), "has pooling class, not mean"),
        (lambda: own.encode_touch(CLIPS), r"\(B, 3, 28, 28, 3\)"),
        (lambda: own.computed_in("bfloat16"), "float32 or int8"),
        (
            lambda: export(encoder, tmp_path / "m.onnx", frames=4, form="onnx"),
            "touches of 1 or 3 frames, not of 4",
        ),
        (own.traceable, "has no parameters for jax"),
        (lambda: export(own, tmp_path / "m.bin"), "has no parameters for jax"),
        (
            lambda: engines.quantised(b"", calibration[0][:199], calibration[1][:199]),
            "on 200 touches, not on 199",
        ),
    ):
        with pytest.raises(UserError, match=word):
            call()
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(
        UserError, match=r'onnxruntime is not installed: pip install "anytouch_jax\[engines\]"'
    ):
        load(exported[0])


@pytest.mark.parametrize(("frames", "pooling"), [(1, "class"), (3, "both")])
def test_fields_on_an_engine_are_those_of_the_live_model(tmp_path, frames, pooling):
    live = load_encoder(
        measuring_weights(tmp_path / "w.safetensors", {"depth": 2.0, "modulus": {"digit": 50.0}})
    )
    rng = np.random.default_rng(1)
    moved = jax.tree.map(
        lambda x: x + 0.05 * rng.standard_normal(x.shape).astype(np.float32), live.others["fields"]
    )
    live = replace(live, others={"fields": moved})
    about = export(
        live, tmp_path / "m.onnx", frames=frames, pooling=pooling, form="onnx", fields=True
    )
    assert about["worst_difference"] < 1e-5 and "aspect" in about
    engine = load_encoder(tmp_path / "m.onnx")
    clips = RNG.integers(0, 256, (2, frames, 30, 40, 3), np.uint8)
    one, two = (each.measure(clips, None, "digit", width_mm=12.0) for each in (live, engine))
    for name in (
        "depth",
        "depth_std",
        "shear",
        "contact",
        "force",
        "force_std",
        "torque",
        "slip_std",
        "centre",
    ):
        np.testing.assert_allclose(getattr(two, name), getattr(one, name), rtol=1e-3, atol=1e-4)
    features = [
        each.encode_touch(CLIPS[:2, :frames], "digit", pooling=pooling) for each in (live, engine)
    ]
    np.testing.assert_allclose(*features, atol=1e-4)
    export(live, tmp_path / "plain.onnx", frames=frames, form="onnx")
    plain = load_encoder(tmp_path / "plain.onnx")
    for wrong in (
        lambda: plain.measure(clips),
        lambda: export(live, tmp_path / "m.bin", fields=True),
    ):
        with pytest.raises(UserError, match=r"--model\.fields 32|--to onnx"):
            wrong()
