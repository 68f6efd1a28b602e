from dataclasses import replace

import jax
import numpy as np
import pytest
from refused import refused
from runs import run_config
from tiny_models import full_model
from touch_world import make_touches

from anytouch_jax.config import to_json
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.weights import checkpoint, convert, safetensors
from experiments.compare import run
from experiments.image_tower import image_tower_encoder
from experiments.records import read_records
from tests.support.release_keys import release_names
from tests.weights.test_start import mae


@pytest.fixture(scope="module")
def encoder(tmp_path_factory):
    return mae(tmp_path_factory.mktemp("file") / "mae")


def test_files_are_probed_by_both_protocols_and_the_page_is_the_users_own(
    encoder, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    data = make_touches(tmp_path / "data", touches={"train": 4, "val": 2, "test": 4}, each=1)
    out = tmp_path / "runs" / "compare" / "compare.jsonl"
    options = run.Options(encoders=(f"mine={encoder}",), data=(data,), label="hardness")
    assert run.run(options) == 0, capsys.readouterr().err
    records = read_records(out)
    assert {record.get("protocol") for record in records.values()} == {"grouped", "released", None}
    text = out.with_suffix(".md").read_text()
    assert not (tmp_path / "experiments").exists()
    assert (
        "linear, grouped, %" in text
        and "kNN, released, %" in text
        and "| mine | 1 | 28 x 28 |" in text
    )
    refused("add DATA", run.run, run.Options(encoders=("mine=x",), out=out))
    refused("NAME=FILE", run.run, run.Options(encoders=("mine",), data=(data,), out=out))
    refused("no family", run.run, run.Options(only=("Nothing",), out=out))


RNG = np.random.default_rng(0)
STILLS = RNG.integers(0, 256, (2, 28, 28, 3), np.uint8)


def stored(folder, config, params):
    saver = checkpoint.Checkpoints(
        folder / "checkpoints", keep=1, config_json=to_json(config), metadata={}
    )
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
        params["lora"] = jax.tree.map(
            lambda x: np.asarray(RNG.standard_normal(x.shape), np.float32), params["lora"]
        )
    encoder = image_tower_encoder(stored(tmp_path, config, params))
    wanted = net.encode_image(params, normalise_touch(STILLS))
    np.testing.assert_allclose(encoder.encode_touch(STILLS, "digit"), wanted, atol=2e-5)
    # it knows no sensors
    for sensor in ("universal", "gelsight"):
        np.testing.assert_array_equal(
            encoder.encode_touch(STILLS, sensor), encoder.encode_touch(STILLS, "digit")
        )
    assert "image tower" in encoder.source


def test_the_tower_of_clip_weights(tmp_path):
    model = replace(full_model(), match_head="linear")
    params = build(model).init(jax.random.key(9))
    full = convert.to_release(params, model)
    keys = release_names(model, "clip")
    file = tmp_path / "clip.safetensors"
    safetensors.write_safetensors(
        file, {key: full[key] for key in keys}, {safetensors.MODEL_KEY: to_json(model)}
    )
    wanted = build(model).encode_image(params, normalise_touch(STILLS))
    np.testing.assert_allclose(image_tower_encoder(file).encode_touch(STILLS), wanted, atol=2e-5)


def test_a_run_without_an_image_tower_is_one_sentence(tmp_path):
    config = run_config(tmp_path)
    run = stored(tmp_path / "r", config, build(config.model).init(jax.random.key(0)))
    refused("has no image tower; give a stage-2 run", image_tower_encoder, run)
    refused("no run folder or weights file", image_tower_encoder, tmp_path / "gone")
