"""What can be wrong with a manifest, each check apart: (manifest, scan) -> findings."""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.config import FIELD_SENSORS, SENSORS, UNIVERSAL, SpellingError, check_spelling
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.manifest.schema import SPLITS
from anytouch_jax.data.prepare.licences import NO, commercial_use
from anytouch_jax.data.prepare.scan import OK, STATES, Scan

EXAMPLES = 5
_FRAME = ("dataset", "sensor", "unit", "sequence", "frame_index", "split")
LEARNING = ("train", "val", "test")  # the splits that must not share anything
Level = Literal["error", "warning", "info"]


class Finding(NamedTuple):
    """One kind of fault: `rows` i64 the row ids that it concerns, `examples` sentences about the first few."""

    kind: str
    level: Level
    sentence: str
    rows: np.ndarray
    examples: tuple[str, ...] = ()
    column: str | None = None


def bad_files(manifest: Manifest, found: Scan) -> Iterator[Finding]:
    """Files that are missing, outside of the folder, empty, cut short, or not to be read."""
    for column, code in found.files.code.items():
        states = found.states(column)
        for number, state in enumerate(STATES):
            rows = np.flatnonzero(states == number)
            if number == OK or not rows.size:
                continue
            examples = tuple(
                f"{manifest.where(row)}: {manifest.value(row, column)!r}: {found.reasons.get(int(code[row]), state)}"
                for row in rows[:EXAMPLES]
            )
            yield Finding(state, "error", f"{rows.size} rows whose {column} is {state}", rows, examples, column)


def wrong_sizes(manifest: Manifest, found: Scan) -> Iterator[Finding]:
    """Touch images of another size than most of their dataset, sensor and unit."""
    size = found.size[found.files.code["path"]].astype(np.int64)
    rows = np.flatnonzero(size[:, 0] > 0)
    if not rows.size:
        return
    keys = np.stack([manifest.codes(name)[rows] for name in ("dataset", "sensor", "unit")], 1)
    _, group = np.unique(keys, axis=0, return_inverse=True)
    _, kind = np.unique(size[rows], axis=0, return_inverse=True)
    pairs, counts = np.unique(np.stack([group.ravel(), kind.ravel()], 1), axis=0, return_counts=True)
    order = np.lexsort((-counts, pairs[:, 0]))
    main = np.full(pairs[:, 0].max() + 1, -1)
    main[pairs[order[::-1], 0]] = pairs[order[::-1], 1]  # the last one written is the most frequent
    odd = rows[main[group.ravel()] != kind.ravel()]
    if odd.size:
        usual = {g: size[rows[np.flatnonzero((group.ravel() == g) & (kind.ravel() == main[g]))[0]]] for g in
                 np.unique(group.ravel()[np.isin(rows, odd)])}  # fmt: skip
        of = dict(zip(rows.tolist(), group.ravel().tolist(), strict=True))
        examples = tuple(
            f"{manifest.where(row)}: {size[row][0]} x {size[row][1]}, "
            f"where most of its sensor are {usual[of[int(row)]][0]} x {usual[of[int(row)]][1]}"
            for row in odd[:EXAMPLES]
        )
        sentence = f"{odd.size} touch images of another size than most of their dataset, sensor and unit"
        yield Finding("wrong_size", "warning", sentence, odd, examples, "path")


def identity(found: Scan, column: str = "path") -> np.ndarray:
    """Equal numbers i64 (rows,) for equal bytes, -1 for null: by hash where there is one, else by path."""
    code = found.files.code[column]
    numbers = np.char.mod("file %d", np.arange(len(found.digest))).astype("S32")
    names = np.where(found.digest == b"", numbers, found.digest)
    _, same = np.unique(names, return_inverse=True)
    return np.where(code < 0, -1, same[code])


def repeated_rows(manifest: Manifest, same: np.ndarray) -> np.ndarray:
    """Rows i64 that repeat an earlier one: equal bytes of the touch image and equal values in every other column."""
    _, inverse, counts = np.unique(same, return_inverse=True, return_counts=True)
    rows = np.flatnonzero(counts[inverse] > 1)
    if not rows.size:
        return rows
    table = manifest.table.take(pa.array(rows))
    plain = [c for c in table.column_names if c != "path" and not pa.types.is_nested(table[c].type)]
    parts = [np.asarray(pc.fill_null(_codes(table[name]), -1)) for name in plain]
    key = np.stack([same[rows], manifest.source[rows], *parts], 1)
    _, first = np.unique(key, axis=0, return_index=True)
    repeats = np.ones(len(rows), bool)
    repeats[first] = False
    return rows[repeats]


def _codes(column: pa.ChunkedArray) -> pa.Array:
    plain = (
        column if pa.types.is_binary(column.type) or pa.types.is_large_binary(column.type) else column.cast(pa.string())
    )
    return plain.combine_chunks().dictionary_encode().indices


def duplicates(manifest: Manifest, found: Scan) -> Iterator[Finding]:
    """Touch images that are there more than once, and touch images that are also the row's photograph."""
    same = identity(found)
    rows = repeated_rows(manifest, same)
    if rows.size:
        yield Finding(
            "repeated_row", "warning", f"{rows.size} rows repeat an earlier row, touch image and all", rows,
            tuple(manifest.where(row) for row in rows[:EXAMPLES]),
        )  # fmt: skip
    yield from _leak(manifest, same, "leak_file", "error", "touch image", "path")
    kept = np.ones(len(same), bool)
    kept[rows] = False
    _, inverse, counts = np.unique(same, return_inverse=True, return_counts=True)
    kept &= counts[inverse] > 1
    many = np.bincount(inverse, weights=kept)[inverse] > 1
    rows = np.flatnonzero(kept & many)
    if rows.size:
        examples = tuple(f"{manifest.where(row)}: {manifest.value(row, 'path')!r}" for row in rows[:EXAMPLES])
        yield Finding("duplicate", "warning", f"{rows.size} rows share the bytes of their touch image", rows, examples)
    if "image_path" in found.files.code:
        picture = identity(found, "image_path")
        rows = np.flatnonzero((same == picture) & (picture >= 0))
        if rows.size:
            examples = tuple(f"{manifest.where(row)}: {manifest.value(row, 'path')!r}" for row in rows[:EXAMPLES])
            sentence = f"{rows.size} rows whose touch image and photograph are the same"
            yield Finding("touch_is_picture", "error", sentence, rows, examples, "image_path")


def _leak(manifest: Manifest, codes: np.ndarray, kind: str, level: Level, what: str, column: str) -> Iterator[Finding]:
    """Values (by their codes i64, -1 unknown) that stand in two of the learning splits; `column` shows them."""
    split = manifest.codes("split")
    names = [manifest.value(np.flatnonzero(split == code)[0], "split") for code in range(split.max() + 1)]
    rows = np.flatnonzero((codes >= 0) & np.isin(split, [i for i, name in enumerate(names) if name in LEARNING]))
    if not rows.size:
        return
    _, value = np.unique(codes[rows], return_inverse=True)
    pairs = np.unique(np.stack([value, split[rows]], 1), axis=0)
    sides = np.bincount(pairs[:, 0])
    bad = np.flatnonzero(sides > 1)
    if not bad.size:
        return
    rows = rows[sides[value] > 1]
    _, first = np.unique(codes[rows], return_index=True)
    examples = []
    for row in rows[np.sort(first)[:EXAMPLES]]:
        here = sorted({names[s] for s in split[rows[codes[rows] == codes[row]]]}, key=SPLITS.index)
        examples.append(f"{what} {manifest.value(row, column)!r} is in {', '.join(here)}")
    sentence = f"{bad.size} values of {what} are in more than one of {', '.join(LEARNING)} ({rows.size} rows)"
    yield Finding(kind, level, sentence, rows, tuple(examples))


def split_leaks(manifest: Manifest, *, objects: bool = False) -> Iterator[Finding]:
    """Sequences, touches, grasps and objects on both sides of a split; an object counts as a fault with `objects`."""
    for column in ("sequence", "touch", "grasp_group", "object"):
        if column not in manifest.table.column_names:
            continue
        level: Level = "info" if column == "object" and not objects else "error"
        codes = manifest.codes(column, own=column != "object")
        yield from _leak(manifest, codes, f"leak_{column}", level, column, column)


def frame_order(manifest: Manifest) -> Iterator[Finding]:
    """Sequences that hold a frame twice (no clips can be cut), or whose rows are not in the order of their frames."""
    sequence = manifest.codes("sequence", own=True) * len(SPLITS) + manifest.codes("split")
    frame = np.asarray(manifest.table["frame_index"])

    def example(row: int) -> str:
        return f"{manifest.where(row)}: frame {frame[row]} of sequence {manifest.value(row, 'sequence')!r}"

    order = np.lexsort((np.arange(len(frame)), frame, sequence))
    twice = (np.diff(sequence[order]) == 0) & (np.diff(frame[order]) == 0)
    rows = np.sort(order[1:][twice])
    if rows.size:
        sentence = f"{rows.size} rows repeat a frame of their sequence: no clips can be cut from it"
        yield Finding("repeated_frame", "error", sentence, rows, tuple(map(example, rows[:EXAMPLES])), "frame_index")
    order = np.argsort(sequence, kind="stable")
    back = (np.diff(sequence[order]) == 0) & (frame[order][1:] < frame[order][:-1])
    rows = np.sort(order[1:][back])
    if rows.size:
        sentence = f"{rows.size} rows stand after a later frame of their sequence"
        yield Finding("frame_order", "warning", sentence, rows, tuple(map(example, rows[:EXAMPLES])), "frame_index")


def misspelt_sensors(manifest: Manifest) -> Iterator[Finding]:
    """Names of sensors that are nearly known ones: a name of one's own is no fault, a slip of the pen is."""
    names = np.array(manifest.column("sensor").to_pylist(), str)
    known = (*(name for name in SENSORS if name != UNIVERSAL), *FIELD_SENSORS)
    for name in sorted(set(names.tolist()) - set(known)):
        rows = np.flatnonzero(names == name)
        try:
            check_spelling(name)
        except SpellingError as error:
            yield Finding("unknown_sensor", "error", f"{rows.size} rows are of {error}", rows, (), "sensor")
            continue
        if near := difflib.get_close_matches(name.lower(), known, 1, 0.8):
            sentence = f"{rows.size} rows are of sensor {name!r}, which is not known: did you mean {near[0]}?"
            yield Finding("unknown_sensor", "warning", sentence, rows, (), "sensor")


def licence_conflicts(manifest: Manifest) -> Iterator[Finding]:
    """Rows marked as commercial whose licence says that they are not."""
    marked = np.asarray(pc.fill_null(manifest.column("commercial"), False))
    rows = np.flatnonzero(marked & (commercial_use(manifest) == NO))
    if rows.size:
        examples = tuple(f"{manifest.where(row)}: {manifest.value(row, 'license')!r}" for row in rows[:EXAMPLES])
        sentence = f"{rows.size} rows are marked commercial although their licence is not"
        yield Finding("licence_conflict", "warning", sentence, rows, examples, "commercial")


def split_hash(manifest: Manifest) -> str:
    """SHA-256 of which frame is in which split.

    A frame is (dataset, sensor, unit, sequence, frame_index): neither the order of rows nor where files lie counts.
    """
    table = manifest.table
    nulls = pa.nulls(table.num_rows, pa.string())
    columns = [table[name].cast(pa.string()) if name in table.column_names else nulls for name in _FRAME]
    # A tag before the value keeps a null apart from an empty text.
    parts = [pc.fill_null(pc.binary_join_element_wise("=", column, ""), "-") for column in columns]
    digest = hashlib.sha256()
    for line in sorted(pc.binary_join_element_wise(*parts, "\x1f").to_pylist()):
        digest.update(line.encode() + b"\n")
    return digest.hexdigest()
