"""Statistics of evaluations: bootstrap intervals over groups and seeds, verdicts, Markdown tables,
plain JSON.
"""

import dataclasses
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Protocol = Literal["honest", "published"]
# the controls of probes
RAW = "raw pixels"
RANDOM = "random encoder"

# bootstraps of an interval: its ends are 0.03 standard errors off, with a tenth of the draws 0.09
DRAWS = 10_000


class GroupSums(NamedTuple):
    """Test rows of one run: `groups` (n,), and what is summed over them, f64 (n, sums)."""

    groups: Array
    sums: Array


def classification_sums(correct: Array, groups: Array) -> GroupSums:
    """Return the sums that `_mean_of` divides, of values (n,) or of rows that are right or
    wrong.
    """
    return GroupSums(groups, np.stack([np.asarray(correct, np.float64), np.ones(len(correct))], 1))


def regression_sums(error: Array, truth: Array, groups: Array) -> GroupSums:
    """Return what `_r2_of` and `_mae_of` divide; `truth` is best centred: the square of an offset
    hides the spread.
    """
    return GroupSums(
        groups, np.stack([error**2, np.abs(error), truth, truth**2, np.ones(len(error))], 1)
    )


def _mean_of(sums: Array) -> Array:
    """Return the mean (accuracy) from sums (..., [values, rows])."""
    return np.asarray(sums[..., 0] / sums[..., 1])


def _r2_of(sums: Array) -> Array:
    """Return R2 from sums (..., [squared error, absolute error, truth, squared truth, rows]); NaN
    for equal labels.
    """
    spread = sums[..., 3] - sums[..., 2] ** 2 / sums[..., 4]
    return np.asarray(1 - sums[..., 0] / np.where(spread > 1e-12 * sums[..., 3], spread, np.nan))


def _mae_of(sums: Array) -> Array:
    """Return the mean absolute error from sums as `_r2_of` reads them."""
    return np.asarray(sums[..., 1] / sums[..., 4])


def paired_gain(
    real: Sequence[GroupSums], other: Sequence[GroupSums], measured: bool
) -> dict[str, float | None]:
    """Return by how much the score of `real` is above that of `other` on the same rows, with its 95
    % interval.
    """
    metric = _r2_of if measured else _mean_of
    width = real[0].sums.shape[1]

    def gain(sums: Array) -> Array:
        return metric(sums[..., :width]) - metric(sums[..., width:])

    both = [
        GroupSums(a.groups, np.concatenate([a.sums, b.sums], 1))
        for a, b in zip(real, other, strict=True)
    ]
    low, high = _bootstrap_interval(both, gain)
    return {
        "difference": float(np.mean([gain(run.sums.sum(0)) for run in both])),
        "low": low,
        "high": high,
    }


def _bootstrap_interval(
    runs: Sequence[GroupSums], of: Callable[[Array], Array]
) -> tuple[float | None, float | None]:
    """Return the 95 % percentile interval of the mean over runs of `of` (sums -> number).

    Groups, which all runs share, and runs are resampled. (None, None) with fewer than two groups,
    or no value.
    """
    names = np.unique(np.concatenate([run.groups for run in runs]))
    if len(names) < 2:
        return None, None
    totals = np.zeros((len(runs), len(names), runs[0].sums.shape[1]))
    for total, run in zip(totals, runs, strict=True):
        np.add.at(total, np.searchsorted(names, run.groups), run.sums)
    # the draws of many groups are not kept
    draw = _draws if len(names) <= 5000 else _draws.__wrapped__
    shares = np.concatenate(_draws(len(runs), stream=1)) / len(runs)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.concatenate(
            [[of(times @ total) for total in totals] for times in draw(len(names), 0)], axis=1
        ).T
    means = np.where(shares > 0, shares * values, 0).sum(1)
    means = means[np.isfinite(means)]
    if means.size:
        return tuple(np.percentile(means, [2.5, 97.5]).tolist())
    return (None, None)


@functools.lru_cache(maxsize=4)  # drawing takes nine tenths of the time of an interval
def _draws(count: int, stream: int) -> list[Array]:
    """Return how often each of `count` groups is drawn, u8 (1000, count) at a time, DRAWS in all;
    streams differ.
    """
    rng = np.random.default_rng(stream)
    shares = np.full(count, 1 / count)
    return [
        rng.multinomial(count, shares, size=1000).astype(np.uint8) for _ in range(DRAWS // 1000)
    ]


def mean_interval(values: Array, groups: Array) -> tuple[float | None, float | None]:
    """Return the 95 % percentile interval of the mean of `values` (n,) under a bootstrap over
    `groups` (n,).
    """
    return _bootstrap_interval([classification_sums(values, groups)], _mean_of)


def scores(
    runs: Sequence[GroupSums], baselines: Sequence[GroupSums], measured: bool
) -> dict[str, Any]:
    """Return mean, interval, values and chance of accuracy (R2 and MAE if `measured`), a run for
    each seed.
    """

    def values(of: Callable[[Array], Array], several: Sequence[GroupSums]) -> list[float]:
        return [float(of(run.sums.sum(0))) for run in several]

    metric = _r2_of if measured else _mean_of
    low, high = _bootstrap_interval(runs, metric)
    result: dict[str, Any] = {
        "metric": "r2" if measured else "accuracy",
        "mean": float(np.mean(values(metric, runs))),
        "low": low,
        "high": high,
        "values": values(metric, runs),
        "chance": float(np.mean(values(metric, baselines))),
    }
    if measured:
        mae_low, mae_high = _bootstrap_interval(runs, _mae_of)
        mae, chance = (float(np.mean(values(_mae_of, several))) for several in (runs, baselines))
        result |= {"mae": mae, "mae_low": mae_low, "mae_high": mae_high, "chance_mae": chance}
    return result


def plain(value: Any) -> Any:
    """Return a value for JSON: records as objects without their values per row, numbers that are
    not finite as null.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {
            one.name: plain(getattr(value, one.name))
            for one in fields
            if one.name not in ("outcome", "per_query")
        }
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[Any]], align: str = "") -> str:
    """Return a Markdown table; use it wherever a page, a report or a command prints one.

    Cells are converted to text; bars, line breaks, HTML and links in them are escaped. `align` has
    a letter per column, l or r for left or right; without it the reader's program decides.

    >>> print(markdown_table(("sensor", "recall@1"), [("digit", 0.5)], "lr"))
    | sensor | recall@1 |
    | :--- | ---: |
    | digit | 0.5 |
    """
    marks = {"l": ":---", "r": "---:"}
    rule = [marks[letter] for letter in align] if align else ["---"] * len(header)
    lines = [
        [without_html(cell).replace("|", "\\|") for cell in line] for line in (header, rule, *rows)
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def without_html(value: Any) -> str:
    """Return one line of Markdown without HTML, links and attributes of elements, whatever the
    value says.
    """
    text = re.sub(r"&(?=#?\w+;)", "&amp;", " ".join(str(value).split()))
    return re.sub(r"<(?=[A-Za-z/!?])", "&lt;", text).replace("](", "]\\(").replace("{", "&#123;")


def as_text(value: Any) -> str:
    """Return one line of Markdown that a reader sees as the value is written: for names and
    captions of a user.
    """
    return re.sub(
        r"[\\`*\[\]~]|(?<![^\W_])_|_(?![^\W_])",
        r"\\\g<0>",
        without_html(value).replace("]\\(", "]("),
    )


def verdict(name: str, gain: Mapping[str, float | None], task: str = "") -> str:
    """Return a sentence on features against raw pixels, from a `paired_gain`."""
    points, low, high = (100 * (gain[key] or 0.0) for key in ("difference", "low", "high"))
    of = f"{task}: " if task else ""
    if gain["low"] is None:
        return (
            f"{of}{name} is {points:+.0f} points from raw pixels, by too few test recordings to be "
            "sure."
        )
    interval = f"({low:.0f} to {high:.0f})"
    if low > 0:
        return f"{of}{name} is {points:.0f} points above raw pixels {interval}."
    return (
        f"{of}{name} is no better than raw pixels: {points:+.0f} points {interval}. Try --pooling "
        "both, more "
        "recordings, or another encoder, and look at the untouched gel with `anytouch view`."
    )


def label_verdicts(results: Sequence[Any]) -> list[str]:
    """Return a sentence on each source of features of `probe_label` against raw pixels, by its
    first head.
    """
    first: dict[str, Any] = {}
    for result in results:
        first.setdefault(result.probe.partition(": ")[0], result)
    sums = {
        name: classification_sums(one.outcome.correct, one.outcome.groups)
        for name, one in first.items()
        if one.outcome is not None and ": " in one.probe
    }
    raw = sums.pop(RAW, None)
    sums.pop(RANDOM, None)
    if raw is None:
        return []
    return [verdict(name, paired_gain([one], [raw], False)) for name, one in sums.items()]


def share_text(value: float | None) -> str:
    """Return a share in percent as text, "-" if there is none."""
    if value is None or np.isnan(value):
        return "-"
    return f"{100 * value:.1f} %"


def interval_text(
    low: float | None, high: float | None, factor: float = 100.0, digits: int = 1
) -> str:
    """Return an interval as text, "-" if there is none; shares are in points by default."""
    if low is None or high is None:
        return "-"
    return f"{factor * low:.{digits}f} to {factor * high:.{digits}f}"
