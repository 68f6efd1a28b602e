"""Datasets of tiny images, laid out like the originals."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.datasets.readers import IndexReport

PIXELS = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
BYTES = {ending: cv2.imencode(ending, PIXELS)[1].tobytes() for ending in (".png", ".jpg")}


def fill(root: Path, files: Iterable[str]) -> None:
    """Write a tiny image to each of `files` under `root`."""
    for name in files:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(BYTES[path.suffix])


def fill_ycb(root: Path, objects: Iterable[str] = ("mug",), frames: int = 4) -> None:
    """Write YCB-Slide with one recording of each object."""
    fill(
        root,
        [
            f"real/{name}/dataset_0/frames/frame_{i:07d}.jpg"
            for name in objects
            for i in range(frames)
        ],
    )


class Table:
    """A written manifest, read back: columns as lists, rows by path."""

    def __init__(self, report: IndexReport) -> None:
        self.report = report
        self.manifest = manifests.read(report.out)
        self.rows = {row["path"]: row for row in self.manifest.table.to_pylist()}

    def __getitem__(self, name: str) -> list:
        return self.manifest.column(name).to_pylist()

    def clips(self, length: int = 3) -> list[list[str]]:
        paths = self["path"]
        return [[paths[i] for i in clip] for clip in self.manifest.clips(length)]

    @property
    def reasons(self) -> dict[str, int]:
        return {reason: count for reason, (count, _) in self.report.skipped.items()}


def check_laws(table: Table, root: Path) -> None:
    """No sequence in two splits (background and unused are none), frames in order, every path a
    file in its folder.
    """
    parts: dict[str, set[str]] = {}
    last: dict[str, int] = {}
    for row in table.rows.values():
        if row["split"] not in ("background", "unused"):
            parts.setdefault(row["sequence"], set()).add(row["split"])
        assert row["frame_index"] > last.get(row["sequence"], -1), row
        last[row["sequence"]] = row["frame_index"]
    assert all(len(splits) == 1 for splits in parts.values()), parts
    assert len(table.rows) == len(table.manifest)  # no path twice
    for name in ("path", "image_path", "background_path"):
        for row in np.flatnonzero(table.manifest.present(name)):
            assert table.manifest.file(int(row), name).is_file()
    known = {row["dataset"] for row in table.rows.values()}
    assert known and None not in known
    assert all(row["license"] and row["commercial"] is not None for row in table.rows.values())
