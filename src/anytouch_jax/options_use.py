"""The options of the subcommands that put a trained model to use; see `options` for the others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from anytouch_jax.options import Paths


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
class Pour:
    """Pour 60 g of 100 g of beads by touch alone, in simulation: imitation learning over a run's features, then trials.

    Example: anytouch pour --run runs/stage2 --trials 10

    Prints the mass of each trial and the mean error beside a blind policy and the expert; OUT gets a film, JSON and the
    policy. With --recordings it learns from your own runs and is compared with the hand on those of split test.
    """

    run: Path | None = None
    """Run folder or weights file (.pth, .safetensors)."""
    recordings: Path | None = None
    """Manifest of recorded runs to learn from: a row a moment (five a second), label.action pour, wait or retract."""
    record: Path | None = None
    """Only write the expert's demonstrations to this folder, as images and manifest in the form of --recordings."""
    size: int = 112
    """Side of the recorded frames in pixels."""
    trials: int = 10
    """Runs of the learned policy, with cylinders, beads, grips and sensors that it has not met."""
    out: Path | None = None
    """Folder for pour.gif (the first trial), pour.json and the policy (default: pour in the run's folder)."""
    demos: int = 120
    """Demonstrations of the expert, who sees the scales; a thousand are better (memory: 5 GB of 84 pixels)."""
    stills: bool = False
    """Features of single frames, not of segments of three."""
    fine_tune: bool = False
    """Train the encoder too: minutes, for a third to a half less error in our table."""
    steps: int | None = None
    """Steps of the policy's training (default 3000)."""
    markers: bool = True
    """The gel has markers; without them shear is hardly to be seen."""
    seed: int = 0
    """Seed of demonstrations, learning and trials."""


@dataclass(frozen=True)
class Translate:
    """Translate images of one sensor into images, or fields, of another; with --fit train that translation.

    Example: anytouch translate --run runs/stage2 --from gelsight_mini --to duragel frame.png

    First: anytouch translate --fit --data pairs/manifest.parquet --run runs/stage2 --from gelsight_mini --to duragel.
    Pairs are frames with equal touch and frame_index (anytouch simulate --grade fine --units one). A translation is
    kept in RUN/generators/FROM-TO. Images come out at the model's size as PNG, fields (tac3d) as .npy, mm and N.
    """

    images: Paths
    """Images of the sensor that is given."""
    run: Path | None = None
    """Run folder or weights file of the encoder; where its translations are kept."""
    source: str = "gelsight_mini"
    """Sensor that is given."""
    to: str = "duragel"
    """Sensor that is wanted."""
    background: Path | None = None
    """Picture of the untouched gel, for an encoder trained on differences from it."""
    out: Path | None = None
    """File or folder to write (default: beside each image). With --fit: the folder of the translation."""
    generator: Path | None = None
    """Folder of a translation, when it is not in the run."""
    fit: bool = False
    """Train the translation on the pairs of --data (split train), score it on split test, and keep it."""
    data: Paths = ()
    """Manifests with fine-aligned pairs."""
    steps: int = 800
    """Training steps."""
    batch: int = 32
    """Pairs a step."""
    learning_rate: float = 1e-3
    """Peak of the learning rate."""
    tune: Literal["frozen", "fine"] = "frozen"
    """Keep the encoder as it is, or train it too, at a tenth of the rate."""
    adversarial: float = 0.02
    """Weight of the critic's verdict on images, in units of the error of copying the mean image; 0 for none."""
    seed: int = 0
    """Seed of everything drawn."""


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
