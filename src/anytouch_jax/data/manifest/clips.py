"""Clips as windows over rows: rows exactly one stride apart in one sequence, found without a loop over rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

_MOST = 1 << 61
_LONGEST = 10**12  # frames of a clip
_BLOCK = 1 << 18  # rows at a time, so that the intermediate arrays of a block fit into the cache


def clip_windows(
    sequence: np.ndarray,
    frame: np.ndarray,
    stride: np.ndarray,
    length: int,
    repeat_error: Callable[[int, int], Exception] | None = None,
    ends: np.ndarray | None = None,
) -> np.ndarray:
    """Return row ids (windows, length) of rows t - (length-1)*stride .. t of one sequence, ordered by t's row id.

    The ids are i32, beyond 2^31 rows i64. `sequence` (codes), `frame` and `stride` are i64 (rows,); the stride of row t
    counts. A row whose window has a gap, or that is not in `ends` bool (rows,), has no window. Raises
    `repeat_error(first row, second row)` if a sequence repeats a frame, and OverflowError for a length above 10^12.
    """
    order, key, blocks = _blocks(sequence, frame, stride, length, repeat_error, ends)
    dtype = np.int32 if len(key) <= np.iinfo(np.int32).max else np.int64  # there can be millions of windows
    if length > np.bincount(sequence, minlength=1).max():
        return np.empty((0, length), dtype)
    windows, count = np.empty((len(key), length), dtype), 0
    for positions in blocks:
        windows[count : count + len(positions)] = positions if order is None else order[positions]
        count += len(positions)
    windows = windows[:count]
    return windows if order is None else windows[np.argsort(windows[:, -1], kind="stable")]


def count_windows(
    sequence: np.ndarray, frame: np.ndarray, stride: np.ndarray, length: int,
    repeat_error: Callable[[int, int], Exception] | None = None,
) -> int:  # fmt: skip
    """Return the number of rows of `clip_windows`, which are not stored."""
    return sum(map(len, _blocks(sequence, frame, stride, length, repeat_error)[2]))


def _blocks(
    sequence: np.ndarray, frame: np.ndarray, stride: np.ndarray, length: int,
    repeat_error: Callable[[int, int], Exception] | None, ends: np.ndarray | None = None,
) -> tuple[np.ndarray | None, np.ndarray, Iterator[np.ndarray]]:  # fmt: skip
    """Return (order, key) of `_sorted_keys`, and windows as positions in them, in blocks. Raises as `clip_windows`."""
    if length < 1:
        raise ValueError(f"a clip has at least one frame, not {length}")
    if length > _LONGEST:
        raise OverflowError(f"no clip has {length} frames")
    order, key, spread = _sorted_keys(sequence, frame)
    repeats = np.flatnonzero(key[1:] == key[:-1])
    if repeats.size and length > 1:
        first, second = sorted(int(at if order is None else order[at]) for at in (repeats[0], repeats[0] + 1))
        raise repeat_error(first, second) if repeat_error else ValueError(f"rows {first}, {second}: the same frame")

    def blocks() -> Iterator[np.ndarray]:
        for start in range(0, len(key), _BLOCK):
            last = np.arange(start, min(start + _BLOCK, len(key)))
            rows = last if order is None else order[last]
            if ends is not None:
                last, rows = last[ends[rows]], rows[ends[rows]]
            yield _windows_ending_at(last, key, spread, stride[rows], length)

    return order, key, blocks()


def _windows_ending_at(last: np.ndarray, key: np.ndarray, spread: int, stride: np.ndarray, length: int) -> np.ndarray:
    """Return the whole windows that end at the positions `last` of `key`, as positions i64 (windows, length)."""
    windows = np.empty((len(last), length), np.int64)
    windows[:, -1] = last
    is_whole, last_key, stride = np.ones(len(last), bool), key[last], np.minimum(stride, spread)
    for back in range(1, length):
        wanted = last_key - back * stride
        same_sequence = last_key % spread >= back * stride  # else the key would be one of the sequence before
        at = np.maximum(last - back * stride, 0)  # its position if no frame between is missing
        elsewhere = np.flatnonzero(same_sequence & (key[at] != wanted))
        at[elsewhere] = np.minimum(np.searchsorted(key, wanted[elsewhere]), len(key) - 1)
        is_whole &= same_sequence & (key[at] == wanted)
        windows[:, length - 1 - back] = at
    return windows[is_whole]


def _sorted_keys(sequence: np.ndarray, frame: np.ndarray) -> tuple[np.ndarray | None, np.ndarray, int]:
    """Return (order, key, spread): row ids i64 sorted by sequence and frame (None if sorted), and their keys. A key i64
    is sequence * spread + frame. Frames count from 0 and are below `spread`."""
    if not len(frame):
        return None, np.arange(0), 1
    low, high, sequences = int(frame.min()), int(frame.max()), int(sequence.max()) + 1
    if (high - low + 1) * sequences < _MOST:
        spread = high - low + 1
        key = sequence * spread
        key += frame
        key -= low
        if (key[1:] >= key[:-1]).all():  # the order in which readers write
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
