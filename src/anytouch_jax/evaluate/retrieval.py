"""Cross-sensor retrieval: does the embedding of a touch by one sensor find the same touch felt by another?

For each query touch of sensor A a gallery of touches of sensor B holds that touch once, among distractors that are
nearest to it in position, depth and force, so that the place or the size of a contact does not give it away. What is
reported is the share of queries whose own touch comes first (top-1) or among the first five, with an interval over
objects. Equal scores share their places evenly, so features that say nothing score chance and never more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.embed import text_column
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.contacts import COVARIATES, deepest_rows, numbers
from anytouch_jax.evaluate.galleries import GALLERY, Galleries, Metric, draw_galleries, score, texts
from anytouch_jax.evaluate.statistics import mean_interval

Array = npt.NDArray[Any]
ALL = "all"


@dataclass(frozen=True, eq=False)
class Found:
    """Query by query: its key, the chance (0..1) that it is found at top 1 and top 5, its group. See `difference`."""

    keys: Array
    top1: Array
    top5: Array
    groups: Array


@dataclass(frozen=True)
class Retrieval:
    """Retrieval by one set of features; shares are in 0..1.

    `low`, `high` (and those of top 5): 95 % percentile interval when the groups (objects) are drawn anew with
    replacement; None with fewer than two. `chance1`, `chance5`: what features that say nothing reach. `matched`: the
    covariates in which distractors are near, empty where they are drawn by chance; `nearness`: their mean distance to
    the touch looked for, divided by that of all touches they were taken from (1: the matching chose nothing).
    `centred`: the mean feature of each sensor was subtracted.
    """

    name: str
    query_sensor: str
    gallery_sensor: str
    metric: Metric
    centred: bool
    matched: tuple[str, ...]
    top1: float
    low: float | None
    high: float | None
    top5: float
    top5_low: float | None
    top5_high: float | None
    chance1: float
    chance5: float
    gallery: int
    queries: int
    groups: int
    nearness: float | None
    notes: tuple[str, ...] = ()
    found: Found | None = field(default=None, repr=False, compare=False)


def cross_sensor_retrieval(
    manifest: Manifest,
    features: Mapping[str, Array],
    rows: Array,
    *,
    pairs: Sequence[tuple[str, str]] | None = None,
    gallery_size: int = GALLERY,
    match: Sequence[str] | None = COVARIATES,
    centre: Sequence[bool] = (False, True),
    metrics: Mapping[str, Metric] | None = None,
    seeds: int = 5,
) -> list[Retrieval]:
    """Retrieval for each set of features, ordered pair of sensors and kind of centring; pooled over the pairs last.

    `features` {name: (len(rows), d)} of manifest `rows`, of which the deepest frame of each touch, sensor and unit
    counts. `match`: label columns, those that the manifest has are used; None draws galleries by chance. `metrics`
    {name: metric}, cosine otherwise. Touches without a value in one of the columns are left out, which a note says.
    Raises UserError when a sensor is paired with itself, no covariate is there, no touch is in common, a gallery would
    be too small, or features are not finite.
    """
    rows = np.asarray(rows)
    for name, values in features.items():
        if len(values) != len(rows):
            raise UserError(f"features {name!r} have {len(values)} rows; they must have one for each of {len(rows)}")
    kept, place, covariates, notes = _usable(manifest, rows, match)
    sensors = text_column(manifest, "sensor")[kept]
    touch, unit = _touches(manifest, kept), _joined(sensors, text_column(manifest, "unit")[kept])
    things = text_column(manifest, "object")[kept]
    groups, keys = np.where(things == "", touch, things), _joined(touch, unit)
    drawn = {}
    for first, second in _pairs(sensors) if pairs is None else pairs:
        one, two = _rows_of(sensors, first, second)
        if pairs is None and not np.isin(touch[one], touch[two]).any():
            notes += (f"{first} to {second} left out: no touch was felt by both",)
            continue
        near = None if match is None else numbers(manifest, covariates, kept[two])
        drawn[first, second] = draw_galleries(
            touch[one], touch[two], gallery_size=gallery_size, match=near, query_unit=unit[one],
            gallery_unit=unit[two], seeds=seeds,
        )  # fmt: skip
    if not drawn:
        raise UserError("no touch was felt by two sensors; `touch` must be equal where the same place was touched")
    results = []
    for name, centred in ((name, centred) for name in features for centred in centre):
        metric, values = (metrics or {}).get(name, "cosine"), np.asarray(features[name])[place]
        about = {"name": name, "metric": metric, "matched": covariates, "centred": centred, "notes": notes}
        several, tables = [], []
        for (first, second), galleries in drawn.items():
            one, two = _rows_of(sensors, first, second)
            tops = score(values[one], values[two], galleries, metric=metric, centre=centred)
            asked = one[galleries.queries]
            tables.append(Found(_joined(keys[asked], [f"{first} to {second}"] * len(asked)), *tops, groups[asked]))
            names = {"query_sensor": first, "gallery_sensor": second}
            several.append(_summary(tables[-1], gallery_size, (galleries,), about | names))
        results += [*several, _summary(_concatenated(tables), gallery_size, tuple(drawn.values()), about)]
    return results


def difference(first: Retrieval, second: Retrieval) -> tuple[float, float | None, float | None]:
    """Top-1 share of `first` minus that of `second`, with its 95 % interval over groups, paired by query.

    Raises UserError when the two did not answer the same queries.
    """
    a, b = first.found, second.found
    if a is None or b is None or not np.array_equal(a.keys, b.keys) or not np.array_equal(a.groups, b.groups):
        raise UserError(f"{first.name!r} and {second.name!r} did not answer the same queries; give both the same rows")
    change = a.top1 - b.top1
    return float(change.mean()), *mean_interval(change, a.groups)


def _summary(found: Found, size: int, drawn: Sequence[Galleries], about: Mapping[str, Any]) -> Retrieval:
    missing, notes = sum(one.missing for one in drawn), tuple(about.get("notes", ()))
    if missing:
        notes += (f"{missing} queries left out: no other unit of the gallery felt their touch",)
    weights = [len(one.queries) for one in drawn if one.nearness is not None]
    near = [one.nearness * len(one.queries) for one in drawn if one.nearness is not None]
    fields: dict[str, Any] = {
        "query_sensor": ALL, "gallery_sensor": ALL, **about, **_shares(found), "notes": notes,
        "chance1": 1 / size, "chance5": min(5 / size, 1.0), "gallery": size, "queries": len(found.keys),
        "groups": len(np.unique(found.groups)), "nearness": sum(near) / sum(weights) if near else None,
    }  # fmt: skip
    return Retrieval(**fields, found=found)


def _shares(found: Found) -> dict[str, Any]:
    low, high = mean_interval(found.top1, found.groups)
    low5, high5 = mean_interval(found.top5, found.groups)
    return {
        "top1": float(found.top1.mean()), "low": low, "high": high,
        "top5": float(found.top5.mean()), "top5_low": low5, "top5_high": high5,
    }  # fmt: skip


def _concatenated(tables: Sequence[Found]) -> Found:
    return Found(*(np.concatenate([getattr(one, part.name) for one in tables]) for part in dataclasses.fields(Found)))


def _touches(manifest: Manifest, rows: Array) -> Array:
    """Names of touches; those of joined manifests are their own."""
    names = text_column(manifest, "touch")[rows]
    return names if len(manifest.files) == 1 else _joined(names, manifest.source[rows])


def _usable(
    manifest: Manifest, rows: Array, match: Sequence[str] | None
) -> tuple[Array, Array, tuple[str, ...], tuple[str, ...]]:
    """Rows that take part, their places in `rows`, the covariates that the manifest has, and notes."""
    kept, notes = deepest_rows(manifest, rows), []
    fields = np.isin(text_column(manifest, "sensor")[kept], FIELD_SENSORS)
    kept = kept[~fields]
    if fields.any():
        notes.append(f"{int(fields.sum())} touches by force-field sensors, which have no images, left out")
    covariates = () if match is None else tuple(one for one in match if one in manifest.table.column_names)
    if match is not None:
        if not covariates:
            raise UserError(
                f"the manifest has none of {', '.join(match)} to match the gallery in; add one, or draw --by-chance"
            )
        whole = np.isfinite(numbers(manifest, covariates, kept)).all(axis=1)
        if not whole.all():
            notes.append(f"{int(np.sum(~whole))} touches without {' or '.join(covariates)} left out")
        kept = kept[whole]
    order = np.argsort(rows)
    return kept, order[np.searchsorted(rows, kept, sorter=order)], covariates, tuple(notes)


def _pairs(sensors: Array) -> list[tuple[str, str]]:
    names = [str(one) for one in np.unique(sensors)]
    if len(names) < 2:
        raise UserError(f"cross-sensor retrieval needs touches by two sensors, and these are by {names or 'none'}")
    return [(one, two) for one in names for two in names if one != two]


def _rows_of(sensors: Array, first: str, second: str) -> tuple[Array, Array]:
    if first == second:
        raise UserError(f"query and gallery are both by {first!r}; a sensor is not to be found by itself")
    for name in (first, second):
        if name not in sensors:
            raise UserError(f"no touch is by the sensor {name!r}; there are {', '.join(np.unique(sensors))}")
    return np.flatnonzero(sensors == first), np.flatnonzero(sensors == second)


def _joined(first: Any, second: Any) -> Array:
    return np.array([f"{one}/{two}" for one, two in zip(texts(first), texts(second), strict=True)], dtype=str)
