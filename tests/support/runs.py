"""A small world on disk (two sensors at the same places, one RGB image, a few captions) and runs
trained on it.
"""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tiny_models import tiny_config

from anytouch_jax.config import Config
from anytouch_jax.train.loop import FitResult
from anytouch_jax.training import pretrain
from anytouch_jax.weights.tree import flatten

# the fields of a line that differ between equal runs
TIMING = ("samples_per_second", "wait", "wait_fraction")
COLUMNS = (
    "path",
    "sensor",
    "sequence",
    "frame_index",
    "split",
    "touch",
    "object",
    "image_path",
    "text",
    "label.object",
)
# sequence -> sensor and the split of its four frames
SEQUENCES = {
    "a": ("digit", ("train",) * 4),
    "b": ("gelsight_mini", ("train",) * 4),
    "c": ("digit", ("val", "val", "test", "test")),
}


# The options of `anytouch train` for a network that compiles fast.
SIZES = {
    "model.image-size": 28,
    "model.patch": 7,
    "model.embed": 12,
    "model.touch.width": 16,
    "model.touch.depth": 1,
    "model.touch.heads": 2,
    "model.touch.mlp": 32,
    "model.decoder.width": 8,
    "model.decoder.depth": 1,
    "model.decoder.heads": 2,
    "model.decoder.mlp": 16,
    "data.clip-fraction": 0,
}


def make_world(folder: Path) -> Path:
    """Twelve frames of 32 x 32 pixels in three sequences; a ball and a cube take turns."""
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "photo.png"), rng.integers(0, 256, (40, 44, 3), np.uint8))
    rows = []
    for name, (sensor, splits) in SEQUENCES.items():
        for frame, split in enumerate(splits):
            thing = ("ball", "cube")[frame % 2]
            image = rng.integers(0, 60, (32, 32, 3)) + (150 if thing == "ball" else 20)
            path = f"{name}{frame}.png"
            cv2.imwrite(str(folder / path), image.astype(np.uint8))
            photo = "photo.png" if (name, frame) == ("a", 2) else ""
            text = f"a round thing, {name}" if thing == "ball" and split == "train" else ""
            rows.append(
                (path, sensor, name, frame, split, f"place {thing}", thing, photo, text, thing)
            )
    return write_manifest(folder / "manifest.csv", rows)


def write_manifest(path: Path, rows: Any, columns: tuple[str, ...] = COLUMNS) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *rows])
    return path


def read_rows(manifest: Path) -> list[dict[str, str]]:
    with manifest.open(newline="") as file:
        return list(csv.DictReader(file))


def run_config(
    manifest: Path,
    stage: int = 1,
    recipe: str = "paper",
    towers: str = "scratch",
    *,
    steps: int = 4,
    batch: int = 8,
    model: dict[str, Any] | None = None,
    **run: Any,
) -> Config:
    """A recipe on the smallest model and the small world; a step for each of the four devices to
    share.
    """
    config = tiny_config(stage, recipe, towers, **(model or {}))
    data = replace(config.data, manifests=(str(manifest),), batch_size=batch)
    settings: dict[str, Any] = {"steps": steps, "save_every": steps, "figure_every": 0} | run
    if config.model.text:  # room for the tokenizer that is trained on the captions
        config = replace(
            config, model=replace(config.model, text=replace(config.model.text, vocab=2048))
        )
    return replace(config, data=data, run=replace(config.run, **settings))


def train(config: Config, run: Path, notes: list[str] | None = None, **options: Any) -> FitResult:
    """Run `pretrain` quietly; its log goes to `notes`."""
    return pretrain(config, run, log=(notes if notes is not None else []).append, **options)


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """The lines of metrics.jsonl without the fields that differ between equal runs."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name not in TIMING} for line in lines]


def arrays_of(result: FitResult) -> dict[str, np.ndarray]:
    """Every array of the state, optimiser included, by name."""
    return {name: np.asarray(leaf) for name, leaf in flatten(result.state).items()}


def saved_steps(run: Path) -> list[int]:
    return sorted(int(path.name) for path in (run / "checkpoints").iterdir() if path.name.isdigit())
