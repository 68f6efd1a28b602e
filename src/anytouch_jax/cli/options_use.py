"""The options of the subcommands that put a trained model to use; see `options` for the others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from anytouch_jax.cli.options import Paths


@dataclass(frozen=True)
class Info:
    """Say what a file or folder is: a run, weights, a manifest, features, a translation.

    Example: anytouch info runs/stage2 data/scenes/manifest.parquet features.npz
    """

    paths: Paths
    """Files and folders."""


@dataclass(frozen=True)
class Export:
    """Write a trained touch encoder as one file that needs jax alone, checked against the live model.

    Example: anytouch export --run runs/stage2 --out encoder.bin --frames 3

    uint8 frames and sensor rows in, features out, any number of touches; OUT.json beside it says how to call it.
    """

    run: Path
    """Run folder or weights file (.pth, .safetensors)."""
    out: Path
    """The artefact to write."""
    frames: int = 1
    """Frames of a touch: 1 (stills), 3, or more (segments of three)."""
    platforms: str = "cpu,cuda"
    """Where it is to run, with commas between: cpu, cuda, rocm, tpu."""
    pooling: Literal["class", "mean", "both"] = "class"
    """Class token (what alignment trains), mean of patch tokens, or both."""
    join: Literal["mean", "sum", "concat"] = "mean"
    """How the segments of a long clip are joined."""
    dtype: Literal["trained", "float32", "bfloat16"] = "trained"
    """Arithmetic: as in training, or another; bfloat16 is for GPUs and CPUs with AMX."""


@dataclass(frozen=True)
class Adapt:
    """Give a sensor that a run has never seen tokens of its own, fitted to a few of its frames; all else is frozen.

    Example: anytouch adapt --run runs/stage1 --data mine.csv --sensor my_gel --frames 20 --out runs/my_gel

    Without --labels they are fitted by masked reconstruction, best through the decoder of a stage-1 run.
    """

    run: Path
    """Run folder of stage 1 or stage 2."""
    data: tuple[Path, ...]
    """Manifests with frames of the sensor in split train."""
    sensor: str
    """Name of the sensor, as in the manifest's column sensor."""
    out: Path
    """Run folder to write; embed, probe and retrieve read it."""
    frames: int = 100
    """Frames to fit, spread over the recordings; 0: the universal tokens as they are."""
    labels: str | None = None
    """Fit to the classes of this column instead, as the known sensors' frames in the manifests show them."""
    steps: int = 200
    """Steps of the fit."""
    seed: int = 0
    """Seed of what is drawn."""
