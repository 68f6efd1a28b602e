"""Probes of named tasks and public benchmarks, over several seeds and by both protocols."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import feature_cache, sources, tasks
from anytouch_jax.evaluate.feature_cache import FeatureSource
from anytouch_jax.evaluate.options import Models, Paths, TaskProbeOptions, Tasks
from anytouch_jax.evaluate.task_plans import TaskPlan, plan_tasks
from anytouch_jax.evaluate.task_scores import score_source
from anytouch_jax.evaluate.tasks import TaskRows
from anytouch_jax.evaluate.verdicts import Runs, task_verdicts
from anytouch_jax.files import atomic_write
from anytouch_jax.renamed import PROTOCOLS, keywords


@keywords({"protocol": PROTOCOLS}, join="aggregation")
def probe_tasks(
    models: Models,
    data: Paths | Manifest,
    tasks: Tasks = "all",
    *,
    options: TaskProbeOptions | None = None,
    keep: Runs | None = None,
    log: Log = print,
    **changes: Any,
) -> dict[str, Any]:
    """Probe named tasks with features of every model, of features files, and of the controls.

    The "results" have a JSON-ready dict for each source of features, task, head and protocol.
    `metric` is "accuracy" in 0..1 or "r2". `mean`, `low` and `high` (95 %) are over seeds and test
    groups, and `values` has one a seed. `train` and `test` count rows, `groups` the tested groups.
    `chance` is that of the most frequent class or the mean of train. A regression also has mae,
    mae_low, mae_high and chance_mae in `unit`. Tasks that cannot be probed are "left_out" with
    their reason.

    Args:
        models: names, run folders or weights files of encoders.
        data: manifests, or one that was read.
        tasks: names of `tasks.TASKS` or tasks, or "all" of which the manifest has labels.
        options: all settings; see `TaskProbeOptions`. Protocol "released" reports both.
        keep: gets the test rows of every seed, to compare sources on the same rows.
        log: is called with sentences on what is done.
        changes: settings by name, such as `seeds=3`: fields of `TaskProbeOptions`.

    Raises:
        UserError: for options that have no effect, and if no task can be probed. Tasks and sensors
            are checked before an encoder is loaded.
    """
    options = replace(options or TaskProbeOptions(), **changes)
    if options.seeds < 1:
        raise UserError(f"seeds must be at least 1, not {options.seeds}.")
    table = data if isinstance(data, Manifest) else manifests.read([str(path) for path in data])
    backgrounds = Backgrounds(table)
    # Opened when the first task has passed its checks, so a wrong word is refused before a load.
    opened = cache(lambda: sources.opened(models))

    def among(rows: TaskRows) -> TaskRows:
        return sources.with_gel(rows, backgrounds, opened())

    plans, left_out = plan_tasks(table, tasks, options, among, log)
    probed = _sources(table, opened(), plans, options, backgrounds, log)
    runs: Runs = {} if keep is None else keep
    results: list[dict[str, Any]] = []
    for source in probed:
        # the cost is that of every source, so it is told once
        results += score_source(source, plans, options, runs, log if not results else _silent)
        log(f"probed {source.name}")
    kinds = {plan.task.name: plan.roles.regression for plan in plans}
    report = {
        "manifest": table.content_hash,
        "data": [str(path) for path in table.files],
        "paper": options.paper,
        "seeds": options.seeds,
        "sides": {name: list(side or ()) or None for name, side in options.sides.items()},
        "runs": {
            source.name: dataclasses.asdict(source.encoder.config)
            for source in probed
            if source.encoder
        },
        "left_out": left_out,
        "verdicts": task_verdicts(runs, kinds),
        "results": results,
    }
    if options.out is not None:
        atomic_write(options.out, json.dumps(report, indent=2, allow_nan=False))
    return report


def _silent(_: str) -> None:
    """Log nothing."""


@keywords({"protocol": PROTOCOLS}, join="aggregation")
def probe_benchmark(
    models: Models, data: Paths | Manifest, benchmark: str, **options: Any
) -> dict[str, Any]:
    """Probe a public benchmark as its authors do, by both protocols.

    Args:
        models: as `probe_tasks`.
        data: as `probe_tasks`.
        benchmark: a name of `tasks.BENCHMARKS`.
        options: others of `probe_tasks`, such as `seeds`, `train_sensors` or `log`.

    Raises:
        UserError: for an unknown benchmark, and as `probe_tasks` does.
    """
    setting = tasks.find_named(tasks.BENCHMARKS, benchmark, "benchmark")
    return probe_tasks(
        models,
        data,
        [setting.task],
        heads=("gradient",),
        protocol="released",
        pooling=setting.pooling,
        universal=setting.universal,
        recipe=setting.recipe,
        paper=setting.paper,
        **options,
    )


def _sources(
    table: Manifest,
    opened: sources.Opened,
    plans: Sequence[TaskPlan],
    options: TaskProbeOptions,
    backgrounds: Backgrounds,
    log: Log,
) -> list[FeatureSource]:
    """Return the sources of features, with those of all tasks computed in one pass.

    Raises UserError for an order or a join that has no effect, since a table would name it.
    """
    is_still = all(plan.frames == 1 for plan in plans)
    if options.order != "right" and (options.features or is_still):
        raise UserError(
            "--order has no effect on stills or on --features. Leave it out, or give --frames."
        )
    rows = {}
    for length in sorted({plan.frames for plan in plans}):
        parts = [plan.rows.rows.ravel() for plan in plans if plan.frames == length]
        rows[length] = np.concatenate(parts)
    log(backgrounds.report(np.unique(np.concatenate(list(rows.values())))))
    encoding = feature_cache.Encoding(
        pooling=options.pooling,
        aggregation=options.aggregation,
        order=options.order,
        universal=options.universal,
        folder=options.cache,
        backgrounds=backgrounds,
    )
    frames = options.frames or 1
    found = sources.gather_sources(
        table,
        opened,
        encoding,
        rows,
        features=options.features,
        controls=options.controls,
        least=frames,
    )
    encoders = [source.encoder for source in found if source.encoder]
    has_single = any(frames <= encoder.config.model.frames for encoder in encoders)
    if options.aggregation != "mean" and has_single:
        raise UserError(
            "--aggregation has no effect without --frames longer than a clip of the model."
        )
    return found
