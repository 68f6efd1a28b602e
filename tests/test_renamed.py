"""Old names work, say what they are called now, and give what the new ones give."""

import json
from dataclasses import replace

import numpy as np
import pytest

import anytouch_jax as at
from anytouch_jax import renamed
from anytouch_jax.cli.app import main
from anytouch_jax.config import from_json, preset, to_json


def old(name):
    return pytest.warns(DeprecationWarning, match=rf"{name}.* is called .*leaves in version 0.4")


def test_an_old_keyword_gives_what_the_new_one_gives():
    encoder = at.load_encoder("anytouch-tiny")
    clip = np.random.default_rng(0).integers(0, 255, (1, 6, 112, 112, 3), dtype=np.uint8)
    with old("join="):
        features = encoder.encode_touch(clip, "digit", join="concat")
    np.testing.assert_array_equal(
        features, encoder.encode_touch(clip, "digit", aggregation="concat")
    )
    with old("encoder.gels"):
        assert encoder.gels == encoder.backgrounds


def test_old_values_of_a_protocol_are_understood():
    rng = np.random.default_rng(0)
    labels = np.repeat([0, 1], 40)
    features = rng.standard_normal((80, 3)).astype(np.float32) + labels[:, None]
    split = np.tile(["train", "train", "val", "test"], 20)
    given = (features, labels, np.arange(80), split)
    new = at.probe_features(*given, protocol="released", seeds=1)
    with old("protocol 'published'"):
        assert at.probe_features(*given, protocol="published", seeds=1) == new
    with old("measured="):
        number = at.probe_features(*given, measured=True)
    assert number == at.probe_features(*given, regression=True)


def test_a_setting_has_its_old_name_in_code_and_in_files():
    with old("clip_share"):
        data = at.DataConfig(clip_share=0.25)
    with old("clip_share"):
        assert data.clip_share == data.clip_fraction == 0.25
    text = json.loads(to_json(replace(preset("tiny"), data=data)))
    text["data"]["clip_share"] = text["data"].pop("clip_fraction")
    assert from_json(json.dumps(text)).data == data


def test_words_of_the_command_line_have_their_old_names():
    told = []
    words = [
        "--join",
        "sum",
        "--data.clip_share=0.1",
        "--protocol",
        "honest",
        "--data",
        "--x",
        "honest",
    ]
    today = renamed.words(words, told.append)
    wanted = "--aggregation sum --data.clip-fraction=0.1 --protocol grouped --data --x honest"
    assert today == wanted.split()
    assert len(told) == 3 and told[0].startswith("--join is called --aggregation now")
    assert renamed.words(["--protocol=published"], told.append) == ["--protocol=released"]


def test_a_command_says_what_an_old_option_is_called(tmp_path, capsys):
    missing = str(tmp_path / "none.csv")
    assert main(["data", "contact", missing, "--share", "0.6", "--out", "x.csv"])
    errors = capsys.readouterr().err
    assert "--share is called --fraction now" in errors and "none.csv" in errors


@pytest.mark.parametrize("name", sorted(renamed.ATTRIBUTES))
def test_an_old_module_has_its_old_names(name):
    with old(name):
        found = renamed.moved("anytouch_jax.data.gels")(name)
    assert found.__name__ == renamed.ATTRIBUTES[name]
