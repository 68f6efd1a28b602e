"""The columns of a manifest: their types, and CSV or Parquet files read into a checked table."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from anytouch_jax.errors import UserError

SPLITS = ("train", "val", "test", "background", "unused")
REQUIRED = ("path", "sensor", "sequence", "frame_index", "split")
PATHS = ("path", "image_path", "image2_path", "background_path", "field_path")

_READERS = 2  # columns of a Parquet file that are read at once: more need more memory
_TEXT, _WHOLE, _FLAG = pa.string(), pa.int64(), pa.bool_()
SCHEMA: dict[str, pa.DataType] = {
    "path": _TEXT,
    "sensor": _TEXT,
    "sequence": _TEXT,
    "frame_index": _WHOLE,
    "split": _TEXT,
    "dataset": _TEXT,
    "unit": _TEXT,
    "stride": _WHOLE,
    "touch": _TEXT,
    "object": _TEXT,
    "image_path": _TEXT,
    "image2_path": _TEXT,
    "text": _TEXT,
    "background_path": _TEXT,
    "field_path": _TEXT,
    "license": _TEXT,
    "commercial": _FLAG,
}


class ManifestError(UserError):
    """A manifest that cannot be used; the message names the file, the column and the row (counted from 0)."""


def load_table(path: Path) -> pa.Table:
    """The table in `path` (.csv or .parquet), checked and typed by `typed`. Raises ManifestError."""
    if path.is_dir():
        raise ManifestError(f"{path} is a folder; give the .csv or .parquet file in it")
    if not path.is_file():
        raise ManifestError(f"there is no manifest {path}")
    kind = path.suffix.lower()
    if kind not in (".csv", ".parquet"):
        raise ManifestError(f"{path}: a manifest ends in .csv or .parquet")
    try:
        return typed(_read_csv(path), str(path)) if kind == ".csv" else _load_parquet(path)
    except (pa.ArrowException, UnicodeDecodeError, csv.Error, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ManifestError(f"{path} cannot be read as a {kind[1:]} table: {reason}") from None


def is_manifest(path: Path) -> bool:
    """Whether the file in `path` has the columns of a manifest; its values are not looked at."""
    try:
        if path.suffix.lower() == ".parquet":
            names = pa.parquet.read_schema(path).names
        else:
            with path.open(encoding="utf-8-sig", newline="") as file:
                names = next(csv.reader(file), [])
    except (pa.ArrowException, UnicodeDecodeError, csv.Error):
        return False
    return set(REQUIRED) <= set(names)


def _load_parquet(path: Path) -> pa.Table:
    """Column by column, so that a large table is never in the memory twice."""
    with pa.parquet.ParquetFile(path) as file:
        names, rows = file.schema_arrow.names, file.metadata.num_rows
    _check_names(names, rows, str(path))

    def load(name: str) -> pa.ChunkedArray:
        with pa.parquet.ParquetFile(path) as file:  # a file is not to be read by two threads
            column = file.read([name], use_threads=False)[name]
        return _whole_chunk(_checked(name, column, str(path)))

    with ThreadPoolExecutor(_READERS) as pool:
        columns = dict(zip(names, pool.map(load, names), strict=True))
    pa.default_memory_pool().release_unused()
    return pa.table(columns)


def _whole_chunk(column: pa.ChunkedArray) -> pa.ChunkedArray:
    return pa.table({"one": column}).combine_chunks()["one"]


def typed(table: pa.Table, where: str) -> pa.Table:
    """`table` with the types of SCHEMA, blank text as null, and every value checked.

    Columns outside SCHEMA are carried through. `where` names the file in errors. Raises ManifestError when a
    required column or value is missing, a type is wrong, a split is unknown, a stride is below 1, or no row is there.
    """
    _check_names(table.column_names, table.num_rows, where)
    return pa.table({name: _checked(name, table[name], where) for name in table.column_names}).combine_chunks()


def _check_names(names: Sequence[str], rows: int, where: str) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ManifestError(f"{where}: column {twice[0]!r} is there twice")
    missing = [name for name in REQUIRED if name not in names]
    if len(names) == 1 and ";" in names[0]:
        raise ManifestError(f"{where} has semicolons between its columns; save it with commas")
    if missing:
        raise ManifestError(f"{where} lacks the column {', '.join(map(repr, missing))}; it has {', '.join(names)}")
    if not rows:
        raise ManifestError(f"{where} has no rows")


def _checked(name: str, column: pa.ChunkedArray, where: str) -> pa.ChunkedArray:
    """A column with its type, every value checked."""
    column = _convert(name, column, where)
    if name in REQUIRED:
        _refuse(pc.is_null(column), where, name, lambda _: "is empty")
    if name == "split":
        unknown = pc.invert(pc.is_in(column, value_set=pa.array(SPLITS)))
        choices = ", ".join(SPLITS)
        _refuse(unknown, where, name, lambda row: f"must be one of {choices}, is the unknown split {column[row]}")
    if name == "stride":
        column = pc.fill_null(column, 1)
        _refuse(pc.less(column, 1), where, name, lambda row: f"must be at least 1, is {column[row]}")
    return column


def _read_csv(path: Path) -> pa.Table:
    """A CSV file as text columns (an empty cell is null), `label.*` as numbers or truths where all cells are."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        names = next(csv.reader(file), [])
    convert = pa.csv.ConvertOptions(
        column_types=dict.fromkeys(names, _TEXT), strings_can_be_null=True, null_values=[""]
    )
    table = pa.csv.read_csv(path, convert_options=convert, parse_options=pa.csv.ParseOptions(newlines_in_values=True))
    for position, name in enumerate(table.column_names):
        if name.startswith("label."):
            table = table.set_column(position, name, typed_label(table[name]))
    return table


def typed_label(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """A column of text as numbers or truths where all of it are; 007 is a name, of which a number would lose the 0s."""
    column = pc.utf8_trim_whitespace(column)
    column = pc.if_else(pc.equal(column, ""), pa.scalar(None, _TEXT), column)
    if pc.any(pc.match_substring_regex(column, r"^[-+]?0\d")).as_py():
        return column
    for kind in (pa.int64(), pa.float64(), pa.bool_()):
        try:
            return column.cast(kind)
        except pa.ArrowInvalid:
            continue
    return column


def _convert(name: str, column: pa.ChunkedArray, where: str) -> pa.ChunkedArray:
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    wanted = SCHEMA.get(name)
    if wanted is None:
        return column
    if pa.types.is_null(column.type):
        return column.cast(wanted)
    is_text = any(kind(column.type) for kind in (pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view))
    if is_text:
        column = column.cast(_TEXT)
        if wanted != _TEXT:
            column = pc.utf8_trim_whitespace(column)
        blank = pc.or_(pc.equal(pc.binary_length(column), 0), pc.utf8_is_space(column))
        if pc.any(blank).as_py():  # copying millions of strings takes longer than looking at them
            column = pc.if_else(blank, pa.scalar(None, _TEXT), column)
    if wanted == _TEXT:
        if not is_text:
            raise ManifestError(f"{where}: column {name!r} must be text, is {column.type}")
        return column
    number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type) or pa.types.is_boolean(column.type)
    if not (is_text or number):
        raise ManifestError(f"{where}: column {name!r} must be a {_plain(wanted)}, is {column.type}")
    try:
        # A column of whole numbers with gaps is often stored as floats ("130.0"), so a plain cast is not enough.
        return _whole(column) if wanted == _WHOLE else _flag(column, is_text)
    except pa.ArrowInvalid:
        parse = _parse_whole if wanted == _WHOLE else _parse_flag
        row, value = _first_bad(column, parse)
        what = _plain(wanted)
        raise ManifestError(f"{where}, row {row}: column {name!r} must be a {what}, is {value!r}") from None


def _whole(column: pa.ChunkedArray) -> pa.ChunkedArray:
    try:
        return column.cast(_WHOLE)
    except pa.ArrowInvalid:
        return column.cast(pa.float64()).cast(_WHOLE)


def _flag(column: pa.ChunkedArray, is_text: bool) -> pa.ChunkedArray:
    if not is_text and not pa.types.is_boolean(column.type):
        column = _whole(column).cast(_TEXT)  # a number other than 0 and 1 is a mistake, not "true"
    return column.cast(pa.bool_())


def _plain(kind: pa.DataType) -> str:
    return "whole number" if kind == _WHOLE else "0 or 1"


def _parse_whole(value: Any) -> None:
    if "_" in str(value) or float(value) != int(float(value)) or abs(float(value)) >= 2**63:
        raise ValueError


def _parse_flag(value: Any) -> None:
    if str(value).lower() not in ("0", "1", "true", "false"):
        raise ValueError


def _first_bad(column: pa.ChunkedArray, parse: Callable[[Any], None]) -> tuple[int, Any]:
    """Row and value of the first entry that `parse` refuses; only walked when the fast cast has failed."""
    for row, value in enumerate(column.to_pylist()):
        if value is None:
            continue
        try:
            parse(value)
        except (ValueError, OverflowError):
            return row, value
    return 0, column[0].as_py()


def _refuse(bad: pa.ChunkedArray, where: str, name: str, log: Callable[[int], str]) -> None:
    row = pc.index(bad, True).as_py()
    if row >= 0:
        raise ManifestError(f"{where}, row {row}: column {name!r} {log(row)}")
