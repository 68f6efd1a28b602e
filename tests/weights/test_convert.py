from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from weights_world import (
    DECODER_TOKENS,
    MLP,
    NO_LORA,
    STAGE1,
    STAGE2,
    assert_same,
    openclip_of,
    params_of,
    weights_of,
)

from anytouch_jax.config import Stack, preset
from anytouch_jax.errors import UserError
from anytouch_jax.weights.convert import detect_layout, to_params, to_release
from anytouch_jax.weights.keymaps import param_shapes
from anytouch_jax.weights.safetensors import WeightsError
from anytouch_jax.weights.tree import flatten
from tests.support.release_keys import detect_model, release_names, release_shapes

MODELS = {"stage1": STAGE1, "stage2": STAGE2, "no lora": NO_LORA, "decoder tokens": DECODER_TOKENS}
LAYER = "touch_model.encoder.layers.1."


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_there_and_back_is_bit_equal(model):
    weights = weights_of(model)
    params = to_params(weights, model)
    assert {n: a.shape for n, a in flatten(params).items()} == param_shapes(model)
    assert all(a.dtype == np.float32 and a.flags.c_contiguous for a in flatten(params).values())
    back = to_release(params, model)
    assert back.keys() == weights.keys()
    for key in release_names(model):
        np.testing.assert_array_equal(back[key], weights[key], err_msg=key)
    prefix = "touch_mae_model." if model.image else ""
    inner = f"{prefix}touch_model.embeddings."
    video = f"{prefix}video_"
    position = weights[f"{inner}position_embedding.weight"]
    np.testing.assert_array_equal(back[f"{video}position_embedding.weight"], position)
    mean = weights[f"{video}patch_embedding.weight"].mean(1)
    np.testing.assert_allclose(back[f"{inner}patch_embedding.weight"], mean, atol=1e-6)


def test_every_value_is_in_its_place():
    """Every value of a file is drawn, so that an exchanged one shows."""
    weights = weights_of(STAGE2)
    params = to_params(weights, STAGE2)
    same = np.testing.assert_array_equal
    # (D, frame, colour, row, col), golden Q1
    kernel = weights["touch_mae_model.video_patch_embedding.weight"]
    still = weights["vision_model.embeddings.patch_embedding.weight"]
    same(params["touch"]["patch"]["kernel"], kernel.transpose(1, 3, 4, 2, 0).reshape(3, -1, 16))
    same(params["image"]["patch"]["kernel"], still.transpose(2, 3, 1, 0).reshape(-1, 16))
    layers = "vision_model.encoder.base_model.model.layers.1."
    attention = params["image"]["blocks"]["attention"]
    for theirs, ours in {
        "q_proj": "query",
        "k_proj": "key",
        "v_proj": "value",
        "out_proj": "out",
    }.items():
        base = f"{layers}self_attn.{theirs}"
        same(attention[ours]["kernel"][1], weights[f"{base}.base_layer.weight"].T)
        same(attention[ours]["bias"][1], weights[f"{base}.base_layer.bias"])
        for part in "ab":
            same(
                params["lora"][ours][part][1],
                weights[f"{base}.lora_{part.upper()}.default.weight"].T,
            )
    rest = {
        "layer_norm1": "norm1",
        "layer_norm2": "norm2",
        "mlp.fc1": "mlp/up",
        "mlp.fc2": "mlp/down",
    }
    parts = {
        layers: "image",
        f"touch_mae_model.{LAYER}": "touch",
        "text_model.encoder.layers.1.": "text",
    }
    for (prefix, part), (theirs, ours) in product(parts.items(), rest.items()):
        blocks = flatten(params[part]["blocks"])
        same(
            blocks[f"{ours}/{'scale' if 'norm' in ours else 'kernel'}"][1],
            weights[f"{prefix}{theirs}.weight"].T,
        )
        same(blocks[f"{ours}/bias"][1], weights[f"{prefix}{theirs}.bias"])
    block = "touch_decoder_blocks.2."
    flat = flatten(params)
    for theirs, ours in {
        "touch_model.pre_layrnorm.bias": "touch/pre_norm/bias",
        "mask_token": "decoder/mask_token",
        "touch_model.post_layernorm.bias": "touch/post_norm/bias",
        "decoder_pred.weight": "decoder/still_head/kernel",
        "decoder_pred_video.weight": "decoder/clip_head/kernel",
        "decoder_embed.weight": "decoder/embed/kernel",
        f"{block}attention.output.dense.weight": "decoder/blocks/attention/out/kernel",
        f"{block}output.dense.weight": "decoder/blocks/mlp/down/kernel",
        f"{block}layernorm_after.weight": "decoder/blocks/norm2/scale",
    }.items():
        same(
            flat[ours][2] if "blocks" in ours else flat[ours],
            np.squeeze(weights[f"touch_mae_model.{theirs}"].T),
        )
    same(params["image"]["pre_norm"]["scale"], weights["vision_model.pre_layrnorm.weight"])
    same(params["image"]["post_norm"]["scale"], weights["vision_model.post_layernorm.weight"])
    same(params["text"]["token"], weights["text_model.embeddings.token_embedding.weight"])
    assert params["logit_scale"] == weights["logit_scale"] and params["logit_scale"].shape == ()


def test_every_wrong_key_is_listed_at_once():
    weights = weights_of(STAGE1)
    del weights["decoder_norm.bias"], weights[f"{LAYER}mlp.fc1.bias"]
    weights["surprise"] = np.zeros(2, "f4")
    weights["another.one"] = np.zeros((), "f4")
    weights["mask_token"] = np.zeros((1, 1, 9), "f4")
    weights["touch_projection.weight"] = weights["touch_projection.weight"].T
    with pytest.raises(UserError) as caught:
        to_params(weights, STAGE1)
    message = str(caught.value)
    for part in ["decoder_norm.bias", f"{LAYER}mlp.fc1.bias", "surprise", "another.one", "\n"]:
        assert (part in message) == (part != "\n")
    assert (
        "unknown keys (2)" in message
        and "missing keys (2)" in message
        and "other shapes (2)" in message
    )
    assert "mask_token has (1, 1, 9) instead of (1, 1, 8)" in message
    assert "touch_projection.weight has (16, 12) instead of (12, 16)" in message


@pytest.mark.parametrize(
    ("file", "wanted", "setting"),
    [
        (DECODER_TOKENS, STAGE1, "decoder_sensor_tokens"),
        (STAGE2, NO_LORA, "lora_rank"),
        (NO_LORA, STAGE2, "lora_rank"),
        (STAGE2, MLP, "match_head"),
        (STAGE1, replace(STAGE1, touch=Stack(16, 3, 4, 24)), "depths"),
        (STAGE1, replace(STAGE1, embed=13), "other shapes"),
    ],
)
def test_a_wrong_model_names_the_setting(file, wanted, setting):
    with pytest.raises(UserError, match=setting):
        to_params(weights_of(file), wanted)


def test_hf_and_open_clip_agree():
    weights = weights_of(STAGE2, "clip")
    params = to_params(weights, STAGE2)
    assert set(params) == {"image", "text", "logit_scale"}
    other = openclip_of(weights)
    assert detect_layout(other) == "openclip" and detect_layout(weights) == "clip"
    assert_same(to_params(other, STAGE2), params)
    no_text = replace(STAGE2, text=None)
    assert (
        set(to_params(other, no_text))
        == set(to_params(weights, no_text))
        == {"image", "logit_scale"}
    )
    other["visual.transformer.resblocks.0.attn.in_proj_weight"] = np.zeros((47, 16), "f4")
    with pytest.raises(UserError, match=r"in_proj_weight has \(47, 16\) instead of \(48, 16\)"):
        to_params(other, STAGE2)


def test_a_probe_file_gives_encoder_and_classifier():
    weights = weights_of(STAGE1, "probe") | {
        "head.weight": np.ones((20, 12), "f4"),
        "head.bias": np.zeros(20, "f4"),
    }
    params = to_params(weights, STAGE1)
    assert set(params) == {"touch", "head"} and params["head"]["kernel"].shape == (12, 20)
    stage1 = dict(weights)
    # golden Q14
    stage1["video_patch_embedding.weight"] = stage1.pop(
        "touch_model.embeddings.patch_embedding.weight"
    )
    whole = weights_of(STAGE1) | {
        key: value for key, value in stage1.items() if not key.startswith("head")
    }
    assert_same(params["touch"], to_params(whole, STAGE1)["touch"])
    with pytest.raises(UserError, match=r"head\.bias"):
        to_params({key: value for key, value in weights.items() if key != "head.weight"}, STAGE1)


@pytest.mark.parametrize("layout", ["stage1", "stage2", "clip", "openclip", "probe"])
def test_detects_the_model(layout):
    model = DECODER_TOKENS if layout == "stage1" else STAGE2
    weights = (
        openclip_of(weights_of(model, "clip"))
        if layout == "openclip"
        else weights_of(model, layout)
    )
    detected = detect_model(weights, {"touch": 4, "image": 4, "decoder": 2, "text": 2})
    alone = {"decoder": Stack(512, 8, 16, 2048), "match_head": "none", "lora_rank": 0}
    expected = {"clip": replace(model, **alone), "probe": replace(STAGE1, **alone)}
    assert detected == expected.get(layout.removeprefix("open"), model)
    to_params(weights, detected)


@pytest.mark.parametrize("name", ["tiny", "small", "base", "large"])
def test_head_counts_are_right_or_refused_for_every_preset(name):
    model = preset(name, stage=2, recipe="release").model
    weights = {
        key: np.broadcast_to(np.float32(0), shape) for key, shape in release_shapes(model).items()
    }
    heads = {part: getattr(model, part).heads for part in ("touch", "image", "decoder")}
    assert detect_model(weights, heads | {"text": model.text.stack.heads}) == model
    if name != "tiny":
        assert detect_model(weights) == model
        return
    # 6 heads: width / 64 would be 3
    with pytest.raises(UserError, match=r"touch \(width 192\).*config\.json"):
        detect_model(weights)


@pytest.mark.parametrize("model", [STAGE1, STAGE2], ids=["stage1", "stage2"])
def test_own_names_are_read_too(model):
    params = params_of(model)
    flat = flatten(params)
    stage1 = {part: params[part] for part in ("touch", "decoder")}
    assert_same(to_params(flatten(stage1), model), stage1)
    # of no network here
    for others in ({}, {"force/bias": np.zeros(2), "head/bias": np.zeros(3)}):
        assert_same(to_params(flat | others, model), params)
    with pytest.raises(WeightsError, match=r"unknown keys \(2\): bogus/kernel, Touch/scale$"):
        to_params(flat | {"bogus/kernel": np.zeros(2), "Touch/scale": np.zeros(2)}, model)
    with pytest.raises(UserError, match=r"missing keys.*touch/class_token"):
        to_params(
            {name: array for name, array in flat.items() if name != "touch/class_token"}, model
        )
