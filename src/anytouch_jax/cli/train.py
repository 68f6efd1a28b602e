"""`anytouch train`: pre-training, or continuing a run."""

from __future__ import annotations

import inspect
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_type_hints

import tyro

from anytouch_jax.cli.arguments import option_of, parse_options
from anytouch_jax.cli.output import log
from anytouch_jax.config import (
    Config,
    DataConfig,
    LossConfig,
    ModelConfig,
    OptimConfig,
    PresetName,
    RunConfig,
    baselines,
    preset,
)
from anytouch_jax.errors import UserError

# Fields that one stage alone reads, by section.
_STAGE_2_FIELDS: dict[str, tuple[str, ...]] = {
    "objective": ("alpha_tv", "alpha_tl", "alpha_vl", "match_weight", "match_keep", "groups", "center_embeddings"),
    "model": ("match_head", "lora_rank", "lora_alpha", "temperature"),
    "data": ("negatives",),
}
_RECONSTRUCTION_FIELDS: dict[str, tuple[str, ...]] = {"objective": ("mask_ratio", "norm_pix_loss", "next_frame")}


@dataclass(frozen=True)
class TrainOptions:
    """Pre-train stage 1 (masked autoencoding, next frame) or stage 2 (alignment, matching).

    Example: anytouch train --stage 1 --data manifest.csv --run runs/stage1 --preset tiny --steps 800

    Run the same command again to continue from the last checkpoint. Sections of the configuration are options too,
    such as --model.patch 16 or --optim.learning-rate 1e-3. `--help-all` lists them.
    """

    data: tuple[Path, ...]  # Manifests (.csv or .parquet) to train on.
    run: Path  # Run folder: config.json, metrics.jsonl, checkpoints/, figures/.
    stage: Literal[1, 2] = 1  # 1 learns from pixels. 2 aligns touch, vision and text, and matches sensors.
    preset: PresetName = "tiny"  # Sizes of the network. large is the paper's.
    recipe: Literal["paper", "release"] = "paper"  # Follow the paper's text, or the authors' released code.
    towers: Literal["scratch", "pretrained"] = "scratch"
    """Stage 2: train small image and text towers, or start from CLIP weights (--clip-weights)."""
    baseline: str = "anytouch"  # Train a baseline or an ablation: unitouch, tlv_link, t3, static_only, no_matching, ...
    init: Path | None = None  # Start from this stage-1 run or weights file.
    clip_weights: Path | None = None  # CLIP weights (HF or OpenCLIP): a file, or a folder with tokenizer.json.
    steps: int | None = None  # Steps of the whole schedule (default: 1000).
    stop_after: int | None = None  # Stop after this many steps, without changing the schedule.
    save_every: int | None = None  # Steps between checkpoints (default: 200).
    batch: int | None = None  # Samples per step (default: the preset's).
    seed: int = 0  # Random seed.
    on_bad_sample: Literal["error", "skip"] = "error"  # Stop at a sample that cannot be read, or replace and count it.
    tensorboard: bool = False  # Also write TensorBoard events.


@dataclass(frozen=True)
class Sections:
    """Every field of the configuration, with the defaults of the preset, the recipe and the options of --help."""

    model: ModelConfig
    objective: LossConfig
    optim: OptimConfig
    data: DataConfig
    run: RunConfig


class TrainRequest(NamedTuple):
    """The options of `train` and the configuration that they make."""

    options: TrainOptions
    config: Config


def parse(kind: type[TrainOptions], name: str, args: Sequence[str]) -> TrainRequest:
    """Return the options of `train`, and the configuration of its preset, its options and its sections, in this order.

    The sections are parsed second, since their defaults depend on the preset.
    """
    list_all = "--help-all" in args
    plain, sections = _split_sections([arg for arg in args if arg != "--help-all"])
    _suggest_section(plain)
    options = parse_options(kind, name, plain, TrainOptions((), Path("runs/stage1")) if list_all else None)
    config = _configure(options)
    if not sections and not list_all:
        return TrainRequest(options, config)
    default = Sections(config.model, config.objective, config.optim, config.data, config.run)
    if list_all:
        parse_options(_documented_sections(), "train [the options of --help]", ["--help"], default)
    try:
        section = parse_options(Sections, "train [the options of --help]", sections, default, add_help=False)
    except SystemExit:
        print("For every field of the configuration, run anytouch train --help-all", file=sys.stderr)
        raise
    return TrainRequest(options, replace(config, **vars(section)))


def run(request: TrainRequest) -> int:
    """Train or continue, alone or as one of several processes; 0 after SIGTERM and 130 after Ctrl-C, both saved."""
    from anytouch_jax.train.progress import Terminated, terminating

    options, config = request
    baseline = baselines.find(options.baseline)
    if options.stage == 2 and options.init and not baseline.starts_from_stage1:
        raise UserError(f"baseline {baseline.name} has no stage 1. Remove --init.")
    if options.stage == 1 and options.towers == "pretrained" and not options.clip_weights:
        raise UserError("--towers pretrained starts the touch encoder of stage 1 from CLIP. Add --clip-weights.")
    if options.stage == 2 and options.clip_weights and options.towers != "pretrained":
        raise UserError("--clip-weights needs --towers pretrained in stage 2. Add it, or remove --clip-weights.")
    if options.stop_after is not None and options.stop_after < 0:
        raise UserError(f"--stop-after must be 0 or more, not {options.stop_after}")
    _refuse_other_stage(options, config)
    try:
        with terminating():
            return _train(options, config)
    except Terminated:
        log(f"stopped by SIGTERM before the first step of {options.run}. Run the same command again to continue.")
        return 0


def _train(options: TrainOptions, config: Config) -> int:
    from anytouch_jax.pretrain import pretrain
    from anytouch_jax.train.distributed import joined
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    with joined() as place:
        result = pretrain(
            config, options.run, init=options.init, clip=options.clip_weights, stop_after=options.stop_after, log=log
        )
    if result.interrupted == signal.SIGINT:
        return 130
    if place is None or place.index == 0:
        log(f"{options.run}: {result.step} of {config.run.steps} steps")
    return 0


def _configure(options: TrainOptions) -> Config:
    """Return the configuration of the preset and recipe, changed by the short options and the baseline."""
    config = preset(options.preset, stage=options.stage, recipe=options.recipe, towers=options.towers)
    data = replace(
        config.data,
        manifests=tuple(str(path) for path in options.data),
        on_bad_sample=options.on_bad_sample,
        batch_size=config.data.batch_size if options.batch is None else options.batch,
    )
    run = replace(
        config.run,
        seed=options.seed,
        steps=config.run.steps if options.steps is None else options.steps,
        save_every=config.run.save_every if options.save_every is None else options.save_every,
        tensorboard=options.tensorboard,
    )
    return baselines.apply(options.baseline, replace(config, data=data, run=run))


def _refuse_other_stage(options: TrainOptions, config: Config) -> None:
    """Raise UserError for settings that this stage, or these weights, do not read."""
    usual = preset(options.preset, stage=options.stage, recipe=options.recipe, towers=options.towers)
    usual = baselines.apply(options.baseline, usual)
    where, unread = "in stage 1", _STAGE_2_FIELDS
    if options.stage == 2:
        where = "in stage 2 of the paper recipe"
        unread = {} if config.reconstructs else _RECONSTRUCTION_FIELDS
        if options.clip_weights and config.model.temperature != usual.model.temperature:
            raise UserError("--model.temperature has no effect with --clip-weights, which has its own. Remove it.")
    for section, names in unread.items():
        ours, theirs = getattr(config, section), getattr(usual, section)
        for name in names:
            if getattr(ours, name) != getattr(theirs, name):
                raise UserError(f"--{section}.{name.replace('_', '-')} has no effect {where}. Remove it.")


def _split_sections(args: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split argv into plain options and those of a section (--model.patch 16), each with the values that follow it."""
    plain: list[str] = []
    section: list[str] = []
    target = plain
    for arg in args:
        if arg.startswith("-") and not arg.lstrip("-").replace(".", "", 1).isdigit():
            target = section if "." in arg.partition("=")[0] else plain
        target.append(arg)
    return plain, section


def _suggest_section(args: Sequence[str]) -> None:
    """Raise UserError for an option that only a section has, with the section's name (--optim.learning-rate)."""
    known = set(get_type_hints(TrainOptions))
    homes = {field: home for home, kind in get_type_hints(Sections).items() for field in get_type_hints(kind)}
    for option in map(option_of, args):
        field = option.removeprefix("--").replace("-", "_")
        if option.startswith("--") and field in homes and field not in known:
            raise UserError(f"there is no {option}. Use --{homes[field]}.{option.removeprefix('--')}.")


def _documented_sections() -> type[Sections]:
    """Return `Sections` with the docstring of each section's class as its help."""
    kinds: dict[str, Any] = {
        name: Annotated[kind, tyro.conf.arg(help=inspect.cleandoc(kind.__doc__ or ""))]
        for name, kind in get_type_hints(Sections).items()
    }
    about = {"__doc__": Sections.__doc__}
    return make_dataclass("Sections", kinds.items(), bases=(Sections,), frozen=True, namespace=about)
