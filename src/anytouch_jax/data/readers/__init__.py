"""Readers: a public dataset on disk becomes a manifest. `READERS` names them all, `index` runs one."""

from __future__ import annotations

import difflib
import os
from collections import Counter
from dataclasses import dataclass, fields, replace
from pathlib import Path

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.schema import PATHS, SPLITS, is_manifest
from anytouch_jax.data.readers import (
    before,
    cloth,
    feel,
    objectfolder,
    objectfolder_real,
    octopi,
    real_touch,
    recordings,
    ssvtp,
    tacquad,
    taxim_presses,
    touch_and_go,
    tvl,
    visgel,
    ycb_slide,
)
from anytouch_jax.data.readers.common import Columns, DatasetError, DatasetReader, IndexOptions, Notes
from anytouch_jax.errors import UserError

__all__ = [
    "READERS",
    "Columns",
    "DatasetError",
    "DatasetReader",
    "IndexOptions",
    "IndexReport",
    "Notes",
    "get_reader",
    "index",
]

READERS: dict[str, DatasetReader] = {
    "touch_and_go": touch_and_go.READER,
    "visgel": visgel.READER,
    "cloth": cloth.READER,
    "objectfolder_real": objectfolder_real.READER,
    "tvl": tvl.READER,
    "ssvtp": ssvtp.READER,
    "ycb_slide": ycb_slide.READER,
    "octopi": octopi.READER,
    "tacquad": tacquad.READER,
    "feel": feel.READER,
    "objectfolder": objectfolder.READER,
    "real_touch": real_touch.READER,
    "taxim_presses": taxim_presses.READER,
    "recordings": recordings.READER,
}


@dataclass(frozen=True)
class IndexReport:
    """What one run of `index` found: counts, what was skipped (reason -> count, example), and sentences to say."""

    name: str
    out: Path
    rows: int
    sequences: int
    splits: dict[str, int]
    sensors: dict[str, int]
    frames: int
    paper: int | None
    paper_note: str
    with_image: int
    with_text: int
    with_touch: int
    license: str
    citation: str
    commercial: bool
    skipped: dict[str, tuple[int, str]]
    notes: list[str]
    content_hash: str

    def lines(self) -> list[str]:
        """The report as lines of text."""
        counts = ", ".join(f"{name} {count:,}" for name, count in self.splits.items())
        share = f" ({self.paper_note})" if self.paper_note else ""
        paper = f"{self.paper:,} in the paper{share}" if self.paper else "no count in the paper"
        use = "commercial use allowed" if self.commercial else "not for commercial use unless its owner allows it"
        return [
            f"{self.out}: {self.rows:,} rows of {self.sequences:,} sequences ({counts})",
            "sensors: " + ", ".join(f"{name} {count:,}" for name, count in self.sensors.items()),
            f"touch frames {self.frames:,}; {paper}",
            f"with photograph {self.with_image:,}, with text {self.with_text:,}, in a touch pair {self.with_touch:,}",
            f"licence: {self.license}; {use}",
            f"to be cited: {self.citation}",
            *(f"left out or noted, {reason}: {count:,} (first: {one})" for reason, (count, one) in
              self.skipped.items()),
            *(f"note: {sentence}" for sentence in self.notes),
            f"content hash {self.content_hash}",
        ]  # fmt: skip


def get_reader(name: str) -> DatasetReader:
    """The reader called `name`. Raises UserError with the nearest names."""
    if name not in READERS:
        near = difflib.get_close_matches(name.lower().replace("-", "_"), READERS, 1, 0.4)
        guess = f"; did you mean {near[0]}?" if near else ""
        raise UserError(f"no reader is called {name!r}{guess} There are: {', '.join(READERS)}")
    return READERS[name]


def index(
    name: str,
    root: str | Path,
    out: str | Path | None = None,
    *,
    options: IndexOptions | None = None,
    keep: bool = False,
) -> IndexReport:
    """Read the dataset `name` in the folder `root` and write its manifest to `out` (default: ROOT/<name>.parquet).

    `out` lies in `root` or above it: a manifest's paths may not leave its folder. `keep`: an edited manifest there
    keeps its columns and values (see before.py). Raises UserError for a folder that is not the dataset, an option the
    reader does not heed, a manifest that cannot be written there, and an edited one that would be lost.
    """
    one, options = get_reader(name), options or IndexOptions()
    base = Path(root).expanduser().resolve()
    if not base.is_dir():
        what = f"{base} is a file" if base.exists() else f"there is no folder {base}"
        raise UserError(f"{what}; ROOT is the folder that holds the dataset {name}")
    _refuse_unused(one, options)
    if options.lists is not None:
        options = replace(options, lists=(lists := options.lists.expanduser()))
        if not lists.is_dir():
            raise UserError(f"there is no folder {lists}; --lists is the folder that holds the dataset's lists")
    target = _target(base, name, out)
    notes = Notes()
    columns = one.read(base, options, notes)
    size = len(columns["path"])
    if not size:
        reasons = "; ".join(f"{reason}: {count} (first: {where})" for reason, (count, where) in notes.skipped.items())
        raise DatasetError(f"{base} has no frame of {name} that could be used. Left out: {reasons or 'nothing'}")
    constant = {"dataset": one.name, "license": one.license, "commercial": one.commercial}
    columns |= {key: [value] * size for key, value in constant.items() if key not in columns}
    manifest = manifests.from_columns(_below(columns, base, target.parent), target)
    manifest.clips(2)  # raises for a frame that is there twice
    _refuse_links(manifest, base)
    whole = ("sequence",) if options.split_by == "recording" else ("sequence", "object")
    manifest = before.carry(manifest, target, notes, keep=keep, groups=whole)
    try:
        manifests.write(before.marked(manifest), target)
    except OSError as error:
        raise UserError(
            f"the manifest {target} cannot be written: {error.strerror}; name another file with --out, in a folder "
            "that contains the data"
        ) from None
    for _, sentence, _ in manifests.misspelt_sensors(manifest):
        notes.log(sentence)
    return _report(one, target, manifest, notes)


def _refuse_links(manifest: manifests.Manifest, base: Path) -> None:
    """Raise UserError for a folder that is a link out of ROOT: no row of it could ever be read."""
    found = (path for name in PATHS for path in manifest.column(name).unique().drop_null().to_pylist())
    for folder in dict.fromkeys(path.rpartition("/")[0] for path in found):
        place = manifest.files[0].parent / folder
        if not place.resolve().is_relative_to(manifest.files[0].parent.resolve()):
            raise UserError(
                f"{place} leads out of {base}, to {place.resolve()}; give the folder that really holds it as ROOT"
            )


def _refuse_unused(one: DatasetReader, options: IndexOptions) -> None:
    for field in fields(IndexOptions):
        if field.name not in one.uses and getattr(options, field.name) != field.default:
            heeds = ", ".join(one.uses) or "no option"
            raise UserError(f"the reader {one.name} does not use the option {field.name}; it uses {heeds}")


def _target(base: Path, name: str, out: str | Path | None) -> Path:
    target = Path(out).expanduser().resolve() if out is not None else base / f"{name}.parquet"
    if target.suffix.lower() not in (".csv", ".parquet"):
        raise UserError(f"{target}: a manifest ends in .csv or .parquet")
    if not base.is_relative_to(target.parent):
        raise UserError(
            f"the manifest {target} must lie in {base} or in a folder above it, because its paths may not leave its "
            "folder; leave --out away, or move the data"
        )
    if name == "real_touch" and target == base / "manifest.csv":
        raise UserError(f"{target} is the pack's own manifest; name another file with --out")
    if target.exists() and not is_manifest(target):
        raise UserError(f"{target} is there and is no manifest; name another file with --out, or remove it")
    if not os.access(target.parent, os.W_OK):
        raise UserError(
            f"the manifest {target} cannot be written: {target.parent} is read-only; name another file with --out, in "
            "a folder that contains the data"
        )
    return target


def _below(columns: Columns, base: Path, folder: Path) -> Columns:
    """Paths relative to `folder`, which is `base` or above it."""
    prefix = base.relative_to(folder).as_posix()
    if prefix == ".":
        return columns
    paths = {name: [one and f"{prefix}/{one}" for one in columns[name]] for name in PATHS if name in columns}
    return columns | paths


def _report(one: DatasetReader, target: Path, manifest: manifests.Manifest, notes: Notes) -> IndexReport:
    splits = Counter(manifest.table["split"].to_pylist())
    return IndexReport(
        name=one.name,
        out=target,
        rows=len(manifest),
        sequences=int(manifest.codes("sequence").max()) + 1,
        splits={split: splits[split] for split in SPLITS if splits[split]},
        sensors=dict(sorted(Counter(manifest.table["sensor"].to_pylist()).items())),
        frames=len(manifest) - splits["background"] - splits["unused"],
        paper=one.paper,
        paper_note=one.paper_note,
        with_image=int(manifest.present("image_path").sum()),
        with_text=int(manifest.present("text").sum()),
        with_touch=int(manifest.present("touch").sum()),
        license=one.license,
        citation=one.citation,
        commercial=one.commercial,
        skipped=dict(sorted(notes.skipped.items())),
        notes=notes.said,
        content_hash=manifest.content_hash,
    )
