"""What a table of frames contains, from its columns in blocks: digest, counts, recordings, clips.

Every column is passed once or twice, and no value becomes a Python object. So 20 million rows take
some hundred MB. Clips are windows over rows, exactly one stride apart in one sequence, which are
found without a loop over rows.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.manifest.schema import BLOCK, SPLITS

Blocks = Callable[[str], Iterator[pa.Array]]  # of a column's name, its values in blocks
# bytes of text that are kept for the second half of a digest; a longer column is read again
_KEPT = 400 << 20
_SHOWN = 20


class Summary(NamedTuple):
    """Numbers of a manifest.

    Attributes:
        rows: Frames.
        recordings: Sequences.
        clips: Clips of the length that was asked for.
        filled: Rows with a value, by column.
        counts: Of split and sensor: the first values with their rows, and how many values there
            are.
        digest: SHA-256 of the content.
    """

    rows: int
    recordings: int
    clips: int
    filled: dict[str, int]
    counts: dict[str, tuple[list[tuple[str, int]], int]]
    digest: str


def table_blocks(table: pa.Table) -> Blocks:
    """Return the columns of a table in blocks."""

    def blocks(name: str) -> Iterator[pa.Array]:
        column = table[name]
        for start in range(0, len(column), BLOCK):
            part = column.slice(start, BLOCK).combine_chunks()
            yield from part.chunks if isinstance(part, pa.ChunkedArray) else (part,)

    return blocks


def content_digest(
    names: Iterable[str], blocks: Blocks, look: Callable[[str, pa.Array], None] | None = None
) -> str:
    """Return the SHA-256 over every column's name and values.

    A value counts as text, so that equal tables in CSV and Parquet have equal digests. A column is
    digested as an Arrow array lies in memory: which values are null, where each value ends, and the
    text of all.

    Args:
        names: The columns.
        blocks: Returns the blocks of a column.
        look: Gets each block once, for those who count at the same time.
    """
    digest = hashlib.sha256()
    for name in sorted(names):
        valid = [np.zeros(0, bool)]
        lengths = list[np.ndarray]()
        texts = list[memoryview]()
        size = 0
        for block in blocks(name):
            if look is not None:
                look(name, block)
            valid.append(np.asarray(pc.is_valid(block)))
            ends, text = _text(block)
            lengths.append(np.diff(ends))
            size += len(text)
            if size <= _KEPT:
                texts.append(text)
            else:
                texts.clear()
        digest.update(name.encode() + b"\0")
        digest.update(np.packbits(np.concatenate(valid)).tobytes())
        _digest_ends(digest, lengths)
        if size > _KEPT:
            # The column is read again rather than kept.
            for block in blocks(name):
                digest.update(_text(block)[1])
        for text in texts:
            digest.update(text)
    return digest.hexdigest()


def _digest_ends(digest: hashlib._Hash, lengths: Sequence[np.ndarray]) -> None:
    """Digest where each value of a column ends, from the lengths of the values of its blocks."""
    digest.update(np.zeros(1, "<i8").tobytes())
    end = 0
    for length in lengths:
        ends = np.cumsum(length, dtype=np.int64) + end
        digest.update(ends.astype("<i8", copy=False).data)
        if len(ends):
            end = int(ends[-1])


def _text(block: pa.Array) -> tuple[np.ndarray, memoryview]:
    """Return where each value ends as text, and the text of all; null is empty."""
    try:
        text = block
        if not pa.types.is_string(block.type):
            text = block.cast(pa.large_string())
        if text.null_count:
            text = pc.fill_null(text, "")
    except pa.ArrowException:  # nested or binary: as Python writes it
        text = pa.array([repr(value) for value in block.to_pylist()], pa.large_string())
    # The second buffer of an Arrow string array has the ends, the third the text.
    kind = np.int32 if pa.types.is_string(text.type) else np.int64
    ends = np.frombuffer(text.buffers()[1], kind)[text.offset : text.offset + len(text) + 1]
    return ends, memoryview(text.buffers()[2] or b"")[ends[0] : ends[-1]]


def summarise(
    names: Sequence[str],
    blocks: Blocks,
    length: int,
    repeat: Callable[[int, int, int, str], Exception],
) -> Summary:
    """Return the numbers of a table.

    Args:
        names: Its columns.
        blocks: Returns the blocks of a column.
        length: Frames of a clip.
        repeat: Makes the error to raise if a sequence repeats a frame, from the first row, the
            second row, the frame_index and the sequence.
    """
    parts: dict[str, list[Any]] = {
        name: [] for name in ("sequence", "frame_index", "stride", "split", "sensor")
    }
    filled: dict[str, int] = {}

    def look(name: str, block: pa.Array) -> None:
        filled[name] = filled.get(name, 0) + len(block) - block.null_count
        if name == "sequence":
            parts[name].append(block.dictionary_encode())
        elif name in ("frame_index", "stride"):
            parts[name].append(np.asarray(block))
        elif name == "sensor":
            parts[name].append(pa.Table.from_struct_array(pc.value_counts(block)))
        elif name == "split":
            parts[name].append(np.asarray(pc.index_in(block, pa.array(SPLITS))).astype(np.int8))

    digest = content_digest(names, blocks, look)
    encoded = pa.chunked_array(parts.pop("sequence")).unify_dictionaries()
    recordings = encoded.chunk(0).dictionary
    split = np.concatenate(parts.pop("split"))
    sequence = np.concatenate([np.asarray(chunk.indices) for chunk in encoded.chunks]).astype(
        np.int64
    )
    del encoded
    sequence *= len(SPLITS)
    sequence += split
    frame = np.concatenate(parts.pop("frame_index"))
    strides = parts.pop("stride")
    stride = np.concatenate(strides) if strides else np.broadcast_to(np.int64(1), len(frame))

    def error(first: int, second: int) -> Exception:
        name = recordings[int(sequence[second]) // len(SPLITS)].as_py()
        return repeat(first, second, int(frame[second]), name)

    # they are not stored
    clips = sum(map(len, _blocks(sequence, frame, stride, length, error)[2]))
    by_sensor = pa.concat_tables(parts["sensor"]).group_by("values")
    sensors = by_sensor.aggregate([("counts", "sum")]).sort_by("values")
    values, rows = (column.slice(0, _SHOWN).to_pylist() for column in sensors.columns)
    of_split = enumerate(np.bincount(split))
    splits = sorted((SPLITS[at], int(count)) for at, count in of_split if count)
    return Summary(
        rows=len(frame),
        recordings=len(recordings),
        clips=clips,
        filled={name: filled[name] for name in names},
        counts={
            "split": (splits, len(splits)),
            "sensor": (list(zip(values, rows, strict=True)), len(sensors)),
        },
        digest=digest,
    )


_MOST = 1 << 61  # of a key: differences of two keys stay within 64 bits
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
    """Return the windows of rows t - (length-1)*stride .. t of one sequence.

    A row with a gap before it has no window.

    Args:
        sequence: Codes i64 (rows,).
        frame: Frame numbers i64 (rows,).
        stride: Of the window that ends at each row, i64 (rows,).
        length: Rows of a window.
        repeat_error: Makes the error to raise if a sequence repeats a frame, from the first row and
            the second row.
        ends: Rows that may be the last of a window, bool (rows,), by default all.

    Returns:
        Row ids (windows, length), ordered by the last row; i32, or i64 beyond 2^31 rows.

    Raises:
        OverflowError: For a length above 10^12.
    """
    order, key, blocks = _blocks(sequence, frame, stride, length, repeat_error, ends)
    # there can be millions of windows
    dtype = np.int32 if len(key) <= np.iinfo(np.int32).max else np.int64
    if length > np.bincount(sequence, minlength=1).max():
        return np.empty((0, length), dtype)
    windows = np.empty((len(key), length), dtype)
    count = 0
    for positions in blocks:
        windows[count : count + len(positions)] = positions if order is None else order[positions]
        count += len(positions)
    windows = windows[:count]
    if order is None:
        return windows
    return windows[np.argsort(windows[:, -1], kind="stable")]


def _blocks(
    sequence: np.ndarray,
    frame: np.ndarray,
    stride: np.ndarray,
    length: int,
    repeat_error: Callable[[int, int], Exception] | None,
    ends: np.ndarray | None = None,
) -> tuple[np.ndarray | None, np.ndarray, Iterator[np.ndarray]]:
    """Return the order and keys of `_sorted_keys`, and windows as positions in them, in blocks.

    The arguments are those of `clip_windows`, which raises the same.
    """
    if length < 1:
        raise ValueError(f"a clip has at least one frame, not {length}")
    if length > _LONGEST:
        raise OverflowError(f"no clip has {length} frames")
    order, key, spread = _sorted_keys(sequence, frame)
    repeats = np.flatnonzero(key[1:] == key[:-1])
    if repeats.size and length > 1:
        places = repeats[0] + np.array([0, 1])
        rows = places if order is None else order[places]
        first, second = sorted(rows.tolist())
        if repeat_error is not None:
            raise repeat_error(first, second)
        raise ValueError(f"rows {first}, {second}: the same frame")

    def blocks() -> Iterator[np.ndarray]:
        for start in range(0, len(key), _BLOCK):
            last = np.arange(start, min(start + _BLOCK, len(key)))
            rows = last if order is None else order[last]
            if ends is not None:
                last = last[ends[rows]]
                rows = rows[ends[rows]]
            yield _windows_ending_at(last, key, spread, stride[rows], length)

    return order, key, blocks()


def _windows_ending_at(
    last: np.ndarray, key: np.ndarray, spread: int, stride: np.ndarray, length: int
) -> np.ndarray:
    """Return the whole windows that end at some positions, as positions i64 (windows, length).

    Args:
        last: Positions i64 (n,) in `key`.
        key: Sorted keys, see `_sorted_keys`.
        spread: Of the keys.
        stride: i64 (n,), of each window.
        length: Rows of a window.
    """
    windows = np.empty((len(last), length), np.int64)
    windows[:, -1] = last
    is_whole = np.ones(len(last), bool)
    last_key = key[last]
    stride = np.minimum(stride, spread)
    for back in range(1, length):
        wanted = last_key - back * stride
        # Otherwise the key would be one of the sequence before.
        same_sequence = last_key % spread >= back * stride
        # Its position if no frame between is missing, as is usual. The others are searched for.
        at = np.maximum(last - back * stride, 0)
        elsewhere = np.flatnonzero(same_sequence & (key[at] != wanted))
        at[elsewhere] = np.minimum(np.searchsorted(key, wanted[elsewhere]), len(key) - 1)
        is_whole &= same_sequence & (key[at] == wanted)
        windows[:, length - 1 - back] = at
    return windows[is_whole]


def _sorted_keys(
    sequence: np.ndarray, frame: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray, int]:
    """Return rows in the order of sequence and frame, by one key for both.

    A key is sequence * spread + frame. Frames count from 0 and are below `spread`, so the key of
    the frame before is one less, and there is none across sequences.

    Returns:
        Row ids i64 in order (None if the rows are in order), their keys i64, and the spread.
    """
    if not len(frame):
        return None, np.arange(0), 1
    low = int(frame.min())
    high = int(frame.max())
    sequences = int(sequence.max()) + 1
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
    sequence = sequence[order]
    frame = frame[order]
    starts = np.flatnonzero(np.diff(sequence, prepend=-1))
    frame = frame - np.repeat(frame[starts], np.diff(np.append(starts, len(frame))))
    spread = int(frame.max()) + 1
    if spread * sequences >= _MOST:
        raise OverflowError(
            f"frame_index spans {spread} in one of {sequences} sequences, more than 64 bits hold"
        )
    return order, sequence * spread + frame, spread
