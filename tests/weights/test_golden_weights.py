import json

import numpy as np
import pytest
from places import SHARED

from anytouch_jax.config import Stack
from anytouch_jax.weights.convert import detect_form, to_params, to_release
from anytouch_jax.weights.keymaps import param_shapes
from anytouch_jax.weights.load import read_weights
from anytouch_jax.weights.tree import flatten
from tests.parity import weights as parity_weights
from tests.parity.golden_files import Case
from tests.support.release_keys import detect_model, release_names

GOLDEN = SHARED / "golden"


def same(first, second) -> None:
    first, second = flatten(first), flatten(second)
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


@pytest.mark.parametrize("stage", ["stage1", "stage2"])
def test_the_authors_checkpoint_holds_the_golden_parameters(stage):
    from_torch = read_weights(GOLDEN / f"{stage}_tiny_checkpoint-0.pth")
    arrays = read_weights(GOLDEN / f"{stage}_params.npz")
    model, _ = detect_form(from_torch, {})
    params = to_params(from_torch, model)
    same(params, to_params(arrays, model, ignore={"sensor_token_proj.weight"}))
    assert {name: leaf.shape for name, leaf in flatten(params).items()} == param_shapes(model)
    back = to_release(params, model)
    assert back.keys() == from_torch.keys()
    for key in release_names(model):
        np.testing.assert_array_equal(back[key], arrays[key], err_msg=key)


def test_the_detected_model_has_the_recorded_sizes():
    sizes = json.loads((GOLDEN / "stage2_params.json").read_text())["config"]
    heads = {"touch": sizes["heads"], "image": sizes["heads"], "decoder": sizes["dheads"], "text": sizes["heads"]}
    model = detect_model(read_weights(GOLDEN / "stage2_params.npz"), heads)
    tower = Stack(sizes["hidden"], sizes["layers"], sizes["heads"], sizes["mlp"])
    assert model.touch == model.image == tower
    assert model.decoder == Stack(sizes["dh"], sizes["dl"], sizes["dheads"], sizes["dmlp"])
    assert (model.image_size, model.patch, model.embed) == (sizes["image"], sizes["patch"], sizes["proj"])
    assert (model.lora_rank, model.match_head, model.frames) == (sizes["lora_r"], "linear", 3)
    assert (model.text.vocab, model.text.length) == (sizes["vocab"], sizes["maxpos"])
    assert detect_form(read_weights(GOLDEN / "stage1_params.npz"), {})[0].decoder_sensor_tokens


def test_clip_parameters_fill_both_towers():
    weights = read_weights(GOLDEN / "J_clip_params.npz")
    model, _ = detect_form(weights, {})
    params = to_params(weights, model)
    expected = {
        name: shape for name, shape in param_shapes(model).items() if name.split("/")[0] not in ("touch", "decoder")
    }
    assert {name: leaf.shape for name, leaf in flatten(params).items()} == expected


def checked(case, runner, change=lambda info: None):
    """The rows of a case whose JSON was changed."""
    info = json.loads((GOLDEN / f"{case}.json").read_text())
    change(info)
    made = Case(case, GOLDEN, info)
    runner(made)
    return made.rows


def test_full_size_files_are_those_of_the_authors():
    rows = checked("K_manifest", parity_weights.manifest)
    assert [row for row in rows if not row.good] == []
    assert {row.array for row in rows} == {
        *(f"{kind}/keys" for kind in ("stage1", "stage2", "probe_material", "hf_clip_vit_l_14")),
        *(f"{kind}/{what}" for kind in ("stage1", "stage2") for what in ("network", "groups")),
    }


def change_row(kind, key, place, value):
    def change(info):
        (row,) = [row for row in info[kind]["state_dict"] if row[0] == key]
        row[place] = value

    return change


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (change_row("stage1", "mask_token", 3, "no_decay"), "stage1/groups/mask_token"),
        (change_row("stage2", "logit_scale", 3, "frozen"), "stage2/groups/logit_scale"),
        (change_row("probe_material", "sensor_token", 1, [9, 5, 1024]), "probe_material/keys/sensor_token"),
        (change_row("hf_clip_vit_l_14", "logit_scale", 1, [1]), "hf_clip_vit_l_14/keys/logit_scale"),
    ],
)
def test_another_group_or_shape_is_found(change, wrong):
    assert [row.array for row in checked("K_manifest", parity_weights.manifest, change) if not row.good] == [wrong]


def test_loading_follows_the_authors_map():
    rows = checked("K_weight_loading_map", parity_weights.loading_map)
    assert [row for row in rows if not row.good] == []
    assert [row.array.split("/")[0] for row in rows] == [
        "stage1_from_clip", "stage2_from_stage1_and_clip", "stage2_from_clip_only", "probe_from_stage1",
        "probe_from_stage2",
    ]  # fmt: skip


def test_a_value_from_elsewhere_is_found():
    key = "touch_model.post_layernorm.weight"

    def change(info):
        info["stage1_from_clip"][key] = "clip:vision_model.pre_layrnorm.weight"
        del info["stage2_from_clip_only"]["logit_scale"]
        info["probe_from_stage1"][key] = "mae:touch_model.pre_layrnorm.weight"

    wrong = {row.array for row in checked("K_weight_loading_map", parity_weights.loading_map, change) if not row.good}
    assert wrong == {
        f"stage1_from_clip/{key}", "stage2_from_clip_only/logit_scale", "stage2_from_clip_only/keys",
        "probe_from_stage1/touch/post_norm/scale",
    }  # fmt: skip
