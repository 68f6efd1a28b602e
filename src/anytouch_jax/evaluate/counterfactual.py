"""Does touch matter for a task? The same probe on touches that were exchanged, shifted, emptied or
averaged.

Each control removes one thing. Shuffled touch is that of another row, and time-shifted touch that
of half a recording later. Background only is the untouched gel. Mean touch is the mean of all
features.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.background.rule import UnitGels
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import statistics
from anytouch_jax.evaluate.feature_cache import FeatureSource, FeatureStore, encoder_features
from anytouch_jax.evaluate.probing import probe_tasks
from anytouch_jax.evaluate.statistics import Array, GroupSums, interval_text

REAL = "real touch"
SHUFFLED = "shuffled touch"
SHIFTED = "time-shifted touch"
BACKGROUND = "background only"
MEAN = "mean touch"


def probe_counterfactual(
    models: Sequence[str | Path],
    data: Sequence[str | Path],
    tasks: Any = "all",
    *,
    log: Log = print,
    **options: Any,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the results of `probe_tasks` for the five kinds of touch, and what real touch adds to
    each of the others.

    An entry of the second has task, head, control, difference, low and high: a paired difference of
    accuracy or R2 with its 95 % interval. Without an untouched gel for every row "background only"
    is left out. `options` are others of `probe_tasks`. Raises UserError.
    """
    if len(models) != 1:
        raise UserError(
            f"A counterfactual probe takes one encoder, not {len(models)}. Give one --model."
        )
    table = manifests.read([str(path) for path in data])
    encoder = load_encoder(models[0])
    encoding = {name: options[name] for name in ("pooling", "join") if name in options}
    cache = options.pop("cache", None)
    sources = touch_sources(table, encoder, cache=cache, log=log, **encoding)
    runs: dict[tuple[str, ...], list[GroupSums]] = {}
    options |= {"controls": False, "features": ()}
    results = probe_tasks(sources, table, tasks, keep=runs, log=log, **options)
    gains = []
    for (name, task, head, protocol), several in runs.items():
        if name != REAL:
            real = runs[REAL, task, head, protocol]
            measured = real[0].sums.shape[1] > 2
            entry = {"task": task, "head": head, "protocol": protocol, "control": name}
            gains.append(entry | statistics.paired_gain(real, several, measured))
    return results, gains


def touch_sources(
    table: Manifest,
    encoder: Encoder,
    *,
    cache: Path | None = None,
    log: Log = print,
    **encoding: Any,
) -> list[FeatureSource]:
    """Return features of the real touch and of the four controls; "background only" where rows have
    backgrounds.
    """
    gels = UnitGels(table)
    real = encoder_features(encoder, table, folder=cache, gels=gels, log=log, **encoding)

    def from_real(partners: Callable[[Array, int], Array]) -> FeatureStore:
        return FeatureStore(lambda rows, frames: real.get(partners(rows, frames)[:, None], frames))

    def average(rows: Array, frames: int) -> Array:
        values = real.get(rows[:, None], frames)
        return np.repeat(values.mean(0, keepdims=True), len(values), 0)

    def shifted(rows: Array, frames: int) -> Array:
        return shift_in_time(table, rows, frames)

    gel = gels.shared(
        lambda picture: encoder.prepare(picture, picture if encoder.subtracts else None)
    )

    def empty(clips: Array, rows: Array) -> Array:
        return np.broadcast_to(
            np.stack([np.asarray(gel(row)) for row in rows.tolist()])[:, None], clips.shape
        )

    def background(rows: Array, frames: int) -> Array:
        return embed_rows(
            encoder, table, rows, frames, edit=empty, gels=gels, log=lambda _: None, **encoding
        )[1]

    stores = {
        REAL: real,
        SHUFFLED: from_real(lambda rows, _: shuffle_rows(table, rows)),
        SHIFTED: from_real(shifted),
    }
    if gels.has(
        np.flatnonzero(np.isin(table.text_column("split"), ("train", "val", "test")))
    ).all():
        stores[BACKGROUND] = FeatureStore(background)
    else:
        log(f"{BACKGROUND}: left out, as some rows have no picture of the untouched gel")
    stores[MEAN] = FeatureStore(average)
    return [FeatureSource(name, store, encoder) for name, store in stores.items()]


def shuffle_rows(table: Manifest, rows: Array) -> Array:
    """Return for each of `rows` (n,) another row of the same sensor, drawn with a fixed seed."""
    rng = np.random.default_rng(0)
    sensor = table.codes("sensor")[rows]
    partners = rows.copy()
    for name in np.unique(sensor):
        here = np.flatnonzero(sensor == name)
        turned = rng.permutation(here)
        partners[turned] = rows[np.roll(turned, 1)]  # nobody keeps its own
    return partners


def shift_in_time(table: Manifest, rows: Array, frames: int) -> Array:
    """Return for each of `rows` (n,) the row half a recording later, around the end; one frame
    alone stays.
    """
    ends = np.arange(len(table)) if frames == 1 else np.unique(table.clips(frames)[:, -1])
    sequence = table.codes("sequence", own=True)
    number = np.asarray(table.column("frame_index"))
    ends = ends[np.lexsort((number[ends], sequence[ends]))]
    _, first, place, counts = np.unique(
        sequence[ends], return_index=True, return_inverse=True, return_counts=True
    )
    later = (np.arange(len(ends)) - first[place] + counts[place] // 2) % counts[place] + first[
        place
    ]
    partner = np.arange(len(table))
    partner[ends] = ends[later]
    return partner[rows]


def verdicts(gains: Sequence[dict[str, Any]]) -> list[str]:
    """Return one sentence for each task and head on whether touch matters."""
    lines = []
    for key in dict.fromkeys((gain["task"], gain["head"], gain["protocol"]) for gain in gains):
        own = {g["control"]: g for g in gains if (g["task"], g["head"], g["protocol"]) == key}
        without = [gain for name, gain in own.items() if name != SHIFTED]
        above = [gain for gain in without if gain["low"] is not None and gain["low"] > 0]
        if len(above) == len(without):
            least = min(without, key=lambda gain: gain["difference"])
            points = (
                f"{100 * least['difference']:.1f} points ({100 * least['low']:.1f} to "
                f"{100 * least['high']:.1f})"
            )
            sentence = f"Touch matters for {key[0]}: it adds {points} to {least['control']}"
            late = own.get(SHIFTED, {"low": None})
            if late["low"] is not None and (late["low"], late["high"]) != (
                0,
                0,
            ):  # there is another moment
                sentence += (
                    ", and the moment matters"
                    if late["low"] > 0
                    else ", and any moment of a recording serves"
                )
        else:
            failed = ", ".join(gain["control"] for gain in without if gain not in above)
            sentence = (
                f"There is no sign that touch matters for {key[0]}: real touch is not above "
                f"{failed}"
            )
        lines.append(f"{sentence} ({key[1]}).")
    return lines


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
    return statistics.markdown_table(("task", "head", "compared", "points", "95 %"), rows)
