"""The `anytouch` command: the only reader of argv. Heavy imports wait until a subcommand needs them."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from anytouch_jax import __version__
from anytouch_jax.config import Config, Data, Model, Objective, Optim, Run, UserError, preset

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
    preset: Literal["tiny", "small", "base", "large"] = "tiny"
    """Sizes of the network; large is the paper's."""
    recipe: Literal["paper", "release"] = "paper"
    """Follow the paper's text, or the authors' released code where they differ."""
    towers: Literal["scratch", "pretrained"] = "scratch"
    """Stage 2: train small image and text towers, or start from CLIP weights (--clip)."""
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

    model: Model
    """Shapes and arithmetic of the network."""
    objective: Objective
    """Weights and choices of the losses."""
    optim: Optim
    """AdamW and its schedule."""
    loader: Data
    """How data are read and augmented (data in config.json)."""
    loop: Run
    """How the run goes (run in config.json)."""


@dataclass(frozen=True)
class Embed:
    """Embed a manifest, a folder of frames or a video with a trained encoder; writes an .npz of features.

    Example: anytouch embed --run runs/stage2 --input manifest.csv --split test --out features.npz
    """

    run: Path
    """Run folder or weights file (.pth, .safetensors)."""
    input: Path
    """Manifest (.csv, .parquet), folder of frames, or video file."""
    out: Path
    """The .npz to write: features (n, d), rows (n,), key/* (n,)."""
    split: str | None = None
    """Only this split of a manifest."""
    sensor: str = "universal"
    """Sensor of a folder or a video; one that the model does not know gets the universal tokens."""
    frames: int = 1
    """Frames of a clip that ends at each row: 1 (stills), 3, or more (segments of three)."""
    pooling: Literal["class", "mean", "both"] = "class"
    """Class token (what alignment trains), mean of patch tokens, or both."""
    join: Literal["mean", "sum", "concat"] = "mean"
    """How the segments of a long clip are joined."""
    batch: int = 64
    """Frames at a time."""


@dataclass(frozen=True)
class Probe:
    """Probe a label column with frozen features: linear and kNN, beside raw pixels and a random encoder.

    Example: anytouch probe --run runs/stage1 --data manifest.csv --label object --where label.contact_score 7

    The penalty is chosen on split val, or by cross-validation in groups inside train; the report is on split test.
    """

    data: Paths
    """Manifests with the label column."""
    run: Paths = ()
    """Run folders or weights files to compare."""
    label: str = "object"
    """Label column, with or without "label."."""
    group: str = "grasp_group"
    """Column whose values never stand on both sides of a split (falls back to sequence)."""
    leave_out: str | None = None
    """Leave whole values of this column out in turn (for slip: object), instead of the splits."""
    where: tuple[str, float] | None = None
    """Keep rows whose column is above a number."""
    sensor: str | None = None
    """Keep rows of this sensor."""
    frames: int = 1
    """Frames of a clip that ends at each row: 1 (stills), 3 or more."""
    pooling: Literal["class", "mean", "both"] = "both"
    """Features: class token, mean of patch tokens, or both."""
    seeds: int = 5
    """Bootstrap resamples of the training groups."""
    protocol: Literal["honest", "published"] = "honest"
    """published chooses the penalty on the test split, as the authors' code does, and is labelled so."""
    controls: bool = True
    """Also probe raw pixels and a random encoder."""
    out: Path | None = None
    """Write the results as JSON."""


@dataclass(frozen=True)
class Parity:
    """Compare this implementation with golden vectors of the authors' PyTorch code.

    Example: anytouch parity ../shared/golden

    Exits 1 when a case is out of tolerance or not understood.
    """

    folder: Path
    """Folder with A_*.json, A_*.npz, ..."""
    verbose: bool = False
    """Print every array, not only the worst of a case."""


@dataclass(frozen=True)
class Convert:
    """Convert weights: authors' .pth, CLIP (.safetensors, .bin) or a run -> .safetensors with the authors' key names.

    Example: anytouch convert runs/stage2 weights.safetensors
    """

    source: Path
    """Run folder or weights file."""
    target: Path
    """The .safetensors to write."""
    names: Literal["release", "own"] = "release"
    """Key names of the authors' files, or this package's parameter names."""


_COMMANDS: dict[str, tuple[type, str]] = {
    "train": (Train, "pre-train stage 1 or stage 2, or go on with a run"),
    "embed": (Embed, "features of a manifest, a folder or a video"),
    "probe": (Probe, "linear and kNN probes of frozen features"),
    "parity": (Parity, "compare with golden vectors of the authors' code"),
    "convert": (Convert, "weights in and out"),
}
_POSITIONAL = (Parity, Convert)  # what these require is given by place, not by name


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 1 (a user's mistake or a failed check), 2 (usage), 130."""
    try:
        status = _main(argv)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # the reader of our output went away (| head): nobody is left to be told
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def _main(argv: Sequence[str] | None) -> int:
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        print(_usage())
        return 0 if args else 2
    if args[0] == "--version":
        print(__version__)
        return 0
    if args[0] not in _COMMANDS:
        from difflib import get_close_matches

        near = get_close_matches(args[0], _COMMANDS, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        print(f"anytouch: no command {args[0]!r}{hint} See anytouch --help", file=sys.stderr)
        return 2
    try:
        return _run(args[0], args[1:])
    except UserError as error:
        print(f"anytouch {args[0]}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _usage() -> str:
    lines = "\n".join(f"  {name:8} {text}" for name, (_, text) in _COMMANDS.items())
    return f"""usage: anytouch COMMAND [options]

One representation of touch for many camera-based tactile sensors.

{lines}

anytouch COMMAND --help explains a command and gives an example."""


def _run(name: str, args: list[str]) -> int:
    from anytouch_jax import commands

    if name == "train":
        return commands.train(*_parse_train(args))
    options = _parse(_COMMANDS[name][0], name, args)
    run: Callable[[Any], int] = getattr(commands, name)
    return run(options)


def _parse(kind: Any, name: str, args: list[str], default: Any = None) -> Any:
    import tyro

    extra = {} if default is None else {"default": default}
    config: list[Any] = [tyro.conf.AvoidSubcommands]
    if kind in _POSITIONAL:
        config.append(tyro.conf.PositionalRequiredArgs)
    return tyro.cli(kind, prog=f"anytouch {name}", args=args, config=config, **extra)


def _parse_train(args: list[str]) -> tuple[Train, Config]:
    """The options of `train`, and the configuration after the preset, the short flags and the long ones."""
    if "--help" in args or "-h" in args:
        return _parse(Train, "train", args)
    sections = [a for a in args if a.startswith(("--model.", "--objective.", "--optim.", "--loader.", "--loop."))]
    if not sections and "--help-all" not in args:
        options = _parse(Train, "train", args)
        return options, _configure(options)

    asked = "--help-all" in args
    first, rest = _split_sections([arg for arg in args if arg != "--help-all"])
    options = _parse(Train, "train", first, Train((), Path("runs/stage1")) if asked else None)
    config = _configure(options)
    if asked:
        rest = ["--help"]
    default = Sections(config.model, config.objective, config.optim, config.data, config.run)
    s = _parse(Sections, "train [the options of --help]", rest, default)
    return options, replace(config, model=s.model, objective=s.objective, optim=s.optim, data=s.loader, run=s.loop)


def _split_sections(args: list[str]) -> tuple[list[str], list[str]]:
    """Cut argv in plain options and those of a section (--model.patch 16), each with the values that follow it."""
    plain: list[str] = []
    section: list[str] = []
    target = plain
    for arg in args:
        if arg.startswith("-") and not arg.lstrip("-").replace(".", "", 1).isdigit():
            target = section if "." in arg.split("=")[0] else plain
        target.append(arg)
    return plain, section


def _configure(options: Train) -> Config:
    """The preset and recipe of `options`, with its short flags in place."""
    config = preset(options.preset, stage=options.stage, recipe=options.recipe, towers=options.towers)
    data = replace(
        config.data,
        manifests=tuple(str(path) for path in options.data),
        on_bad_sample=options.on_bad_sample,
        batch_size=options.batch or config.data.batch_size,
    )
    run = replace(
        config.run,
        seed=options.seed,
        steps=options.steps or config.run.steps,
        save_every=options.save_every or config.run.save_every,
        tensorboard=options.tensorboard,
    )
    return replace(config, data=data, run=run)
