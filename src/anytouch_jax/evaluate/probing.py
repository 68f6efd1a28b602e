"""Probes of frozen features: of arrays, a label column, named tasks, or a public benchmark; their
results and tables.

A task selects rows and labels. Frames are never augmented. The protocols are those of `splits`. In
tasks, "honest" splits whole groups (objects, recordings) again by every seed, and "published" keeps
the manifest's split.

Probes of arrays take `features` (n, d); `labels` (n,), where None, "" or NaN is no label; `groups`
(n,), which no fold or bootstrap cuts; and `split` (n,), "train", "val" or "test" for the rows that
take part.
"""

import dataclasses
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from anytouch_jax.data.background.rule import UnitGels
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Join, Log, Pooling
from anytouch_jax.encoder.linear_head import COVERAGE, FALSE_ALARMS, LinearHead, save_head
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import feature_cache, splits, statistics, tasks
from anytouch_jax.evaluate import heads as probe_heads
from anytouch_jax.evaluate.feature_cache import RANDOM, RAW, FeatureSource, Order
from anytouch_jax.evaluate.heads import GradientRecipe, HeadName, LinearModel, ProbeHead, Scaling
from anytouch_jax.evaluate.splits import SIDES, LabelledFeatures, RowRoles, Selection, Split
from anytouch_jax.evaluate.statistics import (
    Array,
    GroupSums,
    Protocol,
    interval_text,
    share_text,
    verdict,
)
from anytouch_jax.evaluate.tasks import Task, TaskRows
from anytouch_jax.files import atomic_write
from anytouch_jax.progress import tracked
from anytouch_jax.shown import shown_short

Subsets = Mapping[str, Array]
Paths = Sequence[str | Path]
Models = Sequence[str | Path | FeatureSource]
Names = Sequence[str] | None

NAN = float("nan")
OF_CLASSES = (
    "accuracy",
    "balanced_accuracy",
    "baseline",
    "refit_mean",
    "refit_std",
    "seeds",
    "classes",
    "parts",
)
OF_NUMBERS = ("r2", "mae", "mae_low", "mae_high", "baseline_mae")


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
    """The test rows, whether each was right, and its group; `fitted`: the linear model and the
    names of its classes.
    """

    rows: Array
    correct: Array
    groups: Array
    fitted: tuple[Any, Array] | None = None


@shown_short
@dataclass(frozen=True)
class ProbeResult:
    """The score of a head fitted on all of train, on the test rows. Shares are in 0..1.

    `low`, `high`: 95 % interval of the accuracy or R2 under a bootstrap over the test groups, None
    with fewer than two. `penalty` (k, epoch) was selected on `chosen_on`. If that is test, the
    score is an upper estimate. A class that train lacks counts as an error. `baseline` is the most
    frequent class of train. `refit_mean`, `refit_std`: accuracy of `seeds` heads fitted on
    bootstraps of the train groups, a little lower. `mae` is in units of the label, `baseline_mae`
    that of train's mean.
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
    notes: tuple[str, ...] = ()
    outcome: Outcome | None = field(default=None, repr=False, compare=False)

    @property
    def measured(self) -> bool:
        """Whether the label is a number."""
        return not np.isnan(self.r2)


def probe_features(
    features: Array,
    labels: Any,
    groups: Any,
    split: Any,
    head: ProbeHead | None = None,
    *,
    measured: bool = False,
    protocol: Protocol = "honest",
    seeds: int = 5,
    subsets: Subsets | None = None,
    name: str = "linear",
) -> ProbeResult:
    """Probe with a head (default: linear) that is selected and fitted on train, and tested on test.

    `measured`: labels are numbers. `seeds` heads of classes are fitted on bootstraps of the train
    groups too. `subsets` (name -> mask over all rows) report parts of test. Raises UserError as
    `check_rows`.
    """
    data, rows, notes = splits.check_rows(features, labels, groups, split, measured=measured)
    head = head or ProbeHead()
    selected, model, predicted = _predict(data, rows, head, protocol, refit=True)
    if selected.chosen_on == "test":
        notes += ("chosen on test, as the authors' code does: an upper estimate",)
    scores = np.asarray(selected.scores)
    at_edge = (
        len(scores)
        and selected.place in (0, len(scores) - 1)
        and np.sum(scores == scores.max()) == 1
    )
    if at_edge and head.name == "linear":
        notes += (f"the chosen penalty {selected.option:g} lies at the edge of those tried",)
    if model is not None and not model.fit.finished:
        notes += ("the fit stopped at its limit of iterations",)
    result = _result(name, protocol, data, rows, predicted, selected, notes, subsets)
    bootstraps = tracked(
        list(splits.group_bootstraps(rows.fit, data.groups, 0 if measured else seeds)), "refits"
    )
    refits = []
    head = replace(head, options=(selected.option,))
    for ids, weights in bootstraps:
        (again,) = data.fit(head, ids, weights=weights, start=model).predict(data.x[rows.test])
        refits.append(float(np.mean(again == data.y[rows.test])))
    if refits:
        spread = float(np.std(refits, ddof=1)) if len(refits) > 1 else None
        result = replace(
            result, refit_mean=float(np.mean(refits)), refit_std=spread, seeds=len(refits)
        )
    return replace(
        result, outcome=result.outcome and replace(result.outcome, fitted=(model, data.names))
    )


def leave_groups_out(
    features: Array,
    labels: Any,
    groups: Any,
    *,
    folds: int | None = 10,
    penalties: Sequence[float] = (10.0, *probe_heads.PENALTIES),
    scaling: Scaling = "column",
    subsets: Subsets | None = None,
    name: str = "linear, groups left out",
) -> ProbeResult:
    """Probe each row with a linear fit on no row of its group, for instance on held-out objects.

    `folds` None: each group alone. The other groups select the penalty, and their commonest class
    is the baseline.
    """
    data, rows, notes = splits.check_rows(
        features, labels, groups, np.full(len(labels), "train"), tested=False
    )
    used = rows.fit
    chosen = []
    predicted = np.full(len(data.y), -1)
    baseline = np.full(len(data.y), -1)
    head = ProbeHead("linear", scaling, tuple(penalties))
    count = len(np.unique(data.groups[used])) if folds is None else folds
    for fit, out in tracked(list(splits.group_folds(used, data.groups, data.y, count)), "folds"):
        cut = Split(fit, fit[:0], out)
        selected, _, predicted[out] = _predict(data, cut, head, "honest", refit=True)
        chosen.append(selected.option)
        baseline[out] = _constant(data, cut)
    values, times = np.unique(chosen, return_counts=True)
    counts = ", ".join(f"{value:g} ({count} x)" for value, count in zip(values, times, strict=True))
    selected = Selection(0, float(np.median(chosen)), "cross-validation, median of the folds")
    notes += (f"penalties of the folds: {counts}",)
    rows = Split(used, used[:0], used)
    return _result(
        name, "honest", data, rows, predicted[used], selected, notes, subsets, baseline[used]
    )


def _predict(
    data: LabelledFeatures, cut: Split, head: ProbeHead, protocol: Protocol, *, refit: bool = False
) -> tuple[Selection, LinearModel | None, Array]:
    """Return the selected option, its logistic model and its predictions for the test rows; `refit`
    without a start.
    """
    selected = splits.select_option(head, data, cut, protocol)
    fitted = selected.fitted
    place = selected.place
    if refit or fitted is None or (head.name != "gradient" and len(cut.fit) > splits.SELECT_ROWS):
        start = fitted.models[place] if fitted and fitted.models and not refit else None
        fitted = data.fit(replace(head, options=(selected.option,)), cut.fit, start=start)
        place = 0
    return (
        selected,
        fitted.models[place] if fitted.models else None,
        fitted.predict(data.x[cut.test])[place],
    )


def _constant(data: LabelledFeatures, cut: Split) -> Array:
    """Return the most frequent class (the smallest of equals) or the mean of the fitted rows for
    each test row.
    """
    y = data.y[cut.fit]
    return np.full(len(cut.test), np.bincount(y).argmax() if len(data.names) else y.mean())


def _sums(data: LabelledFeatures, predicted: Array, tested: Array) -> GroupSums:
    truth = data.y[tested]
    groups = data.groups[tested]
    if len(data.names):
        return statistics.classification_sums(predicted == truth, groups)
    return statistics.regression_sums(predicted - truth, truth - truth.mean(), groups)


def _result(
    name: str,
    protocol: Protocol,
    data: LabelledFeatures,
    rows: Split,
    predicted: Array,
    selected: Selection | None,
    notes: tuple[str, ...],
    subsets: Subsets | None,
    constant: Array | None = None,
) -> ProbeResult:
    """Return the scores of predictions for the test rows, and of a constant (default: that of
    train).
    """
    truth = data.y[rows.test]
    groups = data.groups[rows.test]
    measured = not len(data.names)
    constant = _constant(data, rows) if constant is None else constant
    scored = statistics.scores(
        [_sums(data, predicted, rows.test)], [_sums(data, constant, rows.test)], measured
    )
    if measured:
        scores = {name: scored[name] for name in ("mae", "mae_low", "mae_high")}
        scores |= {"r2": scored["mean"], "baseline_mae": scored["chance_mae"]}
    else:
        correct = predicted == truth
        parts = []
        for part, mask in (subsets or {}).items():
            kept = np.asarray(mask, bool)[rows.test]
            interval = statistics.mean_interval(correct[kept], groups[kept])
            accuracy = float(correct[kept].mean()) if kept.any() else NAN
            parts.append(SubsetResult(part, accuracy, *interval, int(kept.sum())))
        scores = {
            "accuracy": scored["mean"],
            "baseline": scored["chance"],
            "parts": tuple(parts),
            "balanced_accuracy": float(
                np.mean([correct[truth == number].mean() for number in np.unique(truth)])
            ),
            "classes": tuple(map(str, data.names[np.unique(data.y[rows.fit])])),
            "outcome": Outcome(rows.test, correct, groups),
        }
        notes = (
            notes if scored["low"] is not None else (*notes, "test has one group only: no interval")
        )
    option, chosen_on = (selected.option, selected.chosen_on) if selected else (None, "")
    sizes = (len(rows.fit), len(rows.test), len(np.unique(groups)))
    return ProbeResult(
        name,
        protocol,
        scored["low"],
        scored["high"],
        option,
        chosen_on,
        *sizes,
        **scores,
        notes=notes,
    )


def probe_json(results: Sequence[ProbeResult]) -> str:
    """Return the results as a JSON list of objects, without outcomes; a number that does not exist
    is null.
    """
    records = []
    for result in results:
        others = OF_CLASSES if result.measured else OF_NUMBERS
        records.append(
            {name: value for name, value in statistics.plain(result).items() if name not in others}
        )
    return json.dumps(records, indent=2, allow_nan=False)


def probe_table(
    results: Sequence[ProbeResult | Mapping[str, Any]],
    paper: float | None = None,
    *,
    details: bool = False,
) -> str:
    """Return results, or results of `probe_tasks`, as one Markdown table, with the notes below.

    `paper`: the accuracy of AnyTouch in the paper. `details`: also a row for each part of the test
    rows.
    """
    lines = list[dict[str, str]]()
    notes = list[str]()
    for result in results:
        if isinstance(result, ProbeResult):
            lines += _result_lines(result)[: None if details else 1]
            notes += [f"- {result.probe} ({result.protocol}): {note}" for note in result.notes]
        else:
            names = {
                name: result.get(name, "") for name in ("features", "task", "head", "protocol")
            }
            lines.append(names | _score_cells(result))
            notes += [f"- {result['task']}: {note}" for note in result["notes"]]
    if paper is not None:
        notes.append(
            f"- the paper reports {100 * paper:.2f} % for AnyTouch, its epoch chosen on test"
        )
    header = list(dict.fromkeys(column for line in lines for column in line))
    table = statistics.markdown_table(
        header, [[line.get(column, "") for column in header] for line in lines]
    )
    return "\n\n".join([table, *(["\n".join(dict.fromkeys(notes))] if notes else [])]) + "\n"


def _result_lines(result: ProbeResult) -> list[dict[str, str]]:
    """Return the cells of a result, and of its parts, by column."""
    line = {"probe": result.probe, "protocol": result.protocol} | _score_cells(
        {
            "metric": "r2" if result.measured else "accuracy",
            "mean": result.r2 if result.measured else result.accuracy,
            "low": result.low,
            "high": result.high,
            "chance": result.baseline,
            "mae": result.mae,
            "unit": "",
            "chance_mae": result.baseline_mae,
            "train": result.n_train,
            "test": result.n_test,
            "groups": result.test_groups,
        }
    )
    if result.measured:
        line["MAE 95 %"] = interval_text(result.mae_low, result.mae_high, 1.0, 3)
    else:
        refits = (
            f"{share_text(result.refit_mean)} ± {100 * (result.refit_std or 0):.1f}"
            if result.seeds
            else "-"
        )
        line |= {
            "balanced": share_text(result.balanced_accuracy),
            "refits": refits,
            "classes": str(len(result.classes)),
        }
    line["penalty or k"] = (
        "-" if result.penalty is None else f"{result.penalty:g} ({result.chosen_on})"
    )
    parts = [
        {
            "probe": f"{result.probe}: {part.name}",
            "protocol": result.protocol,
            "score": share_text(part.accuracy),
            "95 %": interval_text(part.low, part.high),
            "test (groups)": str(part.n_test),
        }
        for part in result.parts
    ]
    return [line, *parts]


def _score_cells(row: Mapping[str, Any]) -> dict[str, str]:
    """Return the cells of a result of `probe_tasks` that every table has."""
    score = share_text(row["mean"])
    interval = interval_text(row["low"], row["high"])
    chance = share_text(row["chance"])
    if row["metric"] == "r2":
        mae, chance = (f"{row[name]:.3g} {row['unit']}".strip() for name in ("mae", "chance_mae"))
        score = f"R2 {row['mean']:.3f}, {mae}"
        interval = interval_text(row["low"], row["high"], 1.0, 3)
    sizes = {"train": str(row["train"]), "test (groups)": f"{row['test']} ({row['groups']})"}
    return {"score": score, "95 %": interval, "chance": chance} | sizes


def probe_label(
    models: Models,
    data: Paths,
    label: str = "object",
    *,
    features: Paths = (),
    group: str = "",
    leave_out: str | None = None,
    where: tuple[str, float] | None = None,
    sensor: str | None = None,
    frames: int = 1,
    pooling: Pooling = "class",
    join: Join = "mean",
    seeds: int = 5,
    protocol: Protocol = "honest",
    controls: bool = True,
    cache: Path | None = None,
    save: Path | None = None,
    out: Path | None = None,
    coverage: float = COVERAGE,
    false_alarms: float = FALSE_ALARMS,
    log: Log = print,
) -> list[ProbeResult]:
    """Probe a label column with features of every model, of features files, and of the controls.

    No split cuts a value of column `group`. `leave_out` tests every value of a column held out,
    instead of the splits. `where` keeps rows whose column exceeds a number. `save` writes the
    linear head of the only model, calibrated to a `coverage` of its sets and a share of
    `false_alarms`. `out` writes JSON. `probe_table` prints. Raises UserError.
    """
    if save is not None and len(models) != 1:
        raise UserError(f"save writes the linear head of one model, not of {len(models)}.")
    table = manifests.read([str(path) for path in data])
    opened = feature_cache.opened(models)
    gels = UnitGels(table)
    rows, subsets = label_rows(
        table,
        label,
        group=group,
        leave_out=leave_out,
        where=where,
        sensor=sensor,
        frames=frames,
        among=partial(feature_cache.with_gel, gels=gels, models=opened),
    )
    log(f"{len(rows.rows)} of {len(table)} rows take part")
    log(gels.report(rows.rows[:, 0]))
    for note in rows.notes:
        log(note)
    if leave_out is not None and len(np.unique(rows.groups)) == 1:
        raise UserError(
            f"All rows are of one {leave_out} ({rows.groups[0]}). Nothing is left to fit on."
        )
    split = rows.split if leave_out is None else np.full(len(rows.split), "train")
    nothing = np.zeros((len(split), 1))
    given, cut, _ = splits.check_rows(
        nothing, rows.labels, rows.groups, split, tested=leave_out is None
    )
    results = list[ProbeResult]()
    encoding = dict[str, Any](least=frames, pooling=pooling, join=join, gels=gels)
    for source in feature_cache.sources(
        table, opened, features, controls, cache, {frames: rows.rows}, **encoding
    ):
        pixels = source.name == RAW
        x = (
            feature_cache.pixel_components(source.store, rows)
            if pixels
            else source.store.get(rows.rows, frames)
        )
        arrays = (x, rows.labels, rows.groups)
        if leave_out is not None:
            name = f"{source.name}: linear, {leave_out} left out"
            results.append(
                leave_groups_out(*arrays, name=name, scaling=source.scaling, subsets=subsets)
            )
        for kind, each in {
            "linear": ProbeHead("linear", source.scaling),
            "kNN": ProbeHead("knn"),
        }.items():
            if leave_out is None:
                options: dict[str, Any] = {"protocol": protocol, "seeds": seeds, "subsets": subsets}
                results.append(
                    probe_features(
                        *arrays, rows.split, each, name=f"{source.name}: {kind}", **options
                    )
                )
        log(f"probed {source.name}")
        if (
            save is not None
            and source.encoder is not None
            and source.name != RANDOM
            and (tested := results[0].outcome)
        ):
            about: dict[str, Any] = {
                "label": label.removeprefix("label."),
                "pooling": pooling,
                "frames": frames,
            }
            assert tested.fitted is not None
            head = probe_heads.linear_head(
                *tested.fitted, **about, fingerprint=source.encoder.fingerprint
            )
            if source.encoder.subtracts:
                head = replace(head, gels=gels.pictures(rows.rows[:, 0]))
            shares = {"coverage": coverage, "false_alarms": false_alarms}
            save_head(save, calibrated(head, x, rows, results[0].penalty or 1.0, log, **shares))
            log(f"{save}: the linear head")
    if leave_out is None:
        results.append(
            _result(
                "commonest class", "honest", given, cut, _constant(given, cut), None, (), subsets
            )
        )
    if out is not None:
        atomic_write(out, probe_json(results))
    return results


def calibrated(
    head: LinearHead, x: Array, rows: TaskRows, penalty: float, log: Log, **shares: float
) -> LinearHead:
    """Return the head with its calibration, and log what it says; without one if the data do not
    allow it.
    """
    fit, val = (np.flatnonzero(rows.split == name) for name in ("train", "val"))
    try:
        labels = rows.labels
        groups = rows.groups
        sensors = rows.sensors
        folds = splits.group_folds(
            fit, groups, np.unique(labels, return_inverse=True)[1], splits.FOLDS
        )
        head = probe_heads.calibrate(
            head, x, labels, groups, sensors, fit, val, folds, penalty, **shares
        )
    except UserError as error:
        log(f"The head has no calibration: {error}")
    for sentence in head.promises():
        log(sentence)
    return head


def label_rows(
    table: Manifest,
    label: str,
    *,
    group: str = "",
    leave_out: str | None = None,
    where: tuple[str, float] | None = None,
    sensor: str | None = None,
    frames: int = 1,
    among: Callable[[TaskRows], TaskRows] = lambda rows: rows,
) -> tuple[TaskRows, dict[str, Array]]:
    """Return the rows of `probe_label`, of which `among` chooses some, and masks as of
    `tasks.described_subsets`.
    """
    task = tasks.label_task(table, label, group=leave_out or group, where=where, sensor=sensor)
    rows = among(tasks.select(table, task, frames))
    column, name = (
        (task.label, "classes") if leave_out is None else (task.groups[0], f"{leave_out}s")
    )
    return rows, tasks.described_subsets(table, column, rows.rows[:, 0], name)


class _Plan(NamedTuple):
    """A task with the rows that can be fitted on or tested, their roles and class names, and the
    length of a clip.
    """

    task: Task
    rows: TaskRows
    roles: RowRoles
    names: Array
    frames: int
    notes: list[str]


def probe_tasks(
    models: Models,
    data: Paths | Manifest,
    tasks: Sequence[str | Task] | Literal["all"] = "all",
    *,
    features: Paths = (),
    heads: Sequence[HeadName] = ("linear",),
    seeds: int = 5,
    protocol: Protocol = "honest",
    frames: int | None = None,
    pooling: Pooling = "class",
    join: Join = "mean",
    order: Order = "right",
    max_rows: int | None = None,
    universal: bool = False,
    recipe: GradientRecipe | None = None,
    paper: float | None = None,
    controls: bool = True,
    cache: Path | None = None,
    out: Path | None = None,
    keep: dict[tuple[str, ...], list[GroupSums]] | None = None,
    log: Log = print,
    **sides: Names,
) -> dict[str, Any]:
    """Probe named tasks with features of every model, of features files, and of the controls.

    The "results" have a JSON-ready dict for each source of features, task, head and protocol.
    `metric` is "accuracy" in 0..1 or "r2". `mean`, `low` and `high` (95 %) are over seeds and test
    groups, and `values` has one a seed. `train` and `test` count rows, `groups` the tested groups.
    `chance` is that of the most frequent class or the mean of train. A regression also has mae,
    mae_low, mae_high and chance_mae in `unit`. Tasks that cannot be probed are "left_out" with
    their reason.

    `protocol` "published" reports both. `frames` replaces that of each task. `order` shuffles the
    frames of clips, or repeats the last. `universal`: the universal tokens for all sensors. `keep`
    gets the test rows of every seed. `sides`: train_sensors, test_sensors, train_units and
    test_units, names or patterns. Raises UserError.
    """
    if seeds < 1:
        raise UserError(f"seeds must be at least 1, not {seeds}.")
    table = data if isinstance(data, Manifest) else manifests.read([str(path) for path in data])
    opened = feature_cache.opened(models)
    gels = UnitGels(table)
    among = partial(feature_cache.with_gel, gels=gels, models=opened)
    plans, left_out = _plan_tasks(table, tasks, frames, sides, max_rows, log, among)
    if order != "right" and (features or all(plan.frames == 1 for plan in plans)):
        raise UserError(
            "--order has no effect on stills or on --features. Leave it out, or give --frames."
        )
    # one pass computes the features of all tasks
    lengths = sorted({plan.frames for plan in plans})
    rows = {
        n: np.concatenate([plan.rows.rows.ravel() for plan in plans if plan.frames == n])
        for n in lengths
    }
    log(gels.report(np.unique(np.concatenate(list(rows.values())))))
    encoding: dict[str, Any] = {
        "pooling": pooling,
        "join": join,
        "order": order,
        "universal": universal,
        "gels": gels,
    }
    sources = feature_cache.sources(
        table, opened, features, controls, cache, rows, least=frames or 1, **encoding
    )
    if join != "mean" and any(
        s.encoder and (frames or 1) <= s.encoder.config.model.frames for s in sources
    ):
        raise UserError("--join has no effect without --frames longer than a clip of the model.")
    protocols: tuple[Protocol, ...] = (
        ("honest", "published") if protocol == "published" else (protocol,)
    )
    results = []
    keep = {} if keep is None else keep
    for source in sources:
        for length, ids in rows.items():
            source.store.add(ids, length)
        for plan in tracked(plans, f"tasks with {source.name}"):
            labelled = _labelled(source, plan)
            notes = [*plan.notes, *source.notes(plan.rows.sensors)]
            about = {"frames": plan.frames, "order": order}
            about |= {"order": "right"} if plan.frames == 1 else {}
            for name, each in itertools.product(heads, protocols):
                head = ProbeHead(name, source.scaling, recipe=recipe or GradientRecipe())
                scored, runs = _score(labelled, plan, head, each, seeds)
                names = {
                    "features": source.name,
                    "task": plan.task.name,
                    "head": name,
                    "protocol": each,
                }
                keep[tuple(names.values())] = runs
                results.append(names | scored | about | {"notes": notes + scored["notes"]})
        log(f"probed {source.name}")
    kinds = {plan.task.name: plan.roles.measured for plan in plans}
    verdicts = [
        verdict(
            name,
            statistics.paired_gain(runs, keep[RAW, *others], kinds[others[0]]),
            f"{others[0]}, {others[1]}",
        )
        for (name, *others), runs in keep.items()
        if name not in (RAW, RANDOM) and (RAW, *others) in keep
    ]
    report = {
        "manifest": table.content_hash,
        "data": [str(path) for path in table.files],
        "paper": paper,
        "seeds": seeds,
        "sides": {name: list(sides.get(name) or ()) or None for name in SIDES},
        "runs": {
            source.name: dataclasses.asdict(source.encoder.config)
            for source in sources
            if source.encoder
        },
        "left_out": left_out,
        "verdicts": verdicts,
        "results": results,
    }
    if out is not None:
        atomic_write(out, json.dumps(report, indent=2, allow_nan=False))
    return report


def probe_benchmark(
    models: Models, data: Paths | Manifest, benchmark: str, **options: Any
) -> dict[str, Any]:
    """Probe a public benchmark as its authors do, by both protocols; `options` of `probe_tasks`.

    Raises UserError.
    """
    setting = tasks.find_named(tasks.BENCHMARKS, benchmark, "benchmark")
    return probe_tasks(
        models,
        data,
        [setting.task],
        heads=("gradient",),
        protocol="published",
        pooling=setting.pooling,
        universal=setting.universal,
        recipe=setting.recipe,
        paper=setting.paper,
        **options,
    )


def _plan_tasks(
    table: Manifest,
    names: Sequence[str | Task],
    frames: int | None,
    sides: dict[str, Names],
    max_rows: int | None,
    log: Log,
    among: Callable[[TaskRows], TaskRows],
) -> tuple[list[_Plan], dict[str, str]]:
    """Return the plans of the tasks that can be probed, and why the others cannot.

    Raises UserError if none can.
    """
    plans = list[_Plan]()
    left_out = dict[str, str]()
    if names == "all" or list(names) == ["all"]:
        names = tasks.available_tasks(table)
        left_out = {
            name: "The manifest has no such label." for name in tasks.TASKS if name not in names
        }
    if not names:
        raise UserError(
            "The manifest has no label of any task. `anytouch probe label` takes any column."
        )
    errors = []
    for task in [tasks.find_named(tasks.TASKS, name, "task") for name in names]:
        try:
            plans.append(_plan(table, task, frames, sides, max_rows, among))
        except UserError as error:
            left_out[task.name] = str(error).removeprefix(f"Task {task.name}: ")
            errors.append(f"Task {task.name}: {left_out[task.name]}")
    if not plans:
        raise UserError(" ".join(errors))
    for name, reason in left_out.items():
        log(f"{name}: not probed ({reason})")
    return plans, left_out


def _plan(
    table: Manifest,
    task: Task,
    frames: int | None,
    sides: dict[str, Names],
    max_rows: int | None,
    among: Callable[[TaskRows], TaskRows],
) -> _Plan:
    """Select the rows of a task that can be fitted on or tested, at most `max_rows` of them.

    Raises UserError.
    """
    for name, count in (("max_rows", max_rows), ("frames", frames)):
        if count is not None and count < 1:
            raise UserError(f"{name} must be at least 1, not {count}.")
    if unknown := sides.keys() - set(SIDES):
        raise TypeError(f"Unknown options {', '.join(sorted(unknown))}.")
    rows = among(tasks.select(table, task, frames))
    roles, _ = splits.assign_roles(task, rows, sides)
    used = np.flatnonzero(splits.split_scheme(roles)[1] & (roles.may_fit | roles.may_test))
    rows = rows.take(splits.subsample(used, max_rows or len(used)))
    roles, names = splits.assign_roles(task, rows, sides)
    scheme, _, why = splits.split_scheme(roles)
    notes = [*rows.notes, why]
    notes += [
        f"{name.replace('_', ' ')} {', '.join(patterns)}"
        for name in SIDES
        if (patterns := sides.get(name))
    ]
    if scheme == "split" and not roles.measured:
        notes += splits.unlearned_note(roles.y[roles.tested], roles.y[roles.fitted], names)
    return _Plan(task, rows, roles, names, frames or task.frames, [note for note in notes if note])


def _labelled(source: FeatureSource, plan: _Plan) -> LabelledFeatures:
    """Return the features and labels of a task; of raw pixels their principal components."""
    x = source.store.get(plan.rows.rows, plan.frames)
    if not np.isfinite(x).all():
        raise UserError(
            f"Task {plan.task.name}: features are NaN or infinite. Did the training diverge?"
        )
    if (
        source.scaling == "common"
    ):  # components are fitted on rows that are never tested, if there are any
        fitted = (
            ~plan.roles.test
            if splits.split_scheme(plan.roles)[0] == "split"
            else np.ones(len(x), bool)
        )
        with probe_heads.threads(x.size * feature_cache.COMPONENTS):
            x = feature_cache.principal_components(x, fitted, solver="randomized")
    return LabelledFeatures(x, plan.roles.y, plan.names, plan.roles.groups)


def _score(
    data: LabelledFeatures, plan: _Plan, head: ProbeHead, protocol: Protocol, seeds: int
) -> tuple[dict[str, Any], list[GroupSums]]:
    """Score a head on all splits of all seeds. Return the test rows of each seed, too."""
    roles = plan.roles
    chosen = list[float]()
    sizes = list[int]()
    unfinished = 0
    runs = list[GroupSums]()
    baselines = list[GroupSums]()
    for seed in tracked(range(seeds), "splits"):
        cuts = splits.seeded_splits(roles, seed, protocol)
        if seed and protocol == "published" and len(cuts) == 1 and head.name != "gradient":
            runs.append(runs[0])  # nothing is drawn: every seed is the same fit
            continue
        parts = [
            _predict(data, cut, replace(head, seed=seed), protocol)
            for cut in tracked(cuts, "folds")
        ]
        tested = np.concatenate([cut.test for cut in cuts])
        runs.append(_sums(data, np.concatenate([predicted for *_, predicted in parts]), tested))
        baselines.append(
            _sums(data, np.concatenate([_constant(data, cut) for cut in cuts]), tested)
        )
        chosen += [selected.option for selected, *_ in parts]
        sizes += [len(cut.fit) for cut in cuts]
        unfinished += sum(model is not None and not model.fit.finished for _, model, _ in parts)
    scores = statistics.scores(runs, baselines, roles.measured) | (
        {"unit": plan.task.unit} if roles.measured else {}
    )
    return scores | {
        "train": round(float(np.mean(sizes))),
        "test": len(runs[0].groups),
        "classes": data.names.tolist(),
        "groups": len(np.unique(runs[0].groups)),
        "chosen": chosen,
        "notes": [f"{unfinished} of {len(chosen)} fits did not converge"] if unfinished else [],
    }, runs
