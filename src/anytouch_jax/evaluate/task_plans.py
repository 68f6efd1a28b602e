"""Plans of probing tasks: the rows of each task, their roles, and why a task cannot be probed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Array, Log
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import splits, tasks
from anytouch_jax.evaluate.options import TaskProbeOptions
from anytouch_jax.evaluate.splits import SIDES, RowRoles
from anytouch_jax.evaluate.tasks import Task, TaskRows


class TaskPlan(NamedTuple):
    """A task with the rows that can be fitted on or tested.

    `roles` and class `names` are of the rows, and `frames` is the length of a clip.
    """

    task: Task
    rows: TaskRows
    roles: RowRoles
    names: Array
    frames: int
    notes: list[str]


def plan_tasks(
    table: Manifest,
    names: Sequence[str | Task],
    options: TaskProbeOptions,
    among: Callable[[TaskRows], TaskRows],
    log: Log,
) -> tuple[list[TaskPlan], dict[str, str]]:
    """Return the plans of the tasks that can be probed, and why the others cannot.

    Raises UserError if none can.

    Args:
        table: the frames.
        names: of tasks, or tasks.
        options: of the probe.
        among: chooses some of a task's rows.
        log: takes a sentence on what is left out.
    """
    plans = list[TaskPlan]()
    left_out = dict[str, str]()
    if names == "all" or list(names) == ["all"]:
        names = tasks.available_tasks(table)
        for name in tasks.TASKS:
            if name not in names:
                left_out[name] = "The manifest has no such label."
    if not names:
        raise UserError(
            "The manifest has no label of any task. `anytouch probe label` takes any column."
        )
    errors = []
    for task in [_find(table, name) for name in names]:
        try:
            plans.append(_plan(table, task, options, among))
        except UserError as error:
            left_out[task.name] = str(error).removeprefix(f"Task {task.name}: ")
            errors.append(f"Task {task.name}: {left_out[task.name]}")
    if not plans:
        raise UserError(" ".join(errors))
    for name, reason in left_out.items():
        log(f"{name}: not probed ({reason})")
    return plans, left_out


def _find(table: Manifest, name: str | Task) -> Task:
    """Return a task by its name, or that of a label column of the manifest. Raises UserError."""
    columns = table.table.column_names
    is_column = isinstance(name, str) and (name in columns or f"label.{name}" in columns)
    if name not in tasks.TASKS and is_column:
        return tasks.label_task(table, str(name))
    if isinstance(name, str) and name not in tasks.TASKS:
        raise UserError(
            f"There is no task {name!r}. Choose among {', '.join(tasks.TASKS)}, or name a label "
            "column of the manifest."
        )
    return tasks.find_named(tasks.TASKS, name, "task")


def _plan(
    table: Manifest,
    task: Task,
    options: TaskProbeOptions,
    among: Callable[[TaskRows], TaskRows],
) -> TaskPlan:
    """Select the rows of a task that can be fitted on or tested, at most `max_rows` of them.

    Raises UserError.
    """
    for name, count in (("max_rows", options.max_rows), ("frames", options.frames)):
        if count is not None and count < 1:
            raise UserError(f"{name} must be at least 1, not {count}.")
    sides = options.sides
    task = tasks.with_kind(table, task, options.regression)
    rows = tasks.select(table, task, options.frames)
    splits.assign_roles(task, rows, sides)  # raises for sensors that no row has, before `among`
    rows = among(rows)
    roles, _ = splits.assign_roles(task, rows, sides)
    _, takes_part, _ = splits.split_scheme(roles)
    used = np.flatnonzero(takes_part & (roles.may_fit | roles.may_test))
    rows = rows.take(splits.subsample(used, options.max_rows or len(used)))
    # again, as classes and scheme may be others among the rows that are left
    roles, names = splits.assign_roles(task, rows, sides)
    scheme, _, why = splits.split_scheme(roles)
    notes = [*rows.notes, why]
    for side in SIDES:
        patterns = sides[side]
        if patterns:
            notes.append(f"{side.replace('_', ' ')} {', '.join(patterns)}")
    if scheme == "split" and not roles.regression:
        notes += splits.unlearned_note(roles.y[roles.tested], roles.y[roles.fitted], names)
    notes = [note for note in notes if note]
    return TaskPlan(task, rows, roles, names, options.frames or task.frames, notes)
