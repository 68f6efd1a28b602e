import numpy as np
import pytest

from anytouch_jax.data.loading.samples import SampleError, evaluation
from anytouch_jax.errors import UserError


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
        np.testing.assert_array_equal(a.clip, b.clip)  # no augmentation in either
    assert list(evaluation(manifest, np.array([], int), settings())) == []


@pytest.mark.parametrize("frames", [None, 3, 5])
def test_clips_end_at_their_row(make, settings, read_back, frames):
    manifest, length = _clips(make), frames or 3
    rows = np.array([11, 5, 4])
    ((ids, batch),) = evaluation(manifest, rows, settings(), "clip", frames=frames)
    assert ids.tolist() == [11, 5, 4]
    assert read_back(batch.clip)[:3].tolist() == [list(range(r - length + 1, r + 1)) for r in rows]
    with pytest.raises(UserError, match=r"row 7 of .*manifest\.csv does not end a clip of 3 frames \(nor do 1 other"):
        evaluation(manifest, np.array([5, 7, 6]), settings(), "clip")
    with pytest.raises(UserError, match="does not end a clip of 30 frames"):
        evaluation(manifest, np.array([5]), settings(), "clip", frames=30)


def test_bad_rows_are_named_or_left_out(make, settings, read_back):
    manifest = _clips(make)
    for row in (0, 2, 8, 9, 10, 11):
        manifest.file(row).unlink()
    with pytest.raises(SampleError, match=r"row 0 of .*f0\.png"):
        list(evaluation(manifest, np.arange(12), settings()))
    got = list(evaluation(manifest, np.arange(12), settings(on_bad_sample="skip")))
    assert [ids.tolist() for ids, _ in got] == [[1, 3], [4, 5, 6, 7]]  # a batch of nothing but bad rows is not given
    assert read_back(got[0][1].clip)[:, 0].tolist() == [1, 3, 3, 3]
