import cv2
import numpy as np
import pytest
from checked_world import columns
from press_videos import gel_frame, press_video
from refused import refused

from anytouch_jax.data.background import contact as c
from anytouch_jax.data.background.estimate import scale_image
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError


def gel(depth=0.0, seed=0, shift=0.0):
    return gel_frame("coloured", depth, shift=shift, seed=seed)


@pytest.fixture
def world(tmp_path):
    """world(rows): a manifest of rows (name, image, cells); "bg.png" is the untouched gel."""

    def build(rows, **more):
        cv2.imwrite(str(tmp_path / "bg.png"), gel()[..., ::-1])
        full = []
        usual = {"sensor": "gelsight_mini", "sequence": "s", "split": "train"}
        for i, (name, image, cells) in enumerate(rows):
            if image is not None:
                cv2.imwrite(str(tmp_path / name), image[..., ::-1])
            full.append({"path": name, "frame_index": i, **usual, **cells})
        names = {key: None for row in full for key in row}
        table = {key: [row.get(key) for row in full] for key in names}
        return manifests.from_columns({**table, **more}, tmp_path / "m.parquet")

    return build


GIVEN = {"background_path": "bg.png"}


def test_given_backgrounds_and_broken_files(world, tmp_path):
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nxx")
    manifest = world(
        [
            ("a.png", gel(1), GIVEN),
            ("b.png", gel(0, 1), GIVEN),
            ("broken.png", None, GIVEN),
            ("gone.png", None, GIVEN),
            ("c.png", np.rot90(gel()), GIVEN),
            ("d.png", gel(1), {"background_path": "lost.png"}),
        ]
    )
    for workers in (1, 3):
        scores = c.contact_scores(manifest, workers=workers)
        assert (scores.score[:2] > c.DEFAULT_THRESHOLD).tolist() == [True, False]
        assert np.isnan(scores.score[2:]).all()
        assert scores.counts == {
            "given": 2,
            "none: the frame or its background cannot be read": 3,
            "none: its background has other proportions": 1,
        }
        named = [
            ("row 2 of", "broken.png"),
            ("row 3 of", "gone.png"),
            ("row 4 of", "c.png"),
            ("row 5 of", "lost.png"),
        ]
        assert len(scores.faults) == 4
        assert all(
            row in fault and name in fault
            for fault, (row, name) in zip(scores.faults, named, strict=True)
        )
    some = c.contact_scores(manifest, np.array([1]))
    assert some.counts == {"not asked for": 5, "given": 1}
    assert some.score[1] == scores.score[1]


def test_backgrounds_are_estimated_by_unit_then_by_sequence(world):
    free = [(f"f{k}.png", gel(0, k + 1), {"unit": "u", "sequence": f"s{k}"}) for k in range(5)]
    presses = [
        (f"p{k}.png", gel(1, k, 30.0 * k - 40), {"unit": "u", "sequence": f"t{k}"})
        for k in range(3)
    ]
    lock = [("alone.png", gel(1), {"sequence": "x"})]
    other = [(f"o{k}.png", gel(k > 3, 20 + k), {"sequence": "y"}) for k in range(6)]
    scores = c.contact_scores(world(free + presses + lock + other))
    assert (scores.score[:5] < c.DEFAULT_THRESHOLD).all() and (
        scores.score[5:8] > c.DEFAULT_THRESHOLD
    ).all()
    assert np.isnan(scores.score[8]) and "fewer than two frames" in scores.reasons[8]
    assert (scores.score[9:] > c.DEFAULT_THRESHOLD).tolist() == [False] * 4 + [True] * 2
    assert scores.counts["estimated"] == 14
    # stills of a unit count as one recording
    assert (scores.recordings, scores.decided) == (3, 2)


def test_background_rows_of_a_unit_are_its_untouched_gel(world):
    # held all the time
    pressed = [(f"p{k}.png", gel(1, k + 1), {"unit": "u"}) for k in range(6)]
    assert np.isnan(c.contact_scores(world(pressed)).score).all()
    row = [("free.png", gel(), {"unit": "u", "split": "background"})]
    scores = c.contact_scores(world(pressed + row))
    assert (scores.score[:6] > c.DEFAULT_THRESHOLD).all()
    assert scores.score[6] < 1


def video(name, fraction, shape="ball", look="dotted", **cells):
    """Rows of a gel pressed for a part of 20 frames for `world`, and whether each is pressed."""
    images, contact = press_video(look, fraction, shape, 20)
    return [
        (f"{name}{k}.png", one, {"sequence": name, **cells}) for k, one in enumerate(images)
    ], contact.tolist()


def test_recordings_of_a_unit_decide_for_its_undecided_ones(world):
    first, contact = video("a", 0.5, unit="u")
    second, more = video("b", 0.75, "pins", unit="u")
    always, yes = video("c", 1.0, unit="u")
    alone, _ = video("d", 1.0, unit="v")
    manifest = world([*first, *second, *always, *alone])
    scores = c.contact_scores(manifest)
    assert (scores.score[:60] > c.DEFAULT_THRESHOLD).tolist() == contact + more + yes
    assert np.isnan(scores.score[60:]).all() and (scores.recordings, scores.decided) == (4, 3)
    assert scores.counts["estimated from other recordings of the unit"] == 20
    marked, report = c.mark_contact(manifest, scores, drop=True)
    # unknown frames stay
    assert marked.column("sequence").to_pylist().count("d") == 20
    assert report.unknown == 20 and "3 of 4 recordings (75%)" in "\n".join(report.lines())


def test_a_recording_that_contradicts_its_unit_is_undecided(world):
    first, contact = video("a", 0.5, unit="u")
    second, more = video("b", 0.5, "bar", unit="u")
    odd, _ = video("c", 0.5, look="coloured", unit="u")
    # another gel
    odd = [(name, 255 - image, cells) for name, image, cells in odd]
    # one against one decides nothing
    for gel_frames, decided in ((first + second, 2), (first, 0)):
        assert c.contact_scores(world(gel_frames)).decided == len(gel_frames) / 20
        scores = c.contact_scores(world(gel_frames + odd))
        assert scores.decided == decided
        assert np.isnan(scores.score[-20:]).all()
        assert "different untouched gels" in scores.reasons[-1]
    assert contact == more


def test_a_worn_gel_does_not_contradict_its_unit(world):
    first, _ = video("a", 0.5, unit="u")
    second, _ = video("b", 0.5, "bar", unit="u")
    worn, _ = video("c", 0.5, "pins", unit="u")
    rng = np.random.default_rng(0)
    dirt = cv2.GaussianBlur(
        rng.normal(0, 1, gel_frame("dotted", 0).shape).astype(np.float32), (0, 0), 6
    )
    # they differ by 5.4, slight wear, and by 9.5, another gel
    for size, decided in ((10, 3), (18, 2)):
        marked = [
            (
                name,
                np.clip(image + size * dirt / np.abs(dirt).max(), 0, 255).astype(np.uint8),
                cells,
            )
            for name, image, cells in worn
        ]
        scores = c.contact_scores(world(first + second + marked))
        assert scores.decided == decided


def test_a_image_of_the_untouched_gel_decides_what_the_frames_cannot(world, tmp_path):
    always, _ = video("a", 1.0, unit="u")
    other, _ = video("b", 1.0, "bar", unit="v")
    manifest = world(
        [*always, *other, ("c.png", gel(), {"background_path": "bg.png", "unit": "w"})]
    )
    free = str(tmp_path / "free=1.png")
    cv2.imwrite(free, gel_frame("dotted", 0, seed=5)[..., ::-1])
    scores = c.contact_scores(manifest, backgrounds=c.read_backgrounds(manifest, [free]))
    assert (scores.score[:40] > c.DEFAULT_THRESHOLD).all() and scores.recordings == 0
    assert scores.counts == {"--background": 40, "given": 1}
    cv2.imwrite(str(tmp_path / "bg2.png"), gel_frame("dotted", 0)[..., ::-1])
    scores = c.contact_scores(
        manifest, backgrounds=c.read_backgrounds(manifest, [f"v={tmp_path / 'bg2.png'}"])
    )
    assert np.isnan(scores.score[:20]).all() and (scores.score[20:40] > c.DEFAULT_THRESHOLD).all()
    turned = str(tmp_path / "turned.png")
    cv2.imwrite(turned, np.rot90(gel()))
    for words, named in (
        ([turned], "proportions"),
        ([f"u={turned}"], "row 0 of"),
        ([f"w={turned}"], "unit w"),
        ([f"x={free}"], "x"),
        ([turned, turned], "UNIT=FILE"),
        (["gone.png"], "gone.png"),
        ([f"u={tmp_path / 'bg2.png'}", f"u={tmp_path / 'bg2.png'}"], "UNIT=FILE"),
    ):
        refused(named, c.read_backgrounds, manifest, words)


def _marked(manifest, scores, **kwargs):
    return c.mark_contact(manifest, _scores(scores), **kwargs)


def test_marks_keep_what_the_dataset_says_and_what_is_unknown(world):
    manifest = world(
        [(f"{k}.png", None, {"split": "background" if k == 4 else "train"}) for k in range(6)],
        **{"label.contact": [None, None, 1, 0, None, None]},
    )
    scores = [9.0, 2.0, 2.0, 9.0, 9.0, np.nan]
    marked, report = _marked(manifest, scores)
    assert marked.column("label.contact").to_pylist() == [1, 0, 1, 0, 0, None]
    assert marked.column("label.contact_score").to_pylist()[:2] == [9.0, 2.0]
    assert marked.column("label.contact_score").null_count == 1
    assert (report.contact, report.free, report.unknown, report.dropped) == (2, 3, 1, 0)
    kept, report = _marked(manifest, scores, drop=True)
    assert kept.column("path").to_pylist() == ["0.png", "2.png", "4.png", "5.png"]
    assert (len(kept), report.dropped) == (4, 2)
    # rows keep the number they have in their file
    assert kept.where(1).startswith("row 2 of")
    manifests.write(kept, kept.files[0])
    assert len(manifests.read(kept.files[0])) == 4


def test_a_fraction_of_the_highest_score_leaves_out_where_contact_is_made_and_broken(
    world,
):
    named = ["s", "s", "s", "t", "t", "u"]
    manifest = world([(f"{k}.png", None, {"sequence": name}) for k, name in enumerate(named)])
    scores = [10.0, 40.0, 19.0, 8.0, np.nan, 7.0]
    marked, _ = _marked(manifest, scores, fraction=0.5)
    assert marked.column("label.contact").to_pylist() == [0, 1, 0, 1, None, 1]
    marked, _ = _marked(manifest, scores)
    assert marked.column("label.contact").to_pylist() == [1, 1, 1, 1, None, 1]
    refused(
        "--fraction is a part of the highest score of a sequence, 0 to 1, not 60",
        _marked,
        manifest,
        scores,
        fraction=60,
    )


def test_thresholds_by_sensor_and_an_older_score(world):
    manifest = world(
        [(f"{k}.png", None, {"sensor": s}) for k, s in enumerate(("digit", "9dtact"))],
        **{"label.contact_score": [1.5, 2.5]},
    )
    marked, report = _marked(manifest, [5.0, 5.0])
    assert marked.column("label.contact").to_pylist() == [0, 1]
    assert marked.column("label.contact_score_given").to_pylist() == [1.5, 2.5]
    assert report.thresholds == {"9dtact": 4.0, "digit": 6.5}
    again, _ = _marked(marked, [1.0, 1.0], thresholds={"digit": 0.5})
    # now given, and kept
    assert again.column("label.contact").to_pylist() == [0, 1]
    assert again.table.column_names.count("label.contact_score_given") == 1
    refused(
        "sensor 'tacto', which the manifest does not have",
        _marked,
        manifest,
        [1, 1],
        thresholds={"tacto": 3},
    )
    with pytest.raises(UserError, match="the threshold of digit must be a number, not nan"):
        _marked(manifest, [1, 1], thresholds={"digit": float("nan")})
    refused("nothing would be left", _marked, manifest, [0.0, 0.0], drop=True)
    refused("workers", c.contact_scores, manifest, workers=0)


def test_one_odd_file_ends_nothing(tmp_path):
    (tmp_path / "data").mkdir()
    cv2.imwrite(str(tmp_path / "away.png"), gel())
    for number in range(12):
        cv2.imwrite(str(tmp_path / "data" / f"{number}.png"), gel(number > 8, number + 1))
    (tmp_path / "data" / "3.png").unlink()
    (tmp_path / "data" / "3.png").symlink_to(tmp_path / "away.png")
    cv2.imwrite(str(tmp_path / "data" / "5.png"), np.zeros((3, 180, 3), np.uint8))
    manifest = manifests.from_columns(columns(12), tmp_path / "data" / "m.csv")
    scores = c.contact_scores(manifest, workers=1)
    assert np.flatnonzero(np.isnan(scores.score)).tolist() == [3, 5]
    for number in (6, 7, 8, 9, 10):
        (tmp_path / "data" / f"{number}.png").write_bytes(b"\x89PNG")
    _, report = c.mark_contact(manifest, c.contact_scores(manifest))
    lines = report.lines()
    at = lines.index("images that cannot be used:")
    assert [line.split()[1] for line in lines[at + 1 : at + 6]] == ["3", "5", "6", "7", "8"]
    assert "6.png" in lines[at + 3] and "`anytouch data verify`" in lines[at + 6]


def _manifest(folder, splits=None, **more):
    rows = len(next(iter(more.values())))
    return manifests.from_columns(
        columns(rows, split=splits or ["train"] * rows, **more), folder / "m.parquet"
    )


def _scores(values, reason="given"):
    return c.ContactScores(np.array(values, np.float32), np.full(len(values), reason, object))


def test_precision_recall_and_correlation_on_a_table_of_hand(tmp_path):
    manifest = _manifest(tmp_path, **{"label.force": [0.0, 0.5, 2.0, 3.0, 0.0, None]})
    got = c.contact_quality(manifest, _scores([1, 2, 9, 9, 9, 9]))
    assert (got.reference, got.above, got.rows, got.skipped) == ("label.force", 0.0, 5, 1)
    assert (got.positives, got.predicted, got.hits, got.precision, got.recall) == (
        3,
        3,
        2,
        2 / 3,
        2 / 3,
    )
    assert got.correlation == pytest.approx(np.corrcoef([1, 2, 9, 9, 9], [0, 0.5, 2, 3, 0])[0, 1])
    assert got.parts == {"sensor digit": (5, 2 / 3, 2 / 3), "background given": (5, 2 / 3, 2 / 3)}
    strict = c.contact_quality(manifest, _scores([1, 2, 9, 9, 9, 9]), above=1.0)
    assert (strict.positives, strict.recall) == (2, 1.0)
    splits = ["train", "test", "background"]
    labels = {"label.contact": [1, 0, 0], "label.contact_score": [9.0, 9, 1]}
    manifest = _manifest(tmp_path, splits, **labels)
    scores = _scores([9, 9, 9])
    # background rows say nothing
    assert c.contact_quality(manifest, scores).rows == 2
    free = c.contact_quality(_manifest(tmp_path, **{"label.contact": [0]}), _scores([9]))
    assert free.precision == 0 and np.isnan(free.recall)
    assert c.contact_quality(manifest, scores, reference="label.contact_score").precision == 1
    for table, values, reference, words in (
        (manifest, scores, "label.depth", r"no column label\.depth"),
        (
            manifest,
            _scores([np.nan] * 3, "none"),
            None,
            r"both a value in label\.contact and a score",
        ),
        (
            _manifest(tmp_path, **{"label.force": ["x"]}),
            _scores([1]),
            None,
            r"contains text\. It must have numbers",
        ),
    ):
        refused(words, c.contact_quality, table, values, reference=reference)
    refused("nothing to show", c.contact_sheet, manifest, _scores([np.nan] * 3), tmp_path / "c.png")


def test_pressed_frames_with_known_force_are_distinguished_from_free_ones(tmp_path):
    force = np.array([0.0] * 6 + [4.0, 5.0, 6.0, 8.0])
    for i, one in enumerate(force):
        cv2.imwrite(
            str(tmp_path / f"{i}.png"), gel((one / 8) ** 0.5, i, 20.0 * (i % 5) - 40)[..., ::-1]
        )
    manifest = _manifest(tmp_path, **{"label.force": force.tolist()})
    # no background is given: it is estimated from the ten frames
    scores = c.contact_scores(manifest)
    got = c.contact_quality(manifest, scores)
    assert (got.precision, got.recall) == (1.0, 1.0)
    assert got.correlation > 0.85
    path = c.contact_sheet(manifest, scores, tmp_path / "out" / "contact.png", rows=1)
    image = decode(path)
    assert image.shape == (2 * (28 + c.TILE), c.TILE * c.PER_ROW, 3)
    tile = image[28 : 28 + c.TILE, : c.TILE]
    shift = image[56 + c.TILE :, : c.TILE]
    red = tile[..., 0].astype(int) - tile[..., 1]
    green = shift[..., 1].astype(int) - shift[..., 0]
    # a red border above, a green one below
    assert red.max() > 100 and green.max() > 60
    assert not [name for name in (tmp_path / "out").iterdir() if name.name.startswith(".")]


def test_an_estimated_gel_is_stored_and_becomes_the_background(tmp_path):
    images, contact = press_video("dotted", 0.5, frames=16)
    for number, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image[..., ::-1])
    table = manifests.from_columns(columns(16), tmp_path / "a.csv")
    stored = c.store_backgrounds(table, c.contact_scores(table), tmp_path / "gels")
    assert len({stored.file(row, "background_path") for row in range(16)}) == 1
    free = np.mean([decode(stored.file(row)) for row in np.flatnonzero(~contact)], axis=0)
    assert (
        np.abs(
            scale_image(free.astype(np.uint8)).astype(int)
            - decode(stored.file(0, "background_path"))
        ).mean()
        < 3
    )
    again = c.contact_scores(stored)
    assert again.counts == {"given": 16} and not again.backgrounds
    np.testing.assert_allclose(again.score, c.contact_scores(table).score, atol=0.5)
