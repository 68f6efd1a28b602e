"""Probes of a label column: linear and kNN heads on the features of encoders and of controls."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import feature_cache, sources
from anytouch_jax.evaluate.label_rows import constant_result, labelled_rows, plan_rows, task_of
from anytouch_jax.evaluate.label_scores import cost_of, features_of, probe_source
from anytouch_jax.evaluate.options import LabelProbeOptions, Models, Paths
from anytouch_jax.evaluate.results import ProbeResult, probe_json
from anytouch_jax.evaluate.saved_heads import save_probed
from anytouch_jax.files import atomic_write
from anytouch_jax.renamed import PROTOCOLS, keywords


@keywords({"protocol": PROTOCOLS}, join="aggregation")
def probe_label(
    models: Models,
    data: Paths,
    label: str | None = None,
    *,
    options: LabelProbeOptions | None = None,
    log: Log = print,
    **changes: Any,
) -> list[ProbeResult]:
    """Probe a label column with features of every model, of features files, and of the controls.

    `probe_table` prints the results, `label_verdicts` compares them.

    Args:
        models: names, run folders or weights files of encoders.
        data: manifests.
        label: the column, "object" by default.
        options: all settings; see `LabelProbeOptions`.
        log: is called with sentences on what is done.
        changes: settings by name, such as `seeds=3`: fields of `LabelProbeOptions`.

    Raises:
        UserError: for rows that cannot be probed. Words are checked before an encoder is loaded.
    """
    if label is not None:
        changes["label"] = label
    options = replace(options or LabelProbeOptions(), **changes)
    if options.save is not None and len(models) != 1:
        raise UserError(f"save writes the linear head of one model, not of {len(models)}.")
    table = manifests.read([str(path) for path in data])
    task = task_of(table, options)
    rows = labelled_rows(table, task, options)
    encoders = sources.opened(models)
    backgrounds = Backgrounds(table)
    plan = plan_rows(table, task, sources.with_gel(rows, backgrounds, encoders), options)
    rows = plan.rows
    log(f"{len(rows.rows)} of {len(table)} rows take part")
    log(backgrounds.report(rows.rows[:, 0]))
    for note in plan.notes:
        log(note)
    chance = constant_result(plan)
    encoding = feature_cache.Encoding(
        pooling=options.pooling,
        aggregation=options.aggregation,
        folder=options.cache,
        backgrounds=backgrounds,
    )
    probed = sources.gather_sources(
        table,
        encoders,
        encoding,
        {options.frames: rows.rows},
        features=options.features,
        controls=options.controls,
        least=options.frames,
    )
    results = list[ProbeResult]()
    for source in probed:
        x = features_of(source, rows, options.frames)
        if not results:
            note = cost_of(x, plan, options)
            if note:
                log(note)
        found = probe_source(source, x, plan, options)
        results += found
        log(f"probed {source.name}")
        if options.save is not None and source.encoder is not None and not source.is_control:
            save_probed(source, x, rows, found[0], options, backgrounds, log)
    if chance is not None:
        results.append(chance)
    if options.out is not None:
        atomic_write(options.out, probe_json(results))
    return results
