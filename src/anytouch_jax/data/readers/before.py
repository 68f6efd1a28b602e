"""A manifest that stands where a new one is to be written: what of it would be lost, and how it is carried over."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest, replace_column
from anytouch_jax.data.readers.common import Notes
from anytouch_jax.errors import UserError

_MARK = b"anytouch.index"  # in the schema of a Parquet file: the content hash with which `index` wrote it
_FROM_FILES = ("path", "sequence", "frame_index", "stride")  # what the files on disk say, never the user


def marked(new: Manifest) -> Manifest:
    """The manifest with a mark by which a Parquet file is known as what `index` wrote, as long as nobody edits it."""
    return replace(new, table=new.table.replace_schema_metadata({_MARK: new.content_hash.encode()}))


def carry(new: Manifest, target: Path, notes: Notes, *, keep: bool, groups: Collection[str]) -> Manifest:
    """The manifest to write in the place of `target`: `new`, with the values of `target` by `path` where `keep`.

    A row that is still there keeps every value but those of _FROM_FILES; empty cells and new rows get the reader's,
    but a new row the split of its group (columns `groups`) where its kept rows agree. Without `keep`, raises UserError
    for an edited `target`: it has a column that `new` lacks, or another value in a row of the same path.
    """
    if not target.exists():
        return new
    old = manifests.read(target)
    if not keep and _is_as_written(old, target):
        return new
    at = pc.index_in(new.column("path").combine_chunks(), value_set=old.column("path").combine_chunks())
    merged, lost = new, []
    for name in (one for one in old.table.column_names if one not in _FROM_FILES):
        mine = old.column(name).take(at)
        there = name in new.table.column_names
        differs = _differ(mine, new.column(name)) if there else np.asarray(pc.is_valid(mine))
        if not differs.any():
            continue
        lost.append(f"other values of {name} ({differs.sum()} rows)" if there else name)
        merged = replace_column(merged, name, _first_of(mine, new.column(name)) if there else mine)
    if lost and not keep:
        raise UserError(
            f"{target} has {', '.join(lost)}, which index does not write: give another --out, --keep to carry them "
            "over by path, or remove it"
        )
    if lost:
        notes.log(f"kept from {target.name} by path: {', '.join(lost)}")
    return _with_splits_of_groups(merged, np.asarray(pc.is_valid(at)), groups) if keep else merged


def _is_as_written(old: Manifest, target: Path) -> bool:
    if target.suffix.lower() != ".parquet":
        return False
    return (pa.parquet.read_schema(target).metadata or {}).get(_MARK) == old.content_hash.encode()


def _differ(mine: pa.ChunkedArray, new: pa.ChunkedArray) -> np.ndarray:
    """Where `mine` has another value than `new`, bool (rows,): 1 in a CSV may be "1" elsewhere."""
    same = pc.equal(mine.cast(pa.string()), new.cast(pa.string()))
    return np.asarray(pc.and_(pc.is_valid(mine), pc.invert(pc.fill_null(same, False))))


def _first_of(mine: pa.ChunkedArray, new: pa.ChunkedArray) -> pa.ChunkedArray:
    if mine.type != new.type:
        mine, new = mine.cast(pa.string()), new.cast(pa.string())
    return pc.coalesce(mine, new)


def _with_splits_of_groups(merged: Manifest, kept: np.ndarray, groups: Collection[str]) -> Manifest:
    """New rows of a recording or an object whose kept rows have one split get it: none comes to stand on two sides."""
    split = np.array(merged.column("split").to_pylist(), object)
    open_rows = ~kept
    for group in groups:
        codes = merged.codes(group)
        for code in np.unique(codes[open_rows & (codes >= 0)]):
            here = codes == code
            if len(of := set(split[here & kept])) == 1:
                split[here & open_rows] = of.pop()
                open_rows = open_rows & ~here
    return replace_column(merged, "split", split.tolist())
