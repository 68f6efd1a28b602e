"""Galleries for cross-sensor retrieval, drawn from names and covariates alone, and how features score in them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError

Array = npt.NDArray[Any]
Metric = Literal["cosine", "euclidean"]

GALLERY = 50  # touches in a gallery, the one looked for included
_TIE = 1e-9
_CHUNK = 1024  # queries whose scores are held at a time


@dataclass(frozen=True, eq=False)
class Galleries:
    """`queries` (n,) row numbers; `items` (draws, n, size) gallery rows, the touch looked for first in each.

    `nearness`: mean covariate distance of the distractors to the touch looked for, divided by that of all touches
    that they were taken from; None where they were drawn by chance. `missing` counts queries whose touch no other
    unit of the gallery felt.
    """

    queries: Array
    items: Array
    nearness: float | None
    missing: int


@dataclass(frozen=True, eq=False)
class _Side:
    """Query or gallery rows in an order that depends on their names alone."""

    order: Array
    touch: Array
    unit: Array


def draw_galleries(
    query_touch: Any,
    gallery_touch: Any,
    *,
    gallery_size: int = GALLERY,
    match: Array | None = None,
    query_unit: Any = None,
    gallery_unit: Any = None,
    seeds: int = 5,
) -> Galleries:
    """Galleries that depend on names, covariates and seeds, not on any order of rows; equal names are one touch.

    `match` (m, k): covariates of the gallery; the distractors are the nearest to the touch looked for once each
    covariate has unit spread. Without it `seeds` galleries are drawn by chance. Items of the query's own unit never
    enter its gallery. Raises UserError on covariates that are not finite, a gallery that is too small, or no touch in
    common.
    """
    if seeds < 1:
        raise UserError(f"seeds must be at least 1, not {seeds}")
    if gallery_size < 2:
        raise UserError(f"gallery_size {gallery_size} is too small: a gallery holds the touch and at least one other")
    query = _sorted(query_touch, query_unit, "query")
    gallery = _sorted(gallery_touch, gallery_unit, "gallery")
    for one, two in pairwise(zip(gallery.touch, gallery.unit, strict=True)):
        if one == two:
            raise UserError(f"the gallery holds touch {str(one[0])!r} twice by one unit; keep one frame of each touch")
    covariates = None if match is None else _spread(match, len(gallery.order))[gallery.order]
    draws = seeds if covariates is None else 1  # a matched gallery is determined
    ranks, items, sums = [], [], np.zeros(2)
    for rank in range(len(query.order)):
        allowed = gallery.unit != query.unit[rank]
        same = gallery.touch == query.touch[rank]
        own, rest = np.flatnonzero(allowed & same), np.flatnonzero(allowed & ~same)
        if not len(own):
            continue
        if len(rest) < gallery_size - 1:
            raise UserError(
                f"a gallery of {gallery_size} needs {gallery_size - 1} other touches than "
                f"{str(query.touch[rank])!r}, and there are {len(rest)}; give more touches or a smaller --gallery"
            )
        ranks.append(rank)
        several = [_draw(own, rest, covariates, gallery_size, np.random.default_rng([s, rank])) for s in range(draws)]
        items.append([gallery.order[chosen] for chosen, _ in several])
        sums += np.sum([away for _, away in several], axis=0)
    if not ranks:
        raise UserError("no query touch is in the gallery: the two sensors share no touch")
    rows = query.order[ranks]
    back = np.argsort(rows)
    nearness = float(sums[0] / sums[1]) if sums[1] > 0 else None
    return Galleries(rows[back], np.asarray(items).transpose(1, 0, 2)[:, back], nearness, len(query.order) - len(rows))


def _draw(
    own: Array, rest: Array, covariates: Array | None, size: int, rng: np.random.Generator
) -> tuple[Array, tuple[float, float]]:
    """One gallery, its own touch first; and the mean distance of its distractors and of all that they might be."""
    wanted, lot = own[rng.integers(len(own))], rng.random(len(rest))
    away = np.zeros(len(rest))
    if covariates is not None:
        away = np.linalg.norm(covariates[rest] - covariates[[wanted]], axis=1)
    nearest = np.lexsort((lot, away))[: size - 1]
    return np.concatenate([[wanted], rest[nearest]]), (float(away[nearest].mean()), float(away.mean()))


def score(
    query: Array, gallery: Array, drawn: Galleries, *, metric: Metric = "cosine", centre: bool = False
) -> tuple[Array, Array]:
    """Chance of each query of `drawn` to be found at top 1 and top 5, f64 (n,) each, mean over the draws.

    `query` (n, d), `gallery` (m, d); `centre` subtracts the mean of each. Items that tie share their places evenly.
    """
    q, g = finite(query, "query"), finite(gallery, "gallery")
    if q.shape[1] != g.shape[1]:
        raise UserError(f"query and gallery features have {q.shape[1]} and {g.shape[1]} values; they must be alike")
    q, g = _prepared(q, metric, centre)[drawn.queries], _prepared(g, metric, centre)
    if metric == "euclidean":
        q, g = _comparable(q, g)
    top1, top5 = np.zeros(len(q)), np.zeros(len(q))
    for start in range(0, len(q), _CHUNK):
        here = slice(start, start + _CHUNK)
        likeness = q[here] @ g.T
        if metric == "euclidean":
            likeness = 2 * likeness - np.sum(g * g, axis=1)[None] - np.sum(q[here] ** 2, axis=1, keepdims=True)
        for items in drawn.items[:, here]:
            values = np.take_along_axis(likeness, items, axis=1)
            margin = _TIE * np.maximum(1.0, np.abs(values).max(axis=1, keepdims=True))
            ahead = values[:, 1:] - values[:, :1]
            better, equal = np.sum(ahead > margin, axis=1), np.sum(np.abs(ahead) <= margin, axis=1)
            for k, total in ((1, top1), (5, top5)):
                total[here] += np.clip((k - better) / (equal + 1), 0, 1) / len(drawn.items)
    return top1, top5


def _prepared(values: Array, metric: Metric, centre: bool) -> Array:
    """Rows to be compared by their products; what is left of a constant after centring is nothing, not noise."""
    least = _TIE * np.abs(values).max(initial=0.0) if centre else 0.0
    if centre:
        values = values - values.mean(axis=0, keepdims=True)
    if metric == "euclidean":
        return np.where(np.abs(values) > least, values, 0.0)
    size = np.linalg.norm(values, axis=1, keepdims=True)
    return np.where(size > least, values / np.maximum(size, 1e-300), 0.0)


def _comparable(q: Array, g: Array) -> tuple[Array, Array]:
    """Both moved and scaled alike, which changes no order of distances, so that none of these is lost in rounding."""
    least, middle = _TIE * max(np.abs(q).max(initial=0.0), np.abs(g).max(initial=0.0)), g.mean(axis=0, keepdims=True)
    q, g = (np.where(np.abs(one - middle) > least, one - middle, 0.0) for one in (q, g))
    size = max(np.abs(q).max(initial=0.0), np.abs(g).max(initial=0.0))
    return (q / size, g / size) if size > 0 else (q, g)


def _sorted(touch: Any, unit: Any, side: str) -> _Side:
    touch = texts(touch)
    unit = texts([side] * len(touch) if unit is None else unit, len(touch))
    order = np.lexsort((unit, touch))
    return _Side(order, touch[order], unit[order])


def _spread(match: Array, count: int) -> Array:
    """Covariates (m, k) with unit spread each; one that never changes says nothing."""
    values = finite(match, "covariate")
    if len(values) != count:
        raise UserError(f"match has {len(values)} rows; it must have one for each of the {count} gallery touches")
    spread = values.std(axis=0, keepdims=True)
    return (values - values.mean(axis=0, keepdims=True)) / np.where(spread > 0, spread, 1.0)


def finite(values: Any, what: str) -> Array:
    """`values` as f64 (n, d). Raises UserError for another shape and for NaN or Inf."""
    values = np.asarray(values, np.float64)
    if values.ndim != 2:
        raise UserError(f"{what} values must be (n, d), not {values.shape}")
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise UserError(f"{what} row {bad[0]} is not finite (nor are {len(bad) - 1} others); repair or drop it")
    return values


def texts(values: Any, count: int | None = None) -> Array:
    """Names as strings (n,). Raises UserError when there are not `count`."""
    found = np.asarray(values).astype(str)
    if found.ndim != 1 or count not in (None, len(found)):
        raise UserError(f"retrieval needs one name for each touch, not {found.shape} names for {count}")
    return found
