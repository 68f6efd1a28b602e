"""Checks of a run's settings, before its data and weights are read."""

from __future__ import annotations

from pathlib import Path

import jax

from anytouch_jax import doors
from anytouch_jax.config import Config
from anytouch_jax.errors import UserError
from anytouch_jax.objectives import find_objective
from anytouch_jax.train.progress import begun_with

PathLike = str | Path


def check_start(
    config: Config,
    run: Path,
    *,
    init: PathLike | None,
    clip: PathLike | None,
    resumes: bool,
    has_tokenizer: bool,
) -> None:
    """Raise UserError for settings that this machine or this stage cannot follow.

    So it does for missing weights, and for a run folder of another stage.

    Args:
        config: The settings.
        run: The run folder, which need not exist.
        init: A stage-1 run or weights, or None.
        clip: CLIP weights, or None.
        resumes: Whether the folder has a complete checkpoint.
        has_tokenizer: Whether the folder has a tokenizer.
    """
    _check_arithmetic(config)
    _check_stage(config, init, clip)
    for name, _ in config.objective.terms:
        find_objective(name)
    if run.is_file():
        raise UserError(f"{run} is a file, not a folder; choose another --run")
    needs_clip = config.towers == "pretrained" and clip is None
    # A run that continues has the weights, and the tokenizer if it needs one.
    complete = resumes and (config.model.text is None or has_tokenizer)
    if needs_clip and not complete:
        raise UserError(
            "--towers pretrained needs CLIP weights: add --clip-weights <folder or file>, with "
            "tokenizer.json in the same folder"
        )
    earlier = begun_with(run)
    if earlier is not None and earlier.stage != config.stage:
        raise UserError(
            f"{run} has a run of stage {earlier.stage}; choose another --run for stage "
            f"{config.stage}"
        )


def check_sources(words: tuple[str, ...]) -> None:
    """Raise UserError for words of --data in `doors.BATCHES` that cannot go together here."""
    if len(words) > 1:
        raise UserError(f"--data names {' and '.join(words)}; leave one out")
    if words and jax.process_count() > 1:
        raise UserError(f"--data {words[0]} is for one process; leave it out, or start one process")


def source_words(config: Config) -> tuple[str, ...]:
    """Return the words of --data that name a source of batches instead of a manifest."""
    return tuple(name for name in config.data.manifests if name in doors.BATCHES)


def _check_arithmetic(config: Config) -> None:
    """Raise UserError for types and forms of arithmetic that this machine lacks."""
    model = config.model
    if model.attention == "cudnn":
        if jax.default_backend() != "gpu":
            raise UserError("--model.attention cudnn needs a GPU of NVIDIA; leave it out here")
        if model.dtype != "bfloat16":
            raise UserError(
                "--model.attention cudnn computes in 16 bits: add --model.dtype bfloat16, or "
                "leave it out"
            )
    has_x64 = jax.config.read("jax_enable_x64")
    if model.dtype == "float64" and not has_x64:
        raise UserError(
            "--model.dtype float64 needs JAX_ENABLE_X64=1 in the environment, else jax computes "
            "in float32"
        )
    if has_x64 and model.dtype != "float64":
        raise UserError(
            "JAX_ENABLE_X64 is set, which changes the random numbers and the checkpoints of a "
            "run: unset it, or add --model.dtype float64"
        )


def _check_stage(config: Config, init: PathLike | None, clip: PathLike | None) -> None:
    """Raise UserError for settings that do not go together in this stage."""
    model = config.model
    has_slots = config.stage == 2 and bool(model.image or model.text)
    if has_slots and config.optim.accumulate > 1:
        raise UserError(
            "--optim.accumulate must be 1 in stage 2 with RGB images or captions, whose slots "
            "belong to rows of the whole batch; lower --batch instead"
        )
    if model.match_head == "linear" and config.recipe == "paper":
        raise UserError(
            "--model.match-head linear is the head of the release; add --recipe release, or "
            "choose mlp"
        )
    if config.stage == 1 and init is not None and clip is not None:
        raise UserError(
            "--init and --clip-weights both give stage 1 its touch encoder; leave one out"
        )
