"""The table of touch frames: read, join, write, and look up rows, clips and files.

One row is one tactile frame (the schema is in `table.py`). Row numbers count from 0. The keys of a manifest
(`sequence`, `touch`) are its own: two joined manifests never share a sequence or a touch by accident.
"""

from __future__ import annotations

import csv
import difflib
import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from anytouch_jax.config import FIELD_SENSORS, SENSORS, UNIVERSAL, ModelConfig, SpellingError, check_spelling
from anytouch_jax.data.manifest.clips import clip_windows
from anytouch_jax.data.manifest.schema import (
    PATHS,
    SCHEMA,
    SPLITS,
    ManifestError,
    load_table,
    typed,
)
from anytouch_jax.errors import ConfigError, UserError
from anytouch_jax.files import atomic_path

KEYS = ("sequence", "touch", "grasp_group")  # what two manifests may call alike and is not the same


@dataclass(frozen=True, eq=False)
class Manifest:
    """A checked table of touch frames, from one file or several joined ones.

    `table` typed columns; `files` the absolute manifest files; `source` i32 (rows,) which file a row is from;
    `number` i64 (rows,) its row number in that file.
    """

    table: pa.Table
    files: tuple[Path, ...]
    source: np.ndarray
    number: np.ndarray

    def __len__(self) -> int:
        return int(self.table.num_rows)

    def where(self, row: int) -> str:
        """ "row 3 of /data/manifest.csv", for errors."""
        return f"row {self.number[row]} of {self.files[self.source[row]]}"

    def column(self, name: str) -> pa.ChunkedArray:
        """The column `name`; all null where an optional one is absent. Raises ManifestError for any other name."""
        if name in self.table.column_names:
            return self.table[name]
        if name in SCHEMA:
            fill = pa.scalar(1 if name == "stride" else None, SCHEMA[name])
            return pa.chunked_array([pa.repeat(fill, len(self))])
        raise ManifestError(f"{self._name} has no column {name!r}; it has {', '.join(self.table.column_names)}")

    def value(self, row: int, name: str) -> Any:
        """One cell as a Python value, None where it is null or the column is absent."""
        column = self._cells.get(name)
        return None if column is None else column[int(row)].as_py()

    def present(self, name: str) -> np.ndarray:
        """Which rows have a value in column `name`: bool (rows,)."""
        return np.asarray(pc.is_valid(self.column(name)))

    def codes(self, name: str, *, own: bool = False) -> np.ndarray:
        """A text column as i64 (rows,): equal numbers for equal values, -1 for null.

        `own`: values of different files are different (see the module's docstring).
        """
        indices = self.column(name).combine_chunks().dictionary_encode().indices
        codes = np.asarray(pc.fill_null(indices, -1)).astype(np.int64)
        if own and len(self.files) > 1:
            codes = np.where(codes < 0, -1, codes * len(self.files) + self.source)
        return codes

    def file(self, row: int, name: str = "path") -> Path:
        """The absolute file in a path column. Raises ManifestError when the path leaves the manifest's folder."""
        return resolve_path(self._roots[self.source[row]], self.value(row, name))

    def rows_of(self, split: str) -> np.ndarray:
        """Row ids i64 of one split, in order. Raises ManifestError when it is unknown or empty."""
        if split not in SPLITS:
            raise ManifestError(f"unknown split {split!r}; use one of {', '.join(SPLITS)}")
        rows = np.flatnonzero(np.asarray(pc.equal(self.table["split"], split)))
        if not rows.size:
            there = ", ".join(sorted(pc.unique(self.table["split"]).to_pylist()))
            raise ManifestError(f"{self._name}: column 'split' has no row {split!r}; it has {there}")
        return rows

    def clips(self, length: int, split: str | None = None) -> np.ndarray:
        """All clips of `length` frames: row ids i64 (clips, length), oldest first, ordered by their last row.

        A clip is rows of one sequence and one split whose frame_index lie exactly `stride` (of the last row)
        apart. `split` keeps only clips of that split. Raises ManifestError when a sequence repeats a frame.
        """
        wanted = None
        if split is not None:
            wanted = np.zeros(len(self), bool)
            wanted[self.rows_of(split)] = True
        try:
            return clip_windows(self._sequence, self._frame, self._stride, length, self._say_repeat, wanted)
        except OverflowError as error:
            raise ManifestError(f"{self._name}: {error}") from None

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 over every column's name and values: equal tables in CSV and Parquet have equal hashes."""
        digest = hashlib.sha256()
        for name in sorted(self.table.column_names):
            column = self.table[name].combine_chunks()
            try:
                text = pc.fill_null(column.cast(pa.large_string()), "")
            except pa.ArrowException:  # nested or binary: as Python writes it
                text = pa.array([repr(value) for value in column.to_pylist()], pa.large_string())
            ends = np.frombuffer(text.buffers()[1], np.int64)[text.offset : text.offset + len(text) + 1]
            digest.update(name.encode() + b"\0")
            digest.update(np.packbits(np.asarray(pc.is_valid(column))).tobytes())
            digest.update((ends - ends[0]).astype("<i8").tobytes())
            digest.update(memoryview(text.buffers()[2] or b"")[ends[0] : ends[-1]])
        return digest.hexdigest()

    @cached_property
    def _cells(self) -> dict[str, Any]:
        # A table makes a list of its names and a new column object at each look-up.
        columns = {name: self.table[name] for name in self.table.column_names}
        return {name: one.chunk(0) if one.num_chunks == 1 else one for name, one in columns.items()}

    @cached_property
    def _roots(self) -> tuple[str, ...]:
        return tuple(str(file.parent) for file in self.files)

    @property
    def _name(self) -> str:
        return ", ".join(map(str, self.files))

    @property
    def _sequence(self) -> np.ndarray:  # not kept: 20 MB of a large manifest, for a fraction of a second
        codes = self.codes("sequence", own=True)
        codes *= len(SPLITS)
        codes += self.codes("split")
        return codes

    @cached_property
    def _frame(self) -> np.ndarray:
        return np.asarray(self.table["frame_index"])

    @cached_property
    def _stride(self) -> np.ndarray:
        if "stride" not in self.table.column_names:
            return np.broadcast_to(np.int64(1), len(self))
        return np.asarray(self.table["stride"])

    def _say_repeat(self, first: int, second: int) -> ManifestError:
        sequence, frame = self.value(second, "sequence"), self.value(second, "frame_index")
        return ManifestError(
            f"{self.where(second)} repeats frame_index {frame} of sequence {sequence!r} (row {self.number[first]}); "
            "a sequence has one row a frame"
        )


def read(paths: str | Path | Sequence[str | Path]) -> Manifest:
    """Read one manifest (.csv or .parquet), or several joined in the order given.

    Every row keeps its own file, and its paths are relative to the folder of that file. Raises ManifestError.
    """
    several = [paths] if isinstance(paths, str | Path) else list(paths)
    if not several:
        raise ManifestError("no manifest is given; name a .csv or .parquet file")
    files = tuple(_real(Path(path).expanduser()) for path in several)
    if len(set(files)) != len(files):
        raise ManifestError(f"a manifest is given twice: {', '.join(map(str, files))}")
    return _join([load_table(file) for file in files], files)


def _real(path: Path) -> Path:
    """The file of a name. Raises ManifestError for a link as the Hub's cache has them, to a name without an ending."""
    file = path.resolve()
    if path.is_symlink() and path.suffix and not file.suffix:
        raise ManifestError(
            f"{path} is a link into a cache, as its pictures may be; download the data into a folder of their own "
            "(hf download --local-dir)"
        )
    return file


def from_columns(columns: Mapping[str, Any], path: str | Path) -> Manifest:
    """A manifest from columns in memory, as if read from the file `path`, which need not exist yet.

    `columns` maps names to sequences of equal length (None is null). Raises ManifestError as `read` does.
    """
    file = Path(path).expanduser().resolve()
    try:
        table = pa.table({name: pa.array(values) for name, values in columns.items()})
    except (pa.ArrowException, ValueError, OverflowError) as error:
        raise ManifestError(f"{file}: the columns make no table: {error}") from None
    return _join([typed(table, str(file))], (file,))


def _join(tables: list[pa.Table], files: tuple[Path, ...]) -> Manifest:
    clash = {name for name, kinds in _kinds(tables).items() if len(kinds) > 1}
    try:
        # A label that is a number in one manifest and text in another becomes text in all of them.
        same = [
            pa.table({n: t[n].cast(pa.string()) if n in clash else t[n] for n in t.column_names}) if clash else t
            for t in tables
        ]
        table = pa.concat_tables(same, promote_options="permissive")
    except pa.ArrowException as error:
        raise ManifestError(f"{', '.join(map(str, files))} cannot be joined: {error}") from None
    if "stride" in table.column_names:
        table = table.set_column(table.column_names.index("stride"), "stride", pc.fill_null(table["stride"], 1))
    sizes = [t.num_rows for t in tables]
    source = np.repeat(np.arange(len(files), dtype=np.int32), sizes)
    number = np.concatenate([np.arange(size, dtype=np.int64) for size in sizes])
    return Manifest(table.combine_chunks(), files, source, number)


def _kinds(tables: list[pa.Table]) -> dict[str, set[bool]]:
    """For every column, whether it is text, in all the tables that have it with a value."""
    kinds: dict[str, set[bool]] = {}
    for table in tables:
        for column in table.schema:
            if not pa.types.is_null(column.type):
                text = pa.types.is_string(column.type) or pa.types.is_large_string(column.type)
                kinds.setdefault(column.name, set()).add(text)
    return kinds


def write(manifest: Manifest, path: str | Path) -> None:
    """Write a manifest as .csv or .parquet, whole or not at all; its paths are made relative to the new folder.

    Keys that two joined manifests share become different ones. Raises ManifestError for another ending, for a file that
    would lie outside the new folder and for a column that the format cannot hold.
    """
    target, table = _placed(manifest, path)
    table = with_distinct_keys(manifest, table)
    try:
        with atomic_path(target) as part, part.open("wb") as file:
            if target.suffix.lower() == ".csv":
                pa.csv.write_csv(table, file, pa.csv.WriteOptions(quoting_style="needed"))
            else:
                pa.parquet.write_table(table, file)
    except pa.ArrowException as error:
        raise ManifestError(f"{target} cannot be written: {str(error).splitlines()[0]}") from None


def check_target(manifest: Manifest, path: str | Path) -> None:
    """Raise the ManifestError of `write` before hours of work: a wrong ending, or files outside the new folder."""
    _placed(manifest, path)


def _placed(manifest: Manifest, path: str | Path) -> tuple[Path, pa.Table]:
    """The absolute path of a manifest to be written, and its table with paths relative to the folder."""
    target = Path(path).expanduser().resolve()
    if target.suffix.lower() not in (".csv", ".parquet"):
        raise ManifestError(f"{target}: a manifest ends in .csv or .parquet")
    return target, _rebase(manifest, target.parent)


def distinct_keys(manifest: Manifest, name: str) -> pa.ChunkedArray:
    """The column `name` with values that two of the manifest's files share made different, for writing as one file.

    The keys of a manifest are its own (see manifest.py); in one file equal keys would be one.
    """
    if name not in manifest.table.column_names:
        raise ManifestError(f"there is no column {name!r}")
    column = manifest.table[name]
    codes = manifest.codes(name)
    known = codes >= 0
    pairs = np.unique(np.stack([codes[known], manifest.source[known].astype(np.int64)], 1), axis=0)
    if len(pairs) == len(np.unique(pairs[:, 0])):
        return column
    prefix = pa.array([f"{number}/" for number in range(len(manifest.files))]).take(pa.array(manifest.source))
    return pa.chunked_array([pc.binary_join_element_wise(prefix, column.combine_chunks().cast(pa.string()), "")])


def with_distinct_keys(manifest: Manifest, table: pa.Table) -> pa.Table:
    """`table` with keys of different files made different: in one file equal keys would be one."""
    for name in KEYS if len(manifest.files) > 1 else ():
        if name in table.column_names:
            table = table.set_column(table.column_names.index(name), name, distinct_keys(manifest, name))
    return table


def _rebase(manifest: Manifest, folder: Path) -> pa.Table:
    table = manifest.table
    if all(file.parent == folder for file in manifest.files):
        return table
    for name in set(PATHS) & set(table.column_names):
        cells = [None if cell is None else _relative(manifest, row, cell, folder)
                 for row, cell in enumerate(table[name].to_pylist())]  # fmt: skip
        table = table.set_column(table.column_names.index(name), name, pa.array(cells, pa.string()))
    return table


def _relative(manifest: Manifest, row: int, cell: str, folder: Path) -> str:
    file = os.path.normpath(manifest.files[manifest.source[row]].parent / cell)
    if not Path(file).is_relative_to(folder):
        raise ManifestError(
            f"{manifest.where(row)}: {file} is not inside {folder}, where the manifest is to be written"
        )
    return Path(file).relative_to(folder).as_posix()


def sensor_rows(
    manifest: Manifest,
    model: ModelConfig,
    rows: np.ndarray | None = None,
    *,
    unknown: Literal["error", "skip", "universal"] = "error",
) -> tuple[np.ndarray, list[str]]:
    """The sensor-table row of every manifest row, i32 (rows,), -1 for rows to leave out; and notes to say aloud.

    Only `rows` (default: all) are looked at; the others are -1. Force-field sensors have no images and are left out.
    A sensor that `model.sensors` lacks is an error that names its first row, is left out (`skip`), or is served by
    the universal tokens (`universal`). Raises ManifestError.
    """
    ids = np.full(len(manifest), -1, np.int32)
    codes = manifest.codes("sensor")
    if rows is not None:
        inside = np.zeros(len(manifest), bool)
        inside[rows] = True
        codes = np.where(inside, codes, -1)
    notes = []
    for code in np.flatnonzero(np.bincount(codes[codes >= 0])):
        here = np.flatnonzero(codes == code)
        name = manifest.value(here[0], "sensor")
        try:
            ids[here] = model.sensor_row(name)
        except ConfigError as error:
            if name in FIELD_SENSORS:
                notes.append(f"left out {len(here)} rows of {name}: it measures a force field and has no images")
            elif unknown == "error" or isinstance(error, SpellingError):
                raise ManifestError(f"{manifest.where(here[0])}, column 'sensor': {error}") from None
            elif unknown == "skip":
                notes.append(f"left out {len(here)} rows of the unknown sensor {name!r}")
            else:
                ids[here] = model.universal_row
                notes.append(f"sensor {name!r} is unknown: its {len(here)} rows use the universal sensor tokens")
    return ids, notes


def select_rows(manifest: Manifest, rows: np.ndarray) -> Manifest:
    """The manifest of `rows` (ids i64) in the order given; errors still name the rows of the files they come from."""
    rows = np.asarray(rows, np.int64)
    return Manifest(manifest.table.take(pa.array(rows)), manifest.files, manifest.source[rows], manifest.number[rows])


def replace_column(manifest: Manifest, name: str, values: Any) -> Manifest:
    """The manifest with column `name` set to `values` (rows,), added at the end where it was absent."""
    column = pa.array(values, SCHEMA.get(name)) if not isinstance(values, pa.Array | pa.ChunkedArray) else values
    table, names = manifest.table, manifest.table.column_names
    table = table.set_column(names.index(name), name, column) if name in names else table.append_column(name, column)
    return Manifest(table, manifest.files, manifest.source, manifest.number)


def attach_text(
    manifest: Manifest, captions: str | Path, *, key: str | None = None, text: str = "text", overwrite: bool = False
) -> tuple[Manifest, list[str]]:
    """Captions from a table (.csv or .parquet) with a key column and the column `text`; and notes to say aloud.

    `key` is a column of both (default: the one column of the table beside `text`), for instance `sequence`, `touch`,
    `object` or `path`. Rows that have a caption keep it unless `overwrite`. Raises UserError for a table that lacks a
    column, has a key twice with different captions, or matches no row.
    """
    path = Path(captions).expanduser()
    table = _read_captions(path)
    if text not in table.column_names:
        raise UserError(f"{path} has no column {text!r}; it has {', '.join(table.column_names)}")
    others = [name for name in table.column_names if name != text]
    if key is None and len(others) != 1:
        raise UserError(f"{path} has the columns {', '.join(table.column_names)}: say which one is the key")
    key = key or others[0]
    if key not in others:
        raise UserError(f"{path} has no column {key!r}; it has {', '.join(table.column_names)}")
    found = _captions(table, key, text, path)
    try:
        keys = manifest.column(key).cast(pa.string())
    except pa.ArrowException:
        raise UserError(f"column {key!r} of the manifest is no key: it is {manifest.column(key).type}") from None
    at = pc.index_in(keys, value_set=pa.array(list(found), pa.string()))
    new = pa.chunked_array([pa.array(list(found.values()), pa.string())]).take(at.combine_chunks())
    matched = pc.sum(pc.is_valid(new)).as_py()
    if not matched:
        first = next(iter(found), None)
        raise UserError(f"{path}: no key {key!r} of it is in the manifest; its first one is {first!r}")
    old = manifest.column("text")
    merged = pc.coalesce(new, old) if overwrite else pc.coalesce(old, new)
    kept = 0 if overwrite else pc.sum(pc.and_(pc.is_valid(new), pc.is_valid(old))).as_py()
    unused = len(found) - len(pc.unique(at.drop_null()))
    notes = [f"{matched - kept} rows got a caption by {key!r}"]
    notes += [f"{kept} rows kept the caption they had"] if kept else []
    notes += [f"{unused} of {len(found)} keys of {path.name} are not in the manifest"] if unused else []
    return replace_column(manifest, "text", merged), notes


def _read_captions(path: Path) -> pa.Table:
    kind = path.suffix.lower()
    if kind not in (".csv", ".parquet"):
        raise UserError(f"{path}: a table of captions ends in .csv or .parquet")
    if not path.is_file():
        raise UserError(f"there is no table {path}")
    try:
        if kind == ".parquet":
            return pa.parquet.read_table(path, partitioning=None)
        with path.open(encoding="utf-8-sig", newline="") as file:
            names = next(csv.reader(file), [])
        convert = pa.csv.ConvertOptions(
            column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=True, null_values=[""]
        )
        options = pa.csv.ParseOptions(newlines_in_values=True)
        return pa.csv.read_csv(path, convert_options=convert, parse_options=options)
    except (pa.ArrowException, UnicodeDecodeError, csv.Error, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path} cannot be read as a {kind[1:]} table: {reason}") from None


def _captions(table: pa.Table, key: str, text: str, path: Path) -> dict[str, str]:
    twice = [name for name in (key, text) if table.column_names.count(name) > 1]
    if twice:
        raise UserError(f"{path} has the column {twice[0]!r} twice")
    try:
        keys, texts = table[key].cast(pa.string()).to_pylist(), table[text].cast(pa.string()).to_pylist()
    except pa.ArrowException:
        kinds = f"{table[key].type} and {table[text].type}"
        raise UserError(f"{path}: {key!r} and {text!r} must be plain columns, are {kinds}") from None
    found: dict[str, str] = {}
    for row, (name, caption) in enumerate(zip(keys, texts, strict=True)):
        if name is None or caption is None or not caption.strip():
            continue
        caption = " ".join(caption.split())
        if found.setdefault(name, caption) != caption:
            raise UserError(f"{path}, row {row}: {key} {name!r} has another caption in an earlier row")
    return found


def resolve_path(root: str | Path, relative: str | None) -> Path:
    """The file `relative` inside the folder `root` (absolute, resolved).

    Raises ManifestError when the path is empty, absolute, or leaves the folder by "..", or by a symbolic link.
    """
    if not relative:
        raise ManifestError("the path is empty")
    if "\0" in relative:
        raise ManifestError(f"the path {relative!r} is not a file name")
    root = str(root)
    head, _, name = relative.rpartition("/")
    # A folder is looked at once and each file for itself: that is most of the time that a path takes.
    path = f"{_real_folder(root, head)}/{name}"
    if name in ("", ".", "..") or os.path.islink(path):
        path = os.path.realpath(path)
    if relative[0] == "/":
        raise ManifestError(f"the path {relative!r} is absolute; write it relative to the manifest's folder, {root}")
    if not path.startswith(root if root[-1] == "/" else f"{root}/"):
        link = "" if ".." in relative.split("/") else ", by a link; put the files there, or the manifest beside them"
        raise ManifestError(f"the path {relative!r} leaves the folder of the manifest, {root}{link}")
    return Path(path)


@lru_cache(4096)
def _real_folder(root: str, head: str) -> str:
    folder = os.path.realpath(os.path.join(root, head))
    return "" if folder == "/" else folder


def misspelt_sensors(manifest: Manifest) -> Iterator[tuple[Literal["error", "warning"], str, np.ndarray]]:
    """Yield (level, sentence, row ids i64) for sensor names that are nearly known names. New names are no fault."""
    names = np.array(manifest.column("sensor").to_pylist(), str)
    known = (*(name for name in SENSORS if name != UNIVERSAL), *FIELD_SENSORS)
    for name in sorted(set(names.tolist()) - set(known)):
        rows = np.flatnonzero(names == name)
        try:
            check_spelling(name)
        except SpellingError as error:
            yield "error", f"{rows.size} rows are of {error}", rows
            continue
        if near := difflib.get_close_matches(name.lower(), known, 1, 0.8):
            sentence = f"{rows.size} rows are of sensor {name!r}, which is not known: did you mean {near[0]}?"
            yield "warning", sentence, rows
