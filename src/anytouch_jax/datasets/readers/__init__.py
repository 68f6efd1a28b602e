"""Readers: a public dataset on disk becomes a manifest. `READERS` lists them, `index` runs one."""

from __future__ import annotations

import difflib
import os
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import is_remote
from anytouch_jax.data.manifest.manifest import Manifest, replace_column
from anytouch_jax.data.manifest.schema import PATHS, SPLITS, is_manifest, table_suffix
from anytouch_jax.datasets.readers.common import (
    DatasetError,
    DatasetIndex,
    DatasetReader,
    IndexOptions,
)
from anytouch_jax.datasets.readers.table import READERS
from anytouch_jax.errors import UserError

__all__ = [
    "READERS",
    "DatasetError",
    "DatasetIndex",
    "DatasetReader",
    "IndexOptions",
    "IndexReport",
    "index",
]

# in the schema of a Parquet file: the content hash with which `index` wrote it
_INDEX_KEY = b"anytouch.index"
_OTHER_OUT = "name another file with --out, in a folder that contains the data"
# columns that come from the files, never from the user
_FROM_FILES = ("path", "sequence", "frame_index", "stride")


@dataclass(frozen=True)
class IndexReport:
    """One run of `index`: its manifest `out`, the skipped files (reason -> count, example),
    sentences for the user.
    """

    reader: DatasetReader
    out: Path
    manifest: Manifest
    skipped: dict[str, tuple[int, str]]
    notes: list[str]
    left_out: int = 0  # frames without a row
    written: int = 0  # images that were written into ROOT

    @property
    def splits(self) -> dict[str, int]:
        """Rows of each split."""
        counts = Counter(self.manifest.table["split"].to_pylist())
        return {split: counts[split] for split in SPLITS if counts[split]}

    @property
    def sensors(self) -> dict[str, int]:
        """Rows of each sensor."""
        return dict(sorted(Counter(self.manifest.table["sensor"].to_pylist()).items()))

    @property
    def frames(self) -> int:
        """Touch frames: rows that are neither background nor unused."""
        return sum(
            count for split, count in self.splits.items() if split not in ("background", "unused")
        )

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        reader = self.reader
        manifest = self.manifest
        splits = ", ".join(f"{name} {count:,}" for name, count in self.splits.items())
        image, text, touch = (
            int(manifest.present(name).sum()) for name in ("image_path", "text", "touch")
        )
        labels = [name for name in manifest.table.column_names if name.startswith("label.")]
        found = ", ".join(
            f"{name.removeprefix('label.')} {manifest.present(name).sum():,}" for name in labels
        )
        fraction = f" ({reader.paper_note})" if reader.paper_note else ""
        paper = (
            f"{reader.paper:,} in the paper{fraction}" if reader.paper else "no count in the paper"
        )
        use = (
            "commercial use allowed"
            if reader.commercial
            else "no commercial use unless its owner allows it"
        )
        return [
            f"{self.out}: {len(manifest):,} rows of {manifest.codes('sequence').max() + 1:,} "
            f"sequences ({splits})",
            "sensors: " + ", ".join(f"{name} {count:,}" for name, count in self.sensors.items()),
            f"frames read {len(manifest) + self.left_out:,}, rows {len(manifest):,}, without a row "
            f"{self.left_out:,}",
            f"touch frames {self.frames:,}; {paper}",
            f"with RGB image {image:,}, with text {text:,}, in a touch pair {touch:,}",
            *([f"labels found: {found}"] if found else []),
            f"licence: {reader.license}; {use}" + (f" ({reader.url})" if reader.url else ""),
            f"to be cited: {reader.citation}",
            *(
                f"left out or noted, {reason}: {count:,} (first: {example})"
                for reason, (count, example) in self.skipped.items()
            ),
            *(f"note: {sentence}" for sentence in self.notes),
            f"content hash {manifest.content_hash}",
        ]


def index(
    name: str,
    root: str | Path,
    out: str | Path | None = None,
    *,
    options: IndexOptions | None = None,
    keep: bool = False,
) -> IndexReport:
    """Read the dataset `name` in the folder `root` and write its manifest to `out`.

    By default that is ROOT/<name>.parquet, or, for a reader of files whose `root` is one of them,
    a file of its name beside it.

    `out` must be in `root` or above it, because a manifest's paths may not leave its folder. With
    `keep` an edited manifest at `out` keeps its columns and values. Raises UserError for a folder
    that is not the dataset and for an option that the reader does not use. It also does so if the
    manifest cannot be written, or if edits would be lost.

    Args:
        name: the reader.
        root: the dataset's folder, or for a reader of files one of them.
        out: the manifest, in `root` or above it. By default ROOT/<name>.parquet, or beside a
            file one of its name.
        options: sensor, split and what else the reader uses.
        keep: keep the columns and values of an edited manifest at `out`.
    """
    if name not in READERS:
        near = difflib.get_close_matches(name.lower().replace("-", "_"), READERS, 1, 0.4)
        guess = f"; did you mean {near[0]}?" if near else "."
        raise UserError(f"no reader is called {name!r}{guess} There are: {', '.join(READERS)}")
    reader = READERS[name]
    options = options or IndexOptions()
    base = Path(root).expanduser().resolve()
    file = None
    if base.name.lower().endswith(reader.files) and base.exists():
        file = base.name
        base = base.parent
        if file.encode(errors="ignore").decode() != file:
            raise UserError(
                f"the name {file!r} is not UTF-8, and a manifest holds no other text; rename this "
                "file"
            )
    if not base.is_dir():
        problem = f"{base} is a file" if base.exists() else f"there is no folder {base}"
        endings = f", or a file {', '.join(reader.files)}" if reader.files else ""
        raise UserError(f"{problem}; ROOT is the folder that holds the dataset {name}{endings}")
    for field in fields(IndexOptions):
        if field.name not in reader.uses and getattr(options, field.name) != field.default:
            uses = ", ".join(reader.uses) or "no option"
            raise UserError(
                f"the reader {name} does not use the option {field.name}; it uses {uses}"
            )
    lists = options.lists and options.lists.expanduser()
    if lists is not None and not lists.is_dir():
        raise UserError(
            f"there is no folder {lists}; --lists is the folder that holds the dataset's lists"
        )
    stem = name if file is None else file.partition(".")[0] or name
    target = _target(base, stem, out)
    rows = DatasetIndex(name, base, replace(options, lists=lists), file)
    reader.read(rows)
    rows.note_on_few()
    columns = rows.columns()
    size = len(columns["path"])
    if not size:
        reasons = "; ".join(
            f"{reason}: {count} (first: {first})" for reason, (count, first) in rows.skipped.items()
        )
        raise DatasetError(
            f"{base} has no frame of {name} that could be used: expected {reader.layout} in it; is "
            f"ROOT the folder that holds {reader.layout.split('/')[0]!r}? Left out: "
            f"{reasons or 'nothing'}"
        )
    constant = {"dataset": name, "license": reader.license, "commercial": reader.commercial}
    columns |= {key: [value] * size for key, value in constant.items() if key not in columns}
    above = base.relative_to(target.parent)
    for column in set(PATHS) & columns.keys() if above != Path() else ():
        columns[column] = [
            p and (p if is_remote(p) else f"{above.as_posix()}/{p}") for p in columns[column]
        ]
    manifest = manifests.from_columns(columns, target)
    manifest.clips(2)  # raises for a repeated frame
    _check_links(manifest, base)
    manifest = _carry_over(manifest, target, rows.notes, keep=keep, groups=rows.keep_together)
    try:
        marked = manifest.table.replace_schema_metadata(
            {_INDEX_KEY: manifest.content_hash.encode()}
        )
        manifests.write(replace(manifest, table=marked), target)
    except OSError as error:
        raise UserError(
            f"the manifest {target} cannot be written: {error.strerror}; {_OTHER_OUT}"
        ) from None
    rows.notes += [sentence for _, sentence, _ in manifests.misspelt_sensors(manifest)]
    skipped = dict(sorted(rows.skipped.items()))
    return IndexReport(reader, target, manifest, skipped, rows.notes, rows.left_out, rows.written)


def _target(base: Path, name: str, out: str | Path | None) -> Path:
    target = Path(out).expanduser().resolve() if out is not None else base / f"{name}.parquet"
    table_suffix(target)
    if not base.is_relative_to(target.parent):
        raise UserError(
            f"the manifest {target} must lie in {base} or in a folder above it, because its paths "
            "may not leave its folder; leave out --out, or move the data"
        )
    if name == "real_touch" and target == base / "manifest.csv":
        raise UserError(f"{target} is the pack's own manifest; name another file with --out")
    if target.exists() and not is_manifest(target):
        raise UserError(
            f"{target} exists and is no manifest; name another file with --out, or remove it"
        )
    if not os.access(target.parent, os.W_OK):
        raise UserError(
            f"the manifest {target} cannot be written: {target.parent} is read-only; {_OTHER_OUT}"
        )
    return target


def _check_links(manifest: Manifest, base: Path) -> None:
    """Raise UserError for a folder that is a link out of ROOT, because none of its rows could be
    read.
    """
    root = manifest.files[0].parent
    paths = (
        path for name in PATHS for path in manifest.column(name).unique().drop_null().to_pylist()
    )
    for folder in dict.fromkeys(path.rpartition("/")[0] for path in paths if not is_remote(path)):
        place = (root / folder).resolve()
        if not place.is_relative_to(root.resolve()):
            raise UserError(
                f"{root / folder} leads out of {base}, to {place}; give the folder that really "
                "holds it"
            )


def _carry_over(
    new: Manifest, target: Path, notes: list[str], *, keep: bool, groups: Collection[str]
) -> Manifest:
    """Return the manifest to write over `target`: `new`, with the values of `target` by `path` if
    `keep`.

    A row that still exists keeps every value except those of _FROM_FILES. Empty cells and new rows
    get the reader's values, but a new row gets the split of its group (columns `groups`) if the
    kept rows of it agree. Without `keep`, raises UserError for an edited `target`: it has a column
    that `new` lacks, or another value in a row of one path.
    """
    if not target.exists():
        return new
    old = manifests.read(target)
    # which holds the content hash that `index` wrote
    is_parquet = target.suffix.lower() == ".parquet"
    written = (
        (pa.parquet.read_schema(target).metadata or {}).get(_INDEX_KEY) if is_parquet else None
    )
    if not keep and written == old.content_hash.encode():
        return new
    at = pc.index_in(
        new.column("path").combine_chunks(), value_set=old.column("path").combine_chunks()
    )
    merged = new
    edits = []
    for name in (column for column in old.table.column_names if column not in _FROM_FILES):
        before = old.column(name).take(at)
        is_new = name not in new.table.column_names
        now = pa.chunked_array([pa.nulls(len(new), before.type)]) if is_new else new.column(name)
        if before.type != now.type:  # 1 in a CSV may be "1" elsewhere
            before = before.cast(pa.string())
            now = now.cast(pa.string())
        differs = np.asarray(
            pc.and_(pc.is_valid(before), pc.invert(pc.fill_null(pc.equal(before, now), False)))
        )
        if differs.any():
            edits.append(name if is_new else f"other values of {name} ({differs.sum()} rows)")
            merged = replace_column(merged, name, pc.coalesce(before, now))
    if edits and not keep:
        raise UserError(
            f"{target} has {', '.join(edits)}, which index does not write: give another --out, "
            "pass --keep to carry them over by path, or remove it"
        )
    if edits:
        notes.append(f"kept from {target.name} by path: {', '.join(edits)}")
    if keep:
        return _with_splits_of_groups(merged, np.asarray(pc.is_valid(at)), groups)
    return merged


def _with_splits_of_groups(
    merged: Manifest, is_old: np.ndarray, groups: Collection[str]
) -> Manifest:
    """Give new rows of a group the one split of its old rows, so that no group comes to be in two
    splits.
    """
    split = np.array(merged.column("split").to_pylist(), object)
    is_open = ~is_old
    for group in groups:
        codes = merged.codes(group)
        for code in np.unique(codes[is_open & (codes >= 0)]):
            in_group = codes == code
            if len(splits := set(split[in_group & is_old])) == 1:
                split[in_group & is_open] = splits.pop()
                is_open = is_open & ~in_group
    return replace_column(merged, "split", split.tolist())
