"""Scores of a label probe: every head on the features of one source."""

from __future__ import annotations

import numpy as np

from anytouch_jax.encoder.arrays import Array
from anytouch_jax.evaluate import feature_cache, heads, splits
from anytouch_jax.evaluate.array_probes import leave_groups_out, probe_cuts, probe_features
from anytouch_jax.evaluate.feature_cache import FeatureSource
from anytouch_jax.evaluate.heads import ProbeHead
from anytouch_jax.evaluate.label_rows import LabelPlan
from anytouch_jax.evaluate.options import LabelProbeOptions
from anytouch_jax.evaluate.results import ProbeResult
from anytouch_jax.evaluate.tasks import TaskRows

HEADS: dict[str, heads.HeadName] = {"linear": "linear", "kNN": "knn"}  # by their names in tables


def features_of(source: FeatureSource, rows: TaskRows, frames: int) -> Array:
    """Return features (n, d); of raw pixels their principal components."""
    if source.scaling == "common":
        return feature_cache.pixel_components(source.store, rows)
    return source.store.get(rows.rows, frames)


def cost_of(x: Array, plan: LabelPlan, options: LabelProbeOptions) -> str:
    """Return what to say on the time of the fits before they begin, "" if it is short."""
    if plan.regression:
        return ""
    names, y = np.unique(plan.rows.labels, return_inverse=True)
    # A selection by cross-validation has a fit for each fold, and so have the fits around it.
    fits = 1
    if plan.left_out:
        fits = 10 * splits.FOLDS
    elif plan.cuts:
        fits = len(plan.cuts)
    elif not np.any(plan.rows.split == "val"):
        fits = splits.FOLDS
    # the fit of the chosen penalty, and those on bootstraps, which start from it
    fits += 1 + options.seeds // len(heads.PENALTIES)
    fitted = plan.rows.split != "test"
    if not fitted.any():
        fitted = ~fitted
    return heads.cost_sentence(x[fitted], y[fitted], len(names), fits)


def probe_source(
    source: FeatureSource, x: Array, plan: LabelPlan, options: LabelProbeOptions
) -> list[ProbeResult]:
    """Return the results of one source of features `x` (n, d), the linear head first.

    Args:
        source: what the features are of.
        x: f32 (n, d).
        plan: what is fitted on and tested.
        options: of the probe.
    """
    rows = plan.rows
    if plan.left_out:
        return [
            leave_groups_out(
                x,
                rows.labels,
                rows.groups,
                regression=plan.regression,
                scaling=source.scaling,
                subsets=plan.subsets,
                name=f"{source.name}: linear, {plan.left_out} left out",
            )
        ]
    results = []
    for shown, kind in HEADS.items():
        # kNN compares by cosine, which no scaling of all features changes
        head = ProbeHead(kind, source.scaling if kind == "linear" else "column")
        name = f"{source.name}: {shown}"
        if plan.cuts:
            results.append(_between_sensors(x, plan, head, options, name))
            continue
        results.append(
            probe_features(
                x,
                rows.labels,
                rows.groups,
                rows.split,
                head,
                regression=plan.regression,
                protocol=options.protocol,
                seeds=options.seeds,
                subsets=plan.subsets,
                name=name,
            )
        )
    return results


def _between_sensors(
    x: Array, plan: LabelPlan, head: ProbeHead, options: LabelProbeOptions, name: str
) -> ProbeResult:
    """Return the result of a head that is fitted on one sensor and tested on another."""
    rows = plan.rows
    everywhere = np.full(len(rows.labels), "train")
    data, _, notes = splits.check_rows(
        x, rows.labels, rows.groups, everywhere, regression=plan.regression, tested=False
    )
    notes += (f"fitted on {options.train_sensor}, tested on {options.test_sensor}",)
    return probe_cuts(data, plan.cuts, head, name=name, protocol=options.protocol, notes=notes)
