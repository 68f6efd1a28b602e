"""Cross-sensor retrieval and matching: the same touch by another sensor, among similar touches.

For each query touch of sensor A, a gallery of touches of sensor B has that touch once. The
distractors are its nearest neighbours in position, depth and force. Against random distractors,
features that know no more than where and how hard a touch was would win: a deep touch at the edge
looks like no other. In a matched gallery only what was touched is left to tell.

Equal scores share their ranks evenly, so constant features score chance.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, permutations, product
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from sklearn.metrics import roc_auc_score

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.loading.sampling import Matches, MatchKeys
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import unit_rows
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import Array, fraction_interval, mean_interval
from anytouch_jax.evaluate.tasks import best_rows

Metric = Literal["cosine", "euclidean"]

ALL = "all"
GALLERY = 50  # touches in a gallery, the true one included
COVARIATES = ("label.x", "label.y", "label.depth", "label.force")  # mm, mm, mm, N
VECTOR = ("label.area", "label.x", "label.y", "label.force")  # mm2, mm, mm, N
Negatives = Literal["any", "same_sensor"]
NEGATIVES: tuple[Negatives, ...] = ("any", "same_sensor")
DRAWS = 5  # triples of each anchor
_TIE = 1e-9
_CHUNK = 1024  # queries whose scores are in memory at a time


@dataclass(frozen=True, eq=False)
class QueryScores:
    """Recall of each query at 1 and at 5 (0..1, means over galleries), with its key and group.

    The keys tell `difference` whether two results are of the same queries.
    """

    keys: Array
    top1: Array
    top5: Array
    groups: Array


@dataclass(frozen=True)
class Retrieval:
    """Retrieval by one set of features; fractions are in 0..1.

    Attributes:
        name: of the features.
        query_sensor: "all" in pooled results.
        gallery_sensor: "all" in pooled results.
        metric: by which touches are near.
        centred: the mean feature of each sensor was subtracted.
        matched: covariates in which distractors are near, empty for random galleries.
        top1: recall@1.
        low: lower end of its 95 % interval under a bootstrap over the groups (objects), None with
            fewer than two.
        high: its upper end.
        top5: recall@5, with its interval.
        top5_low: lower end of that interval.
        top5_high: its upper end.
        chance1: recall@1 of constant features.
        chance5: recall@5 of constant features.
        gallery: touches in a gallery.
        queries: how many were scored.
        groups: of the queries.
        nearness: mean distance of the distractors to the true touch, over that of all candidates.
        notes: what a reader should know.
        per_query: the queries one by one; not in JSON.
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
    per_query: QueryScores | None = field(default=None, repr=False, compare=False)


def cross_sensor_retrieval(
    manifest: Manifest,
    features: Mapping[str, Array],
    rows: Array,
    *,
    gallery_size: int = GALLERY,
    match: Sequence[str] | None = COVARIATES,
    centre: Sequence[bool] = (False, True),
    metrics: Mapping[str, Metric] | None = None,
    seeds: int = 5,
) -> list[Retrieval]:
    """Return retrieval for each set of features, pair of sensors and kind of centring.

    Pooled results of all pairs come last.

    Args:
        manifest: with the columns touch and unit, and labels to match in.
        features: {name: (len(rows), d)} of manifest `rows`.
        rows: row numbers; the deepest frame of each touch, sensor and sensor instance is used.
        gallery_size: touches in a gallery.
        match: label columns, of which those in the manifest are used; None draws random galleries.
        centre: whether the mean feature of each sensor is subtracted, each way once.
        metrics: {name: metric}, cosine by default.
        seeds: random galleries of each query.

    Raises:
        UserError: for a single sensor, no covariate, no common touch, a gallery that is too large,
            or features that are not finite.
    """
    rows = np.asarray(rows)
    for name, values in features.items():
        if len(values) != len(rows):
            raise UserError(
                f"Features {name!r} have {len(values)} rows. They must have one for each of "
                f"{len(rows)}."
            )
    used, place, covariates, notes = _usable(manifest, rows, match)
    touches = _Touches.of(manifest, used)
    drawn: dict[tuple[str, str], Galleries] = {}
    for first, second in permutations(touches.rows_of, 2):
        query = touches.rows_of[first]
        gallery = touches.rows_of[second]
        if not np.isin(touches.touch[query], touches.touch[gallery]).any():
            notes += (f"{first} to {second} left out: they share no touch",)
            continue
        near = None
        if match is not None:
            near = numbers(manifest, covariates, used[gallery])
        drawn[first, second] = draw_galleries(
            touches.touch[query],
            touches.touch[gallery],
            gallery_size=gallery_size,
            match=near,
            query_unit=touches.unit[query],
            gallery_unit=touches.unit[gallery],
            seeds=seeds,
        )
    if not drawn:
        raise UserError(
            "The two sensors share no touch. `touch` must be equal for the same place of the same "
            "object."
        )
    results = []
    for name, centred in product(features, centre):
        common: dict[str, Any] = {
            "name": name,
            "metric": (metrics or {}).get(name, "cosine"),
            "matched": covariates,
            "centred": centred,
            "notes": notes,
        }
        values = np.asarray(features[name])[place]
        results += _scores_of(values, touches, drawn, gallery_size, common)
    return results


@dataclass(frozen=True, eq=False)
class _Touches:
    """Names of the touches that are used, text (n,), and the places of each sensor's."""

    touch: Array
    unit: Array
    groups: Array
    rows_of: dict[str, Array]

    @staticmethod
    def of(manifest: Manifest, used: Array) -> _Touches:
        """Return the names of the rows `used`. Raises UserError for a single sensor."""
        columns = ("sensor", "unit", "object", "touch")
        sensors, units, objects, touch = (manifest.text_column(name)[used] for name in columns)
        if len(manifest.files) > 1:
            # equal names of joined manifests are not one touch
            touch = _joined(touch, manifest.source[used])
        rows_of = {str(name): np.flatnonzero(sensors == name) for name in np.unique(sensors)}
        if len(rows_of) < 2:
            raise UserError(
                "Cross-sensor retrieval needs touches by two sensors. These are by "
                f"{', '.join(rows_of)}."
            )
        groups = np.where(objects == "", touch, objects)
        return _Touches(touch, _joined(sensors, units), groups, rows_of)


def _scores_of(
    values: Array,
    touches: _Touches,
    drawn: Mapping[tuple[str, str], Galleries],
    size: int,
    common: Mapping[str, Any],
) -> list[Retrieval]:
    """Return the results of one set of features: of each pair of sensors, then pooled."""
    keys = _joined(touches.touch, touches.unit)
    results = []
    tables = []
    for (first, second), galleries in drawn.items():
        query = touches.rows_of[first]
        gallery = touches.rows_of[second]
        top1, top5 = score_galleries(
            values[query],
            values[gallery],
            galleries,
            metric=common["metric"],
            centre=common["centred"],
        )
        ids = query[galleries.queries]
        own_keys = _joined(keys[ids], [f"{first} to {second}"] * len(ids))
        table = QueryScores(own_keys, top1, top5, touches.groups[ids])
        tables.append(table)
        sides = {"query_sensor": first, "gallery_sensor": second}
        results.append(_summary(table, size, (galleries,), {**common, **sides}))
    pooled = QueryScores(
        np.concatenate([table.keys for table in tables]),
        np.concatenate([table.top1 for table in tables]),
        np.concatenate([table.top5 for table in tables]),
        np.concatenate([table.groups for table in tables]),
    )
    results.append(_summary(pooled, size, tuple(drawn.values()), common))
    return results


def difference(first: Retrieval, second: Retrieval) -> tuple[float, float | None, float | None]:
    """Return recall@1 of `first` minus `second`, and its 95 % interval, paired.

    Raises UserError for other queries.
    """
    a = first.per_query
    b = second.per_query
    is_paired = (
        a is not None
        and b is not None
        and np.array_equal(a.keys, b.keys)
        and np.array_equal(a.groups, b.groups)
    )
    if a is None or b is None or not is_paired:
        raise UserError(
            f"{first.name!r} and {second.name!r} have different queries. Give both the same rows."
        )
    change = a.top1 - b.top1
    return float(change.mean()), *mean_interval(change, a.groups)


def _summary(
    scores: QueryScores, size: int, drawn: Sequence[Galleries], common: Mapping[str, Any]
) -> Retrieval:
    """Return the result of some queries; `common` are the fields that do not depend on them."""
    missing = sum(galleries.missing for galleries in drawn)
    notes = tuple(common["notes"])
    if missing:
        notes += (f"{missing} queries left out: no other unit in the gallery has their touch",)
    near = [(part.nearness, len(part.queries)) for part in drawn if part.nearness is not None]
    nearness = None
    if near:
        nearness = sum(value * count for value, count in near) / sum(count for _, count in near)
    low, high = fraction_interval(scores.top1, scores.groups)
    low5, high5 = fraction_interval(scores.top5, scores.groups)
    fields: dict[str, Any] = {
        "query_sensor": ALL,
        "gallery_sensor": ALL,
        **common,
        "notes": notes,
        "top1": float(scores.top1.mean()),
        "low": low,
        "high": high,
        "top5": float(scores.top5.mean()),
        "top5_low": low5,
        "top5_high": high5,
        "chance1": 1 / size,
        "chance5": min(5 / size, 1.0),
        "gallery": size,
        "queries": len(scores.keys),
        "groups": len(np.unique(scores.groups)),
        "nearness": nearness,
    }
    return Retrieval(**fields, per_query=scores)


def _usable(
    manifest: Manifest, rows: Array, match: Sequence[str] | None
) -> tuple[Array, Array, tuple[str, ...], tuple[str, ...]]:
    """Return the rows to use, their places in `rows`, the covariates of the manifest, and notes."""
    used = deepest_rows(manifest, rows)
    notes = []
    is_field = np.isin(manifest.text_column("sensor")[used], FIELD_SENSORS)
    used = used[~is_field]
    if is_field.any():
        notes.append(
            f"{int(is_field.sum())} touches by force-field sensors, which have no images, left out"
        )
    covariates: tuple[str, ...] = ()
    if match is not None:
        covariates = tuple(name for name in match if name in manifest.table.column_names)
        if not covariates:
            raise UserError(
                f"The manifest has none of {', '.join(match)} to match the gallery in. Use "
                "--by-chance."
            )
        whole = np.isfinite(numbers(manifest, covariates, used)).all(axis=1)
        if not whole.all():
            notes.append(
                f"{int(np.sum(~whole))} touches without {' or '.join(covariates)} left out"
            )
        used = used[whole]
    order = np.argsort(rows)
    return used, order[np.searchsorted(rows, used, sorter=order)], covariates, tuple(notes)


def _joined(first: Iterable[Any], second: Iterable[Any]) -> Array:
    return np.array([f"{a}/{b}" for a, b in zip(first, second, strict=True)], dtype=str)


@dataclass(frozen=True, eq=False)
class Galleries:
    """Gallery rows of each query, drawn from names and covariates alone.

    Attributes:
        queries: row numbers (n,).
        items: gallery rows (draws, n, size), the true touch first.
        nearness: as in `Retrieval`.
        missing: queries whose touch no other sensor instance in the gallery has.
    """

    queries: Array
    items: Array
    nearness: float | None
    missing: int


def draw_galleries(
    query_touch: npt.ArrayLike,
    gallery_touch: npt.ArrayLike,
    *,
    gallery_size: int = GALLERY,
    match: Array | None = None,
    query_unit: npt.ArrayLike | None = None,
    gallery_unit: npt.ArrayLike | None = None,
    seeds: int = 5,
) -> Galleries:
    """Return galleries that depend on names, covariates and seeds, not on the order of rows.

    So every set of features is scored on the same galleries, and differences are paired.

    Args:
        query_touch: names (q,); equal names are one touch.
        gallery_touch: names (m,).
        gallery_size: touches in a gallery.
        match: covariates (m, k) of the gallery, scaled to unit spread: the nearest are the
            distractors. Without it random galleries are drawn.
        query_unit: sensor instances (q,). Items of the query's own are never in its gallery.
        gallery_unit: sensor instances (m,).
        seeds: how many random galleries each query has.

    Raises:
        UserError: for too few touches, or no common touch.
    """
    if seeds < 1:
        raise UserError(f"seeds must be at least 1, not {seeds}.")
    if gallery_size < 2:
        raise UserError(
            f"gallery_size {gallery_size} is too small. A gallery has the touch and another."
        )
    query_order, query_touch, query_unit = _by_name(query_touch, query_unit, "query")
    order, touch, unit = _by_name(gallery_touch, gallery_unit, "gallery")
    for one, two in pairwise(zip(touch, unit, strict=True)):
        if one == two:
            raise UserError(
                f"The gallery has touch {str(one[0])!r} twice by one unit. Keep one frame of each "
                "touch."
            )
    # matched galleries have no randomness
    draws = 1
    covariates = np.zeros((len(order), 0))
    if match is None:
        draws = seeds
    else:
        spread = match.std(axis=0)
        covariates = ((match - match.mean(axis=0)) / np.where(spread > 0, spread, 1.0))[order]
    ranks = []
    items = []
    sums = np.zeros(2)
    for rank in range(len(query_order)):
        allowed = unit != query_unit[rank]
        same = touch == query_touch[rank]
        own = np.flatnonzero(allowed & same)
        rest = np.flatnonzero(allowed & ~same)
        if not len(own):
            continue
        if len(rest) < gallery_size - 1:
            raise UserError(
                f"A gallery of {gallery_size} needs {gallery_size - 1} other touches than "
                f"{str(query_touch[rank])!r}. There are {len(rest)}. Give more touches, or a "
                "smaller --gallery."
            )
        ranks.append(rank)
        chosen = []
        for seed in range(draws):
            # By the rank of the query among names: other queries do not change its gallery.
            rng = np.random.default_rng([seed, rank])
            drawn, distances = _draw(own, rest, covariates, gallery_size, rng)
            chosen.append(order[drawn])
            sums += distances
        items.append(chosen)
    if not ranks:
        raise UserError("No query touch is in the gallery. The two sensors share no touch.")
    rows = query_order[ranks]
    back = np.argsort(rows)
    nearness = None
    if sums[1] > 0:
        nearness = float(sums[0] / sums[1])
    return Galleries(
        rows[back],
        np.asarray(items).transpose(1, 0, 2)[:, back],
        nearness,
        len(query_order) - len(rows),
    )


def _by_name(
    touches: npt.ArrayLike, units: npt.ArrayLike | None, side: str
) -> tuple[Array, Array, Array]:
    """Return an order of rows that depends on their names alone, and touch and unit names in it.

    Without units all rows of a `side` are of one, so that both sides never share one.
    """
    touch = np.asarray(touches).astype(str)
    if units is None:
        units = [side] * len(touch)
    unit = np.asarray(units).astype(str)
    order = np.lexsort((unit, touch))
    return order, touch[order], unit[order]


def _draw(
    own: Array, rest: Array, covariates: Array, size: int, rng: np.random.Generator
) -> tuple[Array, tuple[float, float]]:
    """Return one gallery, the true touch first.

    Then come the mean distances of its distractors and of all candidates.
    """
    wanted = own[rng.integers(len(own))]
    # Without covariates all distances are 0, and the lot alone decides.
    lot = rng.random(len(rest))
    distance = np.linalg.norm(covariates[rest] - covariates[[wanted]], axis=1)
    nearest = np.lexsort((lot, distance))[: size - 1]
    means = (float(distance[nearest].mean()), float(distance.mean()))
    return np.concatenate([[wanted], rest[nearest]]), means


def score_galleries(
    query: Array,
    gallery: Array,
    drawn: Galleries,
    *,
    metric: Metric = "cosine",
    centre: bool = False,
) -> tuple[Array, Array]:
    """Return recall@1 and recall@5 (n,) of each query, as means over its galleries.

    Ties share their ranks evenly: a query whose gallery is one tie has recall@1 of one in its size.

    Args:
        query: features (q, d).
        gallery: features (m, d).
        drawn: the galleries of n of the queries.
        metric: by which touches are near.
        centre: subtracts the mean of each side.

    Raises:
        UserError: for values that do not fit.
    """
    q = _finite(query, "query")
    g = _finite(gallery, "gallery")
    if q.shape[1] != g.shape[1]:
        raise UserError(
            f"query and gallery features have {q.shape[1]} and {g.shape[1]} values. They must be "
            "alike."
        )
    q = _prepared(q, metric, centre)[drawn.queries]
    g = _prepared(g, metric, centre)
    if metric == "euclidean":
        # Both sides are moved and scaled by the same amount, so that rounding does not reorder
        # distances.
        least = _TIE * max(np.abs(side).max(initial=0.0) for side in (q, g))
        middle = g.mean(axis=0, keepdims=True)
        q = np.where(np.abs(q - middle) > least, q - middle, 0.0)
        g = np.where(np.abs(g - middle) > least, g - middle, 0.0)
        size = max(np.abs(side).max(initial=0.0) for side in (q, g)) or 1.0
        q = q / size
        g = g / size
    top1 = np.zeros(len(q))
    top5 = np.zeros(len(q))
    for start in range(0, len(q), _CHUNK):
        part = slice(start, start + _CHUNK)
        likeness = q[part] @ g.T
        if metric == "euclidean":
            # minus the squared distance
            gallery_square = np.sum(g * g, axis=1)[None]
            query_square = np.sum(q[part] ** 2, axis=1, keepdims=True)
            likeness = 2 * likeness - gallery_square - query_square
        for items in drawn.items[:, part]:
            values = np.take_along_axis(likeness, items, axis=1)
            margin = _TIE * np.maximum(1.0, np.abs(values).max(axis=1, keepdims=True))
            ahead = values[:, 1:] - values[:, :1]
            better = np.sum(ahead > margin, axis=1)
            equal = np.sum(np.abs(ahead) <= margin, axis=1)
            # The true touch shares the ranks after the better ones with its equals: of these
            # equal + 1 ranks k - better lie within the first k.
            for k, total in ((1, top1), (5, top5)):
                total[part] += np.clip((k - better) / (equal + 1), 0, 1) / len(drawn.items)
    return top1, top5


def _prepared(values: Array, metric: Metric, centre: bool) -> Array:
    """Return rows to compare by their products.

    What centring leaves of a constant is 0, not rounding noise, whose direction would decide.
    """
    least = 0.0
    if centre:
        least = _TIE * np.abs(values).max(initial=0.0)
        values = values - values.mean(axis=0, keepdims=True)
    if metric == "euclidean":
        return np.where(np.abs(values) > least, values, 0.0)
    unit = unit_rows(values)
    return np.where(np.abs(values).max(axis=1, keepdims=True, initial=0.0) > least, unit, 0.0)


def _finite(values: Any, kind: str) -> Array:
    values = np.asarray(values, np.float64)
    if values.ndim != 2:
        raise UserError(f"The {kind} values must be (n, d), not {values.shape}.")
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise UserError(
            f"The {kind} row {bad[0]} is not finite, nor are {len(bad) - 1} others. Repair or drop "
            "them."
        )
    return values


@dataclass(frozen=True)
class MatchScore:
    """How a matcher distinguishes positives from `negatives`; chance is 0.5.

    Attributes:
        negatives: of any sensor, or of the positive's.
        accuracy: fraction of logits on the right side of 0.
        low: lower end of its 95 % interval under a bootstrap over the anchors' objects, None with
            fewer than two.
        high: its upper end.
        auc: area under the ROC curve of the logits.
        sensors_alone: accuracy of the best rule that only knows the two sensors.
        triples: anchor, positive and negative.
        anchors: how many there are.
    """

    negatives: Negatives
    accuracy: float
    low: float | None
    high: float | None
    auc: float
    sensors_alone: float
    triples: int
    anchors: int


def score_matching(
    encoder: Encoder, manifest: Manifest, rows: Array, features: Array
) -> list[MatchScore]:
    """Return the scores of the encoder's matching head (Eq. 5) for both kinds of negatives.

    With negatives of any sensor, the sensors alone reveal part of the answer. With negatives of the
    positive's sensor they do not.

    Args:
        encoder: with a matching head.
        manifest: whose column touch says which touches match.
        rows: row numbers (n,).
        features: (n, E) of these, pooling class.

    Raises:
        UserError: without a matching head, and if two sensors share no touch.
    """
    objects = manifest.text_column("object")[rows]
    scores = []
    encoder.match(features[:1], features[:1])  # raises without a head
    for negatives in NEGATIVES:
        anchor, positive, negative = draw_triples(manifest, rows, negatives)
        right = encoder.match(features[anchor], features[positive])
        wrong = encoder.match(features[anchor], features[negative])
        correct = np.mean([right > 0, wrong <= 0], axis=0)
        sensor = manifest.codes("sensor")[rows]
        codes = [
            sensor[anchor] * (1 + sensor.max()) + sensor[other] for other in (positive, negative)
        ]
        low, high = fraction_interval(correct, objects[anchor])
        labels = np.repeat([1, 0], [len(right), len(wrong)])
        auc = float(roc_auc_score(labels, np.concatenate([right, wrong])))
        alone = best_rule(codes[0], codes[1], anchor)
        count = len(np.unique(anchor))
        scores.append(
            MatchScore(negatives, float(correct.mean()), low, high, auc, alone, len(anchor), count)
        )
    return scores


def draw_triples(
    manifest: Manifest, rows: Array, negatives: Negatives, *, draws: int = DRAWS, seed: int = 0
) -> tuple[Array, Array, Array]:
    """Return places in `rows` of anchors, positives and negatives, i64 (m,), drawn as in training.

    Raises UserError.

    Args:
        manifest: the frames.
        rows: i64 (n,) of the gallery.
        negatives: what a negative is drawn from.
        draws: of each anchor.
        seed: of the draws.
    """
    names = ("touch", "sensor", "unit", "object", "dataset")
    keys = MatchKeys(*(manifest.codes(name, own=name == "touch") for name in names))
    matches = Matches(rows, keys, same_sensor=negatives == "same_sensor", other_object=True)
    if not matches.anchors.size:
        which = "" if negatives == "any" else " next to a touch of another place"
        raise UserError(
            f"two sensors share no touch{which} in these rows; there is nothing to match"
        )
    triples = []
    for one in map(int, matches.anchors):
        for number in range(draws):
            drawn = matches.draw(one, np.random.default_rng([seed, one, number]))
            triples.append((one, *drawn))
    anchor, positive, negative = np.asarray(triples, np.int64).T
    return anchor, positive, negative


def best_rule(right: Array, wrong: Array, anchor: Array) -> float:
    """Return the accuracy of the best rule on codes i64 (n,) of positives and of negatives.

    It is learned on half of the anchors (`anchor` i64 (n,)) and scored on the others. It guesses
    for unknown codes.
    """
    names, place = np.unique(anchor, return_inverse=True)
    half = (np.random.default_rng(0).permutation(len(names)) % 2)[place]
    codes, code = np.unique(np.stack([right, wrong]), return_inverse=True)
    code = code.reshape(2, -1)
    yes = np.empty((2, len(place)))
    for side in (0, 1):
        counts = [np.bincount(part[half != side], minlength=len(codes)) for part in code]
        # 1 where the code was a positive more often, 0 where a negative, 0.5 where it is unknown
        rule = 0.5 + 0.5 * np.sign(counts[0] - counts[1])
        yes[:, half == side] = rule[code[:, half == side]]
    return float((yes[0].mean() + 1 - yes[1].mean()) / 2)


def numbers(manifest: Manifest, names: Sequence[str], rows: Array) -> Array:
    """Return numeric columns as f64 (rows, columns), NaN for an empty cell.

    Raises UserError for text.
    """
    return np.stack([manifest.number_column(name)[rows] for name in names], 1)


def deepest_rows(
    manifest: Manifest, rows: Array | None = None, *, split: str = "test", frames: int = 1
) -> Array:
    """Return one row for each touch, sensor and sensor instance, in order: the deepest.

    That is the row of the largest `label.force`, the first of equals. Without forces it is that of
    the largest `label.depth`, without both the middle frame.

    Args:
        manifest: with the column touch.
        rows: those that are used, the whole `split` by default.
        split: of the manifest.
        frames: above 1 only ends of clips of so many frames are used.

    Raises:
        UserError: if no row is left.
    """
    rows = np.unique(manifest.rows_of(split) if rows is None else np.asarray(rows))
    rows = rows[manifest.present("touch")[rows]]
    if frames > 1 and len(rows):
        rows = np.intersect1d(rows, manifest.clips(frames)[:, -1])
        if not len(rows):
            raise UserError(f"no touch ends a clip of {frames} frames; take fewer, or 1")
    if not len(rows):
        raise UserError(
            "no row has a touch; cross-sensor tasks need the column 'touch', equal for the same "
            "place"
        )
    codes = np.stack(
        [
            manifest.codes("touch", own=True),
            manifest.codes("sensor"),
            manifest.codes("unit", own=True),
        ],
        1,
    )
    _, contact = np.unique(codes[rows], axis=0, return_inverse=True)
    return np.sort(best_rows(rows, contact.ravel(), _depth(manifest, rows, contact.ravel())))


def _depth(manifest: Manifest, rows: Array, contact: Array) -> Array:
    """Return the depth of each row (n,) within its contact, by the best column of its file."""
    frame = np.asarray(manifest.column("frame_index"))[rows].astype(np.float64)
    middle = np.array([np.median(frame[contact == number]) for number in range(contact.max() + 1)])
    depth = -np.abs(frame - middle[contact])
    # In this order, so that force, where a file has it, replaces depth.
    for name in ("label.depth", "label.force"):
        if name in manifest.table.column_names:
            values = numbers(manifest, (name,), rows)[:, 0]
            source = manifest.source[rows]
            measured = np.isin(source, source[np.isfinite(values)])
            depth[measured] = np.where(np.isfinite(values), values, -np.inf)[measured]
    return depth


def contact_vector(manifest: Manifest, rows: Array) -> Array:
    """Return area, centroid and force of each contact, f32 (rows, up to 4).

    They are a control: what retrieval owes to where and how hard a touch was, without its texture.
    Each has mean 0 and standard deviation 1 within its sensor. Raises UserError if the manifest or
    a row lacks them.
    """
    names = [name for name in VECTOR if name in manifest.table.column_names]
    if not names:
        raise UserError(
            f"the manifest has none of the columns {', '.join(VECTOR)}; add one, or leave the "
            "control out"
        )
    values = numbers(manifest, names, rows)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise UserError(
            f"{manifest.where(int(rows[bad[0]]))} has no value in one of {', '.join(names)}; add it"
        )
    sensors = manifest.text_column("sensor")[rows]
    for sensor in np.unique(sensors):
        part = values[sensors == sensor]
        spread = part.std(axis=0, keepdims=True)
        centred = part - part.mean(axis=0, keepdims=True)
        values[sensors == sensor] = centred / np.where(spread > 0, spread, 1.0)
    return values.astype(np.float32)
