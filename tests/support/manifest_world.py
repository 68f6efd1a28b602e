"""Small worlds on disk.

Every touch image is of one colour that tells its row, so that a batch can be read back.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from anytouch_jax import config as configuration
from anytouch_jax.data.manifest import manifest as manifests


def colour(row: int) -> tuple[int, int, int]:
    """The RGB colour of the touch image of `row`."""
    return row % 250 + 1, row // 250, 7


def row_of(pixel: np.ndarray) -> int:
    """The row whose colour a pixel has."""
    return int(pixel[..., 0].flat[0]) - 1 + 250 * int(pixel[..., 1].flat[0])


def save(path: Path, rgb: tuple[int, int, int], shape: tuple[int, int] = (12, 16)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.broadcast_to(np.array(rgb[::-1], np.uint8), (*shape, 3))
    assert cv2.imwrite(str(path), image)


@pytest.fixture
def make(tmp_path: Path) -> Callable[..., manifests.Manifest]:
    """make(rows, folder="."): a manifest of rows given as dicts, with the images that they name."""

    def build(rows: list[dict[str, Any]], folder: str = ".") -> manifests.Manifest:
        root = tmp_path / folder
        full = [
            {
                "path": f"f{i}.png",
                "sensor": "digit",
                "sequence": f"s{i}",
                "frame_index": 0,
                "split": "train",
                **row,
            }
            for i, row in enumerate(rows)
        ]
        for i, row in enumerate(full):
            save(root / row["path"], colour(i))
            for name in ("image_path", "image2_path"):
                if row.get(name):
                    save(root / row[name], (i + 1, 200, 9), (40, 40))
        names = {name: None for row in full for name in row}
        return manifests.from_columns(
            {name: [row.get(name) for row in full] for name in names}, root / "manifest.csv"
        )

    return build


@pytest.fixture
def rich() -> list[dict[str, Any]]:
    """Rows for `make`: clips of two sensors at the same places, some with images and captions."""
    rows = []
    for i in range(8):
        for k in range(6):
            row = {
                "sequence": f"s{i}",
                "frame_index": k,
                "sensor": "digit" if i % 2 else "gelslim",
                "touch": f"place{i // 2}.{k}",
                "object": f"o{i // 2}",
                "unit": f"u{i % 2}",
            }
            row |= {"image_path": f"v{i}{k}.png"} if i < 3 else {}
            rows.append(row | ({"text": f"caption {i}"} if i % 3 == 2 else {}))
    return rows


@pytest.fixture
def settings() -> Callable[..., configuration.Config]:
    """settings(stage, recipe, plain=True, **data): preset tiny at 28 pixels, plain: as stored."""

    def build(
        stage: Any = 1, recipe: Any = "paper", plain: bool = True, **data: Any
    ) -> configuration.Config:
        config = configuration.preset("tiny", stage=stage, recipe=recipe)
        if plain:
            data = {"flip": 0.0, "jitter": (0.0, 0.0, 0.0, 0.0), "rotation": 0.0, **data}
        model = replace(
            config.model,
            image_size=28,
            text=config.model.text and replace(config.model.text, length=12),
        )
        return replace(config, model=model, data=replace(config.data, **{"batch_size": 4, **data}))

    return build


@pytest.fixture
def read_back() -> Callable[[np.ndarray], np.ndarray]:
    """Row ids of a clip array u8 (B, T, H, W, 3): i64 (B, T)."""
    return lambda clip: np.array(
        [[row_of(frame[10:11, 10]) for frame in sample] for sample in clip]
    )
