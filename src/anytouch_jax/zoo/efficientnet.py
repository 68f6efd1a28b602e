"""EfficientNet-lite of ImageNet, without its classifier: what a user would take off the shelf.

Its middle blocks are read, as they are more use for touch than its head, which knows kinds of
things. A touch becomes an image of what changed, in which the network finds edges and textures.

Tan and Le, "EfficientNet: Rethinking model scaling for convolutional neural networks" (2019). The
lite form has neither squeeze-and-excitation nor swish, and ReLU6 in their place.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.config import UNIVERSAL, Config, DataConfig, ModelConfig, Stack
from anytouch_jax.encoder.arrays import Aggregation, Array, Log, Params, Pooling, warn
from anytouch_jax.encoder.base import Encoder
from anytouch_jax.shown import count_of
from anytouch_jax.weights.keymaps import DECODER, Weights
from anytouch_jax.weights.safetensors import WeightsError
from anytouch_jax.weights.tree import flatten
from anytouch_jax.zoo.table import CONVOLUTIONAL, Family

SIDE = 224  # pixels, those of its training on ImageNet
_STRIDES = (1, 2, 2, 2, 1, 2, 1)  # of the first block of each stage
_READ = (2, 3, 4, 5)  # stages whose last blocks are features, from 0
_EPSILON = 1e-3  # of its batch norms
_MIDDLE = 127.0  # grey levels: its pixels are (x - 127) / 128
_RANGE = 128.0


@dataclass(frozen=True)
class ConvModel:
    """A network as its file has it: the stride of each block, and those that are features."""

    family: Family
    params: Params = field(repr=False)
    strides: tuple[int, ...]
    read: tuple[int, ...]
    side: int
    width: int


@dataclass(frozen=True, repr=False)
class ConvEncoder(Encoder):
    """An EfficientNet-lite under the interface of `Encoder`.

    Features are the means over the image of the last blocks of four stages, whatever the
    pooling. Frames of a clip are averaged.
    """

    form: ConvModel = field(kw_only=True, repr=False)

    def about(self) -> dict[str, str]:
        """Return what a user wants to know."""
        side = self.form.side
        count = sum(np.size(leaf) for leaf in jax.tree.leaves(self.params))
        return {
            "family": self.form.family.title,
            "parameters": count_of(count),
            "licence": self.form.family.licence,
            "input": f"uint8 RGB {side} x {side}, one frame",
            "background": "subtracted if it is given",
            "features": f"{self.form.width}, means of blocks {_listed(self.form.read)}",
            "sensors": self.form.family.sensors,
        }

    @property
    def contract(self) -> str:
        """Everything but the parameters that decides its features, as text."""
        return repr((super().contract, self.form.strides, self.form.read))

    def sensor_row(self, name: str, log: Log = warn) -> int:
        """Return 0: it does not know sensors."""
        return 0

    def untrained(self, seed: int = 0) -> Encoder:
        """Return the same network with random weights (He et al. 2015)."""
        rng = np.random.default_rng(seed)

        def drawn(path: Any, leaf: Array) -> Array:
            if path[-1].key == "bias":
                return np.zeros_like(leaf)
            inputs = np.prod(leaf.shape[:-1])
            return np.asarray(rng.standard_normal(leaf.shape) * np.sqrt(2 / inputs), np.float32)

        params = jax.tree_util.tree_map_with_path(drawn, self.params)
        return replace(self, params=params, source=f"random({seed})")

    def bare(self) -> Encoder:
        """Return what prepares frames, without parameters."""
        return replace(self, params={})

    def traceable(
        self, pooling: Pooling = "class", aggregation: Aggregation = "mean"
    ) -> Callable[..., jax.Array]:
        """Return the function from params, touches u8 (B, T, H, W, 3) and rows to features (B, E).

        There is one kind of feature, so pooling and the temporal aggregation are ignored.
        """

        def features(params: Params, clips: jax.Array, rows: jax.Array) -> jax.Array:
            count, frames = clips.shape[:2]
            images = clips.reshape(count * frames, *clips.shape[2:])
            means = run_network(params, images, self.form.strides, self.form.read)
            return means.reshape(count, frames, -1).mean(1)

        return features


def run_network(
    params: Params, images: jax.Array, strides: tuple[int, ...], read: tuple[int, ...]
) -> jax.Array:
    """Return the means f32 (B, E) of the outputs of some blocks.

    Args:
        params: "stem" and "block0", "block1" and so on, each convolution with kernel and bias.
        images: (B, H, W, 3) in 0..255.
        strides: of each block.
        read: numbers of the blocks whose means are returned, joined.
    """
    x = (images.astype(jnp.float32) - _MIDDLE) / _RANGE
    stem = params["stem"]
    x = jax.lax.conv_general_dilated(
        x, stem["kernel"], (2, 2), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    x = _clipped(x + _wide(stem["bias"]))
    means = []
    # Blocks behind the last one that is read are not computed.
    for number in range(max(read) + 1):
        x = _block(params[f"block{number}"], x, strides[number])
        if number in read:
            means.append(x.mean((1, 2)))
    return jnp.concatenate(means, axis=-1)


def _block(params: Params, x: jax.Array, stride: int) -> jax.Array:
    """Return a mobile inverted bottleneck (Sandler et al. 2018) of x (B, H, W, C)."""
    y = x
    if "expand" in params:
        y = _clipped(_pointwise(params["expand"], y))
    y = _clipped(_depthwise(params["depthwise"], y, stride))
    y = _pointwise(params["project"], y)
    if stride == 1 and x.shape == y.shape:
        return x + y
    return y


def _pointwise(params: Params, x: jax.Array) -> jax.Array:
    y = x.reshape(-1, x.shape[-1]) @ params["kernel"] + params["bias"][None]
    return y.reshape(*x.shape[:-1], y.shape[-1])


def _depthwise(params: Params, x: jax.Array, stride: int) -> jax.Array:
    """Return a convolution of each channel (B, H, W, C), padded as TensorFlow's SAME."""
    kernel = params["kernel"]
    size = kernel.shape[0]
    outs = [-(-side // stride) for side in x.shape[1:3]]
    pads = []
    for out, side in zip(outs, x.shape[1:3], strict=True):
        total = max((out - 1) * stride + size - side, 0)
        pads.append((total // 2, total - total // 2))
    x = jnp.pad(x, ((0, 0), *pads, (0, 0)))
    # A sum of shifted images: XLA's grouped convolution takes several times as long on a CPU.
    total_sum: jax.Array = _wide(params["bias"])
    for down in range(size):
        for right in range(size):
            rows = slice(down, down + stride * (outs[0] - 1) + 1, stride)
            columns = slice(right, right + stride * (outs[1] - 1) + 1, stride)
            total_sum = total_sum + x[:, rows, columns] * _wide(kernel[down, right])
    return total_sum


def _wide(values: jax.Array) -> jax.Array:
    """Return values of each channel (C,) with the axes of images."""
    return jnp.asarray(values)[None, None, None]


def _clipped(x: jax.Array) -> jax.Array:
    return jnp.clip(x, 0.0, 6.0)


def is_efficientnet(weights: Weights) -> bool:
    """Return whether a file has an EfficientNet by the names of its PyTorch form."""
    return {"_conv_stem.weight", "_blocks.0._depthwise_conv.weight"} <= weights.keys()


def read_efficientnet(path: Path, weights: Mapping[str, Array], side: int | None) -> ConvModel:
    """Return the network of a file, with its batch norms folded into the convolutions.

    Args:
        path: the file, for sentences.
        weights: its arrays.
        side: of its images, pixels. None is SIDE.

    Raises:
        WeightsError: another form than the lite one, or a damaged file.
    """
    if any("_se_" in name for name in weights):
        raise WeightsError(f"{path} is an EfficientNet; only its lite form is computed here")
    numbers = [int(found[1]) for name in weights if (found := re.match(r"_blocks\.(\d+)\.", name))]
    params: Params = {}
    strides = list[int]()
    ends = list[int]()  # the last block of each stage
    try:
        params["stem"] = _folded(weights, "_conv_stem", "_bn0")
        before = 0
        for number in range(max(numbers) + 1):
            prefix = f"_blocks.{number}."
            block = {
                "depthwise": _folded(weights, f"{prefix}_depthwise_conv", f"{prefix}_bn1"),
                "project": _folded(weights, f"{prefix}_project_conv", f"{prefix}_bn2"),
            }
            if f"{prefix}_expand_conv.weight" in weights:
                block["expand"] = _folded(weights, f"{prefix}_expand_conv", f"{prefix}_bn0")
            params[f"block{number}"] = block
            width = block["project"]["kernel"].shape[-1]
            # A stage begins where the width changes.
            is_first = width != before
            strides.append(_STRIDES[len(ends)] if is_first else 1)
            if is_first:
                ends.append(number)
            ends[-1] = number
            before = width
        if len(ends) != len(_STRIDES):
            raise WeightsError(f"{path} has {len(ends)} stages, not {len(_STRIDES)}")
        _check_chain(params)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise WeightsError(f"{path} is not a whole EfficientNet-lite ({error})") from None
    read = tuple(ends[stage] for stage in _READ)
    width = sum(params[f"block{number}"]["project"]["kernel"].shape[-1] for number in read)
    used = {name: params[name] for name in ("stem", *(f"block{n}" for n in range(read[-1] + 1)))}
    if not all(np.isfinite(leaf).all() for leaf in flatten(used).values()):
        raise WeightsError(f"{path} has values that are not finite; download it again")
    return ConvModel(CONVOLUTIONAL, used, tuple(strides), read, side or SIDE, width)


def _folded(weights: Mapping[str, Array], convolution: str, norm: str) -> Params:
    """Return kernel and bias of a convolution and the batch norm behind it."""
    kernel = np.asarray(weights[f"{convolution}.weight"], np.float64)
    scale = np.asarray(weights[f"{norm}.weight"], np.float64) / np.sqrt(
        np.asarray(weights[f"{norm}.running_var"], np.float64) + _EPSILON
    )
    bias = weights[f"{norm}.bias"] - weights[f"{norm}.running_mean"] * scale
    if kernel.ndim != 4 or bias.shape != (len(kernel),):
        raise ValueError(f"{convolution} has shape {kernel.shape}")
    kernel = np.moveaxis(kernel * scale[:, None, None, None], 0, -1)  # (in, h, w, out)
    kernel = np.moveaxis(kernel, 0, -2)  # (h, w, in, out)
    if convolution.endswith("_depthwise_conv"):
        kernel = kernel[:, :, 0]
    elif kernel.shape[:2] == (1, 1):
        kernel = kernel[0, 0]
    return {"kernel": np.asarray(kernel, np.float32), "bias": np.asarray(bias, np.float32)}


def _check_chain(params: Params) -> None:
    """Raise ValueError where a layer does not take what the one before gives."""
    width = params["stem"]["kernel"].shape[-1]
    for number in range(len(params) - 1):
        block = params[f"block{number}"]
        if "expand" in block:
            first, width = block["expand"]["kernel"].shape
            last = params[f"block{number - 1}"]["project"]["kernel"].shape[-1]
            if first != last:
                raise ValueError(f"block {number} takes {first} channels of {last}")
        if block["depthwise"]["kernel"].shape[-1] != width:
            raise ValueError(f"block {number} filters another number of channels than {width}")
        inputs, width = block["project"]["kernel"].shape
        if inputs != block["depthwise"]["kernel"].shape[-1]:
            raise ValueError(f"block {number} projects {inputs} channels")


def conv_encoder(model: ConvModel, source: str) -> ConvEncoder:
    """Return the encoder of a network."""
    config = ModelConfig(
        image_size=model.side,
        patch=1,
        embed=model.width,
        touch=Stack(model.width, 0, 1, 1),
        decoder=DECODER,
        frames=1,
        sensors=(UNIVERSAL,),
        sensor_tokens=0,
    )
    return ConvEncoder(
        Config(config, data=DataConfig(background="either")), model.params, source, form=model
    )


def _listed(read: tuple[int, ...]) -> str:
    return ", ".join(str(number + 1) for number in read)
