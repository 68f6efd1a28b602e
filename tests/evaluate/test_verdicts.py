from dataclasses import replace

import numpy as np
import pytest

from anytouch_jax.evaluate.array_probes import probe_features
from anytouch_jax.evaluate.results import ProbeResult
from anytouch_jax.evaluate.statistics import RANDOM, RAW, classification_sums, regression_sums
from anytouch_jax.evaluate.verdicts import label_verdicts, task_verdicts, verdict


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (0.03, 0.21, "ours is 12 points above the best control, raw pixels (3 to 21)."),
        (-0.02, 0.26, "ours is no better than the best control, raw pixels: +12 points (-2 to 26)"),
        (None, None, "ours is +12 points from raw pixels, by too few test recordings to be sure."),
    ],
)
def test_a_verdict_is_a_paired_interval(low, high, words):
    assert words in verdict("ours", {"difference": 0.12, "low": low, "high": high})


def scored(right: float, seed: int = 0, rows: int = 200) -> list:
    """Test rows of 100 recordings, of which a fraction is right: a higher one where a lower is."""
    correct = np.random.default_rng(seed).permutation(rows // 2) < right * rows / 2
    return [classification_sums(np.repeat(correct, 2), np.arange(rows) // 2)]


def result(name: str, right: float, seed: int = 0) -> ProbeResult:
    """A result of `probe_label` with that accuracy."""
    rng = np.random.default_rng(0)
    group = np.arange(60) // 2
    split = np.where(group < 15, "train", "test")
    plain = probe_features(rng.normal(size=(60, 3)), group % 2, group, split, seeds=0)
    sums = scored(right, seed)[0]
    return replace(plain, probe=name, outcome=replace(plain.outcome, sums=sums))


def test_the_best_control_counts_not_raw_pixels_by_the_same_head():
    """Linear pixels are 55 points below, kNN pixels 25, a random encoder 9."""
    results = [
        result("ours: linear", 0.95),
        result("ours: kNN", 0.99),
        result(f"{RANDOM}: linear", 0.86),
        result(f"{RANDOM}: kNN", 0.5),
        result(f"{RAW}: linear", 0.4),
        result(f"{RAW}: kNN", 0.7),
        result("commonest class", 0.3),
    ]
    (line,) = label_verdicts(results)
    assert line.startswith("ours (linear) is 9 points above the best control, an untrained encoder")
    assert "(linear) (4 to 15)" in line or "(linear) (4 to 14)" in line
    results[5] = result(f"{RAW}: kNN", 0.9)
    (line,) = label_verdicts(results)
    assert "raw pixels (kNN)" in line
    results[6] = result("commonest class", 0.94)
    (line,) = label_verdicts(results)
    assert "no better than the best control, the commonest class: +1 points" in line


def test_an_untrained_encoder_that_is_better_is_named():
    ours = result("ours: linear", 0.6)
    raw = result(f"{RAW}: linear", 0.3)
    (line,) = label_verdicts([ours, raw, result(f"{RANDOM}: kNN", 0.8)])
    assert "no better than the best control, an untrained encoder (kNN): -20 points" in line
    first, second = label_verdicts(
        [ours, result(f"{RAW}: linear", 0.9), result(f"{RANDOM}: kNN", 0.8)]
    )
    assert "raw pixels (linear): -30 points" in first
    assert second.startswith("An untrained encoder (kNN) is 20 points better than ours (linear)")
    assert "chance" not in second
    *_, last = label_verdicts(
        [ours, result(f"{RAW}: linear", 0.9), result(f"{RANDOM}: kNN", 0.61, seed=1)]
    )
    assert "1 points better" in last and "may be chance" in last
    assert label_verdicts([ours]) == []


def test_tasks_are_compared_with_the_best_head_of_a_control_on_the_same_task():
    runs = {
        ("ours", "slip", "linear", "grouped"): scored(0.8),
        (RAW, "slip", "linear", "grouped"): scored(0.4),
        (RAW, "slip", "knn", "grouped"): scored(0.7),
        (RAW, "slip", "knn", "released"): scored(0.99),
        (RANDOM, "material", "knn", "grouped"): scored(0.9),
        ("ours", "material", "knn", "released"): scored(0.9),
    }
    (line,) = task_verdicts(runs, {"slip": False, "material": False})
    assert line.startswith(
        "slip: ours (linear) is 10 points above the best control, raw pixels (kn"
    )


def test_a_regression_is_compared_by_r2():
    rng = np.random.default_rng(0)
    truth = rng.normal(size=100)
    groups = np.arange(100) // 2
    runs = {}
    for name, noise in (("ours", 0.3), (RAW, 0.8)):
        sums = regression_sums(noise * rng.normal(size=100), truth, groups)
        runs[name, "force", "linear", "grouped"] = [sums]
    (line,) = task_verdicts(runs, {"force": True})
    assert "of R2 above the best control, raw pixels (linear) (0." in line
