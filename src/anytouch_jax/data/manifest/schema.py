"""The schema of a manifest: column types, and CSV or Parquet files read into a checked table."""

from __future__ import annotations

import csv
import difflib
import unicodedata
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from anytouch_jax.errors import UserError
from anytouch_jax.files import csv_lines, placeholder

SPLITS = ("train", "val", "test", "background", "unused")
REQUIRED = ("path", "sensor", "sequence", "frame_index", "split")
PATHS = ("path", "image_path", "image2_path", "background_path", "field_path")

# Spellings of an unknown value, in small letters. Spreadsheets write #N/A, and pandas <NA>.
EMPTY = ("", "na", "n/a", "n.a.", "#n/a", "<na>", "nan", "none", "null", "nil", "-", "--", "?")

EXAMPLES = 5  # rows that a report on many rows names
MAX_ROWS = 20_000_000  # of a manifest file
_LISTED = 20  # names in a message
MAX_TEXT = 10_000  # bytes of a text cell in the columns that are used
_SPACES = r"[\s\p{Z}\x{200B}\x{FEFF}]+"
NUMBER = r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"
_READERS = 2  # parts of a Parquet file that are read at once: more need more memory
# cells of a part: a large table is read column by column, so that it is never in memory twice
_PART = 1 << 22
BLOCK = 1 << 19  # rows that are read at once where a table is not needed whole
_TEXT = pa.string()
_WHOLE = pa.int64()
_FLAG = pa.bool_()
_TEXT_COLUMNS = (*REQUIRED, *PATHS, "dataset", "unit", "touch", "object", "text", "license")
# text columns with values that a hand-written table may misspell
_NAMES = ("dataset", "unit", "object", "license")
SCHEMA: dict[str, pa.DataType] = dict.fromkeys(_TEXT_COLUMNS, _TEXT)
SCHEMA |= {"frame_index": _WHOLE, "stride": _WHOLE, "commercial": _FLAG}

Cast = Callable[[pa.ChunkedArray], pa.ChunkedArray]


class ManifestError(UserError):
    """A manifest that cannot be used.

    The message names the file, the column, and the line or row (`place_of`).
    """


def is_manifest(path: Path) -> bool:
    """Return whether a file has the columns of a manifest; its values are not checked."""
    try:
        if path.suffix.lower() == ".parquet":
            names = pa.parquet.read_schema(path).names
        else:
            names = _csv_names(path)
    except (pa.ArrowException, UnicodeDecodeError, csv.Error):
        return False
    return set(REQUIRED) <= {name.strip() for name in names}


def table_suffix(path: Path, name: str = "a manifest") -> str:
    """Return ".csv" or ".parquet".

    Raises ManifestError for any other ending; `name` is for the message.
    """
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise ManifestError(f"{path}: {name} ends in .csv or .parquet")
    return suffix


def load_table(path: Path) -> pa.Table:
    """Load the table in `path` (.csv or .parquet), checked and typed by `typed`.

    Raises ManifestError.
    """
    if path.is_dir():
        raise ManifestError(f"{path} is a folder; give the .csv or .parquet file in it")
    if not path.is_file():
        raise ManifestError(f"there is no manifest {path}")
    if table_suffix(path) == ".parquet":
        with reading(path):
            return _load_parquet(path)
    table = read_text_csv(path)
    _check_names(table.column_names, table.num_rows, path)
    columns = dict(zip(table.column_names, table.columns, strict=True))
    for name, column in columns.items():
        if name.startswith("label."):
            columns[name] = typed_label(column, name, partial(place_of, path))
        elif name in (*_NAMES, "sensor", "split"):
            columns[name] = clean_text(column)
    return typed(pa.table(columns), path)


def shown(value: object) -> str:
    """Return a value for a message: at most 200 characters of its form in Python."""
    text = repr(value[:200] if isinstance(value, str | bytes) else value)
    if len(text) <= 200:
        return text
    return f"{text[:197]}..."


def listed(names: Sequence[str], count: int | None = None) -> str:
    """Return the first twenty names for a message, and how many of `count` follow.

    Each has 50 characters at most.
    """
    if count is None:
        count = len(names)
    first = ", ".join(name[:50] for name in names[:_LISTED])
    if count > _LISTED:
        first += f" and {count - _LISTED:,} more"
    return first


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn errors of reading a table into a ManifestError that names the file."""
    try:
        kind = placeholder(path)
        if kind:
            raise ManifestError(f"{path} is {kind}")
        yield
    except (pa.ArrowException, UnicodeDecodeError, csv.Error, OSError) as error:
        said = getattr(error, "strerror", None) or str(error) or type(error).__name__
        # Arrow's errors go on with where in its sources they arose.
        reason = said.splitlines()[0][:500]
        form = path.suffix.lower()[1:]
        raise ManifestError(f"{path} cannot be read as a {form} table: {reason}") from None


def read_text_csv(path: Path) -> pa.Table:
    """Return a CSV file as a table of text columns, where an empty cell is null.

    Raises ManifestError.
    """
    with reading(path):
        names = _csv_names(path)
        types = dict.fromkeys(names, _TEXT)
        convert = pa.csv.ConvertOptions(
            column_types=types, strings_can_be_null=True, null_values=[""]
        )
        parse = pa.csv.ParseOptions(newlines_in_values=True)
        try:
            table = pa.csv.read_csv(path, convert_options=convert, parse_options=parse)
        except pa.ArrowInvalid:
            line, cells = _first_odd_line(path, len(names))
            if not line:
                raise
            raise ManifestError(
                f"{path}, line {line}: {len(cells)} cells for {len(names)} columns, in "
                f"{shown(','.join(cells))}; quote cells with commas, and close each quote"
            ) from None
        if any(_has_line_breaks(column) for column in table.columns):
            # Arrow takes the rows after a quote that is not closed for its text. Python's reader
            # raises for it.
            deque(csv_lines(path), 0)
        return table.rename_columns([name.strip() for name in table.column_names])


def _first_odd_line(path: Path, columns: int) -> tuple[int, list[str]]:
    """Return the first line with another number of cells, and these; line 0 without one."""
    for line, cells in csv_lines(path):
        if len(cells) != columns:
            return line, cells
    return 0, []


def _has_line_breaks(column: pa.ChunkedArray) -> bool:
    return bool(pc.any(pc.match_substring_regex(column, r"[\r\n]")).as_py())


def _csv_names(path: Path) -> list[str]:
    return next(csv_lines(path), (0, list[str]()))[1]


def place_of(path: Path, row: int) -> str:
    """Return where a row is, for errors.

    That is "line 5 of m.csv", as an editor counts lines, or "row 3 of m.parquet", counted from 0.
    """
    if path.suffix.lower() == ".csv":
        with suppress(OSError, UnicodeDecodeError, csv.Error, IndexError):
            return f"line {_csv_line_numbers(path, path.stat().st_mtime_ns)[row + 1]} of {path}"
    return f"row {row} of {path}"


@lru_cache(4)
def _csv_line_numbers(path: Path, changed: int) -> np.ndarray:
    """Return the first line of each row of a CSV file, i64 (1 + rows,).

    `changed` is the time of its last change.
    """
    return np.fromiter((line for line, _ in csv_lines(path)), np.int64)


def _load_parquet(path: Path) -> pa.Table:
    with pa.parquet.ParquetFile(path) as file:
        names = file.schema_arrow.names
        rows = file.metadata.num_rows
    _check_names(names, rows, path)
    size = max(1, _PART // rows)

    def load(start: int) -> list[pa.ChunkedArray]:
        part = names[start : start + size]
        # two threads cannot share a file
        with pa.parquet.ParquetFile(path) as file:
            table = file.read(part, use_threads=False)
        checked = pa.table({name: _checked(name, table[name], path) for name in part})
        return checked.combine_chunks().columns

    with ThreadPoolExecutor(_READERS) as pool:
        columns = [column for part in pool.map(load, range(0, len(names), size)) for column in part]
    pa.default_memory_pool().release_unused()
    return pa.table(columns, names)


def parquet_blocks(path: Path) -> tuple[list[str], Callable[[str], Iterator[pa.Array]]]:
    """Return the columns of a Parquet file, and a function that yields one in checked blocks.

    Raises ManifestError.
    """
    with reading(path):
        file = pa.parquet.ParquetFile(path, pre_buffer=False)
        names = file.schema_arrow.names
        _check_names(names, file.metadata.num_rows, path)

    def blocks(name: str) -> Iterator[pa.Array]:
        first = 0
        with reading(path):
            for batch in file.iter_batches(BLOCK, columns=[name], use_threads=False):
                column = _checked(name, pa.chunked_array([batch.column(name)]), path, first)
                first += len(column)
                yield from column.chunks

    return names, blocks


def typed(table: pa.Table, path: Path) -> pa.Table:
    """Return `table` with the types of SCHEMA, blank text as null, and every value checked.

    Other columns stay unchanged.

    Raises:
        ManifestError: Names the place in `path`. For a missing column or value, a wrong type, an
            unknown split, a stride below 1, text that is not UTF-8 or too long, and for too many
            rows or none.
    """
    _check_names(table.column_names, table.num_rows, path)
    checked = {name: _checked(name, table[name], path) for name in table.column_names}
    return pa.table(checked).combine_chunks()


def typed_label(
    column: pa.ChunkedArray, name: str = "", where: Callable[[int], str] | None = None
) -> pa.ChunkedArray:
    """Return a text column as numbers or truth values if all cells are; 007 stays text.

    Args:
        column: Text.
        name: Its name, for errors.
        where: Names a row. With it, a class in two spellings, and a text among nine times as many
            numbers, are errors.

    Raises:
        ManifestError: For these.
    """
    column = clean_text(column)
    # 007 names an object, and as a number it would lose its zeros.
    has_leading_zeros = pc.any(pc.match_substring_regex(column, r"^[-+]?0\d")).as_py()
    if not has_leading_zeros:
        for kind in (_WHOLE, pa.float64(), pa.bool_()):
            with suppress(pa.ArrowInvalid):
                return _decimal(column).cast(kind)
    if where is not None:
        _check_label(name, column, where)
    return column


def clean_text(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return a text column in Unicode form NFC with single spaces, and EMPTY words as null."""
    composed = pc.utf8_normalize(column, "NFC")
    column = pc.utf8_trim(pc.replace_substring_regex(composed, _SPACES, " "), " ")
    is_empty = pc.is_in(pc.utf8_lower(column), value_set=pa.array(EMPTY))
    return pc.if_else(is_empty, pa.scalar(None, _TEXT), column)


def spellings(values: Iterable[str]) -> list[list[str]]:
    """Return the groups of values that differ by spaces, letter case or Unicode form only."""
    groups: dict[str, list[str]] = {}
    for value in dict.fromkeys(values):
        folded = unicodedata.normalize("NFKC", value).casefold()
        groups.setdefault(" ".join(folded.split()), []).append(value)
    return [group for group in groups.values() if len(group) > 1]


def _check_label(name: str, column: pa.ChunkedArray, where: Callable[[int], str]) -> None:
    for first, other, *_ in spellings(column.unique().drop_null().to_pylist()):
        places = [where(pc.index(column, text).as_py()) for text in (other, first)]
        raise ManifestError(
            f"{places[0]}: column {name!r} has {shown(other)}, and {places[1]} has {shown(first)}; "
            "write one class in one way"
        )
    is_number = np.asarray(pc.fill_null(pc.match_substring_regex(column, NUMBER), False))
    words = np.flatnonzero(np.asarray(pc.is_valid(column)) & ~is_number)
    # 007 is a name, and names may have letters too.
    is_name = pc.any(pc.match_substring_regex(column, r"^0\d")).as_py()
    if words.size and is_number.sum() >= 9 * words.size and not is_name:
        cell = shown(column[int(words[0])].as_py())
        raise ManifestError(
            f"{where(words[0])}: column {name!r} has {cell} among numbers; write a number or "
            "nothing"
        )


def _check_names(names: Sequence[str], rows: int, path: Path) -> None:
    repeated = [name for name, count in Counter(names).items() if count > 1]
    missing = [name for name in REQUIRED if name not in names]
    if repeated:
        raise ManifestError(f"{path}: column {shown(repeated[0])} is there twice")
    if len(names) == 1 and ";" in names[0]:
        raise ManifestError(f"{path} has semicolons between its columns; save it with commas")
    if missing:
        raise ManifestError(
            f"{path} lacks the column {', '.join(map(repr, missing))}; it has {listed(names)}"
        )
    if not rows:
        raise ManifestError(f"{path} has no rows")
    if rows > MAX_ROWS:
        raise ManifestError(
            f"{path} has {rows:,} rows, more than {MAX_ROWS:,}; split it into several manifests"
        )


def is_text(kind: pa.DataType) -> bool:
    """Return whether a column of this type holds text."""
    return (
        pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind)
    )


def _checked(name: str, column: pa.ChunkedArray, path: Path, first: int = 0) -> pa.ChunkedArray:
    """Return a column in its type, checked.

    Args:
        name: Its name, which SCHEMA may know.
        column: As it was read.
        path: The file, for errors.
        first: The row of the file that it begins with.

    Raises:
        ManifestError: With a place.
    """

    def refuse(bad: pa.ChunkedArray, problem: Callable[[int], str]) -> None:
        """Raise for the first row that is bad."""
        row = pc.index(bad, True).as_py()
        if row >= 0:
            raise ManifestError(
                f"{place_of(path, first + row)}: column {shown(name)} {problem(row)}"
            )

    column = _cast(name, column, path, first)
    if name in REQUIRED:
        refuse(pc.is_null(column), lambda _: "is empty")
    is_label = name.startswith("label.")
    if is_label and is_text(column.type):  # polars writes large_string
        column = column.cast(_TEXT)
    if pa.types.is_string(column.type) and (name in SCHEMA or is_label):
        length = pc.binary_length(column)
        refuse(
            pc.greater(length, MAX_TEXT),
            lambda row: f"has a text of {length[row]} bytes, more than {MAX_TEXT:,}",
        )
    if name == "split":
        unknown = pc.invert(pc.is_in(column, value_set=pa.array(SPLITS)))
        refuse(unknown, lambda row: _unknown_split(column[row].as_py()))
    if name == "stride":
        column = pc.fill_null(column, 1)
        refuse(pc.less(column, 1), lambda row: f"must be at least 1, is {column[row]}")
    return column


def _cast(name: str, column: pa.ChunkedArray, path: Path, first: int) -> pa.ChunkedArray:
    """Return a column in its type; the arguments are those of `_checked`."""
    for cast, kind in ((_plain, "UTF-8 text"), _CASTS[SCHEMA.get(name)]):
        try:
            column = cast(column)
        except pa.ArrowInvalid:
            row = _first_invalid(column, cast)
            # a text that is not UTF-8 cannot be shown
            value = "" if cast is _plain else f", is {shown(column[row].as_py())}"
            raise ManifestError(
                f"{place_of(path, first + row)}: column {shown(name)} must be {kind}{value}"
            ) from None
        except pa.ArrowTypeError:
            raise ManifestError(
                f"{path}: column {name!r} must be {kind}, is {column.type}"
            ) from None
    return column


def _unknown_split(value: str) -> str:
    """Return what is wrong with a split, and the nearest one that there is."""
    problem = f"must be one of {', '.join(SPLITS)}, is the unknown split {shown(value)}"
    word = value[:50].strip().lower().replace("validation", "val")
    near = difflib.get_close_matches(word, SPLITS, 1)
    if near:
        problem += f"; did you mean {near[0]}?"
    return problem


def _plain(column: pa.ChunkedArray) -> pa.ChunkedArray:
    column.validate(full=True)
    if pa.types.is_dictionary(column.type):
        return column.cast(column.type.value_type)
    return column


def _cast_text(column: pa.ChunkedArray) -> pa.ChunkedArray:
    if not is_text(column.type) and not pa.types.is_null(column.type):
        raise pa.ArrowTypeError
    column = column.cast(_TEXT)
    blank = pc.or_(pc.equal(pc.binary_length(column), 0), pc.utf8_is_space(column))
    # Copying millions of strings takes longer than the check.
    if pc.any(blank).as_py():
        return pc.if_else(blank, pa.scalar(None, _TEXT), column)
    return column


def _decimal(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return a text column.

    Raises ArrowInvalid for a cell like 0x10, which a cast would take for 16.
    """
    if pc.any(pc.match_substring_regex(column, r"^0[xX]")).as_py():
        raise pa.ArrowInvalid("a number in hexadecimal")
    return column


def _cast_whole(column: pa.ChunkedArray) -> pa.ChunkedArray:
    kind = column.type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
        column = _decimal(pc.utf8_trim_whitespace(_cast_text(column)))
    try:
        return column.cast(_WHOLE)
    except (
        pa.ArrowInvalid
    ):  # a column of whole numbers with gaps is often stored as floats ("130.0")
        return column.cast(pa.float64()).cast(_WHOLE)


def _cast_flag(column: pa.ChunkedArray) -> pa.ChunkedArray:
    if pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
        # a number other than 0 and 1 is a mistake, not "true"
        column = _cast_whole(column).cast(_TEXT)
    if pa.types.is_boolean(column.type):
        return column
    return pc.utf8_trim_whitespace(_cast_text(column)).cast(_FLAG)


_CASTS: dict[pa.DataType | None, tuple[Cast, str]] = {
    None: (lambda column: column, ""),
    _TEXT: (_cast_text, "text"),
    _WHOLE: (_cast_whole, "a whole number"),
    _FLAG: (_cast_flag, "a 0 or 1"),
}


def _first_invalid(column: pa.ChunkedArray, cast: Cast) -> int:
    """Return the first row that `cast` refuses, by bisection."""
    low = 0
    high = len(column)
    while high - low > 1:
        middle = (low + high) // 2
        try:
            cast(column.slice(low, middle - low))
            low = middle
        except pa.ArrowInvalid:
            high = middle
    return low
