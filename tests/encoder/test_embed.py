import numpy as np
import pytest

from anytouch_jax.encoder.arrays import spread_lines, unit_rows
from anytouch_jax.encoder.embed import embed_frames, run_in_batches
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(("count", "shapes"), [(0, []), (3, [3]), (4, [4]), (9, [4, 4, 4]), (8, [4, 4])])
def test_batches_are_of_one_size_and_results_keep_their_order(count, shapes):
    sizes, items = [], RNG.standard_normal((count, 5))

    def double(batch):
        sizes.append(len(batch))
        return batch * 2

    values = run_in_batches(double, items, 4)
    assert sizes == shapes and len(values) == count
    if count:
        np.testing.assert_array_equal(values, items * 2)


def test_results_that_are_not_finite_are_refused():
    huge = RNG.standard_normal((3, 2)).astype(np.float32) * np.float32(1e30)
    with np.errstate(over="ignore"), pytest.raises(UserError, match="the features are not finite"):
        run_in_batches(lambda batch: batch * batch, huge, 2)


@pytest.fixture(scope="module")
def encoder(tiny_run):
    return load_encoder(tiny_run)


def test_no_clip_spans_a_gap_or_an_unreadable_frame(encoder):
    frames = RNG.integers(0, 256, (8, 28, 28, 3), np.uint8)
    named = [(number, f"{number}.png", frames[i]) for i, number in enumerate((0, 1, 2, 3, 6, 7, 8, 9))]
    features = embed_frames(encoder, named, 1, length=3, batch=2)
    assert features.rows.tolist() == [2, 3, 6, 7] and features.skipped == 2
    assert features.keys["path"].tolist() == ["2.png", "3.png", "8.png", "9.png"]
    wanted = encoder.encode_touch(np.stack([frames[i - 2 : i + 1] for i in (2, 3, 6, 7)]), "digit")
    np.testing.assert_allclose(features.values, wanted, atol=1e-5)
    named[1] = (1, "1.png", None)
    assert embed_frames(encoder, named, 1, length=3).rows.tolist() == [6, 7]
    with pytest.raises(UserError, match="too few for clips of 5"):
        embed_frames(encoder, named, 1, length=5)


@pytest.mark.parametrize(("noise", "is_constant"), [(0.02, True), (1.0, False)])
def test_the_spread_is_the_mean_cosine_of_pairs(noise, is_constant):
    rng = np.random.default_rng(0)
    values = (rng.standard_normal(16) + noise * rng.standard_normal((40, 16))).astype(np.float32)
    unit = values / np.linalg.norm(values, axis=1, keepdims=True)
    wanted = np.mean([unit[i] @ unit[j] for i in range(40) for j in range(40) if i != j])
    lines = spread_lines(values)
    assert f"{wanted:.4f}" in lines[0] and len(lines) == 1 + is_constant
    assert not is_constant or ("Train longer" in lines[1] and "background subtraction" in lines[1])
    assert spread_lines(values[:1]) == [] and spread_lines(np.zeros((0, 0), np.float32)) == []
    assert len(spread_lines(np.repeat(values, 100, axis=0))) == 1 + is_constant, "more rows than are compared"
    assert spread_lines(values.astype(np.float64) * 1e200) == spread_lines(values.astype(np.float64) * 1e-200) == lines


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rows_of_any_magnitude_have_length_one(dtype: type) -> None:
    rows = np.random.default_rng(0).normal(size=(20, 7)).astype(dtype)
    unit = unit_rows(rows)
    np.testing.assert_array_equal(unit, rows / np.linalg.norm(rows, axis=1, keepdims=True))  # no digit changes
    for power in (67, 120, -67, -130):  # 1e20, 1e36, 1e-20, 1e-39
        np.testing.assert_allclose(unit_rows(np.ldexp(rows, power)), unit, rtol=1e-6 if power > -127 else 1e-3)
    assert not unit_rows(np.zeros((2, 3), dtype)).any() and unit_rows(np.zeros((0, 3), dtype)).shape == (0, 3)
