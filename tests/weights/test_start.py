import json
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from places import ROOT
from safetensors.numpy import load_file, save_file
from tiny_models import touch_model

from anytouch_jax import load_encoder
from anytouch_jax.config import Config, Stack, preset
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.weights.start import load_start
from tests.support.weights_world import assert_same
from tests.zoo.test_families import MAE, made

OTHERS = ROOT / "tests" / "parity" / "golden_others"


def no_registers(source: Path, folder: Path) -> Path:
    """The DINOv2 of the golden files without its register tokens."""
    arrays = load_file(next(source.glob("*.safetensors")))
    arrays = {key: array for key, array in arrays.items() if not key.endswith("register_tokens")}
    folder.mkdir()
    save_file(arrays, folder / "model.safetensors")
    shutil.copy(source / "config.json", folder)
    return folder


def mae(folder: Path) -> Path:
    """A ViT-MAE of Hugging Face with random arrays: 28 pixels, patches of 7, width 16."""
    *_, arrays = made(MAE, (16, 2, 2, 32), 7, {"grid": (1, 4, 4)}, (28, 28))
    folder.mkdir()
    save_file(
        {key: np.float32(0.3) * array for key, array in arrays.items()},
        folder / "model.safetensors",
    )
    (folder / "config.json").write_text(json.dumps({"num_attention_heads": 2}))
    return folder


def run_of(encoder, **changes) -> Config:
    """A run of stage 1 whose touch encoder has the form of a ViT."""
    form = encoder.form.model
    size = {name: getattr(form, name) for name in ("patch", "touch", "norm_eps")}
    size |= {
        "image_size": encoder.image_size[0],
        "embed": form.touch.width,
        "decoder": Stack(8, 1, 2, 16),
    }
    return replace(preset("tiny"), model=touch_model(**size, pre_norm=False, **changes))


@pytest.mark.parametrize("family", ["dinov2", "vit_mae"])
def test_a_still_and_a_clip_of_equal_frames_give_the_class_token_of_the_file(family, tmp_path):
    """Layer scales, the bias of the patches and the kernel over three frames are exact."""
    source = (
        no_registers(OTHERS / "dinov2_registers_hf", tmp_path / "a")
        if family == "dinov2"
        else mae(tmp_path / "b")
    )
    encoder = load_encoder(source)
    # stored positions
    encoder = load_encoder(source, image_size=encoder.form.grid[1] * encoder.form.model.patch)
    assert encoder.family.name == family
    config = run_of(encoder, sensor_tokens=0)
    net = build(config.model)
    fresh = net.init(jax.random.key(0))
    params, notes, trained = load_start(fresh, config, init=source)
    assert trained == () and "start untrained" in notes[0]
    params["touch"]["projection"]["kernel"] = np.eye(config.model.embed, dtype=np.float32)
    frame = np.random.default_rng(1).normal(size=(2, 1, *encoder.image_size, 3)).astype("f4")
    wanted = encoder.encode_touch(frame)
    for clip in (frame, np.repeat(frame, 3, axis=1)):
        ours = np.asarray(net.encode_touch(params, clip, np.zeros(2, np.int32)))
        np.testing.assert_allclose(ours, wanted, atol=2e-5 * np.abs(wanted).max())
    assert_same({"decoder": params["decoder"]}, {"decoder": fresh["decoder"]})


def test_positions_are_resized_and_registers_left_out(tmp_path):
    source = OTHERS / "dinov2_registers_hf"
    encoder = load_encoder(source)
    config = run_of(encoder)
    side = encoder.form.model.patch * (encoder.form.grid[1] + 2)
    config = replace(config, model=replace(config.model, image_size=side))
    fresh = build(config.model).init(jax.random.key(0))
    params, notes, _ = load_start(fresh, config, init=source)
    assert params["touch"]["position"].shape == (config.model.patches + 1, config.model.touch.width)
    assert any("register tokens" in note for note in notes)
    assert {
        name: np.shape(x) for name, x in params["touch"].items() if not isinstance(x, dict)
    } == {name: x.shape for name, x in fresh["touch"].items() if not isinstance(x, dict)}


def test_another_form_or_family_is_one_sentence(tmp_path):
    source = mae(tmp_path / "mae")
    config = run_of(load_encoder(source))
    fresh = build(config.model).init(jax.random.key(0))
    wrong = {
        "--model.no-pre-norm": {"pre_norm": True},
        "--model.norm-eps 1e-12": {"norm_eps": 1e-5},
        "--model.touch.width 16": {"touch": Stack(32, 2, 2, 32)},
        "--model.activation": {"activation": "quick_gelu"},
    }
    for option, change in wrong.items():
        with pytest.raises(UserError, match=option):
            load_start(fresh, replace(config, model=replace(config.model, **change)), init=source)
    shutil.copy(OTHERS / "anytouch2_checkpoint-4frames.pth", tmp_path / "other.pth")
    (tmp_path / "config.json").write_text(json.dumps({"num_attention_heads": 4}))
    with pytest.raises(UserError, match="encoder of AnyTouch 2"):
        load_start(fresh, config, init=tmp_path / "other.pth")
