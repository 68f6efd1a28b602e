"""The authors' files and full-size key lists, where the golden vectors are present beside the checkout."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from anytouch_jax.config import Stack, preset
from anytouch_jax.io.release import (
    clip_to_stage1,
    detect_model,
    merge_stage2,
    read_weights,
    release_names,
    release_shapes,
    to_params,
    to_release,
)
from anytouch_jax.io.shapes import param_shapes
from anytouch_jax.io.tree import flatten, nest

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "golden"
STAGE1 = preset("large", recipe="release")
STAGE2 = preset("large", stage=2, recipe="release", towers="pretrained")


def same(first, second) -> None:
    first, second = flatten(first), flatten(second)
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


@pytest.mark.parametrize("stage", ["stage1", "stage2"])
def test_the_authors_checkpoint_holds_the_golden_parameters(stage):
    from_torch = read_weights(GOLDEN / f"{stage}_tiny_checkpoint-0.pth")
    arrays = read_weights(GOLDEN / f"{stage}_params.npz")
    model = detect_model(from_torch)
    params = to_params(from_torch, model)
    same(params, to_params(arrays, model, ignore={"sensor_token_proj.weight"}))
    assert {name: leaf.shape for name, leaf in flatten(params).items()} == param_shapes(model)
    back = to_release(params, model)
    assert back.keys() == from_torch.keys()
    for key in release_names(model):
        np.testing.assert_array_equal(back[key], arrays[key], err_msg=key)


def test_the_detected_model_has_the_recorded_sizes():
    sizes = json.loads((GOLDEN / "stage2_params.json").read_text())["config"]
    model = detect_model(
        read_weights(GOLDEN / "stage2_params.npz"), heads=sizes["heads"], decoder_heads=sizes["dheads"]
    )
    tower = Stack(sizes["hidden"], sizes["layers"], sizes["heads"], sizes["mlp"])
    assert model.touch == model.image == tower
    assert model.decoder == Stack(sizes["dh"], sizes["dl"], sizes["dheads"], sizes["dmlp"])
    assert (model.image_size, model.patch, model.embed) == (sizes["image"], sizes["patch"], sizes["proj"])
    assert (model.lora_rank, model.match_head, model.frames) == (sizes["lora_r"], "linear", 3)
    assert (model.text.vocab, model.text.length) == (sizes["vocab"], sizes["maxpos"])
    assert detect_model(read_weights(GOLDEN / "stage1_params.npz")).decoder_sensor_tokens


def test_clip_parameters_fill_both_towers():
    weights = read_weights(GOLDEN / "J_clip_params.npz")
    model = detect_model(weights)
    params = to_params(weights, model)
    expected = {
        name: shape for name, shape in param_shapes(model).items() if name.split("/")[0] not in ("touch", "decoder")
    }
    assert {name: leaf.shape for name, leaf in flatten(params).items()} == expected


@pytest.mark.parametrize(
    ("case", "layout", "model"),
    [
        ("stage1", "stage1", STAGE1.model),
        ("stage2", "stage2", STAGE2.model),
        ("hf_clip_vit_l_14", "clip", STAGE2.model),
        ("probe_material", "probe", STAGE1.model),
    ],
)
def test_full_size_keys_and_shapes(case, layout, model):
    manifest = json.loads((GOLDEN / "K_manifest.json").read_text())[case]["state_dict"]
    rows = {key: tuple(shape) for key, shape, *_ in manifest if not key.startswith("head.")}
    assert release_shapes(model, layout) == rows


def _first(rules, name):
    return next(value for pattern, value in rules if re.search(pattern, name))


@pytest.mark.parametrize(("case", "config"), [("stage1", STAGE1), ("stage2", STAGE2)])
def test_decay_and_freezing_follow_the_authors_groups(case, config):
    names = release_names(config.model)
    manifest = json.loads((GOLDEN / "K_manifest.json").read_text())[case]["state_dict"]
    checked = 0
    for key, _, _, group in manifest:
        if key not in names:  # an array that nothing reads
            continue
        name = names[key]
        without_gradient = group == "frozen" or name.startswith("text/")  # under no_grad there, golden Q10
        assert _first(config.frozen, name) == without_gradient, key
        if group != "frozen":
            assert _first(config.weight_decay, name) == {"decay": 0.1, "no_decay": 0.0}[group], key
        checked += 1
    assert checked == len(names) == len(manifest) - 2


def _sources(case: str) -> dict[str, str]:
    return json.loads((GOLDEN / "K_weight_loading_map.json").read_text())[case]


def _values(shapes: dict[str, tuple], seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {key: rng.normal(size=shape).astype("f4") for key, shape in shapes.items()}


def _check_sources(case: str, merged: dict, fresh: dict, files: dict[str, dict]) -> None:
    """Every used key of the merged weights has the value that the authors' loader would give it."""
    for key, source in _sources(case).items():
        if key not in merged:
            continue
        if source == "kept at its fresh initial value":
            expected = fresh[key]
        else:
            file, _, theirs = source.partition(":")
            expected = files[file][theirs]
            if key.endswith("video_patch_embedding.weight") and file == "clip":
                expected = np.repeat(expected[:, None], 3, axis=1)
        np.testing.assert_array_equal(merged[key], expected, err_msg=key)


@pytest.mark.parametrize("case", ["stage1_from_clip", "stage2_from_stage1_and_clip", "stage2_from_clip_only"])
def test_loading_follows_the_authors_map(case):
    # The map was written for a two-layer model; LoRA is inserted after loading.
    stack = Stack(16, 2, 4, 24)
    towers = {"image": stack, "text": dataclasses.replace(STAGE2.model.text, stack=Stack(10, 2, 2, 14), vocab=30)}
    sizes = {"image_size": 28, "patch": 14, "embed": 12, "touch": stack, "decoder": Stack(8, 2, 2, 16)}
    model1 = dataclasses.replace(STAGE1.model, **sizes)
    model2 = dataclasses.replace(STAGE2.model, **sizes, **towers, lora_rank=0)
    clip = _values(release_shapes(model2, "clip"), 1)
    mae = _values(release_shapes(model1), 2)
    model = model1 if case == "stage1_from_clip" else model2
    fresh = nest(_values(param_shapes(model), 3))
    if case == "stage1_from_clip":
        merged = clip_to_stage1(clip, model, fresh)
    else:
        stage1 = to_params(mae, model1) if "stage1" in case else None
        merged = merge_stage2(fresh, stage1=stage1, clip=to_params(clip, model))
    used = set(release_names(model))
    assert used <= set(_sources(case))
    theirs, before = to_release(merged, model), to_release(fresh, model)
    _check_sources(case, {key: theirs[key] for key in used}, before, {"clip": clip, "mae": mae})
