import jax
import numpy as np
import pytest

import anytouch_jax as at
from anytouch_jax.encoder.embed import Features, load_index, save_npz
from anytouch_jax.encoder.linear_head import LinearHead

ARRAY = np.zeros((2, 3), np.float32)


def made(tmp_path, world, tiny_run):
    """Yield objects that a user may meet, by name."""
    encoder = at.load_encoder(tiny_run)
    manifest = at.read_manifest(world)
    config = at.preset("tiny", stage=2)
    features = Features(ARRAY, np.arange(2), {"path": np.array(["a", "b"])})
    save_npz(tmp_path / "f.npz", features, {"encoder": "x", "weights": encoder.fingerprint})
    classes = np.array([f"class {number}" for number in range(40)])
    clip = np.zeros((2, 3, 28, 28, 3), np.uint8)
    rows = np.zeros(2, np.int32)
    match = at.MatchBatch(clip, rows, clip, rows)
    loader_config = encoder.config.with_settings(
        {"data.manifests": (str(world),), "data.batch_size": 2}
    )
    state = at.init_state(encoder.params, encoder.config)
    yield from {
        "encoder": encoder,
        "random": at.random_encoder(encoder.config),
        "net": encoder.net,
        "preprocess": at.Preprocess(encoder, np.zeros((30, 40, 3), np.uint8)),
        "example": at.example_touches()[0],
        "config": config,
        "model": config.model,
        "data": at.DataConfig(manifests=tuple(map(str, range(500)))),
        "manifest": manifest,
        "loader": at.Loader(manifest, loader_config),
        "features": features,
        "index": load_index(tmp_path / "f.npz"),
        "head": at.ProbeHead(),
        "touch": at.TouchBatch(clip, rows),
        "stage 2": at.Stage2Batch(None, match),
        "traced": jax.eval_shape(lambda: at.TouchBatch(clip, rows)),
        "state": state,
        "linear head": LinearHead(
            classes, ARRAY, ARRAY[0], ARRAY[0], ARRAY[0], "object", "class", 1, "f"
        ),
    }.items()


def test_every_repr_is_short_and_shows_no_array(tmp_path, world, tiny_run):
    for name, one in made(tmp_path, world, tiny_run):
        text = repr(one)
        assert len(text) <= 600 and len(text.splitlines()) <= 8, (name, text)
        assert " object at 0x" not in text and "array(" not in text and "[[" not in text, (
            name,
            text,
        )
        assert text.startswith(type(one).__name__), (name, text)


@pytest.mark.parametrize(
    "text", ["LossConfig()", "LossConfig(mask_ratio=0.5)", "DataConfig(manifests=('a.csv',))"]
)
def test_a_configuration_shows_what_is_not_the_default(text):
    assert repr(eval(f"at.{text}")) == text
