"""Forms of AdamW: all forms give the same update, and each is stored in its own type and trained."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from touch_world import make_touches

from anytouch_jax.config import Stack, preset
from anytouch_jax.nn.functional import build
from experiments.benchmarks import optimiser
from experiments.benchmarks.optimiser import HALF, WAYS
from experiments.records import read_records


@pytest.fixture(scope="module")
def small():
    """A preset of few parameters."""
    whole = preset("tiny")
    return replace(whole, model=replace(whole.model, image_size=28, touch=Stack(16, 1, 2, 32)))


@pytest.fixture(scope="module")
def updates(small):
    """Parameters and state after one update by each way, and the facts of its program."""
    params = jax.device_get(build(small.model).init(jax.random.key(0)))
    found = {}
    for way in WAYS:
        call, facts = optimiser.update_of(way, small, jax.device_put(params))
        found[way.name] = (*jax.device_get(call()), facts)
    return params, found


def flat(tree):
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


def test_all_forms_of_our_update_give_the_same_parameters(updates):
    start, found = updates
    ours = flat(found[WAYS[0].name][0])
    assert np.abs(ours - flat(start)).max() > 0
    for way in WAYS:
        if not way.optax and way.mu != HALF:
            np.testing.assert_allclose(flat(found[way.name][0]), ours, rtol=1e-6, atol=1e-8, err_msg=way.name)


def test_moments_are_stored_in_the_type_of_their_way(updates):
    _, found = updates
    for way in WAYS:
        if not way.optax:
            state = found[way.name][1]
            kinds = {x.dtype for x in state.mu}, {x.dtype for x in state.nu}
            assert kinds == ({np.dtype(way.mu)}, {np.dtype(way.nu)}), way.name
    sizes = [found[name][2]["state_bytes"] for name in ("ours: small arrays packed", "both moments in bfloat16")]
    assert sizes[1] < 0.51 * sizes[0]


def test_a_record_has_times_of_all_ways_and_losses_of_those_that_train(tmp_path, monkeypatch, small):
    monkeypatch.setattr(optimiser, "preset", lambda name: small)
    monkeypatch.setattr(optimiser, "SIDE", 28)
    data = make_touches(tmp_path / "touches", touches={"train": 4})
    options = optimiser.OptimiserOptions(data, ("tiny",), rounds=1, steps=3, seeds=1, out=tmp_path / "lines.jsonl")
    assert optimiser.run(options) == 0
    records = read_records(options.out)
    assert {*records} == {way.name for way in WAYS} and all(one["tiny"]["ms"] > 0 for one in records.values())
    trained = {way.name for way in WAYS if way.mu == HALF} | {WAYS[0].name}
    assert {name for name, one in records.items() if "loss" in one} == trained
    assert records[WAYS[0].name]["loss_ratio"] == [1.0]
