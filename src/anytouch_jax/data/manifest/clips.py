"""Clips as windows over rows: which rows lie exactly one stride apart in one sequence, without a loop over rows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_MOST = 1 << 61
_BLOCK = 1 << 18  # rows at a time: what a block needs beside its windows fits into the cache


def clip_windows(
    sequence: np.ndarray,
    frame: np.ndarray,
    stride: np.ndarray,
    length: int,
    repeated: Callable[[int, int], Exception] | None = None,
    ends: np.ndarray | None = None,
) -> np.ndarray:
    """Row ids (windows, length) of rows t - (length-1)*stride .. t of one sequence, ordered by t's row id.

    They are i32, beyond 2^31 rows i64. `sequence` i64 (rows,) codes, `frame` i64 (rows,), `stride` i64 (rows,) (that of
    t counts). A row whose window has a gap has no window, nor has one that is not in `ends`, bool (rows,). Raises
    `repeated(first row, second row)` when a sequence holds a frame twice.
    """
    if length < 1:
        raise ValueError(f"a clip has at least one frame, not {length}")
    order, key, spread = _keys(sequence, frame)
    twice = np.flatnonzero(key[1:] == key[:-1])
    if twice.size and length > 1:
        one, two = sorted(int(at if order is None else order[at]) for at in (twice[0], twice[0] + 1))
        raise repeated(one, two) if repeated else ValueError(f"rows {one} and {two} are the same frame")
    kind = np.int32 if len(key) <= np.iinfo(np.int32).max else np.int64  # millions of windows are held
    if length > np.bincount(sequence, minlength=1).max():
        return np.empty((0, length), kind)
    found, count = np.empty((len(key), length), kind), 0
    for start in range(0, len(key), _BLOCK):
        here = np.arange(start, min(start + _BLOCK, len(key)))
        rows = here if order is None else order[here]
        chosen = rows if ends is None else rows[ends[rows]]
        places = _places(key, spread, here if ends is None else here[ends[rows]], stride[chosen], length)
        found[count : count + len(places)] = places if order is None else order[places]
        count += len(places)
    found = found[:count]
    return found if order is None else found[np.argsort(found[:, -1], kind="stable")]


def _places(key: np.ndarray, spread: int, here: np.ndarray, stride: np.ndarray, length: int) -> np.ndarray:
    """Windows that end at the places `here` of `key`, as places i64 (windows, length)."""
    found = np.empty((len(here), length), np.int64)
    found[:, -1] = here
    whole, last, stride = np.ones(len(here), bool), key[here], np.minimum(stride, spread)
    for back in range(1, length):
        wanted = last - back * stride
        inside = last % spread >= back * stride  # else the number would be one of the sequence before
        at = np.maximum(here - back * stride, 0)  # where it lies when no frame between is missing
        astray = np.flatnonzero(inside & (key[at] != wanted))
        at[astray] = np.minimum(np.searchsorted(key, wanted[astray]), len(key) - 1)
        whole &= inside & (key[at] == wanted)
        found[:, length - 1 - back] = at
    return found[whole]


def _keys(sequence: np.ndarray, frame: np.ndarray) -> tuple[np.ndarray | None, np.ndarray, int]:
    """(order, key, spread): row ids i64 by sequence and frame (None: they are so already), and in that order one
    number i64 for each row, sequence * spread + frame, where frames count from 0 and stay below `spread`."""
    if not len(frame):
        return None, np.arange(0), 1
    low, high, sequences = int(frame.min()), int(frame.max()), int(sequence.max()) + 1
    if (high - low + 1) * sequences < _MOST:
        spread = high - low + 1
        key = sequence * spread
        key += frame
        key -= low
        if (key[1:] >= key[:-1]).all():  # as readers write them: nothing to sort
            return None, key, spread
        order = np.argsort(key, kind="stable")
        return order, key[order], spread
    # Time stamps in ns: count from the first frame of each sequence.
    order = np.lexsort((frame, sequence))
    sequence, frame = sequence[order], frame[order]
    starts = np.flatnonzero(np.diff(sequence, prepend=-1))
    frame = frame - np.repeat(frame[starts], np.diff(np.append(starts, len(frame))))
    spread = int(frame.max()) + 1
    if spread * sequences >= _MOST:
        raise OverflowError(f"frame_index spans {spread} in one of {sequences} sequences, more than 64 bits hold")
    return order, sequence * spread + frame, spread
