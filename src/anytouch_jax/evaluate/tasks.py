"""Probing tasks: which rows of a manifest, which label, which groups never stand on both sides of a
split.

Probes read every frame unflipped, as a flip changes a direction label. Pre-training flips touches
(`data.flip`).
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

# newtons (simulated) and label.contact_score (real_touch) above which a frame is contact
FORCE = 0.05
SCORE = 7.0
# of a label probe: the first with a value that is not the label
GROUPS = ("grasp_group", "object", "touch")


@dataclass(frozen=True)
class Task:
    """A question to ask of frozen features.

    `label`: a column of the manifest. `classes`: the only values that take part. `above`: the label
    is a number, and the class is whether it is larger. `groups`: columns of which the first with a
    value names the group of a row, else its sequence. The group "recording" is the sequence without
    its last part. `frames`: 1, or the length of a clip that ends at the row. `which` rows: the
    deepest frame of a recording ("press"), all that touch ("contact"), or the frame that slips most
    ("moving"). `fingers`: rows of a touch by two units. `phase` "after" the grasp (Feel). `where`:
    (column, text) must be equal, (column, number) must be exceeded. `test_list`: test rows are
    those whose `downstream_test` names this list.
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
    """A public benchmark of the paper with the authors' settings; `paper`: the accuracy of AnyTouch
    there.
    """

    task: Task
    pooling: Pooling
    recipe: GradientRecipe
    universal: bool
    paper: float


def _benchmark(
    name: str,
    dataset: str,
    label: str,
    paper: float,
    batch: int,
    rate: float,
    decay: float,
    pooling: Pooling = "class",
    universal: bool = False,
    **task: Any,
) -> Benchmark:
    question = Task(name, label, which="all", where=(("dataset", dataset),), **task)
    return Benchmark(
        question, pooling, GradientRecipe(batch=batch, rate=rate, decay=decay), universal, paper
    )


# Paper, appendix "Downstream Datasets" and Tables 1 to 3; released code,
# run_probe_{TAG,Feel,OF1,OF2}.sh, main_probe.py and downstream_dataset.py. A batch is of two
# devices together. Features are computed once, so training pictures are not augmented: the release
# flips and jitters them, except for ObjectFolder 2.0.
_TAG: dict[str, Any] = {"batch": 128, "rate": 2e-4, "decay": 0.05, "groups": ("recording",)}
_OF: dict[str, Any] = {"label": "label.material", "rate": 1e-3, "decay": 0.01, "universal": True}
BENCHMARKS = {
    benchmark.task.name: benchmark
    for benchmark in (
        _benchmark(
            "touch_and_go_material",
            "touch_and_go",
            "label.material",
            0.8082,
            test_list="material",
            **_TAG,
        ),
        _benchmark(
            "touch_and_go_roughness",
            "touch_and_go",
            "label.rough",
            0.8674,
            test_list="rough",
            **_TAG,
        ),
        _benchmark(
            "touch_and_go_hardness",
            "touch_and_go",
            "label.hardness",
            0.9468,
            test_list="material",
            **_TAG,
        ),
        _benchmark("feel_grasp", "feel", "label.success", 0.8053, 256, 1e-3, 0.05, fingers=True),
        _benchmark(
            "objectfolder1_material",
            "objectfolder1",
            paper=0.4962,
            batch=128,
            pooling="mean",
            **_OF,
        ),
        _benchmark("objectfolder2_material", "objectfolder2", paper=0.7602, batch=256, **_OF),
    )
}


class TaskRows(NamedTuple):
    """The rows of a task: `rows` i64 (n, fingers) of the manifest, and for each its label (text, or
    f64 of a regression), group, split (train, val, test), sensor and unit. `notes` say which rows
    are left out.
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
    """Return the task of any label column ("label." may be left out), on all rows that pass the
    filters.

    `group` defaults to the first of GROUPS with a value that is not the label. UserError for an
    unknown name.
    """
    conditions: list[tuple[str, str | float]] = (
        [(find_column(table, where[0]), where[1])] if where else []
    )
    if sensor is not None:
        if sensor not in (known := sorted(set(table.text_column("sensor")))):
            raise UserError(f"No row is of sensor {sensor!r}. The manifest has {', '.join(known)}.")
        conditions.append(("sensor", sensor))
    name = label.removeprefix("label.")
    known = [
        one
        for one in GROUPS
        if one != name and (_has_values(table, one) or _has_values(table, f"label.{one}"))
    ]
    groups = tuple(find_column(table, column) for column in ([group] if group else known[:1]))
    return Task(
        name, find_column(table, label), groups=groups, which="all", where=tuple(conditions)
    )


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
    """Return masks over `rows` (n,): values of `column` with a photograph or caption in train, and
    others, or {}.
    """
    values = table.text_column(column)
    described = (table.present("image_path") | table.present("text")) & (
        table.text_column("split") == "train"
    )
    mask = np.isin(values[rows], np.setdiff1d(values[described], [""]))
    if mask.all() or not mask.any():
        return {}
    return {f"{name} with a photograph or caption": mask, f"{name} without": ~mask}


def select(table: Manifest, task: Task, frames: int | None = None) -> TaskRows:
    """Return the rows of a task in the manifest's order; `frames` above the task's selects rows
    that end such a clip.

    A still (`frames` 1) of a task on clips takes the same rows as the clips do. Raises UserError
    without the label.
    """
    task = replace(task, label=_label_column(table, task))
    if not _has_values(table, task.label):
        known = (
            ", ".join(name for name in table.table.column_names if name.startswith("label."))
            or "none"
        )
        raise UserError(
            f"Task {task.name}: no row has a value in column {task.label!r}. The labels are "
            f"{known}."
        )
    labels = _labels(table, task)
    split = table.text_column("split")
    if task.test_list is not None:  # whichever list decided the split of this manifest
        if "downstream_test" not in table.table.column_names:
            raise UserError(
                f"Task {task.name} needs the column downstream_test. Index the data set again."
            )
        listed = [
            task.test_list in name.split("+") for name in table.text_column("downstream_test")
        ]
        split = np.where(listed, "test", "train")
    used = labels != "" if labels.dtype.kind == "U" else np.isfinite(labels)
    used &= np.isin(split, ("train", "val", "test")) & ~np.isin(
        table.text_column("sensor"), FIELD_SENSORS
    )
    for column, value in task.where:
        used &= (
            table.text_column(column) == value
            if isinstance(value, str)
            else table.number_column(column) > value
        )
    length = max(task.frames, frames or 1)
    if length > 1:
        used &= np.isin(np.arange(len(table)), table.clips(length)[:, -1])
    first = _choose_frames(table, task.which, np.flatnonzero(used))
    rows, first, notes = (
        _pair_fingers(table, task, first) if task.fingers else (first[:, None], first, ())
    )
    if not len(rows):
        lacking = (
            " and two fingers" if task.fingers else "" if task.which == "all" else " and contact"
        )
        raise UserError(
            f"Task {task.name}: no row of split train, val or test has a label in "
            f"{task.label!r}{lacking}. "
            "Check the filters and the splits."
        )
    if labels.dtype.kind == "U":
        notes += tuple(
            f"Classes {' and '.join(map(repr, alike))} differ only by spaces, letter case or "
            "Unicode form. They are "
            "probed as different classes."
            for alike in spellings(labels[first].tolist())
        )
    sensors, units = (table.text_column(name)[first] for name in ("sensor", "unit"))
    return TaskRows(
        rows, labels[first], _groups(table, task.groups)[first], split[first], sensors, units, notes
    )


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
            f"{source} contains {value:g}, a measured quantity, not a class. Probe it as a number."
        )
    return str(int(value))


def _has_values(table: Manifest, column: str) -> bool:
    return column in table.table.column_names and bool(table.present(column).any())


def _label_column(table: Manifest, task: Task) -> str:
    """Return the label column of a task; `object` falls back to the manifest's object column."""
    fallback = task.label == "label.object" and task.label not in table.table.column_names
    if fallback:
        return "object"
    return task.label


def _labels(table: Manifest, task: Task) -> Array:
    if task.kind == "regression" or task.above is not None:
        number = table.number_column(task.label)
        if task.above is None:
            return number
        return np.where(np.isfinite(number), np.where(number > task.above, "yes", "no"), "")
    values = table.column(task.label).to_pylist()
    texts = np.array([label_text(value, f"Column {task.label!r}") for value in values], dtype=str)
    if task.classes:
        return np.where(np.isin(texts, task.classes), texts, "")
    return texts


def _choose_frames(table: Manifest, which: Which, rows: Array) -> Array:
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
    slip = np.nan_to_num(table.number_column("label.slip")[rows], nan=0.0).round(2)
    return np.sort(best_rows(rows, sequence[rows], slip, late))


def best_rows(rows: Array, groups: Array, *keys: Array) -> Array:
    """Return the row of each group (n,) with the largest first key (n,), then the next key, then
    the earliest.
    """
    order = np.lexsort((rows, *(-key for key in reversed(keys)), groups))
    return rows[order[np.unique(groups[order], return_index=True)[1]]]


def _touching(table: Manifest) -> Array:
    """Return whether each frame is contact, bool (rows,), by force, flag or score; all are in a
    file without these.
    """
    # Force comes first: a flag or a score depends on the picture, and would leave out soft objects
    # for some sensors.
    force, contact_score = (
        table.number_column(f"label.{name}") for name in ("force", "contact_score")
    )
    flag = known_contact(table)
    touches = np.ones(len(table), bool)
    for source in range(len(table.files)):
        here = table.source == source
        for values, least in ((force, FORCE), (flag, 0.5), (contact_score, SCORE)):
            if np.isfinite(values[here]).any():
                touches[here] = np.nan_to_num(values[here], nan=-1.0) > least
                break
    return touches


def _groups(table: Manifest, columns: Sequence[str]) -> Array:
    """Return the group of each row: the first column with a value, else the sequence; keys differ
    between manifests.
    """
    sequence = table.text_column("sequence")
    file = np.array(
        [f" of file {number}" if len(table.files) > 1 else "" for number in table.source], dtype=str
    )
    groups = np.char.add(np.char.add("sequence ", sequence), file)
    for name in reversed(columns):
        if name == "recording":
            recordings = np.array(
                [f"recording {key.rpartition('/')[0] or key}" for key in sequence]
            )
            groups = np.char.add(recordings, file) if len(set(recordings)) > 1 else groups
        elif name in table.table.column_names:
            values = table.text_column(name)
            keys = np.char.add(values, file) if name in KEYS else values
            groups = np.where(values != "", np.char.add(f"{name} ", keys), groups)
    return groups


def _grasp_column(table: Manifest) -> str:
    """Return the column that two fingers of one grasp share."""
    if "grasp_group" in table.table.column_names:
        return "grasp_group"
    return "touch"


def _pair_fingers(table: Manifest, task: Task, rows: Array) -> tuple[Array, Array, tuple[str, ...]]:
    """Return rows (n, 2) of the two units of each grasp, by the units' names; the labelled row of
    each; and notes.
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
    notes = (
        [f"{len(starts) - len(whole)} grasps without two fingers left out"]
        if len(starts) > len(whole)
        else []
    )
    labelled = pairs[:, 0]
    if task.phase == "after":
        # of the form <grasp>/after/<finger>
        sequence = table.text_column("sequence")
        source = table.source
        after = {
            (source[row], sequence[row]): row
            for row in range(len(table))
            if "/after/" in sequence[row]
        }
        keys = [
            (source[row], sequence[row].replace("/during/", "/after/")) for row in pairs.ravel()
        ]
        pairs = np.array([after.get(key, -1) for key in keys], np.int64).reshape(pairs.shape)
        complete = (pairs >= 0).all(1)
        pairs = pairs[complete]
        labelled = labelled[complete]
        if not complete.all():
            notes.append(f"{np.sum(~complete)} grasps without both frames after left out")
    order = np.argsort(labelled)
    return pairs[order], labelled[order], tuple(notes)
