"""What a probe reports: frozen records, intervals over groups, Markdown and JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError

Array = npt.NDArray[Any]
Protocol = Literal["honest", "published"]


@dataclass(frozen=True)
class Part:
    """Accuracy of a fit on a named part of its test rows; `low`, `high` as in `ProbeResult`."""

    name: str
    accuracy: float
    low: float | None
    high: float | None
    n_test: int


@dataclass(frozen=True, eq=False)
class Outcome:
    """Test row by test row: number of the row, whether it was right, its group. What `difference` pairs.

    `fitted`: the linear model that was tested, and the names (K,) that its class numbers count.
    """

    rows: Array
    correct: Array
    groups: Array
    fitted: tuple[Any, Array] | None = None


@dataclass(frozen=True)
class ProbeResult:
    """A classification probe. Shares are in 0..1.

    `accuracy`, `balanced_accuracy`: of the model fitted on all of train, on the test rows; a test row of a class
    that train lacks counts as an error. `low`, `high`: 95 % percentile interval of that accuracy when the test
    *groups* (recordings), not the frames, are drawn anew with replacement: what other recordings of the same kind
    would give for this fitted model. None with fewer than two test groups. `refit_mean`, `refit_std`: accuracy of
    `seeds` models fitted on bootstraps of the train groups: what other training recordings would give (each sees
    some 63 % of the recordings, so the mean lies a little below `accuracy`). `baseline`: accuracy of always naming
    the commonest class of train. `protocol` honest: `penalty` (k for kNN) was chosen without the test set, on
    `chosen_on`; published: on the test set, as the authors' released code does, so the accuracy is an upper estimate.
    """

    probe: str
    protocol: Protocol
    accuracy: float
    balanced_accuracy: float
    low: float | None
    high: float | None
    baseline: float
    refit_mean: float | None
    refit_std: float | None
    seeds: int
    penalty: float | None
    chosen_on: str
    n_train: int
    n_test: int
    test_groups: int
    classes: tuple[str, ...]
    parts: tuple[Part, ...] = ()
    notes: tuple[str, ...] = ()
    outcome: Outcome | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class RegressionResult:
    """A regression probe: `r2` (1 - squared error / variance of the test labels) and `mae` in units of the label.

    `low`, `high` bound R2 as in `ProbeResult`; `baseline_mae` is that of always naming the mean of train.
    """

    probe: str
    protocol: Protocol
    r2: float
    low: float | None
    high: float | None
    mae: float
    mae_low: float | None
    mae_high: float | None
    baseline_mae: float
    penalty: float
    chosen_on: str
    n_train: int
    n_test: int
    test_groups: int
    notes: tuple[str, ...] = ()


Result = ProbeResult | RegressionResult


DRAWS = 10_000  # bootstraps of an interval: with a tenth of them its ends are 0.09 standard errors off, now 0.03


def group_draws(count: int, stream: int = 0) -> Iterator[Array]:
    """How often each of `count` groups is drawn in a bootstrap, i64 (1000, count) at a time, DRAWS in all.

    Another `stream` draws independently.
    """
    rng = np.random.default_rng(stream)
    for _ in range(DRAWS // 1000):
        yield rng.multinomial(count, np.full(count, 1 / count), size=1000)


class GroupSums(NamedTuple):
    """Test rows of one run: `groups` (n,), and what is summed over them, f64 (n, sums)."""

    groups: Array
    sums: Array


def classification_sums(correct: Array, groups: Array) -> GroupSums:
    """Return the sums that `mean_of` divides, of values (n,) or of rows that are right or wrong."""
    return GroupSums(groups, np.stack([np.asarray(correct, np.float64), np.ones(len(correct))], 1))


def regression_sums(error: Array, truth: Array, groups: Array) -> GroupSums:
    """Return the sums of `r2_of` and `mae_of`; `truth` is best centred, as the square of an offset hides the spread."""
    return GroupSums(groups, np.stack([error**2, np.abs(error), truth, truth**2, np.ones(len(error))], 1))


def mean_of(sums: Array) -> Array:
    """Return the mean (accuracy) from sums (..., [values, rows])."""
    return np.asarray(sums[..., 0] / sums[..., 1])


def r2_of(sums: Array) -> Array:
    """Return R2 from sums (..., [squared error, absolute error, truth, squared truth, rows]); NaN for equal labels."""
    spread = sums[..., 3] - sums[..., 2] ** 2 / sums[..., 4]
    return np.asarray(1 - sums[..., 0] / np.where(spread > 1e-12 * sums[..., 3], spread, np.nan))


def mae_of(sums: Array) -> Array:
    """Return the mean absolute error from sums as `r2_of` reads them."""
    return np.asarray(sums[..., 1] / sums[..., 4])


def bootstrap_interval(runs: Sequence[GroupSums], value: Callable[[Array], Array]) -> tuple[float | None, float | None]:
    """Return the 95 % percentile interval of the mean over runs of `value` (sums -> number).

    Groups and runs (seeds) are resampled with replacement; the runs share the drawn groups, as they share the test
    rows. The interval is too narrow with a handful of groups or of runs. (None, None) with fewer than two groups, and
    where no draw has a value.
    """
    names = np.unique(np.concatenate([run.groups for run in runs]))
    if len(names) < 2:
        return None, None
    totals = np.zeros((len(runs), len(names), runs[0].sums.shape[1]))
    for total, run in zip(totals, runs, strict=True):
        np.add.at(total, np.searchsorted(names, run.groups), run.sums)
    shares = np.concatenate(list(group_draws(len(runs), stream=1))) / len(runs)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.concatenate(
            [np.stack([value(times @ total) for total in totals], 1) for times in group_draws(len(names))]
        )
    drawn = np.where(shares > 0, shares * values, 0).sum(1)
    drawn = drawn[np.isfinite(drawn)]
    if not drawn.size:
        return None, None
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(low), float(high)


def mean_interval(values: Array, groups: Array) -> tuple[float | None, float | None]:
    """Return the 95 % percentile interval of the mean of `values` (n,) under a bootstrap over `groups` (n,)."""
    return bootstrap_interval([classification_sums(values, groups)], mean_of)


def r2_interval(error: Array, truth: Array, groups: Array) -> tuple[float | None, float | None]:
    """Return the 95 % percentile interval of R2 under a bootstrap over `groups`; `error`, `truth` (n,)."""
    return bootstrap_interval([regression_sums(error, truth - truth.mean(), groups)], r2_of)


def seed_interval(several: Sequence[float]) -> tuple[float | None, float | None]:
    """95 % interval of the mean over seeds, by Student's t; (None, None) below two."""
    if len(several) < 2:
        return None, None
    from scipy.stats import t

    half = float(t.ppf(0.975, len(several) - 1) * np.std(several, ddof=1) / np.sqrt(len(several)))
    return float(np.mean(several)) - half, float(np.mean(several)) + half


CLAIM = 3  # seeds from which a sign is claimed


def verdict(low: float | None, high: float | None, seeds: int, *, wanted: float = 1.0) -> str:
    """What the interval of a difference says of a claim that it has the sign of `wanted`.

    "agrees" or "disagrees" where zero lies outside, else "undecided"; below CLAIM seeds "1 seed, no claim".
    """
    if seeds < CLAIM:
        return f"{seeds} seed{'s' if seeds > 1 else ''}, no claim"
    if low is None or high is None or low <= 0 <= high:
        return "undecided"
    return "agrees" if (low > 0) == (wanted > 0) else "disagrees"


def difference(first: ProbeResult, second: ProbeResult) -> tuple[float, float | None, float | None]:
    """Accuracy of `first` minus that of `second` with its 95 % interval over groups, paired by test row.

    Two encoders err on the same hard recordings, so this is much narrower than two intervals side by side. Raises
    UserError when the two were not tested on the same rows.
    """
    a, b = first.outcome, second.outcome
    if a is None or b is None or not np.array_equal(a.rows, b.rows) or not np.array_equal(a.groups, b.groups):
        raise UserError(
            f"{first.probe!r} and {second.probe!r} were not tested on the same rows; give both the same table"
        )
    change = a.correct.astype(np.float64) - b.correct
    return float(change.mean()), *mean_interval(change, a.groups)


def parts_of(correct: Array, groups: Array, subsets: Mapping[str, Array], test: Array) -> tuple[Part, ...]:
    """`correct` and `groups` of the test rows, cut by `subsets` (masks over all rows; `test` are the rows' numbers)."""
    found = []
    for name, mask in subsets.items():
        chosen = np.asarray(mask, bool)[test]
        if chosen.any():
            low, high = mean_interval(correct[chosen], groups[chosen])
            found.append(Part(name, float(correct[chosen].mean()), low, high, int(chosen.sum())))
        else:
            found.append(Part(name, float("nan"), None, None, 0))
    return tuple(found)


def to_json(results: Sequence[Result]) -> str:
    """The results as a JSON list of objects, without outcomes; a number that does not exist is null."""
    return json.dumps(plain(results), indent=2, allow_nan=False)


def plain(value: Any) -> Any:
    """A value as JSON takes it: records as objects without what single rows did, what is not finite as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {one.name: plain(getattr(value, one.name)) for one in fields if one.name not in ("outcome", "found")}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not np.isfinite(value) else value


def to_table(results: Sequence[Result]) -> str:
    """The results as Markdown: one table of classification, one of regression, then the notes."""
    blocks = []
    classified = [one for one in results if isinstance(one, ProbeResult)]
    regressed = [one for one in results if isinstance(one, RegressionResult)]
    if classified:
        head = ("probe", "protocol", "accuracy", "95 % over test groups", "balanced", "commonest class", "refits")
        blocks.append(markdown((*head, "train", "test (groups)", "classes", "penalty or k"), _class_rows(classified)))
    if regressed:
        head = ("probe", "protocol", "R2", "95 % over test groups", "MAE", "MAE 95 %", "MAE of the mean")
        blocks.append(markdown((*head, "train", "test (groups)", "penalty"), _regression_rows(regressed)))
    notes = dict.fromkeys(f"- {one.probe} ({one.protocol}): {note}" for one in results for note in one.notes)
    if notes:
        blocks.append("\n".join(notes))
    return "\n\n".join(blocks) + "\n"


def _class_rows(results: Sequence[ProbeResult]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for one in results:
        refits = "-" if one.refit_mean is None else f"{_share(one.refit_mean)} ± {100 * (one.refit_std or 0):.1f}"
        chosen = "-" if one.penalty is None else f"{one.penalty:g} ({one.chosen_on})"
        interval, size = _interval(one.low, one.high), f"{one.n_test} ({one.test_groups})"
        shares = (_share(one.accuracy), interval, _share(one.balanced_accuracy), _share(one.baseline), refits)
        rows.append((one.probe, one.protocol, *shares, str(one.n_train), size, str(len(one.classes)), chosen))
        for part in one.parts:
            cells = (_share(part.accuracy), _interval(part.low, part.high), "", "", "", "", str(part.n_test), "", "")
            rows.append((f"{one.probe}: {part.name}", one.protocol, *cells))
    return rows


def _regression_rows(results: Sequence[RegressionResult]) -> list[tuple[str, ...]]:
    return [
        (
            *(one.probe, one.protocol, f"{one.r2:.3f}", _interval(one.low, one.high, 1.0, 3)),
            *(f"{one.mae:.4g}", _interval(one.mae_low, one.mae_high, 1.0, 3), f"{one.baseline_mae:.4g}"),
            *(str(one.n_train), f"{one.n_test} ({one.test_groups})", f"{one.penalty:g} ({one.chosen_on})"),
        )
        for one in results
    ]


def _share(value: float) -> str:
    return "-" if np.isnan(value) else f"{100 * value:.1f} %"


def _interval(low: float | None, high: float | None, factor: float = 100.0, digits: int = 1) -> str:
    return "-" if low is None or high is None else f"{factor * low:.{digits}f} to {factor * high:.{digits}f}"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table of texts; bars and line breaks in a cell are made harmless."""
    lines = [head, ["---"] * len(head), *rows]
    clean = [[" ".join(str(cell).split()).replace("|", "\\|") for cell in line] for line in lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in clean)
