"""Probing tasks: which rows of a manifest, which label, and which groups stay together.

Probes read every frame unflipped, because a flip changes a direction label. Pre-training flips
touches (`data.flip`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import pyarrow as pa

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.background.contact import known_contact
from anytouch_jax.data.manifest.manifest import KEYS, Manifest
from anytouch_jax.data.manifest.schema import EMPTY, spellings
from anytouch_jax.encoder.arrays import Pooling
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.heads import GradientRecipe
from anytouch_jax.evaluate.statistics import Array

T = TypeVar("T")
Which = Literal["all", "press", "contact", "moving"]
# whether a label is continuous: decided by its column, or given
Regression = Literal["auto", "yes", "no"]

# newtons (simulated) and label.contact_score (real_touch) above which a frame is contact
FORCE = 0.05
SCORE = 7.0
# of a label probe: the first with a value that is not the label
GROUPS = ("grasp_group", "object", "touch")


@dataclass(frozen=True)
class Task:
    """A question to ask of frozen features.

    Attributes:
        name: on the command line and in tables.
        label: a column of the manifest.
        kind: classes, or a continuous label ("regression").
        groups: columns of which the first with a value names the group of a row, else its
            sequence. The group "recording" is the sequence without its last part.
        frames: 1, or the length of a clip that ends at the row.
        which: the deepest frame of a recording ("press"), all that touch ("contact"), the frame
            that slips most ("moving"), or all rows.
        classes: the only values that take part.
        above: the label is a number, and the class is whether it is larger.
        fingers: rows of a touch by two sensor instances.
        phase: "after" the grasp (Feel).
        where: (column, text) must be equal, (column, number) must be exceeded.
        test_list: test rows are those whose `downstream_test` names this list.
        unit: of a continuous label.
    """

    name: str
    label: str
    kind: Literal["classification", "regression"] = "classification"
    groups: tuple[str, ...] = ("object", "recording")
    frames: int = 1
    which: Which = "press"
    classes: tuple[str, ...] = ()
    above: float | None = None
    fingers: bool = False
    phase: Literal["during", "after"] = "during"
    where: tuple[tuple[str, str | float], ...] = ()
    test_list: str | None = None
    unit: str = ""


TASKS = {
    task.name: task
    for task in (
        *(Task(name, f"label.{name}") for name in ("material", "roughness", "hardness")),
        Task("grasp", "label.success", which="all", fingers=True),
        Task("grasp_after", "label.success", which="all", fingers=True, phase="after"),
        Task("object", "label.object", groups=("grasp_group", "touch")),
        Task("slip", "label.slip", frames=3, which="contact", above=0.5),
        Task("force", "label.force", "regression", frames=3, which="contact", unit="N"),
        Task(
            "twist",
            "label.twist",
            frames=3,
            which="moving",
            classes=("clockwise", "counterclockwise"),
        ),
        Task(
            "slide",
            "label.slide",
            frames=3,
            which="moving",
            classes=("right", "down", "left", "up"),
        ),
        Task("indenter", "label.indenter"),
    )
}


@dataclass(frozen=True)
class Benchmark:
    """A public benchmark of the paper with the authors' settings.

    `paper` is the accuracy of AnyTouch there, 0..1.
    """

    task: Task
    pooling: Pooling
    recipe: GradientRecipe
    universal: bool
    paper: float


def _benchmark(dataset: str, task: Task, paper: float, **settings: Any) -> Benchmark:
    """Return a benchmark on rows of one data set; `settings` are others than the usual ones."""
    task = replace(task, which="all", where=(("dataset", dataset),))
    usual: dict[str, Any] = {"pooling": "class", "universal": False}
    return Benchmark(task, paper=paper, **usual | settings)


# Paper, appendix "Downstream Datasets" and Tables 1 to 3; released code,
# run_probe_{TAG,Feel,OF1,OF2}.sh, main_probe.py and downstream_dataset.py. A batch is of two
# devices together. Features are computed once, so training images are not augmented: the release
# flips and jitters them, except for ObjectFolder 2.0.
_TAG = GradientRecipe(batch=128, rate=2e-4, decay=0.05)
_FEEL = GradientRecipe(batch=256, rate=1e-3, decay=0.05)
_OF1 = GradientRecipe(batch=128, rate=1e-3, decay=0.01)
_OF2 = GradientRecipe(batch=256, rate=1e-3, decay=0.01)


def _tag_task(name: str, label: str, test_list: str) -> Task:
    """Return a task of Touch and Go; the authors' list says which rows are tested."""
    return Task(f"touch_and_go_{name}", label, groups=("recording",), test_list=test_list)


_BENCHMARKS = (
    _benchmark(
        "touch_and_go", _tag_task("material", "label.material", "material"), 0.8082, recipe=_TAG
    ),
    _benchmark("touch_and_go", _tag_task("roughness", "label.rough", "rough"), 0.8674, recipe=_TAG),
    _benchmark(
        "touch_and_go", _tag_task("hardness", "label.hardness", "material"), 0.9468, recipe=_TAG
    ),
    _benchmark("feel", Task("feel_grasp", "label.success", fingers=True), 0.8053, recipe=_FEEL),
    _benchmark(
        "objectfolder1",
        Task("objectfolder1_material", "label.material"),
        0.4962,
        recipe=_OF1,
        pooling="mean",
        universal=True,
    ),
    _benchmark(
        "objectfolder2",
        Task("objectfolder2_material", "label.material"),
        0.7602,
        recipe=_OF2,
        universal=True,
    ),
)
BENCHMARKS = {benchmark.task.name: benchmark for benchmark in _BENCHMARKS}


class TaskRows(NamedTuple):
    """The rows of a task, `rows` i64 (n, fingers) of the manifest, with what a probe knows of them.

    `labels` (n,) are text, or f64 of a regression. `groups`, `split` (train, val, test), `sensors`
    and `units` (sensor instances) are text (n,). `notes` say which rows are left out.
    """

    rows: Array
    labels: Array
    groups: Array
    split: Array
    sensors: Array
    units: Array
    notes: tuple[str, ...]

    def take(self, ids: Array) -> TaskRows:
        """Return the rows with these places."""
        return TaskRows._make([*(column[ids] for column in self[:-1]), self.notes])


def find_named(known: Mapping[str, T], name: str | T, kind: str) -> T:
    """Return the task or benchmark with that name, or one that is given. Raises UserError."""
    if not isinstance(name, str):
        return name
    if name not in known:
        raise UserError(f"There is no {kind} {name!r}. Choose among {', '.join(known)}.")
    return known[name]


def available_tasks(table: Manifest) -> tuple[str, ...]:
    """Return the tasks for which the manifest has a label on some row."""
    paired = _has_values(table, _grasp_column(table)) and _has_values(table, "unit")
    labelled = {
        name: task for name, task in TASKS.items() if _has_values(table, _label_column(table, task))
    }
    return tuple(name for name, task in labelled.items() if paired or not task.fingers)


def label_task(
    table: Manifest,
    label: str,
    *,
    group: str = "",
    where: tuple[str, float] | None = None,
    sensor: str | None = None,
) -> Task:
    """Return the task of any label column, on all rows that pass the filters.

    Args:
        table: the manifest.
        label: the column; "label." may be left out.
        group: column whose values stay together, by default the first of GROUPS with a value that
            is not the label.
        where: keep rows whose column is above a number.
        sensor: keep rows of this sensor.

    Raises:
        UserError: for a name that the manifest does not have.
    """
    conditions: list[tuple[str, str | float]] = []
    if where is not None:
        column, number = where
        conditions.append((find_column(table, column), number))
    if sensor is not None:
        known = sorted(set(table.text_column("sensor")))
        if sensor not in known:
            raise UserError(f"No row is of sensor {sensor!r}. The manifest has {', '.join(known)}.")
        conditions.append(("sensor", sensor))
    name = label.removeprefix("label.")
    columns = [group] if group else _group_columns(table, name)[:1]
    groups = tuple(find_column(table, column) for column in columns)
    column = find_column(table, label)
    return Task(name, column, groups=groups, which="all", where=tuple(conditions))


def _group_columns(table: Manifest, label: str) -> list[str]:
    """Return those of GROUPS that have a value and are not the label itself.

    Groups by the label would put each class on one side of the split.
    """
    columns = []
    for name in GROUPS:
        if name != label and (_has_values(table, name) or _has_values(table, f"label.{name}")):
            columns.append(name)
    return columns


def with_kind(table: Manifest, task: Task, regression: Regression = "auto") -> Task:
    """Return a task of classes as a regression if its label is continuous.

    By "auto" it is one if the column has a number with a fraction: a stiffness of 10.25 is no
    class. Whole numbers may be names of classes (object 17), so they are a regression by "yes"
    alone. Raises UserError for "yes" on text.
    """
    fixed = task.kind == "regression" or task.above is not None or bool(task.classes)
    if fixed or task.label not in table.table.column_names or regression == "no":
        return task
    kind = table.column(task.label).type
    is_number = pa.types.is_floating(kind) or pa.types.is_integer(kind)
    if regression == "yes":
        if not is_number:
            raise UserError(
                f"Column {task.label!r} contains text. A regression needs numbers. Leave out "
                "--regression yes."
            )
        return replace(task, kind="regression")
    if not pa.types.is_floating(kind):
        return task
    values = table.number_column(task.label)
    values = values[np.isfinite(values)]
    if (values != np.round(values)).any():
        return replace(task, kind="regression")
    return task


def find_column(table: Manifest, name: str) -> str:
    """Return `label.<name>` or else `name`, whichever the manifest has. Raises UserError."""
    columns = table.table.column_names
    for candidate in (f"label.{name}", name):
        if candidate in columns:
            if pa.types.is_nested(table.column(candidate).type):
                raise UserError(
                    f"Column {candidate!r} contains lists. A probe needs one value a row."
                )
            return candidate
    raise UserError(
        f"The manifest has no column {name!r} or 'label.{name}'. It has {', '.join(columns)}."
    )


def described_subsets(table: Manifest, column: str, rows: Array, name: str) -> dict[str, Array]:
    """Return masks over `rows` (n,): values of `column` that alignment may have named, and others.

    Those are values with an RGB image or caption in train. {} if all values are of one kind.

    Args:
        table: the frames.
        column: whose values are divided.
        rows: i64 (n,).
        name: of the subsets in tables.
    """
    values = table.text_column(column)
    described = (table.present("image_path") | table.present("text")) & (
        table.text_column("split") == "train"
    )
    mask = np.isin(values[rows], np.setdiff1d(values[described], [""]))
    if mask.all() or not mask.any():
        return {}
    return {f"{name} with an RGB image or caption": mask, f"{name} without": ~mask}


def select(table: Manifest, task: Task, frames: int | None = None) -> TaskRows:
    """Return the rows of a task in the manifest's order.

    `frames` above the task's selects rows that end such a clip. A still (`frames` 1) of a task on
    clips takes the same rows as the clips do, so that both can be compared. Raises UserError
    without the label.
    """
    task = replace(task, label=_label_column(table, task))
    if not _has_values(table, task.label):
        columns = [name for name in table.table.column_names if name.startswith("label.")]
        raise UserError(
            f"Task {task.name}: no row has a value in column {task.label!r}. The labels are "
            f"{', '.join(columns) or 'none'}."
        )
    labels = _labels(table, task)
    split = _split(table, task)
    used = _takes_part(table, task, labels, split, frames or 1)
    first = _choose_frames(table, task.which, np.flatnonzero(used))
    rows = first[:, None]
    notes: tuple[str, ...] = ()
    if task.fingers:
        rows, first, notes = _pair_fingers(table, task, first)
    if not len(rows):
        raise UserError(
            f"Task {task.name}: no row of split train, val or test has a label in "
            f"{task.label!r}{_also_needed(task)}. Check the filters and the splits."
        )
    if labels.dtype.kind == "U":
        for alike in spellings(labels[first].tolist()):
            notes += (
                f"Classes {' and '.join(map(repr, alike))} differ only by spaces, letter case or "
                "Unicode form. They are probed as different classes.",
            )
    return TaskRows(
        rows,
        labels[first],
        _groups(table, task.groups)[first],
        split[first],
        table.text_column("sensor")[first],
        table.text_column("unit")[first],
        notes,
    )


def _also_needed(task: Task) -> str:
    """Return what a row needs beside a label, to end a sentence."""
    if task.fingers:
        return " and two fingers"
    if task.which == "all":
        return ""
    return " and contact"


def _split(table: Manifest, task: Task) -> Array:
    """Return the split of each row, by the list that a benchmark tests on if it names one."""
    if task.test_list is None:
        return table.text_column("split")
    # Data sets with several lists have one column `split`, by whichever list it was indexed.
    if "downstream_test" not in table.table.column_names:
        raise UserError(
            f"Task {task.name} needs the column downstream_test. Index the data set again."
        )
    lists = table.text_column("downstream_test")
    listed = [task.test_list in names.split("+") for names in lists]
    return np.where(listed, "test", "train")


def _takes_part(table: Manifest, task: Task, labels: Array, split: Array, frames: int) -> Array:
    """Return which rows have a label and image, a split that counts, and pass the filters."""
    if labels.dtype.kind == "U":
        used = labels != ""
    else:
        used = np.isfinite(labels)
    used &= np.isin(split, ("train", "val", "test"))
    used &= ~np.isin(table.text_column("sensor"), FIELD_SENSORS)
    for column, value in task.where:
        if isinstance(value, str):
            used &= table.text_column(column) == value
        else:
            used &= table.number_column(column) > value
    length = max(task.frames, frames)
    if length > 1:
        used &= np.isin(np.arange(len(table)), table.clips(length)[:, -1])
    return used


def label_text(value: Any, source: str = "The label") -> str:
    """Return a class label as text, "" for None, NaN and texts such as "n/a".

    Raises UserError for a quantity.
    """
    if value is None or value != value:
        return ""
    if not isinstance(value, float | np.floating):
        text = str(value).strip()
        # "none" is a class of the simulator (no slide, no twist); "None" is what Python prints for
        # a missing value.
        if text == "None" or (text != "none" and text.lower() in EMPTY):
            return ""
        return str(value)
    if not np.isfinite(value) or value != int(value):
        raise UserError(
            f"{source} contains {value:g}, a measured quantity, not a class. Probe it with "
            "--regression yes, or in Python with regression=True."
        )
    return str(int(value))


def _has_values(table: Manifest, column: str) -> bool:
    return column in table.table.column_names and bool(table.present(column).any())


def _label_column(table: Manifest, task: Task) -> str:
    """Return the label column of a task; `object` falls back to the manifest's object column."""
    if task.label == "label.object" and task.label not in table.table.column_names:
        return "object"
    return task.label


def _labels(table: Manifest, task: Task) -> Array:
    if task.kind == "regression" or task.above is not None:
        number = table.number_column(task.label)
        if task.above is None:
            return number
        answer = np.where(number > task.above, "yes", "no")
        return np.where(np.isfinite(number), answer, "")
    values = table.column(task.label).to_pylist()
    texts = np.array([label_text(value, f"Column {task.label!r}") for value in values], dtype=str)
    if task.classes:
        return np.where(np.isin(texts, task.classes), texts, "")
    return texts


def _choose_frames(table: Manifest, which: Which, rows: Array) -> Array:
    """Return those of `rows` that a task asks about; see `Task.which`."""
    if which == "all":
        return rows
    rows = rows[_touching(table)[rows]]
    if which == "contact" or not len(rows):
        return rows
    sequence = table.codes("sequence", own=True)
    frame = np.asarray(table.column("frame_index"))
    if which == "press":
        force = table.number_column("label.force")[rows]
        known = np.isfinite(force)
        deepest = best_rows(rows[known], sequence[rows[known]], force[known])
        return np.sort(np.concatenate([rows[~known], deepest]))
    last = np.zeros(sequence.max() + 1)
    np.maximum.at(last, sequence, frame)
    # motion lasts from a third to five sixths of a recording
    late = -np.abs(frame - 2 / 3 * last[sequence])[rows]
    # rounded, so that the noise of the last digits does not outvote the moment
    slip = np.nan_to_num(table.number_column("label.slip")[rows], nan=0.0).round(2)
    return np.sort(best_rows(rows, sequence[rows], slip, late))


def best_rows(rows: Array, groups: Array, *keys: Array) -> Array:
    """Return the row of each group (n,) with the largest first key (n,).

    Of equals it is that with the largest next key, then the earliest.
    """
    descending = [-key for key in reversed(keys)]
    order = np.lexsort((rows, *descending, groups))
    first = np.unique(groups[order], return_index=True)[1]
    return rows[order[first]]


def _touching(table: Manifest) -> Array:
    """Return whether each frame is contact, bool (rows,), by force, flag or score.

    In a file without these all frames are.
    """
    # Force comes first: a flag or a score depends on the image, and would leave out soft objects
    # for some sensors.
    measures = (
        (table.number_column("label.force"), FORCE),
        (known_contact(table), 0.5),
        (table.number_column("label.contact_score"), SCORE),
    )
    touches = np.ones(len(table), bool)
    for source in range(len(table.files)):
        here = table.source == source
        for values, least in measures:
            if np.isfinite(values[here]).any():
                touches[here] = np.nan_to_num(values[here], nan=-1.0) > least
                break
    return touches


def _groups(table: Manifest, columns: Sequence[str]) -> Array:
    """Return the group of each row: the first column with a value, else the sequence.

    Touches and recordings are numbered in each manifest anew, so keys of several manifests differ.
    """
    sequence = table.text_column("sequence")
    file = np.full(len(table), "")
    if len(table.files) > 1:
        file = np.array([f" of file {number}" for number in table.source])
    groups = np.char.add(np.char.add("sequence ", sequence), file)
    for name in reversed(columns):
        if name == "recording":
            names = [key.rpartition("/")[0] or key for key in sequence]
            recordings = np.array([f"recording {one}" for one in names])
            # One name for all says nothing: it is a folder that holds the recordings.
            if len(set(recordings)) > 1:
                groups = np.char.add(recordings, file)
        elif name in table.table.column_names:
            values = table.text_column(name)
            keys = values
            if name in KEYS:
                keys = np.char.add(values, file)
            groups = np.where(values != "", np.char.add(f"{name} ", keys), groups)
    return groups


def _grasp_column(table: Manifest) -> str:
    """Return the column that two fingers of one grasp share."""
    if "grasp_group" in table.table.column_names:
        return "grasp_group"
    return "touch"


def _pair_fingers(table: Manifest, task: Task, rows: Array) -> tuple[Array, Array, tuple[str, ...]]:
    """Return rows (n, 2) of the two sensor instances of each grasp, in the order of their names.

    Then come the labelled row of each grasp, and notes.
    """
    name = _grasp_column(table)
    rows = rows[table.present(name)[rows] & table.present("unit")[rows]]
    grasp = table.codes(name, own=True)[rows]
    unit = table.text_column("unit")[rows]
    order = np.lexsort((unit, grasp))
    rows = rows[order]
    grasp = grasp[order]
    unit = unit[order]
    starts, counts = np.unique(grasp, return_index=True, return_counts=True)[1:]
    whole = starts[counts == 2]
    whole = whole[unit[whole] != unit[whole + 1]]
    pairs = rows[whole[:, None] + np.arange(2)]
    notes = []
    if len(starts) > len(whole):
        notes.append(f"{len(starts) - len(whole)} grasps without two fingers left out")
    labelled = pairs[:, 0]
    if task.phase == "after":
        pairs = _frames_after(table, pairs)
        complete = (pairs >= 0).all(1)
        pairs = pairs[complete]
        labelled = labelled[complete]
        if not complete.all():
            notes.append(f"{np.sum(~complete)} grasps without both frames after left out")
    order = np.argsort(labelled)
    return pairs[order], labelled[order], tuple(notes)


def _frames_after(table: Manifest, pairs: Array) -> Array:
    """Return the rows (n, 2) after the grasp of rows during it, -1 where there is none.

    Recordings of Feel are called <grasp>/during/<finger> and <grasp>/after/<finger>.
    """
    sequence = table.text_column("sequence")
    source = table.source
    after = {}
    for row in range(len(table)):
        if "/after/" in sequence[row]:
            after[source[row], sequence[row]] = row
    found = []
    for row in pairs.ravel():
        later = sequence[row].replace("/during/", "/after/")
        found.append(after.get((source[row], later), -1))
    return np.array(found, np.int64).reshape(pairs.shape)
