"""The ball presses in the Python package `taxim`: real frames of a GelSight and a GelSight Mini.

Layout (taxim 1.4.1, MIT): `calib/{gelsight,gelsight_mini}/dataPack.npz` with `f0` (the untouched gel), `imgs` (48 and
24 presses of a steel ball, BGR u8 480 x 640), `touch_center` and `touch_radius` (pixels). The reader first writes these
arrays as PNG into ROOT/taxim_presses, where an existing file stays. It reads the files of the package and does not
import it; `lists` may name another `calib` folder.

Every press is a sequence, split by hash. The radius is that of the contact disc in the picture.
"""

from __future__ import annotations

import importlib.metadata
import zipfile
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader
from anytouch_jax.files import atomic_write

FOLDER = "taxim_presses"  # in ROOT


def read(index: DatasetIndex) -> None:
    """Write the presses as pictures and add them. Raises DatasetError if the package is not installed."""
    calib = index.options.lists or _installed_calib()
    for sensor in ("gelsight", "gelsight_mini"):
        path, place = calib / sensor / "dataPack.npz", f"{FOLDER}/{sensor}"
        if not path.is_file():
            index.skip("sensor without dataPack.npz", str(path))
            continue
        try:
            with np.load(path, allow_pickle=False) as pack:
                gel, images, centres, radii = (pack[key] for key in ("f0", "imgs", "touch_center", "touch_radius"))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DatasetError(f"{path} is not a calibration pack of taxim: {error}") from None
        names = [f"press_{i:02d}" for i in range(len(images))]
        for name, image in zip(("background", *names), (gel, *images), strict=True):
            _save(index.root / place / f"{name}.png", image)
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


def _installed_calib() -> Path:
    try:
        calib = Path(str(importlib.metadata.distribution("taxim").locate_file("taxim/calib")))
    except importlib.metadata.PackageNotFoundError:
        raise DatasetError("the package taxim is not installed; run pip install taxim") from None
    if not calib.is_dir():
        raise DatasetError(f"the installed package taxim has no folder {calib}; name its calib folder with --lists")
    return calib


def _save(path: Path, image: np.ndarray) -> None:
    """Write a BGR picture as PNG unless it exists."""
    if not path.is_file():
        atomic_write(path, cv2.imencode(".png", image)[1].tobytes(), sync=False)


READER = DatasetReader(
    read,
    license="MIT",
    url="https://pypi.org/project/taxim",
    citation="Si and Yuan, Taxim: An Example-Based Simulation Model for GelSight Tactile Sensors, RA-L 2022",
    uses=("val", "test", "lists"),
)
