"""The task battery: the same tasks, splits, heads and protocols for every encoder and for raw pixels.

Two protocols side by side. `honest`: whole groups (objects, recordings) on one side, dealt anew by every seed, the
option of a head chosen on groups left out of train. `published`: the manifest's own split, the option chosen on test,
as the authors' released code does. No frame is flipped or otherwise augmented (see `tasks` on directions; the authors'
probes augment their training pictures, so their head sees other features in every epoch).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from sklearn.decomposition import PCA

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.encoder import Encoder, Join, Pooling
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import deals, heads, logistic
from anytouch_jax.evaluate.battery_features import Order, Store, encoded, raw
from anytouch_jax.evaluate.heads import HeadName, Problem, Recipe
from anytouch_jax.evaluate.probe_models import Scaling, commonest
from anytouch_jax.evaluate.statistics import GroupSums, Protocol, bootstrap_interval, mae_of, mean_of, r2_of
from anytouch_jax.evaluate.tasks import Selection, Task, select, task_of

Array = npt.NDArray[Any]

COMPONENTS = 200  # principal components of raw pixels


def run(
    encoder: Encoder | Store | None,
    table: Manifest,
    tasks: Sequence[str | Task],
    *,
    cache: Path | None = None,
    seeds: int = 5,
    frames: int | None = None,
    pooling: Pooling = "both",
    join: Join = "mean",
    protocols: Sequence[Protocol] = ("honest",),
    train_sensors: Sequence[str] | None = None,
    test_sensors: Sequence[str] | None = None,
    order: Order = "right",
    max_rows: int | None = None,
    train_units: Sequence[str] | None = None,
    test_units: Sequence[str] | None = None,
    head_names: Sequence[HeadName] = ("linear",),
    recipe: Recipe | None = None,
    universal: bool = False,
) -> list[dict[str, Any]]:
    """Probe frozen features of `encoder` on `tasks` (names of `tasks.TASKS`) of a manifest.

    `encoder` None: pixels and their difference from the background, reduced to 200 principal components (fitted,
    without labels, on the rows that are never tested; on all where the test is in folds). For these, and for a `Store`
    (features that are there: `given`), `pooling`, `join` and `universal` mean nothing.

    One JSON-ready dict for each task, head and protocol: task, protocol, metric ("accuracy" in 0..1, or "r2"), mean
    (over seeds), low, high (95 % over seeds and test groups; None with fewer than two groups), values (one a seed),
    train, test (rows), classes (names; [] for a number), chance (accuracy of the commonest class of train; for r2 that
    of the mean of train); then head, frames, order, groups (tested), chosen (options), notes; of a regression also mae,
    mae_low, mae_high and chance_mae in units of the label (`unit`).

    `frames` replaces each task's own (1, 3, ...). `train_sensors`, `test_sensors` name sensors, `train_units`,
    `test_units` units (patterns such as cam0_*); all without them. `order`: frames of a clip as they are, in another
    order, or the last one repeated. `max_rows` a task, by a fixed chance. `cache`: folder that keeps features by
    content. `universal`: the universal tokens for all sensors; a sensor that the model lacks always gets them. `recipe`
    of the gradient-trained head. Raises UserError: unknown task, label not there, too few groups, nothing left to test.
    """
    sides = Sides(train_sensors, test_sensors, train_units, test_units)
    setting = Setting(seeds, frames, recipe, sides, order, max_rows, "common", None)
    if encoder is None:
        store = raw(table, order=order, folder=cache)
    elif isinstance(encoder, Store):
        store, setting = encoder, setting._replace(scaling="column")
    else:
        store = encoded(encoder, table, pooling=pooling, join=join, order=order, universal=universal, folder=cache)
        setting = setting._replace(
            scaling="column", known=frozenset(encoder.config.model.sensors if encoder.seen is None else encoder.seen)
        )
    return _probe(store, table, tasks, setting, head_names, protocols)


def left_out(
    table: Manifest, tasks: Sequence[str], frames: int | None, sides: Sides, max_rows: int | None
) -> dict[str, str]:
    """Why a task cannot be probed on this manifest, by the name of each such one. Raises UserError: unknown names."""
    setting, found = Setting(1, frames, None, sides, "right", max_rows, "common", None), dict[str, str]()
    for task in map(task_of, tasks):
        try:
            _selected(table, task, setting)
        except UserError as error:
            found[task.name] = str(error).removeprefix(f"task {task.name}: ")
    return found


class Sides(NamedTuple):
    """Sensors and units (patterns) to learn from and to test on; None: all."""

    train_sensors: Sequence[str] | None
    test_sensors: Sequence[str] | None
    train_units: Sequence[str] | None
    test_units: Sequence[str] | None


class Setting(NamedTuple):
    """What the probes of all tasks share; `known` sensors of the model (None: raw pixels)."""

    seeds: int
    frames: int | None
    recipe: Recipe | None
    sides: Sides
    order: Order
    max_rows: int | None
    scaling: Scaling
    known: frozenset[str] | None


class Case(NamedTuple):
    """Features (n, d) of a task's rows, with what a deal needs of them and the names of the classes."""

    x: Array
    rows: deals.Rows
    names: Array
    task: Task
    setting: Setting


def _probe(
    store: Store,
    table: Manifest,
    tasks: Sequence[str | Task],
    setting: Setting,
    head_names: Sequence[HeadName],
    protocols: Sequence[Protocol],
) -> list[dict[str, Any]]:
    for what, count in (("seeds", setting.seeds), ("max_rows", setting.max_rows), ("frames", setting.frames)):
        if count is not None and count < 1:
            raise UserError(f"{what} must be at least 1, not {count}")
    chosen = [task_of(task) for task in tasks]
    selections = [_selected(table, task, setting) for task in chosen]
    lengths = [setting.frames or task.frames for task in chosen]
    for length in sorted(set(lengths)):  # one pass over the rows of all tasks
        wanted = [one.rows.ravel() for one, frames in zip(selections, lengths, strict=True) if frames == length]
        store.add(np.concatenate(wanted), length)
    found = []
    for task, selection, length in zip(chosen, selections, lengths, strict=True):
        rows, names = _rows(task, selection, setting.sides)
        x = store.get(selection.rows, length)
        if not np.isfinite(x).all():
            raise UserError(f"task {task.name}: features are NaN or infinite; did the training diverge?")
        case = Case(x if setting.scaling == "column" else _components(x, rows), rows, names, task, setting)
        notes = [*selection.notes, *_remarks(rows, selection, setting)]
        for head in head_names:
            for protocol in protocols:
                about = {"task": task.name, "head": head, "protocol": protocol}
                result = _result(case, head, protocol)
                rest = {
                    "frames": length,
                    "order": setting.order if length > 1 else "right",
                    "notes": notes + result["notes"],
                }
                found.append(about | result | rest)
    return found


def _selected(table: Manifest, task: Task, setting: Setting) -> Selection:
    """The rows of a task that can be learned from or tested, at most `max_rows` of them."""
    found = select(table, task, setting.frames)
    found = _only(found, np.flatnonzero(np.logical_or(*_sides(found, setting.sides))))
    kept = np.flatnonzero(deals.scheme(_rows(task, found, setting.sides)[0])[1])
    if setting.max_rows is not None and len(kept) > setting.max_rows:
        kept = np.sort(np.random.default_rng(0).choice(kept, setting.max_rows, replace=False))
    return _only(found, kept)


def _only(selection: Selection, kept: Array) -> Selection:
    return Selection._make([*(one[kept] for one in selection[:-1]), selection.notes])


def _sides(selection: Selection, sides: Sides) -> tuple[Array, Array]:
    """Which rows may teach and which may be tested, by sensor and unit. Raises UserError for one that is not there."""
    found = []
    for sensors, units in ((sides.train_sensors, sides.train_units), (sides.test_sensors, sides.test_units)):
        mask = np.ones(len(selection.labels), bool)
        for names, column, what in ((sensors, selection.sensors, "sensor"), (units, selection.units, "unit")):
            if names is not None:
                there = np.unique(column)
                for name in names:
                    if not any(fnmatch(one, name) for one in there):
                        raise UserError(f"no row has the {what} {name!r}; there are {', '.join(there) or 'none'}")
                mask &= np.isin(column, [one for one in there if any(fnmatch(one, name) for name in names)])
        found.append(mask)
    return found[0], found[1]


def _rows(task: Task, selection: Selection, sides: Sides) -> tuple[deals.Rows, Array]:
    """What the deals need, and the names of the classes."""
    measured = task.kind == "regression"
    names, y = (np.array([], str), selection.labels) if measured else np.unique(selection.labels, return_inverse=True)
    fits, tests = _sides(selection, sides)
    test = selection.split == "test"
    rows = deals.Rows(y, selection.groups, ~test, test, fits, tests, measured)
    for mask, what in ((rows.test & tests, "test"), ((rows.pool | test) & fits, "train")):
        if not mask.any():
            raise UserError(f"task {task.name}: no row is left to {what}; check the splits, sensors and units")
    if measured and np.ptp(y[rows.test & tests]) == 0:
        raise UserError(f"task {task.name}: {task.label} is the same on every row of test; R2 has no meaning there")
    if not measured and len(names) < 2:
        raise UserError(f"task {task.name}: the label is {str(names[0])!r} on every row; a probe needs two classes")
    return rows, names


def _remarks(rows: deals.Rows, selection: Selection, setting: Setting) -> list[str]:
    notes = [deals.scheme(rows)[2]]
    sides = setting.sides._asdict()
    notes += [f"{name.replace('_', ' ')} {', '.join(some)}" for name, some in sides.items() if some is not None]
    if setting.known is not None:
        unknown = sorted(set(selection.sensors) - setting.known)
        notes += [f"universal tokens for {', '.join(unknown)}" if unknown else ""]
    learned, tested = rows.pool & rows.fits, rows.test & rows.tests
    if not rows.measured and deals.scheme(rows)[0] == "split":
        never = tested & ~np.isin(rows.y, rows.y[learned])
        names = np.unique(selection.labels[never])
        notes += [f"{never.sum()} test rows of classes that train lacks count as errors: {', '.join(names)}"] * bool(
            len(names)
        )
    return [note for note in notes if note]


def _components(x: Array, rows: deals.Rows) -> Array:
    """Principal components of pixels, fitted on rows that are never tested."""
    how, _, _ = deals.scheme(rows)
    fitted = x[rows.pool] if how == "split" else x
    count = min(COMPONENTS, *fitted.shape)
    with logistic.threads(x.size * count):
        return np.asarray(PCA(count, svd_solver="randomized", random_state=0).fit(fitted).transform(x), np.float32)


def _result(case: Case, head: HeadName, protocol: Protocol) -> dict[str, Any]:
    rows, chosen, sizes, unfinished = case.rows, list[float](), list[int](), 0
    tested, chances = list[GroupSums](), list[GroupSums]()
    for seed in range(case.setting.seeds):
        cuts = deals.cuts(rows, seed, protocol)
        if seed and protocol == "published" and len(cuts) == 1 and head != "gradient":
            tested.append(tested[0])  # nothing is drawn: every seed is the same fit
            continue
        said, base = [], []
        for cut in cuts:
            option, predicted, finished = _predicted(case, cut, head, protocol, seed)
            unfinished += not finished
            said.append(_tested(rows, cut, predicted))
            base.append(_tested(rows, cut, _constant(rows, cut)))
            chosen.append(option)
            sizes.append(len(cut.fit))
        tested.append(_joined(said))
        chances.append(_joined(base))
    value = r2_of if rows.measured else mean_of
    values = _values(value, tested)
    low, high = bootstrap_interval(tested, value)
    result: dict[str, Any] = {"metric": "r2" if rows.measured else "accuracy", "mean": float(np.mean(values))}
    result |= {"low": low, "high": high, "values": values, "train": round(float(np.mean(sizes)))}
    result |= {"test": len(tested[0].groups), "classes": case.names.tolist()}
    result |= {"chance": float(np.mean(_values(value, chances)))}
    if rows.measured:
        low, high = bootstrap_interval(tested, mae_of)
        mae, chance = (float(np.mean(_values(mae_of, several))) for several in (tested, chances))
        result |= {"mae": mae, "mae_low": low, "mae_high": high, "chance_mae": chance, "unit": case.task.unit}
    notes = [f"{unfinished} of {len(chosen)} fits did not converge"] * bool(unfinished)
    return result | {"groups": len(np.unique(tested[0].groups)), "chosen": chosen, "notes": notes}


def _values(value: Callable[[Array], Array], tested: Sequence[GroupSums]) -> list[float]:
    return [float(value(one.sums.sum(0))) for one in tested]


def _joined(parts: Sequence[GroupSums]) -> GroupSums:
    return GroupSums(np.concatenate([one.groups for one in parts]), np.concatenate([one.sums for one in parts]))


def _predicted(case: Case, cut: deals.Cut, head: HeadName, protocol: Protocol, seed: int) -> tuple[float, Array, bool]:
    """The option chosen, what its head says of the test rows, and whether its fit converged."""
    x, y, classes, setting = case.x, case.rows.y, len(case.names), case.setting
    problem = Problem(x[cut.fit], y[cut.fit], x[cut.val], x[cut.test], classes, setting.scaling, seed)
    path = heads.fit(head, problem, setting.recipe)
    on_test = protocol == "published"
    option = heads.choose(path.test if on_test else path.val, y[cut.test if on_test else cut.val], classes)
    return path.options[option], path.final(option), all(path.finished[option : option + 1])


def _constant(rows: deals.Rows, cut: deals.Cut) -> Array:
    learned = rows.y[cut.fit]
    return np.full(len(cut.test), learned.mean() if rows.measured else commonest(learned))


def _tested(rows: deals.Rows, cut: deals.Cut, said: Array) -> GroupSums:
    truth, ones = rows.y[cut.test], np.ones(len(cut.test))
    if not rows.measured:
        return GroupSums(rows.groups[cut.test], np.stack([(said == truth).astype(np.float64), ones], 1))
    error = said - truth
    truth = truth - rows.y.mean()  # an offset changes no R2, and its square hides the spread
    return GroupSums(rows.groups[cut.test], np.stack([error**2, np.abs(error), truth, truth**2, ones], 1))
