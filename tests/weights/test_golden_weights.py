import json

import pytest
from places import SHARED

from anytouch_jax.config import Stack
from anytouch_jax.weights.convert import detect_form
from anytouch_jax.weights.load import read_weights
from tests.parity import weights as parity_weights
from tests.parity.golden_files import Case
from tests.support.release_keys import detect_model

GOLDEN = SHARED / "golden"


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


def checked(case, runner, change=lambda info: None):
    """The rows of a case whose JSON was changed."""
    info = json.loads((GOLDEN / f"{case}.json").read_text())
    change(info)
    made = Case(case, GOLDEN, info)
    runner(made)
    return made.rows


def test_full_size_files_are_those_of_the_authors_and_loading_follows_their_map():
    rows = checked("K_manifest", parity_weights.manifest)
    assert [row for row in rows if not row.good] == []
    assert {row.array for row in rows} == {
        *(f"{kind}/keys" for kind in ("stage1", "stage2", "probe_material", "hf_clip_vit_l_14")),
        *(f"{kind}/{what}" for kind in ("stage1", "stage2") for what in ("network", "groups")),
    }
    rows = checked("K_weight_loading_map", parity_weights.loading_map)
    assert [row for row in rows if not row.good] == []
    assert [row.array.split("/")[0] for row in rows] == [
        "stage1_from_clip", "stage2_from_stage1_and_clip", "stage2_from_clip_only", "probe_from_stage1",
        "probe_from_stage2",
    ]  # fmt: skip


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
