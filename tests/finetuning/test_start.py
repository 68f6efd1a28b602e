"""What fine-tuning starts from: whole groups held out, and scores that count each group once."""

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.tasks import TaskRows
from anytouch_jax.finetuning import start
from anytouch_jax.finetuning.start import Target


def rows_of(labels, groups, split="train"):
    labels = np.asarray(labels)
    count = len(labels)
    names = np.full(count, "x")
    split = np.broadcast_to(np.asarray(split), count)
    return TaskRows(np.arange(count)[:, None], labels, np.asarray(groups), split, names, names, ())


def test_whole_groups_are_held_out_of_every_class():
    labels = np.repeat(["a", "b", "c"], 40)
    groups = np.array([f"{label}{i // 4 % 10}" for i, label in enumerate(labels)])
    parts = start.deal_parts(rows_of(labels, groups), is_number=False)
    assert not set(groups[parts.fit]) & set(groups[parts.val])
    assert sorted([*parts.fit, *parts.val]) == list(range(120))
    assert set(labels[parts.val]) == {"a", "b", "c"}
    assert len(set(groups[parts.val])) == 6


def test_the_only_group_of_a_class_is_trained_on():
    labels = np.array(["a"] * 8 + ["b"] * 8 + ["alone"] * 4)
    groups = np.array(["1", "2", "3", "4"] * 4 + ["5"] * 4)
    groups[8:16] = np.char.add("b", groups[8:16])
    parts = start.deal_parts(rows_of(labels, groups), is_number=False)
    assert set(range(16, 20)) <= set(parts.fit)


def test_split_val_is_held_out_where_there_is_one():
    split = ["train"] * 6 + ["val"] * 2 + ["test"] * 2
    parts = start.deal_parts(rows_of(["a", "b"] * 5, list("0123456789"), split), is_number=False)
    assert parts.val.tolist() == [6, 7] and parts.test.tolist() == [8, 9]


def test_recordings_that_stand_alone_cannot_be_held_out():
    with pytest.raises(UserError, match="record each class twice"):
        start.deal_parts(rows_of(["a", "b", "c"], ["1", "2", "3"]), is_number=False)


def test_a_group_counts_once_and_confidence_does_not():
    target = Target(np.array([0, 1, 1, 1, 1]), np.array(["n", "y"]), np.array(list("aabbb")))
    outputs = np.array([[3.0, 0], [3, 0], [0, 1], [0, 1], [0, 1]])
    places = np.arange(5)
    one = start.held_score(outputs, target, places)
    assert one.shown == pytest.approx((0.5 + 1) / 2)
    again = start.held_score(2 * outputs, target, places)
    assert again.loss == pytest.approx(one.loss, abs=1e-4)


def test_ridge_agrees_with_its_equations():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((30, 4)).astype(np.float32)
    y = rng.standard_normal(30)
    for one in start._ridge_path(x, y, 0):
        z = ((x - x.mean(0)) / x.std(0)).astype(np.float64)
        wanted = np.linalg.solve(z.T @ z / 30 + one.penalty * np.eye(4), z.T @ (y - y.mean()) / 30)
        np.testing.assert_allclose(one.weights[:, 0], wanted, rtol=1e-3, atol=1e-6)
        assert one.bias[0] == pytest.approx(y.mean(), rel=1e-5)


def test_training_starts_from_a_firm_penalty():
    rng = np.random.default_rng(1)
    y = np.arange(60) % 3
    x = (np.eye(3)[y] + 0.3 * rng.standard_normal((60, 3))).astype(np.float32)
    groups = np.array([str(i // 3) for i in range(60)])
    target = Target(y, np.array(["a", "b", "c"]), groups)
    parts = start.Parts(np.arange(45), np.arange(45, 60), np.arange(0), "")
    found = start.linear_start(x, target, parts)
    assert found.first.penalty >= start.FIRM
    assert found.score == start.held_score(found.linear(x[45:]), target, parts.val)
