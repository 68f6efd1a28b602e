from typing import NamedTuple

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.weights.tree import flatten, interpolate, nest


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
    first, second = {"a": {"x": np.zeros(3)}}, {"a": {"x": np.full(3, 4.0)}, "b": np.ones(2)}
    middle = interpolate(first, second, 0.25)
    np.testing.assert_array_equal(middle["a"]["x"], np.ones(3))
    np.testing.assert_array_equal(middle["b"], np.ones(2))  # only `second` has it
    for share, end in ((0, first), (1, second)):
        np.testing.assert_array_equal(interpolate(first, second, share)["a"]["x"], end["a"]["x"])
    with pytest.raises(UserError, match=r"a has shape \(3,\) in one and \(2,\)"):
        interpolate({"a": np.zeros(3)}, {"a": np.zeros(2)}, 0.5)
