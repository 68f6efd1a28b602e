from dataclasses import replace

import cv2
import numpy as np
import pytest
from checked_world import columns
from faulty_camera import Video
from touch_world import make_touches

from anytouch_jax.cli.app import main
from anytouch_jax.config import DataConfig, preset
from anytouch_jax.data.background.rule import SETTLED, Backgrounds
from anytouch_jax.data.images import decode
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.loading.samples import SampleError, SampleReader, evaluation
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.transforms import subtract_background
from anytouch_jax.datasets.verify import verify
from anytouch_jax.encoder.base import Preprocess
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.encoder.linear_head import ContactGate
from anytouch_jax.errors import UserError
from anytouch_jax.live.stream import stream
from experiments.pouring import policy

RNG = np.random.default_rng(0)
GEL = RNG.integers(60, 200, (28, 28, 3), np.uint8)


@pytest.fixture(scope="module")
def touches(tmp_path_factory):
    return make_touches(
        tmp_path_factory.mktemp("touches"), touches={"train": 4, "test": 2}, frames=4, size=28
    )


def settings(touches, background="subtract", **data):
    config = preset("tiny")
    data = {
        "batch_size": 4,
        "flip": 0.0,
        "jitter": (0.0,) * 4,
        "clip_fraction": 0.0,
        "background": background,
    } | data
    data = DataConfig(manifests=(str(touches),), **data)
    return replace(config, model=replace(config.model, image_size=28), data=data)


@pytest.fixture(scope="module")
def encoder(tiny_run):
    """A trained encoder, told that it was trained on differences."""
    found = load_encoder(tiny_run)
    return replace(
        found, config=replace(found.config, data=replace(found.config.data, background="subtract"))
    )


def test_what_is_left_is_the_contact_on_middle_grey():
    assert (np.stack(subtract_background([GEL, GEL], GEL)) == 128).all()
    darker = np.clip(GEL.astype(int) - 30, 0, 255)
    brighter = np.clip(GEL.astype(int) + 200, 0, 255)
    dark, bright = subtract_background(np.stack([darker, brighter]).astype(np.uint8), GEL)
    assert (dark == 98).all() and (bright == np.minimum(128 + brighter - GEL, 255)).all()
    tinted = subtract_background(
        [np.clip(GEL.astype(int) + 25, 0, 255).astype(np.uint8)], (GEL + 25).astype(np.uint8)
    )
    assert (tinted[0] == 128).all()  # a unit's own colour is gone
    large = cv2.resize(GEL, (56, 56), interpolation=cv2.INTER_NEAREST)
    assert np.abs(subtract_background([GEL], large)[0].astype(int) - 128).max() <= 1


@pytest.mark.parametrize(("stored", "used"), [(True, "a stored image"), (False, "the median of")])
def test_training_and_probes_read_the_same_differences(touches, stored, used):
    table = manifests.read(touches)
    if not stored:
        table = without_backgrounds(table, np.arange(len(table)), touches.parent / "bare.parquet")
    rows = table.rows_of("test")
    backgrounds = Backgrounds(table)
    (_, batch), *_ = evaluation(table, rows, settings(touches, batch_size=len(rows)))
    for clip, row in zip(batch.clip, rows.tolist(), strict=True):
        ground = decode(table.file(row, "background_path")) if stored else backgrounds(row)
        np.testing.assert_array_equal(
            clip[0], np.clip(decode(table.file(row)).astype(int) - ground + 128, 0, 255)
        )
    config = settings(touches)
    assert sum(f"untouched gel: {used}" in note for note in Loader(table, config).notes) == 1
    seen = {
        tuple(one.reshape(-1)[:60])
        for step in range(6)
        for one in Loader(table, config).batch(step).clip[:, 0]
    }
    (_, everything), *_ = evaluation(
        table, table.rows_of("train"), settings(touches, batch_size=48)
    )
    assert seen <= {tuple(one.reshape(-1)[:60]) for one in everything.clip[:, 0]} and len(seen) > 12
    plain = Loader(table, settings(touches, "keep")).batch(0).clip
    assert np.abs(plain.astype(int) - Loader(table, config).batch(0).clip).max() > 20


@pytest.mark.parametrize(
    "change", [{"jitter": (0.4, 0.4, 0.5, 0.3), "flip": 0.5}, {"affine": (20.0, 0.1, 0.1)}]
)
def test_another_light_or_place_leaves_the_untouched_gel_grey(touches, change):
    """Augmentation comes first: after it a change of brightness would outshine the contact."""
    table = manifests.read(touches)
    cells = {name: table.column(name).to_pylist() for name in table.table.column_names}
    cells["path"] = cells["background_path"]  # nobody touches
    bare = manifests.from_columns(cells, touches.parent / "bare.parquet")
    config = settings(touches, **change)
    assert all((Loader(bare, config).batch(step).clip == 128).all() for step in range(3))
    seen = [Loader(table, config).batch(step).clip.astype(int) for step in range(3)]
    plain = [Loader(table, settings(touches)).batch(step).clip.astype(int) for step in range(3)]
    # and the contact is changed
    assert all(np.abs(a - b).max() > 5 for a, b in zip(seen, plain, strict=True))


def without_backgrounds(table, rows, file):
    """The same manifest, in which `rows` have no background_path."""
    cells = {name: table.column(name).to_pylist() for name in table.table.column_names}
    for row in rows.tolist():
        cells["background_path"][row] = None
    return manifests.from_columns(cells, file)


def test_rows_without_a_image_of_the_gel_get_the_median_of_their_unit(encoder, touches):
    table = manifests.read(touches)
    rows = table.rows_of("test")
    bare = without_backgrounds(table, np.arange(len(table)), touches.parent / "bare.parquet")
    said: list[str] = []
    ids, values = embed_rows(encoder, bare, rows, log=said.append)
    assert ids.tolist() == rows.tolist() and any(
        "untouched gel: the median" in words for words in said
    )
    whole = embed_rows(encoder, table, rows, log=said.append)[1]
    assert (
        np.abs(values - whole).max() > 1e-3
        and f"untouched gel: a stored image for {len(rows)} rows" in said
    )


def test_rows_that_are_too_few_for_a_median_are_left_out_and_counted(encoder, touches):
    table = manifests.read(touches)
    few = table.rows_of("test")[:3]
    alone = without_backgrounds(
        manifests.select_rows(table, few), few[:0], touches.parent / "few.parquet"
    )
    cells = {name: alone.column(name).to_pylist() for name in alone.table.column_names}
    cells["background_path"][1] = None
    cells["dataset"], cells["unit"] = ["mine"] * 3, ["u", "v", "u"]
    alone = manifests.from_columns(cells, touches.parent / "few.parquet")
    said = list[str]()
    ids, _ = embed_rows(encoder, alone, np.arange(3), log=said.append)
    assert (
        ids.tolist() == [0, 2]
        and "1 of 3 rows have no image of the untouched gel, and are left out" in said
    )
    with pytest.raises(UserError, match=r"too few frames to estimate it.*background_path"):
        embed_rows(encoder, alone, np.array([1]), log=said.append)
    with pytest.raises(
        SampleError, match=r"row \d+ of .* has no image of the untouched gel.*background_path"
    ):
        list(evaluation(alone, np.arange(3), settings(touches)))
    ((ids, _),) = evaluation(alone, np.arange(3), settings(touches, on_bad_sample="skip"))
    assert ids.tolist() == [0, 2]
    assert len(list(evaluation(alone, np.arange(3), settings(touches, "keep")))) == 1


def test_a_image_frames_or_a_head_decide_what_a_camera_subtracts(encoder):
    frames = [GEL, np.clip(GEL + 20, 0, 255).astype(np.uint8)]
    see = Preprocess(encoder)  # a running estimate
    assert [int(np.median(see(one))) for one in frames] == [128, 148] and see.estimated
    told = Preprocess(encoder, frames[1])
    assert [int(np.median(told(one))) for one in frames] == [108, 128] and not told.estimated
    of_frames = Preprocess(encoder, frames=[frames[1]] * 6)
    assert (of_frames(frames[1]) == 128).all() and not of_frames.estimated
    said: list[str] = []
    fitted = Preprocess(encoder, known={"a": frames[1], "b": 255 - GEL}, log=said.append)
    assert int(np.median(fitted(frames[1]))) == 128 and not fitted.estimated and not said
    other = Preprocess(encoder, known={"b": 255 - GEL}, log=said.append)
    assert [int(np.median(other(one))) for one in frames] == [128, 148] and other.estimated
    assert len(said) == 1 and "in tint" in said[0]
    with pytest.raises(UserError, match="not both"):
        Preprocess(encoder, GEL, frames=frames)
    with pytest.raises(
        UserError,
        match=r"at\.estimate_background\(frames\).*at\.Preprocess\(encoder, frames=frames\)",
    ):
        encoder.preprocess(GEL)
    plain = Preprocess(replace(encoder, config=replace(encoder.config, data=DataConfig())))
    np.testing.assert_array_equal(plain(GEL), GEL)
    # the background lies on its side as the frames do
    lying = Preprocess(encoder, np.rot90(GEL), rotate=90)
    np.testing.assert_array_equal(lying(np.rot90(frames[1])), Preprocess(encoder, GEL)(frames[1]))


def test_a_folder_is_embedded_like_the_manifest_that_names_its_background(
    encoder, touches, tmp_path, monkeypatch, capsys
):
    table = manifests.read(touches)
    row = int(table.rows_of("test")[-1])
    frames = tmp_path / "frames"
    frames.mkdir()
    shot = cv2.imread(str(table.file(row)))
    cv2.imwrite(str(frames / "0.png"), shot)
    ground = table.file(row, "background_path")
    monkeypatch.setattr("anytouch_jax.encoder.encoder.load_encoder", lambda _, **__: encoder)
    words = [
        "embed",
        "--model",
        "unused",
        "--data",
        str(frames),
        "--sensor",
        str(table.value(row, "sensor")),
    ]
    assert main([*words, "--out", str(tmp_path / "a.npz"), "--background", str(ground)]) == 0
    assert "first frame" not in capsys.readouterr().err
    said: list[str] = []
    _, wanted = embed_rows(encoder, table, np.array([row]), log=said.append)
    assert all(
        "'gelslim' was not in training" in words or "untouched gel" in words for words in said
    )
    np.testing.assert_allclose(np.load(tmp_path / "a.npz")["features"], wanted, atol=1e-5)
    # one image, less itself, is nothing
    assert main([*words, "--out", str(tmp_path / "b.npz")]) == 2
    assert "too few frames to estimate the untouched gel" in capsys.readouterr().err
    for number in range(1, 7):
        cv2.imwrite(str(frames / f"{number}.png"), shot)
    assert main([*words, "--out", str(tmp_path / "b.npz")]) == 0
    assert "untouched gel: estimated from 7 frames" in capsys.readouterr().err
    with np.load(tmp_path / "b.npz") as written:
        assert np.abs(written["features"] - wanted).max() > 1e-3 and len(written["gels"]) == 1


def test_training_leaves_out_the_rows_of_a_sensor_of_few_frames(touches):
    table = manifests.read(touches)
    rows = table.rows_of("train")
    cells = {name: table.column(name).to_pylist() for name in table.table.column_names}
    for row in rows[:3].tolist():
        cells["background_path"][row], cells["sensor"][row] = None, "taxim"
    config = settings(touches)
    holed = manifests.from_columns(cells, touches.parent / "holed.parquet")
    left_out = f"3 of {len(rows)} rows have no image of the untouched gel, and are left out"
    assert left_out in Loader(holed, config).notes
    with pytest.raises(
        manifests.ManifestError,
        match=r"row 0 of .* and 2 other rows have no image.*Record 5 frames",
    ):
        Loader(manifests.select_rows(holed, rows[:3]), config)


def test_the_pouring_policy_sees_what_changed_since_its_run_began(encoder):
    frames = RNG.integers(100, 150, (9, 2, 28, 28, 3), np.uint8)
    # what it is tuned on
    clips = policy.segments(encoder, frames, np.array([[0, 1], [3, 0]]), 3)
    np.testing.assert_array_equal(clips[1, 2], frames[5, 0].astype(int) - frames[0, 0] + 128)
    np.testing.assert_array_equal(clips[0, 0], np.full_like(GEL, 128))
    shown = policy.subtracted(encoder, frames[:3], frames[0])
    assert (shown[0] == 128).all() and shown.dtype == np.uint8
    np.testing.assert_array_equal(shown[2, 1], frames[2, 1].astype(int) - frames[0, 1] + 128)
    plain = Encoder(replace(encoder.config, data=DataConfig()), encoder.params, "")
    assert policy.subtracted(plain, frames, frames[0]) is frames


def test_either_subtracts_half_of_the_samples_and_every_known_background_in_evaluation(touches):
    """Each row is drawn by itself, again in every epoch; one without a gel stays as it is."""
    table = manifests.read(touches)
    readers = {
        mode: SampleReader(table, settings(touches, mode))
        for mode in ("keep", "subtract", "either")
    }
    rows = np.flatnonzero(table.column("split").to_numpy(zero_copy_only=False) == "train")

    def subtracted(epoch):
        several = (
            [one.touch(rows[i : i + 1], epoch) for i in range(len(rows))]
            for one in readers.values()
        )
        plain, less, either = several
        assert all(
            np.array_equal(e, p) or np.array_equal(e, s)
            for e, p, s in zip(either, plain, less, strict=True)
        )
        return np.array([np.array_equal(e, s) for e, s in zip(either, less, strict=True)])

    draws = np.stack([subtracted(epoch) for epoch in range(40)])
    assert 0.4 < draws.mean() < 0.6 and draws.std(0).min() > 0.2 and draws.std(1).min() > 0
    assert subtracted(None).all()
    bare = without_backgrounds(manifests.select_rows(table, rows[:1]), np.arange(1), touches)
    plain = SampleReader(bare, settings(touches, "either")).touch(np.arange(1), None)
    assert np.array_equal(plain, readers["keep"].touch(rows[:1], None))


def test_an_encoder_of_either_kind_works_with_and_without_a_background(encoder):
    either = replace(
        encoder,
        config=replace(encoder.config, data=replace(encoder.config.data, background="either")),
    )
    side = either.config.model.image_size
    gel = np.full((side, side, 3), 90, np.uint8)
    assert (either.preprocess(gel, gel) == 128).all() and (either.preprocess(gel) == 90).all()
    assert either.subtracts and not either.needs_background
    camera = Preprocess(either)
    assert (camera(gel) == 90).all() and (camera(gel) == 90).all()


def test_a_stream_is_marked_until_its_untouched_gel_is_settled_or_captured(encoder):
    frames = [GEL] * (SETTLED + 2)
    # it begins with a press
    frames[0] = np.clip(GEL.astype(int) + 60, 0, 255).astype(np.uint8)
    for background, marked in ((None, SETTLED - 1), (GEL, 0)):
        preprocess = Preprocess(encoder, background)
        gate = ContactGate(preprocess, "digit")
        arrived = list(
            stream(
                encoder, Video(np.flip(frames, -1)), preprocess, live=False, sensor=0, contact=gate
            )
        )
        assert [one.estimated for one in arrived] == [True] * marked + [False] * (
            len(frames) - marked
        )
        np.testing.assert_array_equal(preprocess.background, GEL)
        assert not any(one.contact for one in arrived[4:])


@pytest.mark.parametrize(
    ("size", "fits"),
    [
        ((24, 48), True),
        ((48, 96), True),
        ((96, 48), False),
        ((24, 44), False),
        ((48, 48), False),
        ((100, 196), False),
    ],
)  # as the frames, larger, turned, cropped at a side, cropped to a square, cropped by little
def test_a_background_of_other_proportions_is_refused_everywhere(tmp_path, encoder, size, fits):
    for name, shape in (("frame", (24, 48)), ("gel", size)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), RNG.integers(0, 255, (*shape, 3), np.uint8))
    table = manifests.from_columns(
        columns(path=["frame.png"], background_path=["gel.png"]), tmp_path / "m.csv"
    )
    manifests.write(table, tmp_path / "m.csv")
    frame = decode(tmp_path / "frame.png")
    gel = decode(tmp_path / "gel.png")
    tries = {
        "training": lambda: SampleReader(table, settings(tmp_path / "m.csv", flip=0.5)).touch(
            np.array([0]), 0
        ),
        "training, plain": lambda: SampleReader(table, settings(tmp_path / "m.csv")).touch(
            np.array([0]), 0
        ),
        "evaluation": lambda: embed_rows(encoder, table, np.array([0]), log=lambda _: None),
        "Python": lambda: encoder.preprocess(frame, gel),
        "a camera": lambda: Preprocess(encoder, gel)(frame),
    }
    for name, call in tries.items():
        if fits:
            call()
            continue
        with pytest.raises(UserError, match="was turned or cropped") as raised:
            call()
        assert ("m.csv" in str(raised.value)) == (name not in ("Python", "a camera"))
    assert ("background_form" in {one.kind for one in verify(table).findings}) == (not fits)
