"""Manifests without images for probing tasks, and features like those of a network."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest

MATERIALS = ("foam", "rubber", "wood", "steel")
TWISTS = ("clockwise", "counterclockwise", "none")
SLIDES = ("none", "right", "down", "left", "up")


def simulated(
    *,
    objects: int = 24,
    each: int = 2,
    sensors: tuple[str, ...] = ("digit", "duragel"),
    frames: int = 5,
    seed: int = 0,
    shared: bool = False,
) -> Manifest:
    """Recordings as the simulator's: deepest in frame 2, slipping most in frame 3; the last quarter
    of objects is test.

    `shared`: every object is in all splits instead.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for thing in range(objects):
        for number in range(each):
            touch = thing * each + number
            push = float(rng.uniform(1, 4))
            split = ("train", "train", "val", "test")[(number if shared else thing) % 4]
            for sensor in sensors:
                for frame in range(frames):
                    rows.append(
                        {
                            "path": f"{touch}-{sensor}-{frame}.png",
                            "sensor": sensor,
                            "unit": f"{sensor}_{touch % 2}",
                            "sequence": f"{touch:04d}-{sensor}",
                            "frame_index": frame,
                            "split": split,
                            "touch": f"{touch:04d}",
                            "object": f"thing {thing}",
                            "label.object": f"thing {thing}",
                            "label.material": MATERIALS[(thing // 4) % len(MATERIALS)],
                            "label.force": push * (0.01, 0.5, 1.0, 0.9, 0.5)[frame % 5],
                            "label.slip": (0.0, 0.1, 0.2, 0.9, 0.6)[frame % 5] * (touch % 3 > 0),
                            "label.twist": TWISTS[touch % 3],
                            "label.slide": SLIDES[touch % 5],
                        }
                    )
    return table(rows)


def table(rows: list[dict[str, Any]]) -> Manifest:
    """A manifest in memory; a column that a row lacks is null there."""
    names = dict.fromkeys(name for row in rows for name in row)
    return manifests.from_columns(
        {name: [row.get(name) for row in rows] for name in names}, Path("nowhere.parquet")
    )


def row(**changes: Any) -> dict[str, Any]:
    """Return a complete row of a manifest with these changes."""
    plain = {
        "path": "a.png",
        "sensor": "digit",
        "sequence": "a",
        "frame_index": 0,
        "split": "train",
    }
    return plain | {name.replace("__", "."): value for name, value in changes.items()}


def blobs(n: int = 600, d: int = 24, classes: int = 4, apart: float = 1.0, seed: int = 0):
    """Correlated features, as a network's are: spreads from 1 to 100, then standardised; class
    numbers.
    """
    rng = np.random.default_rng(seed)
    mixed = np.linalg.qr(rng.normal(size=(d, d)))[0] * np.geomspace(1, 100, d)
    y = rng.integers(classes, size=n)
    x = (rng.normal(size=(n, d)) + apart * rng.normal(size=(classes, d))[y]) @ mixed
    return ((x - x.mean(0)) / x.std(0)).astype(np.float32), y


def painted(folder: Path) -> Manifest:
    """A small world on disk: brighter is harder pressed, with backgrounds."""
    world = simulated(objects=8, each=2, frames=4)
    rng = np.random.default_rng(0)
    columns = world.table.to_pydict()
    columns["background_path"] = ["ground.png"] * len(world)
    cv2.imwrite(str(folder / "ground.png"), np.full((32, 32, 3), 40, np.uint8))
    for name, force in zip(columns["path"], columns["label.force"], strict=True):
        image = 40 + 30 * force + rng.integers(0, 5, (32, 32, 3))
        cv2.imwrite(str(folder / name), image.clip(0, 255).astype(np.uint8))
    file = folder / "manifest.parquet"
    manifests.write(manifests.from_columns(columns, file), file)
    return manifests.read(file)
