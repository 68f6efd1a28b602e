import json

import pytest
from places import EXPERIMENTS, SHARED
from touch_world import make_touches

from anytouch_jax.errors import UserError
from anytouch_jax.weights.convert import file_shapes
from anytouch_jax.weights.families import entries_of
from experiments.compare import families, run
from experiments.records import read_records
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
