"""The ball presses that the Python package `taxim` carries: real frames of a GelSight and a GelSight Mini.

Seen whole (taxim 1.4.1, MIT): `calib/{gelsight,gelsight_mini}/dataPack.npz` with `f0` (the untouched gel), `imgs`
(48 and 24 presses of a steel ball, BGR u8 480 x 640), `touch_center`, `touch_radius` (pixels). They are arrays, so the
reader writes them as PNG into ROOT/taxim_presses first (an existing file is left alone). The package is not imported,
only its files are read; `lists` may name another `calib` folder.

Every press is a sequence of its own, split by hash. The radius is that of the contact disc seen in the picture.
"""

from __future__ import annotations

import importlib.metadata
import zipfile
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.readers.common import (
    Columns,
    DatasetError,
    DatasetReader,
    IndexOptions,
    Notes,
    RowBuilder,
    hash_split,
)
from anytouch_jax.files import atomic_write

FOLDER = "taxim_presses"


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Write the presses as pictures and list them. Raises DatasetError when the package is not installed."""
    calib = options.lists or _installed()
    rows = RowBuilder(
        "object", "unit", "background_path", "label.contact", "label.radius_px", "label.x_px", "label.y_px"
    )
    for sensor in ("gelsight", "gelsight_mini"):
        path = calib / sensor / "dataPack.npz"
        if not path.is_file():
            notes.skip("sensor without dataPack.npz", str(path))
            continue
        try:
            with np.load(path, allow_pickle=False) as pack:
                empty, images, centres, radii = (pack[key] for key in ("f0", "imgs", "touch_center", "touch_radius"))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DatasetError(f"{path} is not a calibration pack of taxim: {error}") from None
        place = f"{FOLDER}/{sensor}"
        _save(root / place / "background.png", empty)
        names = [f"press_{i:02d}" for i in range(len(images))]
        for name, image in zip(names, images, strict=True):
            _save(root / place / f"{name}.png", image)
        cells = {"sensor": sensor, "unit": f"taxim/{sensor}", "frame_index": 0}
        rows.add(
            [f"{place}/{name}.png" for name in names],
            **cells,
            object="ball",
            sequence=[f"{sensor}/{name}" for name in names],
            split=[hash_split(FOLDER, f"{sensor}/{name}", options) for name in names],
            background_path=f"{place}/background.png",
            **{"label.contact": 1, "label.radius_px": [float(r) for r in radii],
               "label.x_px": [float(x) for x, _ in centres], "label.y_px": [float(y) for _, y in centres]},
        )  # fmt: skip
        rows.add([f"{place}/background.png"], **cells, sequence=f"{sensor}/background", split="background",
                 **{"label.contact": 0})  # fmt: skip
    return rows.columns()


def _installed() -> Path:
    try:
        calib = Path(str(importlib.metadata.distribution("taxim").locate_file("taxim/calib")))
    except importlib.metadata.PackageNotFoundError:
        raise DatasetError("the package taxim is not installed; run pip install taxim") from None
    if not calib.is_dir():
        raise DatasetError(f"the installed package taxim has no folder {calib}; say where its calib is with --lists")
    return calib


def _save(path: Path, image: np.ndarray) -> None:
    """Write a BGR picture as PNG, whole or not at all, unless it is there."""
    if not path.is_file():
        atomic_write(path, cv2.imencode(".png", image)[1].tobytes(), sync=False)


READER = DatasetReader(
    name=FOLDER,
    read=read,
    sensor="gelsight, gelsight_mini",
    license="MIT",
    commercial=True,
    about="real ball presses of the Python package taxim (written as PNG into ROOT)",
    url="https://pypi.org/project/taxim",
    citation="Si and Yuan, Taxim: An Example-Based Simulation Model for GelSight Tactile Sensors, RA-L 2022",
    uses=("val", "test", "lists"),
)
