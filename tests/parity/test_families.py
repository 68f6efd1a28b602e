"""Encoders of other families against their authors' code; files that are cut, hostile or of no family."""

import json
import pickle
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from places import SHARED
from safetensors.numpy import load_file, save_file

from anytouch_jax import load_encoder
from anytouch_jax.cli.app import main
from anytouch_jax.data.gels import untouched_gel
from anytouch_jax.encoder.export import load as load_exported
from anytouch_jax.errors import UserError
from anytouch_jax.weights import families
from tests.parity import cases
from tests.parity.golden_files import read_cases

HERE = Path(__file__).parent / "golden_others"
ALL = SHARED / "golden_others"  # the whole set, where it lies next to the checkout
CASES = {case.name: case for case in read_cases(HERE)}
WHOLE = {case.name: case for case in read_cases(ALL)} if ALL.is_dir() else {}
COMPARISONS = {"anytouch2": 9, "dinov2_registers_hf": 7, "sparsh_vjepa_learned": 3, "t3": 10, "timm_vit": 7}
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
    changes = {"eps": 1e-3, "preparation": replace(families.FAMILIES[1].preparation, newest_first=False)}
    for name, value in changes.items():
        changed = tuple(replace(family, **{name: value}) for family in families.FAMILIES)
        monkeypatch.setattr(families, "FAMILIES", changed)
        assert "out/a/tokens" in bad(replace(CASES["sparsh_vjepa_learned"], rows=[], seen=set()))


def test_the_names_of_hugging_face_give_the_tokens_of_timms(tmp_path):
    """ViT and DeiT of Hugging Face: the same weights under other names, q, k and v apart."""
    whole, names = load_file(HERE / "timm_vit.safetensors"), {}
    names["cls_token"], names["pos_embed"] = "embeddings.cls_token", "embeddings.position_embeddings"
    for end in ("weight", "bias"):
        names[f"patch_embed.proj.{end}"] = f"embeddings.patch_embeddings.projection.{end}"
        names[f"norm.{end}"] = f"layernorm.{end}"
        for layer in range(2):
            ours, theirs = f"blocks.{layer}", f"encoder.layer.{layer}"
            names[f"{ours}.norm1.{end}"] = f"{theirs}.layernorm_before.{end}"
            names[f"{ours}.norm2.{end}"] = f"{theirs}.layernorm_after.{end}"
            names[f"{ours}.attn.proj.{end}"] = f"{theirs}.attention.output.dense.{end}"
            names[f"{ours}.mlp.fc1.{end}"] = f"{theirs}.intermediate.dense.{end}"
            names[f"{ours}.mlp.fc2.{end}"] = f"{theirs}.output.dense.{end}"
            for part, thirds in zip(
                ["query", "key", "value"], np.split(whole[f"{ours}.attn.qkv.{end}"], 3), strict=True
            ):
                whole[f"{part}{layer}{end}"] = thirds
                names[f"{part}{layer}{end}"] = f"{theirs}.attention.attention.{part}.{end}"
    arrays = {f"vit.{theirs}": np.ascontiguousarray(whole[ours]) for ours, theirs in names.items()}
    save_file(arrays | {"classifier.weight": np.zeros((2, 32), np.float32)}, tmp_path / "model.safetensors")
    (tmp_path / "config.json").write_text(json.dumps({"num_attention_heads": 4, "layer_norm_eps": 1e-6}))
    case = CASES["timm_vit"]
    frames = np.moveaxis(case.arrays["in/a/preprocessed"], 1, -1)
    tokens = load_encoder(tmp_path).encode_tokens(frames)
    np.testing.assert_allclose(tokens, case.arrays["out/a/tokens"], atol=3e-5)


def test_calibration_images_of_sitr_have_their_own_tokens(tmp_path):
    """The class token reads them, their tokens are dropped, and without them the encoder refuses to run."""
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
    save_file({f"base_model.{key}": x for key, x in weights.items() if not key.startswith("head.")}, file)
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
    assert np.abs(features - encoder.calibrated(images[:4], ROLLED).encode_touch(frame)).max() > 1e-3
    assert four.encode_tokens(frame).shape == (1, 10, 32)
    with pytest.raises(UserError, match="needs 4 calibration images"):
        encoder.calibrated(images[:3], ROLLED)


class Harmful:
    def __reduce__(self):
        return print, ("run",)


def torch_file(path, content):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(content, protocol=2))
    return path


def test_damaged_and_hostile_files_get_one_sentence(tmp_path, capsys):
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(VIDEO.read_bytes()[:-1000])
    part = tmp_path / "part.safetensors"
    save_file({key: x for key, x in load_file(VIDEO).items() if "blocks.1.mlp" not in key}, part)
    distilled = tmp_path / "distilled.safetensors"
    save_file(load_file(HERE / "timm_vit.safetensors") | {"dist_token": np.zeros((1, 1, 32), np.float32)}, distilled)
    alone = tmp_path / "digit.pth"
    shutil.copy(HERE / "t3/encoders/digit.pth", alone)
    other = tmp_path / "other.safetensors"
    save_file({"layer.weight": np.zeros((2, 2), np.float32)}, other)
    for file, reason in {
        cut: "not a whole safetensors file", part: r"missing keys \(4\)", distilled: "is a distilled DeiT",
        alone: "put its trunk.pth", HERE / "t3/trunk.pth": "trunk of T3 alone", other: "not weights of",
        torch_file(tmp_path / "harmful.ckpt", {"model": {}, "scheduler": Harmful()}): "nothing was run",
    }.items():  # fmt: skip
        with pytest.raises(UserError, match=reason) as raised:
            load_encoder(file, heads=None if file in (other,) else 4 if file == distilled else 3)
        assert "\n" not in str(raised.value)
    assert capsys.readouterr().out == ""
    with pytest.raises(UserError, match="number of attention heads"):
        load_encoder(VIDEO)
    with pytest.raises(UserError, match="not those of 96 x 96 pixels"):
        load_encoder(VIDEO, heads=3, image_size=96)


def test_clips_are_taken_at_the_stride_of_the_family():
    encoder = load_encoder(VIDEO, heads=3)
    frames = np.random.default_rng(1).random((1, 9, 64, 48, 3), np.float32)
    chosen = encoder.encode_touch(frames[:, 2::2])
    np.testing.assert_array_equal(encoder.encode_touch(frames), chosen)  # the newest, two apart
    np.testing.assert_allclose(encoder.encode_touch(frames[0, 0]), encoder.encode_touch(frames[:, [0] * 4]))
    with pytest.raises(UserError, match="takes 1 frame, 4 frames"):
        encoder.encode_touch(frames[:, :5])
    with pytest.raises(UserError, match="float32"):
        encoder.encode_touch(np.zeros((64, 48, 3), np.uint8))
    with pytest.warns(UserWarning, match="does not know sensors"):
        encoder.encode_touch(frames, "digit")


def test_the_commands_take_a_family(tmp_path, capsys):
    for file in ("sparsh_vjepa_learned.safetensors",):
        shutil.copy(HERE / file, tmp_path)
    (tmp_path / "config.json").write_text('{"num_attention_heads": 3, "preparation": {"portrait": false}}')
    model = str(tmp_path / VIDEO.name)
    assert main(["info", model]) == 0
    assert "non-commercial" in (shown := capsys.readouterr().out) and "4 frames, 2 apart" in shown
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(5):
        np.save(frames / f"frame_{number}.npy", np.roll(ROLLED, number, axis=0))
    out = tmp_path / "features.npz"
    assert main(["embed", "--model", model, "--data", str(frames), "--frames", "4", "--out", str(out)]) == 0
    encoder = load_encoder(model)
    rolled = [np.roll(ROLLED, number, axis=0) for number in range(5)]
    clip = np.stack([encoder.preprocess(frame, untouched_gel(rolled)) for frame in rolled[1:]])
    with np.load(out) as features:
        np.testing.assert_allclose(features["features"][1:], encoder.encode_touch(clip[None]), atol=1e-5)
    exported = tmp_path / "encoder.bin"
    args = ["export", "--model", model, "--to", "jax", "--out", str(exported), "--frames", "4", "--platforms", "cpu"]
    assert main(args) == 0
    np.testing.assert_allclose(load_exported(exported)(clip[None]), encoder.encode_touch(clip[None]), atol=1e-5)
