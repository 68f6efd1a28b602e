"""`anytouch train`: pre-train, or go on with a run."""

from __future__ import annotations

import signal

from anytouch_jax.cli.options import Train
from anytouch_jax.cli.words import log
from anytouch_jax.config import Config, baselines, preset
from anytouch_jax.errors import UserError
from anytouch_jax.train.progress import Terminated, terminating

# Fields of `config.Objective`, and of other sections, that only one stage reads.
_ALIGNING: tuple[str, ...] = ("alpha_tv", "alpha_tl", "alpha_vl", "touch_text_sum", "match_weight", "match_keep")
_ALIGNING += ("reconstruct", "groups", "centre")
_TOWERS = {"model": ("match_head", "lora_rank", "lora_alpha", "temperature"), "loader": ("negatives",)}
_MASKING: tuple[str, ...] = ("mask_ratio", "norm_pix_loss", "next_frame")


def run(options: Train, config: Config) -> int:
    """Train or go on, alone or as one of several processes; 0 also after SIGTERM (saved), 130 after Ctrl-C (saved)."""
    baseline = baselines.find(options.baseline)
    if options.stage == 2 and options.init and not baseline.starts_from_stage1:
        raise UserError(f"baseline {baseline.name} has no stage 1: leave out --init")
    if options.stage == 1 and options.towers == "pretrained" and not options.clip:
        raise UserError("--towers pretrained needs CLIP weights: stage 1 starts its touch encoder from those of --clip")
    if options.stage == 2 and options.clip and options.towers != "pretrained":
        raise UserError("--clip gives stage 2 the towers of CLIP: add --towers pretrained, or leave --clip out")
    if options.stop_after is not None and options.stop_after < 0:
        raise UserError(f"--stop-after must be 0 or more, not {options.stop_after}")
    _refuse_unread(options, config)
    try:
        with terminating():
            return _train(options, config)
    except Terminated:
        log(f"stopped by SIGTERM before a step of {options.run} was under way; the same command starts it, or goes on")
        return 0


def _refuse_unread(options: Train, config: Config) -> None:
    """Raise UserError for settings that this stage, or these weights, do not read: they would do nothing."""
    usual = preset(options.preset, stage=options.stage, recipe=options.recipe, towers=options.towers)
    usual = baselines.apply(options.baseline, usual)
    where, unread = "in stage 1", {"objective": _ALIGNING, **_TOWERS}
    if options.stage == 2:
        where = "in stage 2 without --objective.reconstruct"
        unread = {"objective": () if config.objective.reconstruct else _MASKING}
        if options.clip and config.model.temperature != usual.model.temperature:
            raise UserError("--model.temperature does nothing with --clip, whose temperature is taken; leave it out")
    for section, names in unread.items():
        ours, theirs = (getattr(one, {"loader": "data"}.get(section, section)) for one in (config, usual))
        for name in names:
            if getattr(ours, name) != getattr(theirs, name):
                raise UserError(f"--{section}.{name.replace('_', '-')} does nothing {where}; leave it out")


def _train(options: Train, config: Config) -> int:
    from anytouch_jax.pretrain import pretrain
    from anytouch_jax.train.distributed import joined
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    with joined() as place:
        result = pretrain(
            config, options.run, init=options.init, clip=options.clip, stop_after=options.stop_after, log=log
        )
    if result.interrupted == signal.SIGINT:
        return 130
    if place is None or place.index == 0:
        log(f"{options.run}: {result.step} of {config.run.steps} steps")
    return 0
