"""What a table of frames contains, from its columns in blocks: digest, counts, recordings, clips.

Every column is passed once or twice, and no value becomes a Python object. So 20 million rows take some hundred MB.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.manifest.clips import count_windows
from anytouch_jax.data.manifest.schema import BLOCK, SPLITS

Blocks = Callable[[str], Iterator[pa.Array]]  # of a column's name, its values in blocks
_KEPT = 400 << 20  # bytes of text that are kept for the second half of a digest; a longer column is read again
_SHOWN = 20


class Summary(NamedTuple):
    """Numbers of a manifest.

    `clips` counts those of the asked length. `filled` are rows with a value, by column. `counts` has the first values
    with their rows of split and sensor, in order, and the number of distinct ones.
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


def content_digest(names: Iterable[str], blocks: Blocks, look: Callable[[str, pa.Array], None] | None = None) -> str:
    """Return the SHA-256 over every column's name and values; `look` gets each block once."""
    digest = hashlib.sha256()
    for name in sorted(names):
        valid, lengths, texts, size = list[np.ndarray](), list[np.ndarray](), list[memoryview](), 0
        for block in blocks(name):
            if look is not None:
                look(name, block)
            valid.append(np.asarray(pc.is_valid(block)))
            ends, text = _text(block)
            lengths.append(np.diff(ends))
            size += len(text)
            texts = [*texts, text] if size <= _KEPT else []
        digest.update(name.encode() + b"\0")
        digest.update(np.packbits(np.concatenate(valid) if valid else np.zeros(0, bool)).tobytes())
        end = 0
        digest.update(np.zeros(1, "<i8").tobytes())
        for length in lengths:
            ends = np.cumsum(length, dtype=np.int64)
            digest.update((ends + end).astype("<i8", copy=False).data)
            end += int(ends[-1]) if len(ends) else 0
        for text in texts if size <= _KEPT else (_text(block)[1] for block in blocks(name)):
            digest.update(text)
    return digest.hexdigest()


def _text(block: pa.Array) -> tuple[np.ndarray, memoryview]:
    """Return where each value ends as text, and the text of all; null is empty."""
    try:
        text = block if pa.types.is_string(block.type) else block.cast(pa.large_string())
        text = pc.fill_null(text, "") if text.null_count else text
    except pa.ArrowException:  # nested or binary: as Python writes it
        text = pa.array([repr(value) for value in block.to_pylist()], pa.large_string())
    kind = np.int32 if pa.types.is_string(text.type) else np.int64
    ends = np.frombuffer(text.buffers()[1], kind)[text.offset : text.offset + len(text) + 1]
    return ends, memoryview(text.buffers()[2] or b"")[ends[0] : ends[-1]]


def summarise(
    names: Sequence[str], blocks: Blocks, length: int, repeat: Callable[[int, int, int, str], Exception]
) -> Summary:
    """Return the numbers of a table of these columns, with its clips of `length` frames.

    Raises `repeat(first row, second row, frame_index, sequence)` if a sequence repeats a frame.
    """
    parts: dict[str, list[Any]] = {name: [] for name in ("sequence", "frame_index", "stride", "split", "sensor")}
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
    sequence = np.concatenate([np.asarray(chunk.indices) for chunk in encoded.chunks]).astype(np.int64)
    del encoded
    sequence *= len(SPLITS)
    sequence += split
    frame = np.concatenate(parts.pop("frame_index"))
    strides = parts.pop("stride")
    stride = np.concatenate(strides) if strides else np.broadcast_to(np.int64(1), len(frame))

    def error(first: int, second: int) -> Exception:
        name = recordings[int(sequence[second]) // len(SPLITS)].as_py()
        return repeat(first, second, int(frame[second]), name)

    clips = count_windows(sequence, frame, stride, length, error)
    sensors = pa.concat_tables(parts["sensor"]).group_by("values").aggregate([("counts", "sum")]).sort_by("values")
    first = (column.slice(0, _SHOWN).to_pylist() for column in sensors.columns)
    splits = sorted((SPLITS[at], int(count)) for at, count in enumerate(np.bincount(split)) if count)
    counts = {"split": (splits, len(splits)), "sensor": (list(zip(*first, strict=True)), len(sensors))}
    return Summary(len(frame), len(recordings), clips, {name: filled[name] for name in names}, counts, digest)
