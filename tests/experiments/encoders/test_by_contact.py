"""Training by contact: where contact is, which patches it hides, and what a training records."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from touch_world import make_touches

from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Stack, preset
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from experiments.encoders import by_contact
from experiments.encoders.by_contact import WAYS, ContactOptions, Stills, contact_of, squares, weighted_loss
from experiments.records import read_records


@pytest.fixture(scope="module")
def small():
    whole = preset("tiny")
    config = replace(whole, model=replace(whole.model, image_size=28, patch=7, touch=Stack(16, 1, 2, 32)))
    net = build(config.model)
    return net, net.init(jax.random.key(0)), config


@pytest.fixture(scope="module")
def touched():
    """A batch of stills whose left half differs from the gel."""
    clip = np.full((4, 1, 28, 28, 3), 128, np.uint8)
    clip[..., :14, 1] += 20
    return TouchBatch(clip, np.zeros(4, np.int32))


def test_a_patch_has_contact_if_it_differs_from_the_gel(touched, monkeypatch):
    monkeypatch.setattr(by_contact, "PATCH", 7)
    wanted = np.tile([True, True, False, False], (4, 4))
    np.testing.assert_array_equal(contact_of(touched.clip), wanted)
    assert not contact_of(np.full_like(touched.clip, 131)).any(), "noise of three grey levels is no contact"


def test_the_plain_way_is_the_loss_of_the_paper_and_weights_favour_contact(small, touched):
    net, params, config = small
    key = jax.random.key(1)
    error, hidden = squares(params, touched, jax.random.uniform(key, (4, 16)), net=net, config=config)
    contact = contact_of(touched.clip)
    losses = {
        way: weighted_loss(params, touched, key, np.float32(0), net=net, config=config, way=way)[0] for way in WAYS
    }
    assert losses["as in the paper"] == pytest.approx(float((error * hidden).sum() / hidden.sum()), rel=1e-6)
    weights = hidden * (1 + 3 * contact)
    assert losses["contact counts more"] == pytest.approx(float((error * weights).sum() / weights.sum()), rel=1e-6)
    assert len({round(float(loss), 7) for loss in losses.values()}) == len(WAYS)


def test_patches_with_contact_are_hidden_more_often(small, touched):
    net, params, config = small
    contact, shares = contact_of(touched.clip), []
    for more in (0.0, 0.4):
        noise = np.random.default_rng(0).random((4, 16)).astype(np.float32) + more * np.asarray(contact)
        _, hidden = squares(params, touched, noise.astype(np.float32), net=net, config=config)
        assert int(hidden.sum()) == 4 * 12, "the number of hidden patches stays"
        shares.append(float((hidden * contact).sum() / contact.sum()))
    assert shares[1] > shares[0]


def test_recall_finds_the_other_frame_of_a_touch_by_the_same_sensor():
    rng = np.random.default_rng(0)
    deep = rng.standard_normal((6, 8))
    held = Stills(np.zeros((6, 2, 2, 3), np.uint8), np.zeros((6, 2, 2, 3), np.uint8), np.array([0, 0, 0, 1, 1, 1]))
    assert by_contact.recall(np.concatenate([deep, deep + 0.01]), held) == 1.0
    assert by_contact.recall(np.concatenate([deep, deep[[1, 2, 0, 3, 4, 5]]]), held) == 0.5


def test_a_training_of_each_way_is_recorded(tmp_path, monkeypatch):
    monkeypatch.setattr(by_contact, "SIDE", 28)
    data = make_touches(tmp_path / "touches", touches={"train": 4, "val": 2}, frames=3)
    options = ContactOptions(data, steps=2, every=1, out=tmp_path / "lines.jsonl")
    assert by_contact.run(options) == 0
    records = read_records(options.out)
    assert {one["way"] for one in records.values()} == {*WAYS}
    for one in records.values():
        assert one["touches"] == [12, 6] and [row[0] for row in one["curve"]] == [1, 2]
        assert all(0 < row[1] < 10 and 0 <= row[3] <= 1 for row in one["curve"])


def test_a_manifest_without_the_split_is_refused(tmp_path):
    data = make_touches(tmp_path / "touches", touches={"train": 2})
    with pytest.raises(UserError, match="no recordings of the splits val, test"):
        by_contact.read_stills(data, ("digit", "gelsight", "gelslim"), ("val", "test"))
