"""The report's section on probes of labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import plots, probing
from anytouch_jax.evaluate.feature_cache import principal_components
from anytouch_jax.evaluate.heads import ProbeHead
from anytouch_jax.evaluate.pages import Section
from anytouch_jax.evaluate.plots import FractionBar
from anytouch_jax.evaluate.probing import ProbeResult
from anytouch_jax.evaluate.report_study import PIXELS, Study
from anytouch_jax.evaluate.report_words import Claim
from anytouch_jax.evaluate.statistics import paired_gain
from anytouch_jax.evaluate.tables import score_text

LABELS = ("hardness", "roughness", "material", "indenter", "force")


def probes_section(study: Study, out: Path) -> tuple[Section | None, dict[str, Any]]:
    """Return probes of labels on held-out objects, None where there is nothing to draw.

    The second is the results, and a note on each label that cannot be probed.
    """
    table = study.manifest
    rows = study.rows
    notes = list(study.notes)
    features = {
        name: np.concatenate([study.classes[name], study.patches[name]], 1)
        for name in study.classes
    }
    if study.pixels is not None:
        features[PIXELS] = principal_components(study.pixels, study.split == "train")
    objects = table.text_column("object")[rows]
    sequences = table.text_column("sequence")[rows]
    groups = np.where(objects == "", sequences, objects)
    results: dict[str, list[ProbeResult]] = {}
    for label in LABELS:
        if f"label.{label}" not in table.table.column_names:
            notes.append(f"{label}: the manifest has no column label.{label}")
            continue
        values = [table.value(int(row), f"label.{label}") for row in rows]
        regression = any(isinstance(value, float) and value % 1 for value in values)
        scored = list[ProbeResult]()
        try:
            for name, x in features.items():
                # Principal components share one scale: unit spread for each would amplify the
                # smallest.
                head = ProbeHead("linear", "common" if name == PIXELS else "column")
                options: dict[str, Any] = {"regression": regression, "name": name, "seeds": 0}
                scored.append(
                    probing.probe_features(x, values, groups, study.split, head, **options)
                )
        except UserError as error:
            notes.append(f"{label}: not probed: {error}")
        if scored:
            results[label] = scored
    bars = {
        label: {
            one.probe: FractionBar(one.accuracy, one.low, one.high, one.baseline) for one in scored
        }
        for label, scored in results.items()
        if not scored[0].regression
    }
    path = out / "figures" / "probes.png"
    if bars:
        plots.bars(path, bars, label="accuracy")
    section = None
    if bars:
        text = (
            "A linear probe on frozen features (class token and mean of patches), fitted on train, "
            "tested on test. Dashes mark the commonest answer."
        )
        section = Section("Probes", text, figure=path)
    return section, {"found": results, "notes": notes}


def probe_claims(found: Mapping[str, Sequence[ProbeResult]]) -> list[Claim]:
    """Return what probes say of stage 2, each beside the best features without training."""
    claims = []
    for label, several in found.items():
        of = {one.probe: one for one in several}
        best = of.pop("stage 2", None)
        of.pop("stage 1", None)
        if best is None or best.regression or best.outcome is None or not of:
            continue
        other = max(of.values(), key=lambda one: one.accuracy)
        assert other.outcome is not None
        gain = paired_gain([best.outcome.sums], [other.outcome.sums], regression=False)
        guess = f"{other.probe} names {score_text(other.accuracy)}"
        told = score_text(best.accuracy, best.low, best.high)
        claims.append(Claim(f"{label} is named in", told, guess, gain["low"], gain["high"]))
    return claims
