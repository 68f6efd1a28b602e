"""Probes on data whose answer is known: separable, shuffled, leaking and measured labels; tables, JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads
from anytouch_jax.evaluate.heads import ProbeHead, linear_path
from anytouch_jax.evaluate.probing import (
    Outcome,
    ProbeResult,
    SubsetResult,
    leave_groups_out,
    majority_baseline,
    probe_features,
    probe_json,
    probe_table,
)
from anytouch_jax.evaluate.verdict import label_verdicts, verdict

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


def linear_probe(*arrays: Any, penalties: Any = None, scaling: Any = "column", **options: Any) -> ProbeResult:
    return probe_features(*arrays, ProbeHead("linear", scaling, penalties), **options)


def knn_probe(*arrays: Any, **options: Any) -> ProbeResult:
    return probe_features(*arrays, ProbeHead("knn"), **options)


def regression_probe(*arrays: Any, head: ProbeHead | None = None, **options: Any) -> ProbeResult:
    return probe_features(*arrays, head, measured=True, **options)


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
        written[test] = linear_path(features[train], y[train], [penalty])[0](features[test])
        for protocol, chosen in choices.items():
            arguments = (features, written, groups, split)
            chosen.append(linear_probe(*arguments, penalties=(10.0, 1e-4), protocol=protocol).penalty)  # type: ignore
    assert choices["published"] == [10.0, 1e-4]
    assert choices["honest"][0] == choices["honest"][1]


@pytest.mark.parametrize("penalties", [(), (0.0, 1.0), (-1.0,)])
def test_penalties_are_positive(penalties: tuple[float, ...]) -> None:
    refused("above 0", options={"penalties": penalties})


def test_the_published_choice_is_the_best_on_test() -> None:
    features, labels, groups, split = table(apart=1.0)
    penalties = (30.0, 1.0, 0.01, 1e-5)
    single = [linear_probe(features, labels, groups, split, penalties=[p], seeds=0).accuracy for p in penalties]
    result = linear_probe(features, labels, groups, split, penalties=penalties, protocol="published", seeds=0)
    assert result.accuracy == pytest.approx(max(single), abs=1 / 100)  # another start, the same optimum
    assert result.protocol == "published"


def test_val_decides_the_penalty() -> None:
    features, labels, groups, split = table(groups=120, apart=1.0)
    penalties = (30.0, 1.0, 0.01, 1e-5)
    on_val = np.where(split == "val", "test", np.where(split == "test", "unused", split))
    scores = [linear_probe(features, labels, groups, on_val, penalties=[p], seeds=0).accuracy for p in penalties]
    chosen = linear_probe(features, labels, groups, split, penalties=penalties, seeds=0).penalty
    assert scores[penalties.index(chosen)] == pytest.approx(max(scores), abs=0.02)


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
    assert len(result.notes) == 1 and "30 " in result.notes[0] and "sponge" in result.notes[0]


def test_a_group_that_gives_the_label_away_does_not_help_on_other_groups() -> None:
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(24), 10)
    label = rng.permutation(24)[group] % 2
    identity = 5 * np.eye(24)[group] + 0.1 * rng.normal(size=(240, 24))
    inside = np.where(np.arange(240) % 10 < 5, "train", "test")  # every group on both sides
    leaky = linear_probe(identity, label, group, inside)
    assert leaky.accuracy == 1.0
    assert any("24 groups" in note for note in leaky.notes)
    honest = leave_groups_out(identity, label, group, folds=6)
    assert honest.accuracy < 0.62
    assert honest.test_groups == 24
    assert honest.n_test == 240


def test_groups_left_out_generalise() -> None:
    features, labels, groups, _ = table(groups=24, apart=9.0)
    for folds in (5, None):
        result = leave_groups_out(features, labels, groups, folds=folds)
        assert result.accuracy == 1.0
        assert result.baseline < 0.4


def test_groups_left_out_are_reported_by_subset() -> None:
    features, labels, groups, _ = table(groups=24, apart=0.8)
    named = np.isin(groups, np.unique(groups)[:8])
    result = leave_groups_out(features, labels, groups, subsets={"named": named, "others": ~named})
    assert [part.n_test for part in result.parts] == [named.sum(), (~named).sum()]
    whole = sum(part.accuracy * part.n_test for part in result.parts) / len(labels)
    assert whole == pytest.approx(result.accuracy) and 0.4 < result.accuracy < 1


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
    values = {
        "text": labels,
        "int": numbers,
        "float": numbers.astype(float),
        "object": np.array([None if i in (0, 1) else int(n) for i, n in enumerate(numbers)], object),
    }[kind]
    result = linear_probe(features, values, groups, split)
    assert result.accuracy == 1.0
    assert result.classes == (("ball", "cube", "ring") if kind == "text" else ("0", "1", "2"))
    assert result.n_train == (163 if kind == "object" else 165)
    assert any("2 rows" in note for note in result.notes) == (kind == "object")


def test_majority_and_baseline_agree() -> None:
    features, labels, groups, split = table(apart=0.0)
    labels = np.where(groups % 5 == 0, "rare", "common")
    expected = float(np.mean(labels[split == "test"] == "common"))
    assert majority_baseline(labels, groups, split).accuracy == expected
    assert linear_probe(features, labels, groups, split).baseline == expected
    assert majority_baseline(np.full(len(labels), "one"), groups, split).accuracy == 1.0


def test_parts_of_the_test_rows() -> None:
    features, labels, groups, split = table(apart=9.0)
    features[(split == "test") & (labels == "cube")] = features[(split == "train") & (labels == "ring")][0]
    cube = labels == "cube"
    result = linear_probe(features, labels, groups, split, subsets={"cube": cube, "rest": ~cube, "none": cube & ~cube})
    wrong, right, none = result.parts
    assert (wrong.name, wrong.accuracy, right.accuracy) == ("cube", 0.0, 1.0)
    assert wrong.n_test + right.n_test == result.n_test
    assert (none.n_test, none.low) == (0, None)


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


def test_the_selected_epoch_is_the_tested_one() -> None:
    arrays, recipe = table(apart=1.0), heads.GradientRecipe(epochs=8, batch=32, rate=0.01)
    by_epoch = [
        probe_features(*arrays, ProbeHead("gradient", options=(epoch,), recipe=recipe), seeds=0).accuracy
        for epoch in range(1, 9)
    ]
    result = probe_features(*arrays, ProbeHead("gradient", recipe=recipe), protocol="published", seeds=0)
    assert result.penalty is not None and result.accuracy == by_epoch[int(result.penalty) - 1] == max(by_epoch)


# ---- a user's mistakes -------------------------------------------------------------------------------------

NUMBERS = np.arange(300) + 0.5


def refused(*words: str, probe: Any = linear_probe, options: Any = None, **changes: Any) -> None:
    """The probe of `table()` with these arguments raises one line that holds the words."""
    names = ("features", "labels", "groups", "split")
    arguments = dict(zip(names, table(), strict=True))
    for name, change in changes.items():
        arguments[name] = change(arguments[name].copy(), arguments["split"]) if callable(change) else change
    with pytest.raises(UserError) as error:
        probe(*arguments.values(), **(options or {}))
    assert "\n" not in str(error.value) and all(word in str(error.value) for word in words), error.value


@EITHER
def test_rows_that_cannot_be_probed_are_refused(probe: Any) -> None:
    refused("'ball'", "train", probe=probe, labels=lambda y, split: np.where(split == "train", "ball", y))
    refused("'test'", "label", probe=probe, labels=lambda y, split: np.where(split == "test", "", y))
    for part in ("train", "test"):
        refused(repr(part), probe=probe, split=lambda parts, _, part=part: np.where(parts == part, "unused", parts))
    for bad in (np.nan, np.inf):
        refused("rows 4, 17 ", probe=probe, features=lambda x, _, bad=bad: x * np.where(wild(x), bad, 1)[:, None])
        refused("9 and 290 more", probe=probe, features=lambda x, _, bad=bad: x * bad)
    refused("299", probe=probe, labels=np.zeros(299))
    refused("'lucky'", probe=probe, options={"protocol": "lucky"})
    refused("3, 8", "group", probe=probe, groups=lambda g, _: np.where(np.isin(np.arange(300), (3, 8)), "", g))
    refused("one group", probe=probe, groups=lambda g, split: np.where(split == "test", 1, 0),
            split=lambda parts, _: np.where(parts == "val", "unused", parts))  # fmt: skip


def wild(x: Array) -> Array:
    return np.isin(np.arange(len(x)), (4, 17))


def test_labels_of_the_wrong_kind_are_refused() -> None:
    refused("0.5", labels=NUMBERS)
    refused("'ball'", probe=regression_probe, labels=np.full(300, "ball"))
    for part in ("train", "test"):
        labels = lambda y, split, part=part: np.where(split == part, 2.0, NUMBERS)  # noqa: E731
        refused("2", part, probe=regression_probe, labels=labels)


def test_one_group_without_a_choice_has_no_interval() -> None:
    features, labels, _, split = table(val=False)
    result = linear_probe(features, labels, np.where(split == "train", 0, 1), split, penalties=[0.1])
    assert result.low is None and result.chosen_on == "given"


# ---- tables and JSON ---------------------------------------------------------------------------

ONE = ProbeResult(
    probe="linear",
    protocol="honest",
    accuracy=0.5,
    balanced_accuracy=0.4,
    low=0.25,
    high=0.75,
    baseline=0.1,
    refit_mean=0.45,
    refit_std=0.02,
    seeds=5,
    penalty=0.01,
    chosen_on="val",
    n_train=100,
    n_test=40,
    test_groups=8,
    classes=("ball", "cube"),
    parts=(SubsetResult("with photo", 0.6, 0.5, 0.7, 20), SubsetResult("empty", float("nan"), None, None, 0)),
    notes=("3 rows without this label left out",),
)
TWO = ProbeResult(
    probe="ridge",
    protocol="published",
    r2=0.81,
    low=0.7,
    high=0.9,
    mae=0.123,
    mae_low=0.1,
    mae_high=0.15,
    baseline_mae=0.5,
    penalty=1.0,
    chosen_on="test",
    n_train=100,
    n_test=40,
    test_groups=8,
)


def test_a_table_of_classes_and_numbers() -> None:
    assert probe_table([ONE, TWO]).count("\n| ") == 3  # parts are details
    lines = probe_table([ONE, TWO], details=True).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    one, part, empty, two = (dict(zip(cells[0], row, strict=True)) for row in cells[2:])
    assert (one["score"], one["95 %"], one["chance"], one["refits"]) == (
        "50.0 %", "25.0 to 75.0", "10.0 %", "45.0 % ± 2.0",
    )  # fmt: skip
    assert (one["test (groups)"], one["penalty or k"], one["balanced"]) == ("40 (8)", "0.01 (val)", "40.0 %")
    assert (part["probe"], part["score"], empty["score"]) == ("linear: with photo", "60.0 %", "-")
    assert (two["score"], two["95 %"], two["chance"]) == ("R2 0.810, 0.123", "0.700 to 0.900", "0.5")
    assert lines[-1] == "- linear (honest): 3 rows without this label left out"


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (0.03, 0.21, "ours is 12 points above raw pixels (3 to 21)."),
        (-0.02, 0.26, "no better than raw pixels: +12 points"),
        (None, None, "ours is +12 points from raw pixels, by too few test recordings to be sure."),
    ],
)
def test_a_verdict_is_a_paired_interval(low: float | None, high: float | None, words: str) -> None:
    assert words in verdict("ours", {"difference": 0.12, "low": low, "high": high})


def test_a_source_is_compared_with_raw_pixels_on_the_same_groups() -> None:
    groups = np.repeat(np.arange(40), 3)
    right = {"ours": np.ones(120, bool), "raw pixels": np.arange(120) % 2 == 0, "random encoder": np.zeros(120, bool)}
    results = [
        replace(ONE, probe=f"{name}: {kind}", outcome=Outcome(np.arange(120), correct, groups))
        for name, correct in right.items() for kind in ("linear", "kNN")
    ]  # fmt: skip
    (sentence,) = label_verdicts([*results, replace(ONE, probe="commonest class")])
    assert sentence.startswith("ours is 50 points above raw pixels (")
    assert label_verdicts(results[:2]) == []


def test_json() -> None:
    one, two = json.loads(probe_json([replace(ONE, outcome=Outcome(np.zeros(1), np.ones(1, bool), np.zeros(1))), TWO]))
    assert one["accuracy"] == 0.5
    assert one["classes"] == ["ball", "cube"]
    assert one["parts"][1]["accuracy"] is None
    assert "outcome" not in one
    assert two["r2"] == 0.81
    assert "r2" not in one and "accuracy" not in two


def test_the_table_of_tasks() -> None:
    names = {"features": "run", "task": "slip", "head": "knn", "protocol": "honest", "metric": "accuracy"}
    sizes = {"train": 50, "test": 20, "groups": 8, "notes": ["folds"]}
    row: dict[str, Any] = names | sizes | {"mean": 0.635, "low": 0.5, "high": 0.75, "chance": 0.6}
    errors = {"mae": 5.1234, "unit": "N", "chance_mae": 6.0}
    force = row | errors | {"task": "force", "metric": "r2", "mean": -0.3, "low": None, "high": None}
    lines = probe_table([row, force], 0.8).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert cells[2][4:] == ["63.5 %", "50.0 to 75.0", "60.0 %", "50", "20 (8)"]
    assert cells[3][4:7] == ["R2 -0.300, 5.12 N", "-", "6 N"]
    assert "- slip: folds" in lines and "80.00 %" in lines[-1]
