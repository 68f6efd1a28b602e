"""Probes on data whose answer is known: what they find, what they must not find, what they say when they cannot."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import probe_models, probe_rows
from anytouch_jax.evaluate.probe import knn_probe, leave_groups_out, linear_probe, majority, regression_probe

Array = np.ndarray[Any, Any]


def table(
    *, groups: int = 60, each: int = 5, classes: int = 3, apart: float = 6.0, val: bool = True, seed: int = 0
) -> tuple[Array, Array, Array, Array]:
    """Gaussian blobs, `apart` standard deviations from the origin: features, labels, groups, split."""
    rng = np.random.default_rng(seed)
    group = np.repeat(np.arange(groups), each)
    label = group % classes
    centres = apart * np.eye(classes, 8)
    features = (centres[label] + rng.normal(size=(len(label), 8))).astype(np.float32)
    third = (group // classes) % 6
    split = np.where(third < 3, "train", np.where((third == 3) & val, "val", "test"))
    return features, np.array(["ball", "cube", "ring", "rod"])[label], group, split


PROBES = [linear_probe, knn_probe]
EITHER = pytest.mark.parametrize("probe", PROBES)


@EITHER
@pytest.mark.parametrize("val", [True, False])
def test_separable_blobs_reach_one(probe: Any, val: bool) -> None:
    result = probe(*table(val=val, apart=9.0))
    assert result.accuracy == result.balanced_accuracy == result.refit_mean == 1.0
    assert (result.low, result.high) == (1.0, 1.0)
    assert result.chosen_on == ("val" if val else "cross-validation")
    assert result.classes == ("ball", "cube", "ring")
    assert (result.n_train, result.n_test, result.test_groups) == ((165, 90, 18) if val else (165, 135, 27))


@EITHER
def test_shuffled_labels_give_chance(probe: Any) -> None:
    features, labels, groups, split = table(groups=240)
    labels = np.random.default_rng(1).permutation(240)[groups] % 3
    result = probe(features, labels, groups, split)
    assert result.low <= 1 / 3 <= result.high
    assert abs(result.accuracy - 1 / 3) < 0.12


@EITHER
@pytest.mark.parametrize("val", [True, False])
def test_the_choice_never_looks_at_test(probe: Any, val: bool) -> None:
    features, labels, groups, split = table(apart=1.5, val=val)
    test = split == "test"
    plain = probe(features, labels, groups, split)
    other, moved = labels.copy(), features.copy()
    other[test] = np.random.default_rng(3).permutation(labels[test])
    moved[test] += 5.0
    assert probe(moved, other, groups, split).penalty == plain.penalty
    assert probe(features, other, groups, split).accuracy < plain.accuracy


def test_only_the_published_protocol_follows_the_labels_of_test() -> None:
    features, labels, groups, split = table(apart=1.0)
    y = np.unique(labels, return_inverse=True)[1]
    train, test = split == "train", split == "test"
    choices: dict[str, list[float]] = {"honest": [], "published": []}
    for penalty in (10.0, 1e-4):  # labels of test as this very fit would have them
        written = y.copy()
        written[test] = probe_models.Linear(features[train], y[train], penalty)(features[test])
        for protocol, chosen in choices.items():
            arguments = (features, written, groups, split)
            chosen.append(linear_probe(*arguments, penalties=(10.0, 1e-4), protocol=protocol).penalty)  # type: ignore
    assert choices["published"] == [10.0, 1e-4]
    assert choices["honest"][0] == choices["honest"][1]


@pytest.mark.parametrize("penalties", [(), (0.0, 1.0), (-1.0,)])
def test_penalties_are_above_nought(penalties: tuple[float, ...]) -> None:
    with pytest.raises(UserError, match="penalties and numbers of neighbours are above 0, at least one of them, not"):
        linear_probe(*table(apart=1.0), penalties=penalties)


def test_the_published_choice_is_the_best_on_test() -> None:
    features, labels, groups, split = table(apart=1.0)
    penalties = (30.0, 1.0, 0.01, 1e-5)
    single = [linear_probe(features, labels, groups, split, penalties=[p], seeds=0).accuracy for p in penalties]
    result = linear_probe(features, labels, groups, split, penalties=penalties, protocol="published", seeds=0)
    assert result.accuracy == pytest.approx(max(single), abs=1 / 100)  # another start, the same optimum
    assert result.protocol == "published"
    assert any("upper estimate" in note for note in result.notes)


def test_val_decides_the_penalty() -> None:
    features, labels, groups, split = table(groups=120, apart=1.0)
    penalties = (30.0, 1.0, 0.01, 1e-5)
    on_val = np.where(split == "val", "test", np.where(split == "test", "unused", split))
    scores = [linear_probe(features, labels, groups, on_val, penalties=[p], seeds=0).accuracy for p in penalties]
    chosen = linear_probe(features, labels, groups, split, penalties=penalties, seeds=0).penalty
    assert scores[penalties.index(chosen)] == pytest.approx(max(scores), abs=0.02)


def test_a_penalty_means_the_same_for_any_number_of_rows() -> None:
    features, labels, _, _ = table(apart=1.0)
    y = np.unique(labels, return_inverse=True)[1]
    once = probe_models.Linear(features, y, 0.1)
    thrice = probe_models.Linear(np.tile(features, (3, 1)), np.tile(y, 3), 0.1)
    weighted = probe_models.Linear(features, y, 0.1, weights=np.full(len(y), 3.0, np.float32))
    assert once.fit and thrice.fit and weighted.fit
    np.testing.assert_allclose(thrice.fit.weights, once.fit.weights, atol=2e-3)
    np.testing.assert_allclose(weighted.fit.weights, once.fit.weights, atol=2e-3)


def test_a_row_that_counts_twice_is_a_row_given_twice() -> None:
    features, labels, _, _ = table(apart=1.0)
    y = np.unique(labels, return_inverse=True)[1]
    for names in (y, y % 2):  # many classes, and two
        times = np.random.default_rng(0).integers(0, 4, len(names))
        counted = probe_models.Linear(features, names, 0.1, weights=times.astype(np.float32)).fit
        given = probe_models.Linear(np.repeat(features, times, 0), np.repeat(names, times), 0.1).fit
        assert counted and given and counted.loss == pytest.approx(given.loss, abs=1e-5)
        np.testing.assert_allclose(counted.weights, given.weights, atol=5e-3)


def test_logistic_regression_is_at_its_optimum() -> None:
    features, labels, _, _ = table(apart=1.0)
    y = np.unique(labels, return_inverse=True)[1]
    model = probe_models.Linear(features, y, 0.1)
    x = (features - features.mean(0)) / features.std(0)
    assert model.fit
    logits = x @ model.fit.weights + model.fit.bias
    share = np.exp(logits - logits.max(1, keepdims=True))
    share /= share.sum(1, keepdims=True)
    gradient = (share - np.eye(3)[y]).T @ x / len(y) + 0.1 * model.fit.weights.T
    assert np.abs(gradient).max() < 5e-3


def test_standardising_is_fitted_on_train() -> None:
    features, labels, groups, split = table(apart=2.0)
    wild = features.copy()
    wild[split == "test"] *= 1e4  # changes nothing for the fit
    a, b = (linear_probe(x, labels, groups, split, seeds=0) for x in (features, wild))
    assert a.penalty == b.penalty
    scaled = linear_probe(features * 1e3 + 7.0, labels, groups, split, seeds=0)
    assert scaled.accuracy == pytest.approx(a.accuracy, abs=0.011)


def test_common_scaling_keeps_the_ranking_of_components() -> None:
    features, labels, groups, split = table(groups=30, apart=3.0)
    noise = 1e-3 * np.random.default_rng(5).normal(size=(len(features), 300)).astype(np.float32)
    wide = np.concatenate([features, noise], axis=1)
    column, common = (
        linear_probe(wide, labels, groups, split, scaling=one, penalties=[0.1], seeds=0).accuracy
        for one in ("column", "common")
    )
    assert common > column + 0.1


def test_a_constant_feature_is_harmless() -> None:
    features, labels, groups, split = table()
    features[:, 7] = 1234.5
    assert linear_probe(features, labels, groups, split).accuracy == 1.0


@EITHER
def test_classes_that_train_lacks_count_as_errors(probe: Any) -> None:
    features, labels, groups, split = table(apart=9.0)
    test = np.flatnonzero(split == "test")
    labels = labels.astype(object)
    labels[test[:30]] = "sponge"
    result = probe(features, labels, groups, split)
    assert result.accuracy == pytest.approx(2 / 3)
    assert result.balanced_accuracy == pytest.approx(3 / 4)  # four classes in test, one of them never right
    assert "sponge" not in result.classes
    assert result.notes == ("30 test rows of classes that train lacks count as errors: sponge",)


def test_a_group_that_gives_the_label_away_does_not_help_on_other_groups() -> None:
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(24), 10)
    label = rng.permutation(24)[group] % 2
    identity = 5 * np.eye(24)[group] + 0.1 * rng.normal(size=(240, 24))
    inside = np.where(np.arange(240) % 10 < 5, "train", "test")  # every group on both sides
    leaky = linear_probe(identity, label, group, inside)
    assert leaky.accuracy == 1.0
    assert any(note.startswith("24 groups lie in both train and test") for note in leaky.notes)
    honest = leave_groups_out(identity, label, group, folds=6)
    assert honest.accuracy < 0.62
    assert honest.test_groups == 24
    assert honest.n_test == 240


def test_groups_left_out_still_find_what_generalises() -> None:
    features, labels, groups, _ = table(groups=24, apart=9.0)
    for folds in (5, None):
        result = leave_groups_out(features, labels, groups, folds=folds)
        assert result.accuracy == 1.0
        assert result.baseline < 0.4


def test_groups_left_out_are_told_apart_by_what_was_described() -> None:
    features, labels, groups, _ = table(groups=24, apart=0.8)
    named = np.isin(groups, np.unique(groups)[:8])
    result = leave_groups_out(features, labels, groups, subsets={"named": named, "others": ~named})
    assert [part.n_test for part in result.parts] == [named.sum(), (~named).sum()]
    whole = sum(part.accuracy * part.n_test for part in result.parts) / len(labels)
    assert whole == pytest.approx(result.accuracy) and 0.4 < result.accuracy < 1


@pytest.mark.parametrize("count", [2, 5, 7, 100])
def test_folds_keep_groups_whole_and_spread_classes(count: int) -> None:
    features, labels, groups, _ = table(groups=30)
    rows = probe_rows.prepare(features, labels, groups, np.full(len(labels), "train"), tested=False)
    seen = []
    for fit, out in probe_rows.folded(rows, rows.train, count):
        assert set(groups[fit]).isdisjoint(groups[out])
        assert len(fit) + len(out) == len(groups)
        if count == 5:
            assert np.bincount(rows.y[out]).tolist() == [10, 10, 10]
        seen.append(out)
    assert len(seen) == min(count, 30)
    np.testing.assert_array_equal(np.sort(np.concatenate(seen)), np.arange(len(groups)))


@EITHER
def test_the_same_call_gives_the_same_numbers(probe: Any) -> None:
    arguments = table(apart=1.5, val=False)
    assert probe(*arguments) == probe(*arguments)


@EITHER
def test_rows_outside_the_splits_and_order_of_rows_do_not_matter(probe: Any) -> None:
    features, labels, groups, split = table(apart=1.5)
    plain = probe(features, labels, groups, split, seeds=0)
    extra = (np.full((9, 8), np.nan), np.full(9, "ball"), np.full(9, 0), np.full(9, "background"))
    more = [np.concatenate(pair) for pair in zip((features, labels, groups, split), extra, strict=True)]
    order = np.random.default_rng(0).permutation(len(more[0]))
    mixed = probe(*(one[order] for one in more), seeds=0)
    assert mixed.accuracy == pytest.approx(plain.accuracy, abs=0.011)
    assert (mixed.penalty, mixed.n_train, mixed.n_test) == (plain.penalty, plain.n_train, plain.n_test)


@pytest.mark.parametrize("kind", ["text", "int", "float", "object"])
def test_kinds_of_labels(kind: str) -> None:
    features, labels, groups, split = table()
    numbers = np.unique(labels, return_inverse=True)[1]
    given = {
        "text": labels,
        "int": numbers,
        "float": numbers.astype(float),
        "object": np.array([None if i in (0, 1) else int(n) for i, n in enumerate(numbers)], object),
    }[kind]
    result = linear_probe(features, given, groups, split)
    assert result.accuracy == 1.0
    assert result.classes == (("ball", "cube", "ring") if kind == "text" else ("0", "1", "2"))
    assert result.n_train == (163 if kind == "object" else 165)
    assert result.notes[:1] == (("2 rows without this label left out",) if kind == "object" else result.notes[:1])


def test_majority_and_baseline_agree() -> None:
    features, labels, groups, split = table(apart=0.0)
    labels = np.where(groups % 5 == 0, "rare", "common")
    expected = float(np.mean(labels[split == "test"] == "common"))
    assert majority(labels, groups, split).accuracy == expected
    assert linear_probe(features, labels, groups, split).baseline == expected
    assert majority(np.full(len(labels), "one"), groups, split).accuracy == 1.0


def test_parts_of_the_test_rows() -> None:
    features, labels, groups, split = table(apart=9.0)
    features[(split == "test") & (labels == "cube")] = features[(split == "train") & (labels == "ring")][0]
    cube = labels == "cube"
    result = linear_probe(features, labels, groups, split, subsets={"cube": cube, "rest": ~cube, "none": cube & ~cube})
    wrong, right, none = result.parts
    assert (wrong.name, wrong.accuracy, right.accuracy) == ("cube", 0.0, 1.0)
    assert wrong.n_test + right.n_test == result.n_test
    assert (none.n_test, none.low) == (0, None)


# ---- nearest neighbours ------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [1, 5, 20])
@pytest.mark.parametrize("columns", [3, 20, 700, 3001])
def test_nearest_equals_sorting_everything(k: int, columns: int) -> None:
    rng = np.random.default_rng(0)
    train, scored = (rng.normal(size=(n, 16)).astype(np.float32) for n in (columns, 9))
    ids, cosines = probe_models.nearest(train, scored, k)
    expected = np.argsort(-(scored @ train.T), axis=1)[:, :k]
    np.testing.assert_array_equal(ids, expected)
    np.testing.assert_allclose(cosines, np.take_along_axis(scored @ train.T, expected, 1), rtol=1e-5)


def test_votes() -> None:
    labels = np.array([[0, 1, 1], [2, 0, 0], [1, 2, 0], [0, 1, 2]])
    likeness = np.array([[0.99, 0.1, 0.1], [0.9, 0.8, 0.7], [0.2, 0.9, 0.5], [0.3, 0.2, 0.1]])
    np.testing.assert_array_equal(probe_models.vote(labels, likeness, 3), [1, 0, 2, 0])


def test_neighbours_are_by_direction_not_by_length() -> None:
    rng = np.random.default_rng(0)
    angle = np.repeat([0.3, 1.2], 60)
    length = np.where(angle < 1, 50.0, 0.5) * rng.uniform(0.5, 2, 120)
    features = np.stack([length * np.cos(angle), length * np.sin(angle)], 1) * (1 + 0.01 * rng.normal(size=(120, 2)))
    groups, split = np.arange(120), np.where(np.arange(120) % 2, "train", "test")
    assert knn_probe(features, angle > 1, groups, split).accuracy == 1.0


# ---- regression --------------------------------------------------------------------------------------------


def measured(noise: float, groups: int = 60) -> tuple[Array, Array, Array, Array]:
    features, _, group, split = table(groups=groups, apart=0.0)
    weights = np.arange(8) - 3.0
    force = features @ weights + 5.0 + noise * np.random.default_rng(2).normal(size=len(features))
    return features, force, group, split


def test_regression_of_a_linear_quantity() -> None:
    result = regression_probe(*measured(0.0))
    assert result.r2 > 0.9999
    assert result.mae < 0.02
    noisy = regression_probe(*measured(6.0))
    assert noisy.low < noisy.r2 < noisy.high < result.r2
    assert noisy.mae_low < noisy.mae < noisy.mae_high
    assert 0.3 < noisy.r2 < 0.85


def test_ridge_equals_its_normal_equations() -> None:
    features, force, _, _ = measured(1.0)
    x = (features - features.mean(0)) / features.std(0)
    weights = np.linalg.solve(x.T @ x / len(x) + 0.3 * np.eye(8), x.T @ (force - force.mean()) / len(x))
    np.testing.assert_allclose(
        probe_models.ridge(features, force, features, [0.3])[0], x @ weights + force.mean(), atol=1e-4
    )


def test_regression_on_nothing_is_no_better_than_the_mean() -> None:
    features, force, groups, split = measured(0.0)
    result = regression_probe(features, np.random.default_rng(0).permutation(force), groups, split)
    assert result.r2 < 0.1
    assert result.mae == pytest.approx(result.baseline_mae, rel=0.15)


# ---- a user's mistakes -------------------------------------------------------------------------------------


def without(split: str) -> tuple[Array, Array, Array, Array]:
    features, labels, groups, parts = table()
    return features, labels, groups, np.where(parts == split, "unused", parts)


@EITHER
def test_one_class_is_one_sentence(probe: Any) -> None:
    features, labels, groups, split = table()
    labels[split == "train"] = "ball"
    with pytest.raises(UserError, match="one class only, 'ball', of train; a probe needs at least two"):
        probe(features, labels, groups, split)


@EITHER
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_features_that_are_not_finite_name_their_rows(probe: Any, bad: float) -> None:
    features, labels, groups, split = table()
    features[[4, 17], 3] = bad
    with pytest.raises(UserError, match=r"features of rows 4, 17 hold NaN or infinity"):
        probe(features, labels, groups, split)
    features[:, 0] = bad
    with pytest.raises(UserError, match=r"rows 0, 1, .*, 9 and 290 more hold"):
        probe(features, labels, groups, split)


@EITHER
@pytest.mark.parametrize("split", ["train", "test"])
def test_an_empty_split_is_named(probe: Any, split: str) -> None:
    with pytest.raises(UserError, match=f"no row of split '{split}' has this label"):
        probe(*without(split))


def test_labels_only_outside_of_test() -> None:
    features, labels, groups, split = table()
    with pytest.raises(UserError, match="no row of split 'test' has this label"):
        linear_probe(features, np.where(split == "test", "", labels), groups, split)


def test_a_measured_label_is_sent_to_regression() -> None:
    features, _, groups, split = table()
    with pytest.raises(UserError, match=r"0\.5, a measured quantity .* --tasks force"):
        linear_probe(features, groups + 0.5, groups, split)
    with pytest.raises(UserError, match=r"not a number .*'ball'.* use the linear probe"):
        regression_probe(features, np.full(len(groups), "ball"), groups, split)


def test_a_constant_measured_label() -> None:
    features, force, groups, split = measured(0.0)
    with pytest.raises(UserError, match="the label is 2 on every row of train"):
        regression_probe(features, np.where(split == "train", 2.0, force), groups, split)
    with pytest.raises(UserError, match="the label is 2 on every row of test"):
        regression_probe(features, np.where(split == "test", 2.0, force), groups, split)


def test_one_group_cannot_choose_a_penalty() -> None:
    features, labels, _, split = table(val=False)
    with pytest.raises(UserError, match="all rows to learn from are of one group"):
        linear_probe(features, labels, np.where(split == "train", 0, 1), split)
    assert linear_probe(features, labels, np.where(split == "train", 0, 1), split, penalties=[0.1]).low is None


def test_rows_without_a_group() -> None:
    features, labels, groups, split = table()
    names = groups.astype(str).astype(object)
    names[[3, 8]] = ["", None]
    with pytest.raises(UserError, match="rows 3, 8 name no group"):
        linear_probe(features, labels, names, split)


def test_lengths_must_agree() -> None:
    features, labels, groups, split = table()
    with pytest.raises(UserError, match="n labels, groups and splits"):
        linear_probe(features, labels[:-1], groups, split)
    with pytest.raises(UserError, match="unknown protocol 'lucky'"):
        linear_probe(features, labels, groups, split, protocol="lucky")  # type: ignore[arg-type]


def test_an_unfinished_fit_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    features, labels, groups, split = table(apart=1.0)
    monkeypatch.setattr("anytouch_jax.evaluate.logistic.STEPS", 2)
    assert "the fit stopped at its limit of iterations" in linear_probe(features, labels, groups, split).notes


def test_results_are_records() -> None:
    result = linear_probe(*table())
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.accuracy = 0.0  # type: ignore[misc]
