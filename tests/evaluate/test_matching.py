"""The matcher on held-out touches: the triples it is asked about, and what its answers are worth."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest
from runs import run_config
from touch_world import make_touches

from anytouch_jax.config import to_json
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import matching
from anytouch_jax.evaluate.matching import MatchScore, auc, best_rule, draw_triples, matcher, score_matching
from anytouch_jax.evaluate.retrieval import deepest_rows
from anytouch_jax.nn.functional import build
from anytouch_jax.weights.checkpoint import Checkpoints

WAYS = ("any", "same_sensor")


@pytest.fixture(scope="module")
def touched(tmp_path_factory: Any) -> manifests.Manifest:
    return manifests.read(make_touches(tmp_path_factory.mktemp("touched"), touches={"test": 20}, each=2))


@pytest.fixture(scope="module")
def rows(touched: manifests.Manifest) -> np.ndarray:
    return deepest_rows(touched, split="test")


def column(manifest: manifests.Manifest, rows: np.ndarray, name: str) -> np.ndarray:
    return np.asarray(manifest.column(name).to_pylist())[rows]


# Numbers ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_auc_is_the_share_of_pairs_in_the_right_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    right, wrong = rng.integers(0, 6, 17) + 1.0, rng.integers(0, 6, 23).astype(float)
    brute = np.mean([(a > b) + 0.5 * (a == b) for a in right for b in wrong])
    assert auc(right, wrong) == pytest.approx(brute)
    assert auc(wrong, right) == pytest.approx(1 - brute)
    assert auc(1e4 * right + 1e5, 1e4 * wrong) == 1.0 and auc(np.zeros(3), np.zeros(5)) == 0.5


def test_the_best_rule_of_a_code() -> None:
    anchor = np.repeat(np.arange(40), 3)
    one = np.ones(120, int)
    assert best_rule(one, 2 * one, anchor) == 1.0
    assert best_rule(one, one, anchor) == 0.5
    # Positives are never of code 0, a third of the negatives is: yes unless 0.
    assert best_rule(np.tile([1, 2, 2], 40), np.tile([0, 1, 2], 40), anchor) == pytest.approx((1 + 1 / 3) / 2, abs=0.1)
    assert best_rule(np.arange(120), 120 + np.arange(120), anchor) == 0.5  # no code is met twice
    assert best_rule(one[:3], 2 * one[:3], anchor[:3]) == 0.5  # nobody to learn from


def test_a_rule_finds_nothing_in_codes_that_say_nothing() -> None:
    rng = np.random.default_rng(0)
    found = [best_rule(*rng.integers(12, size=(2, 50)), np.repeat(np.arange(10), 5)) for _ in range(300)]
    assert abs(np.mean(found) - 0.5) < 0.01  # 0.63 where it was learned


# Triples ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("negatives", WAYS)
def test_triples_are_of_one_place_and_of_two(touched: Any, rows: np.ndarray, negatives: Any) -> None:
    anchor, positive, negative = draw_triples(touched, rows, negatives, draws=4, seed=1)
    touch, sensor, thing = (column(touched, rows, name) for name in ("touch", "sensor", "object"))
    assert len(anchor) == 4 * 60 and (np.bincount(anchor) == 4).all()  # every touch was felt by all three sensors
    assert (touch[anchor] == touch[positive]).all() and (sensor[anchor] != sensor[positive]).all()
    assert (thing[anchor] != thing[negative]).all()
    same = sensor[positive] == sensor[negative]
    assert same.all() if negatives == "same_sensor" else 0.1 < same.mean() < 0.6
    again = draw_triples(touched, rows, negatives, draws=4, seed=1)
    np.testing.assert_array_equal(again, (anchor, positive, negative))
    assert not np.array_equal(draw_triples(touched, rows, negatives, draws=4, seed=2)[2], negative)


def test_without_pairs_there_is_nothing_to_match(touched: Any, rows: np.ndarray) -> None:
    lock = rows[column(touched, rows, "sensor") == "digit"]
    with pytest.raises(UserError, match="no touch of these rows was felt by two sensors"):
        draw_triples(touched, lock, "any")


# Scores -------------------------------------------------------------------------------------------------------------


def scored(monkeypatch: Any, touched: Any, rows: np.ndarray, features: np.ndarray, logits: Any) -> list[MatchScore]:
    monkeypatch.setattr(matching, "matcher", lambda run: logits)
    return score_matching("run", touched, rows, features)


def test_features_that_know_the_place_match_perfectly(monkeypatch: Any, touched: Any, rows: np.ndarray) -> None:
    place = np.unique(column(touched, rows, "touch"), return_inverse=True)[1]
    dot = lambda a, b: (a * b).sum(1) - 0.5  # noqa: E731
    for one in scored(monkeypatch, touched, rows, np.eye(20)[place], dot):
        assert (one.accuracy, one.auc, one.low, one.high) == (1.0, 1.0, 1.0, 1.0)
        assert (one.triples, one.anchors) == (300, 60)


def test_features_that_say_nothing_are_at_chance(monkeypatch: Any, touched: Any, rows: np.ndarray) -> None:
    noise = np.random.default_rng(0).standard_normal((len(rows), 16))
    for one in scored(monkeypatch, touched, rows, noise, lambda a, b: (a * b).sum(1)):
        assert abs(one.accuracy - 0.5) < 0.08 and abs(one.auc - 0.5) < 0.08
        assert one.low is not None and one.high is not None and one.low <= one.accuracy <= one.high
    always = scored(monkeypatch, touched, rows, noise, lambda a, b: np.ones(len(a)))
    assert [(one.accuracy, one.auc) for one in always] == [(0.5, 0.5)] * 2


def test_a_matcher_that_sees_only_the_sensors_is_found_out(monkeypatch: Any, touched: Any, rows: np.ndarray) -> None:
    """It says yes to two different sensors: above chance with any negatives, and not with those of one sensor."""
    sensor = np.unique(column(touched, rows, "sensor"), return_inverse=True)[1]
    differ = lambda a, b: 0.5 - (a * b).sum(1)  # noqa: E731
    free, bound = scored(monkeypatch, touched, rows, np.eye(3)[sensor], differ)
    assert (free.negatives, bound.negatives) == WAYS
    assert free.accuracy > 0.6 and abs(free.sensors_alone - free.accuracy) < 0.05
    assert (bound.accuracy, bound.auc, bound.sensors_alone) == (0.5, 0.5, 0.5)


# Runs ---------------------------------------------------------------------------------------------------------------


def test_the_matcher_of_a_run_is_that_of_its_parameters(tmp_path: Any, world: Any) -> None:
    config = run_config(world, 2)
    net = build(config.model)
    params = net.init(jax.random.key(0))
    checkpoints = Checkpoints(tmp_path / "checkpoints", keep=1, config_json=to_json(config), metadata={})
    checkpoints.save(1, {"trainable": params}, {"loss": 1.0})
    checkpoints.close()
    z = np.random.default_rng(0).standard_normal((2, 7, 12)).astype(np.float32)
    one, two = (part / np.linalg.norm(part, axis=1, keepdims=True) for part in z)
    found = matcher(tmp_path)(*z)
    np.testing.assert_allclose(found, net.apply(params, "match", one, two), atol=1e-6)
    assert found.shape == (7,) and np.ptp(found) > 1e-4


def test_a_run_without_a_matching_head_is_refused(tiny_run: Any) -> None:
    with pytest.raises(UserError, match="the run has no matching head; give one of stage 2"):
        matcher(tiny_run)


def test_the_table_says_what_the_sensors_alone_give_away() -> None:
    head, lines = matching.table(
        [
            MatchScore("any", 0.8, 0.7, 0.9, 0.85, 0.65, 300, 60),
            MatchScore("same_sensor", 0.6, None, None, 0.7, 0.5, 300, 60),
        ]
    )
    assert len(head) == len(lines[0]) == 5
    assert lines[0] == ("of any sensor", "80.0 % (70.0 to 90.0)", "0.850", "65.0 %", "300")
    assert lines[1][:2] == ("of the positive's sensor", "60.0 %")
