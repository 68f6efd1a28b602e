"""A further objective in two files: its own, and a row in `doors.OBJECTIVES`."""

import json
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from runs import read_metrics, run_config, train
from tiny_models import tiny_config

import anytouch_jax
from anytouch_jax import doors, objectives
from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import from_json, preset, to_json
from anytouch_jax.errors import ConfigError, UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.train.optim import match_rules
from anytouch_jax.weights.tree import flatten

# The first file.
SHORT = """
import jax
import jax.numpy as jnp

from anytouch_jax.objectives import Objective, normalise_touch


def term(params, batch, key, progress, *, net, config):
    if batch.clip.shape[1] > 1:
        return None
    noise = 1e-3 * jax.random.normal(key, batch.clip.shape)
    z = net.encode_touch(params, normalise_touch(batch.clip) + noise, batch.sensor)
    length = jnp.mean(jnp.square(z))
    return length, {"short": length}


def trains(batch):
    return ("^touch/",) if batch.clip.shape[1] == 1 else ()


OBJECTIVE = Objective(term, trains)
"""


@pytest.fixture
def short(tmp_path, monkeypatch):
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "short_embeddings.py").write_text(SHORT)
    monkeypatch.setattr(
        anytouch_jax, "__path__", [*anytouch_jax.__path__, str(tmp_path / "package")]
    )
    # The second file.
    monkeypatch.setitem(doors.OBJECTIVES, "short", doors.Door("short_embeddings:OBJECTIVE"))


def test_a_new_objective_trains_by_one_file_and_one_row(short, world, tmp_path):
    plain = run_config(world)
    config = plain.with_settings({"objective.terms": (("short", 0.5),)})
    before = train(plain, tmp_path / "plain")
    after = train(config, tmp_path / "short")
    lines = read_metrics(tmp_path / "short")
    assert ["short" in line for line in lines] == [True, False, True, False]
    for line in lines:
        wanted = line["reconstruction"] + line.get("next_frame", 0) + 0.5 * line.get("short", 0)
        assert line["loss"] == pytest.approx(wanted, rel=1e-6)
    # The draws of the stage are the same: the first step has the same reconstruction.
    first = read_metrics(tmp_path / "plain")[0]
    assert first["reconstruction"] == pytest.approx(lines[0]["reconstruction"], rel=1e-6)
    # Stage 1 alone never trains the last norm. The new objective does, on stills.
    norms = [flatten(one.params)["touch/post_norm/scale"] for one in (before, after)]
    assert np.all(norms[0] == 1) and np.any(norms[1] != 1)
    assert [count["touch/post_norm/scale"] for count in map(_counts, (before, after))] == [0, 2]
    assert from_json((tmp_path / "short" / "config.json").read_text()).objective.terms == (
        ("short", 0.5),
    )


def _counts(result):
    names = flatten(result.state.trainable)
    return dict(zip(names, np.asarray(result.state.opt_state.counts), strict=True))


def test_the_weight_scales_the_term_and_its_own_draws_differ_from_the_stage(short):
    config = tiny_config(1)
    net = build(config.model)
    params = net.init(jax.random.key(0))
    batch = TouchBatch(
        np.random.default_rng(0).integers(0, 255, (2, 1, 28, 28, 3), np.uint8),
        np.zeros(2, np.int32),
    )

    def loss(*terms):
        own = config.with_settings({"objective.terms": terms})
        stage1 = partial(objectives.stage1_loss, net=net, config=own)
        loss, metrics = jax.jit(stage1)(params, batch, jax.random.key(3), 0.5)
        return float(loss), float(metrics.get("short", 0))

    plain, _ = loss()
    once, short_term = loss(("short", 1.0))
    thrice, _ = loss(("short", 3.0))
    assert once - plain == pytest.approx(short_term, rel=1e-4)
    assert thrice - plain == pytest.approx(3 * short_term, rel=1e-4)


def test_rules_of_an_objective_come_first_and_only_for_its_batches(short):
    config = tiny_config(1).with_settings({"objective.terms": (("short", 1.0),)})
    names = ["touch/post_norm/scale", "decoder/still_head/kernel", "touch/patch/kernel"]
    still = TouchBatch(np.zeros((2, 1, 28, 28, 3), np.uint8), np.zeros(2, np.int32))
    clip = TouchBatch(np.zeros((2, 4, 28, 28, 3), np.uint8), np.zeros(2, np.int32))
    trained = [match_rules(objectives.trained_by(b, config=config), names) for b in (still, clip)]
    assert list(trained[0].values()) == [True, True, True]
    assert list(trained[1].values()) == [False, False, True]


def test_an_unknown_objective_is_one_sentence_before_anything_is_made(world, tmp_path):
    config = run_config(world).with_settings({"objective.terms": (("shrot", 1.0),)})
    with pytest.raises(UserError, match=r"'shrot', which is no objective.*fields"):
        train(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("terms", "told"),
    [
        ((("a", 1.0), ("a", 2.0)), "twice"),
        ((("fields", 1.0),), "--objective.field-weight"),
        ((("a", -1.0),), "0 or more"),
    ],
)
def test_wrong_terms_are_refused(terms, told):
    with pytest.raises(ConfigError, match=told):
        preset("tiny").with_settings({"objective.terms": terms})


def test_the_metrics_of_two_objectives_do_not_overwrite_each_other(short, monkeypatch):
    def taken(params, batch, key, progress, *, net, config):
        return 0.0, {"reconstruction": 0.0}

    twice = objectives.Objective(taken, lambda batch: ())
    monkeypatch.setattr(objectives, "find_objective", lambda name: twice)
    config = tiny_config(1).with_settings({"objective.terms": (("short", 1.0),)})
    net = build(config.model)
    batch = TouchBatch(np.zeros((2, 1, 28, 28, 3), np.uint8), np.zeros(2, np.int32))
    stage1 = partial(objectives.stage1_loss, net=net, config=config)
    with pytest.raises(ConfigError, match="gives reconstruction a second time"):
        jax.eval_shape(stage1, net.abstract(), batch, jax.random.key(0), 0.0)


def test_an_older_configuration_has_no_further_terms_and_no_residual():
    config = preset("tiny")
    older = json.loads(to_json(config))
    del older["objective"]["terms"], older["objective"]["next_frame_residual"]
    assert from_json(json.dumps(older)) == config
    assert config.objective.terms == () and not config.objective.next_frame_residual
    for stage in (1, 2):
        for recipe in ("paper", "release"):
            assert not preset("tiny", stage=stage, recipe=recipe).objective.next_frame_residual


def touches(frames, seed=0):
    rng = np.random.default_rng(seed)
    clip = rng.normal(size=(3, frames, 28, 28, 3)).astype(np.float32)
    return clip, np.zeros(3, np.int32), rng.uniform(size=(3, 16)).astype(np.float32)


@pytest.mark.parametrize("norm", [False, True])
def test_the_residual_begins_as_a_copy_of_the_last_frame(norm):
    """A decoder that predicts no change copies the last frame. Other frames are as they were."""
    config = tiny_config(1).with_settings({"objective.norm_pix_loss": norm})
    residual = config.with_settings({"objective.next_frame_residual": True})
    net = build(config.model)
    params = net.init(jax.random.key(0))
    clip, sensor, noise = touches(4)

    def terms(config, params, clip):
        stage1 = partial(objectives.stage1_terms, net=net, config=config)
        return jax.jit(stage1)(params, clip, sensor, noise)[1]

    head = dict(params["decoder"]["clip_head"])
    pixels = 7 * 7 * 3
    head["kernel"] = head["kernel"].at[:, 3 * pixels :].set(0)
    none = params | {"decoder": params["decoder"] | {"clip_head": head}}
    # the next frame equals the last one: no error is left
    copied = np.concatenate([clip[:, :3], clip[:, 2:3]], axis=1)
    assert terms(residual, none, copied)["next_frame"] < 1e-10
    assert terms(config, none, copied)["next_frame"] > 0.1
    for name in ("reconstruction",):
        assert terms(residual, params, clip)[name] == terms(config, params, clip)[name]
    # a still has no next frame
    still = touches(1)[0]
    assert terms(residual, params, still) == terms(config, params, still)


def test_a_residual_is_learned_where_the_next_frame_is_the_last_one(world, tmp_path):
    config = run_config(world, steps=2).with_settings({"data.clip_fraction": 1.0})
    losses = []
    for residual in (False, True):
        own = config.with_settings({"objective.next_frame_residual": residual})
        train(own, tmp_path / str(residual))
        losses.append([line["next_frame"] for line in read_metrics(tmp_path / str(residual))])
    assert losses[0] != losses[1]


def test_a_residual_without_a_next_frame_is_refused():
    with pytest.raises(ConfigError, match=r"needs --objective\.next-frame"):
        replace(preset("tiny").objective, next_frame=False, next_frame_residual=True)
