"""Scores of a label probe: every head on the features of one source."""

from __future__ import annotations

from anytouch_jax.encoder.arrays import Array
from anytouch_jax.evaluate import feature_cache, heads
from anytouch_jax.evaluate.array_probes import leave_groups_out, probe_features
from anytouch_jax.evaluate.feature_cache import FeatureSource
from anytouch_jax.evaluate.options import LabelProbeOptions
from anytouch_jax.evaluate.results import ProbeResult
from anytouch_jax.evaluate.scoring import Subsets
from anytouch_jax.evaluate.tasks import TaskRows

HEADS: dict[str, heads.HeadName] = {"linear": "linear", "kNN": "knn"}  # by their names in tables


def features_of(source: FeatureSource, rows: TaskRows, frames: int) -> Array:
    """Return features (n, d); of raw pixels their principal components."""
    if source.scaling == "common":
        return feature_cache.pixel_components(source.store, rows)
    return source.store.get(rows.rows, frames)


def probe_source(
    source: FeatureSource,
    x: Array,
    rows: TaskRows,
    options: LabelProbeOptions,
    subsets: Subsets,
    left_out: str,
    measured: bool,
) -> list[ProbeResult]:
    """Return the results of one source of features: of each head, the linear one first.

    Args:
        source: of the features.
        x: f32 (n, d).
        rows: their labels, groups and splits.
        options: of the probe.
        subsets: parts of the rows that are scored too.
        left_out: what is left out in turn, instead of the split.
        measured: the label is continuous.
    """
    if left_out:
        return [
            leave_groups_out(
                x,
                rows.labels,
                rows.groups,
                measured=measured,
                scaling=source.scaling,
                subsets=subsets,
                name=f"{source.name}: linear, {left_out} left out",
            )
        ]
    results = []
    for shown, name in HEADS.items():
        scaling: heads.Scaling = source.scaling if name == "linear" else "column"
        results.append(
            probe_features(
                x,
                rows.labels,
                rows.groups,
                rows.split,
                heads.ProbeHead(name, scaling),
                measured=measured,
                protocol=options.protocol,
                seeds=options.seeds,
                subsets=subsets,
                name=f"{source.name}: {shown}",
            )
        )
    return results
