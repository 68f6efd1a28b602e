"""Manifests made from manifests: some of the rows, another column, captions from a table."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.manifest.schema import SCHEMA
from anytouch_jax.errors import UserError


def select(manifest: Manifest, rows: np.ndarray) -> Manifest:
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
    table = _read(path)
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


def _read(path: Path) -> pa.Table:
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
