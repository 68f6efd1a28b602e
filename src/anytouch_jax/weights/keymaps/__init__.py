"""Key maps: which array of a weights file is which parameter of the model.

A family of weights is one module of this folder. It lists the keys of its files, and detects its files by their keys.
Our names are those of `Net.abstract()`: paths joined with "/", blocks stacked on axis 0, kernels as (in, out).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from anytouch_jax.config import ModelConfig, Stack, TextTower
from anytouch_jax.nn.functional import build
from anytouch_jax.weights.tree import flatten

Weights = Mapping[str, np.ndarray]
Shape = tuple[int, ...]
Heads = Mapping[str, int]  # head counts of "touch", "decoder", "image" and "text"
PROJECTIONS = ("query", "key", "value", "out")


@dataclass(frozen=True)
class Conversion:
    """Exact conversions of an array: from the file's layout to ours (`read`), and back (`write`)."""

    read: Callable[[np.ndarray], np.ndarray]
    write: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Entry:
    """One array of a file: its `key`, our parameter `name`, its `layer` in a stack, its third (`part`) of a kernel."""

    key: str
    name: str
    conversion: Conversion
    layer: int | None = None
    part: int | None = None


@dataclass(frozen=True)
class KeyMap:
    """A kind of weights file.

    `matches` detects it. `entries` lists the arrays that fill a model. `detect` returns the model that made the file;
    its last argument has the known head counts, which leave no trace in shapes.
    `unused` maps a key that no code reads to the key it is made from: a copy, or the mean over frames if it has fewer
    axes (golden Q2). `towers` matches the keys of each part that a model may lack.
    """

    name: str
    matches: Callable[[Weights], bool]
    entries: Callable[[ModelConfig], list[Entry]]
    detect: Callable[[Weights, Heads], ModelConfig]
    unused: Mapping[str, str] = field(default_factory=dict)
    towers: Mapping[str, str] = field(default_factory=dict)


@lru_cache(maxsize=8)
def _shapes(model: ModelConfig) -> dict[str, Shape]:
    return {name: tuple(leaf.shape) for name, leaf in flatten(build(model).abstract()).items()}


def param_shapes(model: ModelConfig) -> dict[str, Shape]:
    """Return name -> shape of every parameter of a model."""
    return dict(_shapes(model))


def _write_patch(kernel: np.ndarray) -> np.ndarray:  # (..., P*P*3, D) -> (D, ..., colour, row, col)
    side = math.isqrt(kernel.shape[-2] // 3)
    return np.moveaxis(kernel.reshape(*kernel.shape[:-2], side, side, 3, -1), (-1, -2), (0, -3))


def _read_patch(weight: np.ndarray) -> np.ndarray:  # golden Q1: (D, frame, colour, row, col) -> (frames, P*P*3, D)
    return np.moveaxis(weight, (0, -3), (-1, -2)).reshape(*weight.shape[1:-3], -1, len(weight))


SAME = Conversion(lambda x: x, lambda x: x)
LINEAR = Conversion(lambda x: x.T, lambda x: x.T)
ROW = Conversion(lambda x: x[0], lambda x: x[None])
TOKEN = Conversion(lambda x: x[0, 0], lambda x: x[None, None])
PATCH = Conversion(_read_patch, _write_patch)


def linear(theirs: str, ours: str) -> list[Entry]:
    """Return the entries of a torch Linear layer."""
    return [Entry(f"{theirs}.weight", f"{ours}/kernel", LINEAR), Entry(f"{theirs}.bias", f"{ours}/bias", SAME)]


def layer_norm(theirs: str, ours: str) -> list[Entry]:
    """Return the entries of a LayerNorm."""
    return [Entry(f"{theirs}.weight", f"{ours}/scale", SAME), Entry(f"{theirs}.bias", f"{ours}/bias", SAME)]


def stacked(theirs: str, ours: str, depth: int, block: Iterable[Entry]) -> Iterator[Entry]:
    """Yield the entries of `depth` blocks, each with the entries of `block`."""
    block = list(block)
    for layer in range(depth):
        for entry in block:
            yield Entry(f"{theirs}.{layer}.{entry.key}", f"{ours}/{entry.name}", entry.conversion, layer, entry.part)


# Heads of the published towers by width: OpenAI's CLIP and the authors (width / 64), OpenCLIP's larger towers (16).
VISION_HEADS = {384: 6, 512: 8, 768: 12, 896: 14, 1024: 16, 1280: 16, 1408: 16, 1664: 16}
TEXT_HEADS = {384: 6, 512: 8, 640: 10, 768: 12, 1024: 16, 1280: 20}
DECODER_HEADS = {512: 16}  # the authors'


class UnknownHeads(Exception):
    """The head count of a stack, which leaves no trace in its arrays: `stack` is its name, `width` its width."""

    def __init__(self, stack: str, width: int) -> None:
        super().__init__(stack, width)
        self.stack, self.width = stack, width


def detect_stack(weights: Weights, prefix: str, name: str, heads: Heads, published: Mapping[int, int]) -> Stack:
    """Return the sizes of the blocks under `prefix`, from the kernels of their feed-forward layers.

    The head count is `heads[name]`, else that of a published tower of this width. Raises KeyError if there are no
    blocks, and UnknownHeads.
    """
    pattern = re.compile(
        re.escape(prefix) + r"\.(?:encoder\.|base_model\.model\.|layers\.|transformer\.|resblocks\.)*(\d+)\."
        r"(?:mlp\.fc1|mlp\.c_fc|intermediate\.dense)\.weight"
    )
    shapes = {int(match[1]): array.shape for key, array in weights.items() if (match := pattern.fullmatch(key))}
    if not shapes:
        raise KeyError(f"{prefix} blocks")
    mlp, width = shapes[0]
    count = heads.get(name) or published.get(width)
    if count is None:
        raise UnknownHeads(name, width)
    return Stack(width, max(shapes) + 1, count, mlp)


def detect_text(weights: Weights, blocks: str, token: str, position: str, heads: Heads) -> TextTower | None:
    """Return the sizes of a text tower from the keys of its tables; None if the file has no such tower."""
    if token not in weights:
        return None
    stack = detect_stack(weights, blocks, "text", heads, TEXT_HEADS)
    return TextTower(stack, vocab=len(weights[token]), length=len(weights[position]))


def image_sizes(weights: Weights, patch: str, position: str) -> dict[str, Any]:
    """Return the image and patch sizes in pixels, from the keys of a patch kernel and a position table."""
    side = int(weights[patch].shape[-1])
    return {"image_size": round((len(weights[position]) - 1) ** 0.5) * side, "patch": side}
