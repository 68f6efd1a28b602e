"""The tasks of the battery: which rows of a manifest, which label, and what must never stand on both sides of a split.

A direction is a label of the picture as it is: a flip of the picture changes it. Pre-training flips touches
(`data.flip`, as the release), the positive of a matching pair independently of its anchor, which teaches the encoder to
overlook directions. Probes see every frame unflipped. Whoever trains with direction labels sets `--loader.flip 0` (and
turns nothing by `--loader.affine`), or changes the label with the picture by `mirrored`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from anytouch_jax.data.manifest.manifest import KEYS, Manifest
from anytouch_jax.data.prepare.contact import known_contact
from anytouch_jax.encoder.encoder import text_column
from anytouch_jax.errors import UserError

Array = npt.NDArray[Any]
Which = Literal["all", "press", "contact", "moving"]

FORCE, SCORE = 0.05, 7.0  # newtons (simulated) and label.contact_score (real_touch) above which a frame is contact
_TURNED = {"clockwise": "counterclockwise", "counterclockwise": "clockwise"}
_ACROSS, _DOWN = {"right": "left", "left": "right"}, {"up": "down", "down": "up"}


@dataclass(frozen=True)
class Task:
    """A question asked of frozen features.

    `label`: a column of the manifest; `classes`: the only values that take part (all without it); `above`: the label is
    a number, and the class is whether it lies above. `groups`: columns of which the first with a value names what is
    never on both sides of a split (then the sequence; "recording" is the sequence without its last part: several
    touches of one video, and no group where all rows are of one). `frames`: 1,
    or 3 for a clip that ends at the row. `which` rows: press, the deepest frame of a recording; contact, all that
    touch; moving, the frame of a recording that slips most. `fingers`: the rows of a touch by two units, features
    concatenated; `phase` "after": the frames after the grasp (Feel) instead of those during it. `where`: (column,
    value) that a row must have. `listed`: test rows are those whose `downstream_test` names this list. `unit` of a
    regression.
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
    where: tuple[str, str] | None = None
    listed: str | None = None
    unit: str = ""


TASKS = {
    task.name: task
    for task in (
        Task("material", "label.material"),
        Task("roughness", "label.roughness"),
        Task("hardness", "label.hardness"),
        Task("grasp", "label.success", which="all", fingers=True),
        Task("grasp_after", "label.success", which="all", fingers=True, phase="after"),
        Task("object", "label.object", groups=("grasp_group", "touch")),
        Task("slip", "label.slip", frames=3, which="contact", above=0.5),
        Task("force", "label.force", "regression", frames=3, which="contact", unit="N"),
        Task("twist", "label.twist", frames=3, which="moving", classes=("clockwise", "counterclockwise")),
        Task("slide", "label.slide", frames=3, which="moving", classes=("right", "down", "left", "up")),
        Task("indenter", "label.indenter"),
    )
}


class Selection(NamedTuple):
    """The rows of a task: `rows` i64 (n, fingers) of the manifest, and of each its label (text, or f64 of a
    regression), group, split (train, val, test), sensor and unit; `notes` on what was left out."""

    rows: Array
    labels: Array
    groups: Array
    split: Array
    sensors: Array
    units: Array
    notes: tuple[str, ...]


def task_of(task: str | Task) -> Task:
    """The task of that name. Raises UserError."""
    if isinstance(task, Task):
        return task
    if task not in TASKS:
        raise UserError(f"there is no task {task!r}; choose among {', '.join(TASKS)}")
    return TASKS[task]


def available(table: Manifest) -> tuple[str, ...]:
    """The tasks whose label the manifest holds on some row."""
    columns = {name: _column_of(table, task) for name, task in TASKS.items()}
    has = {name: bool(table.present(name).any()) for name in set(columns.values()) if name in table.table.column_names}
    return tuple(
        name for name, task in TASKS.items() if has.get(columns[name]) and (not task.fingers or _paired(table))
    )


def _column_of(table: Manifest, task: Task) -> str:
    """The column of a task's label; the object is told by a column of its own where there is no label of it."""
    lock = task.label == "label.object" and task.label not in table.table.column_names
    return "object" if lock else task.label


def mirrored(label: str, value: str, *, across: bool = False, down: bool = False) -> str:
    """What a direction label (column `label`) becomes when the picture is flipped left to right or upside down."""
    if label == "label.twist" and across != down:
        return _TURNED.get(value, value)
    if label == "label.slide":
        value = _ACROSS.get(value, value) if across else value
        value = _DOWN.get(value, value) if down else value
    return value


def select(table: Manifest, task: Task, frames: int | None = None) -> Selection:
    """The rows of a task, in the manifest's order. `frames` longer than the task's asks for rows that end such a clip.

    A still (`frames` 1) of a task on clips takes the same rows as the clips do. Raises UserError without the label.
    """
    task = replace(task, label=_column_of(table, task))
    if task.label not in table.table.column_names or not table.present(task.label).any():
        known = ", ".join(name for name in table.table.column_names if name.startswith("label.")) or "none"
        raise UserError(f"task {task.name}: the manifest has no label in column {task.label!r}; it has {known}")
    labels, split = _labels(table, task), _split(table, task)
    has = labels != "" if labels.dtype.kind == "U" else np.isfinite(labels)
    kept = has & np.isin(split, ("train", "val", "test"))
    if task.where is not None:
        kept &= text_column(table, task.where[0]) == task.where[1]
    length = max(task.frames, frames or 1)
    if length > 1:
        kept &= np.isin(np.arange(len(table)), table.clips(length)[:, -1])
    rows = _which(table, task.which, np.flatnonzero(kept))
    read, told, notes = _fingers(table, task, rows) if task.fingers else (rows[:, None], rows, ())
    if not len(read):
        what = "two fingers of one touch" if task.fingers else "a label and contact"
        raise UserError(f"task {task.name}: no row of split train, val or test has {what} (label {task.label!r})")
    sensors, units = (text_column(table, name)[told] for name in ("sensor", "unit"))
    return Selection(read, labels[told], _groups(table, task.groups)[told], split[told], sensors, units, notes)


def _labels(table: Manifest, task: Task) -> Array:
    if task.kind == "regression" or task.above is not None:
        number = _number(table, task.label)
        if task.above is None:
            return number
        return np.where(np.isfinite(number), np.where(number > task.above, "yes", "no"), "")
    values = table.column(task.label).to_pylist()
    texts = np.array([_text(value, task) for value in values], dtype=str)
    return np.where(np.isin(texts, task.classes), texts, "") if task.classes else texts


def _text(value: Any, task: Task) -> str:
    if isinstance(value, float) and not np.isnan(value) and not value.is_integer():
        raise UserError(f"task {task.name}: column {task.label!r} holds {value:g}, a measured quantity and no class")
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    return str(int(value)) if isinstance(value, bool | float) else str(value)


def _number(table: Manifest, name: str) -> Array:
    """A column as f64 (rows,), NaN where it is empty or not there."""
    if name not in table.table.column_names:
        return np.full(len(table), np.nan)
    try:
        return table.column(name).cast(pa.float64()).to_numpy().astype(np.float64)
    except pa.ArrowException:
        raise UserError(f"column {name!r} holds text; this task needs numbers") from None


def _split(table: Manifest, task: Task) -> Array:
    split = text_column(table, "split")
    if task.listed is None:
        return split
    if "downstream_test" not in table.table.column_names:
        raise UserError(f"task {task.name} follows the authors' lists: index the data set again, for 'downstream_test'")
    listed = [task.listed in name.split("+") for name in text_column(table, "downstream_test")]
    return np.where(listed, "test", "train")  # whichever list decided the split of this manifest


def _which(table: Manifest, which: Which, rows: Array) -> Array:
    if which == "all":
        return rows
    rows = rows[_touching(table)[rows]]
    if which == "contact" or not len(rows):
        return rows
    sequence, frame = table.codes("sequence", own=True), np.asarray(table.column("frame_index"))
    if which == "press":
        force = _number(table, "label.force")[rows]
        known = np.isfinite(force)
        best = _best(rows[known], sequence[rows[known]], force[known], np.zeros(known.sum()))
        return np.sort(np.concatenate([rows[~known], best]))
    last = np.zeros(sequence.max() + 1)
    np.maximum.at(last, sequence, frame)
    late = -np.abs(frame - 2 / 3 * last[sequence])[rows]  # motion lasts from a third to five sixths of a recording
    slip = np.nan_to_num(_number(table, "label.slip")[rows], nan=0.0).round(2)
    return np.sort(_best(rows, sequence[rows], slip, late))


def _best(rows: Array, sequence: Array, first: Array, second: Array) -> Array:
    """Of each sequence the row of the largest `first`, then of the largest `second`, then the earliest."""
    order = np.lexsort((rows, -second, -first, sequence))
    return rows[order[np.unique(sequence[order], return_index=True)[1]]]


def _touching(table: Manifest) -> Array:
    """Whether a frame is contact, bool (rows,): by force, by mark (`anytouch contact`) or by score; all of a file
    without these.

    Force first: a mark or a score is of the picture, and would leave out soft objects, by sensors unequally.
    """
    force, score = (_number(table, f"label.{name}") for name in ("force", "contact_score"))
    mark = known_contact(table)
    touches = np.ones(len(table), bool)
    for source in range(len(table.files)):
        here = table.source == source
        for values, least in ((force, FORCE), (mark, 0.5), (score, SCORE)):
            if np.isfinite(values[here]).any():
                touches[here] = np.nan_to_num(values[here], nan=-1.0) > least
                break
    return touches


def _groups(table: Manifest, columns: Sequence[str]) -> Array:
    """The first column with a value names a row's group; the sequence where all are empty.

    Keys of joined manifests are their own: a recording of one file is not that of the same name in another.
    """
    sequence = text_column(table, "sequence")
    file = np.array([f" of file {one}" if len(table.files) > 1 else "" for one in table.source], dtype=str)
    found = np.char.add(np.char.add("sequence ", sequence), file)
    for name in reversed(columns):
        if name == "recording":
            recordings = np.array([f"recording {one.rpartition('/')[0] or one}" for one in sequence])
            found = np.char.add(recordings, file) if len(set(recordings)) > 1 else found
        elif name in table.table.column_names:
            values = text_column(table, name)
            own = np.char.add(values, file) if name in KEYS else values
            found = np.where(values != "", np.char.add(f"{name} ", own), found)
    return found


def _grasp(table: Manifest) -> str:
    """The column that two fingers of one grasp share."""
    return "grasp_group" if "grasp_group" in table.table.column_names else "touch"


def _paired(table: Manifest) -> bool:
    return bool(table.present(_grasp(table)).any() and table.present("unit").any())


def _fingers(table: Manifest, task: Task, rows: Array) -> tuple[Array, Array, tuple[str, ...]]:
    """Rows (n, 2) to read, of the two units of each grasp in the order of the units' names; the row of each that has
    the label; and what was left out."""
    name = _grasp(table)
    rows = rows[table.present(name)[rows] & table.present("unit")[rows]]
    grasp, unit = table.codes(name, own=True)[rows], text_column(table, "unit")[rows]
    order = np.lexsort((unit, grasp))
    rows, grasp, unit = rows[order], grasp[order], unit[order]
    starts, counts = np.unique(grasp, return_index=True, return_counts=True)[1:]
    whole = starts[counts == 2]
    whole = whole[unit[whole] != unit[whole + 1]]
    read = rows[whole[:, None] + np.arange(2)]
    notes = [f"{len(starts) - len(whole)} grasps without two fingers left out"] if len(starts) > len(whole) else []
    told = read[:, 0]
    if task.phase == "after":
        read = _after(table, read)
        there = (read >= 0).all(1)
        read, told = read[there], told[there]
        notes += [f"{np.sum(~there)} grasps without both frames after left out"] if not there.all() else []
    order = np.argsort(told)
    return read[order], told[order], tuple(notes)


def _after(table: Manifest, during: Array) -> Array:
    """The rows after the grasp of these rows during it: sequence <grasp>/after/<finger>; -1 where there is none."""
    sequence, source = text_column(table, "sequence"), table.source
    place = {(source[row], sequence[row]): row for row in range(len(table)) if "/after/" in sequence[row]}
    found = [place.get((source[row], sequence[row].replace("/during/", "/after/")), -1) for row in during.ravel()]
    return np.array(found, np.int64).reshape(during.shape)
