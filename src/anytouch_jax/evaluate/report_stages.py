"""The encoders of a report: those of both stages, and an untrained one beside them."""

from __future__ import annotations

from pathlib import Path

from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import RANDOM
from anytouch_jax.evaluate.tables import as_text


def encoders_of(stage1: Path, stage2: Path, seed: int) -> dict[str, Encoder]:
    """Return the untrained encoder and those of two runs, by their names in the report."""
    first = encoder_of_stage(stage1, 1)
    second = encoder_of_stage(stage2, 2)
    return {RANDOM: random_encoder(first.config, seed), "stage 1": first, "stage 2": second}


def encoder_of_stage(run: Path, stage: int) -> Encoder:
    """Return the encoder of a run.

    Raises UserError for a weights file, which has no losses, and for another stage.
    """
    if run.is_file():
        raise UserError(
            f"--stage{stage} {run} is a weights file. Give the folder of a run of stage {stage}."
        )
    encoder = load_encoder(run)
    if encoder.config.stage != stage:
        meant = "the stage 1 from which stage 2 started"
        if stage == 2:
            meant = "a stage 2 that started from stage 1"
        raise UserError(
            f"--stage{stage} {run} is a run of stage {encoder.config.stage}. Give {meant}."
        )
    return encoder


def lineage(stage1: Path, second: Encoder) -> str:
    """Return a sentence if stage 2 did not start from this stage 1, else nothing."""
    init = (second.metadata.get("source") or {}).get("init")
    if init is None:
        return "Stage 2 started from no run, so this stage 1 is no part of it."
    began = Path(init)
    same = began.resolve() == stage1.resolve() or (
        not began.exists() and began.name == stage1.resolve().name
    )
    name = as_text(began.name)
    if same:
        return ""
    return f"Stage 2 started from another run ({name}), so this stage 1 is no part of it."
