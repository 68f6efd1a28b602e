"""Report sections on features: the geometry of their space, and probes of labels."""

from __future__ import annotations

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
from anytouch_jax.evaluate.tables import listed_notes, markdown_table
from anytouch_jax.progress import tracked

LABELS = ("hardness", "roughness", "material", "indenter", "force")
_T_SNE_ROWS = 800


def space_section(study: Study, out: Path, seed: int) -> tuple[Section, list[plots.Space]]:
    """Return the section and the numbers of the feature spaces.

    These are alignment, uniformity, silhouettes and a t-SNE.
    """
    rows = study.test(study.rows)
    sensors = study.manifest.text_column("sensor")[rows]
    objects = study.manifest.text_column("object")[rows]
    touch = study.manifest.codes("touch", own=True)[rows]
    drawn = np.sort(np.random.default_rng(seed).permutation(len(rows))[:_T_SNE_ROWS])
    features = {name: study.test(values) for name, values in study.classes.items()}
    spaces = [
        plots.describe(values, sensors, objects, touch, name=name)
        for name, values in features.items()
    ]
    points = {
        name: plots.tsne(values[drawn], seed=seed)
        for name, values in tracked(features.items(), "t-SNE")
    }
    path = out / "figures" / "tsne.png"
    plots.tsne_panels(path, points, sensors[drawn], objects[drawn])
    lines = []
    for space in spaces:
        figures = (
            space.alignment,
            space.uniformity,
            space.silhouette_sensor,
            space.silhouette_object,
        )
        cells = ["-" if value is None else f"{value:.3f}" for value in figures]
        lines.append((space.name, *cells, space.rows))
    head = (
        "features",
        "alignment",
        "uniformity",
        "silhouette by sensor",
        "silhouette by object",
        "frames",
    )
    text = (
        "The same touches by several sensors. Alignment: mean squared distance of one touch by two "
        "sensors (0 is best). Uniformity: lower is more even. Silhouette (-1 to 1): good alignment "
        "makes it low by sensor and high by object."
    )
    return Section("The space of touches", text, markdown_table(head, lines), path), spaces


def probes_section(study: Study, out: Path) -> tuple[Section, dict[str, Any]]:
    """Return probes of labels on held-out objects.

    A note names each label that cannot be probed.
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
    text = (
        "A linear probe on frozen features (class token and mean of patches), fitted on train, "
        "tested on test."
    )
    parts = "\n\n".join(
        f"### {label}\n\n{probing.probe_table(scored).strip()}" for label, scored in results.items()
    )
    section = Section("Probes", text, parts, path if bars else None, listed_notes(notes))
    return section, {"found": results, "notes": notes}
