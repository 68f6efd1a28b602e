import dataclasses
import json
from pathlib import Path

import pytest

from anytouch_jax.cli import app, train
from anytouch_jax.config import Config, from_json, preset, presets, to_json

OWN = {"objective.universal_end": 0.0}  # it starts at 0 anyway
STILLS = {"data.clip_share": 0.0}
# (name, stage) -> every field that differs from the paper's model, with its value
CHANGED = {
    ("anytouch", 1): {}, ("anytouch", 2): {}, ("no_stage2", 1): {}, ("no_stage1", 2): {}, ("no_text", 1): {},
    ("no_vision", 1): {}, ("no_text_aligned", 1): {}, ("no_matching", 1): {},
    ("unitouch", 2): {**OWN, **STILLS, "model.text": None, "model.match_head": "none", "data.require": ("image",)},
    ("tlv_link", 2): {
        **OWN, **STILLS, "model.match_head": "none", "model.sensor_tokens": 0, "data.require": ("image", "text"),
    },
    ("t3", 1): {
        **OWN, **STILLS, "model.patch_encoder": "sensor", "model.sensor_tokens": 0, "objective.next_frame": False,
    },
    ("static_only", 1): {**STILLS, "objective.next_frame": False},
    ("static_only", 2): {**STILLS, "objective.next_frame": False},
    ("no_dynamic", 1): {**STILLS, "objective.next_frame": False},
    ("no_dynamic", 2): {**STILLS, "objective.next_frame": False}, ("no_text", 2): {"model.text": None},
    ("no_vision", 2): {"model.image": None}, ("no_matching", 2): {"model.match_head": "none"}, ("no_universal", 1): OWN,
    ("no_universal", 2): OWN, ("no_text_aligned", 2): {"data.aligned_text": False},
}  # fmt: skip


def flat(value: object, prefix: str = "") -> dict[str, object]:
    """Fields of the sections by their dotted names; stacks and towers are one field."""
    sections = ("model", "objective", "optim", "data", "run")
    fields = {f"{prefix}{f.name}": getattr(value, f.name) for f in dataclasses.fields(value)}
    if prefix:
        return fields
    return {
        name: field
        for key, section in fields.items()
        for name, field in (flat(section, f"{key}.").items() if key in sections else [(key, section)])
    }


def differences(name: str, config: Config) -> dict[str, object]:
    before, after = flat(config), flat(presets.apply_baseline(name, config))
    assert before.keys() == after.keys()
    return {key: after[key] for key in after if after[key] != before[key]}


@pytest.mark.parametrize("recipe", ["paper", "release"])
@pytest.mark.parametrize(("name", "stage"), list(CHANGED))
def test_a_recipe_changes_exactly_what_it_says(name: str, stage: int, recipe: str) -> None:
    config = preset("tiny", stage=stage, recipe=recipe)
    assert differences(name, config) == CHANGED[name, stage]


def test_a_configuration_from_before_these_fields_reads_as_the_paper_model() -> None:
    config = preset("tiny", stage=2)
    data = json.loads(to_json(config))
    for section, names in {"model": ("patch_encoder",), "data": ("require", "contact_only", "aligned_text")}.items():
        for name in names:
            del data[section][name]
    assert from_json(json.dumps(data)) == config


TRAIN = ["--data", "m.csv", "--run", "r"]


def test_train_takes_a_baseline_before_the_users_own_overrides() -> None:
    _, config = train.parse(train.TrainOptions, "train", [*TRAIN, "--baseline", "t3"])
    assert config.model.patch_encoder == "sensor" and config.data.clip_share == 0
    args = [*TRAIN, "--baseline", "t3", "--model.sensor-tokens", "2", "--data.clip-share", "0.25"]
    _, config = train.parse(train.TrainOptions, "train", args)
    assert config.model.patch_encoder == "sensor" and config.model.sensor_tokens == 2
    assert config.data.clip_share == 0.25 and not config.objective.next_frame
    _, config = train.parse(train.TrainOptions, "train", [*TRAIN, "--stage", "2", "--data.require", "image", "text"])
    assert config.data.require == ("image", "text")


def test_train_refuses_a_baseline_that_does_not_fit(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    def reported(*args: str) -> str:
        assert app.main(["train", *TRAIN, *args]) == 2
        return capsys.readouterr().err

    assert "no baseline is called 'moco'" in reported("--baseline", "moco")
    assert "no_pretraining is not trained" in reported("--baseline", "no_pretraining")
    assert "t3 has no stage 2" in reported("--baseline", "t3", "--stage", "2")
    init = ("--stage", "2", "--init", str(tmp_path))
    assert "--objective.match-keep has no effect in stage 1" in reported("--objective.match-keep", "0.5")
    for option, value in (("match-head", "cosine"), ("lora-rank", "4"), ("temperature", "0.2")):
        assert f"--model.{option} has no effect in stage 1" in reported(f"--model.{option}", value)
    assert "--data.negatives has no effect in stage 1" in reported("--data.negatives", "same_sensor")
    clip = ("--stage", "2", "--towers", "pretrained", "--clip-weights", str(tmp_path), "--model.temperature")
    assert "--model.temperature has no effect with --clip-weights" in reported(*clip, "0.2")
    assert "there is no manifest" in reported(*clip, "0.07")
    masked = ("--objective.mask-ratio", "0.5", *init)
    assert "--objective.mask-ratio has no effect in stage 2 of the paper recipe" in reported(*masked)
    for kept in (("--recipe", "release", *masked), ("--baseline", "t3")):
        assert "there is no manifest" in reported(*kept)
    assert "no_stage1 has no stage 1" in reported("--baseline", "no_stage1", *init)
    assert "there is no manifest" in reported("--baseline", "no_matching", *init)
