import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from places import EXPERIMENTS, SHARED
from runs import run_config
from tiny_models import full_model
from touch_world import make_touches

from anytouch_jax.config import to_json
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.weights import checkpoint, convert, safetensors
from anytouch_jax.weights.convert import file_shapes
from anytouch_jax.weights.families import entries_of
from experiments.compare import families, run
from experiments.image_tower import image_tower_encoder
from experiments.records import read_records
from tests.support.release_keys import release_names
from tests.weights.test_start import mae

LISTS = SHARED / "golden_others" / "manifest_full_size.json"
NAMES = {  # rows whose released key list is known
    "Sparsh MAE or I-JEPA, small": "sparsh_mae_small", "Sparsh DINO, base": "sparsh_dino_base",
    "Sparsh V-JEPA, base": "sparsh_vjepa_base", "T3, medium": "t3_medium_encoder",
    "AnyTouch 2": "anytouch2_vit_b_4frames_encoder_part", "SITR, 18 images": "sitr_base_18",
    "DINOv2, small": "dinov2_hf_small", "DINOv2 with registers, base": "dinov2_registers_hf_base",
    "ViT-MAE, base": "vitmae_hf_base", "ViT or DeiT, base": "deit_hf_base_ViTForImageClassification",
}  # fmt: skip
UNUSED = ("new_position_ids", "decoder", "mask_token", "classifier", "pooler")


@pytest.mark.parametrize("name", NAMES if LISTS.is_file() else [])
def test_an_untrained_copy_has_the_arrays_of_the_released_file(name):
    everything = json.loads(LISTS.read_text())
    listed = everything[NAMES[name]]
    if isinstance(listed, dict):
        listed = [*everything[listed["as"]], *listed["plus"]]
    if name == "T3, medium":
        listed = [*listed, *([f"trunk.{row[0]}", *row[1:]] for row in everything["t3_medium_trunk"])]
    family, form = families.form_of(name)
    entries, shapes = entries_of(family, form)
    ours = file_shapes(entries, shapes)
    theirs = {row[0]: tuple(row[1]) for row in listed if not any(word in row[0] for word in UNUSED)}
    prefix = next(one for one in (*family.prefixes, "") if all(f"{one}{key}" in theirs for key in ours))
    assert {f"{prefix}{key}": shape for key, shape in ours.items()} == theirs


@pytest.fixture(scope="module")
def encoder(tmp_path_factory):
    return mae(tmp_path_factory.mktemp("file") / "mae")


def test_files_are_probed_by_both_protocols_and_the_page_is_the_users_own(encoder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = make_touches(tmp_path / "data", touches={"train": 4, "val": 2, "test": 4}, each=1)
    out = tmp_path / "runs" / "compare" / "compare.jsonl"
    options = run.Options(encoders=(f"mine={encoder}",), data=(data,), label="hardness")
    assert run.run(options) == 0, capsys.readouterr().err
    records = read_records(out)
    assert {record.get("protocol") for record in records.values()} == {"honest", "published", None}
    text = out.with_suffix(".md").read_text()
    assert not (tmp_path / "experiments").exists()
    assert "linear, honest, %" in text and "kNN, published, %" in text and "| mine | 1 | 28 x 28 |" in text
    with pytest.raises(UserError, match="add DATA"):
        run.run(run.Options(encoders=("mine=x",), out=out))
    with pytest.raises(UserError, match="NAME=FILE"):
        run.run(run.Options(encoders=("mine",), data=(data,), out=out))
    with pytest.raises(UserError, match="no family"):
        run.run(run.Options(only=("Nothing",), out=out))


def test_the_committed_records_have_every_family():
    assert len(read_records(EXPERIMENTS / "results" / "compare.jsonl")) >= len(families.FORMS)


RNG = np.random.default_rng(0)
STILLS = RNG.integers(0, 256, (2, 28, 28, 3), np.uint8)


def stored(folder, config, params):
    saver = checkpoint.Checkpoints(folder / "checkpoints", keep=1, config_json=to_json(config), metadata={})
    saver.save(1, {"trainable": params}, {"loss": 1.0})
    saver.close()
    return folder


@pytest.mark.parametrize("rank", [0, 2])
@pytest.mark.slow
def test_a_still_gives_the_towers_own_embedding(tmp_path, rank):
    config = run_config(tmp_path, 2, towers="pretrained" if rank else "scratch")
    net = build(config.model)
    params = net.init(jax.random.key(3))
    if rank:  # LoRA as if trained: it must be merged
        params["lora"] = jax.tree.map(lambda x: np.asarray(RNG.standard_normal(x.shape), np.float32), params["lora"])
    encoder = image_tower_encoder(stored(tmp_path, config, params))
    wanted = net.encode_image(params, normalise_touch(STILLS))
    np.testing.assert_allclose(encoder.encode_touch(STILLS, "digit"), wanted, atol=2e-5)
    for sensor in ("universal", "gelsight"):  # it knows no sensors
        np.testing.assert_array_equal(encoder.encode_touch(STILLS, sensor), encoder.encode_touch(STILLS, "digit"))
    assert "image tower" in encoder.source


def test_the_tower_of_clip_weights(tmp_path):
    model = replace(full_model(), match_head="linear")
    params = build(model).init(jax.random.key(9))
    full = convert.to_release(params, model)
    keys = release_names(model, "clip")
    file = tmp_path / "clip.safetensors"
    safetensors.write_safetensors(file, {key: full[key] for key in keys}, {safetensors.MODEL_KEY: to_json(model)})
    wanted = build(model).encode_image(params, normalise_touch(STILLS))
    np.testing.assert_allclose(image_tower_encoder(file).encode_touch(STILLS), wanted, atol=2e-5)


def test_a_run_without_an_image_tower_is_one_sentence(tmp_path):
    config = run_config(tmp_path)
    run = stored(tmp_path / "r", config, build(config.model).init(jax.random.key(0)))
    with pytest.raises(UserError, match="has no image tower; give a stage-2 run"):
        image_tower_encoder(run)
    with pytest.raises(UserError, match="no run folder or weights file"):
        image_tower_encoder(tmp_path / "gone")
