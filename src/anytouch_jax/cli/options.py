"""The options of every subcommand of `anytouch`: light records, so that `--help` answers at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from anytouch_jax.config import DataConfig, LossConfig, ModelConfig, OptimConfig, PresetName, RunConfig

Paths = tuple[Path, ...]


@dataclass(frozen=True)
class Train:
    """Pre-train stage 1 (masked autoencoding, next frame) or stage 2 (alignment, matching), or go on with a run.

    Example: anytouch train --stage 1 --data manifest.csv --run runs/stage1 --preset tiny --steps 800

    The same command again goes on from the last checkpoint. `--help-all` lists every field of the configuration.
    """

    data: Paths
    """Manifests (.csv or .parquet) to train on."""
    run: Path
    """Run folder: config.json, metrics.jsonl, checkpoints/, figures/."""
    stage: Literal[1, 2] = 1
    """1: pixels. 2: touch-vision-text alignment and cross-sensor matching."""
    preset: PresetName = "tiny"
    """Sizes of the network; large is the paper's."""
    recipe: Literal["paper", "release"] = "paper"
    """Follow the paper's text, or the authors' released code where they differ."""
    towers: Literal["scratch", "pretrained"] = "scratch"
    """Stage 2: train small image and text towers, or start from CLIP weights (--clip)."""
    baseline: str = "anytouch"
    """A rival or an ablation in place of the paper's model: unitouch, tlv_link, t3, static_only, no_matching, ..."""
    init: Path | None = None
    """Start from this stage-1 run or weights file."""
    clip: Path | None = None
    """CLIP weights (HF or OpenCLIP): a file, or a folder with tokenizer.json."""
    steps: int | None = None
    """Length of the whole schedule in steps (default 1000)."""
    stop_after: int | None = None
    """Stop after this many steps without changing the schedule."""
    save_every: int | None = None
    """Steps between checkpoints (default 200)."""
    batch: int | None = None
    """Samples a step (default: the preset's)."""
    seed: int = 0
    """Seed of everything drawn."""
    on_bad_sample: Literal["error", "skip"] = "error"
    """A sample that cannot be read stops the run, or is counted and replaced."""
    tensorboard: bool = False
    """Write TensorBoard events too."""


@dataclass(frozen=True)
class Sections:
    """Every field of the configuration, with the defaults of the preset, the recipe and the options of --help."""

    model: ModelConfig
    """Shapes and arithmetic of the network."""
    objective: LossConfig
    """Weights and choices of the losses."""
    optim: OptimConfig
    """AdamW and its schedule."""
    loader: DataConfig
    """How data are read and augmented (data in config.json)."""
    loop: RunConfig
    """How the run goes (run in config.json)."""


@dataclass(frozen=True)
class Embed:
    """Embed a manifest, a folder of frames or a video with a trained encoder; writes an .npz of features.

    Example: anytouch embed --run runs/stage2 --input manifest.csv --split test --out features.npz

    With --stream a camera (--input 0) or a video is embedded frame by frame; Ctrl-C ends it and saves what there is.
    """

    run: Path
    """Run folder or weights file (.pth, .safetensors)."""
    input: Path
    """Manifest (.csv, .parquet), folder of frames, a picture or a video; with --stream a camera's number or a video."""
    out: Path
    """The .npz to write: features (n, d), rows (n,), key/* (n,). With --stream also - for JSON lines on stdout."""
    split: str | None = None
    """Only this split of a manifest."""
    sensor: str | None = None
    """Sensor of a folder, a video or a camera; without it, or for an unknown one, the universal tokens."""
    background: Path | None = None
    """Picture of the untouched gel of a folder, a video or a camera, for an encoder trained on differences from it."""
    rotate: Literal[0, 90, 180, 270] = 0
    """Turn the frames of a folder, a video or a camera by so many degrees, clockwise, before anything else."""
    flip: Literal["none", "across", "down"] = "none"
    """Mirror them after that: left and right exchanged, or top and bottom."""
    frames: int = 1
    """Frames of a clip that ends at each row: 1 (stills), 3, or more (segments of three)."""
    pooling: Literal["class", "mean", "both"] | None = None
    """Class token (what alignment trains), mean of patch tokens, or both (default: what --head reads, else class)."""
    join: Literal["mean", "sum", "concat"] = "mean"
    """How the segments of a long clip are joined."""
    dtype: Literal["trained", "float32", "bfloat16"] = "trained"
    """Arithmetic: as in training, or another; bfloat16 is for GPUs and CPUs with AMX."""
    batch: int = 64
    """Frames at a time (not with --stream)."""
    stream: bool = False
    """One frame at a time, the newest of a camera; prints where the time went."""
    stride: int = 1
    """Frames from one frame of a streamed clip to its next: what the clips of the training data have."""
    head: Path | None = None
    """Name the class too by a head of probe --save: label and its probability p, arrays or in each line of JSON."""
    on_bad_sample: Literal["error", "skip"] = "error"
    """A row or a picture of a folder that cannot be read stops the command, or is left out and counted."""

    @property
    def pooled(self) -> Literal["class", "mean", "both"]:
        """The pooling, where no head asks for one."""
        return self.pooling or "class"


@dataclass(frozen=True)
class Probe:
    """Probe a label column with frozen features: linear and kNN, beside raw pixels and a random encoder.

    Example: anytouch probe --run runs/stage1 --data manifest.csv --label object

    With --where label.contact_score 7 firm touches alone, once `anytouch contact` has scored the frames.
    The penalty is chosen on split val, or by cross-validation in groups inside train; the report is on split test.
    --tasks and --benchmark run the battery instead: objects and recordings apart, dealt anew by every seed.
    An option that would do nothing there (--label, --group, --leave-out, --where, --sensor) is refused.
    Example: anytouch probe --run runs/stage2 --data data/scenes/manifest.parquet --tasks material,slip,force,twist
    """

    data: Paths
    """Manifests with the label column."""
    run: Paths = ()
    """Run folders or weights files to compare."""
    features: Paths = ()
    """Features of other encoders, beside them: .npz as embed writes it, arrays features (n, d) and rows (n,)."""
    label: str = "object"
    """Label column, with or without "label."."""
    group: str = ""
    """Column, with or without "label.", whose values never stand on both sides of a split (default: the first of
    grasp_group, object, touch, sequence that the manifest has and that is not the label)."""
    leave_out: str | None = None
    """Leave whole values of this column out in turn (for slip: object), instead of the splits."""
    where: tuple[str, float] | None = None
    """Keep rows whose column is above a number."""
    sensor: str | None = None
    """Keep rows of this sensor."""
    frames: int | None = None
    """Frames of a clip that ends at each row: 1 (stills), 3 or more (default: 1, or each task's own)."""
    pooling: Literal["class", "mean", "both"] = "both"
    """Features: class token, mean of patch tokens, or both."""
    join: Literal["mean", "sum", "concat"] = "mean"
    """How the segments of a clip longer than the model's are joined (battery)."""
    seeds: int = 5
    """Bootstrap resamples of the training groups; of the battery: deals of the groups."""
    protocol: Literal["honest", "published"] = "honest"
    """published chooses on the test split, as the authors' code does, and is labelled so (battery: beside honest)."""
    tasks: str = ""
    """Tasks of the battery, with commas between, or all: material, roughness, hardness, grasp, grasp_after, object,
    slip, force, twist, slide, indenter."""
    benchmark: str = ""
    """A public benchmark with the authors' settings: touch_and_go_material, touch_and_go_roughness,
    touch_and_go_hardness, feel_grasp, objectfolder1_material, objectfolder2_material."""
    heads: str = "linear"
    """Heads of the battery: linear, knn, gradient (the authors': one layer by AdamW)."""
    order: Literal["right", "shuffled", "repeated"] = "right"
    """Frames of a clip as they are, in another order, or the last one repeated (battery)."""
    train_sensors: str = ""
    """Learn from these sensors only (battery); --test-sensors likewise."""
    test_sensors: str = ""
    """Test on these sensors only."""
    train_units: str = ""
    """Learn from these units only, patterns such as cam0_* (battery); --test-units likewise: across fingers."""
    test_units: str = ""
    """Test on these units only."""
    max_rows: int | None = None
    """At most so many rows a task, by a fixed chance (battery)."""
    cache: Path | None = None
    """Folder that keeps features by content, so that nothing is encoded twice (battery)."""
    controls: bool = True
    """Also probe raw pixels and a random encoder."""
    out: Path | None = None
    """Write the results as JSON."""
    save: Path | None = None
    """Keep the linear head of one --run as .npz, for embed --head."""


@dataclass(frozen=True)
class Convert:
    """Convert weights: the authors' .pth, CLIP's (with --names own) or a run -> .safetensors.

    Example: anytouch convert runs/stage2 weights.safetensors
    """

    source: Path
    """Run folder or weights file."""
    target: Path
    """The .safetensors to write."""
    names: Literal["release", "own"] = "release"
    """Key names of the authors' files, or this package's parameter names."""
    between: Path | None = None
    """Run or weights file that SOURCE was trained from, as its stage 1: what is written lies between the two."""
    share: float = 0.5
    """How far from BETWEEN (0) to SOURCE (1): less keeps more of the picture, more what stage 2 learned."""


@dataclass(frozen=True)
class Simulate:
    """Simulate touch scenes: the same touches felt by several sensors, with photographs, captions, forces and slip.

    Example: anytouch simulate --out data/scenes --touches 400 --sensors gelsight_mini,digit,duragel --seed 0

    The same command again goes on where it was interrupted.
    """

    out: Path
    """Folder for images and manifest.parquet."""
    touches: int = 400
    """Places to touch; each is felt once by every sensor."""
    sensors: str = "gelsight_mini,digit,duragel"
    """Sensors, with commas between: gelsight, gelsight_mini, gelslim, digit, duragel, tac3d (a field of forces)."""
    seed: int = 0
    """Seed of everything drawn."""
    grade: Literal["fine", "coarse"] = "fine"
    """fine: the same motion for all sensors, frame by frame. coarse: by hand, only the place is shared."""
    fidelity: Literal["fast", "exact"] = "fast"
    """Contact solved in a few rounds, or to convergence."""
    frames: int = 10
    """Frames of a recording; one gesture fills them (10: a third of a second at 30 Hz)."""
    objects: int = 200
    """Objects of the catalogue that take turns."""
    depth: tuple[float, float] = (0.3, 1.0)
    """Range of the deepest press, mm."""
    vision: float = 0.7
    """Share of the recordings with a photograph."""
    text: float = 0.7
    """Share of the recordings with a caption."""
    held_out: float = 0.25
    """Share of the objects that only the test split touches, by whole pairs of primitive and texture."""
    first: int = 0
    """Number of the first touch: another one gives other touches of the same objects, with the same splits."""
    fields: str = ""
    """Fields to write beside the images (.npy), with commas between: displacement, pressure, shear."""
    size: int = 224
    """Pixels of an image's shorter side; 0 for the sensor's own resolution."""
    units: Literal["each", "one"] = "each"
    """each: every recording by a device of its own. one: one device of each sensor, mounted straight."""
    threads: int = 2
    """Threads that render photographs and write files."""


@dataclass(frozen=True)
class Retrieve:
    """Find the same touch by another sensor: top-1 and top-5 of frozen features, with controls and intervals.

    Example: anytouch retrieve --run runs/stage2 --data data/scenes/manifest.parquet

    A gallery holds the true touch once, and the touches that resemble it most in position, depth and force.
    """

    data: Path
    """Manifest with the columns touch and unit, and labels of the contact (label.x, y, depth, force)."""
    run: Paths = ()
    """Run folders or weights files to compare."""
    split: str = "test"
    """Split that is looked at."""
    frames: int = 1
    """Frames of a clip that ends at each deepest frame: 1 (stills), 3 or more."""
    pooling: Literal["class", "mean", "both"] = "class"
    """Features: class token, mean of patch tokens, or both."""
    gallery: int = 50
    """Touches in a gallery."""
    by_chance: bool = False
    """Draw the galleries by chance, not matched in position, depth and force."""
    seeds: int = 5
    """Galleries drawn for each query (with --by-chance)."""
    controls: bool = True
    """Also score a random encoder, background-differenced pixels, and the contact's area, centroid and force."""
    out: Path | None = None
    """Write the results as JSON."""


@dataclass(frozen=True)
class Report:
    """Write what two runs learned of a manifest: samples, losses, reconstructions, t-SNE, retrieval and probes.

    Example: anytouch report --data data/scenes/manifest.parquet --stage1 runs/stage1 --stage2 runs/stage2 --out report
    """

    data: Path
    """Manifest of simulated scenes, or one with the same columns."""
    stage1: Path
    """Run folder of stage 1."""
    stage2: Path
    """Run folder of stage 2."""
    out: Path
    """Folder for report.md, report.json and figures/."""
    touches: int = 200
    """Touches of the test split that are looked at (and half as many of train and val)."""
    gallery: int = 50
    """Touches in a retrieval gallery."""
    seed: int = 0
    """Seed of what is drawn."""
