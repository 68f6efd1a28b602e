"""Real recordings of a GelSight Mini with dots: frames, backgrounds, and three questions about them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.manifest import manifest as manifests

SET = "incipient_slip-gelsight_mini_markers"


@dataclass(frozen=True)
class Recordings:
    """Frames u8 RGB (n, h, w, 3), a background for each, and one value of every column a frame.

    `background` numbers a row of `backgrounds`. A frame without a background of its unit gets the first frame of its
    sequence: that is what `Preprocess` does with a camera.
    """

    frames: np.ndarray
    backgrounds: np.ndarray
    background: np.ndarray
    recording: np.ndarray
    finger: np.ndarray
    split: np.ndarray
    fold: np.ndarray
    object: np.ndarray
    slip: np.ndarray
    content_hash: str

    @cached_property
    def names(self) -> np.ndarray:
        """The objects, sorted."""
        return np.unique(self.object)


def read(path: str | Path) -> Recordings:
    """Read all frames of the gripper from the manifest of the pack. Raises UserError."""
    manifest = manifests.read(path)
    columns = {name: np.array(manifest.column(name).to_pylist(), object) for name in (
        "path", "dataset", "split", "sequence", "frame_index", "recording", "object_fold", "label.object", "label.slip",
        "unit", "background_path",
    )}  # fmt: skip
    rows = np.flatnonzero((columns["dataset"] == SET) & (columns["split"] != "background"))
    root = Path(path).parent
    pictures: dict[str, int] = {}
    first: dict[str, str] = {}
    for row in sorted(rows, key=lambda row: int(columns["frame_index"][row])):
        first.setdefault(columns["sequence"][row], columns["path"][row])
    background = []
    for row in rows:
        name = columns["background_path"][row] or first[columns["sequence"][row]]
        background.append(pictures.setdefault(name, len(pictures)))

    def picture(name: str) -> np.ndarray:
        return cv2.cvtColor(cv2.imread(str(root / name), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)

    take = {name: values[rows] for name, values in columns.items()}
    return Recordings(
        np.stack([picture(name) for name in take["path"]]), np.stack([picture(name) for name in pictures]),
        np.array(background), take["recording"].astype(str), np.array([unit[:4] for unit in take["unit"]]),
        take["split"].astype(str), take["object_fold"].astype(int), take["label.object"].astype(str),
        take["label.slip"].astype(int), manifest.content_hash,
    )  # fmt: skip
