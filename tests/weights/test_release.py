"""Weights in and out: every key accounted for, every value in its place, there and back bit for bit."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from anytouch_jax.config import SENSORS, UNIVERSAL, ModelConfig, Stack, TextTower, preset
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.weights.compatible import match_sensors
from anytouch_jax.weights.convert import (
    detect_layout,
    detect_model,
    release_names,
    release_shapes,
    to_params,
    to_release,
)
from anytouch_jax.weights.keymaps import param_shapes
from anytouch_jax.weights.load import clip_to_touch, first_params, model_of_file, read_weights
from anytouch_jax.weights.safetensors import WeightsError, write_safetensors
from anytouch_jax.weights.tree import flatten, nest

STAGE1 = ModelConfig(28, 14, 12, Stack(16, 2, 4, 24), Stack(8, 3, 2, 20))
STAGE2 = dataclasses.replace(
    STAGE1,
    image=Stack(16, 2, 4, 24),
    text=TextTower(Stack(10, 2, 2, 14), vocab=30, length=7),
    match_head="linear",
    lora_rank=3,
)
NO_LORA = dataclasses.replace(STAGE2, lora_rank=0)
MLP = dataclasses.replace(STAGE2, match_head="mlp")
DECODER_TOKENS = dataclasses.replace(STAGE1, decoder_sensor_tokens=True)
MODELS = {"stage1": STAGE1, "stage2": STAGE2, "no lora": NO_LORA, "decoder tokens": DECODER_TOKENS}
LAYER = "touch_model.encoder.layers.1."


def weights_of(model: ModelConfig, layout=None, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {key: rng.normal(size=shape).astype("f4") for key, shape in release_shapes(model, layout).items()}


def params_of(model: ModelConfig, seed: int = 0):
    rng = np.random.default_rng(seed)
    return nest({name: rng.normal(size=shape).astype("f4") for name, shape in param_shapes(model).items()})


def same(first, second) -> None:
    first, second = flatten(first), flatten(second)
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


@pytest.mark.parametrize("model", [*MODELS.values(), MLP, preset("tiny").model], ids=str)
def test_names_and_shapes_are_those_of_the_network(model):
    abstract = {name: tuple(leaf.shape) for name, leaf in flatten(build(model).abstract()).items()}
    assert param_shapes(model) == abstract


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
    np.testing.assert_array_equal(
        back[f"{prefix}video_position_embedding.weight"], weights[f"{inner}position_embedding.weight"]
    )
    mean = weights[f"{prefix}video_patch_embedding.weight"].mean(1)
    np.testing.assert_allclose(back[f"{inner}patch_embedding.weight"], mean, atol=1e-6)


def test_every_value_is_in_its_place():
    weights = weights_of(STAGE2)
    params = to_params(weights, STAGE2)
    kernel = weights["touch_mae_model.video_patch_embedding.weight"]  # (D, frame, colour, row, col), golden Q1
    for d, frame, colour, row, col in [(0, 0, 0, 0, 0), (3, 2, 1, 5, 9), (15, 1, 2, 13, 0)]:
        assert (
            params["touch"]["patch"]["kernel"][frame, (row * 14 + col) * 3 + colour, d]
            == kernel[d, frame, colour, row, col]
        )
        still = weights["vision_model.embeddings.patch_embedding.weight"][d, colour, row, col]
        assert params["image"]["patch"]["kernel"][(row * 14 + col) * 3 + colour, d] == still
    layers = "vision_model.encoder.base_model.model.layers.1."
    attention = params["image"]["blocks"]["attention"]
    for theirs, ours in {"q_proj": "query", "k_proj": "key", "v_proj": "value", "out_proj": "out"}.items():
        base = f"{layers}self_attn.{theirs}"
        np.testing.assert_array_equal(attention[ours]["kernel"][1], weights[f"{base}.base_layer.weight"].T)
        np.testing.assert_array_equal(attention[ours]["bias"][1], weights[f"{base}.base_layer.bias"])
        np.testing.assert_array_equal(params["lora"][ours]["a"][1], weights[f"{base}.lora_A.default.weight"].T)
        np.testing.assert_array_equal(params["lora"][ours]["b"][1], weights[f"{base}.lora_B.default.weight"].T)
    rest = {
        "layer_norm1": "norm1/scale",
        "layer_norm2": "norm2/scale",
        "mlp.fc1": "mlp/up/kernel",
        "mlp.fc2": "mlp/down/kernel",
    }
    for prefix, part in {
        layers: "image",
        f"touch_mae_model.{LAYER}": "touch",
        "text_model.encoder.layers.1.": "text",
    }.items():
        blocks = flatten(params[part]["blocks"])
        for theirs, ours in rest.items():
            np.testing.assert_array_equal(blocks[ours][1], weights[f"{prefix}{theirs}.weight"].T)
            np.testing.assert_array_equal(
                blocks[f"{ours.rsplit('/', 1)[0]}/bias"][1], weights[f"{prefix}{theirs}.bias"]
            )
    for key, name in {"pre_layrnorm": "pre_norm", "post_layernorm": "post_norm"}.items():
        np.testing.assert_array_equal(params["touch"][name]["bias"], weights[f"touch_mae_model.touch_model.{key}.bias"])
        np.testing.assert_array_equal(params["image"][name]["scale"], weights[f"vision_model.{key}.weight"])
    for key, name in {
        "decoder_pred": "still_head",
        "decoder_pred_video": "clip_head",
        "decoder_embed": "embed",
    }.items():
        np.testing.assert_array_equal(params["decoder"][name]["kernel"], weights[f"touch_mae_model.{key}.weight"].T)
    block = "touch_mae_model.touch_decoder_blocks.2."
    decoder = params["decoder"]["blocks"]
    np.testing.assert_array_equal(
        decoder["attention"]["out"]["kernel"][2], weights[f"{block}attention.output.dense.weight"].T
    )
    np.testing.assert_array_equal(decoder["mlp"]["down"]["kernel"][2], weights[f"{block}output.dense.weight"].T)
    np.testing.assert_array_equal(decoder["norm2"]["scale"][2], weights[f"{block}layernorm_after.weight"])
    np.testing.assert_array_equal(params["decoder"]["mask_token"], weights["touch_mae_model.mask_token"][0, 0])
    np.testing.assert_array_equal(params["text"]["token"], weights["text_model.embeddings.token_embedding.weight"])
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
    assert "unknown keys (2)" in message and "missing keys (2)" in message and "other shapes (2)" in message
    assert "mask_token has (1, 1, 9) instead of (1, 1, 8)" in message
    assert "touch_projection.weight has (16, 12) instead of (12, 16)" in message


def test_of_many_wrong_keys_a_handful_is_named():
    wide = dataclasses.replace(STAGE1, touch=Stack(32, 4, 4, 24))
    with pytest.raises(UserError, match=r"missing keys \(\d+\): .* and \d+ more; other shapes \(\d+\): ") as caught:
        to_params(weights_of(STAGE1), wide)
    assert str(caught.value).count(" and ") == 2 and len(str(caught.value)) < 1500


@pytest.mark.parametrize(
    ("file", "wanted", "setting"),
    [
        (DECODER_TOKENS, STAGE1, "decoder_sensor_tokens"),
        (STAGE2, NO_LORA, "lora_rank"),
        (NO_LORA, STAGE2, "lora_rank"),
        (STAGE2, MLP, "match_head"),
        (STAGE1, dataclasses.replace(STAGE1, touch=Stack(16, 3, 4, 24)), "depths"),
        (STAGE1, dataclasses.replace(STAGE1, embed=13), "other shapes"),
    ],
)
def test_a_wrong_model_is_told_which_setting(file, wanted, setting):
    with pytest.raises(UserError, match=setting):
        to_params(weights_of(file), wanted)


def test_keys_of_no_use_are_left_out_by_name():
    weights = weights_of(STAGE1)
    weights["touch_model.embeddings.position_ids"] = np.arange(5)[None]
    weights["sensor_token_proj.weight"] = np.zeros((8, 16), "f4")
    same(to_params(weights, STAGE1, ignore={"sensor_token_proj.weight"}), to_params(weights_of(STAGE1), STAGE1))
    for key in ("touch_model.embeddings.patch_embedding.weight", "video_position_embedding.weight"):
        del weights[key]  # and their absence is no fault
    to_params(weights, STAGE1, ignore={"sensor_token_proj.weight"})
    stage2 = weights_of(STAGE2)
    touch_only = to_params(stage2, STAGE1)  # towers and heads that the model does not have
    assert set(touch_only) == {"touch", "decoder"}


@pytest.mark.parametrize("match_head", ["linear", "none"])
def test_towers_not_in_the_model_are_left_out(match_head):
    model = dataclasses.replace(STAGE2, text=None, match_head=match_head)
    params = to_params(weights_of(STAGE2), model)
    assert "text" not in params and "image" in params and ("matcher" in params) == (match_head == "linear")


def test_the_matching_mlp_is_refused_or_extra():
    params = params_of(MLP)
    with pytest.raises(UserError, match="MLP"):
        to_release(params, MLP)
    arrays = to_release(params, MLP, allow_extra=True)
    assert {key for key in arrays if key.startswith("cross_sensor")} == {
        f"cross_sensor_mlp.{part}.{kind}" for part in ("up", "down") for kind in ("weight", "bias")
    }
    same(to_params(arrays, MLP), params)


def test_release_needs_whole_parameters():
    params = params_of(STAGE1)
    del params["decoder"]["norm"]
    params["touch"]["extra"] = np.zeros(1)
    params["touch"]["class_token"] = np.zeros(3)
    with pytest.raises(UserError, match=r"missing keys \(2\): decoder/norm/scale") as caught:
        to_release(params, STAGE1)
    assert "unknown keys (1): touch/extra" in str(caught.value)
    assert "touch/class_token has (3,) instead of (16,)" in str(caught.value)
    turned = dataclasses.replace(STAGE1, sensors=(UNIVERSAL, "digit"))
    with pytest.raises(UserError, match="last row"):
        to_release(params_of(turned), turned)


def openclip_of(params, model: ModelConfig) -> dict[str, np.ndarray]:
    """OpenCLIP's names and layouts, written down a second time."""
    weights = {"logit_scale": params["logit_scale"], "attn_mask": np.zeros((7, 7), "f4")}
    towers = {
        "visual.": (
            "image",
            model.image,
            {"class_embedding": "class_token", "positional_embedding": "position"},
            "visual.proj",
        ),
        "": (
            "text",
            model.text.stack,
            {"token_embedding.weight": "token", "positional_embedding": "position"},
            "text_projection",
        ),
    }
    for prefix, (part, stack, tables, projection) in towers.items():
        tower = params[part]
        weights |= {prefix + key: tower[name] for key, name in tables.items()}
        weights[projection] = tower["projection"]["kernel"]
        norms = {"ln_pre": "pre_norm", "ln_post": "post_norm"} if prefix else {"ln_final": "final_norm"}
        for key, name in norms.items():
            weights |= {f"{prefix}{key}.weight": tower[name]["scale"], f"{prefix}{key}.bias": tower[name]["bias"]}
        for layer in range(stack.depth):
            block = f"{prefix}transformer.resblocks.{layer}."
            rows = tower["blocks"]
            attention = rows["attention"]
            qkv = [attention[name] for name in ("query", "key", "value")]
            weights[f"{block}attn.in_proj_weight"] = np.concatenate([dense["kernel"][layer].T for dense in qkv])
            weights[f"{block}attn.in_proj_bias"] = np.concatenate([dense["bias"][layer] for dense in qkv])
            dense = {
                "attn.out_proj": attention["out"],
                "mlp.c_fc": rows["mlp"]["up"],
                "mlp.c_proj": rows["mlp"]["down"],
            }
            for key, leaf in dense.items():
                weights |= {f"{block}{key}.weight": leaf["kernel"][layer].T, f"{block}{key}.bias": leaf["bias"][layer]}
            for key, name in {"ln_1": "norm1", "ln_2": "norm2"}.items():
                weights |= {
                    f"{block}{key}.weight": rows[name]["scale"][layer],
                    f"{block}{key}.bias": rows[name]["bias"][layer],
                }
    kernel = params["image"]["patch"]["kernel"]
    weights["visual.conv1.weight"] = kernel.reshape(14, 14, 3, -1).transpose(3, 2, 0, 1)
    return weights


def test_hf_and_open_clip_agree():
    weights = weights_of(STAGE2, "clip")
    params = to_params(weights, STAGE2)
    assert set(params) == {"image", "text", "logit_scale"}
    other = openclip_of(params, STAGE2)
    assert detect_layout(other) == "openclip" and detect_layout(weights) == "clip"
    same(to_params(other, STAGE2), params)
    no_text = dataclasses.replace(STAGE2, text=None)
    assert set(to_params(other, no_text)) == set(to_params(weights, no_text)) == {"image", "logit_scale"}
    other["visual.transformer.resblocks.0.attn.in_proj_weight"] = np.zeros((47, 16), "f4")
    with pytest.raises(UserError, match=r"in_proj_weight has \(47, 16\) instead of \(48, 16\)"):
        to_params(other, STAGE2)


@pytest.mark.parametrize("layout", ["clip", "openclip"])
@pytest.mark.parametrize("own", [False, True], ids=["shared", "own patch encoders"])
def test_clip_starts_the_touch_encoder(layout, own):
    clip = weights_of(STAGE2, "clip")
    tower = to_params(clip, STAGE2)
    weights = clip if layout == "clip" else openclip_of(tower, STAGE2)
    model = dataclasses.replace(STAGE1, patch_encoder="sensor" if own else "shared")
    fresh = params_of(model, seed=1)
    params = clip_to_touch(weights, model, fresh)
    same(params["decoder"], fresh["decoder"])  # kept, as the sensor tokens are
    np.testing.assert_array_equal(params["touch"]["sensor_tokens"], fresh["touch"]["sensor_tokens"])
    for part in ("class_token", "position", "pre_norm", "blocks", "post_norm", "projection"):
        same({part: params["touch"][part]}, {part: tower["image"][part]})
    kernel = clip["vision_model.embeddings.patch_embedding.weight"]
    inflated = np.repeat(kernel[:, None], 3, axis=1)  # golden Q1: not divided
    for row in params["touch"]["patch"]["kernel"] if own else [params["touch"]["patch"]["kernel"]]:
        one = {**params, "touch": {**params["touch"], "patch": {"kernel": row}}}
        theirs = to_release(one, STAGE1)["video_patch_embedding.weight"]
        np.testing.assert_allclose(theirs, inflated, rtol=1e-7)
    same({"fresh": fresh}, {"fresh": params_of(model, seed=1)})  # the given tree is not written to


def test_stage2_takes_each_part_from_its_source():
    fresh, stage1 = params_of(STAGE2, seed=1), to_params(weights_of(STAGE1), STAGE1)
    weights = weights_of(STAGE2, "clip")
    clip = to_params(weights, STAGE2)
    params = first_params(fresh, STAGE2, stage1=stage1, clip=weights)
    sources = {"touch": stage1, "decoder": stage1, "image": clip, "text": clip, "logit_scale": clip}
    for part in fresh:
        same({part: params[part]}, {part: sources.get(part, fresh)[part]})
    only_clip = first_params(fresh, STAGE2, clip=weights)
    same({"decoder": only_clip["decoder"]}, {"decoder": fresh["decoder"]})
    same({"blocks": only_clip["touch"]["blocks"]}, {"blocks": clip["image"]["blocks"]})
    no_image = dataclasses.replace(STAGE2, image=None, lora_rank=0)
    without = first_params(params_of(no_image, seed=1), no_image, clip=weights)
    same({"blocks": without["touch"]["blocks"], "text": without["text"]},
         {"blocks": clip["image"]["blocks"], "text": clip["text"]})  # fmt: skip
    only_stage1 = first_params(fresh, STAGE2, stage1=stage1)
    same({"image": only_stage1["image"]}, {"image": fresh["image"]})
    other = to_params(weights_of(dataclasses.replace(STAGE1, embed=13)), dataclasses.replace(STAGE1, embed=13))
    with pytest.raises(UserError, match=r"touch/projection/kernel has \(16, 13\) instead of \(16, 12\)"):
        first_params(fresh, STAGE2, stage1=other)


def test_positions_of_another_image_size_are_resized():
    larger = dataclasses.replace(STAGE2, image_size=56)
    weights = weights_of(STAGE2)
    params = to_params(weights, larger)
    assert {name: leaf.shape for name, leaf in flatten(params).items()} == param_shapes(larger)
    position = "touch_mae_model.touch_model.embeddings.position_embedding.weight"
    np.testing.assert_array_equal(params["touch"]["position"][0], weights[position][0])
    weights[position] = weights[position][:4]  # no grid
    with pytest.raises(UserError, match=r"position_embedding.weight has \(4, 16\)"):
        to_params(weights, larger)


def test_sensor_rows_go_by_name():
    sensors = ("digit", "new_one", *SENSORS[3:])
    model = dataclasses.replace(STAGE1, sensors=sensors)
    weights = weights_of(STAGE1)
    tokens = to_params(weights, model)["touch"]["sensor_tokens"]
    np.testing.assert_array_equal(tokens[0], weights["sensor_token"][1])
    np.testing.assert_array_equal(tokens[1], weights["sensor_token"][-1])  # unknown: starts as universal
    np.testing.assert_array_equal(tokens[2:], weights["sensor_token"][3:])
    np.testing.assert_array_equal(match_sensors(tokens, sensors, ("digit", UNIVERSAL)), tokens[[0, -1]])


def test_a_probe_file_gives_encoder_and_classifier():
    weights = weights_of(STAGE1, "probe") | {"head.weight": np.ones((20, 12), "f4"), "head.bias": np.zeros(20, "f4")}
    params = to_params(weights, STAGE1)
    assert set(params) == {"touch", "head"} and params["head"]["kernel"].shape == (12, 20)
    stage1 = dict(weights)
    stage1["video_patch_embedding.weight"] = stage1.pop("touch_model.embeddings.patch_embedding.weight")  # golden Q14
    whole = weights_of(STAGE1) | {key: value for key, value in stage1.items() if not key.startswith("head")}
    same(params["touch"], to_params(whole, STAGE1)["touch"])
    with pytest.raises(UserError, match=r"head\.bias"):
        to_params({key: value for key, value in weights.items() if key != "head.weight"}, STAGE1)


@pytest.mark.parametrize("layout", ["stage1", "stage2", "clip", "openclip", "probe"])
def test_detects_the_model(layout):
    model = {"stage1": DECODER_TOKENS, "stage2": STAGE2}.get(layout, STAGE2)
    weights = weights_of(model, layout) if layout != "openclip" else openclip_of(params_of(model), model)
    found = detect_model(weights, heads=4, decoder_heads=2)
    decoder = Stack(512, 8, 16, 2048) if layout in ("clip", "openclip", "probe") else model.decoder
    text = dataclasses.replace(model.text, stack=Stack(10, 2, 1, 14)) if model.text else None
    if layout in ("clip", "openclip"):
        expected = dataclasses.replace(model, decoder=decoder, text=text, match_head="none", lora_rank=0)
    elif layout == "probe":
        expected = dataclasses.replace(STAGE1, decoder=decoder)
    else:
        expected = dataclasses.replace(model, text=text)
    assert found == expected
    to_params(weights, found)


def test_detects_heads_as_clip_and_the_authors_choose_them():
    shapes = release_shapes(preset("large").model)
    weights = {key: np.broadcast_to(np.float32(0), shape) for key, shape in shapes.items()}
    assert detect_model(weights) == preset("large").model


@pytest.mark.parametrize(
    ("beside", "activation"),
    [
        ({}, "gelu"),
        ({"config.json": {"hidden_act": "quick_gelu"}}, "gelu"),  # not CLIP's
        ({"config.json": {"vision_config": {"hidden_act": "gelu"}, "text_config": {"hidden_act": "gelu"}}}, "gelu"),
        ({"config.json": {"vision_config": {"hidden_act": "quick_gelu"}}}, "quick_gelu"),
        ({"open_clip_config.json": {"model_cfg": {"embed_dim": 768}}}, "gelu"),
        ({"open_clip_config.json": {"model_cfg": {"quick_gelu": True}}}, "quick_gelu"),
    ],
)
def test_the_activation_of_clip_is_what_stands_beside_it(tmp_path, beside, activation):
    for name, content in beside.items():
        (tmp_path / name).write_text(json.dumps(content))
    assert model_of_file(tmp_path / "clip.bin", weights_of(STAGE2, "clip")).activation == activation
    assert model_of_file(tmp_path / "x.bin", weights_of(STAGE1)).activation == "gelu"  # the authors' own


def test_an_activation_that_the_network_lacks_is_refused(tmp_path):
    file, clip = tmp_path / "config.json", weights_of(STAGE2, "clip")
    for text, word in (
        ('{"vision_config": {"hidden_act": "relu"}}', "relu"),
        ('{"vision_config": {"hidden_act": "gelu"}, "text_config": {"hidden_act": "quick_gelu"}}', "gelu and quick"),
        ("{", "not JSON"),
    ):
        file.write_text(text)
        with pytest.raises(WeightsError, match=word):
            model_of_file(tmp_path / "clip.bin", clip)


def test_foreign_weights_are_named():
    with pytest.raises(UserError, match=r"not weights of AnyTouch.*conv1\.weight"):
        detect_layout({"conv1.weight": np.zeros(1)})
    with pytest.raises(UserError, match="no arrays"):
        to_params({}, STAGE1)
    broken = weights_of(STAGE1)
    del broken["sensor_token"]
    with pytest.raises(UserError, match="sensor_token"):
        detect_model(broken)
    with pytest.raises(UserError, match="cannot be detected"):
        detect_model(weights_of(STAGE1) | {"video_patch_embedding.weight": np.float32(0)})


@pytest.mark.parametrize("model", [STAGE1, STAGE2], ids=["stage1", "stage2"])
def test_own_names_are_read_too(model):
    params = params_of(model)
    same(to_params(flatten(params), model), params)
    stage1 = {part: params[part] for part in ("touch", "decoder")}
    same(to_params(flatten(stage1), model), stage1)
    same(
        to_params(flatten(params) | {"force/bias": np.zeros(2), "head/bias": np.zeros(3)}, model), params
    )  # not its own
    with pytest.raises(WeightsError, match=r"unknown keys \(2\): bogus/kernel, Touch/scale$"):
        to_params(flatten(params) | {"bogus/kernel": np.zeros(2), "Touch/scale": np.zeros(2)}, model)
    flat = flatten(params)
    del flat["touch/class_token"]
    with pytest.raises(UserError, match=r"missing keys.*touch/class_token"):
        to_params(flat, model)


def test_files_of_every_kind_hold_the_same(torch_files, tmp_path):
    weights = weights_of(STAGE1)
    params = to_params(weights, STAGE1)
    write_safetensors(tmp_path / "w.safetensors", {k: v.T.copy().T for k, v in weights.items()}, {"source": "test"})
    np.savez(tmp_path / "w.npz", **weights)
    torch_files.write({"model": {key: torch_files.tensor(value) for key, value in weights.items()}}, "w.pth")
    torch_files.write({key: torch_files.tensor(value) for key, value in weights.items()}, "w.bin", legacy=True)
    for name in ("w.safetensors", "w.npz", "w.pth", "w.bin"):
        same(to_params(read_weights(tmp_path / name), STAGE1), params)
    assert not list(tmp_path.glob(".*"))  # no leftovers of the atomic write


def test_half_precision_becomes_float32(tmp_path, torch_files):
    import ml_dtypes

    values = np.array([1.0, -2.5, 3.140625], "f4")
    for kind in (np.float16, ml_dtypes.bfloat16):
        write_safetensors(tmp_path / "h.safetensors", {"x": values.astype(kind), "ids": np.arange(3)}, {})
        read = read_weights(tmp_path / "h.safetensors")
        assert read["x"].dtype == np.float32 and read["ids"].dtype == np.int64
        np.testing.assert_array_equal(read["x"], values.astype(kind).astype("f4"))


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "w.safetensors"
    write_safetensors(path, {"x": np.ones(2)}, {})
    before = path.read_bytes()
    with pytest.raises(UserError, match=r"w\.safetensors"):
        write_safetensors(path, {"x": np.array([object()])}, {})
    with pytest.raises(UserError, match="must be text"):
        write_safetensors(path, {"x": np.ones(2)}, {"step": 3})
    (tmp_path / "blocked").write_text("")
    with pytest.raises(UserError, match="blocked"):
        write_safetensors(tmp_path / "blocked" / "w.safetensors", {"x": np.ones(2)}, {})
    assert path.read_bytes() == before and sorted(p.name for p in tmp_path.iterdir()) == ["blocked", "w.safetensors"]
    path.write_bytes(before[:-3])
    with pytest.raises(UserError, match="not a whole safetensors"):
        read_weights(path)
