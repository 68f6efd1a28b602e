"""The schema of a manifest: column types, and CSV or Parquet files read into a checked table."""

from __future__ import annotations

import csv
import difflib
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from anytouch_jax.errors import UserError

SPLITS = ("train", "val", "test", "background", "unused")
REQUIRED = ("path", "sensor", "sequence", "frame_index", "split")
PATHS = ("path", "image_path", "image2_path", "background_path", "field_path")

EMPTY = ("", "na", "n/a", "nan", "none", "null", "-", "?")  # spellings of an unknown value, in small letters

_SPACES = r"[\s\p{Z}\x{200B}\x{FEFF}]+"
_READERS = 2  # columns of a Parquet file that are read at once: more need more memory
_TEXT, _WHOLE, _FLAG = pa.string(), pa.int64(), pa.bool_()
_TEXT_COLUMNS = (*REQUIRED, *PATHS, "dataset", "unit", "touch", "object", "text", "license")
_NAMES = ("dataset", "unit", "object", "license")  # text columns with values that a hand-written table may misspell
SCHEMA: dict[str, pa.DataType] = {
    **dict.fromkeys(_TEXT_COLUMNS, _TEXT),
    "frame_index": _WHOLE,
    "stride": _WHOLE,
    "commercial": _FLAG,
}
Cast = Callable[[pa.ChunkedArray], pa.ChunkedArray]


class ManifestError(UserError):
    """A manifest that cannot be used; the message names the file, the column and the row (counted from 0)."""


def is_manifest(path: Path) -> bool:
    """Return whether the file in `path` has the columns of a manifest; its values are not checked."""
    try:
        names = pa.parquet.read_schema(path).names if path.suffix.lower() == ".parquet" else _csv_names(path)
    except (pa.ArrowException, UnicodeDecodeError, csv.Error):
        return False
    return set(REQUIRED) <= set(names)


def table_suffix(path: Path, name: str = "a manifest") -> str:
    """Return ".csv" or ".parquet". Raises ManifestError for any other ending; `name` is for the message."""
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise ManifestError(f"{path}: {name} ends in .csv or .parquet")
    return suffix


def load_table(path: Path) -> pa.Table:
    """Load the table in `path` (.csv or .parquet), checked and typed by `typed`. Raises ManifestError."""
    if path.is_dir():
        raise ManifestError(f"{path} is a folder; give the .csv or .parquet file in it")
    if not path.is_file():
        raise ManifestError(f"there is no manifest {path}")
    if table_suffix(path) == ".parquet":
        with reading(path):
            return _load_parquet(path)
    table = read_text_csv(path)
    for position, name in enumerate(table.column_names):
        if name.startswith("label."):
            column = typed_label(table[name])
            check_label(name, column, lambda row: f"{path}, row {row}")
            table = table.set_column(position, name, column)
        elif name in (*_NAMES, "sensor", "split"):
            table = table.set_column(position, name, clean_text(table[name]))
    return typed(table, str(path))


def shown(value: object) -> str:
    """Return a value for a message: at most 200 characters of its form in Python."""
    text = repr(value[:200] if isinstance(value, str | bytes) else value)
    return text if len(text) <= 200 else f"{text[:197]}..."


def listed(names: Sequence[str]) -> str:
    """Return the first twenty names for a message, each with at most 50 characters, and the number of the others."""
    more = f" and {len(names) - 20:,} more" if len(names) > 20 else ""
    return ", ".join(name[:50] for name in names[:20]) + more


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn errors of reading a table into a ManifestError that names the file."""
    try:
        yield
    except (pa.ArrowException, UnicodeDecodeError, csv.Error, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        kind = path.suffix.lower()[1:]
        raise ManifestError(f"{path} cannot be read as a {kind} table: {reason}") from None


def read_text_csv(path: Path) -> pa.Table:
    """Return a CSV file as a table of text columns, where an empty cell is null. Raises ManifestError."""
    with reading(path):
        types = dict.fromkeys(_csv_names(path), _TEXT)
        convert = pa.csv.ConvertOptions(column_types=types, strings_can_be_null=True, null_values=[""])
        parse = pa.csv.ParseOptions(newlines_in_values=True)
        return pa.csv.read_csv(path, convert_options=convert, parse_options=parse)


def _csv_names(path: Path) -> list[str]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        return next(csv.reader(file), [])


def _load_parquet(path: Path) -> pa.Table:
    """Load column by column, so that a large table is never in memory twice."""
    with pa.parquet.ParquetFile(path) as file:
        names, rows = file.schema_arrow.names, file.metadata.num_rows
    _check_names(names, rows, str(path))

    def load(name: str) -> pa.ChunkedArray:
        with pa.parquet.ParquetFile(path) as file:  # two threads cannot share a file
            column = file.read([name], use_threads=False)[name]
        return pa.table({"column": _checked(name, column, str(path))}).combine_chunks()["column"]

    with ThreadPoolExecutor(_READERS) as pool:
        columns = dict(zip(names, pool.map(load, names), strict=True))
    pa.default_memory_pool().release_unused()
    return pa.table(columns)


def typed(table: pa.Table, where: str) -> pa.Table:
    """Return `table` with the types of SCHEMA, blank text as null, and every value checked.

    Columns outside SCHEMA stay unchanged. `where` names the file in errors. Raises ManifestError for a missing column
    or value, a wrong type, an unknown split, a stride below 1, and a table without rows.
    """
    _check_names(table.column_names, table.num_rows, where)
    return pa.table({name: _checked(name, table[name], where) for name in table.column_names}).combine_chunks()


def typed_label(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return a text column as numbers or truth values if all cells are; 007 stays text, because its zeros matter."""
    column = clean_text(column)
    if pc.any(pc.match_substring_regex(column, r"^[-+]?0\d")).as_py():
        return column
    for kind in (pa.int64(), pa.float64(), pa.bool_()):
        try:
            return column.cast(kind)
        except pa.ArrowInvalid:
            continue
    return column


def clean_text(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return a text column in Unicode form NFC with single spaces, where every spelling of EMPTY is null."""
    column = pc.utf8_trim(pc.replace_substring_regex(pc.utf8_normalize(column, "NFC"), _SPACES, " "), " ")
    is_empty = pc.is_in(pc.utf8_lower(column), value_set=pa.array(EMPTY))
    return pc.if_else(is_empty, pa.scalar(None, _TEXT), column)


def spellings(values: Iterable[str]) -> list[list[str]]:
    """Return the groups of values that differ by spaces, letter case or Unicode form only."""
    groups: dict[str, list[str]] = {}
    for value in dict.fromkeys(values):
        groups.setdefault(" ".join(unicodedata.normalize("NFKC", value).casefold().split()), []).append(value)
    return [group for group in groups.values() if len(group) > 1]


def check_label(name: str, column: pa.ChunkedArray, where: Callable[[int], str]) -> None:
    """Raise ManifestError if a label column has a class in two spellings, or a text among nine times as many numbers.

    `where` names a row of the column.
    """
    if not pa.types.is_string(column.type):
        return
    cells = column.to_pylist()
    for first, other, *_ in spellings(cell for cell in cells if cell is not None):
        raise ManifestError(
            f"{where(cells.index(other))}: column {name!r} has {other!r}, and {where(cells.index(first))} has "
            f"{first!r}; write one class in one way"
        )
    numbers, words = 0, []
    for row, cell in enumerate(cells):
        if cell is not None and _is_number(cell):
            numbers += 1
        elif cell is not None:
            words.append(row)
    # 007 is a name, and names may have letters too.
    if (
        words
        and numbers >= 9 * len(words)
        and not any(cell and cell[0] == "0" and cell[1:2].isdigit() for cell in cells)
    ):
        raise ManifestError(
            f"{where(words[0])}: column {name!r} has {cells[words[0]]!r} among numbers; write a number or nothing"
        )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _check_names(names: Sequence[str], rows: int, where: str) -> None:
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ManifestError(f"{where}: column {repeated[0]!r} is there twice")
    missing = [name for name in REQUIRED if name not in names]
    if len(names) == 1 and ";" in names[0]:
        raise ManifestError(f"{where} has semicolons between its columns; save it with commas")
    if missing:
        raise ManifestError(f"{where} lacks the column {', '.join(map(repr, missing))}; it has {', '.join(names)}")
    if not rows:
        raise ManifestError(f"{where} has no rows")


def _checked(name: str, column: pa.ChunkedArray, where: str) -> pa.ChunkedArray:
    """Return a column with its type, every value checked."""

    def refuse(bad: pa.ChunkedArray, problem: Callable[[int], str]) -> None:
        row = pc.index(bad, True).as_py()
        if row >= 0:
            raise ManifestError(f"{where}, row {row}: column {name!r} {problem(row)}")

    column = _converted(name, column, where)
    if name in REQUIRED:
        refuse(pc.is_null(column), lambda _: "is empty")
    if name == "split":
        unknown, choices = pc.invert(pc.is_in(column, value_set=pa.array(SPLITS))), ", ".join(SPLITS)

        def problem(row: int) -> str:
            value = column[row].as_py()
            near = difflib.get_close_matches(value.strip().lower().replace("validation", "val"), SPLITS, 1)
            guess = f"; did you mean {near[0]}?" if near else ""
            return f"must be one of {choices}, is the unknown split {value!r}{guess}"

        refuse(unknown, problem)
    if name == "stride":
        column = pc.fill_null(column, 1)
        refuse(pc.less(column, 1), lambda row: f"must be at least 1, is {column[row]}")
    return column


def _converted(name: str, column: pa.ChunkedArray, where: str) -> pa.ChunkedArray:
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    wanted = SCHEMA.get(name)
    if wanted is None:
        return column
    is_text = any(kind(column.type) for kind in (pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view))
    if pa.types.is_null(column.type):
        return column.cast(wanted)
    if is_text:
        column = column.cast(_TEXT)
        if wanted != _TEXT:
            column = pc.utf8_trim_whitespace(column)
        blank = pc.or_(pc.equal(pc.binary_length(column), 0), pc.utf8_is_space(column))
        if pc.any(blank).as_py():  # copying millions of strings takes longer than the check
            column = pc.if_else(blank, pa.scalar(None, _TEXT), column)
    if wanted == _TEXT:
        if not is_text:
            raise ManifestError(f"{where}: column {name!r} must be text, is {column.type}")
        return column
    kind = "whole number" if wanted == _WHOLE else "0 or 1"
    if not is_text and not any(
        is_kind(column.type) for is_kind in (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)
    ):
        raise ManifestError(f"{where}: column {name!r} must be a {kind}, is {column.type}")
    cast = _cast_whole if wanted == _WHOLE else _cast_flag
    try:
        return cast(column)
    except pa.ArrowInvalid:
        row = _first_invalid(column, cast)
        value = column[row].as_py()
        raise ManifestError(f"{where}, row {row}: column {name!r} must be a {kind}, is {value!r}") from None


def _cast_whole(column: pa.ChunkedArray) -> pa.ChunkedArray:
    try:
        return column.cast(_WHOLE)
    except pa.ArrowInvalid:  # a column of whole numbers with gaps is often stored as floats ("130.0")
        return column.cast(pa.float64()).cast(_WHOLE)


def _cast_flag(column: pa.ChunkedArray) -> pa.ChunkedArray:
    if pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
        column = _cast_whole(column).cast(_TEXT)  # a number other than 0 and 1 is a mistake, not "true"
    return column.cast(_FLAG)


def _first_invalid(column: pa.ChunkedArray, cast: Cast) -> int:
    """Return the first row that `cast` refuses, by bisection."""
    low, high = 0, len(column)
    while high - low > 1:
        middle = (low + high) // 2
        try:
            cast(column.slice(low, middle - low))
            low = middle
        except pa.ArrowInvalid:
            high = middle
    return low
