"""Statistics of evaluations: scores with 95 % intervals from bootstraps over groups and seeds.

A group is what was sampled independently: a recording, an object, a touch. Frames of one recording
are nearly equal, so a bootstrap over frames would give intervals that are far too narrow.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

Array = npt.NDArray[Any]
Protocol = Literal["grouped", "released"]
Interval = tuple[float | None, float | None]
# sums (..., k) over rows -> a score (...)
Metric = Callable[[Array], Array]

# the controls of probes
RAW = "raw pixels"
RANDOM = "random encoder"
IMAGENET = "ImageNet network"  # where its package is installed, see `weights.registry.INSTALLED`

# Bootstraps of an interval. Its ends are 0.03 standard errors off; a tenth of the draws gives 0.09.
DRAWS = 10_000
# Draws that are made and kept at once: 1000 x 5000 groups are 5 MB of counts.
_BLOCK = 1000
_MOST_KEPT = 5000


class GroupSums(NamedTuple):
    """Test rows of one run: `groups` (n,), and what is summed over them, f64 (n, sums).

    A score is a function of these sums over all rows, so a bootstrap only has to weight groups.
    """

    groups: Array
    sums: Array


def classification_sums(correct: Array, groups: Array) -> GroupSums:
    """Return the sums of `_mean_of` for values (n,), or for rows that are right or wrong."""
    values = np.asarray(correct, np.float64)
    return GroupSums(groups, np.stack([values, np.ones(len(correct))], axis=1))


def regression_sums(
    error: Array, truth: Array, groups: Array, predicted: Array | None = None
) -> GroupSums:
    """Return the sums of `_r2_of`, `_mae_of` and `_spearman_of`.

    Args:
        error: (n,) of the predictions.
        truth: (n,), best centred, because the square of an offset hides the spread.
        groups: (n,).
        predicted: (n,), whose ranks count; by default the truth plus the error.
    """
    if predicted is None:
        predicted = truth + error
    # Ranks among all rows, once: ranks of every draw would cost a sort each, and differ little.
    own_rank = rankdata(predicted) / len(error) - 0.5
    true_rank = rankdata(truth) / len(error) - 0.5
    columns = [
        error**2,
        np.abs(error),
        truth,
        truth**2,
        np.ones(len(error)),
        own_rank,
        true_rank,
        own_rank**2,
        true_rank**2,
        own_rank * true_rank,
    ]
    return GroupSums(groups, np.stack(columns, axis=1))


def _mean_of(sums: Array) -> Array:
    """Return the mean (accuracy) from sums (..., [values, rows])."""
    return np.asarray(sums[..., 0] / sums[..., 1])


def _r2_of(sums: Array) -> Array:
    """Return R2, NaN for equal labels.

    The sums are (..., [squared error, absolute error, truth, squared truth, rows]).
    """
    spread = sums[..., 3] - sums[..., 2] ** 2 / sums[..., 4]
    has_spread = spread > 1e-12 * sums[..., 3]
    return np.asarray(1 - sums[..., 0] / np.where(has_spread, spread, np.nan))


def _mae_of(sums: Array) -> Array:
    """Return the mean absolute error from sums as `_r2_of` reads them."""
    return np.asarray(sums[..., 1] / sums[..., 4])


def _spearman_of(sums: Array) -> Array:
    """Return Spearman's rank correlation, NaN for equal labels or equal predictions.

    The sums from the fifth on are (..., [rows, rank, true rank, squares of both, product]).
    """
    rows = sums[..., 4]
    own = sums[..., 7] - sums[..., 5] ** 2 / rows
    true = sums[..., 8] - sums[..., 6] ** 2 / rows
    both = sums[..., 9] - sums[..., 5] * sums[..., 6] / rows
    has_spread = (own > 1e-9) & (true > 1e-9)
    return np.asarray(both / np.sqrt(np.where(has_spread, own * true, np.nan)))


def _metric(regression: bool) -> Metric:
    if regression:
        return _r2_of
    return _mean_of


def paired_gain(
    real: Sequence[GroupSums], other: Sequence[GroupSums], regression: bool
) -> dict[str, float | None]:
    """Return by how much the score of `real` is above that of `other`, with its 95 % interval.

    Both are scored on the same rows, and every draw takes the same groups for both. What makes a
    group hard for both cancels, so this interval is narrower than the two separate ones suggest.
    """
    metric = _metric(regression)
    width = real[0].sums.shape[1]

    def gain(sums: Array) -> Array:
        return metric(sums[..., :width]) - metric(sums[..., width:])

    both = []
    for a, b in zip(real, other, strict=True):
        both.append(GroupSums(a.groups, np.concatenate([a.sums, b.sums], axis=1)))
    low, high = _bootstrap_interval(both, gain)
    difference = float(np.mean([gain(run.sums.sum(0)) for run in both]))
    return {"difference": difference, "low": low, "high": high}


def _bootstrap_interval(runs: Sequence[GroupSums], of: Metric) -> Interval:
    """Return the 95 % percentile interval of the mean over runs of `of` (sums -> number).

    Groups, which all runs share, and runs are resampled. (None, None) with fewer than two groups,
    or no value.
    """
    names = np.unique(np.concatenate([run.groups for run in runs]))
    if len(names) < 2:
        return None, None
    # Sums of each group once: a draw is then a product with how often each group came.
    totals = np.zeros((len(runs), len(names), runs[0].sums.shape[1]))
    for total, run in zip(totals, runs, strict=True):
        np.add.at(total, np.searchsorted(names, run.groups), run.sums)
    draw: Callable[[int, int], list[Array]] = _draws
    if len(names) > _MOST_KEPT:
        draw = _draws.__wrapped__
    # Seeds differ by their splits and fits, which is noise too. They are drawn from a stream of
    # their own: drawn alike, seed k and group k would always come together.
    run_weights = np.concatenate(_draws(len(runs), stream=1)) / len(runs)
    with np.errstate(divide="ignore", invalid="ignore"):
        blocks = [[of(times @ total) for total in totals] for times in draw(len(names), 0)]
        values: Array = np.concatenate(blocks, axis=1).T
    # A run that was not drawn must not spoil the mean by its NaN.
    means = np.where(run_weights > 0, run_weights * values, 0).sum(axis=1)
    means = means[np.isfinite(means)]
    if not means.size:
        return None, None
    low, high = np.percentile(means, [2.5, 97.5]).tolist()
    return low, high


@functools.lru_cache(maxsize=4)  # drawing takes nine tenths of the time of an interval
def _draws(count: int, stream: int) -> list[Array]:
    """Return how often each of `count` groups is drawn, u8 (1000, count) at a time, DRAWS in all.

    Streams differ. The same groups are drawn for every score of equally many groups, so tables of
    one test set are compared on the same draws.
    """
    rng = np.random.default_rng(stream)
    chances = np.full(count, 1 / count)
    blocks = []
    for _ in range(DRAWS // _BLOCK):
        blocks.append(rng.multinomial(count, chances, size=_BLOCK).astype(np.uint8))
    return blocks


def fraction_interval(values: Array, groups: Array) -> Interval:
    """Return the 95 % interval of a fraction, the mean of `values` (n,) in 0..1.

    It is the bootstrap over `groups` (n,). Where every group has the same value, 0 or 1, each draw
    has it too, and the interval would be a point: sixty recordings that are all right would promise
    100.0 to 100.0 %. There it is the exact one of Clopper and Pearson (1934), a group a trial.

    Use it for accuracies and recalls. A difference has `paired_gain` or `mean_interval`.
    """
    return _fraction_interval([classification_sums(values, groups)])


def _fraction_interval(runs: Sequence[GroupSums]) -> Interval:
    """Return the interval of `fraction_interval` for several runs, the seeds of a probe."""
    low, high = _bootstrap_interval(runs, _mean_of)
    if low is None or low != high or low not in (0.0, 1.0):
        return low, high
    groups = len(np.unique(np.concatenate([run.groups for run in runs])))
    # All groups right: the fraction is above p, unless 2.5 % of p ** groups happened. Runs test the
    # same groups, so more of them are no more trials.
    least = 0.025 ** (1 / groups)
    if low == 1.0:
        return least, 1.0
    return 0.0, 1.0 - least


def mean_interval(values: Array, groups: Array) -> Interval:
    """Return the 95 % interval of the mean of `values` (n,), by a bootstrap over `groups` (n,)."""
    return _bootstrap_interval([classification_sums(values, groups)], _mean_of)


def scores(
    runs: Sequence[GroupSums], baselines: Sequence[GroupSums], regression: bool
) -> dict[str, Any]:
    """Return mean, interval, values and chance of accuracy.

    With `regression` they are of R2, with the mean absolute error and Spearman's correlation
    beside it.

    There is a run, and a baseline that predicts a constant, for each seed.
    """

    def values(of: Metric, several: Sequence[GroupSums]) -> list[float]:
        return [float(of(run.sums.sum(0))) for run in several]

    metric = _metric(regression)
    low, high = _bootstrap_interval(runs, metric) if regression else _fraction_interval(runs)
    result: dict[str, Any] = {
        "metric": "r2" if regression else "accuracy",
        "mean": float(np.mean(values(metric, runs))),
        "low": low,
        "high": high,
        "values": values(metric, runs),
        "chance": float(np.mean(values(metric, baselines))),
    }
    if regression:
        mae_low, mae_high = _bootstrap_interval(runs, _mae_of)
        rank_low, rank_high = _bootstrap_interval(runs, _spearman_of)
        rank = float(np.mean(values(_spearman_of, runs)))
        result |= {
            "mae": float(np.mean(values(_mae_of, runs))),
            "mae_low": mae_low,
            "mae_high": mae_high,
            "chance_mae": float(np.mean(values(_mae_of, baselines))),
            "spearman": rank if np.isfinite(rank) else None,
            "spearman_low": rank_low,
            "spearman_high": rank_high,
        }
    return result
