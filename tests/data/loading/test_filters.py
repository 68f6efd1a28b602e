"""Which samples a baseline draws: complete ones, stills alone, without certain text."""

from __future__ import annotations

import numpy as np
import pytest

from anytouch_jax.config import baselines
from anytouch_jax.data.loading import pools
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.errors import UserError

SIZE = 4


def world():
    """Eight recordings of six frames: every third without caption, every second without photograph; the first two of
    four objects were felt by two sensors at the same places."""
    rows = []
    for i in range(8):
        for k in range(6):
            row = {"sequence": f"s{i}", "frame_index": k, "sensor": "digit" if i % 2 else "gelslim"}
            row |= {"object": f"o{i // 2}", "touch": f"place{i // 2 if i < 4 else i}.{k}"}
            row |= {"text": f"caption {i}"} if i % 3 else {}
            rows.append(row | ({"image_path": f"v{i}.png"} if i in (0, 2, 4, 5, 7) else {}))
    return rows


COMPLETE = {(f"s{i}", i) for i in (2, 4, 5, 7)}


def batches(loader, steps=24):
    return [loader.batch(step) for step in range(steps)]


def changed(config, name):
    return baselines.apply(name, config)


# Complete samples ----------------------------------------------------------------------------------------------------


def test_tlv_link_draws_only_samples_with_all_three(make, settings, read_back):
    loader = Loader(make(world()), changed(settings(2), "tlv_link"))
    seen = set()
    for batch in batches(loader):
        align = batch.align
        assert align.clip.shape[1] == 1 and batch.match is None
        assert sorted(align.image_row.tolist()) == sorted(align.text_row.tolist()) == list(range(SIZE))
        seen |= set((read_back(align.clip)[:, -1] // 6).tolist())
    assert seen == {2, 4, 5, 7}
    assert any("24 of 48 rows have image and text" in note for note in loader.notes)


def test_unitouch_draws_photographs_and_no_text(make, settings, read_back):
    loader = Loader(make(world()), changed(settings(2), "unitouch"))
    seen = set()
    for batch in batches(loader):
        assert batch.align.text.shape[0] == 0 and batch.match is None
        assert sorted(batch.align.image_row.tolist()) == list(range(SIZE))
        seen |= set((read_back(batch.align.clip)[:, -1] // 6).tolist())
    assert seen == {0, 2, 4, 5, 7} and loader.tokenizer is None


def test_clips_end_at_rows_with_the_required_modalities(make, settings, read_back):
    rows = world()
    for row in rows:
        if row["frame_index"] != 4:  # one photograph in a recording: a clip may reach back over frames without one
            row.pop("image_path", None)
    loader = Loader(make(rows), settings(2, require=("image",)))
    ends = {
        (batch.align.clip.shape[1], int(end)) for batch in batches(loader) for end in read_back(batch.align.clip)[:, -1]
    }
    assert {end % 6 for _, end in ends} == {4} and {frames for frames, _ in ends} == {1, 3}
    for batch in batches(loader):
        for clip in (batch.match.clip, batch.match.positive, batch.match.negative) if batch.match else ():
            assert set((read_back(clip)[:, -1] % 6).tolist()) == {4}


def test_no_row_with_the_required_modalities_is_an_error(make, settings):
    rows = [{**row, "image_path": None} for row in world()]
    with pytest.raises(UserError, match=r"data\.require: no row of split 'train' has image and text"):
        Loader(make(rows), settings(2, require=("image", "text")))


def test_only_frames_in_contact_are_drawn_in_alignment_and_in_matching(make, settings, read_back):
    rows = [row | {"label.contact": {0: "0", 1: ""}.get(row["frame_index"], "1")} for row in world()]  # "": not known
    loader = Loader(make(rows), settings(2, contact_only=True))
    drawn = []
    for batch in batches(loader):
        drawn.append(batch.align.clip)
        drawn += (batch.match.clip, batch.match.positive, batch.match.negative) if batch.match else ()
    ends = {(clip.shape[1], int(end) % 6) for clip in drawn for end in read_back(clip)[:, -1]}
    assert ends == {(1, 1)} | {(frames, end) for frames in (1, 3) for end in (2, 3, 4, 5)}
    assert any("40 of 48 rows have contact; only they are drawn (data.contact_only)" in note for note in loader.notes)
    both = Loader(make(rows), settings(2, contact_only=True, require=("text",)))
    assert any("25 of 48 rows have text and contact" in note for note in both.notes)


def test_contact_only_needs_the_contact_column(make, settings):
    with pytest.raises(UserError, match=r"--data\.contact-only needs the column 'label\.contact'"):
        Loader(make(world()), settings(1, contact_only=True))
    free = [row | {"label.contact": "0"} for row in world()]
    with pytest.raises(UserError, match=r"data\.contact_only: no row of split 'train' has contact"):
        Loader(make(free), settings(1, contact_only=True))


# Withheld modalities -------------------------------------------------------------------------------------------------


def captions_drawn(loader, steps=24):
    found = set()
    for batch in batches(loader, steps):
        for ids, row in zip(batch.align.text, batch.align.text_row, strict=True):
            if row < SIZE:
                found.add(tuple(ids.tolist()))
    return {name for name in [f"caption {i}" for i in range(8)] if code(loader, name) in found}


def code(loader, name):
    return tuple(loader.tokenizer.encode([name], 8)[0][0].tolist())


def test_the_text_of_shared_touches_never_reaches_a_batch(make, settings):
    everything = Loader(make(world()), settings(2))
    assert captions_drawn(everything) == {f"caption {i}" for i in (1, 2, 4, 5, 7)}
    loader = Loader(make(world()), changed(settings(2), "no_text_aligned"))
    assert captions_drawn(loader) == {f"caption {i}" for i in (4, 5, 7)}
    assert any("the text of 12 of 30 rows is withheld" in note for note in loader.notes)
    assert any(batch.match is not None for batch in batches(loader, 4))  # their touches still match
    manifest = make(world())
    assert pools.training_captions(manifest, np.arange(48), aligned_text=False) == [f"caption {i}" for i in (4, 5, 7)]


def test_a_touch_is_aligned_by_another_sensor_or_another_unit(make):
    manifest = make([
        {"touch": "a", "sensor": "digit"}, {"touch": "a", "sensor": "gelslim"},  # two sensors
        {"touch": "b", "unit": "1"}, {"touch": "b", "unit": "2"},  # two units
        {"touch": "c", "unit": "1"}, {"touch": "c", "unit": "1"},  # one device twice
        {"touch": None, "sensor": "digit"}, {"touch": None, "sensor": "gelslim"},
    ])  # fmt: skip
    assert pools.withheld_text(manifest, aligned_text=False).tolist() == [True] * 4 + [False] * 4
    assert not pools.withheld_text(manifest).any()


@pytest.mark.parametrize(("name", "images", "texts"), [("no_text", True, False), ("no_vision", False, True)])
def test_a_modality_left_out_never_reaches_a_batch(make, settings, name, images, texts):
    for batch in batches(Loader(make(world()), changed(settings(2), name)), 6):
        assert bool(len(batch.align.image)) == images and bool(len(batch.align.text)) == texts
        assert batch.match is not None


def test_without_matching_no_triple_is_drawn(make, settings):
    loader = Loader(make(world()), changed(settings(2), "no_matching"))
    assert all(batch.match is None for batch in batches(loader, 6))
    release = Loader(make(world()), changed(settings(2, "release"), "no_matching"))
    assert all(batch.match is None and batch.align is not None for batch in batches(release, 6))


# Stills alone --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recipe", ["paper", "release"])
@pytest.mark.parametrize("stage", [1, 2])
@pytest.mark.parametrize("name", ["static_only", "no_dynamic"])
def test_a_static_model_never_sees_a_clip(make, settings, name, stage, recipe):
    loader = Loader(make(world()), changed(settings(stage, recipe), name))
    assert {loader.kind(step) for step in range(50)} == {"still"}
    for batch in batches(loader, 12):
        for part in [batch] if stage == 1 else [part for part in batch if part is not None]:
            assert part.clip.shape[1] == 1
    if stage == 1:
        assert loader.steps_per_epoch == 48 // SIZE  # clips that are never drawn make no epoch longer
    assert not any("all batches are stills" in note for note in loader.notes)


def test_by_default_clips_are_half(make, settings):
    loader = Loader(make(world()), settings(1))
    assert [loader.kind(step) for step in range(4)] == ["still", "clip", "still", "clip"]


def test_the_trained_sensors_are_those_drawn_from(make, settings):
    rows = [*world(), {"sensor": "duragel", "split": "val"}, {"sensor": "gelsight", "image_path": "w.png"}]
    assert Loader(make(rows), settings(1)).trained_sensors == ["gelsight", "digit", "gelslim"]
    assert Loader(make(rows), settings(2, require=("text",))).trained_sensors == ["digit", "gelslim"]


def test_a_sensor_without_a_clip_is_not_trained_where_only_clips_are_drawn(make, settings):
    rows = [*world(), {"sensor": "duragel"}]
    assert "duragel" in Loader(make(rows), settings(1)).trained_sensors
    assert "duragel" not in Loader(make(rows), settings(1, clip_share=1.0)).trained_sensors
