"""The simulated scenes and the images of the notebooks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np

import anytouch_jax as at
from anytouch_jax.data.images import decode
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.evaluate.retrieval import deepest_rows
from anytouch_jax.sim.dataset import simulate
from anytouch_jax.sim.scene import Scenes
from anytouch_jax.train.progress import silent

FOLDER = Path(__file__).resolve().parents[2] / "runs" / "notebooks" / "scenes"


def scenes() -> at.Manifest:
    """Return the manifest of the scenes of the notebooks, or of the folder SCENES.

    They are simulated if they are missing.
    """
    folder = Path(os.environ.get("SCENES") or FOLDER)
    if not (folder / "manifest.parquet").exists():
        simulate(Scenes(touches=500, objects=250, size=128), folder)
    return at.read_manifest(folder / "manifest.parquet")


def small(config: at.Config, steps: int, batch: int) -> at.Config:
    """Return a configuration with a network and a schedule small enough for minutes on a CPU."""
    tower = {"width": 64, "depth": 2, "heads": 4, "mlp": 128}
    model = config.model
    image = model.image
    text = model.text
    model = replace(
        model,
        image_size=56,
        touch=replace(model.touch, **tower),
        decoder=replace(model.decoder, **tower),
        image=image and replace(image, **tower),
        text=text and replace(text, stack=replace(text.stack, **tower)),
    )
    return replace(config, model=model).with_settings(
        {
            "data.batch_size": batch,
            "optim.learning_rate": 1e-3,
            "run.steps": steps,
            "run.save_every": steps,
            "run.figure_every": steps,
        }
    )


def deepest(table: at.Manifest, split: str, most: int) -> np.ndarray:
    """Return the rows (n,) of the deepest frame of up to `most` touches of a split, by every
    sensor.
    """
    rows = deepest_rows(table, table.rows_of(split))
    touches = table.text_column("touch")[rows]
    return rows[np.isin(touches, np.unique(touches)[:most])]


def embed(encoder: at.Encoder, table: at.Manifest, rows: np.ndarray) -> np.ndarray:
    """Return the features (n, d) of rows, class token and mean of patches joined."""
    return embed_rows(encoder, table, rows, pooling="both", log=silent)[1]


def small_images(table: at.Manifest, rows: np.ndarray) -> np.ndarray:
    """Return the change of images from the untouched gel as features (n, d): what needs no
    encoder.
    """
    size = (24, 24)
    changes = [
        cv2.resize(decode(table.file(int(row))), size).astype(np.float32)
        - cv2.resize(decode(table.file(int(row), "background_path")), size)
        for row in rows
    ]
    return np.stack(changes).reshape(len(rows), -1) / 255


def show(
    images: Sequence[np.ndarray], titles: Sequence[str], across: int, size: float = 1.7
) -> None:
    """Show images in rows of `across`, each with a title."""
    down = -(-len(images) // across)
    figure, axes = plt.subplots(
        down, across, figsize=(size * across, (size + 0.2) * down), squeeze=False
    )
    for axis in axes.flat:
        axis.axis("off")
    for axis, image, title in zip(axes.flat, images, titles, strict=False):
        axis.imshow(image)
        axis.set_title(title, fontsize=8)
    figure.tight_layout()
    plt.show()


def show_file(path: Path, width: float = 10) -> None:
    """Show an image file."""
    image = plt.imread(path)
    plt.figure(figsize=(width, width * image.shape[0] / image.shape[1]))
    plt.imshow(image)
    plt.axis("off")
    plt.show()
