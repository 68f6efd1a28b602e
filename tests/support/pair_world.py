"""Fine-aligned pairs on disk: a disc pressed at a place, as two cameras of other colours and a
field sensor feel it.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from anytouch_jax.data.manifest import manifest as manifests

CAMERAS = {"gelsight_mini": (90, 120, 60), "digit": (60, 60, 120), "duragel": (120, 60, 120)}


def scene(rng: np.random.Generator, size: int = 28) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The images u8 (size, size, 3) of one press by name of the camera, and its field f32 (20, 20,
    6).
    """
    place = rng.uniform(-0.6, 0.6, 2)
    depth = rng.uniform(0.3, 1.0)

    def dent(side: int) -> np.ndarray:
        y, x = (np.mgrid[:side, :side] + 0.5) * 2 / side - 1
        return depth * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 0.15)

    light = (
        dent(size)[..., None]
        * np.array([[100, -40, 60], [-50, 100, 40], [60, 90, -50]])[:, None, None]
    )
    images = {
        name: np.clip(np.asarray(ground) + light[k], 0, 255).astype(np.uint8)
        for k, (name, ground) in enumerate(CAMERAS.items())
    }
    return images, (dent(20)[..., None] * np.array([0.1, -0.1, 1.0, 1e-3, 1e-3, 4e-3])).astype(
        np.float32
    )


def arrays(count: int, seed: int = 0, size: int = 28) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """GelSight Mini and DuraGel images u8 (n, size, size, 3), Tac3D fields f32 (n, 20, 20, 6), of
    `count` presses.
    """
    rng = np.random.default_rng(seed)
    several = [scene(rng, size) for _ in range(count)]
    first, second = (
        np.stack([images[name] for images, _ in several]) for name in ("gelsight_mini", "duragel")
    )
    return first, second, np.stack([field for _, field in several])


def make_pairs(folder: Path, touches: dict[str, int], frames: int = 2) -> Path:
    """A manifest of `touches` {split: number}, each of another object, felt by three cameras and a
    Tac3D.
    """
    rng = np.random.default_rng(5)
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for split, count in touches.items():
        for number in range(count):
            for frame in range(frames):
                images, field = scene(rng)
                stem = f"{split}{number}_{frame}"
                np.save(folder / f"{stem}.npy", field)
                rows.append(
                    row(f"{stem}.npy", "tac3d", split, number, frame)
                    | {"field_path": f"{stem}.npy"}
                )
                for name, image in images.items():
                    cv2.imwrite(str(folder / f"{stem}_{name}.png"), image[..., ::-1])
                    rows.append(
                        row(f"{stem}_{name}.png", name, split, number, frame) | {"field_path": None}
                    )
    order = rng.permutation(len(rows))
    columns = {name: [rows[i][name] for i in order] for name in rows[0]}
    file = folder / "manifest.parquet"
    manifests.write(manifests.from_columns(columns, file), file)
    return file


def row(
    path: str, sensor: str, split: str, number: int, frame: int, grade: str | None = "fine"
) -> dict[str, Any]:
    return {
        "path": path,
        "sensor": sensor,
        "sequence": f"{split}/{number}/{sensor}/{grade}",
        "frame_index": frame,
        "split": split,
        "touch": f"{split}/{number}",
        "object": f"{split} thing {number}",
        "grade": grade,
    }
