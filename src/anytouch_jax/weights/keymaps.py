"""Key maps: which array of a weights file is which parameter of the model.

A family of weights is a table in `layouts`: which key of a file is which of our parameters. A row takes
part where the model has its parameter, and the sizes of a model are read from the arrays by the same rows. Our names
are those of `Net.abstract()`: paths joined with "/", blocks stacked on axis 0, kernels as (in, out).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Any

import numpy as np

from anytouch_jax.config import SENSORS, UNIVERSAL, ModelConfig, Stack, TextTower
from anytouch_jax.nn.functional import build
from anytouch_jax.weights.tree import flatten

Weights = Mapping[str, np.ndarray]
Shape = tuple[int, ...]
Heads = Mapping[str, int]  # head counts of "touch", "decoder", "image" and "text"
Conversion = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Entry:
    """One array of a file: its `key`, our parameter `name`, and the exact conversions to our layout and back.

    In a row of a table "{}" in the key stands for the `layer` of a stack. `part` is a third of a kernel.
    """

    key: str
    name: str
    read: Conversion
    write: Conversion
    layer: int | None = None
    part: int | None = None


def _write_patch(kernel: np.ndarray) -> np.ndarray:  # (..., P*P*3, D) -> (D, ..., colour, row, col)
    side = math.isqrt(kernel.shape[-2] // 3)
    return np.moveaxis(kernel.reshape(*kernel.shape[:-2], side, side, 3, -1), (-1, -2), (0, -3))


def _read_patch(weight: np.ndarray) -> np.ndarray:  # golden Q1: (D, frame, colour, row, col) -> (frames, P*P*3, D)
    return np.moveaxis(weight, (0, -3), (-1, -2)).reshape(*weight.shape[1:-3], -1, len(weight))


def _read_frames(weight: np.ndarray) -> np.ndarray:  # from (D, frame * colour, row, col)
    return _read_patch(weight.reshape(len(weight), -1, 3, *weight.shape[2:]))


def _write_frames(kernel: np.ndarray) -> np.ndarray:
    weight = _write_patch(kernel)
    return weight.reshape(len(weight), -1, *weight.shape[3:])


def _read_video(weight: np.ndarray) -> np.ndarray:  # from (D, colour, frame, row, col)
    return _read_patch(weight.swapaxes(1, 2))


def _write_video(kernel: np.ndarray) -> np.ndarray:
    return _write_patch(kernel).swapaxes(1, 2)


def _same(x: np.ndarray) -> np.ndarray:
    return x


# Named functions and not lambdas, so that an encoder of a family can be pickled.
SAME: tuple[Conversion, Conversion] = (_same, _same)
_TURNED: tuple[Conversion, Conversion] = (np.transpose, np.transpose)
_LEADING = (partial(np.squeeze, axis=0), partial(np.expand_dims, axis=0))
_TWO_LEADING = (partial(np.squeeze, axis=(0, 1)), partial(np.expand_dims, axis=(0, 1)))
# kind of a row -> the arrays of such a layer: what is added to its key and to our name, the conversions, the third
_KINDS: dict[str, list[tuple[Any, ...]]] = {
    "same": [("", "", *SAME)],
    "row": [("", "", *_LEADING)],
    "token": [("", "", *_TWO_LEADING)],
    "patch": [(".weight", "/kernel", _read_patch, _write_patch)],
    "frames": [(".weight", "/kernel", _read_frames, _write_frames), (".bias", "/bias", *SAME)],
    "video": [(".weight", "/kernel", _read_video, _write_video), (".bias", "/bias", *SAME)],
    "kernel": [(".weight", "/kernel", *_TURNED)],
    "linear": [(".weight", "/kernel", *_TURNED), (".bias", "/bias", *SAME)],
    "norm": [(".weight", "/scale", *SAME), (".bias", "/bias", *SAME)],
    "lora": [(".lora_A.default.weight", "/a", *_TURNED), (".lora_B.default.weight", "/b", *_TURNED)],
    **{
        kind: [
            (f"{dot}{theirs}", f"/{name}/{ours}", *conversions, None, part)
            for part, name in enumerate(("query", "key", "value"))
            for theirs, ours, conversions in (("weight", "kernel", _TURNED), ("bias", "bias", SAME))
        ]
        for kind, dot in (("qkv", "_"), ("fused", "."))
    },
}


def rows(table: str, theirs: str = "", ours: str = "") -> tuple[Entry, ...]:
    """Return the rows of a table. A line has the kind of a layer in `_KINDS`, its key and our name."""
    return tuple(
        Entry(f"{theirs}{key}{key_end}", f"{ours}{name}{name_end}", *rest)
        for kind, key, name in (line.split() for line in table.strip().splitlines())
        for key_end, name_end, *rest in _KINDS[kind]
    )


def each_layer(table: Iterable[Entry], shapes: Mapping[str, Shape]) -> list[Entry]:
    """Return the rows of a table whose parameters are in `shapes`, one for each layer of a stack."""
    table = [row for row in table if row.name in shapes]
    layers = [range(shapes[row.name][0]) if "{}" in row.key else (None,) for row in table]
    return [
        replace(row, key=row.key.format(layer), layer=layer)
        for row, numbers in zip(table, layers, strict=True)
        for layer in numbers
    ]


def find_depth(key: str, keys: Iterable[str]) -> int:
    """Return the number of layers in a file, from the key of an array of each with "{}" for the layer.

    Raises KeyError if one is missing: a number in a name must not decide how much memory is taken.
    """
    pattern = re.compile(re.escape(key).replace(r"\{\}", r"(\d+)"))
    layers = {int(match[1]) for name in keys if (match := pattern.fullmatch(name))}
    if missing := set(range(max(len(layers), 1))) - layers:
        raise KeyError(key.format(min(missing)))
    return len(layers)


@lru_cache(maxsize=8)
def param_shapes(model: ModelConfig) -> Mapping[str, Shape]:
    """Return name -> shape of every parameter of a model."""
    return MappingProxyType({name: tuple(leaf.shape) for name, leaf in flatten(build(model).abstract()).items()})


# Heads of the published towers by width: OpenAI's CLIP and the authors (width / 64), OpenCLIP's larger towers (16).
VISION_HEADS = {384: 6, 512: 8, 768: 12, 896: 14, 1024: 16, 1280: 16, 1408: 16, 1664: 16}
_TEXT_HEADS = {384: 6, 512: 8, 640: 10, 768: 12, 1024: 16, 1280: 20}
_HEADS = {"touch": VISION_HEADS, "image": VISION_HEADS, "text": _TEXT_HEADS, "decoder": {512: 16}}
_DECODER = Stack(512, 8, 16, 2048)  # the authors', for files without a decoder


@dataclass(frozen=True)
class KeyMap:
    """A family of weights files.

    `mark` is a regex that only its files have a key for. `table` lists the arrays, and `lora` those that replace them
    in a model with LoRA. A table without rows stands for our own names.
    `unused` maps a key that no code reads to the key it is made from: a copy, or the mean over frames if it has fewer
    axes (golden Q2). `towers` matches the keys of each part that a model may lack.
    """

    name: str
    mark: str
    table: tuple[Entry, ...] = ()
    lora: tuple[Entry, ...] = ()
    unused: Mapping[str, str] = field(default_factory=dict)
    towers: Mapping[str, str] = field(default_factory=dict)

    def entries(self, model: ModelConfig) -> list[Entry]:
        """Return the arrays that fill a model, a layer of a stack each."""
        shapes = param_shapes(model)
        if not self.table:
            return [Entry(name, name, *SAME) for name in shapes]
        return each_layer(self._rows(bool(model.lora_rank)).values(), shapes)

    def _rows(self, lora: bool) -> dict[str, Entry]:
        return {row.name: row for row in (*self.table, *(self.lora if lora else ()))}

    def detect(self, weights: Weights, heads: Heads) -> tuple[ModelConfig, dict[str, int]]:
        """Return the model that made a file, and the widths of its stacks of unknown head counts, which are 1 in it.

        A head count leaves no trace in shapes. It is that of `heads`, else that of a published tower of this width.
        A missing array or an odd shape raises KeyError, IndexError, ValueError or TypeError.
        """
        table, unknown = self._rows(any(".lora_A." in key for key in weights)), dict[str, int]()

        def has(name: str) -> bool:
            return name in table and table[name].key.format(0) in weights

        def shape(name: str) -> Shape:
            return table[name].read(weights[table[name].key.format(0)]).shape

        def stack(part: str) -> Stack:
            row = table[f"{part}/blocks/mlp/up/kernel"]
            width, mlp = shape(row.name)
            depth = find_depth(row.key, weights)
            count = heads.get(part) or _HEADS[part].get(width)
            if count is None:
                unknown[part] = width
            return Stack(width, depth, count or 1, mlp)

        main = "touch" if "touch/patch/kernel" in table else "image"
        kernel, tower = shape(f"{main}/patch/kernel"), stack(main)
        patch, projection = math.isqrt(kernel[-2] // 3), f"{main}/projection/kernel"
        sizes: dict[str, Any] = {"touch": tower, "decoder": _DECODER, "match_head": "none"}
        if main == "touch":
            count, each, _ = shape("touch/sensor_tokens")
            numbered = (*(f"sensor{row}" for row in range(count - 1)), UNIVERSAL)
            sizes |= {"sensors": SENSORS if count == len(SENSORS) else numbered, "sensor_tokens": each}
            sizes |= {"frames": kernel[0], "decoder_sensor_tokens": has("decoder/sensor_projection/kernel")}
        if "decoder/mask_token" in table:
            sizes["decoder"] = stack("decoder")
        if has("image/patch/kernel"):
            sizes["image"] = stack("image")
        if has("text/token"):
            sizes["text"] = TextTower(stack("text"), vocab=shape("text/token")[0], length=shape("text/position")[0])
        if has("lora/query/a"):
            sizes["lora_rank"] = shape("lora/query/a")[-1]
        if has("matcher/kernel") or has("matcher/up/kernel"):
            sizes["match_head"] = "linear" if has("matcher/kernel") else "mlp"
        return ModelConfig(
            image_size=round((shape(f"{main}/position")[0] - 1) ** 0.5) * patch,
            patch=patch,
            embed=shape(projection)[-1] if has(projection) else tower.width,  # a vision tower alone has none
            **sizes,
        ), unknown
