"""Small packs of pictures that need no layout: `real_touch` has a manifest, the Python package `taxim` has arrays."""

from __future__ import annotations

import importlib.metadata
import zipfile
from pathlib import Path

import numpy as np
import pyarrow.compute as pc

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.schema import PATHS
from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader
from anytouch_jax.data.readers.exports import exported


def _real_touch(index: DatasetIndex) -> None:
    """Real frames from public repositories. The reader checks `manifest.csv` and that every file in it exists.

    Splits, touches and licences are the pack's own (everything under `nc/` is non-commercial). `label.contact_score` is
    computed by the pack and is no ground truth. Raises ManifestError for a broken manifest.
    """
    if not (index.root / "manifest.csv").is_file():
        return
    table = manifests.read(index.root / "manifest.csv").table
    on_disk = {f"{folder}/{name}".lstrip("/") for folder, _, files in index.walk(count=False) for name in files}
    exists = [path in on_disk for path in table["path"].to_pylist()]
    gone = [path for path in table["path"].to_pylist() if path not in on_disk]
    index.skip("file of the manifest that is not on disk", "".join(gone[:1]), len(gone))
    columns = {name: pc.filter(table[name], exists).to_pylist() for name in table.column_names}
    for name in set(PATHS[1:]) & columns.keys():
        missing = [path is not None and path not in on_disk for path in columns[name]]
        index.skip(f"{name} that is not on disk (kept without)", name, sum(missing))
        columns[name] = [None if gone else path for gone, path in zip(missing, columns[name], strict=True)]
    index.add(columns.pop("path"), **columns)


def _taxim_presses(index: DatasetIndex) -> None:
    """Ball presses on a GelSight and a GelSight Mini, in the package `taxim` (1.4.1), which is read and not imported.

    `calib/{gelsight,gelsight_mini}/dataPack.npz` has `f0`, the untouched gel, and `imgs`, 48 and 24 presses of a steel
    ball, BGR u8 480 x 640. `touch_center` and `touch_radius` are those of the contact disc, in pixels. Pictures are
    written as PNG into ROOT/taxim_presses, where an existing file stays. `lists` may name another `calib` folder.
    Every press is a sequence, split by hash. Raises DatasetError if the package is not installed.
    """
    calib = index.options.lists
    if calib is None:
        try:
            calib = Path(str(importlib.metadata.distribution("taxim").locate_file("taxim/calib")))
        except importlib.metadata.PackageNotFoundError:
            raise DatasetError("the package taxim is not installed; run pip install taxim") from None
    for sensor in ("gelsight", "gelsight_mini"):
        path, place = calib / sensor / "dataPack.npz", f"taxim_presses/{sensor}"
        if not path.is_file():
            index.skip("sensor without dataPack.npz", str(path))
            continue
        try:
            with np.load(path, allow_pickle=False) as pack:
                gel, images, centres, radii = (pack[key] for key in ("f0", "imgs", "touch_center", "touch_radius"))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DatasetError(f"{path} is not a calibration pack of taxim: {error}") from None
        names = [f"press_{i:02d}" for i in range(len(images))]
        with exported(index, place, sensor, [path]) as pictures:
            for name, image in zip(("background", *names), (gel, *images), strict=True):
                pictures.save(f"{name}.png", image[..., ::-1])
        place = pictures.folder
        cells = {"sensor": sensor, "unit": f"taxim/{sensor}", "frame_index": 0}
        index.add(
            [f"{place}/{name}.png" for name in names],
            **cells,
            object="ball",
            sequence=[f"{sensor}/{name}" for name in names],
            split=[index.split_of(f"{sensor}/{name}") for name in names],
            background_path=f"{place}/background.png",
            **{"label.contact": 1, "label.radius_px": [float(r) for r in radii],
               "label.x_px": [float(x) for x, _ in centres], "label.y_px": [float(y) for _, y in centres]},
        )  # fmt: skip
        index.add([f"{place}/background.png"], **cells, sequence=f"{sensor}/background", split="background",
                  **{"label.contact": 0})  # fmt: skip


READERS = {
    "real_touch": DatasetReader(
        _real_touch, "manifest.csv", "the sources named in the pack's read-me", "by row", uses=()
    ),
    "taxim_presses": DatasetReader(
        _taxim_presses,
        "dataPack.npz in the folder calib of the package taxim",
        "Si and Yuan, Taxim: An Example-Based Simulation Model for GelSight Tactile Sensors, RA-L 2022",
        "MIT",
        "https://pypi.org/project/taxim",
        uses=("val", "test", "lists"),
    ),
}
