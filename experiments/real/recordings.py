"""Real recordings of a GelSight Mini with dots: frames, backgrounds, and three questions about them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from anytouch_jax.data.gels import FRAMES, median
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest, replace_column, select_rows
from anytouch_jax.data.prepare.contact import contact_scores, spread

SET = "incipient_slip-gelsight_mini_markers"
Background = Literal["rule", "median", "ten", "half", "recordings", "all", "own", "first", "estimated"]


@dataclass(frozen=True)
class Recordings:
    """Frames u8 RGB (n, h, w, 3), a background for each, and one value of every column a frame.

    `background` numbers a row of `backgrounds` (see `read`).
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


def read(path: str | Path, background: Background = "own") -> Recordings:
    """Read all frames of the gripper from the manifest of the pack. Raises UserError.

    `background`: what is taken for the untouched gel. "own" is the unit's own picture, and "rule" the same with the
    median of the unit's frames where it is missing, as in the package. "median" is this median everywhere. "all",
    "ten", "half" and "recordings" are other forms of it (`_medians`). "estimated" is what `anytouch data contact`
    finds in the recording alone, and "first" its first frame, which stands in where a picture is missing.
    """
    manifest = manifests.read(path)
    columns = {name: np.array(manifest.column(name).to_pylist(), object) for name in (
        "path", "dataset", "split", "sequence", "frame_index", "recording", "object_fold", "label.object", "label.slip",
        "unit", "background_path",
    )}  # fmt: skip
    rows = np.flatnonzero((columns["dataset"] == SET) & (columns["split"] != "background"))
    root, take = Path(path).parent, {name: values[rows] for name, values in columns.items()}

    def picture(name: str) -> np.ndarray:
        return cv2.cvtColor(cv2.imread(str(root / name), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)

    frames = np.stack([picture(name) for name in take["path"]])
    order = np.lexsort((take["frame_index"].astype(int), take["sequence"].astype(str)))
    sequence = np.unique(take["sequence"].astype(str), return_inverse=True)[1]
    names = [f"frame {order[np.searchsorted(sequence[order], number)]}" for number in sequence]
    pictures = {name: frames[int(name.split()[1])] for name in names}
    if background not in ("own", "estimated", "first"):
        for number, (some, gel) in enumerate(_medians(manifest, rows, frames, background)):
            pictures[f"median {number}"] = gel
            for row in some:
                names[row] = f"median {number}"
    if background in ("own", "rule"):
        names = [own or name for own, name in zip(take["background_path"], names, strict=True)]
        pictures |= {name: picture(name) for name in set(names) - set(pictures)}
    elif background == "estimated":
        for number, (some, gel) in enumerate(_estimated(manifest, rows)):
            pictures[f"gel {number}"] = cv2.resize(gel, frames.shape[2:0:-1], interpolation=cv2.INTER_AREA)
            for row in some:
                names[row] = f"gel {number}"
    several = sorted(set(names))
    return Recordings(
        frames, np.stack([pictures[name] for name in several]), np.searchsorted(several, names),
        take["recording"].astype(str), np.array([unit[:4] for unit in take["unit"]]),
        take["split"].astype(str), take["object_fold"].astype(int), take["label.object"].astype(str),
        take["label.slip"].astype(int), manifest.content_hash,
    )  # fmt: skip


def _medians(
    manifest: Manifest, rows: np.ndarray, frames: np.ndarray, form: str
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield row numbers within `rows` of each unit, and the median of its training frames.

    It is of 100 frames, or of "all", of "ten", of the "half" of 100 with least detail, or of the medians of all
    "recordings".
    """
    units, split, sequence = (manifest.text_column(name)[rows] for name in ("unit", "split", "sequence"))
    for unit in np.unique(units):
        own = np.flatnonzero(units == unit)
        train = own[split[own] == "train"]
        some = spread(train, {"all": len(train), "recordings": len(train), "ten": 10}.get(form, FRAMES))
        pictures = list(frames[some])
        if form == "half":
            detail = [cv2.Laplacian(cv2.GaussianBlur(one, (0, 0), 1.5), cv2.CV_32F).std() for one in pictures]
            pictures = [pictures[i] for i in np.argsort(detail)[: len(pictures) // 2]]
        elif form == "recordings":
            pictures = [median(frames[train[sequence[train] == name]]) for name in np.unique(sequence[train])]
        yield own, median(pictures)


def _estimated(manifest: Manifest, rows: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return row numbers within `rows`, and the untouched gel that is estimated for them without a given picture."""
    bare = replace_column(select_rows(manifest, rows), "background_path", [None] * len(rows))
    return [(some, gel.picture) for some, gel in contact_scores(bare).gels]
