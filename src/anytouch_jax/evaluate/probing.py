"""Probes of frozen features from models and manifests: a label column, named tasks, or a public benchmark.

A task selects rows and labels. Features are computed once, groups are split, heads are fitted and scored. Frames are
never flipped or otherwise augmented. The protocols are those of `array_probes`. In tasks, "honest" splits whole groups
(objects, recordings) again by every seed, and "published" keeps the manifest's split.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Callable, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.config import preset
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.embed import Join, Pooling
from anytouch_jax.encoder.encoder import Encoder, check_frames, load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import array_probes, feature_cache, heads, logistic, splits, statistics, tasks
from anytouch_jax.evaluate.array_probes import LabelledFeatures, ProbeResult
from anytouch_jax.evaluate.feature_cache import FeatureStore, Order
from anytouch_jax.evaluate.heads import GradientRecipe, HeadName, ProbeHead, Scaling
from anytouch_jax.evaluate.splits import RowRoles, Split
from anytouch_jax.evaluate.statistics import GroupSums, Protocol
from anytouch_jax.evaluate.tasks import Task, TaskRows
from anytouch_jax.files import atomic_write

Array = npt.NDArray[Any]
Log = Callable[[str], None]
Paths = Sequence[str | Path]
Names = Sequence[str] | None
RAW, RANDOM = "raw pixels", "random encoder"
SIDES = ("train_sensors", "test_sensors", "train_units", "test_units")


class _Source(NamedTuple):
    """Features with their name; `encoder` is None for a features file and for raw pixels."""

    name: str
    store: FeatureStore
    encoder: Encoder | None = None
    scaling: Scaling = "column"


class _Plan(NamedTuple):
    """A task with the rows that can be fitted on or tested, their roles and class names, and the length of a clip."""

    task: Task
    rows: TaskRows
    roles: RowRoles
    names: Array
    frames: int
    notes: list[str]


def probe_label(
    models: Paths, data: Paths, label: str = "object", *, features: Paths = (), group: str = "",
    leave_out: str | None = None, where: tuple[str, float] | None = None, sensor: str | None = None, frames: int = 1,
    pooling: Pooling = "class", join: Join = "mean", seeds: int = 5, protocol: Protocol = "honest",
    controls: bool = True, cache: Path | None = None, save: Path | None = None, out: Path | None = None,
    log: Log = print,
) -> list[ProbeResult]:  # fmt: skip
    """Probe a label column with features of every model, of features files, and of the controls.

    `group` is the column that no split cuts. `leave_out` tests every value of a column held out, instead of the splits.
    `where` keeps rows whose column exceeds a number. `save` writes the linear head of the only model, `out` the results
    as JSON. Print the results with `probe_table`. Raises UserError.
    """
    if save is not None and len(models) != 1:
        raise UserError(f"save writes the linear head of one model, not of {len(models)}.")
    table = manifests.read([str(path) for path in data])
    rows, subsets = label_rows(
        table, label, group=group, leave_out=leave_out, where=where, sensor=sensor, frames=frames
    )
    log(f"{len(rows.rows)} of {len(table)} rows take part")
    for note in rows.notes:
        log(note)
    if leave_out is not None and len(np.unique(rows.groups)) == 1:
        raise UserError(f"All rows are of one {leave_out} ({rows.groups[0]}). Nothing is left to fit on.")
    split = rows.split if leave_out is None else np.full(len(rows.split), "train")
    array_probes.check_rows(np.zeros((len(split), 1)), rows.labels, rows.groups, split, tested=leave_out is None)
    results, encoding = list[ProbeResult](), dict[str, Any](least=frames, pooling=pooling, join=join)
    for source in _sources(table, models, features, controls, cache, {frames: rows.rows}, **encoding):
        values = pixel_components(source.store, rows) if source.name == RAW else source.store.get(rows.rows, frames)
        results += probe_rows(values, rows, source.name, leave_out=leave_out, protocol=protocol, seeds=seeds,
                              scaling=source.scaling, subsets=subsets)  # fmt: skip
        log(f"probed {source.name}")
        if save is not None and source.encoder is not None and source.name != RANDOM and (tested := results[0].outcome):
            about: dict[str, Any] = {"label": label.removeprefix("label."), "pooling": pooling, "frames": frames}
            assert tested.fitted is not None
            heads.save_head(save, heads.linear_head(*tested.fitted, **about, fingerprint=source.encoder.fingerprint))
            log(f"{save}: the linear head")
    if leave_out is None:
        results.append(array_probes.majority_baseline(rows.labels, rows.groups, rows.split, subsets=subsets))
    if out is not None:
        atomic_write(out, array_probes.probe_json(results))
    return results


def label_rows(
    table: Manifest, label: str, *, group: str = "", leave_out: str | None = None,
    where: tuple[str, float] | None = None, sensor: str | None = None, frames: int = 1,
) -> tuple[TaskRows, dict[str, Array]]:  # fmt: skip
    """Return the rows of `probe_label`, and masks of those whose class (held-out object) alignment may have named."""
    task = tasks.label_task(table, label, group=leave_out or group, where=where, sensor=sensor)
    rows = tasks.select(table, task, frames)
    column, name = (task.label, "classes") if leave_out is None else (task.groups[0], f"{leave_out}s")
    return rows, tasks.described_subsets(table, column, rows.rows[:, 0], name)


def pixel_components(store: FeatureStore, rows: TaskRows) -> Array:
    """Return the principal components of raw pixels, fitted on the rows of train (on all without these)."""
    train = rows.split == "train"
    return feature_cache.principal_components(store.get(rows.rows, 1), train if train.any() else ~train)


def probe_rows(
    features: Array, rows: TaskRows, name: str, *, leave_out: str | None = None, protocol: Protocol = "honest",
    seeds: int = 5, scaling: Scaling = "column", subsets: dict[str, Array] | None = None,
) -> list[ProbeResult]:  # fmt: skip
    """Return the linear and kNN results of features (n, d) on the rows of a task, or that of held-out groups."""
    arrays = (features, rows.labels, rows.groups)
    if leave_out is not None:
        name = f"{name}: linear, {leave_out} left out"
        return [array_probes.leave_groups_out(*arrays, name=name, scaling=scaling, subsets=subsets)]
    options: dict[str, Any] = {"protocol": protocol, "seeds": seeds, "subsets": subsets}
    probes = {"linear": ProbeHead("linear", scaling), "kNN": ProbeHead("knn")}
    return [
        array_probes.probe_features(*arrays, rows.split, head, name=f"{name}: {kind}", **options)
        for kind, head in probes.items()
    ]


def probe_tasks(
    models: Paths, data: Paths, tasks: Sequence[str | Task] | Literal["all"] = "all", *, features: Paths = (),
    heads: Sequence[HeadName] = ("linear",), seeds: int = 5, protocol: Protocol = "honest", frames: int | None = None,
    pooling: Pooling = "class", join: Join = "mean", order: Order = "right", max_rows: int | None = None,
    universal: bool = False, recipe: GradientRecipe | None = None, paper: float | None = None, controls: bool = True,
    cache: Path | None = None, out: Path | None = None, log: Log = print, **sides: Names,
) -> dict[str, Any]:  # fmt: skip
    """Probe named tasks with features of every model, of features files, and of the controls.

    Parameters are those of `score_tasks`. `protocol` "published" reports both protocols. `paper`: the accuracy that the
    report names. `out` writes JSON. Tasks that cannot be probed are left out with their reason. Print the "results"
    with `probe_table`. Raises UserError.
    """
    table = manifests.read([str(path) for path in data])
    plans, left_out = _plan_tasks(table, tasks, frames, sides, max_rows, log)
    if order != "right" and (features or all(plan.frames == 1 for plan in plans)):
        raise UserError("--order has no effect on stills or on --features. Leave it out, or give --frames.")
    encoding: dict[str, Any] = {"pooling": pooling, "join": join, "order": order, "universal": universal}
    sources = _sources(table, models, features, controls, cache, _rows_by_length(plans), least=frames or 1, **encoding)
    if join != "mean" and any(s.encoder and (frames or 1) <= s.encoder.config.model.frames for s in sources):
        raise UserError("--join has no effect without --frames longer than a clip of the model.")
    protocols: tuple[Protocol, ...] = ("honest", "published") if protocol == "published" else ("honest",)
    results = []
    for source in sources:
        scored = _run_plans(source, plans, seeds, heads, protocols, recipe, order)
        results += [{"features": source.name} | row for row in scored]
        log(f"probed {source.name}")
    configs = {source.name: dataclasses.asdict(source.encoder.config) for source in sources if source.encoder}
    report = {
        "manifest": table.content_hash, "data": [str(path) for path in data], "paper": paper, "seeds": seeds,
        "sides": {name: list(sides.get(name) or ()) or None for name in SIDES}, "runs": configs, "left_out": left_out,
        "results": results,
    }  # fmt: skip
    if out is not None:
        atomic_write(out, json.dumps(report, indent=2, allow_nan=False))
    return report


def probe_benchmark(models: Paths, data: Paths, benchmark: str, **options: Any) -> dict[str, Any]:
    """Probe a public benchmark with the authors' pooling, head and settings, by both protocols.

    `options` are the others of `probe_tasks`, which returns the result. Raises UserError.
    """
    setting = tasks.find_benchmark(benchmark)
    return probe_tasks(
        models, data, [setting.task], heads=("gradient",), protocol="published", pooling=setting.pooling,
        universal=setting.universal, recipe=setting.recipe, paper=setting.paper, **options,
    )  # fmt: skip


def score_tasks(
    encoder: Encoder | FeatureStore | None, table: Manifest, names: Sequence[str | Task], *, cache: Path | None = None,
    seeds: int = 5, frames: int | None = None, pooling: Pooling = "class", join: Join = "mean",
    protocols: Sequence[Protocol] = ("honest",), order: Order = "right", head_names: Sequence[HeadName] = ("linear",),
    recipe: GradientRecipe | None = None, universal: bool = False, max_rows: int | None = None, **sides: Names,
) -> list[dict[str, Any]]:  # fmt: skip
    """Probe features of an encoder, of a store, or (None) of raw pixels on tasks of a manifest.

    Returns a JSON-ready dict for each task, head and protocol. Keys: task, head, protocol; metric, "accuracy" in 0..1
    or "r2"; mean over seeds, low, high (95 % over seeds and test groups), values (one a seed); train, test (rows);
    groups (tested); classes; chance, the score of the most frequent class or the mean of train; chosen options; frames;
    order; notes. A regression also has mae, mae_low, mae_high and chance_mae in `unit`.

    `frames` replaces that of each task. `order` shuffles the frames of clips, or repeats the last. `universal`: the
    universal tokens for all sensors. `sides`: train_sensors, test_sensors, train_units and test_units, names or
    patterns to fit on and to test on. Raises UserError.
    """
    if encoder is None:
        source = _Source(RAW, feature_cache.pixel_features(table, order=order, folder=cache), None, "common")
    elif isinstance(encoder, FeatureStore):
        source = _Source("features", encoder)
    else:
        options: dict[str, Any] = {"pooling": pooling, "join": join, "order": order, "universal": universal}
        source = _Source("encoder", feature_cache.encoder_features(encoder, table, folder=cache, **options), encoder)
    plans = [_plan(table, tasks.find_task(name), frames, sides, max_rows) for name in names]
    return _run_plans(source, plans, seeds, head_names, protocols, recipe, order)


def _sources(
    table: Manifest, models: Paths, features: Paths, controls: bool, cache: Path | None, rows: dict[int, Array],
    order: Order = "right", least: int = 1, **encoding: Any,
) -> list[_Source]:  # fmt: skip
    """Return models, the random encoder, features files and raw pixels, in this order.

    `rows` by length of clip: a file that lacks some is reported before the work. `least`: frames of every clip.
    """
    encoders = {str(path): load_encoder(path) for path in models}
    if controls:
        first = next(iter(encoders.values()), None)
        encoders[RANDOM] = random_encoder(first.config if first else preset("tiny"))
    sources = []
    for name, encoder in encoders.items():
        check_frames(encoder.config.model, least)
        store = feature_cache.encoder_features(encoder, table, order=order, folder=cache, **encoding)
        sources.append(_Source(name, store, encoder))
    for path in features:
        sources.append(_Source(str(path), feature_cache.file_features(Path(path), table)))
        for frames, ids in rows.items():
            sources[-1].store.add(ids, frames)
    if controls:
        sources.append(_Source(RAW, feature_cache.pixel_features(table, order=order, folder=cache), None, "common"))
    if not sources:
        raise UserError("There is nothing to probe. Give --model or --features, or keep the controls.")
    return sources


def _plan_tasks(
    table: Manifest, names: Sequence[str | Task], frames: int | None, sides: dict[str, Names], max_rows: int | None,
    log: Log,
) -> tuple[list[_Plan], dict[str, str]]:  # fmt: skip
    """Return the plans of the tasks that can be probed, and why the others cannot. Raises UserError if none can."""
    plans, left_out = list[_Plan](), dict[str, str]()
    if names == "all" or list(names) == ["all"]:
        names = tasks.available_tasks(table)
        left_out = {name: "The manifest has no such label." for name in tasks.TASKS if name not in names}
    if not names:
        raise UserError("The manifest has no label of any task. `anytouch probe label` takes any column.")
    errors = []
    for task in map(tasks.find_task, names):
        try:
            plans.append(_plan(table, task, frames, sides, max_rows))
        except UserError as error:
            left_out[task.name] = str(error).removeprefix(f"Task {task.name}: ")
            errors.append(f"Task {task.name}: {left_out[task.name]}")
    if not plans:
        raise UserError(" ".join(errors))
    for name, reason in left_out.items():
        log(f"{name}: not probed ({reason})")
    return plans, left_out


def _plan(table: Manifest, task: Task, frames: int | None, sides: dict[str, Names], max_rows: int | None) -> _Plan:
    """Select the rows of a task that can be fitted on or tested, at most `max_rows` of them. Raises UserError."""
    for name, count in (("max_rows", max_rows), ("frames", frames)):
        if count is not None and count < 1:
            raise UserError(f"{name} must be at least 1, not {count}.")
    if unknown := sides.keys() - set(SIDES):
        raise TypeError(f"Unknown options {', '.join(sorted(unknown))}.")
    rows = tasks.select(table, task, frames)
    rows = rows.take(np.flatnonzero(np.logical_or(*_side_masks(rows, sides))))
    used = np.flatnonzero(splits.split_scheme(_roles(task, rows, sides)[0])[1])
    rows = rows.take(splits.subsample(used, max_rows or len(used)))
    roles, names = _roles(task, rows, sides)
    scheme, _, why = splits.split_scheme(roles)
    notes = [*rows.notes, why]
    notes += [f"{name.replace('_', ' ')} {', '.join(patterns)}" for name in SIDES if (patterns := sides.get(name))]
    if scheme == "split" and not roles.measured:
        notes += array_probes.unlearned_note(roles.y[roles.tested], roles.y[roles.fitted], names)
    return _Plan(task, rows, roles, names, frames or task.frames, [note for note in notes if note])


def _side_masks(rows: TaskRows, sides: dict[str, Names]) -> list[Array]:
    """Return which rows may be fitted on and which may be tested. Raises UserError for an unknown sensor or unit."""
    masks = []
    for side in ("train", "test"):
        mask = np.ones(len(rows.labels), bool)
        for kind, column in (("sensor", rows.sensors), ("unit", rows.units)):
            patterns, known = sides.get(f"{side}_{kind}s") or (), np.unique(column)
            for pattern in patterns:
                if not any(fnmatch(name, pattern) for name in known):
                    raise UserError(f"No row has the {kind} {pattern!r}. There are {', '.join(known) or 'none'}.")
            if patterns:
                mask &= np.isin(column, [name for name in known if any(fnmatch(name, each) for each in patterns)])
        masks.append(mask)
    return masks


def _roles(task: Task, rows: TaskRows, sides: dict[str, Names]) -> tuple[RowRoles, Array]:
    """Return the roles of the rows and the class names. Raises UserError if nothing is left to fit on or to test."""
    measured = task.kind == "regression"
    names, y = (np.array([], str), rows.labels) if measured else np.unique(rows.labels, return_inverse=True)
    test = rows.split == "test"
    may_fit, may_test = _side_masks(rows, sides)
    roles = RowRoles(y, rows.groups, ~test, test, may_fit, may_test, measured)
    for mask, purpose in ((roles.tested, "test"), (roles.may_fit, "train")):
        if not mask.any():
            raise UserError(f"Task {task.name}: no row is left to {purpose}. Check the splits, sensors and units.")
    if measured and np.ptp(y[roles.tested]) == 0:
        raise UserError(f"Task {task.name}: {task.label} is constant on test. R2 has no meaning there.")
    if not measured and len(names) < 2:
        raise UserError(f"Task {task.name}: the label is {str(names[0])!r} on every row. A probe needs two classes.")
    return roles, names


def _rows_by_length(plans: Sequence[_Plan]) -> dict[int, Array]:
    """Return the rows of all tasks by length of clip: one pass computes their features."""
    lengths = sorted({plan.frames for plan in plans})
    return {n: np.concatenate([plan.rows.rows.ravel() for plan in plans if plan.frames == n]) for n in lengths}


def _run_plans(
    source: _Source, plans: Sequence[_Plan], seeds: int, head_names: Sequence[HeadName], protocols: Sequence[Protocol],
    recipe: GradientRecipe | None, order: Order,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the rows of `score_tasks`."""
    if seeds < 1:
        raise UserError(f"seeds must be at least 1, not {seeds}.")
    for length, ids in _rows_by_length(plans).items():
        source.store.add(ids, length)
    results = []
    for plan in plans:
        x = source.store.get(plan.rows.rows, plan.frames)
        if not np.isfinite(x).all():
            raise UserError(f"Task {plan.task.name}: features are NaN or infinite. Did the training diverge?")
        if source.scaling == "common":  # components are fitted on rows that are never tested, if there are any
            fitted = plan.roles.train if splits.split_scheme(plan.roles)[0] == "split" else np.ones(len(x), bool)
            with logistic.threads(x.size * feature_cache.COMPONENTS):
                x = feature_cache.principal_components(x, fitted, solver="randomized")
        labelled = LabelledFeatures(x, plan.roles.y, plan.names, plan.roles.groups)
        notes, encoder = list(plan.notes), source.encoder
        if encoder is not None:
            trained = encoder.config.model.sensors if encoder.trained_sensors is None else encoder.trained_sensors
            unknown = sorted(set(plan.rows.sensors) - set(trained))
            notes += [f"universal tokens for {', '.join(unknown)}"] if unknown else []
        about = {"frames": plan.frames, "order": order if plan.frames > 1 else "right"}
        for name, protocol in itertools.product(head_names, protocols):
            head = ProbeHead(name, source.scaling, recipe=recipe or GradientRecipe())
            scored = _score(labelled, plan, head, protocol, seeds)
            names = {"task": plan.task.name, "head": name, "protocol": protocol}
            results.append(names | scored | about | {"notes": notes + scored["notes"]})
    return results


def _score(data: LabelledFeatures, plan: _Plan, head: ProbeHead, protocol: Protocol, seeds: int) -> dict[str, Any]:
    """Score a head on all splits of all seeds."""
    roles, chosen, sizes, unfinished = plan.roles, list[float](), list[int](), 0
    runs, baselines = list[GroupSums](), list[GroupSums]()
    for seed in range(seeds):
        cuts = splits.seeded_splits(roles, seed, protocol)
        if seed and protocol == "published" and len(cuts) == 1 and head.name != "gradient":
            runs.append(runs[0])  # nothing is drawn: every seed is the same fit
            continue
        predictions, constants = [], []
        for cut in cuts:
            option, predicted, finished = _predict(data, cut, dataclasses.replace(head, seed=seed), protocol)
            unfinished += not finished
            fitted = roles.y[cut.fit]
            constants.append(np.full(len(cut.test), fitted.mean() if roles.measured else heads.majority_class(fitted)))
            predictions.append(predicted)
            chosen.append(option)
            sizes.append(len(cut.fit))
        tested = np.concatenate([cut.test for cut in cuts])
        truth, groups = roles.y[tested], roles.groups[tested]
        for several, parts in ((runs, predictions), (baselines, constants)):
            if roles.measured:
                sums = statistics.regression_sums(np.concatenate(parts) - truth, truth - roles.y.mean(), groups)
            else:
                sums = statistics.classification_sums(np.concatenate(parts) == truth, groups)
            several.append(sums)

    def values(of: Callable[[Array], Array], several: Sequence[GroupSums] = runs) -> list[float]:
        return [float(of(run.sums.sum(0))) for run in several]

    metric = statistics.r2_of if roles.measured else statistics.mean_of
    low, high = statistics.bootstrap_interval(runs, metric)
    result: dict[str, Any] = {
        "metric": "r2" if roles.measured else "accuracy", "mean": float(np.mean(values(metric))), "low": low,
        "high": high, "values": values(metric), "train": round(float(np.mean(sizes))), "test": len(runs[0].groups),
        "classes": data.names.tolist(), "chance": float(np.mean(values(metric, baselines))),
    }  # fmt: skip
    if roles.measured:
        mae_low, mae_high = statistics.bootstrap_interval(runs, statistics.mae_of)
        mae, chance = (float(np.mean(values(statistics.mae_of, several))) for several in (runs, baselines))
        result |= {"mae": mae, "mae_low": mae_low, "mae_high": mae_high, "chance_mae": chance, "unit": plan.task.unit}
    notes = [f"{unfinished} of {len(chosen)} fits did not converge"] if unfinished else []
    return result | {"groups": len(np.unique(runs[0].groups)), "chosen": chosen, "notes": notes}


def _predict(data: LabelledFeatures, cut: Split, head: ProbeHead, protocol: Protocol) -> tuple[float, Array, bool]:
    """Return the selected option, its predictions for the test rows, and whether its fit converged."""
    selected = array_probes.select_option(head, data, cut, protocol)
    fitted, index = selected.fitted, selected.place
    assert fitted is not None  # an honest cut has rows of val
    if head.name != "gradient" and len(cut.fit) > splits.SELECT_ROWS:
        start = fitted.models[index] if fitted.models else None
        fitted, index = data.fit(dataclasses.replace(head, options=(selected.option,)), cut.fit, start=start), 0
    finished = all(model.finished for model in fitted.models[index : index + 1])
    return selected.option, fitted.predict(data.x[cut.test])[index], finished
