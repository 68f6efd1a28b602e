import importlib.util
import json
import pickle
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from measuring import measuring_weights
from tiny_models import touch_model

from anytouch_jax.config import to_json
from anytouch_jax.encoder.base import FEW, Encoder
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import CheckError, UserError
from anytouch_jax.export import cache, engines
from anytouch_jax.export import export as exports
from anytouch_jax.export.artefact import describes
from anytouch_jax.files import cache_folder
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import safetensors

pytest.importorskip("onnxruntime")
CLIPS = np.random.default_rng(0).integers(0, 256, (5, 6, 28, 28, 3), np.uint8)
ENGINES = [
    name
    for name in ("auto", "onnxruntime", "openvino")
    if name == "auto" or importlib.util.find_spec(name)
]


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def weights(
    path: Path, seed: int = 0, scale: float = 1.0, background: str = "keep", **changes
) -> Path:
    """Write weights that are all drawn, so that a forgotten one shows."""
    model = touch_model(**changes)
    rng = np.random.default_rng(seed)
    params = build(model).abstract()
    params = jax.tree.map(lambda x: (0.3 * rng.standard_normal(x.shape)).astype(np.float32), params)
    params["touch"]["projection"]["kernel"] *= np.float32(scale)
    about = {safetensors.MODEL_KEY: to_json(model), safetensors.BACKGROUND_KEY: background}
    safetensors.export_safetensors(path, params, about)
    return path


def stored(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.onnx"))


def test_every_engine_gives_the_features_of_xla_also_after_a_change_of_weights_with_the_same_name(
    tmp_path,
):
    path = tmp_path / "w.safetensors"
    before = None
    for seed, scale in ((0, 1.0), (1, 1.0), (1, 2.0)):
        weights(path, seed, scale)
        live = load_encoder(path, engine="xla")
        for engine in ENGINES:
            encoder = load_encoder(path, engine=engine)
            for frames, pooling in ((1, "class"), (3, "both")):
                wanted = live.encode_touch(CLIPS[:, :frames], "digit", pooling=pooling)
                found = encoder.encode_touch(CLIPS[:, :frames], "digit", pooling=pooling)
                assert (
                    encoder.exported(frames, pooling) is not None
                    and live.exported(frames, pooling) is None
                )
                assert np.abs(found - wanted).max() <= 1e-5 * np.abs(wanted).max(), (
                    engine,
                    seed,
                    frames,
                )
        # the old export would have shown
        assert before is None or np.abs(wanted - before).max() > 0.1
        before = wanted


def test_few_touches_are_computed_by_onnxruntime_and_many_by_xla(tmp_path, monkeypatch):
    """A named engine computes all, as the user wants it."""
    path = weights(tmp_path / "w.safetensors")
    many = np.concatenate([CLIPS[:, 0]] * 2)
    assert len(many) > FEW
    wanted = load_encoder(path, engine="xla").encode_touch(many, "digit")
    asked = []
    exported = Encoder.exported
    monkeypatch.setattr(
        Encoder, "exported", lambda self, *a, **k: (asked.append(1), exported(self, *a, **k))[1]
    )
    for engine, count, uses in (
        ("auto", FEW, 1),
        ("auto", FEW + 1, 0),
        ("onnxruntime", FEW + 1, 1),
        ("xla", 1, 0),
    ):
        asked.clear()
        found = load_encoder(path, engine=engine).encode_touch(many[:count], "digit")
        assert len(asked) == uses, (engine, count)
        np.testing.assert_allclose(found, wanted[:count], rtol=1e-4, atol=1e-5)


def test_an_export_is_made_once_and_again_when_anything_that_decides_it_changes(
    tmp_path, monkeypatch
):
    made = []
    grouped = exports.export_with
    monkeypatch.setattr(
        exports, "export_with", lambda *given, **more: (made.append(0), grouped(*given, **more))[1]
    )

    def features(path):
        return load_encoder(path).encode_touch(CLIPS[:FEW, 0], "digit")

    path = weights(tmp_path / "run" / "w.safetensors")
    first = features(path)
    np.testing.assert_array_equal(features(path), first)
    assert len(made) == 1 and [file.parent.name for file in stored(tmp_path)] == [".engines"]
    assert stored(tmp_path)[0].parents[1] == path.parent
    stored(tmp_path)[0].write_bytes(b"not whole")
    np.testing.assert_array_equal(features(path), first)
    describes(stored(tmp_path)[0]).unlink()
    np.testing.assert_array_equal(features(path), first)
    assert len(made) == 3
    for number, changes in enumerate(
        ({"background": "subtract"}, {"activation": "quick_gelu"}, {"norm_eps": 0.1})
    ):
        features(weights(path, **changes))
        assert len(made) == 4 + number  # the parameters are the same
    monkeypatch.setattr("onnxruntime.__version__", "0")
    features(path)
    assert len(made) == 7
    assert not [
        file for file in path.parent.rglob("*") if file.name.startswith(".") and file.is_file()
    ]


def test_exports_of_the_package_and_of_a_folder_that_cannot_be_written_are_in_the_cache_of_the_user(
    tmp_path, monkeypatch
):
    own = cache_folder() / "engines"
    assert cache._folders("anytouch-tiny") == cache._folders("hf://user/repo") == [own]
    path = weights(tmp_path / "w.safetensors")
    (tmp_path / ".engines").write_text("a file where the folder would be")
    one, two = (load_encoder(path).encode_touch(CLIPS[:FEW, 0], "digit") for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert [file.parent for file in stored(tmp_path)] == [own]
    # nothing can be written
    monkeypatch.setenv("XDG_CACHE_HOME", str(path))
    np.testing.assert_array_equal(load_encoder(path).encode_touch(CLIPS[:FEW, 0], "digit"), one)


def test_an_export_that_differs_is_never_used_and_not_tried_again(tmp_path, monkeypatch):
    grouped = engines.touch_graph
    tried = []

    def other(params, *rest):
        tried.append(0)
        return grouped(jax.tree.map(lambda x: x * np.float32(1.001), params), *rest)

    monkeypatch.setattr(engines, "touch_graph", other)
    path = weights(tmp_path / "w.safetensors")
    for _ in range(2):
        encoder = load_encoder(path)
        live = load_encoder(path, engine="xla").encode_touch(CLIPS[:FEW, 0], "digit")
        np.testing.assert_array_equal(encoder.encode_touch(CLIPS[:FEW, 0], "digit"), live)
        assert encoder.exported(1) is None
    assert len(tried) == 1 and stored(tmp_path) == []
    with pytest.raises(CheckError, match="differs from the live model"):
        load_encoder(path, engine="onnxruntime").encode_touch(CLIPS[:FEW, 0])


def test_xla_computes_what_an_export_cannot(tmp_path, monkeypatch):
    path = weights(tmp_path / "w.safetensors")
    auto, live = (load_encoder(path, engine=engine) for engine in ("auto", "xla"))
    for given in ({"pooling": "mean"}, {"aggregation": "concat"}):
        np.testing.assert_array_equal(
            *(one.encode_touch(CLIPS, "digit", **given) for one in (auto, live))
        )
    half = [
        one.computed_in("bfloat16").encode_touch(CLIPS[:FEW, 0], "digit") for one in (auto, live)
    ]
    np.testing.assert_array_equal(*half)
    gradient = jax.grad(
        lambda params: auto.traceable()(params, CLIPS[:1, :1], np.zeros(1, np.int32)).sum()
    )
    assert np.isfinite(jax.tree.leaves(gradient(auto.params))[0]).all()
    assert auto.encode_touch(CLIPS[:0, :1]).shape == (0, 12)
    assert stored(tmp_path) == []
    gpu = SimpleNamespace(default_backend=lambda: "gpu", tree=jax.tree, tree_util=jax.tree_util)
    for name, value in (("LARGEST", 10), ("jax", gpu)):
        with monkeypatch.context() as patch:
            patch.setattr(cache, name, value)
            assert load_encoder(path).exported(1) is None
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert load_encoder(path).exported(1) is None


def test_fields_and_features_of_one_pass_are_those_of_xla(tmp_path):
    path = measuring_weights(tmp_path / "w.safetensors", {"modulus": {"digit": 50.0}})
    auto, live = (load_encoder(path, engine=engine) for engine in ("auto", "xla"))
    given = CLIPS[:2, :1], np.zeros(2, np.int32), np.zeros(2, np.float32)
    (ours, fields), (theirs, wanted) = (one.encode_and_measure(*given) for one in (auto, live))
    assert auto.exported(1, fields=True) is not None
    np.testing.assert_allclose(ours, theirs, atol=1e-5 * np.abs(theirs).max())
    for one, two in zip(fields, wanted, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-3, atol=1e-4)


def test_an_encoder_in_another_process_finds_the_export(tmp_path):
    encoder = load_encoder(weights(tmp_path / "w.safetensors"))
    wanted = encoder.encode_touch(CLIPS[:FEW, 0], "digit")
    copy = pickle.loads(pickle.dumps(encoder))
    np.testing.assert_array_equal(copy.encode_touch(CLIPS[:FEW, 0], "digit"), wanted)
    assert copy.exported(1) is not None and "exported" not in str(encoder.__getstate__().keys())
    moved = replace(encoder, params=jax.tree.map(lambda x: x * np.float32(1.1), encoder.params))
    assert np.abs(moved.encode_touch(CLIPS[:FEW, 0], "digit") - wanted).max() > 1e-3


def test_an_engine_that_cannot_compute_says_so(tmp_path):
    path = weights(tmp_path / "w.safetensors")
    family = Path(__file__).parents[1] / "parity" / "golden_others" / "timm_vit.safetensors"
    for call, words in (
        (
            lambda: load_encoder(path, engine="tensorrt"),
            "engine is one of auto, xla, onnxruntime, openvino",
        ),
        (lambda: load_encoder(family, heads=4, engine="onnxruntime"), "another family"),
        (
            lambda: (
                load_encoder(path, engine="onnxruntime")
                .computed_in("bfloat16")
                .encode_touch(CLIPS[:FEW, 0])
            ),
            "dtype",
        ),
    ):
        with pytest.raises(UserError, match=words):
            call()
    load_encoder(path).encode_touch(CLIPS[:FEW, 0])
    assert json.loads(describes(stored(tmp_path)[0]).read_text())["form"] == "onnx"
