"""What is drawn from a mixture: weights of datasets, the sensor of negatives, text that is withheld."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from anytouch_jax.config import from_json, to_json
from anytouch_jax.data.loading import pools
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.loading.matching import Matches, MatchKeys
from anytouch_jax.data.loading.sampling import EpochSampler
from anytouch_jax.errors import UserError


def _parts(batch):
    """Arrays of a batch, pictures as the colour of one pixel: what does not depend on versions of the libraries."""
    if batch is None:
        return
    for name, part in batch._asdict().items():
        if part is None or hasattr(part, "_asdict"):
            yield from _parts(part)
        elif name not in ("text", "text_mask"):
            yield part[..., 10, 10, :] if part.ndim > 3 else part


# What the loader draws where nothing is asked for; other draws make old runs end in other places.
BEFORE = {
    (1, "paper"): "ed7e482b46094897", (1, "release"): "9e58a1ad76f48577",
    (2, "paper"): "e30fc1d2cabfdc00", (2, "release"): "141d221a227066ce",
}  # fmt: skip


@pytest.mark.parametrize(("stage", "recipe"), list(BEFORE))
def test_by_default_the_draws_are_what_they_were(make, settings, stage, recipe, rich):
    loader = Loader(make(rich), settings(stage, recipe), devices=2)
    digest = hashlib.sha256()
    for step in range(12):
        for part in _parts(loader.batch(step)):
            digest.update(str(part.shape).encode() + np.ascontiguousarray(part).tobytes())
    assert digest.hexdigest()[:16] == BEFORE[stage, recipe]


# Weights -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", [[2, 2, 2, 1, 1], [3, 0.5, 0.5, 0.5, 0.5], [1, 2.5, 2.5, 1, 1], [0.2] * 5])
def test_an_epoch_draws_each_thing_by_its_weight(weights):
    weights = np.array(weights, float)
    stream = EpochSampler(5, 0, 9, weights)
    epochs = 400
    drawn = stream.take(0, epochs * stream.size)
    for e in range(20):
        counts = Counter(thing for thing, _ in drawn[e * stream.size : (e + 1) * stream.size])
        for weight in np.unique(weights):
            of = [counts[t] for t in np.flatnonzero(weights == weight)]
            assert sum(of) == max(1, round(weight * len(of))) and max(of) - min(of) <= 1
    many = Counter(thing for thing, _ in drawn)
    for weight in np.unique(weights):
        ids = np.flatnonzero(weights == weight)
        share = max(1, round(weight * len(ids))) / len(ids)
        assert all(abs(many[t] / epochs - share) < 0.15 for t in ids)
    assert len(set(drawn)) == len(drawn)  # each time with another augmentation
    assert EpochSampler(5, 0, 9, weights).take(377, 20) == drawn[377:397]  # no need to walk there
    assert stream.take(0, stream.size) != stream.take(stream.size, stream.size)


def test_weights_of_one_change_nothing():
    assert EpochSampler(7, 3, 9, np.ones(7)).take(5, 40) == EpochSampler(7, 3, 9).take(5, 40)


def _sets(counts, **extra):
    """Stills of datasets {name: rows}."""
    return [{"dataset": name, **extra} for name, count in counts.items() for _ in range(count)]


def _drawn(loader, manifest, read_back, draws):
    rows = [row for step in range(draws // 4) for row in read_back(loader.batch(step).clip)[:, -1]]
    names = manifest.column("dataset").to_pylist()
    return Counter(names[row] for row in rows), rows


def test_an_epoch_of_the_loader_draws_datasets_by_weight(make, settings, read_back):
    manifest = make(_sets({"a": 6, "b": 4, None: 2}))
    loader = Loader(manifest, settings(weights=(("a", 3.0), ("b", 0.5))))
    assert loader.steps_per_epoch == 6 and "an epoch draws a 3 times, b 0.5 times, other datasets once" in loader.notes
    counts, rows = _drawn(loader, manifest, read_back, 24)
    assert counts == {"a": 18, "b": 2, None: 2} | ({} if sum(counts.values()) == 22 else counts)
    assert Counter(rows[:22])[0] == 3


def test_weight_zero_leaves_a_dataset_out_of_stills_clips_and_matching(make, settings, read_back, rich):
    rows = [row | {"dataset": "a" if i < 24 else "b"} for i, row in enumerate(rich)]
    loader = Loader(make(rows), settings(2, weights=(("b", 0.0),)))
    for _, batch, _ in loader.stream(0, 20):
        for clip in (batch.align.clip, batch.match.clip, batch.match.positive, batch.match.negative):
            assert read_back(clip).max() < 24


def test_the_release_has_weights_of_its_own_where_its_datasets_are(make, settings):
    there = make(_sets({"touch_and_go": 4, "octopi": 4, "x": 4}, image_path="v.png"))
    release, paper = Loader(there, settings(2, "release")), Loader(there, settings(2))
    assert Loader(there, settings(1, "release")).steps_per_epoch == 3  # its stage 1 draws every row once
    assert release.steps_per_epoch == (8 + 12 + 4) // 4 and paper.steps_per_epoch == 3
    assert any("touch_and_go 2 times, octopi 3 times" in note for note in release.notes)
    assert Loader(there, settings(2, "release", weights=())).steps_per_epoch == 3
    some = Loader(make(_sets({"octopi": 4, "x": 4}), "some"), settings(2, "release"))
    assert some.steps_per_epoch == 4 and not any("touch_and_go" in note for note in some.notes)
    none = Loader(make(_sets({"x": 4}), "none"), settings(2, "release"))
    assert not any("an epoch draws" in note for note in none.notes)


def test_strata_follow_the_weights(make, settings):
    rows = _sets({"a": 8}, image_path="v.png") + _sets({"b": 8})
    few, many = (Loader(make(rows), settings(2, weights=(("a", w),))) for w in (1.0, 3.0))
    assert (len(few.batch(0).align.image), len(many.batch(0).align.image)) == (2, 3)


@pytest.mark.parametrize(
    ("weights", "told"),
    [
        ((("c", 2.0),), r"names the dataset 'c', but split 'train' has a, b"),
        ((("a", -1.0),), r"--data\.weights of 'a'"),
        ((("a", float("nan")),), r"--data\.weights of 'a'"),
        ((("a", 1.0), ("a", 2.0)), "a dataset twice"),
        ((("a", 0.0), ("b", 0.0)), "leaves out every row"),
    ],
)
def test_weights_that_make_no_sense_are_errors(make, settings, weights, told):
    with pytest.raises(UserError, match=told):
        Loader(make(_sets({"a": 4, "b": 4})), settings(weights=weights))


def test_weights_survive_the_configuration_file(settings):
    config = settings(weights=(("a", 2.0), ("b", 0.5)))
    assert from_json(to_json(config)) == config and from_json(to_json(settings())).data.weights is None


# Negatives of the positive's sensor -----------------------------------------------------------------------------------


def _keys(**columns):
    size = len(next(iter(columns.values())))
    return MatchKeys(*(np.array(columns.get(name, [-1] * size), np.int64) for name in MatchKeys._fields))


@pytest.mark.parametrize("seed", range(6))
def test_a_negative_of_the_same_sensor_on_random_tables(seed):
    rng = np.random.default_rng(seed)
    columns = {name: rng.integers(-1, high, 50) for name, high in zip(MatchKeys._fields, (9, 4, 4, 4, 2), strict=True)}
    columns["sensor"] = np.abs(columns["sensor"])
    keys = _keys(**columns)
    matches = Matches(np.arange(50), keys, same_sensor=True)
    places = {s: set(keys.touch[keys.sensor == s].tolist()) - {-1} for s in range(4)}
    brute = []
    for a in range(50):
        same = [r for r in range(50) if keys.touch[r] == keys.touch[a] >= 0]
        others = [r for r in same if keys.sensor[r] != keys.sensor[a]]
        fit = [r for r in others if len(places[keys.sensor[r]]) > 1]
        units = {keys.unit[r] for r in same} - {-1}
        lock = not others and len(units) > 1 and keys.unit[a] >= 0 and len(places[keys.sensor[a]]) > 1
        brute += [a] if fit or lock else []
    assert matches.anchors.tolist() == brute and len(brute) > 5
    for anchor in brute:
        for key in range(20):
            p, n = matches.draw(anchor, np.random.default_rng(key))
            assert keys.sensor[n] == keys.sensor[p] and keys.touch[n] != keys.touch[anchor] == keys.touch[p]


def test_a_sensor_that_felt_one_place_only_is_no_partner():
    keys = _keys(touch=[0, 0, 0, 1, 2], sensor=[0, 1, 2, 0, 1])
    assert Matches(np.arange(5), keys).anchors.tolist() == [0, 1, 2]
    matches = Matches(np.arange(5), keys, same_sensor=True)
    assert matches.anchors.tolist() == [0, 1, 2]
    assert {matches.draw(0, np.random.default_rng(k)) for k in range(50)} == {(1, 4)}  # never 2: sensor 2 felt 0 only
    lock = _keys(touch=[0, 0, 1], sensor=[0, 1, 2])
    assert Matches(np.arange(3), lock).anchors.size and not Matches(np.arange(3), lock, same_sensor=True).anchors.size


def test_with_the_option_the_sensor_alone_tells_nothing(make, settings, rich):
    manifest = make(rich)

    def told_apart(config):  # how often "another sensor than the anchor's" is right of the positive, wrong of the other
        batches = [Loader(manifest, config).batch(step).match for step in range(12)]
        differs = [np.mean([b.sensor != getattr(b, name) for b in batches]) for name in
                   ("positive_sensor", "negative_sensor")]  # fmt: skip
        return (differs[0] + 1 - differs[1]) / 2

    assert told_apart(settings(2, negatives="same_sensor")) == 0.5
    assert told_apart(settings(2)) > 0.6


def test_where_the_batch_is_the_negatives_they_are_of_one_sensor(make, settings, rich):
    manifest, config = make(rich), settings(2, negatives="same_sensor")
    config = replace(config, model=replace(config.model, match_head="cosine"))
    loader = Loader(manifest, config)
    batches = [loader.batch(step).match for step in range(12)]
    looked_for = [set(batch.positive_sensor.tolist()) for batch in batches]
    assert all(len(sensors) == 1 for sensors in looked_for) and len(set.union(*looked_for)) > 1
    assert all((batch.sensor != batch.positive_sensor).all() for batch in batches)
    assert all(np.array_equal(a, b) for a, b in zip(batches[3], Loader(manifest, config).batch(3).match, strict=True))


def test_without_negatives_of_the_same_sensor_there_is_no_matching_and_a_note(make, settings):
    seen = {"text": "words"}
    rows = [{"touch": "p", "sensor": name, "object": "o", **seen} for name in ("digit", "gelslim")]
    loader = Loader(make([*rows, {"touch": "q", "object": "r", "sensor": "duragel"}] * 2), settings(2))
    assert loader.batch(0).match is not None
    loader = Loader(loader.manifest, settings(2, negatives="same_sensor"))
    assert loader.batch(0).match is None and any("data.negatives=same_sensor" in note for note in loader.notes)


# Text of downstream test frames ---------------------------------------------------------------------------------------


def test_text_of_downstream_test_frames_is_withheld_and_counted(make, settings):
    rows = [{"text": f"word{i}", "downstream_test": "material" if i < 3 else None} for i in range(10)]
    manifest = make(rows)
    loader = Loader(manifest, settings(2))
    assert any(note.startswith("the text of 3 rows is withheld") for note in loader.notes)
    assert loader.tokenizer is not None
    used = set()
    for step in range(10):
        batch = loader.batch(step).align
        for text, row in zip(batch.text, batch.text_row, strict=True):
            used.add(tuple(text.tolist()) if row < 4 else None)
    wanted = {tuple(loader.tokenizer.encode([f"word{i}"], 8)[0][0].tolist()) for i in range(3, 10)}
    assert used - {None} == wanted
    assert pools.training_captions(manifest, np.arange(10)) == [f"word{i}" for i in range(3, 10)]
    assert not any("withheld" in note for note in Loader(manifest, settings(1)).notes)


@pytest.mark.parametrize(
    ("values", "set_"),
    [([True, False, None], [1, 0, 0]), ([1, 0, None], [1, 0, 0]), (["1", "0", "False"], [1, 0, 0]),
     (["rough", "", "NO"], [1, 0, 0]), ([0.0, 1.0, None], [0, 1, 0])],
)  # fmt: skip
def test_what_counts_as_set(make, values, set_):
    manifest = make([{"downstream_test": value} for value in values])
    assert pools.withheld_text(manifest).tolist() == [bool(one) for one in set_]


def test_all_text_withheld_means_no_text_slots(make, settings):
    loader = Loader(make([{"text": "x", "downstream_test": "a", "image_path": "v.png"}] * 4), settings(2))
    assert len(loader.batch(0).align.text) == 0 and loader.tokenizer is None
