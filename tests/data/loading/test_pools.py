from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from refused import refused

from anytouch_jax.config import presets
from anytouch_jax.data.loading import pools
from anytouch_jax.data.loading.loader import Loader


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
    assert (
        loader.steps_per_epoch == 6
        and "an epoch draws a 3 times, b 0.5 times, other datasets once" in loader.notes
    )
    counts, rows = _drawn(loader, manifest, read_back, 24)
    assert counts == {"a": 18, "b": 2, None: 2} | ({} if sum(counts.values()) == 22 else counts)
    assert Counter(rows[:22])[0] == 3


def test_weight_zero_leaves_a_dataset_out_of_stills_clips_and_matching(
    make, settings, read_back, rich
):
    rows = [row | {"dataset": "a" if i < 24 else "b"} for i, row in enumerate(rich)]
    loader = Loader(make(rows), settings(2, weights=(("b", 0.0),)))
    for _, batch, _ in loader.stream(0, 20):
        for clip in (
            batch.align.clip,
            batch.match.clip,
            batch.match.positive,
            batch.match.negative,
        ):
            assert read_back(clip).max() < 24


def test_the_release_weighs_its_datasets(make, settings):
    there = make(_sets({"touch_and_go": 4, "octopi": 4, "x": 4}, image_path="v.png"))
    release = Loader(there, settings(2, "release"))
    assert release.steps_per_epoch == (8 + 12 + 4) // 4
    assert any("touch_and_go 2 times, octopi 3 times" in note for note in release.notes)
    for plain in (settings(1, "release"), settings(2), settings(2, "release", weights=())):
        assert Loader(there, plain).steps_per_epoch == 3
    some = Loader(make(_sets({"octopi": 4, "x": 4}), "some"), settings(2, "release"))
    assert some.steps_per_epoch == 4 and not any("touch_and_go" in note for note in some.notes)
    none = Loader(make(_sets({"x": 4}), "none"), settings(2, "release"))
    assert not any("an epoch draws" in note for note in none.notes)


def test_strata_follow_the_weights(make, settings):
    rows = _sets({"a": 8}, image_path="v.png") + _sets({"b": 8})
    few, many = (Loader(make(rows), settings(2, weights=(("a", w),))) for w in (1.0, 3.0))
    assert (len(few.batch(0).align.image), len(many.batch(0).align.image)) == (2, 3)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ((("c", 2.0),), r"names the dataset 'c', but split 'train' has a, b"),
        ((("a", -1.0),), "--data.weights must be 0 or more"),
        ((("a", float("nan")),), "--data.weights must be 0 or more"),
        ((("a", 1.0), ("a", 2.0)), "a dataset twice"),
        ((("a", 0.0), ("b", 0.0)), "leaves out every row"),
    ],
)
def test_weights_that_make_no_sense_are_errors(make, settings, weights, message):
    refused(message, lambda: Loader(make(_sets({"a": 4, "b": 4})), settings(weights=weights)))


def test_where_the_batch_is_the_negatives_they_are_of_one_sensor(make, settings, rich):
    manifest = make(rich)
    config = settings(2, negatives="same_sensor")
    config = replace(config, model=replace(config.model, match_head="cosine"))
    loader = Loader(manifest, config)
    batches = [loader.batch(step).match for step in range(12)]
    looked_for = [set(batch.positive_sensor.tolist()) for batch in batches]
    assert all(len(sensors) == 1 for sensors in looked_for) and len(set.union(*looked_for)) > 1
    assert all((batch.sensor != batch.positive_sensor).all() for batch in batches)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(batches[3], Loader(manifest, config).batch(3).match, strict=True)
    )


def test_without_negatives_of_the_same_sensor_there_is_no_matching_and_a_note(make, settings):
    caption = {"text": "words"}
    rows = [
        {"touch": "p", "sensor": name, "object": "o", **caption} for name in ("digit", "gelslim")
    ]
    loader = Loader(
        make([*rows, {"touch": "q", "object": "r", "sensor": "duragel"}] * 2), settings(2)
    )
    assert loader.batch(0).match is not None
    loader = Loader(loader.manifest, settings(2, negatives="same_sensor"))
    assert loader.batch(0).match is None and any(
        "data.negatives=same_sensor" in note for note in loader.notes
    )


def test_text_of_downstream_test_frames_is_withheld_and_counted(make, settings):
    manifest = make(
        [
            {"text": f"caption {i}", "downstream_test": "material" if i < 3 else None}
            for i in range(8)
        ]
    )
    loader = Loader(manifest, settings(2))
    assert any(note.startswith("the text of 3 rows is withheld") for note in loader.notes)
    assert captions_drawn(loader) == [3, 4, 5, 6, 7]
    assert pools.training_captions(manifest, np.arange(8)) == [f"caption {i}" for i in range(3, 8)]
    assert not any("withheld" in note for note in Loader(manifest, settings(1)).notes)


@pytest.mark.parametrize(
    ("values", "set_"),
    [
        ([True, False, None], [1, 0, 0]),
        ([1, 0, None], [1, 0, 0]),
        (["1", "0", "False"], [1, 0, 0]),
        (["rough", "", "NO"], [1, 0, 0]),
        ([0.0, 1.0, None], [0, 1, 0]),
    ],
)
def test_what_counts_as_set(make, values, set_):
    manifest = make([{"downstream_test": value} for value in values])
    assert pools.withheld_text(manifest).tolist() == [bool(one) for one in set_]


SIZE = 4


def world():
    """Eight recordings of six frames.

    Every third has no caption, every second no image. The first two of four objects were felt by
    two sensors at the same places.
    """
    rows = []
    for i in range(8):
        for k in range(6):
            row = {"sequence": f"s{i}", "frame_index": k, "sensor": "digit" if i % 2 else "gelslim"}
            row |= {"object": f"o{i // 2}", "touch": f"place{i // 2 if i < 4 else i}.{k}"}
            row |= {"text": f"caption {i}"} if i % 3 else {}
            rows.append(row | ({"image_path": f"v{i}.png"} if i in (0, 2, 4, 5, 7) else {}))
    return rows


def batches(loader, steps=24):
    return [loader.batch(step) for step in range(steps)]


def changed(config, name):
    return presets.apply_baseline(name, config)


@pytest.mark.parametrize(
    ("name", "recordings", "images", "texts", "matches"),
    [
        ("tlv_link", {2, 4, 5, 7}, 4, 4, False),
        ("unitouch", {0, 2, 4, 5, 7}, 4, 0, False),
        ("no_text", set(range(8)), None, 0, True),
        ("no_vision", set(range(8)), 0, None, True),
        ("no_matching", set(range(8)), None, None, False),
    ],
)
def test_a_baseline_draws_what_it_needs(
    make, settings, read_back, name, recordings, images, texts, matches
):
    loader = Loader(make(world()), changed(settings(2), name))
    collected = set()
    for batch in batches(loader):
        align = batch.align
        for rows, count in ((align.image_row, images), (align.text_row, texts)):
            assert (sorted(rows.tolist()) == list(range(count))) if count is not None else len(rows)
        assert (batch.match is not None) == matches
        collected |= set((read_back(align.clip)[:, -1] // 6).tolist())
    assert collected == recordings and (loader.tokenizer is None) == (texts == 0)
    assert any("24 of 48 rows have image and text" in note for note in loader.notes) == (
        name == "tlv_link"
    )


@pytest.mark.parametrize(
    ("change", "data", "message"),
    [
        (
            {"image_path": None},
            {"require": ("image", "text")},
            r"data\.require: no row of split 'train' has image and text",
        ),
        ({}, {"contact_only": True}, r"--data\.contact-only needs the column 'label\.contact'"),
        (
            {"label.contact": "0"},
            {"contact_only": True},
            r"data\.contact_only: no row of split 'train' has contact",
        ),
    ],
)
def test_no_row_that_may_be_drawn_is_an_error(make, settings, change, data, message):
    refused(message, lambda: Loader(make([row | change for row in world()]), settings(2, **data)))


def test_only_frames_in_contact_are_drawn_in_alignment_and_in_matching(make, settings, read_back):
    # "": not known
    rows = [
        row | {"label.contact": {0: "0", 1: "", 3: "0"}.get(row["frame_index"], "1")}
        for row in world()
    ]
    loader = Loader(make(rows), settings(2, contact_only=True))
    drawn = []
    for batch in batches(loader):
        drawn.append(batch.align.clip)
        drawn += (
            (batch.match.clip, batch.match.positive, batch.match.negative) if batch.match else ()
        )
    ends = {(clip.shape[1], int(end) % 6) for clip in drawn for end in read_back(clip)[:, -1]}
    assert ends == {(1, 1)} | {(frames, end) for frames in (1, 3) for end in (2, 4, 5)}
    assert any(
        "32 of 48 rows have contact; only they are drawn (data.contact_only)" in note
        for note in loader.notes
    )
    both = Loader(make(rows), settings(2, contact_only=True, require=("text",)))
    assert any("20 of 48 rows have text and contact" in note for note in both.notes)


def captions_drawn(loader):
    drawn = {
        tuple(ids)
        for one in batches(loader)
        for ids in one.align.text[one.align.text_row < SIZE].tolist()
    }
    return [
        i
        for i in range(8)
        if tuple(loader.tokenizer.encode([f"caption {i}"], 8)[0][0].tolist()) in drawn
    ]


def test_the_text_of_shared_touches_never_reaches_a_batch(make, settings):
    manifest = make(world())
    assert captions_drawn(Loader(manifest, settings(2))) == [1, 2, 4, 5, 7]
    loader = Loader(manifest, changed(settings(2), "no_text_aligned"))
    assert captions_drawn(loader) == [4, 5, 7]
    assert any("the text of 12 of 30 rows is withheld" in note for note in loader.notes)
    # their touches still match
    assert any(batch.match is not None for batch in batches(loader, 4))
    assert pools.training_captions(manifest, np.arange(48), aligned_text=False) == [
        f"caption {i}" for i in (4, 5, 7)
    ]


def test_a_touch_is_aligned_by_another_sensor_or_another_unit(make):
    manifest = make(
        [
            {"touch": "a", "sensor": "digit"},
            {"touch": "a", "sensor": "gelslim"},  # two sensors
            {"touch": "b", "unit": "1"},
            {"touch": "b", "unit": "2"},  # two units
            {"touch": "c", "unit": "1"},
            {"touch": "c", "unit": "1"},  # one device twice
            {"touch": None, "sensor": "digit"},
            {"touch": None, "sensor": "gelslim"},
        ]
    )
    assert pools.withheld_text(manifest, aligned_text=False).tolist() == [True] * 4 + [False] * 4
    assert not pools.withheld_text(manifest).any()


def test_the_trained_sensors_are_those_drawn_from(make, settings):
    rows = [
        *world(),
        {"sensor": "duragel", "split": "val"},
        {"sensor": "gelsight", "image_path": "w.png"},
    ]
    for stage, data, sensors in (
        (1, {}, ["gelsight", "digit", "gelslim"]),
        (1, {"clip_fraction": 1.0}, ["digit", "gelslim"]),
        (2, {"require": ("text",)}, ["digit", "gelslim"]),
    ):
        assert Loader(make(rows), settings(stage, **data)).trained_sensors == sensors
