"""Real recordings of a GelSight Mini with dots: rows of a manifest, and what three questions ask of
them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest, replace_column, select_rows

SET = "incipient_slip-gelsight_mini_markers"
Untouched = Literal["rule", "median", "first frame"]


@dataclass(frozen=True)
class Recordings:
    """Frames as rows of `manifest`, and one value of every column a frame.

    `data` is the hash of the whole pack.
    """

    manifest: Manifest
    recording: np.ndarray
    finger: np.ndarray
    split: np.ndarray
    fold: np.ndarray
    object: np.ndarray
    slip: np.ndarray
    data: str = field(default="")

    @cached_property
    def backgrounds(self) -> Backgrounds:
        """The untouched gel of every frame."""
        return Backgrounds(self.manifest)

    @cached_property
    def names(self) -> np.ndarray:
        """The objects, sorted."""
        return np.unique(self.object)

    def pairs(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield every frame u8 RGB (h, w, 3) with its untouched gel."""
        gel = self.backgrounds.shared(lambda image: image)
        for row in range(len(self.manifest)):
            image = gel(row)
            assert image is not None
            yield decode(self.manifest.file(row)), image


def read(path: str | Path, untouched: Untouched = "rule") -> Recordings:
    """Read all rows of the gripper from the manifest of the pack. Raises UserError.

    `untouched`: what is taken for the untouched gel. "rule" is that of the package, the unit's own
    image, or the median of its frames. "median" is this median everywhere, and "first frame" that
    of the recording.
    """
    whole = manifests.read(path)
    rows = (whole.text_column("dataset") == SET) & (whole.text_column("split") != "background")
    manifest = select_rows(whole, np.flatnonzero(rows))
    if untouched != "rule":
        files = manifest.text_column("path")
        sequence = manifest.codes("sequence", own=True)
        order = np.lexsort((manifest.number_column("frame_index"), sequence))
        first = files[order[np.searchsorted(sequence[order], sequence)]].tolist()
        manifest = replace_column(
            manifest, "background_path", first if untouched != "median" else [None] * len(first)
        )
    recording, unit, split, thing = map(
        manifest.text_column, ("recording", "unit", "split", "label.object")
    )
    fold, slip = (
        manifest.number_column(name).astype(int) for name in ("object_fold", "label.slip")
    )
    finger = np.array([name[:4] for name in unit])
    return Recordings(manifest, recording, finger, split, fold, thing, slip, whole.content_hash)
