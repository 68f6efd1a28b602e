import numpy as np
import pytest

import anytouch_jax as at
from anytouch_jax.config import SENSORS
from anytouch_jax.encoder import index as search
from anytouch_jax.encoder.arrays import spread_lines
from anytouch_jax.encoder.embed import load_index, run_in_batches
from anytouch_jax.errors import UserError

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("count", "shapes"), [(0, []), (3, [3]), (4, [4]), (9, [4, 4, 4]), (8, [4, 4])]
)
def test_batches_are_of_one_size_and_results_keep_their_order(count, shapes):
    sizes = []
    items = RNG.standard_normal((count, 5))

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
    assert len(spread_lines(np.repeat(values, 100, axis=0))) == 1 + is_constant, (
        "more rows than are compared"
    )
    assert (
        spread_lines(values.astype(np.float64) * 1e200)
        == spread_lines(values.astype(np.float64) * 1e-200)
        == lines
    )


def test_each_press_is_felt_by_each_sensor_and_differs_from_the_untouched_gel():
    touches = at.example_touches()
    presses, sensors = ({getattr(touch, name) for touch in touches} for name in ("press", "sensor"))
    assert len(touches) == len(presses) * len(sensors) == 6 and sensors <= set(SENSORS)
    for touch in touches:
        assert touch.frame.shape == touch.background.shape and touch.frame.dtype == np.uint8
        difference = np.abs(touch.frame.astype(int) - touch.background)
        assert np.percentile(difference, 98) > 15  # the press is visible


def write(path, values, **more):
    keys = {
        "key/path": np.array([f"{i}.png" for i in range(len(values))]),
        "key/label.object": np.full(len(values), "a"),
    }
    np.savez(
        path,
        **{
            "features": values,
            "rows": np.arange(len(values)),
            "about/weights": "12ab",
            **keys,
            **more,
        },
    )
    return path


def test_the_nearest_are_those_of_largest_cosine(tmp_path):
    rng = np.random.default_rng(0)
    values = rng.standard_normal((500, 8)).astype(np.float32) * rng.uniform(
        0.1, 10, (500, 1)
    ).astype(np.float32)
    index = load_index(write(tmp_path / "f.npz", values))
    query = rng.standard_normal((3, 8))
    ids, cosines = index.search(query, 7)
    cosine = (
        query @ values.T / np.linalg.norm(query, axis=1)[:, None] / np.linalg.norm(values, axis=1)
    )
    np.testing.assert_array_equal(ids, np.argsort(-cosine, axis=1)[:, :7])
    np.testing.assert_allclose(cosines, -np.sort(-cosine, axis=1)[:, :7], atol=1e-5)
    assert index.search(3 * values[4], 1)[0].tolist() == [[4]]
    assert index.search(values[:1], 9999)[0].shape == (1, 500)
    assert index.describe(4) == {"path": "4.png", "label.object": "a"}
    index.check("here", "12ab")
    with pytest.raises(UserError, match="another encoder"):
        index.check("here", "other")
    for wrong in (np.ones((1, 7)), np.full((1, 8), np.nan)):
        with pytest.raises(UserError, match="8 finite values"):
            index.search(wrong)


@pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")  # of FAISS on Python 3.12
def test_cells_find_almost_the_same(tmp_path, monkeypatch):
    pytest.importorskip("faiss")
    monkeypatch.setattr(search, "_OF_CELL", 8)
    monkeypatch.setattr(search, "_LOOKED_INTO", 20)  # of 40 cells
    values = np.random.default_rng(1).standard_normal((400, 16)).astype(np.float32)
    path = write(tmp_path / "f.npz", values)
    exact = load_index(path).search(values[:20], 5)
    index = load_index(path, approximate=True)
    ids, cosines = index.search(values[:20], 5)
    assert np.mean([len(set(a) & set(b)) / 5 for a, b in zip(exact[0], ids, strict=True)]) > 0.9
    np.testing.assert_array_equal(ids[:, 0], np.arange(20))
    np.testing.assert_allclose(cosines[:, 0], 1, atol=1e-4)
    np.testing.assert_array_equal(
        index.search(values[:3], 400)[0], load_index(path).search(values[:3], 400)[0]
    )


def test_a_hostile_file_is_refused(tmp_path):
    with pytest.raises(UserError, match="not finite"):
        load_index(write(tmp_path / "f.npz", np.full((2, 3), np.inf)))
    with pytest.raises(UserError, match="its keys"):
        load_index(write(tmp_path / "f.npz", np.ones((2, 3)), **{"key/path": np.array(["a"])}))
    np.savez(tmp_path / "p.npz", features=np.array([{"a": 1}], dtype=object))
    with pytest.raises(UserError, match="not a features file"):
        load_index(tmp_path / "p.npz")
    with pytest.raises(UserError, match="not a features file"):
        load_index(tmp_path / "gone.npz")
