"""Clips as windows over rows: which rows lie exactly one stride apart in one sequence, without a loop over rows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def windows(
    sequence: np.ndarray,
    frame: np.ndarray,
    stride: np.ndarray,
    length: int,
    repeated: Callable[[int, int], Exception] | None = None,
) -> np.ndarray:
    """Row ids i64 (windows, length) of rows t - (length-1)*stride .. t of one sequence, ordered by t's row id.

    `sequence` i64 (rows,) codes, `frame` i64 (rows,), `stride` i64 (rows,) (that of t counts). A row whose window
    has a gap has no window. Raises `repeated(first row, second row)` when a sequence holds a frame twice.
    """
    if length < 1:
        raise ValueError(f"a clip has at least one frame, not {length}")
    order = np.lexsort((frame, sequence))
    # Frames are replaced by their rank, so that (sequence, frame) fits in one integer even for time stamps in ns.
    frames, rank = np.unique(frame, return_inverse=True)
    span = len(frames)
    key = sequence[order] * span + rank[order]
    twice = np.flatnonzero(key[1:] == key[:-1])
    if twice.size and length > 1:
        first, second = sorted((int(order[twice[0]]), int(order[twice[0] + 1])))
        raise repeated(first, second) if repeated else ValueError(f"rows {first} and {second} are the same frame")
    found = np.empty((len(order), length), np.int64)
    found[:, -1] = order
    whole = np.ones(len(order), bool)
    for back in range(1, length):
        wanted = frame[order] - back * stride[order]
        place = np.minimum(np.searchsorted(frames, wanted), span - 1)
        wanted_key = sequence[order] * span + place
        at = np.minimum(np.searchsorted(key, wanted_key), len(key) - 1)
        whole &= (frames[place] == wanted) & (key[at] == wanted_key)
        found[:, length - 1 - back] = order[at]
    found = found[whole]
    return found[np.argsort(found[:, -1], kind="stable")]
