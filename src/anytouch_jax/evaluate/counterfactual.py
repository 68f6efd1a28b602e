"""Counterfactual probes: does touch matter for a task?

The same probe runs on touches that were exchanged, shifted, emptied or averaged, and each control
removes one thing. Shuffled touch is that of another row: the classes keep their frequencies.
Time-shifted touch is that of half a recording later: what stays the same in a recording is kept.
Background only is the untouched gel: device, light and wear. Mean touch is the mean of all
features, which is nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Array, Log
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import statistics
from anytouch_jax.evaluate.feature_cache import FeatureSource, FeatureStore, encoder_features
from anytouch_jax.evaluate.options import TaskProbeOptions, Tasks
from anytouch_jax.evaluate.tables import interval_text, markdown_table
from anytouch_jax.evaluate.task_probes import probe_tasks
from anytouch_jax.evaluate.verdicts import Runs

REAL = "real touch"
SHUFFLED = "shuffled touch"
SHIFTED = "time-shifted touch"
BACKGROUND = "background only"
MEAN = "mean touch"


def probe_counterfactual(
    models: Sequence[str | Path],
    data: Sequence[str | Path],
    tasks: Tasks = "all",
    *,
    options: TaskProbeOptions | None = None,
    log: Log = print,
    **changes: Any,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return results for the five kinds of touch, and what real touch adds to each of the others.

    The first are those of `probe_tasks`. An entry of the second has task, head, control,
    difference, low and high: a paired difference of accuracy or R2 with its 95 % interval. Without
    a background for every row "background only" is left out.

    Args:
        models: the encoder, alone.
        data: manifests.
        tasks: as of `probe_tasks`.
        options: all settings; see `TaskProbeOptions`. Features files, controls and `out` are left
            alone.
        log: is called with sentences on what is done.
        changes: settings by name: fields of `TaskProbeOptions`.

    Raises:
        UserError: for more than one encoder, and as `probe_tasks` does.
    """
    if len(models) != 1:
        raise UserError(
            f"A counterfactual probe takes one encoder, not {len(models)}. Give one --model."
        )
    table = manifests.read([str(path) for path in data])
    settings = replace(options or TaskProbeOptions(), **changes)
    sources = touch_sources(
        table,
        load_encoder(models[0]),
        cache=settings.cache,
        log=log,
        pooling=settings.pooling,
        aggregation=settings.aggregation,
    )
    runs: Runs = {}
    settings = replace(settings, controls=False, features=(), cache=None, out=None)
    results = probe_tasks(sources, table, tasks, options=settings, keep=runs, log=log)
    gains = []
    for (name, task, head, protocol), several in runs.items():
        if name == REAL:
            continue
        real = runs[REAL, task, head, protocol]
        regression = real[0].sums.shape[1] > 2  # sums of a regression have five columns
        entry = {"task": task, "head": head, "protocol": protocol, "control": name}
        gains.append(entry | statistics.paired_gain(real, several, regression))
    return results, gains


def touch_sources(
    table: Manifest,
    encoder: Encoder,
    *,
    cache: Path | None = None,
    log: Log = print,
    **encoding: Any,
) -> list[FeatureSource]:
    """Return features of the real touch and of the four controls.

    "background only" is left out where rows have no background.

    Args:
        table: the frames.
        encoder: whose features are computed.
        cache: folder that keeps features by content.
        log: takes a sentence on each source.
        encoding: fields of `feature_cache.Encoding`.
    """
    backgrounds = Backgrounds(table)
    real = encoder_features(
        encoder, table, folder=cache, backgrounds=backgrounds, log=log, **encoding
    )

    def from_real(partners: Callable[[Array, int], Array]) -> FeatureStore:
        return FeatureStore(lambda rows, frames: real.get(partners(rows, frames)[:, None], frames))

    def average(rows: Array, frames: int) -> Array:
        values = real.get(rows[:, None], frames)
        return np.repeat(values.mean(0, keepdims=True), len(values), 0)

    def shifted(rows: Array, frames: int) -> Array:
        return shift_in_time(table, rows, frames)

    def prepared(image: Array) -> Array:
        own_background = image if encoder.subtracts else None
        return np.asarray(encoder.prepare(image, own_background))

    gel = backgrounds.shared(prepared)

    def empty(clips: Array, rows: Array) -> Array:
        images = np.stack([np.asarray(gel(row)) for row in rows.tolist()])
        return np.broadcast_to(images[:, None], clips.shape)

    def background(rows: Array, frames: int) -> Array:
        return embed_rows(
            encoder,
            table,
            rows,
            frames,
            edit=empty,
            backgrounds=backgrounds,
            log=lambda _: None,
            **encoding,
        )[1]

    stores = {
        REAL: real,
        SHUFFLED: from_real(lambda rows, _: shuffle_rows(table, rows)),
        SHIFTED: from_real(shifted),
    }
    taking_part = np.flatnonzero(np.isin(table.text_column("split"), ("train", "val", "test")))
    if backgrounds.has(taking_part).all():
        stores[BACKGROUND] = FeatureStore(background)
    else:
        log(f"{BACKGROUND}: left out, as some rows have no image of the untouched gel")
    stores[MEAN] = FeatureStore(average)
    return [FeatureSource(name, store, encoder) for name, store in stores.items()]


def shuffle_rows(table: Manifest, rows: Array) -> Array:
    """Return for each of `rows` (n,) another row of the same sensor, drawn with a fixed seed."""
    rng = np.random.default_rng(0)
    sensor = table.codes("sensor")[rows]
    partners = rows.copy()
    for name in np.unique(sensor):
        here = np.flatnonzero(sensor == name)
        # Each takes the row of its neighbour in a random circle, so that nobody keeps its own.
        circle = rng.permutation(here)
        partners[circle] = rows[np.roll(circle, 1)]
    return partners


def shift_in_time(table: Manifest, rows: Array, frames: int) -> Array:
    """Return for each of `rows` (n,) the row half a recording later, around the end.

    One frame alone stays.
    """
    if frames == 1:
        ends = np.arange(len(table))
    else:
        ends = np.unique(table.clips(frames)[:, -1])
    sequence = table.codes("sequence", own=True)
    number = np.asarray(table.column("frame_index"))
    ends = ends[np.lexsort((number[ends], sequence[ends]))]
    _, first, place, counts = np.unique(
        sequence[ends], return_index=True, return_inverse=True, return_counts=True
    )
    within = np.arange(len(ends)) - first[place]
    later = (within + counts[place] // 2) % counts[place] + first[place]
    partner = np.arange(len(table))
    partner[ends] = ends[later]
    return partner[rows]


def verdicts(gains: Sequence[dict[str, Any]]) -> list[str]:
    """Return one sentence for each task and head on whether touch matters."""
    by_probe: dict[tuple[str, str, str], dict[str, dict[str, Any]]] = {}
    for gain in gains:
        key = (gain["task"], gain["head"], gain["protocol"])
        by_probe.setdefault(key, {})[gain["control"]] = gain
    lines = []
    for (task, head, _), own in by_probe.items():
        # Touch of another moment of the recording is touch still, so it decides nothing.
        without = [gain for name, gain in own.items() if name != SHIFTED]
        failed = [gain["control"] for gain in without if not _is_above(gain)]
        if failed:
            sentence = (
                f"There is no sign that touch matters for {task}: real touch is not above "
                f"{', '.join(failed)}"
            )
        else:
            least = min(without, key=lambda gain: gain["difference"])
            points = (
                f"{100 * least['difference']:.1f} points ({100 * least['low']:.1f} to "
                f"{100 * least['high']:.1f})"
            )
            sentence = f"Touch matters for {task}: it adds {points} to {least['control']}"
            sentence += _on_the_moment(own.get(SHIFTED))
        lines.append(f"{sentence} ({head}).")
    return lines


def _is_above(gain: dict[str, Any]) -> bool:
    return gain["low"] is not None and gain["low"] > 0


def _on_the_moment(late: dict[str, Any] | None) -> str:
    """Return whether another moment of the recording would serve as well, to end a sentence."""
    if late is None or late["low"] is None:
        return ""
    if (late["low"], late["high"]) == (0, 0):
        return ""  # recordings of one frame have no other moment
    if late["low"] > 0:
        return ", and the moment matters"
    return ", and any moment of a recording serves"


def gains_table(gains: Sequence[dict[str, Any]]) -> str:
    """Return the paired differences as a Markdown table, in points of 100."""
    rows = [
        (
            gain["task"],
            gain["head"],
            f"real above {gain['control']}",
            f"{100 * gain['difference']:.1f}",
            interval_text(gain["low"], gain["high"]),
        )
        for gain in gains
    ]
    return markdown_table(("task", "head", "compared", "points", "95 %"), rows)
