"""Encoders of other families against their authors' code; files that are cut, hostile or of no
family.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from places import SHARED
from safetensors.numpy import load_file, save_file

from anytouch_jax import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.zoo import families
from tests.parity import cases
from tests.parity.golden_files import read_cases

HERE = Path(__file__).parent / "golden_others"
ALL = SHARED / "golden_others"  # the whole set, where it lies next to the checkout
CASES = {case.name: case for case in read_cases(HERE)}
WHOLE = {case.name: case for case in read_cases(ALL)} if ALL.is_dir() else {}
COMPARISONS = {
    "anytouch2": 9,
    "dinov2_registers_hf": 7,
    "sparsh_vjepa_learned": 3,
    "t3": 10,
    "timm_vit": 7,
}
LISTS = [name for name in WHOLE if name in ("manifest_full_size", "preprocess_full_size")]
VIDEO = HERE / "sparsh_vjepa_learned.safetensors"
ROLLED = np.arange(48 * 48 * 3, dtype=np.uint8).reshape(48, 48, 3)


def bad(case):
    return {row.array: (row.error, row.note) for row in cases.run_case(case) if not row.good}


@pytest.mark.parametrize("name", COMPARISONS)
def test_a_family_is_within_tolerance(name):
    case = replace(CASES[name], rows=[], seen=set())
    assert bad(case) == {}
    assert len(case.rows) >= COMPARISONS[name]


@pytest.mark.parametrize("name", LISTS)
def test_key_lists_and_preparations_of_the_released_sizes(name):
    assert bad(WHOLE[name]) == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(WHOLE) - {*LISTS}))
def test_a_family_of_the_whole_set_is_within_tolerance(name):
    assert bad(WHOLE[name]) == {}


def test_a_wrong_epsilon_order_of_frames_or_offset_is_out_of_tolerance(monkeypatch):
    changes = {
        "eps": 1e-3,
        "preparation": replace(families.FAMILIES[1].preparation, newest_first=False),
    }
    for name, value in changes.items():
        changed = tuple(replace(family, **{name: value}) for family in families.FAMILIES)
        monkeypatch.setattr(families, "FAMILIES", changed)
        assert "out/a/tokens" in bad(replace(CASES["sparsh_vjepa_learned"], rows=[], seen=set()))


def test_the_names_of_hugging_face_give_the_tokens_of_timms(tmp_path):
    """ViT and DeiT of Hugging Face: the same weights under other names, q, k and v apart."""
    whole = load_file(HERE / "timm_vit.safetensors")
    names = {"cls_token": "embeddings.cls_token"}
    names["pos_embed"] = "embeddings.position_embeddings"
    inside = {
        "norm1": "layernorm_before",
        "norm2": "layernorm_after",
        "attn.proj": "attention.output.dense",
        "mlp.fc1": "intermediate.dense",
        "mlp.fc2": "output.dense",
    }
    for end in ("weight", "bias"):
        names[f"patch_embed.proj.{end}"] = f"embeddings.patch_embeddings.projection.{end}"
        names[f"norm.{end}"] = f"layernorm.{end}"
        for layer in range(2):
            names |= {
                f"blocks.{layer}.{a}.{end}": f"encoder.layer.{layer}.{b}.{end}"
                for a, b in inside.items()
            }
            thirds = np.split(whole[f"blocks.{layer}.attn.qkv.{end}"], 3)
            for part, third in zip(("query", "key", "value"), thirds, strict=True):
                whole[f"{part}{layer}{end}"] = third
                names[f"{part}{layer}{end}"] = (
                    f"encoder.layer.{layer}.attention.attention.{part}.{end}"
                )
    arrays = {f"vit.{theirs}": np.ascontiguousarray(whole[ours]) for ours, theirs in names.items()}
    save_file(
        arrays | {"classifier.weight": np.zeros((2, 32), np.float32)},
        tmp_path / "model.safetensors",
    )
    (tmp_path / "config.json").write_text(
        json.dumps({"num_attention_heads": 4, "layer_norm_eps": 1e-6})
    )
    case = CASES["timm_vit"]
    frames = np.moveaxis(case.arrays["in/a/preprocessed"], 1, -1)
    tokens = load_encoder(tmp_path).encode_tokens(frames)
    np.testing.assert_allclose(tokens, case.arrays["out/a/tokens"], atol=3e-5)


def test_calibration_images_of_sitr_have_their_own_tokens(tmp_path):
    """The class token reads them, their tokens are dropped, and without them the encoder refuses to
    run.
    """
    weights = load_file(HERE / "timm_vit.safetensors")
    rng = np.random.default_rng(0)
    weights |= {
        "c_patch_embed.proj.weight": rng.standard_normal((32, 12, 16, 16), np.float32) / 100,
        "c_patch_embed.proj.bias": np.zeros(32, np.float32),
        "c_pos_embed": rng.standard_normal((1, 9, 32), np.float32),
        "contrastive_head.weight": rng.standard_normal((128, 32), np.float32),
        "contrastive_head.bias": np.zeros(128, np.float32),
    }
    file = tmp_path / "sitr.safetensors"
    save_file(
        {f"base_model.{key}": x for key, x in weights.items() if not key.startswith("head.")}, file
    )
    encoder = load_encoder(file, heads=4)
    with pytest.raises(UserError, match="subtracts the untouched gel"):
        encoder.preprocess(ROLLED)
    frame = encoder.preprocess(ROLLED, ROLLED[::-1])
    difference = ROLLED[0, 0, 0] - float(ROLLED[-1, 0, 0])  # in grey levels
    assert frame[0, 0, 0] == pytest.approx((difference + 1.2223) / 11.7932)
    with pytest.raises(UserError, match="calibration images"):
        encoder.encode_touch(frame)
    images = [np.roll(ROLLED, shift, axis=0) for shift in range(18)]
    four = encoder.calibrated([images[place - 1] for place in (1, 3, 7, 9)], ROLLED[::-1])
    features = encoder.calibrated(images, ROLLED[::-1]).encode_touch(frame)
    np.testing.assert_allclose(np.linalg.norm(features, axis=1), 1, rtol=1e-5)
    np.testing.assert_array_equal(features, four.encode_touch(frame))
    assert (
        np.abs(features - encoder.calibrated(images[:4], ROLLED).encode_touch(frame)).max() > 1e-3
    )
    assert four.encode_tokens(frame).shape == (1, 10, 32)
    with pytest.raises(UserError, match="needs 4 calibration images"):
        encoder.calibrated(images[:3], ROLLED)


def test_clips_are_taken_at_the_stride_of_the_family():
    with pytest.raises(UserError, match="number of attention heads"):
        load_encoder(VIDEO)
    with pytest.raises(UserError, match="not those of 96 x 96 pixels"):
        load_encoder(VIDEO, heads=3, image_size=96)
    encoder = load_encoder(VIDEO, heads=3)
    frames = np.random.default_rng(1).random((1, 9, 64, 48, 3), np.float32)
    chosen = encoder.encode_touch(frames[:, 2::2])
    # the newest, two apart
    np.testing.assert_array_equal(encoder.encode_touch(frames), chosen)
    np.testing.assert_allclose(
        encoder.encode_touch(frames[0, 0]), encoder.encode_touch(frames[:, [0] * 4])
    )
    with pytest.raises(UserError, match="takes 1 frame, 4 frames"):
        encoder.encode_touch(frames[:, :5])
    with pytest.raises(UserError, match="float32"):
        encoder.encode_touch(np.zeros((64, 48, 3), np.uint8))
    with pytest.warns(UserWarning, match="does not know sensors"):
        encoder.encode_touch(frames, "digit")
