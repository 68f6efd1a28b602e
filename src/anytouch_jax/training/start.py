"""Start of a run, resolved once: config, tokenizer, batches, first parameters, metadata."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

from anytouch_jax.batch import BatchSource
from anytouch_jax.config import CLIP_MEAN, CLIP_STD, IMAGENET_MEAN, IMAGENET_STD, Config
from anytouch_jax.data.tokenizer import Tokenizer
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.train.progress import begun_with
from anytouch_jax.training.checks import PathLike, check_start
from anytouch_jax.training.sources import TOKENIZER as TOKENIZER
from anytouch_jax.training.sources import (
    Log,
    RunData,
    open_batches,
    read_data,
    tokenizer_of_run,
    with_vocabulary,
)
from anytouch_jax.weights import checkpoint
from anytouch_jax.weights.start import load_start

Params = dict[str, Any]
CHECKPOINTS = "checkpoints"


@dataclass(frozen=True)
class Start:
    """A run before its first step: all that its settings and its folder decide.

    `config` has the warm-up and the vocabulary of this run. When it resumes, only the shapes of
    `params` matter. `notes` are sentences for the user.
    """

    run: Path
    config: Config
    resumes: bool
    net: Net
    params: Params
    tokenizer: Tokenizer | None
    batches: BatchSource
    notes: tuple[str, ...]
    metadata: dict[str, Any]


def resolve(
    config: Config,
    run: Path,
    *,
    init: PathLike | None,
    clip: PathLike | None,
    mesh: Mesh,
    log: Log,
) -> Start:
    """Return the start of a run. Writes nothing.

    Args:
        config: The settings.
        run: The run folder, which need not exist.
        init: A stage-1 run or weights, see `pretrain`.
        clip: CLIP weights, see `pretrain`.
        mesh: The devices, whose number decides the slots of a batch.
        log: Gets what the loader reports later, such as samples that were replaced.

    Raises:
        UserError: For a mistake in the settings, the data or the folder.
    """
    resumes = bool(checkpoint.steps(run / CHECKPOINTS))
    has_tokenizer = (run / TOKENIZER).exists()
    check_start(config, run, init=init, clip=clip, resumes=resumes, has_tokenizer=has_tokenizer)
    data = read_data(config)
    # Without a checkpoint a tokenizer is left from a start that failed.
    stored_tokenizer = run / TOKENIZER if resumes and has_tokenizer else None
    tokenizer = tokenizer_of_run(config, data, clip, stored_tokenizer)
    config = with_vocabulary(config, tokenizer, data)
    net = build(config.model)
    params = net.init(jax.random.key(config.run.seed))
    stored: dict[str, Any] = {}
    trained: tuple[str, ...] = ()
    if resumes:
        # `fit` reports a damaged checkpoint
        with suppress(checkpoint.CheckpointError):
            stored = checkpoint.read_metadata(run)
        notes = _check_resume(run, data, stored, init=init, clip=clip)
    else:
        first = load_start(params, config, init=init, clip=clip)
        params = first.params
        notes = list(first.notes)
        trained = tuple(first.trained_sensors)
    batches = open_batches(config, data, tokenizer, mesh, log)
    trained_sensors = {*batches.trained_sensors, *trained, *stored.get("seen", ())}
    config = _with_warmup(config, run, batches)
    metadata = {
        "sensors": list(config.model.sensors),
        "seen": [name for name in config.model.sensors if name in trained_sensors],
        "preprocessing": _preprocessing(config),
        "source": stored.get("source", {"init": init and str(init), "clip": clip and str(clip)}),
        "data": data.content,
    }
    return Start(
        run=run,
        config=config,
        resumes=resumes,
        net=net,
        params=params,
        tokenizer=tokenizer,
        batches=batches,
        notes=(*notes, *batches.notes),
        metadata=metadata,
    )


def _preprocessing(config: Config) -> dict[str, Any]:
    """Return how images are prepared, for who reads the weights without this package."""
    size = config.model.image_size
    return {
        "touch": {"size": size, "mean": IMAGENET_MEAN, "std": IMAGENET_STD, "channels": "RGB"},
        "image": {"size": size, "mean": CLIP_MEAN, "std": CLIP_STD, "channels": "RGB"},
    }


def _check_resume(
    run: Path, data: RunData, stored: Mapping[str, Any], **paths: PathLike | None
) -> list[str]:
    """Return notes on weights that differ from those that a run started from.

    Raises UserError if it resumes on other rows.
    """
    if stored.get("data") not in (None, data.content):
        raise UserError(
            f"the rows of the manifests have changed since {run} was started; restore them, or "
            f"start another run with --init {run}, whose touch encoder and decoder it starts from"
        )
    if not stored:
        return []
    notes = []
    source = stored.get("source") or {}
    for name, path in paths.items():
        before = source.get(name)
        if path is None:
            continue
        if before is not None and Path(before).resolve() == Path(path).resolve():
            continue
        option = "--clip-weights" if name == "clip" else "--init"
        notes.append(
            f"{run} resumes and was started with {option} {before or '(nothing)'}: {path} is "
            "not read"
        )
    return notes


def _with_warmup(config: Config, run: Path, batches: BatchSource) -> Config:
    """Return the config with a warm-up of one epoch, or less in a short run.

    An epoch is the paper's (appendix "Implementation details"). A run that started without one
    keeps that.
    """
    if config.optim.warmup is not None:
        return config
    earlier = begun_with(run)
    if earlier is not None and earlier.optim.warmup is None:
        return config
    return config.with_settings({"optim.warmup": min(batches.steps_per_epoch, config.warmup)})
