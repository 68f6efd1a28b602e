"""Labels of one's own recordings: a table by object or sequence, joined to their rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa

from anytouch_jax.data.manifest.schema import typed_label
from anytouch_jax.data.readers.common import Columns, DatasetError, Notes, read_csv

KEYS = ("object", "sequence")
PLAIN = ("unit", "touch", "text")  # columns of a manifest; any other one becomes label.<name>


def join(columns: Columns, path: Path, notes: Notes) -> Columns:
    """`columns` with those of the CSV table `path`; of two lines that fit a row, the one by sequence goes first.

    What fits nothing, and recordings without a label, are counted. Raises DatasetError for a table that is missing,
    has no key, a column or a key twice.
    """
    names, lines = _read(path)
    size = len(columns["path"])
    objects = columns.get("object", [None] * size)
    found: dict[str, list[Any]] = {name: [None] * size for name in names if name not in KEYS}
    used = set()
    bare: dict[str, None] = {}
    for row, (one, sequence) in enumerate(zip(objects, columns["sequence"], strict=True)):
        fitting = [key for key in ((one, None), (None, sequence), (one, sequence)) if any(key) and key in lines]
        used.update(fitting)
        for key in fitting:
            for name, cell in lines[key].items():
                found[name][row] = cell or found[name][row]
        if not fitting:
            bare[sequence] = None
    for key in lines:
        if key not in used:
            notes.skip(f"key of {path.name} that no recording has", ", ".join(part for part in key if part))
    for sequence in bare:
        notes.skip(f"recording without a line in {path.name}", sequence)
    joined = dict(columns)
    for name, cells in found.items():
        if not any(cells):
            continue
        if name in PLAIN:
            old = columns.get(name, [None] * size)
            joined[name] = [new or before for new, before in zip(cells, old, strict=True)]
        else:
            full = name if name.startswith("label.") else f"label.{name}"
            joined[full] = typed_label(pa.chunked_array([pa.array(cells, pa.string())])).to_pylist()
    return joined


def _read(path: Path) -> tuple[list[str], dict[tuple[str | None, str | None], dict[str, str]]]:
    """The columns of the table, and (object, sequence), either None where it is empty -> the other cells."""
    rows = read_csv(path)
    names = rows[0] if rows else []
    if not set(KEYS) & set(names):
        raise DatasetError(
            f"{path} has no column object or sequence, by which labels are joined; it has {', '.join(names)}"
        )
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise DatasetError(f"{path} has the column {twice[0]!r} twice")
    lines: dict[tuple[str | None, str | None], dict[str, str]] = {}
    for number, row in enumerate(rows[1:]):
        cells = dict(zip(names, row, strict=False))
        key = (cells.pop("object", None) or None, cells.pop("sequence", None) or None)
        if not any(key):
            raise DatasetError(f"{path}, row {number}: there is neither an object nor a sequence")
        if key in lines:
            raise DatasetError(f"{path}, row {number}: {', '.join(part for part in key if part)} is there twice")
        lines[key] = {name: cell for name, cell in cells.items() if name}
    return [name for name in names if name], lines
