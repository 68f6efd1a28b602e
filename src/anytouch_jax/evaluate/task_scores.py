"""Scores of planned tasks: each head on all splits of all seeds, for one source of features."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from anytouch_jax.encoder.arrays import Log
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import feature_cache, splits, statistics
from anytouch_jax.evaluate.feature_cache import FeatureSource
from anytouch_jax.evaluate.heads import GradientRecipe, ProbeHead, cost_sentence
from anytouch_jax.evaluate.logistic import threads
from anytouch_jax.evaluate.options import TaskProbeOptions
from anytouch_jax.evaluate.scoring import constant_prediction, predict, score_sums
from anytouch_jax.evaluate.splits import LabelledFeatures
from anytouch_jax.evaluate.statistics import GroupSums, Protocol
from anytouch_jax.evaluate.task_plans import TaskPlan
from anytouch_jax.evaluate.verdicts import Runs
from anytouch_jax.progress import tracked


def score_source(
    source: FeatureSource,
    plans: Sequence[TaskPlan],
    options: TaskProbeOptions,
    runs: Runs,
    log: Log = lambda _: None,
) -> list[dict[str, Any]]:
    """Return the results of one source on all tasks.

    Args:
        source: of the features.
        plans: of the tasks.
        options: of the probe.
        runs: gets the test rows of every seed.
        log: is called with tasks of which the fits take long.
    """
    for length in sorted({plan.frames for plan in plans}):
        wanted = [plan.rows.rows.ravel() for plan in plans if plan.frames == length]
        source.store.add(np.concatenate(wanted), length)
    protocols: tuple[Protocol, ...] = (options.protocol,)
    if options.protocol == "released":
        protocols = ("grouped", "released")
    recipe = options.recipe or GradientRecipe()
    results = []
    for plan in tracked(plans, f"tasks with {source.name}"):
        labelled = _labelled(source, plan)
        cuts = len(splits.seeded_splits(plan.roles, 0, options.protocol))
        if "linear" in options.heads:
            note = cost_sentence(labelled.x, labelled.y, len(plan.names), cuts * options.seeds)
            if note:
                log(f"{plan.task.name}: {note}")
        notes = [*plan.notes, *source.notes(plan.rows.sensors)]
        about = {"frames": plan.frames, "order": options.order}
        if plan.frames == 1:
            about["order"] = "right"
        for name, protocol in itertools.product(options.heads, protocols):
            head = ProbeHead(name, source.scaling, recipe=recipe)
            scored, own_runs = _score(labelled, plan, head, protocol, options.seeds)
            names = {
                "features": source.name,
                "task": plan.task.name,
                "head": name,
                "protocol": protocol,
            }
            runs[tuple(names.values())] = own_runs
            results.append(names | scored | about | {"notes": notes + scored["notes"]})
    return results


def _labelled(source: FeatureSource, plan: TaskPlan) -> LabelledFeatures:
    """Return the features and labels of a task; of raw pixels their principal components."""
    x = source.store.get(plan.rows.rows, plan.frames)
    if not np.isfinite(x).all():
        raise UserError(
            f"Task {plan.task.name}: features are NaN or infinite. Did the training diverge?"
        )
    if source.scaling == "common":
        # Components are fitted on rows that are never tested, if there are any: with folds over
        # all rows there are none, and components see no label.
        fitted = np.ones(len(x), bool)
        if splits.split_scheme(plan.roles)[0] == "split":
            fitted = ~plan.roles.test
        with threads(x.size * feature_cache.COMPONENTS):
            x = feature_cache.principal_components(x, fitted, solver="randomized")
    return LabelledFeatures(x, plan.roles.y, plan.names, plan.roles.groups)


@dataclass
class _Tally:
    """What the fits of all seeds leave behind."""

    chosen: list[float]
    sizes: list[int]
    unfinished: int = 0


def _score(
    data: LabelledFeatures, plan: TaskPlan, head: ProbeHead, protocol: Protocol, seeds: int
) -> tuple[dict[str, Any], list[GroupSums]]:
    """Score a head on all splits of all seeds. Return the test rows of each seed, too."""
    roles = plan.roles
    tally = _Tally([], [])
    runs = list[GroupSums]()
    baselines = list[GroupSums]()
    for seed in tracked(range(seeds), "splits"):
        cuts = splits.seeded_splits(roles, seed, protocol)
        nothing_drawn = protocol == "released" and len(cuts) == 1 and head.name != "gradient"
        if seed and nothing_drawn:
            runs.append(runs[0])  # every seed is the same fit
            continue
        predicted = []
        constant = []
        for cut in tracked(cuts, "folds"):
            found = predict(data, cut, replace(head, seed=seed), protocol)
            predicted.append(found.predicted)
            constant.append(constant_prediction(data, cut))
            tally.chosen.append(found.selected.option)
            tally.sizes.append(len(cut.fit))
            tally.unfinished += found.model is not None and not found.model.fit.finished
        tested = np.concatenate([cut.test for cut in cuts])
        runs.append(score_sums(data, np.concatenate(predicted), tested))
        baselines.append(score_sums(data, np.concatenate(constant), tested))
    scores = statistics.scores(runs, baselines, roles.regression)
    if roles.regression:
        scores["unit"] = plan.task.unit
    notes = []
    if tally.unfinished:
        notes.append(f"{tally.unfinished} of {len(tally.chosen)} fits did not converge")
    about = {
        "train": round(float(np.mean(tally.sizes))),
        "test": len(runs[0].groups),
        "classes": data.names.tolist(),
        "groups": len(np.unique(runs[0].groups)),
        "chosen": tally.chosen,
        "notes": notes,
    }
    return scores | about, runs
