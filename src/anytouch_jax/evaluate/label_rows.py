"""Rows of a label probe: which take part, and which are fitted on and tested."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import scoring, splits, tasks
from anytouch_jax.evaluate.options import LabelProbeOptions
from anytouch_jax.evaluate.results import ProbeResult
from anytouch_jax.evaluate.splits import Split
from anytouch_jax.evaluate.tasks import Task, TaskRows

# A column of more whole numbers than these is rather a measurement than names of classes.
MANY_NUMBERS = 20


class LabelPlan(NamedTuple):
    """What is fitted on and tested in a label probe.

    Attributes:
        task: the label, of classes or a regression.
        rows: that take part.
        subsets: parts of them that are scored too, as masks.
        left_out: what is left out in turn, "" if a split is used.
        cuts: splits from one sensor to another, () if the rows have one split for all.
        notes: sentences on how the rows are split, for the log.
    """

    task: Task
    rows: TaskRows
    subsets: scoring.Subsets
    left_out: str
    cuts: tuple[Split, ...]
    notes: tuple[str, ...]

    @property
    def regression(self) -> bool:
        """Whether the label is continuous."""
        return self.task.kind == "regression"


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
) -> tuple[TaskRows, scoring.Subsets]:
    """Return the rows of `probe_label`, and masks as of `tasks.described_subsets`.

    `among` chooses some of the rows; the other arguments are fields of `LabelProbeOptions`.
    """
    options = LabelProbeOptions(
        label=label, group=group, leave_out=leave_out, where=where, sensor=sensor, frames=frames
    )
    task = task_of(table, options)
    rows = among(tasks.select(table, task, frames))
    return rows, _subsets(table, task, rows, leave_out)


def task_of(table: Manifest, options: LabelProbeOptions) -> Task:
    """Return the task of a label column: of classes, or a regression.

    Raises UserError for an unknown column or sensor, and for options that do not go together.
    """
    task = tasks.label_task(
        table,
        options.label,
        group=options.leave_out or options.group,
        where=options.where,
        sensor=options.sensor,
    )
    task = tasks.with_kind(table, task, options.regression)
    if options.save is not None and task.kind == "regression":
        raise UserError(
            f"{task.label} is continuous, and a saved head names classes. Leave out --save."
        )
    if options.train_sensor is None and options.test_sensor is None:
        return task
    if options.train_sensor is None or options.test_sensor is None:
        raise UserError("--train-sensor and --test-sensor go together. Give both.")
    if options.train_sensor == options.test_sensor:
        raise UserError("--train-sensor and --test-sensor are the same. Use --sensor for one.")
    if options.sensor is not None or options.leave_out is not None or options.save is not None:
        raise UserError(
            "--sensor, --leave-out and --save have no effect with --train-sensor. Leave them out; "
            f"--sensor {options.train_sensor} --save writes the head of one sensor."
        )
    return task


def labelled_rows(table: Manifest, task: Task, options: LabelProbeOptions) -> TaskRows:
    """Return the rows with a label. Raises UserError if there are none, or none of a sensor."""
    rows = tasks.select(table, task, options.frames)
    known = np.unique(rows.sensors)
    for sensor in (options.train_sensor, options.test_sensor):
        if sensor is not None and sensor not in known:
            raise UserError(
                f"No row with {task.label} is of sensor {sensor!r}. There are {', '.join(known)}."
            )
    return rows


def plan_rows(table: Manifest, task: Task, rows: TaskRows, options: LabelProbeOptions) -> LabelPlan:
    """Decide what is fitted on and tested. Raises UserError if nothing can be.

    Args:
        table: the frames.
        task: with the label and the group.
        rows: that have the label.
        options: of the probe.
    """
    if options.train_sensor is not None and options.test_sensor is not None:
        return _between_sensors(task, rows, options, options.train_sensor, options.test_sensor)
    subsets = _subsets(table, task, rows, options.leave_out)
    notes = [*rows.notes, _kind_sentence(table, task, options)]
    left_out = ""
    if options.leave_out is not None:
        left_out = options.leave_out
    elif not (np.any(rows.split == "train") and np.any(rows.split == "test")):
        # Recordings of a camera have no split: whole groups are left out, so that no frame of a
        # recording is tested by a head that has seen its neighbours.
        if options.protocol == "released":
            raise UserError(
                "The manifest has no split into train and test, which --protocol released needs."
            )
        left_out = str(rows.groups[0]).partition(" ")[0]  # keys of groups begin with their column
        notes.append(
            f"The manifest has no split into train and test: every {left_out} is left out in turn, "
            "and scored by a head fitted on the others"
        )
    if left_out and len(np.unique(rows.groups)) == 1:
        raise UserError(
            f"All rows are of one {left_out} ({rows.groups[0]}). Nothing is left to fit on."
        )
    said = tuple(note for note in notes if note)
    return LabelPlan(task, rows, subsets, left_out, (), said)


def _between_sensors(
    task: Task, rows: TaskRows, options: LabelProbeOptions, train: str, test: str
) -> LabelPlan:
    """Return splits that fit on rows of one sensor and test the same classes by another.

    The split of the manifest is kept if train has the classes of test. Else groups are dealt to
    folds: a touch that both sensors felt is tested by a head that has not seen it, nor its place.
    """
    rows = rows.take(np.flatnonzero(np.isin(rows.sensors, (train, test))))
    notes = list(rows.notes)
    is_other = rows.sensors == test
    if task.kind != "regression":
        known = np.isin(rows.labels, rows.labels[~is_other])
        if not known.any() or not np.any(known & is_other):
            raise UserError(f"No class of {task.label} is by both {train} and {test}.")
        if not known.all():
            notes.append(
                f"{np.sum(~known)} rows of classes that {train} has not touched are left out"
            )
        rows = rows.take(np.flatnonzero(known))
        is_other = is_other[known]
    if not np.any((rows.split == "test") & is_other):
        # so all rows are dealt to folds
        rows = rows._replace(split=np.full(len(rows.split), "test"))
    sides = {"train_sensors": (train,), "test_sensors": (test,)}
    roles, _ = splits.assign_roles(task, rows, sides)
    cuts = tuple(splits.seeded_splits(roles, 0, options.protocol))
    if not cuts:
        raise UserError(f"No group of {test} is left to test. Give more recordings.")
    scheme, _, why = splits.split_scheme(roles)
    notes.append(f"fitted on {train}, tested on the same {task.name} by {test}")
    if scheme == "folds":
        notes.append(why)
    return LabelPlan(task, rows, {}, "", cuts, tuple(notes))


def _kind_sentence(table: Manifest, task: Task, options: LabelProbeOptions) -> str:
    """Return how a column of numbers is probed and how to change that, "" if nobody could ask."""
    if options.regression != "auto":
        return ""
    if task.kind == "regression":
        return (
            f"{task.label} holds measurements: it is probed by regression (R2, mean absolute "
            "error, Spearman's correlation)"
        )
    column = table.column(task.label)
    is_number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
    count = len(column.unique().drop_null())
    if is_number and count > MANY_NUMBERS:
        return (
            f"{task.label} holds {count} whole numbers, which are probed as classes. Give "
            "--regression yes if they are measurements"
        )
    return ""


def _subsets(
    table: Manifest, task: Task, rows: TaskRows, leave_out: str | None
) -> dict[str, Array]:
    """Return masks of classes, or of held-out values, that alignment may have named, and others."""
    if task.kind == "regression":
        return {}
    if leave_out is None:
        return tasks.described_subsets(table, task.label, rows.rows[:, 0], "classes")
    return tasks.described_subsets(table, task.groups[0], rows.rows[:, 0], f"{leave_out}s")


def constant_result(plan: LabelPlan) -> ProbeResult | None:
    """Check the rows before the work, and return the result of a constant prediction.

    It is the most frequent class of train, or its mean. There is none where each fold has another
    one: there it is the column `chance` alone.
    """
    rows = plan.rows
    nothing = np.zeros((len(rows.split), 1))
    if plan.cuts:
        return None
    split = rows.split
    if plan.left_out:
        split = np.full(len(split), "train")
    given, cut, _ = splits.check_rows(
        nothing,
        rows.labels,
        rows.groups,
        split,
        regression=plan.regression,
        tested=not plan.left_out,
    )
    if plan.left_out:
        return None
    constant = scoring.constant_prediction(given, cut)
    name = "mean of train" if plan.regression else "commonest class"
    return scoring.result_of(name, "grouped", given, scoring.Scored(cut, constant, constant))
