"""`anytouch train`: pre-training, or continuing a run."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from operator import attrgetter
from pathlib import Path
from typing import Literal, NamedTuple, get_type_hints

from anytouch_jax import doors
from anytouch_jax.cli.arguments import is_option, options_of, parse_options, spelled
from anytouch_jax.cli.output import log
from anytouch_jax.config import (
    OWN_SENSOR,
    Config,
    DataConfig,
    LossConfig,
    ModelConfig,
    OptimConfig,
    PresetName,
    RunConfig,
    SimulatedConfig,
    check_spelling,
    preset,
    presets,
)
from anytouch_jax.config.parsing import Count, NotNegative, Seed
from anytouch_jax.errors import Terminated, UserError

# Fields that one stage alone reads.
_STAGE_2_FIELDS = (
    "objective.alpha_tv",
    "objective.alpha_tl",
    "objective.alpha_vl",
    "objective.match_weight",
    "objective.match_keep",
    "objective.groups",
    "objective.center_embeddings",
    "model.match_head",
    "model.lora_rank",
    "model.lora_alpha",
    "model.temperature",
    "data.negatives",
)
_RECONSTRUCTION_FIELDS = (
    "objective.mask_ratio",
    "objective.norm_pix_loss",
    "objective.next_frame",
    "objective.next_frame_residual",
)


@dataclass(frozen=True)
class TrainOptions:
    """Pre-train stage 1 (masked autoencoding, next frame) or stage 2 (alignment, matching).

    Example: anytouch train --stage 1 --data manifest.csv --run runs/stage1 --preset tiny --steps
    800

    Run the same command again to continue from the last checkpoint. Sections of the configuration
    are options too, such as --model.patch 16 or --optim.learning-rate 1e-3. `--help-all` lists
    them.
    """

    data: tuple[Path, ...]  # Manifests (.csv or .parquet) to train on.
    run: Path  # Run folder: config.json, metrics.jsonl, checkpoints/, figures/.
    # 1 learns from pixels. 2 aligns touch, vision and text, and matches sensors.
    stage: Literal[1, 2] = 1
    preset: PresetName = "tiny"  # Sizes of the network. large is the paper's.
    # Follow the paper's text, or the authors' released code.
    recipe: Literal["paper", "release"] = "paper"
    towers: Literal["scratch", "pretrained"] = "scratch"
    """Stage 2: train small image and text towers, or start from CLIP weights (--clip-weights)."""
    # Train a baseline or an ablation: unitouch, tlv_link, t3, static_only, no_matching, ...
    baseline: str = "anytouch"
    # Start from this stage-1 run or weights file: AnyTouch, DINOv2, ViT-MAE, ViT or CLIP.
    init: Path | None = None
    # CLIP weights (HF or OpenCLIP): a file, or a folder with tokenizer.json.
    clip_weights: Path | None = None
    steps: Count[int | None] = None  # Steps of the whole schedule (default: 1000).
    # Stop after this many steps, without changing the schedule.
    stop_after: NotNegative[int | None] = None
    save_every: NotNegative[int | None] = None  # Steps between checkpoints (default: 200).
    batch: Count[int | None] = None  # Samples per step (default: the preset's).
    seed: Seed = 0  # Random seed.
    # Stop at a sample that cannot be read, or replace and count it.
    on_bad_sample: Literal["error", "skip"] = "error"
    tensorboard: bool = False  # Also write TensorBoard events.
    curve: bool = False  # Draw the loss in the terminal while training.


@dataclass(frozen=True)
class Sections:
    """Every field of the configuration.

    The defaults are those of the preset, the recipe and the options of --help.
    """

    model: ModelConfig  # Network: its sizes, its parts, the table of sensors.
    objective: LossConfig  # Weights and choices of the losses.
    optim: OptimConfig  # AdamW and its schedule.
    data: DataConfig  # Reading and augmentation of the data.
    simulated: SimulatedConfig  # Simulated touches (--data simulated).
    run: RunConfig  # Course of the run.


class TrainRequest(NamedTuple):
    """The options of `train` and the configuration that they make."""

    options: TrainOptions
    config: Config


def parse(kind: type[TrainOptions], name: str, args: Sequence[str]) -> TrainRequest:
    """Return the options of `train` and its configuration.

    The sections come second, because their defaults are those of the preset.
    """
    list_all = "--help-all" in args
    plain, sections = _split_sections([arg for arg in args if arg != "--help-all"])
    defaults = TrainOptions((), Path("runs/stage1")) if list_all else None
    options = parse_options(kind, name, plain, defaults, others=_section_names())
    config = _configure(options)
    if not sections and not list_all:
        return TrainRequest(options, config)
    default = Sections(*(getattr(config, section) for section in get_type_hints(Sections)))
    help_name = "train [the options of --help]"
    words = ["--help"] if list_all else sections
    plain_names = {option.name: option.name for option in options_of(TrainOptions)}
    section = parse_options(
        Sections, help_name, words, default, add_help=list_all, others=plain_names
    )
    return TrainRequest(options, replace(config, **vars(section)))


def _section_names() -> dict[str, str]:
    """Return every option of a section by its name, and by its last word for who forgot the rest.

    Where two sections have the same last word, the first one answers to it.
    """
    names = [option.name for option in options_of(Sections)]
    short = {f"--{name.rpartition('.')[2]}": name for name in reversed(names)}
    return short | {name: name for name in names}


def run(request: TrainRequest) -> int:
    """Train or continue, alone or as one of several processes.

    Returns 0 after SIGTERM and 130 after Ctrl-C, both saved.
    """
    options = request.options
    config = _with_own_sensors(request.config)
    # Wrong words are refused before jax and the networks are imported, which takes seconds.
    _refuse_unread(options, config)
    _refuse_unknown(options, config)
    try:
        return _train(options, config)
    except Terminated:
        log(_before_first_step(options.run, "SIGTERM"))
        return 0
    except KeyboardInterrupt:
        log(_before_first_step(options.run, "Ctrl-C"))
        return 130


def _train(options: TrainOptions, config: Config) -> int:
    from anytouch_jax.train.mesh import enable_compilation_cache, joined
    from anytouch_jax.train.progress import terminating
    from anytouch_jax.training import pretrain

    with terminating():
        enable_compilation_cache()
        with joined() as place:
            result = pretrain(
                config,
                options.run,
                init=options.init,
                clip=options.clip_weights,
                stop_after=options.stop_after,
                log=log,
                curve=options.curve,
            )
    if result.interrupted == signal.SIGINT:
        return 130
    if place is None or place.index == 0:
        log(f"{options.run}: {result.step} of {config.run.steps} steps")
    return 0


def _before_first_step(run: Path, word: str) -> str:
    """Return what a run that was stopped while it started tells: nothing new, nothing lost."""
    return (
        f"stopped by {word} before the first step of {run}. Nothing new was saved, and earlier "
        "checkpoints are kept. Run the same command again to continue."
    )


def _with_own_sensors(config: Config) -> Config:
    """Return the configuration with tokens for the own sensors among the simulated ones.

    They are folders NAME.sensor of `anytouch sensor fit`.
    """
    folders = [word for word in config.simulated.sensors if word.endswith(OWN_SENSOR)]
    if not folders:
        return config
    from anytouch_jax.sim.sensing.own import read_numbers

    own = [read_numbers(folder).name for folder in folders]
    names = dict.fromkeys((*config.model.sensors, *own))
    return replace(config, model=replace(config.model, sensors=tuple(names)))


def _configure(options: TrainOptions, *, usual: bool = False) -> Config:
    """Return the configuration of the preset, the recipe, the short options and the baseline.

    With `usual` the short options are left out.
    """
    config = preset(
        options.preset, stage=options.stage, recipe=options.recipe, towers=options.towers
    )
    if usual:
        return presets.apply_baseline(options.baseline, config)
    short = {
        "data.manifests": tuple(map(str, options.data)),
        "data.on_bad_sample": options.on_bad_sample,
        "data.batch_size": options.batch,
        "run.seed": options.seed,
        "run.steps": options.steps,
        "run.save_every": options.save_every,
        "run.tensorboard": options.tensorboard,
    }
    given = {name: value for name, value in short.items() if value is not None}
    return presets.apply_baseline(options.baseline, config.with_settings(given))


def _refuse_unread(options: TrainOptions, config: Config) -> None:
    """Raise UserError for options that do not go together, or that this stage does not read."""
    baseline = presets.find_baseline(options.baseline)
    if options.stage == 2 and options.init and not baseline.starts_from_stage1:
        raise UserError(f"baseline {baseline.name} has no stage 1. Remove --init.")
    if options.stage == 1 and options.towers == "pretrained" and not options.clip_weights:
        raise UserError(
            "--towers pretrained starts the touch encoder of stage 1 from CLIP. Add --clip-weights."
        )
    if options.stage == 2 and options.clip_weights and options.towers != "pretrained":
        raise UserError(
            "--clip-weights needs --towers pretrained in stage 2. Add it, or remove --clip-weights."
        )
    usual = _configure(options, usual=True)
    for field, reason in _unread_fields(options, config).items():
        value = attrgetter(field)
        if value(config) != value(usual):
            raise UserError(f"{spelled(field)} has no effect {reason}. Remove it.")


def _unread_fields(options: TrainOptions, config: Config) -> dict[str, str]:
    """Return the fields that a run does not read, and why."""
    if options.stage == 1:
        return dict.fromkeys(_STAGE_2_FIELDS, "in stage 1")
    unread: dict[str, str] = {}
    if not config.reconstructs:
        unread |= dict.fromkeys(_RECONSTRUCTION_FIELDS, "in stage 2 of the paper recipe")
    if options.clip_weights:
        unread["model.temperature"] = "with --clip-weights, which has its own"
    return unread


def _refuse_unknown(options: TrainOptions, config: Config) -> None:
    """Raise UserError for words that are no sensor, no split, no objective and no file.

    What only a look into the data can tell, such as a data set's name, is left to that.
    """
    from anytouch_jax.data.manifest.schema import SPLITS
    from anytouch_jax.weights.registry import list_encoders

    for name in config.model.sensors:
        check_spelling(name)
    for name in config.simulated.sensors:
        if not name.endswith(OWN_SENSOR):
            check_spelling(name, config.model.sensors)
    if config.data.split not in SPLITS:
        raise UserError(
            f"--data.split {config.data.split} is no split. Choose one of {', '.join(SPLITS)}."
        )
    for name, _ in config.objective.terms:
        if name not in doors.OBJECTIVES:
            raise UserError(
                f"--objective.terms names {name!r}, which is no objective. Choose one of "
                f"{', '.join(doors.OBJECTIVES)}."
            )
    for name in config.data.manifests:
        if name in doors.BATCHES or Path(name).expanduser().exists():
            continue
        if near := get_close_matches(name, doors.BATCHES, 1):
            raise UserError(f"there is no manifest {name}. Did you mean --data {near[0]}?")
        raise UserError(
            f"there is no manifest {name}. Name a .csv or .parquet file with --data, or "
            f"{' or '.join(doors.BATCHES)}."
        )
    continues = (options.run / "checkpoints").exists()
    for option, path in (("--init", options.init), ("--clip-weights", options.clip_weights)):
        # A run that continues does not read them.
        if path is not None and not continues and not _may_exist(path):
            names = ", ".join(list_encoders())
            raise UserError(
                f"{option} {path} does not exist; give the path of a run folder or a weights file, "
                f"or one of {names}"
            )


def _may_exist(weights: Path) -> bool:
    """Return whether weights are a file, or a name or an address that is read later."""
    from anytouch_jax.weights.registry import FORMER, list_encoders

    # a Path makes hf:/ of hf://
    named = str(weights) in (*list_encoders(), FORMER) or str(weights).startswith("hf:")
    return named or weights.expanduser().exists()


def _split_sections(args: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split argv into plain options and those of a section, such as --model.patch 16.

    Values stay with the option before them.
    """
    plain: list[str] = []
    section: list[str] = []
    target = plain
    for arg in args:
        if is_option(arg):
            has_section = "." in arg.partition("=")[0]
            target = section if has_section else plain
        target.append(arg)
    return plain, section
