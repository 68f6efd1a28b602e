from typing import Any

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.heads import ProbeHead, linear_path
from anytouch_jax.evaluate.probing import ProbeResult, leave_groups_out, probe_features

Array = np.ndarray[Any, Any]


def table(
    *,
    groups: int = 60,
    each: int = 5,
    classes: int = 3,
    apart: float = 6.0,
    val: bool = True,
    seed: int = 0,
) -> tuple[Array, Array, Array, Array]:
    """Gaussian blobs, `apart` standard deviations from the origin: features, labels, groups,
    split.
    """
    rng = np.random.default_rng(seed)
    group = np.repeat(np.arange(groups), each)
    label = group % classes
    centres = apart * np.eye(classes, 8)
    features = (centres[label] + rng.normal(size=(len(label), 8))).astype(np.float32)
    third = (group // classes) % 6
    split = np.where(third < 3, "train", np.where((third == 3) & val, "val", "test"))
    return features, np.array(["ball", "cube", "ring", "rod"])[label], group, split


def linear_probe(
    *arrays: Any, penalties: Any = None, scaling: Any = "column", **options: Any
) -> ProbeResult:
    return probe_features(*arrays, ProbeHead("linear", scaling, penalties), **options)


def knn_probe(*arrays: Any, **options: Any) -> ProbeResult:
    return probe_features(*arrays, ProbeHead("knn"), **options)


PROBES = [linear_probe, knn_probe]
EITHER = pytest.mark.parametrize("probe", PROBES)


@EITHER
@pytest.mark.parametrize("val", [True, False])
def test_separable_blobs_reach_one(probe: Any, val: bool) -> None:
    result = probe(*table(val=val, apart=9.0))
    assert result.accuracy == result.balanced_accuracy == result.refit_mean == 1.0
    # all groups right: the least fraction that 18 or 27 of so many still allow
    assert (result.low, result.high) == pytest.approx((0.025 ** (1 / result.test_groups), 1.0))
    assert result.chosen_on == ("val" if val else "cross-validation")
    assert result.classes == ("ball", "cube", "ring")
    assert (result.n_train, result.n_test, result.test_groups) == (
        (165, 90, 18) if val else (165, 135, 27)
    )


@EITHER
@pytest.mark.parametrize("val", [True, False])
def test_the_choice_never_looks_at_test(probe: Any, val: bool) -> None:
    features, labels, groups, split = table(apart=1.5, val=val)
    test = split == "test"
    plain = probe(features, labels, groups, split)
    other = labels.copy()
    moved = features.copy()
    other[test] = np.random.default_rng(3).permutation(labels[test])
    moved[test] += 5.0
    assert probe(moved, other, groups, split).penalty == plain.penalty
    assert probe(features, other, groups, split).accuracy < plain.accuracy


def test_only_the_published_protocol_follows_the_labels_of_test() -> None:
    features, labels, groups, split = table(apart=1.0)
    y = np.unique(labels, return_inverse=True)[1]
    train = split == "train"
    test = split == "test"
    choices: dict[str, list[float]] = {"grouped": [], "released": []}
    # labels of test as this very fit would have them
    for penalty in (10.0, 1e-4):
        written = y.copy()
        written[test] = linear_path(features[train], y[train], [penalty])[0](features[test])
        for protocol, chosen in choices.items():
            arguments = (features, written, groups, split)
            chosen.append(
                linear_probe(*arguments, penalties=(10.0, 1e-4), protocol=protocol).penalty
            )  # type: ignore
    assert choices["released"] == [10.0, 1e-4]
    assert choices["grouped"][0] == choices["grouped"][1]


@EITHER
def test_classes_that_train_lacks_count_as_errors(probe: Any) -> None:
    features, labels, groups, split = table(apart=9.0)
    test = np.flatnonzero(split == "test")
    labels = labels.astype(object)
    labels[test[:30]] = "sponge"
    result = probe(features, labels, groups, split)
    assert result.accuracy == pytest.approx(2 / 3)
    # four classes in test, one of them never right
    assert result.balanced_accuracy == pytest.approx(3 / 4)
    assert "sponge" not in result.classes
    assert len(result.notes) == 1 and "30 " in result.notes[0] and "sponge" in result.notes[0]


def test_a_group_that_gives_the_label_away_does_not_help_on_other_groups() -> None:
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(24), 10)
    label = rng.permutation(24)[group] % 2
    identity = 5 * np.eye(24)[group] + 0.1 * rng.normal(size=(240, 24))
    # every group on both sides
    inside = np.where(np.arange(240) % 10 < 5, "train", "test")
    leaky = linear_probe(identity, label, group, inside)
    assert leaky.accuracy == 1.0
    assert any("24 groups" in note for note in leaky.notes)
    grouped = leave_groups_out(identity, label, group, folds=6)
    assert grouped.accuracy < 0.62
    assert grouped.test_groups == 24
    assert grouped.n_test == 240


@EITHER
def test_rows_outside_the_splits_and_order_of_rows_do_not_matter(probe: Any) -> None:
    features, labels, groups, split = table(apart=1.5)
    plain = probe(features, labels, groups, split, seeds=0)
    extra = (np.full((9, 8), np.nan), np.full(9, "ball"), np.full(9, 0), np.full(9, "background"))
    more = [
        np.concatenate(pair) for pair in zip((features, labels, groups, split), extra, strict=True)
    ]
    order = np.random.default_rng(0).permutation(len(more[0]))
    mixed = probe(*(one[order] for one in more), seeds=0)
    assert mixed.accuracy == pytest.approx(plain.accuracy, abs=0.011)
    assert (mixed.penalty, mixed.n_train, mixed.n_test) == (
        plain.penalty,
        plain.n_train,
        plain.n_test,
    )


def test_parts_of_the_test_rows() -> None:
    features, labels, groups, split = table(apart=9.0)
    features[(split == "test") & (labels == "cube")] = features[
        (split == "train") & (labels == "ring")
    ][0]
    cube = labels == "cube"
    result = linear_probe(
        features, labels, groups, split, subsets={"cube": cube, "rest": ~cube, "none": cube & ~cube}
    )
    wrong, right, none = result.parts
    assert (wrong.name, wrong.accuracy, right.accuracy) == ("cube", 0.0, 1.0)
    assert wrong.n_test + right.n_test == result.n_test
    assert (none.n_test, none.low) == (0, None)


def refused(*words: str, probe: Any = linear_probe, options: Any = None, **changes: Any) -> None:
    """The probe of `table()` with these arguments raises one line that holds the words."""
    names = ("features", "labels", "groups", "split")
    arguments = dict(zip(names, table(), strict=True))
    for name, change in changes.items():
        arguments[name] = (
            change(arguments[name].copy(), arguments["split"]) if callable(change) else change
        )
    with pytest.raises(UserError) as error:
        probe(*arguments.values(), **(options or {}))
    assert "\n" not in str(error.value) and all(word in str(error.value) for word in words), (
        error.value
    )


@EITHER
def test_rows_that_cannot_be_probed_are_refused(probe: Any) -> None:
    refused(
        "'ball'",
        "train",
        probe=probe,
        labels=lambda y, split: np.where(split == "train", "ball", y),
    )
    refused(
        "'test'", "label", probe=probe, labels=lambda y, split: np.where(split == "test", "", y)
    )
    for part in ("train", "test"):
        refused(
            repr(part),
            probe=probe,
            split=lambda parts, _, part=part: np.where(parts == part, "unused", parts),
        )
    for bad in (np.nan, np.inf):
        some = np.where(np.isin(np.arange(300), (4, 17)), bad, 1)[:, None]
        refused("rows 4, 17 ", probe=probe, features=lambda x, _, some=some: x * some)
        refused("9 and 290 more", probe=probe, features=lambda x, _, bad=bad: x * bad)
    refused("299", probe=probe, labels=np.zeros(299))
    refused("'lucky'", probe=probe, options={"protocol": "lucky"})
    refused(
        "3, 8",
        "group",
        probe=probe,
        groups=lambda g, _: np.where(np.isin(np.arange(300), (3, 8)), "", g),
    )
    refused(
        "one group",
        probe=probe,
        groups=lambda g, split: np.where(split == "test", 1, 0),
        split=lambda parts, _: np.where(parts == "val", "unused", parts),
    )
