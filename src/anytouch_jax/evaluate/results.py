"""Results of probes: records of scores, their JSON and their Markdown table."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from anytouch_jax.evaluate.statistics import Array, GroupSums, Protocol
from anytouch_jax.evaluate.tables import fraction_text, interval_text, markdown_table, plain
from anytouch_jax.shown import shown_short

if TYPE_CHECKING:
    from anytouch_jax.evaluate.heads import LinearModel

NAN = float("nan")
# Fields of a `ProbeResult` that a probe of classes, or of numbers, has alone.
_OF_CLASSES = (
    "accuracy",
    "balanced_accuracy",
    "baseline",
    "refit_mean",
    "refit_std",
    "seeds",
    "classes",
    "parts",
)
_OF_NUMBERS = (
    "r2",
    "mae",
    "mae_low",
    "mae_high",
    "baseline_mae",
    "spearman",
    "spearman_low",
    "spearman_high",
)


@dataclass(frozen=True)
class SubsetResult:
    """Accuracy on a named part of the test rows; `low`, `high` as in `ProbeResult`."""

    name: str
    accuracy: float
    low: float | None
    high: float | None
    n_test: int


@shown_short
@dataclass(frozen=True, eq=False)
class Outcome:
    """The test rows of a result, one by one.

    Attributes:
        rows: places (n,) of the rows.
        correct: whether each was right, bool (n,); empty for a continuous label.
        groups: names (n,).
        sums: by which they are scored.
        fitted: the linear model and the names of its classes.
    """

    rows: Array
    correct: Array
    groups: Array
    sums: GroupSums
    fitted: tuple[LinearModel | None, Array] | None = None


@shown_short
@dataclass(frozen=True)
class ProbeResult:
    """The score of a head fitted on all of train, on the test rows. Fractions are in 0..1.

    Attributes:
        probe: its name in tables.
        protocol: how the penalty was chosen; see `splits`.
        low: lower end of the 95 % interval of the accuracy or R2 under a bootstrap over the test
            groups, None with fewer than two.
        high: its upper end.
        penalty: the penalty (k, epoch) that was selected.
        chosen_on: what it was selected on. If that is test, the score is an upper estimate.
        n_train: rows that were fitted on.
        n_test: rows that were tested on.
        test_groups: groups of the test rows.
        accuracy: of the test rows. A class that train lacks counts as an error.
        balanced_accuracy: the mean of the accuracies of the classes.
        baseline: accuracy of the most frequent class of train.
        refit_mean: accuracy of `seeds` heads fitted on bootstraps of the train groups. It is a
            little lower than `accuracy`, because a bootstrap holds some 63 % of the groups.
        refit_std: its standard deviation over these heads.
        seeds: how many there are.
        classes: the classes of train.
        parts: accuracy on named parts of the test rows.
        r2: of a continuous label, NaN for classes.
        mae: mean absolute error in units of the label.
        mae_low: lower end of its 95 % interval.
        mae_high: upper end.
        baseline_mae: mean absolute error of train's mean.
        spearman: rank correlation of predictions and labels, None where one of them is constant.
        spearman_low: lower end of its 95 % interval.
        spearman_high: upper end.
        notes: what a reader of the score should know.
        outcome: the test rows one by one; not in JSON.
    """

    probe: str
    protocol: Protocol
    low: float | None
    high: float | None
    penalty: float | None
    chosen_on: str
    n_train: int
    n_test: int
    test_groups: int
    accuracy: float = NAN
    balanced_accuracy: float = NAN
    baseline: float = NAN
    refit_mean: float | None = None
    refit_std: float | None = None
    seeds: int = 0
    classes: tuple[str, ...] = ()
    parts: tuple[SubsetResult, ...] = ()
    r2: float = NAN
    mae: float = NAN
    mae_low: float | None = None
    mae_high: float | None = None
    baseline_mae: float = NAN
    spearman: float | None = None
    spearman_low: float | None = None
    spearman_high: float | None = None
    notes: tuple[str, ...] = ()
    outcome: Outcome | None = field(default=None, repr=False, compare=False)

    @property
    def regression(self) -> bool:
        """Whether the label is continuous, so that the head is a regression."""
        return not np.isnan(self.r2)


def probe_json(results: Sequence[ProbeResult]) -> str:
    """Return the results as a JSON list of objects, without outcomes.

    A number that does not exist is null. Fields of the other kind of label are left out.
    """
    records = []
    for result in results:
        others = _OF_CLASSES if result.regression else _OF_NUMBERS
        record = plain(result)
        records.append({name: value for name, value in record.items() if name not in others})
    return json.dumps(records, indent=2, allow_nan=False)


def probe_table(
    results: Sequence[ProbeResult | Mapping[str, Any]],
    paper: float | None = None,
    *,
    details: bool = False,
) -> str:
    """Return results, or results of `probe_tasks`, as one Markdown table, with the notes below.

    Args:
        results: of `probe_features`, `leave_groups_out` or `probe_label`, or the entries of
            `probe_tasks(...)["results"]`.
        paper: the accuracy of AnyTouch in the paper, 0..1.
        details: also a row for each part of the test rows.
    """
    lines = list[dict[str, str]]()
    notes = list[str]()
    for result in results:
        if isinstance(result, ProbeResult):
            lines.append(_result_cells(result))
            if details:
                lines += _part_cells(result)
            notes += [f"- {result.probe} ({result.protocol}): {note}" for note in result.notes]
        else:
            columns = ("features", "task", "head", "protocol")
            names = {name: result.get(name, "") for name in columns}
            lines.append(names | _score_cells(result))
            notes += [f"- {result['task']}: {note}" for note in result["notes"]]
    if paper is not None:
        notes.append(
            f"- the paper reports {100 * paper:.2f} % for AnyTouch, its epoch chosen on test"
        )
    header = list(dict.fromkeys(column for line in lines for column in line))
    cells = [[line.get(column, "") for column in header] for line in lines]
    blocks = [markdown_table(header, cells)]
    if notes:
        blocks.append("\n".join(dict.fromkeys(notes)))
    return "\n\n".join(blocks) + "\n"


def _result_cells(result: ProbeResult) -> dict[str, str]:
    """Return the cells of a result by column."""
    line = {"probe": result.probe, "protocol": result.protocol}
    line |= _score_cells(
        {
            "metric": "r2" if result.regression else "accuracy",
            "mean": result.r2 if result.regression else result.accuracy,
            "low": result.low,
            "high": result.high,
            "chance": result.baseline,
            "mae": result.mae,
            "unit": "",
            "chance_mae": result.baseline_mae,
            "spearman": result.spearman,
            "spearman_low": result.spearman_low,
            "spearman_high": result.spearman_high,
            "train": result.n_train,
            "test": result.n_test,
            "groups": result.test_groups,
        }
    )
    if result.regression:
        line["MAE 95 %"] = interval_text(result.mae_low, result.mae_high, 1.0, 3)
    else:
        line["balanced"] = fraction_text(result.balanced_accuracy)
        line["refits"] = "-"
        if result.seeds:
            deviation = 100 * (result.refit_std or 0)
            line["refits"] = f"{fraction_text(result.refit_mean)} ± {deviation:.1f}"
        line["classes"] = str(len(result.classes))
    line["penalty or k"] = "-"
    if result.penalty is not None:
        line["penalty or k"] = f"{result.penalty:g} ({result.chosen_on})"
    return line


def _part_cells(result: ProbeResult) -> list[dict[str, str]]:
    """Return the cells of each part of a result by column."""
    lines = []
    for part in result.parts:
        lines.append(
            {
                "probe": f"{result.probe}: {part.name}",
                "protocol": result.protocol,
                "score": fraction_text(part.accuracy),
                "95 %": interval_text(part.low, part.high),
                "test (groups)": str(part.n_test),
            }
        )
    return lines


def _score_cells(row: Mapping[str, Any]) -> dict[str, str]:
    """Return the cells of a result of `probe_tasks` that every table has."""
    more = {}
    if row["metric"] == "r2":
        mae = f"{row['mae']:.3g} {row['unit']}".strip()
        score = f"R2 {row['mean']:.3f}, {mae}"
        interval = interval_text(row["low"], row["high"], 1.0, 3)
        chance = f"{row['chance_mae']:.3g} {row['unit']}".strip()
        more["Spearman"] = _rank_text(row)
    else:
        score = fraction_text(row["mean"])
        interval = interval_text(row["low"], row["high"])
        chance = fraction_text(row["chance"])
    return {
        "score": score,
        "95 %": interval,
        "chance": chance,
        "train": str(row["train"]),
        "test (groups)": f"{row['test']} ({row['groups']})",
        **more,
    }


def _rank_text(row: Mapping[str, Any]) -> str:
    """Return Spearman's correlation with its interval, "-" for constant predictions."""
    if row.get("spearman") is None:
        return "-"
    text = f"{row['spearman']:.3f}"
    if row["spearman_low"] is None:
        return text
    return f"{text} ({interval_text(row['spearman_low'], row['spearman_high'], 1.0, 3)})"
