"""Batches as flat lists of arrays, to compare them."""

from typing import Any

import numpy as np


def leaves(batch: Any) -> list[np.ndarray]:
    """All arrays of a batch in order; parts that are None are left out."""
    if batch is None:
        return []
    return [
        leaf
        for part in batch
        for leaf in (leaves(part) if isinstance(part, tuple) or part is None else [part])
    ]


def assert_same(one: Any, two: Any) -> None:
    """Two batches have the same arrays, bit for bit."""
    one = leaves(one)
    two = leaves(two)
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
