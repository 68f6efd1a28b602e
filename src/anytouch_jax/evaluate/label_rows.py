"""Rows of a label probe: which take part, with which label, group and split."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import scoring, splits, tasks
from anytouch_jax.evaluate.options import LabelProbeOptions
from anytouch_jax.evaluate.results import ProbeResult
from anytouch_jax.evaluate.tasks import TaskRows

# A column of more whole numbers than these is rather a measurement than names of classes.
MANY_NUMBERS = 20


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
    return rows, subsets_of(table, task, rows, leave_out)


def task_of(table: Manifest, options: LabelProbeOptions) -> tasks.Task:
    """Return the task of a label column: of classes, or a regression.

    Raises UserError for an unknown column or sensor.
    """
    task = tasks.label_task(
        table,
        options.label,
        group=options.leave_out or options.group,
        where=options.where,
        sensor=options.sensor,
    )
    return tasks.with_kind(table, task, options.regression)


def kind_sentence(table: Manifest, task: tasks.Task, options: LabelProbeOptions) -> str:
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


def select_rows(table: Manifest, task: tasks.Task, options: LabelProbeOptions) -> TaskRows:
    """Return the rows with a label. Raises UserError if there are none."""
    return tasks.select(table, task, options.frames)


def subsets_of(
    table: Manifest, task: tasks.Task, rows: TaskRows, leave_out: str | None
) -> dict[str, Array]:
    """Return masks of classes, or of held-out values, that alignment may have named, and others."""
    if task.kind == "regression":
        return {}
    if leave_out is None:
        return tasks.described_subsets(table, task.label, rows.rows[:, 0], "classes")
    return tasks.described_subsets(table, task.groups[0], rows.rows[:, 0], f"{leave_out}s")


def hold_out(rows: TaskRows, options: LabelProbeOptions) -> tuple[TaskRows, str]:
    """Return the rows, and what is left out in turn; "" if the split of the manifest is used.

    Where whole groups are left out in turn all rows are of train. That is so by `leave_out`, and
    where the manifest has no rows of train or of test, as recordings of a camera have none.
    """
    if options.leave_out is not None:
        return _all_of_train(rows), options.leave_out
    if np.any(rows.split == "train") and np.any(rows.split == "test"):
        return rows, ""
    if options.protocol == "published":
        raise UserError(
            "The manifest has no split into train and test, which --protocol published needs."
        )
    # keys of groups begin with their column
    return _all_of_train(rows), str(rows.groups[0]).partition(" ")[0]


def _all_of_train(rows: TaskRows) -> TaskRows:
    return rows._replace(split=np.full(len(rows.split), "train"))


def constant_result(rows: TaskRows, left_out: str, measured: bool) -> ProbeResult | None:
    """Check the rows before the work, and return the result of a constant prediction.

    It is the most frequent class of train, or its mean. There is none where groups are left out,
    since each fold has another constant.
    """
    if left_out and len(np.unique(rows.groups)) == 1:
        raise UserError(
            f"All rows are of one {left_out} ({rows.groups[0]}). Nothing is left to fit on."
        )
    nothing = np.zeros((len(rows.split), 1))
    if left_out:
        splits.check_rows(
            nothing, rows.labels, rows.groups, rows.split, measured=measured, tested=False
        )
        return None
    given, cut, _ = splits.check_rows(
        nothing, rows.labels, rows.groups, rows.split, measured=measured
    )
    constant = scoring.constant_prediction(given, cut)
    scored = scoring.Scored(cut, constant, constant)
    name = "mean of train" if measured else "commonest class"
    return scoring.result_of(name, "honest", given, scored)
