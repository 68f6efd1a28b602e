"""The last section of a report: how much data there is, how both runs were trained, losses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.evaluate import plots
from anytouch_jax.evaluate.pages import Section
from anytouch_jax.evaluate.report_stages import lineage
from anytouch_jax.evaluate.tables import markdown_table


def runs_section(
    table: Manifest, runs: Mapping[str, Path], encoders: Mapping[str, Encoder], folder: Path
) -> Section:
    """Return how much data of which sensors there is, and how both runs were trained.

    Args:
        table: the frames.
        runs: folders of "stage 1" and "stage 2".
        encoders: of "stage 1" and "stage 2".
        folder: of the report, for figures.
    """
    first = encoders["stage 1"]
    second = encoders["stage 2"]
    path = folder / "figures" / "losses.png"
    plots.loss_curves(path, runs)
    told = lineage(runs["stage 1"], second)
    split = table.text_column("split")
    objects = table.text_column("object")
    touch = table.codes("touch", own=True)
    sensors = table.text_column("sensor")
    rows = []
    for name in manifests.SPLITS:
        part = split == name
        if part.any():
            touches = len(np.unique(touch[part & (touch >= 0)]))
            things = len(set(objects[part]) - {""})
            listed = ", ".join(sorted(set(sensors[part])))
            rows.append((name, part.sum(), touches, things, listed))
    text = (
        f"Data {table.content_hash[:12]}. Stage 1: preset {first.config.preset}, "
        f"{first.config.run.steps} steps of {first.config.data.batch_size}. Stage 2: "
        f"{second.config.run.steps} steps of {second.config.data.batch_size}, recipe "
        f"{second.config.recipe}, towers {second.config.towers}. All scores above are of split "
        "test. Pale: the loss of each step. Strong: its running mean over a twentieth of the run."
    )
    backgrounds = (first.config.data.background, second.config.data.background)
    if backgrounds[0] != backgrounds[1]:
        told += (
            f" Stage 1 was trained with background {backgrounds[0]}, stage 2 with background "
            f"{backgrounds[1]}."
        )
    counted = markdown_table(("split", "frames", "touches", "objects", "sensors"), rows)
    notes = ""
    if told:
        notes = f"**{told.strip()}**"
    return Section("Data and runs", text, counted, path, notes)
