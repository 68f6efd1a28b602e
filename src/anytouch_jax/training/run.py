"""Execution of a pre-training run that was resolved."""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from pathlib import Path

import jax
from jax.sharding import Mesh

from anytouch_jax import objectives
from anytouch_jax.config import Config
from anytouch_jax.errors import refuse_forked
from anytouch_jax.train.loop import FitOptions, FitResult, Work, fit_work
from anytouch_jax.train.mesh import make_mesh
from anytouch_jax.train.pace import Deadline
from anytouch_jax.train.progress import alone_in, silent
from anytouch_jax.training.figures import draw_reconstructions
from anytouch_jax.training.start import TOKENIZER, Log, Start, resolve


def pretrain(  # noqa: PLR0913  a keyword for each option of `anytouch train`
    config: Config,
    run: str | Path,
    *,
    init: str | Path | None = None,
    clip: str | Path | None = None,
    stop_after: int | None = None,
    log: Log = print,
    mesh: Mesh | None = None,
    curve: bool = False,
    until: float | None = None,
) -> FitResult:
    """Train stage 1 or stage 2 in the folder `run`, or resume it (Sec. 3.6).

    Args:
        config: The settings, see `preset`.
        run: The run folder, made if it is missing. A run in it is resumed.
        init: A stage-1 run or AnyTouch weights that stage 2 starts from, or weights for the touch
            encoder of stage 1: AnyTouch, DINOv2, ViT-MAE, ViT, DeiT or CLIP. A resumed run does
            not read it.
        clip: CLIP weights for the towers, and for the touch encoder of stage 1. A resumed run does
            not read them.
        stop_after: End after this many steps in all, without changing the schedule.
        log: Gets one sentence at a time.
        mesh: The devices to train on. All by default.
        curve: Draw the loss on a terminal.
        until: End at this time of `time.monotonic`, which the schedule then follows.

    Raises:
        UserError: For a mistake in the settings, the data or the folder.
    """
    refuse_forked()
    mesh = mesh or make_mesh(fsdp=config.run.fsdp)
    # Every process reads other samples, so each reports those that it could not read.
    start = resolve(config, Path(run), init=init, clip=clip, mesh=mesh, log=log)
    if jax.process_index() > 0:
        log = silent
    for note in start.notes:
        log(note)
    options = FitOptions(
        stop_after=stop_after,
        pace=None if until is None else Deadline(until),
        on_report=partial(draw_reconstructions, start=start),
        log=log,
        mesh=mesh,
        curve=curve,
    )
    return execute(start, options)


def execute(start: Start, options: FitOptions) -> FitResult:
    """Train the run of a start, alone in its folder."""
    config = start.config
    loss = objectives.stage1_loss if config.stage == 1 else objectives.stage2_loss
    work = Work(
        params=start.params,
        loss_fn=partial(loss, net=start.net, config=config),
        batches=start.batches.stream,
        trained=partial(objectives.trained_by, config=config),
        examples=start.batches.examples,
        metadata=start.metadata,
    )
    lead = jax.process_index() == 0
    with alone_in(start.run) if lead else nullcontext():
        if lead and start.tokenizer is not None and not start.resumes:
            start.tokenizer.save(start.run / TOKENIZER)
        return fit_work(config, work, start.run, options)
