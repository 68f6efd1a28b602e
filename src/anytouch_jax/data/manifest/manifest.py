"""Manifests: tables of tactile frames, to read, join, edit and write, and to look up rows in.

One row is one tactile frame (the columns are in `schema.py`), and row numbers count from 0. The
keys `sequence` and `touch` belong to their file: two joined manifests never share a sequence or a
touch by accident.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from anytouch_jax.config import FIELD_SENSORS, ModelConfig, SpellingError, check_spelling
from anytouch_jax.data.manifest import schema
from anytouch_jax.data.manifest.content import (
    Summary,
    clip_windows,
    content_digest,
    summarise,
    table_blocks,
)
from anytouch_jax.data.manifest.files import is_remote, local_copy
from anytouch_jax.data.manifest.schema import PATHS, SCHEMA, SPLITS, ManifestError, listed, shown
from anytouch_jax.errors import ConfigError
from anytouch_jax.files import atomic_path
from anytouch_jax.shown import described

_LONGEST_PATH = 4000  # bytes, on Linux
KEYS = ("sequence", "touch", "grasp_group")  # columns whose values belong to their file


@dataclass(frozen=True, eq=False)
class Manifest:
    """A checked table of touch frames, from one file or several joined files.

    Attributes:
        table: With typed columns.
        files: The absolute manifest files.
        source: i32 (rows,), the file of each row.
        number: i64 (rows,), its row number there.
    """

    table: pa.Table
    files: tuple[Path, ...]
    source: np.ndarray
    number: np.ndarray

    def __len__(self) -> int:
        return int(self.table.num_rows)

    def __repr__(self) -> str:
        counts = {}
        for name in ("split", "sensor"):
            entries = pc.value_counts(self.column(name)).to_pylist()
            most = sorted(entries, key=lambda entry: -entry["counts"])
            words = [f"{entry['values']} {entry['counts']:,}" for entry in most]
            counts[f"{name}s"] = listed(words)
        recordings = len(np.unique(self.codes("sequence", own=True)))
        return described(
            f"Manifest {self._name}",
            rows=f"{len(self):,} in {recordings:,} recordings",
            **counts,
            columns=listed(self.table.column_names),
        )

    def where(self, row: int) -> str:
        """Return "line 5 of /data/m.csv", or "row 3 of /data/m.parquet", for errors."""
        return schema.place_of(self.files[self.source[row]], int(self.number[row]))

    def column(self, name: str) -> pa.ChunkedArray:
        """Return the column `name`, all null for an optional one that is absent.

        Raises ManifestError for others.
        """
        if name in self.table.column_names:
            return self.table[name]
        if name in SCHEMA:
            fill = pa.scalar(1 if name == "stride" else None, SCHEMA[name])
            return pa.chunked_array([pa.repeat(fill, len(self))])
        raise ManifestError(
            f"{self._name} has no column {name!r}; it has {listed(self.table.column_names)}"
        )

    def value(self, row: int, name: str) -> Any:
        """Return one cell as a Python value, None if it is null or the column is absent."""
        column = self._cells.get(name)
        if column is None:
            return None
        return column[int(row)].as_py()

    def present(self, name: str) -> np.ndarray:
        """Return which rows have a value in column `name`, bool (rows,)."""
        return np.asarray(pc.is_valid(self.column(name)))

    def text_column(self, name: str) -> np.ndarray:
        """Return a column as strings (rows,), "" for null."""
        cells = self.column(name).to_pylist()
        return np.array(["" if cell is None else str(cell) for cell in cells])

    def number_column(self, name: str) -> np.ndarray:
        """Return a column as f64 (rows,), NaN where it is empty or missing.

        Raises ManifestError for text.
        """
        if name not in self.table.column_names:
            return np.full(len(self), np.nan)
        try:
            return np.asarray(pc.fill_null(self.table[name].cast(pa.float64()), np.nan))
        except pa.ArrowException:
            raise ManifestError(f"Column {name!r} contains text. It must have numbers.") from None

    def codes(self, name: str, *, own: bool = False) -> np.ndarray:
        """Return a text column as codes i64 (rows,), -1 for null.

        With `own`, equal values of two files are different (see KEYS).
        """
        indices = self.column(name).combine_chunks().dictionary_encode().indices
        codes = np.asarray(pc.fill_null(indices, -1)).astype(np.int64)
        if own and len(self.files) > 1:
            codes = np.where(codes < 0, -1, codes * len(self.files) + self.source)
        return codes

    def groups(self, *names: str) -> list[np.ndarray]:
        """Return the row ids i64 of each combination of values in text columns, in row order."""
        return group_rows(np.arange(len(self)), np.stack([self.codes(name) for name in names], 1))

    def file(self, row: int, name: str = "path") -> Path:
        """Return the absolute file in a path column.

        Raises ManifestError if it is outside the manifest's folder.
        """
        return resolve_path(self._roots[self.source[row]], self.value(row, name))

    def rows_of(self, split: str) -> np.ndarray:
        """Return the row ids i64 of one split, in order.

        Raises ManifestError if it is unknown or empty.
        """
        if split not in SPLITS:
            raise ManifestError(f"unknown split {split!r}; use one of {', '.join(SPLITS)}")
        rows = np.flatnonzero(np.asarray(pc.equal(self.table["split"], split)))
        if not rows.size:
            splits = ", ".join(sorted(pc.unique(self.table["split"]).to_pylist()))
            raise ManifestError(
                f"{self._name}: column 'split' has no row {split!r}; it has {splits}"
            )
        return rows

    def clips(self, length: int, split: str | None = None) -> np.ndarray:
        """Return all clips of a number of frames.

        A clip is rows of one sequence and one split whose frame_index values are exactly `stride`
        (of the last row) apart.

        Args:
            length: Frames of a clip.
            split: Selects the clips of that split.

        Returns:
            Row ids i64 (clips, length), oldest frame first, ordered by the last row of a clip.

        Raises:
            ManifestError: If a sequence repeats a frame.
        """
        table = self.table
        ends = None
        if split is not None:
            ends = np.zeros(len(self), bool)
            ends[self.rows_of(split)] = True
        # One code for sequence and split, so that no clip crosses splits: a frame of the test split
        # must not be seen in training.
        sequence = self.codes("sequence", own=True)
        sequence *= len(SPLITS)
        sequence += self.codes("split")
        if "stride" in table.column_names:
            stride = np.asarray(table["stride"])
        else:
            stride = np.broadcast_to(np.int64(1), len(self))

        def repeats(first: int, second: int) -> ManifestError:
            frame = self.value(second, "frame_index")
            name = self.value(second, "sequence")
            return _repeats(self.where(first), self.where(second), frame, name)

        try:
            return clip_windows(
                sequence, np.asarray(table["frame_index"]), stride, length, repeats, ends
            )
        except OverflowError as error:
            raise ManifestError(f"{self._name}: {error}") from None

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 over every column's name and values.

        Equal tables in CSV and Parquet have equal hashes.
        """
        return content_digest(self.table.column_names, table_blocks(self.table))

    @cached_property
    def _cells(self) -> dict[str, Any]:
        # A table makes a list of its names and a new column object at each look-up, which takes
        # longer than the look-up. So does a column of chunks.
        cells = {}
        for name in self.table.column_names:
            column = self.table[name]
            cells[name] = column.chunk(0) if column.num_chunks == 1 else column
        return cells

    @cached_property
    def _roots(self) -> tuple[str, ...]:
        return tuple(str(file.parent) for file in self.files)

    @property
    def _name(self) -> str:
        return ", ".join(map(str, self.files))


def _repeats(first: str, second: str, frame: int, sequence: str) -> ManifestError:
    return ManifestError(
        f"{second} repeats frame_index {frame} of sequence {sequence!r}, as in {first}; a sequence "
        "has one row a frame"
    )


def read(paths: str | Path | Sequence[str | Path]) -> Manifest:
    """Read one manifest (.csv or .parquet), or several joined in order; rows keep their files.

    Raises ManifestError.
    """
    several = [paths] if isinstance(paths, str | Path) else list(paths)
    if not several:
        raise ManifestError("no manifest is given; name a .csv or .parquet file")
    files = tuple(_real_file(Path(path).expanduser()) for path in several)
    if len(set(files)) != len(files):
        raise ManifestError(f"a manifest is given twice: {', '.join(map(str, files))}")
    return _join([schema.load_table(file) for file in files], files)


def summarise_file(path: str | Path, length: int = 3) -> Summary:
    """Return the numbers of a manifest, with its clips; Parquet is read in blocks.

    Raises ManifestError as `read`.
    """
    file = _real_file(Path(path).expanduser())
    if file.is_file() and file.suffix.lower() == ".parquet":
        names, blocks = schema.parquet_blocks(file)
    else:
        table = read(path).table
        names = table.column_names
        blocks = table_blocks(table)

    def repeats(first: int, second: int, frame: int, sequence: str) -> ManifestError:
        places = schema.place_of(file, first), schema.place_of(file, second)
        return _repeats(*places, frame, sequence)

    try:
        return summarise(names, blocks, length, repeats)
    except OverflowError as error:
        raise ManifestError(f"{file}: {error}") from None


def _real_file(path: Path) -> Path:
    """Return the resolved path.

    Raises ManifestError for a link into the Hub's cache, to a name without an ending.
    """
    file = path.resolve()
    if path.is_symlink() and path.suffix and not file.suffix:
        raise ManifestError(
            f"{path} is a link into a cache, as its images may be; download the data into a "
            "separate folder (hf download --local-dir)"
        )
    return file


def from_columns(columns: Mapping[str, Any], path: str | Path) -> Manifest:
    """Return a manifest from columns of equal length, as if read from `path`.

    Raises ManifestError as `read` does.
    """
    file = Path(path).expanduser().resolve()
    try:
        table = pa.table({name: pa.array(values) for name, values in columns.items()})
    except UnicodeEncodeError as error:
        raise ManifestError(
            f"{file}: the name {error.object!r} is not UTF-8, and a manifest holds no other text; "
            "rename this file or folder"
        ) from None
    except (pa.ArrowException, ValueError, OverflowError) as error:
        raise ManifestError(f"{file}: the columns make no table: {error}") from None
    return _join([schema.typed(table, file)], (file,))


def _join(tables: list[pa.Table], files: tuple[Path, ...]) -> Manifest:
    """Return the manifest of tables, one below the other."""
    try:
        # A label that is a number in one manifest and text in another becomes text in all of them.
        mixed = _mixed_columns(tables)
        tables = [_as_text(table, mixed) for table in tables]
        table = pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException as error:
        raise ManifestError(f"{', '.join(map(str, files))} cannot be joined: {error}") from None
    if "stride" in table.column_names:
        table = _with_column(table, "stride", pc.fill_null(table["stride"], 1))
    sizes = [t.num_rows for t in tables]
    source = np.repeat(np.arange(len(files), dtype=np.int32), sizes)
    number = np.concatenate([np.arange(size, dtype=np.int64) for size in sizes])
    return Manifest(table.combine_chunks(), files, source, number)


def _mixed_columns(tables: list[pa.Table]) -> list[str]:
    """Return the columns that are text in some tables and something else in others."""
    is_text: dict[str, set[bool]] = {}
    for table in tables:
        for field in table.schema:
            if not pa.types.is_null(field.type):  # an empty column is neither
                is_text.setdefault(field.name, set()).add(schema.is_text(field.type))
    return [name for name, answers in is_text.items() if len(answers) > 1]


def _as_text(table: pa.Table, names: Sequence[str]) -> pa.Table:
    for name in names:
        if name in table.column_names:
            table = _with_column(table, name, table[name].cast(pa.string()))
    return table


def _with_column(table: pa.Table, name: str, column: Any) -> pa.Table:
    if name in table.column_names:
        return table.set_column(table.column_names.index(name), name, column)
    return table.append_column(name, column)


def write(manifest: Manifest, path: str | Path) -> None:
    """Write a manifest as .csv or .parquet, atomically.

    Its paths become relative to the new folder, and keys that two joined manifests share become
    different.

    Raises:
        ManifestError: For another ending, for a file outside the new folder, and for a column that
            the format cannot hold.
    """
    target, table = placed(manifest, path)
    table = with_distinct_keys(manifest, table)
    try:
        with atomic_path(target) as part, part.open("wb") as file:
            if target.suffix.lower() == ".csv":
                pa.csv.write_csv(table, file, pa.csv.WriteOptions(quoting_style="needed"))
            else:
                pa.parquet.write_table(table, file)
    except pa.ArrowException as error:
        raise ManifestError(f"{target} cannot be written: {str(error).splitlines()[0]}") from None


def placed(manifest: Manifest, path: str | Path) -> tuple[Path, pa.Table]:
    """Return the path of a manifest to be written, and its table for that folder.

    Raises ManifestError.
    """
    target = Path(path).expanduser().resolve()
    table = manifest.table
    schema.table_suffix(target)
    folder = target.parent

    def relative(row: int, cell: str) -> str:
        if is_remote(cell):
            return cell
        file = os.path.normpath(manifest.files[manifest.source[row]].parent / cell)
        if not Path(file).is_relative_to(folder):
            raise ManifestError(
                f"{manifest.where(row)}: {file} is not inside {folder}, where the manifest is to "
                "be written; write it above its files"
            )
        return Path(file).relative_to(folder).as_posix()

    if any(file.parent != folder for file in manifest.files):
        for name in set(PATHS) & set(table.column_names):
            cells = table[name].to_pylist()
            for row, cell in enumerate(cells):
                if cell:
                    cells[row] = relative(row, cell)
            table = _with_column(table, name, pa.array(cells, pa.string()))
    return target, table


def with_distinct_keys(manifest: Manifest, table: pa.Table) -> pa.Table:
    """Return `table` with a prefix on keys that two files share.

    In one file equal keys would be one.
    """
    if len(manifest.files) == 1:
        return table
    for name in KEYS:
        if name not in table.column_names:
            continue
        codes = manifest.codes(name)
        known = codes >= 0
        source = manifest.source[known].astype(np.int64)
        pairs = np.unique(np.stack([codes[known], source], 1), axis=0)
        has_shared = len(pairs) > len(np.unique(pairs[:, 0]))
        if has_shared:
            prefixes = pa.array([f"{number}/" for number in range(len(manifest.files))])
            prefix = prefixes.take(pa.array(manifest.source))
            keys = manifest.table[name].combine_chunks().cast(pa.string())
            cells = pc.binary_join_element_wise(prefix, keys, "")
            table = _with_column(table, name, pa.chunked_array([cells]))
    return table


def sensor_rows(
    manifest: Manifest,
    model: ModelConfig,
    rows: np.ndarray | None = None,
    *,
    unknown: Literal["error", "skip", "universal"] = "error",
) -> tuple[np.ndarray, list[str]]:
    """Return the sensor-table row of every manifest row, i32 (rows,), and notes.

    It is -1 for rows to leave out, as those of force fields.

    Args:
        manifest: The frames.
        model: Has the sensor table.
        rows: The rows that are considered, by default all.
        unknown: A sensor outside the table is an error, is left out (`skip`), or uses the universal
            tokens (`universal`). A misspelt name is always an error.

    Raises:
        ManifestError: Names the first row.
    """
    ids = np.full(len(manifest), -1, np.int32)
    rows = np.arange(len(manifest)) if rows is None else np.unique(rows)
    notes = []
    for same in group_rows(rows, manifest.codes("sensor")[rows]):
        name = manifest.value(same[0], "sensor")
        try:
            ids[same] = model.sensor_row(name)
        except ConfigError as error:
            if name in FIELD_SENSORS:
                notes.append(
                    f"left out {len(same)} rows of {name}: it measures a force field and has no "
                    "images"
                )
            elif unknown == "error" or isinstance(error, SpellingError):
                raise ManifestError(
                    f"{manifest.where(same[0])}, column 'sensor': {error}"
                ) from None
            elif unknown == "skip":
                notes.append(f"left out {len(same)} rows of the unknown sensor {shown(name)}")
            else:
                ids[same] = model.universal_row
                notes.append(
                    f"sensor {shown(name)} is unknown: its {len(same)} rows use the universal "
                    "sensor tokens"
                )
    return ids, notes


def misspelt_sensors(
    manifest: Manifest,
) -> Iterator[tuple[Literal["error", "warning"], str, np.ndarray]]:
    """Yield (level, sentence, row ids i64) for sensor names that are nearly known names.

    New names are no fault.
    """

    def sensor(rows: np.ndarray) -> str:
        return str(manifest.value(rows[0], "sensor"))

    for rows in sorted(manifest.groups("sensor"), key=sensor):
        try:
            check_spelling(sensor(rows))
        except SpellingError as error:
            yield "error", f"{rows.size} rows are of {error}", rows


def resolve_path(root: str | Path, relative: str | None) -> Path:
    """Return the file inside `root`, or the local copy of an address.

    Raises ManifestError if it leaves the folder.
    """
    if not relative:
        raise ManifestError("the path is empty")
    if is_remote(relative):
        return local_copy(relative)
    root = str(root)
    text = shown(relative)
    if "\0" in relative or len(relative) > _LONGEST_PATH:
        raise ManifestError(f"the path {text} is not a file name")
    head, _, name = relative.rpartition("/")
    # Folders are resolved once and cached, because that takes most of the time.
    path = f"{_real_folder(root, head)}/{name}"
    if name in ("", ".", "..") or os.path.islink(path):
        path = os.path.realpath(path)
    if ("\\" in relative or relative[1:3] == ":/") and not os.path.lexists(path):
        raise ManifestError(
            f"the path {text} is written as on Windows; write it relative to the manifest's "
            "folder, with forward slashes (touch/0.png)"
        )
    if relative[0] == "/":
        raise ManifestError(
            f"the path {text} is absolute; write it relative to the manifest's folder, {root}"
        )
    inside = root if root[-1] == "/" else f"{root}/"
    if not path.startswith(inside):
        message = f"the path {text} leaves the folder of the manifest, {root}"
        if ".." not in relative.split("/"):
            message += ", by a link; put the files there, or move the manifest next to them"
        raise ManifestError(message)
    return Path(path)


@lru_cache(4096)
def _real_folder(root: str, head: str) -> str:
    folder = os.path.realpath(os.path.join(root, head))
    if folder == "/":
        return ""
    return folder


def select_rows(manifest: Manifest, rows: np.ndarray) -> Manifest:
    """Return the manifest of `rows` (ids i64) in the order given.

    Errors still name the rows of the original files.
    """
    rows = np.asarray(rows, np.int64)
    return Manifest(
        manifest.table.take(pa.array(rows)),
        manifest.files,
        manifest.source[rows],
        manifest.number[rows],
    )


def group_rows(
    rows: np.ndarray, keys: np.ndarray, order: np.ndarray | None = None
) -> list[np.ndarray]:
    """Return row ids in groups of equal keys.

    Args:
        rows: Ids i64 (n,).
        keys: Of each row, (n,) or (n, k).
        order: (n,), the order of the rows in a group, by default that of their ids.

    Returns:
        Ids of each group, the groups in the order of their keys.
    """
    if not len(rows):
        return []
    group = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    at = np.lexsort((rows, rows if order is None else order, group))
    return np.split(rows[at], np.flatnonzero(np.diff(group[at])) + 1)


def replace_column(manifest: Manifest, name: str, values: Any) -> Manifest:
    """Return the manifest with column `name` set to `values` (rows,), appended if it was absent."""
    if not isinstance(values, pa.Array | pa.ChunkedArray):
        values = pa.array(values, SCHEMA.get(name))
    return replace(manifest, table=_with_column(manifest.table, name, values))


class Files(NamedTuple):
    """The n distinct files of a manifest.

    Attributes:
        code: For each column the file of each row, i64 (rows,), -1 for null.
        row: i64 (n,), the first row that names a file.
        column: (n,), the column in which it does.
    """

    code: dict[str, np.ndarray]
    row: np.ndarray
    column: np.ndarray

    def __len__(self) -> int:
        return len(self.row)


def distinct_files(manifest: Manifest, columns: Sequence[str] = PATHS) -> Files:
    """Return the files of some path columns, each once, by its written path and its manifest."""
    columns = [name for name in columns if name in manifest.table.column_names]
    rows = len(manifest)
    # All columns one below the other: place i is row i % rows of column i // rows.
    chunks = [chunk for name in columns for chunk in manifest.table[name].chunks]
    encoded = pa.chunked_array(chunks, pa.string()).dictionary_encode().unify_dictionaries()
    codes = [np.asarray(pc.fill_null(chunk.indices, -1)) for chunk in encoded.chunks]
    number = np.concatenate(codes).astype(np.int64)
    key = number * len(manifest.files) + np.tile(manifest.source.astype(np.int64), len(columns))
    known = np.flatnonzero(number >= 0)
    _, first, code = np.unique(key[known], return_index=True, return_inverse=True)
    full = np.full(len(number), -1, np.int64)
    full[known] = code
    first = known[first]
    code_of = {name: full[i * rows : (i + 1) * rows] for i, name in enumerate(columns)}
    return Files(code_of, first % rows, np.array(columns)[first // rows])
