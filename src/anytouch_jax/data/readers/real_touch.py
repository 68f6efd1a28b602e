"""real_touch: a small pack of real frames from public repositories, which has a manifest in this schema.

The reader checks `manifest.csv` and that every file in it exists. Splits, touches and licences are the pack's own
(everything under `nc/` is non-commercial). `label.contact_score` is computed by the pack and is no ground truth.
"""

from __future__ import annotations

import pyarrow.compute as pc

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.schema import PATHS
from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader


def read(index: DatasetIndex) -> None:
    """Add the pack's rows. Raises DatasetError without manifest.csv, ManifestError if it is broken."""
    root = index.root
    if not (root / "manifest.csv").is_file():
        raise DatasetError(f"expected manifest.csv in {root}; is ROOT the folder that holds it?")
    table = manifests.read(root / "manifest.csv").table
    walked = index.walk(root, count=False)
    on_disk = {f"{folder}/{name}" if folder else name for folder, _, files in walked for name in files}
    exists = [path in on_disk for path in table["path"].to_pylist()]
    for path, found in zip(table["path"].to_pylist(), exists, strict=True):
        index.skip("file of the manifest that is not on disk", path, not found)
    columns = {name: pc.filter(table[name], exists).to_pylist() for name in table.column_names}
    for name in set(PATHS[1:]) & columns.keys():
        missing = [path is not None and path not in on_disk for path in columns[name]]
        index.skip(f"{name} that is not on disk (kept without)", name, sum(missing))
        columns[name] = [None if gone else path for gone, path in zip(missing, columns[name], strict=True)]
    index.add(columns.pop("path"), **columns)


READER = DatasetReader(
    read,
    license="by row",
    citation="the sources named in the pack's read-me",
    uses=(),
)
