"""Translations between two sensors: their design, how they are applied, saved and loaded.

The source's image goes through a ViT encoder with its sensor's tokens. A ViT decoder paints the
target's image from all tokens, as the generator of a ViTGAN (Lee et al., 2021); a field is
regressed by an MLP from the patch tokens (App. "Cross-sensor generation"). Without an encoder the
network is one of the two references, a U-Net or an MLP on pixels. What is predicted is the
difference from the mean target of the training pairs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD, from_json, to_json
from anytouch_jax.config.parsing import Above0, Count, NotNegative, check
from anytouch_jax.encoder.embed import run_in_batches
from anytouch_jax.errors import ConfigError, UserError
from anytouch_jax.nn.functional import Part, build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.weights.safetensors import read_safetensors, write_safetensors
from anytouch_jax.weights.tree import flatten, nest
from experiments.translation.networks import (
    Critic,
    FeatureField,
    Painter,
    PixelField,
    Translation,
    UNet,
    halved,
    thumbnail_side,
)

GENERATOR = "generator.safetensors"

Params = dict[str, Any]
# least, middle and most of a touch less its gel (`data.transforms.subtract_background`)
_GREY = (0, 128, 255)


@dataclass(frozen=True)
class Fit:
    """How a translation is trained.

    `adversarial`: weight of the critic's verdict added to the mean squared error, as a fraction of
    the error of copying the mean target, so that it means the same in every unit; 0 for no critic.
    `penalty`: on the critic's slope at real touches (R1, on features), which keeps the two in step.
    `tune` fine also trains the encoders, at a tenth of the rate.
    """

    steps: Count[int] = 800
    batch: Count[int] = 32
    learning_rate: Above0[float] = 1e-3
    tune: Literal["frozen", "fine"] = "frozen"
    adversarial: NotNegative[float] = 0.02
    penalty: NotNegative[float] = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Design:
    """What a generator is: sensors, shapes, where its encoder came from (None: it reads pixels),
    how it was trained.

    `subtracts`: source images are background-subtracted.
    """

    source: str
    target: str
    shape: Translation
    encoder: str | None
    fit: Fit
    pairs: int = 0
    subtracts: bool = False

    @property
    def head(self) -> Part:
        """What makes the output of the features."""
        if self.encoder is None:
            return Part(PixelField if self.shape.field else UNet, self.shape)
        return Part(FeatureField if self.shape.field else Painter, self.shape)

    @property
    def critic(self) -> Part:
        """Return the network that distinguishes real touches from generated ones by an encoder's
        features.
        """
        return Part(Critic, self.shape)

    @property
    def has_critic(self) -> bool:
        """Images are judged by an encoder where the weight is not 0; fields and references
        never.
        """
        return self.encoder is not None and not self.shape.field and self.fit.adversarial > 0


def features(design: Design, encoder: Params | None, images: Array) -> Array:
    """What the head reads of source images u8 (B, H, W, 3): an encoder's tokens, or pixels; f32."""
    pixels = normalise_touch(images)
    if encoder is None:
        side = pixels.shape[1]
        times = side // thumbnail_side(side)
        if design.shape.field:
            return halved(pixels, times).reshape(len(pixels), -1)
        return pixels
    return encoded(design, encoder, pixels, design.source, design.shape.states)


def encoded(design: Design, encoder: Params, pixels: Array, sensor: str, states: int = 1) -> Array:
    """Tokens f32 (B, 1 + S + N, states * D) of normalised images, with those of `sensor`, or the
    universal ones.
    """
    model = design.shape.model
    row = model.sensors.index(sensor) if sensor in model.sensors else model.universal_row
    rows = jnp.full(len(pixels), row, jnp.int32)
    hidden: Array = build(model).bind(encoder).touch.states(pixels[:, None], rows, states)
    return hidden.astype(jnp.float32)


def judged(design: Design, encoder: Params, pixels: Array, gel: Array | None) -> Array:
    """What a critic reads of normalised images of the target: class token and mean of the patch
    tokens (B, 2 D).

    `gel`: the target's untouched gel, alike, which is taken off for an encoder that `subtracts`.
    """
    if gel is not None:
        grey = (
            np.array(_GREY)[:, None, None, None, None] / 255 - np.array(IMAGENET_MEAN)
        ) / np.array(IMAGENET_STD)
        low, middle, high = grey.astype(np.float32)  # (1, 1, 1, 3)
        pixels = jnp.clip(pixels - gel[None] + middle, low, high)
    hidden = encoded(design, encoder, pixels, design.target)
    return jnp.concatenate([hidden[:, 0], hidden[:, design.shape.special :].mean(1)], axis=-1)


def predict(design: Design, params: Params, x: Array) -> Array:
    """The normalised target f32 from features: the mean target plus the head's answer in units of
    its spread.
    """
    fixed = params["fixed"]
    wide = lambda value, to: jnp.expand_dims(value, range(to.ndim - value.ndim))  # noqa: E731
    x = x - wide(fixed["mean"], x)
    x = x @ fixed["whiten"] if "whiten" in fixed else x / wide(fixed["scale"], x)
    out = design.head.apply(params["head"], x).astype(jnp.float32)
    return fixed["target"][None] + out * wide(fixed["spread"], out)


def units(design: Design, fixed: Params) -> tuple[np.ndarray, np.ndarray]:
    """Mean and scale (channels,) by which targets are normalised: ImageNet's on 0..255, or the
    training fields' own.
    """
    if not design.shape.field:
        return 255 * np.asarray(IMAGENET_MEAN, np.float32), 255 * np.asarray(
            IMAGENET_STD, np.float32
        )
    return np.asarray(fixed["unit_mean"]), np.asarray(fixed["unit_scale"])


@dataclass(frozen=True)
class Generator:
    """A trained translation: called on images u8 (n, H, W, 3) of the source sensor, at the model's
    size, it gives the target's images u8 (n, H, W, 3), or fields f32 (n, 20, 20, 6) in mm and N.
    """

    design: Design
    params: Params = field(repr=False)

    def __call__(self, images: np.ndarray) -> np.ndarray:
        mean, scale = units(self.design, self.params["fixed"])
        out = self.normalised(images) * scale + mean
        if self.design.shape.field:
            return out
        return np.rint(np.clip(out, 0, 255)).astype(np.uint8)

    def normalised(self, images: np.ndarray) -> np.ndarray:
        """The prediction f32 in the normalised units of the error.

        Raises UserError for images of another shape.
        """
        side = self.design.shape.model.image_size
        if images.dtype != np.uint8 or images.shape[1:] != (side, side, 3):
            raise UserError(
                f"images must be uint8 RGB of {side} x {side} pixels, not {images.dtype} "
                f"{images.shape}; data.transforms.touch_evaluation resizes them"
            )
        return run_in_batches(partial(_program(nameless(self.design)), self.params), images)

    def from_features(self, x: np.ndarray) -> np.ndarray:
        """The prediction f32 in the normalised units of the error, from what `features` gave."""
        return run_in_batches(partial(_heads(nameless(self.design)), self.params), x)


def nameless(design: Design) -> Design:
    """The design without what does not change its programs, so that these are compiled once."""
    name = None if design.encoder is None else "encoder"
    return replace(
        design,
        encoder=name,
        fit=Fit(tune=design.fit.tune, adversarial=float(design.has_critic)),
        pairs=0,
    )


@lru_cache(maxsize=8)
def _program(design: Design) -> Any:
    def run(params: Params, images: Array) -> Array:
        return predict(design, params, features(design, params.get("encoder"), images))

    return jax.jit(run)


@lru_cache(maxsize=8)
def _heads(design: Design) -> Any:
    return jax.jit(lambda params, x: predict(design, params, x))


def save(generator: Generator, folder: str | Path) -> Path:
    """Write a generator into `folder`, whole or not at all: one safetensors file, its design as
    JSON in the header.
    """
    path = Path(folder) / GENERATOR
    arrays = {name: np.asarray(value) for name, value in flatten(generator.params).items()}
    write_safetensors(path, arrays, {"generator": to_json(generator.design)})
    return path


def load(folder: str | Path) -> Generator:
    """The generator in a folder (or file).

    Raises UserError when there is none, or another kind of file.
    """
    path = Path(folder)
    path = path / GENERATOR if path.is_dir() else path
    if not path.is_file():
        others = sorted(file.parent.name for file in path.parent.glob(f"*/{GENERATOR}"))
        there = f" (there are {', '.join(others)})" if others else ""
        raise UserError(
            f"there is no generator in {folder}{there}; train one with python -m "
            "experiments.translation.run --fit"
        )
    arrays, about = read_safetensors(path)
    try:
        design: Design = from_json(about["generator"], Design)
    except (KeyError, ConfigError) as error:
        raise UserError(
            f"{path} holds no generator that this version can read ({error}); train it again"
        ) from None
    return Generator(design, nest(arrays))
