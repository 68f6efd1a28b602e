"""real_touch: a small pack of real frames from public repositories, which comes with a manifest in this schema.

Seen whole: `manifest.csv` with every frame and background, and the files. The reader checks the manifest and that
every file it names is there, and writes it anew. Splits, touches and licences are the pack's own (everything under
`nc/` is non-commercial); `label.contact_score` is computed by the pack, no ground truth.
"""

from __future__ import annotations

from pathlib import Path

import pyarrow.compute as pc

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.readers.common import Columns, DatasetError, DatasetReader, IndexOptions, Notes, walk


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """The pack's own rows. Raises DatasetError without manifest.csv, ManifestError when it is broken."""
    del options
    if not (root / "manifest.csv").is_file():
        raise DatasetError(f"expected manifest.csv in {root}; is ROOT the folder that holds it?")
    table = manifests.read(root / "manifest.csv").table
    there = {f"{folder}/{name}" if folder else name for folder, _, files in walk(root, Notes()) for name in files}
    here = [path in there for path in table["path"].to_pylist()]
    for path, one in zip(table["path"].to_pylist(), here, strict=True):
        notes.skip("file of the manifest that is not on disk", path, not one)
    columns: Columns = {name: pc.filter(table[name], here).to_pylist() for name in table.column_names}
    for name in set(manifests.PATHS[1:]) & columns.keys():
        lost = [path is not None and path not in there for path in columns[name]]
        notes.skip(f"{name} that is not on disk (kept without)", name, sum(lost))
        columns[name] = [None if gone else path for gone, path in zip(lost, columns[name], strict=True)]
    return columns


READER = DatasetReader(
    name="real_touch",
    read=read,
    sensor="gelsight_mini, gelslim, digit, 9dtact, allsight",
    license="by row",
    commercial=False,
    about="a small pack of real frames: slip clips, ball presses, backgrounds",
    url="",
    citation="the sources named in the pack's read-me",
    uses=(),
)
