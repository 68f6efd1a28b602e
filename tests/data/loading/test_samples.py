from pathlib import Path

import cv2
import numpy as np
import pytest
from batch_leaves import assert_same
from refused import refused

from anytouch_jax.data.images import decode
from anytouch_jax.data.loading import samples
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.loading.samples import SampleError, evaluation, fill_slot
from anytouch_jax.data.transforms import (
    TOUCH,
    augmentation_rng,
    subtract_background,
    touch_transform,
)
from anytouch_jax.errors import UserError


def test_cached_frames_change_no_byte_and_are_read_once(make, settings, monkeypatch):
    rows = [
        {"sequence": f"s{i // 4}", "frame_index": i % 4, "background_path": f"gel{i // 4}.png"}
        for i in range(8)
    ]
    manifest = make(rows)
    noise = np.random.default_rng(0)
    for name in (*(f"f{i}" for i in range(8)), "gel0", "gel1"):
        path = Path(manifest.file(0)).with_name(f"{name}.png")
        assert cv2.imwrite(str(path), noise.integers(0, 255, (45, 60, 3), np.uint8))
    read: list[str] = []
    monkeypatch.setattr(
        samples, "decode", lambda path: (read.append(Path(path).name), decode(path))[1]
    )
    whole = []
    counts = []
    for cache in (0, 512):
        config = settings(1, plain=False, background="subtract", cache=cache)
        batches = [Loader(manifest, config).batch(step).clip for step in range(2)]
        read.clear()
        loader = Loader(manifest, config)
        batches += [loader.batch(step).clip for step in range(2, 8)]
        whole.append(batches)
        counts.append(len(read))
    for one, other in zip(*whole, strict=True):
        np.testing.assert_array_equal(one, other)
    assert counts[0] > 60 and counts[1] == len(set(read)) == 10
    config = settings(1, plain=False, background="subtract")
    rng = augmentation_rng(config.run.seed, 3, 3, TOUCH)
    files = [decode(manifest.file(row)) for row in range(4)] + [
        decode(manifest.file(3, "background_path"))
    ]
    *frames, gel = touch_transform(files, config.model.image_size, rng, config.data)
    made = samples.SampleReader(manifest, config).touch(np.arange(4), 3)
    np.testing.assert_array_equal(made, subtract_background(frames, gel))


def _truncate(path):
    path.write_bytes(path.read_bytes()[:-30])


def _garbage(path):
    path.write_bytes(b"\x00" * 100)


def _nan(path):
    array = np.full((8, 8, 3), 0.5, np.float32)
    array[3, 4] = np.nan
    path.write_bytes(cv2.imencode(".tiff", array)[1].tobytes())


def _outside_link(path):
    outside = path.parent.parent / f"outside-{path.parent.name}.png"
    path.rename(outside)
    path.symlink_to(outside)


BAD = {
    "missing": (lambda path: path.unlink(), "there is no file"),
    "truncated": (_truncate, "corrupt or cut short"),
    "garbage": (_garbage, "not a PNG"),
    "nan": (_nan, "NaN pixels"),
    "link": (_outside_link, "leaves the folder"),
    "path": (None, "leaves the folder"),
}


@pytest.mark.parametrize(
    ("what", "threads"), [(what, 2 * (number % 2)) for number, what in enumerate(BAD)]
)
def test_a_bad_sample_is_named_or_skipped_and_counted(make, settings, read_back, what, threads):
    spoil, words = BAD[what]
    rows = [
        {"path": "../escape.png" if what == "path" and i == 2 else f"f{i}.png"} for i in range(5)
    ]
    manifest = make(rows, folder="data")
    if spoil:
        spoil(manifest.file(2))
    name = "escape.png" if what == "path" else "f2.png"
    with pytest.raises(SampleError) as error:
        list(Loader(manifest, settings(batch_size=5, threads=threads)).stream(0, 1))
    message = str(error.value)
    assert isinstance(error.value, UserError) and "\n" not in message
    for word in ("row 2 of", "manifest.csv", "'path'", name, words):
        assert word in message
    skipping = settings(batch_size=5, threads=threads, on_bad_sample="skip")
    logged: list[str] = []
    loader = Loader(manifest, skipping, log=logged.append)
    ((_, batch, info),) = loader.stream(0, 1)
    assert logged == [f"{message}; another sample replaces it"]
    drawn = read_back(batch.clip)[:, 0]
    assert info["skipped_samples"] >= 1 and 2 not in drawn and set(drawn) == {0, 1, 3, 4}
    # the replacement is deterministic
    assert_same(batch, Loader(manifest, skipping).batch(0))


def test_replacements_differ_by_step_slot_and_attempt(settings):
    bad = {3}

    def replaced(step, slot):
        tried = []

        def write(index, _):
            tried.append(index)
            if index in bad or len(tried) < 3:
                raise SampleError("bad")

        assert (
            fill_slot(write, 1000, step, slot, settings(on_bad_sample="skip"), 3, 0)
            == len(tried) - 1
        )
        return tuple(tried[1:])

    drawn = [replaced(step, slot) for step in range(4) for slot in range(4)]
    assert drawn == [replaced(step, slot) for step in range(4) for slot in range(4)]
    assert len({index for pair in drawn for index in pair}) > 25


def test_only_bad_samples_end_in_an_error(make, settings):
    manifest = make([{}, {}])
    for i in range(2):
        manifest.file(i).unlink()
    words = r"20 samples in a row .* step 0; the last one is row \d of .*there is no file"
    refused(words, Loader(manifest, settings(on_bad_sample="skip")).batch, 0)


def test_a_bad_image_names_its_column(make, settings):
    manifest = make([{"image_path": f"v{i}.png"} for i in range(4)])
    manifest.file(1, "image_path").write_bytes(b"x" * 50)
    refused(r"row 1 of .*column 'image_path': .*v1\.png", Loader(manifest, settings(2)).batch, 0)
    _, batch, info = next(Loader(manifest, settings(2, on_bad_sample="skip")).stream(0, 1))
    assert info["skipped_samples"] >= 1 and 1 not in batch.align.image[:, 14, 14, 0] - 1


def _clips(make, **extra):
    return make([{"sequence": f"s{i // 6}", "frame_index": i % 6, **extra} for i in range(12)])


def test_rows_come_in_the_order_given_and_the_last_batch_is_filled_up(make, settings, read_back):
    manifest = _clips(make)
    rows = np.array([7, 0, 11, 3, 3, 9])
    got = list(evaluation(manifest, rows, settings(plain=False)))
    assert [ids.tolist() for ids, _ in got] == [[7, 0, 11, 3], [3, 9]]
    for ids, batch in got:
        assert batch.clip.shape == (4, 1, 28, 28, 3) and batch.sensor.tolist() == [1] * 4
        assert read_back(batch.clip)[:, 0].tolist() == [*ids, *[ids[-1]] * (4 - len(ids))]
    for (_, a), (_, b) in zip(got, evaluation(manifest, rows, settings(threads=0)), strict=True):
        # no augmentation in either
        np.testing.assert_array_equal(a.clip, b.clip)
    assert list(evaluation(manifest, np.array([], int), settings())) == []


@pytest.mark.parametrize("frames", [None, 3, 5])
def test_clips_end_at_their_row(make, settings, read_back, frames):
    manifest = _clips(make)
    length = frames or 3
    rows = np.array([11, 5, 4])
    ((ids, batch),) = evaluation(manifest, rows, settings(), "clip", frames=frames)
    assert ids.tolist() == [11, 5, 4]
    assert read_back(batch.clip)[:3].tolist() == [list(range(r - length + 1, r + 1)) for r in rows]
    with pytest.raises(
        UserError,
        match=r"row 7 of .*manifest\.csv does not end a clip of 3 frames \(nor do 1 other",
    ):
        evaluation(manifest, np.array([5, 7, 6]), settings(), "clip")
    refused(
        "does not end a clip of 30 frames",
        evaluation,
        manifest,
        np.array([5]),
        settings(),
        "clip",
        frames=30,
    )


def test_bad_rows_are_named_or_left_out(make, settings, read_back):
    manifest = _clips(make)
    for row in (0, 2, 8, 9, 10, 11):
        manifest.file(row).unlink()
    refused(r"row 0 of .*f0\.png", list, evaluation(manifest, np.arange(12), settings()))
    got = list(evaluation(manifest, np.arange(12), settings(on_bad_sample="skip")))
    # a batch of nothing but bad rows is not given
    assert [ids.tolist() for ids, _ in got] == [[1, 3], [4, 5, 6, 7]]
    assert read_back(got[0][1].clip)[:, 0].tolist() == [1, 3, 3, 3]
