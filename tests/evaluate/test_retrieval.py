import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from touch_world import SENSORS, make_touches

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import retrieval
from anytouch_jax.evaluate.retrieval import (
    NEGATIVES,
    MatchScore,
    best_rule,
    cross_sensor_retrieval,
    deepest_rows,
    difference,
    draw_galleries,
    draw_triples,
    score_galleries,
    score_matching,
)
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.evaluate.tables import plain

Array = np.ndarray[Any, Any]
COUNT = 240
OBJECTS = 24
NAMES = [f"touch {i}" for i in range(COUNT)]
THINGS = [f"object {i % OBJECTS}" for i in range(COUNT)]


def noise(count: int = COUNT, width: int = 16, seed: int = 0) -> Array:
    return np.random.default_rng(seed).normal(size=(count, width))


def ask(
    query: Array,
    gallery: Array,
    *,
    match: Array | None = None,
    names: Any = NAMES,
    others: Any = NAMES,
    things: Any = THINGS,
    name: str = "features",
    metric: Any = "cosine",
    centre: bool = False,
    seeds: int = 5,
) -> retrieval.Retrieval:
    """Touches of `names` by digit are queries among those of `others` by gelsight; `match` has a
    row for each other.
    """
    near = (
        {}
        if match is None
        else {f"label.{i}": [*np.zeros(len(names)), *match[:, i]] for i in range(match.shape[1])}
    )
    count = len(names) + len(others)
    columns = {
        "path": [f"{i}.png" for i in range(count)],
        "sequence": [str(i) for i in range(count)],
        "sensor": ["digit"] * len(names) + ["gelsight"] * len(others),
        "frame_index": [0] * count,
        "split": ["test"] * count,
        "touch": [*names, *others],
        "object": [*things, *[""] * len(others)],
    }
    return cross_sensor_retrieval(
        manifests.from_columns(columns | near, "touches.parquet"),
        {name: np.concatenate([query, gallery])},
        np.arange(count),
        match=tuple(near) or None,
        centre=(centre,),
        metrics={name: metric},
        seeds=seeds,
    )[0]


@pytest.mark.parametrize(
    "options", [{}, {"match": noise(width=3, seed=5)}, {"centre": True}, {"metric": "euclidean"}]
)
def test_perfect_features_find_every_touch(options: dict[str, Any]) -> None:
    found = ask(noise(), noise(), **options)
    assert found.top1 == found.top5 == found.high == 1.0
    assert found.low == pytest.approx(0.025 ** (1 / OBJECTS))  # all objects right, yet no certainty
    assert (found.queries, found.groups, found.gallery) == (COUNT, OBJECTS, 50)


@pytest.mark.parametrize("options", [{}, {"match": noise(width=3, seed=5)}, {"centre": True}])
def test_features_without_a_bond_find_chance(options: dict[str, Any]) -> None:
    found = ask(noise(), noise(seed=1), **options)
    assert (found.chance1, found.chance5) == (0.02, 0.1)
    assert found.low <= 0.02 <= found.high and found.top5_low <= 0.1 <= found.top5_high
    assert found.low < found.top1 < found.high


@pytest.mark.parametrize("metric", ["cosine", "euclidean"])
@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize(
    "features", [0.0, 0.1, 1e6, 3.0 + 1e-13 * noise(width=7)], ids=["0", "0.1", "1e6", "rounding"]
)
def test_constant_features_score_chance_exactly(metric: Any, centre: bool, features: Any) -> None:
    """Rounding errors are no features, even where the same touch has the same digits."""
    same = np.broadcast_to(features, (COUNT, 7))
    found = ask(same, same, metric=metric, centre=centre)
    assert found.top1 == pytest.approx(1 / 50) and found.top5 == pytest.approx(5 / 50)


@pytest.mark.parametrize("centre", [False, True])
@pytest.mark.parametrize(
    ("scale", "offset"),
    [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e7), (1e-12, 0.0), (1e170, 0.0), (1e-170, 0.0)],
)
def test_neither_scale_nor_offset_changes_an_order_of_distances(
    centre: bool, scale: float, offset: float
) -> None:
    query = noise(seed=1)
    gallery = noise(seed=1) + 2.0 * noise(seed=2)
    plain = ask(query, gallery, metric="euclidean", centre=centre)
    other = ask(query * scale + offset, gallery * scale + offset, metric="euclidean", centre=centre)
    assert 0.05 < plain.top1 < 1 and other.top1 == pytest.approx(plain.top1)


def test_a_tie_is_counted_as_a_lot_would_be() -> None:
    """Two kinds of touches: the own kind ties with all of its kind, so that top 5 is 5 of those in
    the gallery.
    """
    kind = np.eye(2)[np.arange(COUNT) % 2]
    drawn = draw_galleries(NAMES, NAMES, seeds=1)
    top1, top5 = score_galleries(kind, kind, drawn)
    equal = np.sum(kind[drawn.items[0]][:, :, 0] == kind[drawn.queries][:, :1], axis=1)
    np.testing.assert_allclose(top1, 1 / equal)
    np.testing.assert_allclose(top5, 5 / equal)
    # the own kind is the unlike one
    worse = np.concatenate([kind[:, 1:], kind[:, :1]], axis=1)
    assert max(one.max() for one in score_galleries(worse, kind, drawn)) == 0


def test_a_score_by_hand() -> None:
    query = np.array([[1.0, 0.0]])
    gallery = np.array([[1.0, 1.0], [1.0, 0.1], [0.0, 1.0], [1.0, 0.2], [-1.0, 0.0]])
    drawn = draw_galleries(["a"], ["a", "b", "c", "d", "e"], gallery_size=5)
    assert [one.tolist() for one in score_galleries(query, gallery, drawn)] == [[0.0], [1.0]]
    far = np.array([[5.0, 5.0]])
    # by angle the first is nearest
    assert score_galleries(far, gallery, drawn)[0] == [1.0]
    assert score_galleries(np.array([[0.9, 0.2]]), gallery, drawn, metric="euclidean")[0] == [0.0]


def test_matching_takes_away_what_place_and_force_tell() -> None:
    """Features that hold a contact's covariates alone, with the error that another sensor makes."""
    rng = np.random.default_rng(3)
    names = [f"t{i}" for i in range(3000)]
    covariates = rng.normal(size=(3000, 2))
    query, gallery = (covariates + 0.25 * rng.normal(size=covariates.shape) for _ in range(2))
    asked = {"names": names[:200], "others": names, "things": names[:200]}
    loose = ask(query[:200], gallery, metric="euclidean", seeds=2, **asked)
    tight = ask(query[:200], gallery, metric="euclidean", match=covariates, **asked)
    assert loose.top1 > 0.2 and loose.nearness is None
    assert 0.5 * tight.chance1 <= tight.top1 < 2.5 * tight.chance1 < loose.low
    assert tight.nearness < 0.15
    texture = rng.normal(size=(3000, 8))
    kept = ask(texture[:200], texture, match=covariates, **asked)
    assert kept.top1 == 1.0  # what is not a covariate is found all the same


def test_distractors_are_the_nearest_in_units_of_each_covariate() -> None:
    covariates = noise(width=2, seed=4) * [1.0, 1000.0]
    drawn = draw_galleries(NAMES, NAMES, match=covariates, gallery_size=6)
    standard = covariates / covariates.std(axis=0)
    for query, items in zip(drawn.queries, drawn.items[0], strict=True):
        away = np.linalg.norm(standard - standard[query], axis=1)
        assert items[0] == query and set(items) == set(np.argsort(away)[:6])
    assert 0 < drawn.nearness < 0.25


@pytest.mark.parametrize("matched", [False, True])
def test_no_order_of_rows_matters(matched: bool) -> None:
    query = noise()
    gallery = noise() + 1.5 * noise(seed=1)
    covariates = np.round(noise(width=2, seed=2))  # many are equally near
    first = ask(query, gallery, match=covariates if matched else None)
    assert 0.05 < first.top1 < 0.95
    mixed, turned = (np.random.default_rng(seed).permutation(COUNT) for seed in (8, 9))
    again = ask(
        query[turned],
        gallery[mixed],
        names=np.array(NAMES)[turned],
        others=np.array(NAMES)[mixed],
        things=np.array(THINGS)[turned],
        match=covariates[mixed] if matched else None,
    )
    np.testing.assert_array_equal(again.per_query.keys, first.per_query.keys[turned])
    np.testing.assert_allclose(again.per_query.top1, first.per_query.top1[turned])
    assert again == first


def test_centring_takes_away_what_a_sensor_adds() -> None:
    texture = noise()
    common = 30.0 * np.ones((1, 16))
    query = texture + common
    gallery = texture - common + 0.5 * noise(seed=1)
    plain = ask(query, gallery)
    centred = ask(query, gallery, centre=True)
    assert centred.top1 > 0.95 > 0.5 > plain.top1
    mean, low, high = difference(centred, plain)
    assert mean == pytest.approx(centred.top1 - plain.top1) and 0 < low <= mean <= high


def test_a_units_own_touches_never_enter_its_gallery() -> None:
    """The same array as query and gallery: only touches by another unit may be looked for, or be
    distractors.
    """
    names = np.repeat(NAMES, 2)
    units = np.tile(["unit a", "unit b"], COUNT)
    features = noise(2 * COUNT)
    drawn = draw_galleries(names, names, query_unit=units, gallery_unit=units, seeds=3)
    assert (units[drawn.items] != units[drawn.queries][None, :, None]).all()
    np.testing.assert_array_equal(
        names[drawn.items[:, :, 0]], np.broadcast_to(names[drawn.queries], (3, 2 * COUNT))
    )
    assert (names[drawn.items[:, :, 1:]] != names[drawn.queries][None, :, None]).all()
    low, high = mean_interval(score_galleries(features, features, drawn)[0], names)
    assert low <= 0.02 <= high  # its own row would be found at once
    with pytest.raises(UserError, match="share no touch"):
        draw_galleries(NAMES, NAMES, query_unit=["x"] * COUNT, gallery_unit=["x"] * COUNT)


def test_the_interval_is_over_objects_not_over_touches() -> None:
    """Half of the objects are found always, half never: the interval is that of a few objects."""
    query = noise()
    gallery = noise()
    lost = np.array([int(thing.split()[1]) % 2 == 0 for thing in THINGS])
    query[lost] = noise(seed=9)[lost]
    by_object = ask(query, gallery)
    by_touch = ask(query, gallery, things=[""] * COUNT)
    assert (
        by_object.low < by_object.top1 < by_object.high
        and by_touch.low < by_touch.top1 < by_touch.high
    )
    assert by_object.high - by_object.low > 2 * (by_touch.high - by_touch.low)
    lock = ask(query, gallery, things=["one"] * COUNT)
    assert lock.low is None and lock.groups == 1


def test_a_paired_difference_is_narrower_than_two_intervals() -> None:
    base = noise()
    weak = ask(base, base + 1.2 * noise(seed=1), name="weak")
    strong = ask(base, base + 1.1 * noise(seed=1), name="strong")
    mean, low, high = difference(strong, weak)
    assert mean == pytest.approx(strong.top1 - weak.top1) and low <= mean <= high
    assert high - low < weak.high - weak.low
    assert difference(weak, weak) == (0.0, 0.0, 0.0)
    other = ask(base[:100], base, names=NAMES[:100], things=THINGS[:100], name="other")
    with pytest.raises(UserError, match="'other' have different queries"):
        difference(weak, other)


@pytest.fixture(scope="module")
def touched(tmp_path_factory: Any) -> manifests.Manifest:
    """Forty touches of eight objects by three sensors, three frames each."""
    return manifests.read(
        make_touches(tmp_path_factory.mktemp("touched"), touches={"test": 40, "train": 3}, frames=3)
    )


def with_columns(
    manifest: manifests.Manifest, drop: tuple[str, ...] = (), **columns: Any
) -> manifests.Manifest:
    table = manifest.table.drop_columns(list(drop))
    return manifests.from_columns(table.to_pydict() | columns, manifest.files[0])


def test_the_deepest_frame_of_each_touch(touched: manifests.Manifest) -> None:
    rows = deepest_rows(touched)
    assert len(rows) == 40 * 3 and (np.asarray(touched.column("frame_index"))[rows] == 2).all()
    np.testing.assert_array_equal(deepest_rows(touched, rows[::-1]), rows)
    np.testing.assert_array_equal(deepest_rows(touched, frames=3), rows)
    force = -np.asarray(touched.column("label.force"))
    assert (
        np.asarray(touched.column("frame_index"))[
            deepest_rows(with_columns(touched, **{"label.force": force}))
        ]
        == 0
    ).all()
    flat = with_columns(touched, **{"label.force": np.ones(len(touched))})
    # a tie: the first
    assert (np.asarray(touched.column("frame_index"))[deepest_rows(flat)] == 0).all()
    bare = with_columns(touched, ("label.force", "label.depth"))
    # the middle
    assert (np.asarray(touched.column("frame_index"))[deepest_rows(bare)] == 1).all()
    with pytest.raises(UserError, match="no row has a touch"):
        deepest_rows(with_columns(touched, ("touch",)))
    dropped = {"f": ("label.depth",), "d": ("label.force",), "bare": ("label.force", "label.depth")}
    files = [touched.files[0].with_name(f"{name}.parquet") for name in dropped]
    for file, without in zip(files, dropped.values(), strict=True):
        manifests.write(with_columns(touched, without), file)
    joined = manifests.read(files)  # each file goes by what it has
    rows = deepest_rows(joined)
    frames = np.asarray(joined.column("frame_index"))
    assert [set(frames[rows[joined.source[rows] == source]]) for source in range(3)] == [
        {2},
        {2},
        {1},
    ]


def test_a_manifest_is_scored_by_pairs_and_pooled(touched: manifests.Manifest) -> None:
    rows = touched.rows_of("test")
    # as a perfect encoder: it depends on the touch alone
    of_touch = noise(1000)[touched.codes("touch")[rows]]
    features = {"perfect": of_touch, "lost": noise(len(rows), seed=3)}
    found = cross_sensor_retrieval(touched, features, rows, gallery_size=20)
    assert [(one.name, one.centred) for one in found[::7]] == [
        ("perfect", False),
        ("perfect", True),
        ("lost", False),
        ("lost", True),
    ]
    for start in range(0, 28, 7):
        pairs = found[start : start + 6]
        pooled = found[start + 6]
        assert {(one.query_sensor, one.gallery_sensor) for one in pairs} == {
            (a, b) for a in SENSORS for b in SENSORS if a != b
        }
        assert (pooled.query_sensor, pooled.queries, pooled.groups, pooled.gallery) == (
            "all",
            240,
            8,
            20,
        )
        assert pooled.top1 == pytest.approx(np.mean([one.top1 for one in pairs]))
        assert (
            pooled.matched == ("label.x", "label.y", "label.depth", "label.force")
            and 0 < pooled.nearness < 1
        )
    assert found[6].top1 == 1.0 and found[20].low <= 1 / 20 <= found[20].high
    mean, low, _ = difference(found[6], found[20])
    assert mean > low > 0.8
    told = json.loads(json.dumps(plain(found)))
    assert told[6]["top1"] == 1.0 and "found" not in told[6]


@pytest.fixture(scope="module")
def triads(tmp_path_factory: Any) -> manifests.Manifest:
    return manifests.read(
        make_touches(tmp_path_factory.mktemp("triads"), touches={"test": 20}, each=2)
    )


@pytest.fixture(scope="module")
def rows(triads: manifests.Manifest) -> np.ndarray:
    return deepest_rows(triads, split="test")


def column(manifest: manifests.Manifest, rows: np.ndarray, name: str) -> np.ndarray:
    return np.asarray(manifest.column(name).to_pylist())[rows]


def test_the_best_rule_of_a_code() -> None:
    anchor = np.repeat(np.arange(40), 3)
    one = np.ones(120, int)
    assert best_rule(one, 2 * one, anchor) == 1.0
    assert best_rule(one, one, anchor) == 0.5
    # Positives are never of code 0, a third of the negatives is: yes unless 0.
    assert best_rule(np.tile([1, 2, 2], 40), np.tile([0, 1, 2], 40), anchor) == pytest.approx(
        (1 + 1 / 3) / 2, abs=0.1
    )
    # no code is met twice
    assert best_rule(np.arange(120), 120 + np.arange(120), anchor) == 0.5
    # nobody to learn from
    assert best_rule(one[:3], 2 * one[:3], anchor[:3]) == 0.5


@pytest.mark.parametrize("negatives", NEGATIVES)
def test_triples_are_of_one_place_and_of_two(triads: Any, rows: np.ndarray, negatives: Any) -> None:
    anchor, positive, negative = draw_triples(triads, rows, negatives, draws=4, seed=1)
    touch, sensor, thing = (column(triads, rows, name) for name in ("touch", "sensor", "object"))
    # every touch was felt by all three sensors
    assert len(anchor) == 4 * 60 and (np.bincount(anchor) == 4).all()
    assert (touch[anchor] == touch[positive]).all() and (sensor[anchor] != sensor[positive]).all()
    assert (thing[anchor] != thing[negative]).all()
    same = sensor[positive] == sensor[negative]
    assert same.all() if negatives == "same_sensor" else 0.1 < same.mean() < 0.6
    again = draw_triples(triads, rows, negatives, draws=4, seed=1)
    np.testing.assert_array_equal(again, (anchor, positive, negative))
    assert not np.array_equal(draw_triples(triads, rows, negatives, draws=4, seed=2)[2], negative)


def scored(table: Any, rows: np.ndarray, features: np.ndarray, logits: Any) -> list[MatchScore]:
    return score_matching(SimpleNamespace(match=logits), table, rows, features)  # type: ignore[arg-type]


def test_features_that_say_nothing_are_at_chance(triads: Any, rows: np.ndarray) -> None:
    noise = np.random.default_rng(0).standard_normal((len(rows), 16))
    for one in scored(triads, rows, noise, lambda a, b: (a * b).sum(1)):
        assert abs(one.accuracy - 0.5) < 0.08 and abs(one.auc - 0.5) < 0.08
        assert one.low is not None and one.high is not None and one.low <= one.accuracy <= one.high
    always = scored(triads, rows, noise, lambda a, b: np.ones(len(a)))
    assert [(one.accuracy, one.auc) for one in always] == [(0.5, 0.5)] * 2


def test_a_matcher_that_sees_only_the_sensors_is_found_out(triads: Any, rows: np.ndarray) -> None:
    """It says yes to two different sensors: above chance with any negatives, and not with those of
    one sensor.
    """
    sensor = np.unique(column(triads, rows, "sensor"), return_inverse=True)[1]
    differ = lambda a, b: 0.5 - (a * b).sum(1)  # noqa: E731
    free, bound = scored(triads, rows, np.eye(3)[sensor], differ)
    assert (free.negatives, bound.negatives) == NEGATIVES
    assert free.accuracy > 0.6 and abs(free.sensors_alone - free.accuracy) < 0.05
    assert (bound.accuracy, bound.auc, bound.sensors_alone) == (0.5, 0.5, 0.5)
