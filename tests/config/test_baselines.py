import json
from pathlib import Path

import pytest

from anytouch_jax.cli import app, train
from anytouch_jax.config import from_json, preset, presets, to_json

STAGE_2 = ("no_text", "no_vision", "no_text_aligned", "no_matching")  # they change stage 2 alone
EVERY = [(name, stage) for name, one in presets.BASELINES.items() for stage in one.stages]


@pytest.mark.parametrize("recipe", ["paper", "release"])
@pytest.mark.parametrize(("name", "stage"), EVERY)
def test_a_baseline_trains_as_the_paper_model_does(name: str, stage: int, recipe: str) -> None:
    """Only parts, data and terms differ.

    What each leaves out, the tests of pools, objectives and training say.
    """
    config = preset("tiny", stage=stage, recipe=recipe)
    made = presets.apply_baseline(name, config)
    assert (made.optim, made.run, made.recipe, made.stage) == (
        config.optim,
        config.run,
        config.recipe,
        stage,
    )
    whole = {
        field: getattr(config.model, field)
        for field in ("touch", "decoder", "embed", "image_size", "sensors")
    }
    assert {field: getattr(made.model, field) for field in whole} == whole
    assert (made == config) == (
        name in ("anytouch", "no_stage1", "no_stage2") or (stage == 1 and name in STAGE_2)
    )
    assert "universal" not in name or made.objective.universal_end == 0


def test_a_configuration_from_before_these_fields_reads_as_the_paper_model() -> None:
    config = preset("tiny", stage=2)
    data = json.loads(to_json(config))
    for section, names in {
        "model": ("patch_encoder",),
        "data": ("require", "contact_only", "aligned_text"),
    }.items():
        for name in names:
            del data[section][name]
    assert from_json(json.dumps(data)) == config


TRAIN = ["--data", "m.csv", "--run", "r"]


def test_train_takes_a_baseline_before_the_users_own_overrides() -> None:
    _, config = train.parse(train.TrainOptions, "train", [*TRAIN, "--baseline", "t3"])
    assert config.model.patch_encoder == "sensor" and config.data.clip_fraction == 0
    args = [
        *TRAIN,
        "--baseline",
        "t3",
        "--model.sensor-tokens",
        "2",
        "--data.clip-fraction",
        "0.25",
    ]
    _, config = train.parse(train.TrainOptions, "train", args)
    assert config.model.patch_encoder == "sensor" and config.model.sensor_tokens == 2
    assert config.data.clip_fraction == 0.25 and not config.objective.next_frame
    _, config = train.parse(
        train.TrainOptions, "train", [*TRAIN, "--stage", "2", "--data.require", "image", "text"]
    )
    assert config.data.require == ("image", "text")


def test_train_refuses_a_baseline_that_does_not_fit(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    init = f"--stage 2 --init {tmp_path}"
    clip = f"--stage 2 --towers pretrained --clip-weights {tmp_path}"
    masked = f"--objective.mask-ratio 0.5 {init}"
    one = "has no effect in stage 1"
    for words, reported in (
        ("--baseline moco", "no baseline is called 'moco'"),
        ("--baseline t3 --stage 2", "t3 has no stage 2"),
        ("--baseline no_pretraining", "no_pretraining is not trained"),
        ("--objective.match-keep 0.5", f"--objective.match-keep {one}"),
        ("--model.match-head cosine", f"--model.match-head {one}"),
        ("--model.lora-rank 4", f"--model.lora-rank {one}"),
        ("--model.temperature 0.2", f"--model.temperature {one}"),
        ("--data.negatives same_sensor", f"--data.negatives {one}"),
        (
            f"{clip} --model.temperature 0.2",
            "--model.temperature has no effect with --clip-weights",
        ),
        (f"{clip} --model.temperature 0.07", "there is no manifest"),
        (masked, "--objective.mask-ratio has no effect in stage 2 of the paper recipe"),
        (f"--recipe release {masked}", "there is no manifest"),
        ("--baseline t3", "there is no manifest"),
        (f"--baseline no_stage1 {init}", "no_stage1 has no stage 1"),
        (f"--baseline no_matching {init}", "there is no manifest"),
    ):
        assert app.main(["train", *TRAIN, *words.split()]) == 2
        assert reported in capsys.readouterr().err
