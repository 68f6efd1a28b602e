import hashlib
import threading
from dataclasses import replace

import numpy as np
import pytest
from batch_leaves import assert_same, leaves
from refused import refused

from anytouch_jax.data import tokenizer as text
from anytouch_jax.data.loading import samples
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest.manifest import read, write
from anytouch_jax.errors import UserError


def _clips(sequences=3, length=7):
    return [
        {"sequence": f"s{i}", "frame_index": k} for i in range(sequences) for k in range(length)
    ]


@pytest.mark.parametrize(
    ("stage", "recipe"), [(1, "paper"), (1, "release"), (2, "paper"), (2, "release")]
)
def test_the_same_bytes_for_any_number_of_threads_and_from_any_start(
    make, settings, rich, stage, recipe
):
    manifest = make(rich)
    config = settings(stage, recipe, plain=False, threads=1)
    loader = Loader(manifest, config)
    first = list(loader.stream(0, 6))
    assert [step for step, _, _ in first] == list(range(6))
    for threads in (0, 2, 4):
        other = Loader(manifest, settings(stage, recipe, plain=False, threads=threads, prefetch=2))
        for (_, a, info_a), (_, b, info_b) in zip(first, other.stream(0, 6), strict=True):
            assert_same(a, b)
            assert info_a == info_b
    late = Loader(manifest, config)  # a resumed run
    for (step, a, info), (_, b, info_b) in zip(first[3:], late.stream(3, 6), strict=True):
        assert_same(a, b)
        assert_same(a, Loader(manifest, config).batch(step))
        assert info == info_b
    assert not [
        thread for thread in threading.enumerate() if thread.name.startswith("anytouch-data")
    ]
    changed = Loader(manifest, replace(config, run=replace(config.run, seed=1)))
    assert any(
        not np.array_equal(a, b)
        for a, b in zip(leaves(changed.batch(0)), leaves(first[0][1]), strict=False)
    )


def test_contrast_reads_no_third_touch_and_knows_which_pairs_are_of_one_place(make, settings, rich):
    config = settings(2, plain=True)
    config = replace(config, model=replace(config.model, match_head="cosine"))
    manifest = make(rich)
    places = set()
    for step in range(4):
        match = Loader(manifest, config).batch(step).match
        assert (
            match.clip.any()
            and match.positive.any()
            and match.negative is match.negative_sensor is None
        )
        result = [
            manifest.codes("touch", own=True)[int(clip[-1, 0, 0, 0]) - 1] for clip in match.clip
        ]
        np.testing.assert_array_equal(match.place, result)
        places |= set(result)
    assert len(places) > 1


@pytest.mark.parametrize("batch", [1, 4, 5, 10])
def test_an_epoch_of_stills_and_of_clips_holds_every_row_once(make, settings, read_back, batch):
    """Frame 7 of each recording is of another split, which no clip crosses."""
    rows = [row | {"split": "test" if row["frame_index"] == 7 else "train"} for row in _clips(3, 9)]
    loader = Loader(make(rows), settings(batch_size=batch, threads=0))
    windows = [tuple(range(9 * s + k, 9 * s + k + 4)) for s in range(3) for k in range(4)]
    stills = [(row,) for row in range(27) if row % 9 != 7]
    counts = {"still": dict.fromkeys(stills, 0), "clip": dict.fromkeys(windows, 0)}
    for step in range(2 * 24):
        count = counts[loader.kind(step)]
        clips = loader.batch(step).clip
        assert clips.shape[2:] == (28, 28, 3) and clips.dtype == np.uint8
        for clip in read_back(clips).tolist():
            count[tuple(clip)] += 1
        # all of one epoch come before any of the next
        assert max(count.values()) - min(count.values()) <= 1
    assert min(counts["still"].values()) >= 1 and min(counts["clip"].values()) >= 1
    assert loader.steps_per_epoch == -(-24 // batch) + -(-12 // batch)


def test_the_paper_takes_turns_and_the_release_draws(make, settings):
    manifest = make(_clips())

    def kinds(count, **options):
        loader = Loader(manifest, settings(**options))
        return [loader.kind(step) for step in range(count)]

    assert (
        kinds(4) == ["still", "clip"] * 2
        and kinds(8, clip_fraction=0.25) == (["still"] * 3 + ["clip"]) * 2
    )
    drawn = kinds(400, recipe="release", clip_fraction=0.25)
    assert 70 < drawn.count("clip") < 130
    assert drawn != kinds(400, recipe="release", clip_fraction=0.25, order="alternate")
    for fraction, kind in ((0.0, "still"), (1.0, "clip")):
        for recipe in ("paper", "release"):
            assert kinds(8, recipe=recipe, clip_fraction=fraction)[7] == kind
    # clips make no epoch longer
    assert Loader(manifest, settings(clip_fraction=0.0)).steps_per_epoch == 6


def test_rows_of_the_split_and_of_known_sensors_are_drawn_and_others_are_noted(
    make, settings, read_back
):
    names = ["digit", "gelslim", "9dtact", "tac3d"]
    splits = ["train", "val"]
    manifest = make([{"sensor": names[i % 4], "split": splits[i // 16]} for i in range(20)])
    loader = Loader(manifest, settings())
    for step in range(9):
        batch, drawn = loader.batch(step), read_back(loader.batch(step).clip)[:, 0]
        assert loader.kind(step) == "still" and batch.clip.shape == (4, 1, 28, 28, 3)
        assert drawn.max() < 16 and batch.sensor.dtype == np.int32
        np.testing.assert_array_equal(batch.sensor, np.array([1, 2, 5, -1])[drawn % 4])
    notes = " ".join(loader.notes)
    assert "no clip of 4 frames" in notes and "4 rows of tac3d" in notes
    rows = _clips(1, 12)
    rows[5]["sensor"] = "tac3d"
    loader = Loader(make(rows), settings())
    # no clip spans it
    assert not any(5 in read_back(loader.batch(step).clip) for step in range(1, 20, 2))


@pytest.mark.parametrize(
    ("row", "data", "more", "message"),
    [
        ({"sensor": "tac3d"}, {}, {}, r"manifest\.csv: split 'train' has no row of a known sensor"),
        ({}, {"split": "test"}, {}, r"manifest\.csv: column 'split' has no row 'test'"),
        ({}, {"batch_size": 0}, {}, r"--(loader|data)\.batch-size must be 1 or more, not 0"),
        ({}, {}, {"devices": 0}, "devices must be 1 or more, not 0"),
        (
            {},
            {"batch_size": 6},
            {"devices": 4, "shard": (0, 4)},
            "batch_size 6 cannot be shared by 4 processes",
        ),
        (
            {},
            {"batch_size": 8},
            {"devices": 3, "shard": (0, 2)},
            "devices 3 cannot be shared by 2 processes",
        ),
        ({}, {}, {"devices": 2, "shard": (2, 2)}, "there is no shard 2 of 2"),
        ({}, {}, {"devices": 2, "shard": (0, 0)}, "there is no shard 0 of 0"),
    ],
)
def test_what_cannot_be_loaded_is_refused(make, settings, row, data, more, message):
    refused(message, lambda: Loader(make([row]), settings(**data), **more))


def _check_align(batch, rows, read_back, tokenizer):
    size = len(batch.clip)
    drawn = read_back(batch.clip)[:, -1]
    with_image = [slot for slot, r in enumerate(drawn) if rows[r].get("image_path")]
    with_text = [slot for slot, r in enumerate(drawn) if rows[r].get("text")]
    used = batch.image_row[batch.image_row < size].tolist()
    assert used == with_image and (batch.image_row[len(used) :] == size).all()
    for place, slot in enumerate(used):
        assert batch.image[place, 14, 14].tolist() == [drawn[slot] + 1, 200, 9]
    used = batch.text_row[batch.text_row < size].tolist()
    assert used == with_text and (batch.text_row[len(used) :] == size).all()
    if len(batch.text):
        want, mask = tokenizer.encode(
            [rows[drawn[slot]]["text"] for slot in used] + [""] * (len(batch.text) - len(used)),
            batch.text.shape[1],
        )
        np.testing.assert_array_equal(batch.text, want)
        np.testing.assert_array_equal(batch.text_mask, mask)
    for name, kind in (
        ("image_row", np.int32),
        ("text", np.int32),
        ("text_mask", bool),
        ("text_row", np.int32),
    ):
        assert getattr(batch, name).dtype == kind
    return len(with_image), len(with_text)


@pytest.mark.parametrize("recipe", ["paper", "release"])
@pytest.mark.parametrize("devices", [1, 4])
def test_images_and_texts_sit_in_their_slots(make, settings, read_back, rich, recipe, devices):
    manifest = make(rich)
    config = settings(2, recipe, batch_size=8)
    loader = Loader(manifest, config, devices=devices)
    lock = Loader(manifest, config)
    frames = {"still": 1, "clip": 4 if recipe == "release" else 3}
    shapes = {}
    steps = 0
    for step, batch, info in loader.stream(0, 24):
        if batch.align is None:
            assert info == {"skipped_samples": 0, "images": 0, "texts": 0}
            continue
        steps += 1
        assert batch.align.clip.shape[:2] == (8, frames[loader.kind(step)])
        assert (np.diff(read_back(batch.align.clip), axis=1) == 1).all()
        images, texts = _check_align(batch.align, rich, read_back, loader.tokenizer)
        assert info == {"skipped_samples": 0, "images": images, "texts": texts}
        shape = (len(batch.align.image), len(batch.align.text))
        # fixed for a run
        assert shapes.setdefault(loader.kind(step), shape) == shape
        assert all(slots % devices == 0 for slots in shape)
        # the devices add unused slots, and nothing else
        same = lock.batch(step).align
        np.testing.assert_array_equal(same.clip, batch.align.clip)
        # without them the slots are full
        assert (images, texts) == (len(same.image), len(same.text))
    assert steps >= 5 and set(shapes) == {"still", "clip"}


def test_images_lie_anywhere_in_the_batch(make, settings):
    rows = [{"image_path": f"v{i}.png"} if i % 4 == 0 else {} for i in range(16)]
    loader = Loader(make(rows), settings(2, batch_size=8))
    places = [tuple(loader.batch(step).align.image_row) for step in range(12)]
    # not the first rows only
    assert len(set(places)) > 5 and {slot for pair in places for slot in pair} >= {0, 7}


def test_what_has_no_tower_is_not_read(make, settings):
    rows = [
        {"image_path": f"v{i}.png", "text": "words", "touch": f"p{i // 2}", "unit": f"u{i % 2}"}
        for i in range(8)
    ]
    config = settings(2)
    towerless = replace(config, model=replace(config.model, image=None, text=None))
    loader = Loader(make(rows), towerless)
    batch = loader.batch(0).align
    assert (
        batch.image.shape == (0, 28, 28, 3)
        and batch.image_row.shape == (0,)
        and loader.tokenizer is None
    )
    assert batch.text.shape == batch.text_mask.shape == (0, 0) and batch.text_row.shape == (0,)


def test_captions_are_padded_to_the_longest_in_eights_and_never_beyond_the_tower(make, settings):
    """Positions behind all end tokens are work for nothing. A long caption keeps its end token."""
    for words, length in ((["one"], 8), (["one two three four five six seven eight"], 12)):
        manifest = make([{"text": text} for text in words * 8])
        loader = Loader(manifest, settings(2))  # its tower has 12 positions
        batch = loader.batch(0).align
        assert batch.text.shape[1] == length
        np.testing.assert_array_equal(
            batch.text[0], loader.tokenizer.encode(words[:1], length)[0][0]
        )
        assert loader.tokenizer.end_id in batch.text[0]
    assert loader.tokenizer.longest([]) == 2
    assert loader.tokenizer.longest(["", "one two three four five six seven eight"]) > 9


def test_tokenizers(make, settings, tmp_path):
    rows = [{"text": f"a rough caption number {i}"} for i in range(8)]
    manifest = make(rows)
    config = settings(2)
    loader = Loader(manifest, config)
    assert any("trained on the captions" in note for note in loader.notes)
    given = text.train_tokenizer([row["text"] for row in rows], 300)
    given.save(tmp_path)
    first = Loader(manifest, config, tokenizer=given)
    assert first.tokenizer is given and first.notes != loader.notes
    second = Loader(manifest, settings(2, tokenizer=str(tmp_path)))
    assert_same(first.batch(0), second.batch(0))
    silent = Loader(
        make([{"image_path": f"v{i}.png"} for i in range(4)], "silent"), config, tokenizer=given
    )
    # a manifest without captions, as CLIP's tokenizer meets it
    assert not len(silent.batch(0).align.text)
    small = replace(config, model=replace(config.model, text=replace(config.model.text, vocab=280)))
    refused(
        f"{given.vocab_size} tokens but the text tower only 280",
        Loader,
        manifest,
        small,
        tokenizer=given,
    )


def _check_match(match, rows, read_back, size, frames, other_object=False):
    anchor, positive, negative = (
        read_back(clip) for clip in (match.clip, match.positive, match.negative)
    )
    ids = {"digit": 1, "gelslim": 2}
    for clip, sensor in (
        (anchor, match.sensor),
        (positive, match.positive_sensor),
        (negative, match.negative_sensor),
    ):
        assert clip.shape == (size, frames)
        assert (np.diff(clip, axis=1) == 1).all()
        assert sensor.tolist() == [ids[rows[r]["sensor"]] for r in clip[:, -1]]
    for a, p, n in zip(anchor[:, -1], positive[:, -1], negative[:, -1], strict=True):
        assert rows[a]["touch"] == rows[p]["touch"] and rows[a]["sensor"] != rows[p]["sensor"]
        assert rows[a]["touch"] != rows[n]["touch"]
        assert rows[a]["object"] != rows[n]["object"] or not other_object
    return anchor[:, -1].tolist()


def test_matching_triples_in_both_recipes(make, settings, read_back, rich):
    manifest = make(rich)
    loader = Loader(manifest, settings(2, batch_size=6))
    anchors = {"still": [], "clip": []}
    for step, batch, _ in loader.stream(0, 16):
        assert batch.align is not None
        kind = loader.kind(step)
        anchors[kind] += _check_match(batch.match, rich, read_back, 6, 1 if kind == "still" else 3)
    assert sorted(anchors["still"]) == list(range(48)) and len(set(anchors["clip"][:32])) == 32
    release = Loader(manifest, settings(2, "release", batch_size=6))
    parts = []
    for step, batch, _ in release.stream(0, 60):
        # never both in a step
        assert (batch.align is None) != (batch.match is None)
        parts.append(batch.match is not None)
        if batch.match is not None:
            _check_match(
                batch.match,
                rich,
                read_back,
                3,
                1 if release.kind(step) == "still" else 3,
                other_object=True,
            )
    # align: 48/6 + 24/6 = 12 batches, match: 48/3 + 32/3 = 26.7 batches of half the size
    assert 0.5 < np.mean(parts) < 0.85
    assert release.steps_per_epoch == 8 + 4 + 16 + 11


@pytest.mark.parametrize("recipe", ["paper", "release"])
def test_without_pairs_there_is_no_matching_but_a_note(make, settings, recipe):
    caption = {"text": "a caption"}
    one = make([{"touch": "1"} | caption], "one")
    two = make([{"touch": "1", "sensor": "gelslim"} | caption, {"touch": "2"}], "two")
    for manifest in (one, two):
        write(manifest, manifest.files[0])
    # touches of two manifests are two
    loader = Loader(read([one.files[0], two.files[0]]), settings(2, recipe))
    assert any("no cross-sensor matching" in note for note in loader.notes)
    for _, batch, _ in loader.stream(0, 6):
        assert batch.match is None and batch.align is not None


def test_stage_two_with_nothing_to_learn_is_refused(make, settings):
    """Its loss would be 0 at every step, and the run would end well."""
    bare = [{"touch": f"p{i}"} for i in range(8)]
    pictured = [{"image_path": f"v{i}.png"} for i in range(8)]
    twice = [{"touch": f"p{i // 2}", "unit": f"u{i % 2}"} for i in range(8)]
    captioned = [{"text": "words"} for _ in range(8)]
    config = settings(2)
    changes = {"match_head": "none"}, {"image": None}, {"text": None}
    no_matching, no_vision, no_text = (
        replace(config, model=replace(config.model, **one)) for one in changes
    )
    for rows, one in (
        (bare, config),
        (twice, no_matching),
        (pictured, no_vision),
        (captioned, no_text),
    ):
        refused("stage 2 has nothing to learn from split 'train'", Loader, make(rows), one)
    for rows, one in (
        (twice, config),
        (pictured, no_matching),
        (captioned, no_vision),
        (bare, settings(2, "release")),
    ):
        assert Loader(make(rows), one).steps_per_epoch
    assert Loader(make(bare), settings(1)).steps_per_epoch


def test_pairs_of_stills_only_match_stills_in_clip_steps(make, settings, read_back):
    rows = _clips(3, 6)
    for i, row in enumerate(rows[6:]):
        row["sequence"] += f"x{i // 2}"  # two frames a sequence: no clips
        row |= {
            "touch": f"p{i // 2}",
            "sensor": ["digit", "gelslim"][i % 2],
            "object": f"o{i // 2}",
        }
    loader = Loader(make(rows), settings(2))
    assert any("matching uses stills only" in note for note in loader.notes)
    collected = []
    for step, batch, _ in loader.stream(0, 6):
        assert batch.align.clip.shape[1] == (1 if loader.kind(step) == "still" else 3)
        collected += _check_match(batch.match, rows, read_back, 4, 1)
    # its own epoch goes on through both kinds
    assert sorted(collected[:12]) == list(range(6, 18))


def test_a_bad_partner_replaces_the_triple(make, settings, read_back, rich):
    manifest = make(rich)
    manifest.file(7).unlink()
    loader = Loader(manifest, settings(2, batch_size=6, on_bad_sample="skip"))
    skipped = 0
    for _, batch, info in loader.stream(0, 40):
        frames = batch.match.clip.shape[1]
        _check_match(batch.match, rich, read_back, 6, frames)
        skipped += info["skipped_samples"]
    assert skipped


def test_batches_that_groups_or_processes_cannot_fraction_are_refused(make, settings, rich):
    manifest = make(rich)

    def load(groups, head="mlp", recipe="paper", **data):
        config = settings(2, recipe, **data)
        model = replace(config.model, match_head=head)
        objective = replace(config.objective, groups=groups)
        return Loader(manifest, replace(config, model=model, objective=objective))

    refused(r"a batch of 6 touches does not divide by --objective\.groups 4", load, 4, batch_size=6)
    # Of the release a batch to match has half the rows; only where these are each other's negatives
    # must they divide.
    refused(
        r"a batch of 2 touches does not divide by --objective\.groups 4",
        load,
        4,
        "cosine",
        "release",
    )
    for head, recipe in (("cosine", "paper"), ("linear", "release")):
        assert load(4, head, recipe)
    loader = Loader(manifest, settings(2, "release", batch_size=2), devices=2, shard=(0, 2))
    with pytest.raises(UserError, match="the rows of a matching batch 1 cannot be shared by 2"):
        for step in range(40):
            loader.batch(step)


def _parts(batch):
    """Arrays of a batch, images as the colour of one pixel: the same with any OpenCV."""
    if batch is None:
        return
    for name, part in batch._asdict().items():
        if part is None or hasattr(part, "_asdict"):
            yield from _parts(part)
        elif name not in ("text", "text_mask"):
            yield part[..., 10, 10, :] if part.ndim > 3 else part


# What the loader draws where nothing is asked for; other draws make old runs end in other places.
BEFORE = {
    (1, "paper"): "ed7e482b46094897",
    (1, "release"): "9e58a1ad76f48577",
    (2, "paper"): "e30fc1d2cabfdc00",
    (2, "release"): "141d221a227066ce",
}


@pytest.mark.parametrize(("stage", "recipe"), list(BEFORE))
def test_by_default_the_draws_are_what_they_were(make, settings, stage, recipe, rich):
    loader = Loader(make(rich), settings(stage, recipe), devices=2)
    digest = hashlib.sha256()
    for step in range(12):
        for part in _parts(loader.batch(step)):
            digest.update(str(part.shape).encode() + np.ascontiguousarray(part).tobytes())
    assert digest.hexdigest()[:16] == BEFORE[stage, recipe]


@pytest.mark.parametrize(("stage", "recipe"), [(1, "paper"), (2, "paper"), (2, "release")])
@pytest.mark.parametrize(("count", "bad"), [(2, "error"), (4, "skip")])
def test_the_parts_joined_are_the_whole(make, settings, stage, recipe, count, bad, rich):
    manifest = make(rich)
    if bad == "skip":
        for row in (2, 7, 30):
            manifest.file(row).unlink()
        manifest.file(4, "image_path").unlink()
    config = settings(stage, recipe, plain=False, batch_size=8, on_bad_sample=bad)
    whole = Loader(manifest, config, devices=4)
    parts = [Loader(manifest, config, devices=4, shard=(i, count)) for i in range(count)]
    skipped = 0
    for (step, batch, info), *rest in zip(
        *(one.stream(0, 8) for one in (whole, *parts)), strict=True
    ):
        joined = [
            np.concatenate(arrays)
            for arrays in zip(*(leaves(one) for _, one, _ in rest), strict=True)
        ]
        wanted = leaves(batch)
        assert len(joined) == len(wanted) and step == rest[0][0]
        for got, want in zip(joined, wanted, strict=True):
            np.testing.assert_array_equal(got, want)
        assert sum(one["skipped_samples"] for _, _, one in rest) == info["skipped_samples"]
        assert all(one.get("images") == info.get("images") for _, _, one in rest)
        skipped += info["skipped_samples"]
    assert (skipped > 0) == (bad == "skip")


def test_a_shard_reads_only_the_files_of_its_part(make, settings, monkeypatch, rich):
    manifest = make(rich)
    read = []
    decode = samples.decode
    monkeypatch.setattr(samples, "decode", lambda path: read.append(path) or decode(path))
    counts = {}
    for shard in ((0, 1), (0, 2), (1, 2)):
        read.clear()
        loader = Loader(manifest, settings(2, batch_size=8, cache=0), devices=4, shard=shard)
        for step in range(6):
            loader.batch(step)
        counts[shard] = len(read)
    assert counts[0, 2] + counts[1, 2] == counts[0, 1] and 0.3 < counts[0, 2] / counts[0, 1] < 0.7
