import json
import re
from dataclasses import replace
from itertools import product

import pytest
from places import ROOT
from tiny_models import full_model

from anytouch_jax.config import (
    Config,
    DataConfig,
    LossConfig,
    ModelConfig,
    OptimConfig,
    RunConfig,
    Stack,
    TextTower,
    from_json,
    parse_json,
    preset,
    to_json,
)
from anytouch_jax.errors import ConfigError
from anytouch_jax.nn.functional import build
from anytouch_jax.train.optim import match_rules
from anytouch_jax.weights.tree import flatten

NAMES = ("tiny", "small", "base", "large")
ALL = [*product(NAMES, (1, 2), ("paper", "release"), ("scratch", "pretrained"))]


def test_the_points_on_which_the_recipes_differ():
    paper, release = (
        preset("large", stage=2, recipe=r, towers="pretrained") for r in ("paper", "release")
    )
    assert (paper.model.match_head, release.model.match_head) == ("mlp", "linear")
    assert paper.pair_weights == (0.5, 0.5, 0.1)
    # touch-text: twice the paper's
    assert release.pair_weights == (0.5, 1.0, 0.1)
    assert (paper.reconstructs, release.reconstructs) == (False, True)
    assert (paper.splits_steps, release.splits_steps) == (False, True)
    assert (paper.data.order, release.data.order) == ("alternate", "random")
    assert (paper.optim.decay, release.optim.decay) == ("linear", "cosine")
    assert paper.model.lora_rank == release.model.lora_rank == 16 and paper.model.lora_alpha == 16
    assert preset("large", stage=2).model.lora_rank == 0
    one = preset("large", recipe="release")
    assert one.reconstructs and not one.splits_steps and one.optim.decay == "cosine"


@pytest.mark.parametrize(("name", "stage", "recipe", "towers"), ALL[::3])
def test_json_there_and_back(name, stage, recipe, towers):
    config = preset(name, stage=stage, recipe=recipe, towers=towers)
    again = from_json(to_json(config))
    assert again == config and hash(again) == hash(config)
    assert from_json(to_json(config.model), ModelConfig) == config.model


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("optim.clip_nrm", 1.0, "config.optim has no setting called clip_nrm"),
        ("model.patch", "14", "config.model.patch must be int, not '14'"),
        ("optim.learning_rate", True, "config.optim.learning_rate must be float, not True"),
        ("recipe", "papr", "config.recipe must be one of paper, release, not 'papr'"),
        ("data.jitter", [0.1, 0.2, 0.3], "config.data.jitter must have 4 entries, not 3"),
        ("model.text", 3, "config.model.text must be an object"),
        ("model.touch", {}, "config.model.touch has no"),
        ("model.sensors", "digit", "config.model.sensors must be a list"),
        ("model.sensors", ["digit", "digit", "universal"], "twice"),
    ],
)
def test_wrong_json_is_an_error_that_names_the_key(place, value, words):
    data = json.loads(to_json(preset("tiny", stage=2)))
    *sections, last = place.split(".")
    (data[sections[0]] if sections else data)[last] = value
    with pytest.raises(ConfigError, match=re.escape(words)):
        from_json(json.dumps(data))
    for text, words in (
        ("{", "configuration is not JSON"),
        ("", "is not JSON"),
        ("[]", "config must be an object"),
    ):
        with pytest.raises(ConfigError, match=words):
            from_json(text)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (Stack, {"heads": 0}, "heads must be 1 to 1048576, not 0"),
        (Stack, {"heads": 5}, ".* multiple of heads 5.*"),
        (ModelConfig, {"patch": 13}, ".* multiple of patch 13.*"),
        (ModelConfig, {"sensors": ("digit", "digit", "universal")}, ".* twice.*"),
        (ModelConfig, {"sensors": ("digit",)}, ".*universal.*"),
        (
            ModelConfig,
            {"decoder": Stack(18, 1, 2, 72)},
            "--model.decoder.width must be a multiple of 4 .*, not 18",
        ),
        (
            ModelConfig,
            {"dtype": "float16"},
            "--model.dtype must be one of float32, bfloat16, float64, not 'float16'",
        ),
        (LossConfig, {"alpha_vl": -0.2}, "--objective.alpha-vl must be 0 or more, not -0.2"),
        (
            OptimConfig,
            {"learning_rate": float("nan")},
            "--optim.learning-rate must be 0 or more, not nan",
        ),
        (OptimConfig, {"eps": 0.0}, r"--optim.eps must be 1.2e-38 or more \(float32\), not 0.0"),
        (
            DataConfig,
            {"jitter": (0.4, -0.1, 0.5, 0.3)},
            "--data.jitter must be 0 or more, not -0.1",
        ),
        (
            DataConfig,
            {"require": ("image", "txt")},
            r"--data.require\[1\] must be one of image, text, not 'txt'",
        ),
        (DataConfig, {"require": "image"}, "--data.require must be a list, not 'image'"),
        (RunConfig, {"steps": -5}, "--run.steps must be 1 or more, not -5"),
        (
            Config,
            {"towers": "pretraned"},
            "towers must be one of none, scratch, pretrained, not 'pretraned'",
        ),
        (Config, {"stage": "2"}, "stage must be one of 1, 2, not '2'"),
    ],
)
def test_settings_that_cannot_be_are_errors(kind, options, message):
    """From Python nothing else reads them: a slip would train something else."""
    config = preset("tiny")
    sound = {
        Config: config,
        ModelConfig: config.model,
        Stack: config.model.touch,
        TextTower: TextTower(Stack(8, 1, 2, 32)),
    }
    with pytest.raises(ConfigError, match=f"^{message}$"):
        replace(sound.get(kind) or kind(), **options)


@pytest.mark.parametrize(
    ("stage", "steps", "expected"),
    [(1, 1000, 50), (2, 1000, 83), (1, 19, 1), (2, 11, 1), (2, 1, 1), (2, 24, 2)],
)
def test_warm_up_is_a_twentieth_or_a_twelfth(stage, steps, expected):
    config = preset("tiny", stage=stage)
    config = replace(config, run=replace(config.run, steps=steps))
    assert config.warmup == expected
    assert replace(config, optim=replace(config.optim, warmup=7)).warmup == 7
    assert replace(config, optim=replace(config.optim, warmup=0)).warmup == 0


def parameters(config):
    head = config.model.match_head
    model = full_model(
        lora_rank=min(2, config.model.lora_rank), match_head=head, decoder_sensor_tokens=True
    )
    return flatten(build(model).abstract())


@pytest.mark.parametrize("recipe", ["paper", "release"])
def test_weight_decay_spares_vectors_only(recipe):
    config = preset("tiny", stage=2, recipe=recipe, towers="pretrained")
    leaves = parameters(config)
    decay = match_rules(config.weight_decay, leaves)
    assert set(decay.values()) == {0.0, 0.1}
    for name, leaf in leaves.items():
        # blocks and LoRA are stacked on axis 0: a vector of a block has two axes here
        stacked = "/blocks/" in name or name.startswith("lora/")
        vector = len(leaf.shape) - stacked <= 1
        # (1, 1, D) in the authors' code
        tokens = name in ("decoder/mask_token",)
        if name != "logit_scale":
            assert decay[name] == (0.0 if vector and not tokens else 0.1), name
    for name in (
        "touch/sensor_tokens",
        "touch/position",
        "decoder/mask_token",
        "lora/query/a",
        "lora/out/b",
    ):
        assert decay[name] == 0.1, name
    for name in (
        "touch/class_token",
        "touch/pre_norm/scale",
        "decoder/still_head/bias",
        "logit_scale",
    ):
        assert decay[name] == 0.0, name


def frozen(towers, recipe):
    config = preset("tiny", stage=2, recipe=recipe, towers=towers)
    return {name for name, value in match_rules(config.frozen, parameters(config)).items() if value}


def test_what_is_frozen():
    for recipe in ("paper", "release"):
        assert frozen("scratch", recipe) == {"decoder/position"}
    paper = frozen("pretrained", "paper")
    release = frozen("pretrained", "release")
    names = parameters(preset("tiny", stage=2, towers="pretrained"))
    text = {name for name in names if name.startswith("text/")}
    image = {name for name in names if name.startswith("image/")}
    blocks = {name for name in image if name.startswith("image/blocks/")}
    assert len(text) > 10 and len(blocks) > 10 and blocks < image
    assert paper == {"decoder/position"} | text | image
    # embeddings, norms and projection train fully
    assert release == {"decoder/position"} | text | blocks
    one = preset("tiny")
    assert {
        n for n, v in match_rules(one.frozen, flatten(build(one.model).abstract())).items() if v
    } == {"decoder/position"}


OLD = {  # settings of version 0.1, at values that changed nothing
    "model": {"force_head": False},
    "optim": {"ema": None, "clip_norm": 1.5},
    "objective": {
        "differences": 0.0,
        "force": 0.0,
        "touch_text_sum": False,
        "reconstruct": False,
        "universal_shared": False,
        "centre": True,
    },
    "data": {"split_steps": False},
}


def old_json(recipe="paper", **changes):
    """A config.json as version 0.1 wrote it; `changes` are section__name=value."""
    data = json.loads(to_json(preset("tiny", stage=2, recipe=recipe)))
    del data["objective"]["center_embeddings"], data["optim"]["grad_clip"]
    for section, part in OLD.items():
        data[section] |= part
    for name, value in changes.items():
        section, _, field = name.partition("__")
        data[section][field] = value
    return json.dumps(data)


def test_settings_of_an_older_version_are_read_under_their_new_names():
    config = from_json(old_json(), allow_retired=False)
    assert config.objective.center_embeddings and config.optim.grad_clip == 1.5
    release = {
        "objective__" + name: True for name in ("touch_text_sum", "reconstruct", "universal_shared")
    }
    config = from_json(old_json("release", **release, data__split_steps=True), allow_retired=False)
    assert config.recipe == "release" and config.splits_steps and config.reconstructs


@pytest.mark.parametrize(
    "change",
    [
        {"optim__ema": 0.9},
        {"objective__differences": 1.0},
        {"model__force_head": True},
        {"objective__reconstruct": True},
    ],
)
def test_a_retired_setting_with_an_effect_stops_a_run_but_not_an_encoder(change):
    text = old_json(**change)
    assert from_json(text).model == preset("tiny", stage=2).model
    section, _, name = next(iter(change)).partition("__")
    with pytest.raises(
        ConfigError, match=f"^the run sets {section}.{name} to .*, which this version no longer has"
    ):
        from_json(text, allow_retired=False)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 65 + "]" * 65, "levels"),
        ("1" * 5000, "5000 digits"),
        ('{"a": -Infinity}', "range"),
        ('"\\ud800"', "Unicode"),
        (b"\xff", "not JSON"),
    ],
)
def test_json_has_limits(text, words):
    with pytest.raises(ConfigError, match=words):
        parse_json(text)


def test_the_pages_name_the_default_of_the_background():
    pages = {name: (ROOT / "docs" / name).read_text() for name in ("train.md", "sensor.md")}
    assert f"the default is `--data.background {DataConfig().background}`" in pages["train.md"]
    assert "in training too" not in pages["sensor.md"]
