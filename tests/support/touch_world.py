"""A world on disk where several sensors feel the same places: each touch has its texture, place and
force.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from anytouch_jax.data.manifest import manifest as manifests

SENSORS = ("digit", "gelsight", "gelslim")


def make_touches(
    folder: Path,
    *,
    touches: dict[str, int],
    sensors: tuple[str, ...] = SENSORS,
    frames: int = 1,
    size: int = 32,
    each: int = 5,
    seed: int = 0,
) -> Path:
    """A manifest of `touches` {split: number}, `each` of an object, half of them fine and half
    coarse.

    A frame shows the texture of its touch within a disc at (x, y), as deep as its force, over its
    sensor's tint.
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "photo.png"), rng.integers(0, 256, (40, 30, 3), np.uint8))
    for name in sensors:
        cv2.imwrite(
            str(folder / f"{name}.png"), np.full((size, size, 3), tint(sensors, name), np.uint8)
        )
    rows = []
    for split, count in touches.items():
        for number in range(count):
            texture = rng.uniform(-1, 1, (8, 8))
            force = rng.uniform(1, 5)
            for name in sensors:
                place = rng.uniform(-2, 2, 2)
                for frame in range(frames):
                    now = force * (frame + 1) / frames
                    path = f"{split}{number}_{name}_{frame}.png"
                    image = render(texture, place, now, tint(sensors, name), size)
                    cv2.imwrite(
                        str(folder / path), image + rng.integers(0, 5, image.shape, np.uint8)
                    )
                    rows.append(row(path, split, number, number // each, name, frame, place, now))
    columns: dict[str, Any] = {name: [one[name] for one in rows] for name in rows[0]}
    file = folder / "manifest.parquet"
    manifests.write(manifests.from_columns(columns, file), file)
    return file


def tint(sensors: tuple[str, ...], name: str) -> int:
    return 60 + 50 * sensors.index(name)


def render(
    texture: np.ndarray, place: np.ndarray, force: float, ground: int, size: int
) -> np.ndarray:
    """u8 (size, size, 3): a disc of texture on an even ground; one pixel is 8 / size mm."""
    fine = cv2.resize(texture, (size, size), interpolation=cv2.INTER_NEAREST)
    y, x = (np.mgrid[:size, :size] + 0.5) * 8 / size - 4
    inside = (x - place[0]) ** 2 + (y - place[1]) ** 2 < force
    grey = ground + 8 * force * fine * inside
    return np.clip(np.repeat(grey[..., None], 3, axis=2), 0, 250).astype(np.uint8)


def row(
    path: str,
    split: str,
    number: int,
    thing: int,
    sensor: str,
    frame: int,
    place: np.ndarray,
    force: float,
) -> dict[str, Any]:
    name = f"{split} thing {thing}"
    return {
        "path": path,
        "sensor": sensor,
        "sequence": f"{split}/{number}/{sensor}",
        "frame_index": frame,
        "split": split,
        "unit": f"{split} unit",
        "touch": f"{split}/{number}",
        "object": name,
        "image_path": "photo.png" if number % 2 else None,
        "text": f"{name} | feels coarse" if number % 3 else None,
        "background_path": f"{sensor}.png",
        "grade": "fine" if number % 2 else "coarse",
        "label.hardness": ("soft", "hard")[thing % 2],
        "label.indenter": ("ball", "cube", "ring")[thing % 3],
        "label.force": force,
        "label.depth": force / 5,
        "label.area": 3.1 * force,
        "label.x": place[0],
        "label.y": place[1],
    }
