from typing import NamedTuple

import jax
import ml_dtypes
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.weights.load import read_weights
from anytouch_jax.weights.safetensors import export_safetensors, read_safetensors, write_safetensors
from anytouch_jax.weights.tree import flatten, interpolate, nest


def test_a_tree_is_written_and_read_back(tmp_path):
    tree = {
        "a": {"view": np.arange(6.0).reshape(2, 3).T, "none": np.zeros((0, 3), "f4")},
        "scale": np.float32(2.5),
    }
    export_safetensors(tmp_path / "p.safetensors", tree, {"config": "{}"})
    arrays, metadata = read_safetensors(tmp_path / "p.safetensors")
    assert metadata == {"config": "{}"}
    assert jax.tree.structure(nest(arrays)) == jax.tree.structure(tree)
    for first, second in zip(jax.tree.leaves(nest(arrays)), jax.tree.leaves(tree), strict=True):
        assert first.dtype == second.dtype
        np.testing.assert_array_equal(first, second)


def test_equal_weights_and_metadata_are_equal_bytes(tmp_path):
    notes = {f"key{i}": f'"{i}"\n\u00fc\x01\x7f' for i in range(30)}
    for name, items in (("a", notes), ("b", dict(reversed(notes.items())))):
        write_safetensors(
            tmp_path / name, {"x": np.arange(5, dtype="f4"), "w": np.ones((2, 3))}, items
        )
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    arrays, metadata = read_safetensors(tmp_path / "a")
    assert metadata == notes and arrays["x"].tolist() == [0, 1, 2, 3, 4]


def test_half_precision_becomes_float32(tmp_path):
    values = np.array([1.0, -2.5, 3.140625], "f4")
    for kind in (np.float16, ml_dtypes.bfloat16):
        write_safetensors(
            tmp_path / "h.safetensors", {"x": values.astype(kind), "ids": np.arange(3)}, {}
        )
        read = read_weights(tmp_path / "h.safetensors")
        assert read["x"].dtype == np.float32 and read["ids"].dtype == np.int64
        np.testing.assert_array_equal(read["x"], values.astype(kind).astype("f4"))


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "w.safetensors"
    write_safetensors(path, {"x": np.ones(2)}, {})
    before = path.read_bytes()
    with pytest.raises(UserError, match=r"w\.safetensors"):
        write_safetensors(path, {"x": np.array([object()])}, {})
    with pytest.raises(UserError, match=r"could not write .*w\.safetensors"):
        write_safetensors(path, {"x": np.ones(2)}, {"step": 3})
    (tmp_path / "blocked").write_text("")
    with pytest.raises(UserError, match="blocked"):
        write_safetensors(tmp_path / "blocked" / "w.safetensors", {"x": np.ones(2)}, {})
    assert path.read_bytes() == before and sorted(p.name for p in tmp_path.iterdir()) == [
        "blocked",
        "w.safetensors",
    ]
    path.write_bytes(before[:-3])
    with pytest.raises(UserError, match="not a whole safetensors"):
        read_weights(path)


class Pair(NamedTuple):
    first: object
    second: object


def test_flatten_and_nest_are_inverse():
    tree = {"a": {"b": 1, "c": {"d": 2}}, "e": 3}
    assert flatten(tree) == {"a/b": 1, "a/c/d": 2, "e": 3} and nest(flatten(tree)) == tree
    assert list(flatten(Pair(1, [2, (3,)]))) == ["first", "second/0", "second/1/0"]


def test_a_name_that_is_used_twice_is_an_error():
    with pytest.raises(UserError, match="two arrays"):
        flatten({"a/b": 1, "a": {"b": 2}})
    for clash in ({"a": 1, "a/b": 2}, {"a/b": 2, "a": 1}):
        with pytest.raises(UserError, match="beginning of another"):
            nest(clash)


def test_interpolate():
    middle = interpolate({"a": np.zeros(3)}, {"a": np.full(3, 4.0), "b": np.ones(2)}, 0.25)
    # one that only the second has
    assert middle["a"].tolist() == [1, 1, 1] and middle["b"].tolist() == [1, 1]
    with pytest.raises(UserError, match=r"a has shape \(3,\) in one and \(2,\)"):
        interpolate({"a": np.zeros(3)}, {"a": np.zeros(2)}, 0.5)
