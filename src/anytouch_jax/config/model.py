"""The settings of the network: sizes of its stacks, what it is built of, the table of sensors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from anytouch_jax.config.parsing import ABOVE_0, COUNT, NOT_NEGATIVE, chosen, in_range
from anytouch_jax.errors import ConfigError

UNIVERSAL = "universal"
SENSORS = (
    "gelsight", "digit", "gelslim", "gelsight_mini", "duragel", "9dtact", "allsight", "tacto", "taxim", UNIVERSAL,
)  # fmt: skip
STEM = (24, 64)  # channels of the convolutions of patch_encoder "convolutional"
FIELD_SENSORS = ("tac3d",)  # force fields, not images: left out of training


class SpellingError(ConfigError):
    """The name of a known sensor, spelled otherwise."""


def check_spelling(name: str, known: Iterable[str] = ()) -> None:
    """Raise SpellingError for a name that differs from a known one (SENSORS, FIELD_SENSORS, `known`) by case, or - or a
    blank for _, alone."""
    names = {one: _plain(one) for one in (*SENSORS, *FIELD_SENSORS, *known)}
    right = next((one for one, plain in names.items() if plain == _plain(name)), None)
    if name not in names and right is not None:
        raise SpellingError(f"sensor {name!r}: it is called {right}")


def _plain(name: str) -> str:
    return name.lower().replace("-", "_").replace(" ", "_")


@dataclass(frozen=True)
class Stack:
    """A stack of transformer blocks."""

    width: int  # channels
    depth: int  # blocks
    heads: int  # of attention
    mlp: int  # hidden channels of a block

    def __post_init__(self) -> None:
        in_range("", self, width=COUNT, depth=NOT_NEGATIVE, heads=COUNT, mlp=COUNT)
        if self.width % self.heads:
            raise ConfigError(f"width {self.width} must be a multiple of heads {self.heads}")


@dataclass(frozen=True)
class TextTower:
    """CLIP's text tower."""

    stack: Stack
    vocab: int = 49408  # tokens
    length: int = 77  # of a caption in tokens, with its ends
    end_token: int | None = None  # whose first occurrence is pooled; None: that of the largest id (CLIP)

    def __post_init__(self) -> None:
        in_range("--model.text.", self, vocab=COUNT, length=COUNT)


@dataclass(frozen=True)
class ModelConfig:
    """Everything that decides the shapes and the arithmetic of the network.

    `sensors` names the rows of sensor tokens (Sec. 3.5), and of patch encoders if each has its own (T3).
    """

    image_size: int  # pixels of a side
    patch: int  # pixels of a patch's side
    embed: int  # values of an embedding
    touch: Stack  # touch encoder
    decoder: Stack  # decoder of stage 1
    image: Stack | None = None  # image tower; None: none (stage 1)
    text: TextTower | None = None  # text tower; None: none (stage 1)
    frames: int = 3  # of a clip
    sensors: tuple[str, ...] = SENSORS  # names; "universal" serves those never seen
    sensor_tokens: int = 5  # of each sensor
    activation: Literal["gelu", "quick_gelu"] = "gelu"  # of the encoders; CLIP's own weights want quick_gelu
    norm_eps: float = 1e-5  # of layer norms
    decoder_norm_eps: float = 1e-12  # of the decoder's
    decoder_sensor_tokens: bool = False  # the decoder gets the sensor tokens themselves, not as encoded
    patch_encoder: Literal["shared", "sensor", "convolutional"] = "shared"  # one; one a sensor (T3); small CNN (ours)
    match_head: Literal["mlp", "linear", "cosine", "none"] = "none"  # cosine is ours: `ops.losses.contrast_loss`
    lora_rank: int = 0  # of the image tower's LoRA; 0: none
    lora_alpha: float = 16.0  # LoRA's scale, over its rank
    temperature: float = 0.07  # of InfoNCE at the start; it is learned
    dtype: Literal["float32", "bfloat16", "float64"] = "float32"  # of the arithmetic; parameters are float32
    attention: Literal["auto", "xla", "mapped", "cudnn"] = "auto"  # forms of one sum; auto: the fastest here
    remat: bool = False  # activations are computed again, not kept: less memory, slower

    def __post_init__(self) -> None:
        chosen("--model.", self)
        in_range("--model.", self, image_size=COUNT, patch=COUNT, embed=COUNT, frames=COUNT, temperature=ABOVE_0)
        in_range("--model.", self, sensor_tokens=NOT_NEGATIVE, lora_rank=NOT_NEGATIVE)
        in_range("--model.", self, norm_eps=NOT_NEGATIVE, decoder_norm_eps=NOT_NEGATIVE)
        if self.decoder.width % 4:
            raise ConfigError(
                f"--model.decoder.width must be a multiple of 4 (sines and cosines of rows and columns), "
                f"not {self.decoder.width}"
            )
        if self.image_size % self.patch:
            raise ConfigError(f"image_size {self.image_size} must be a multiple of patch {self.patch}")
        if len(set(self.sensors)) != len(self.sensors):
            raise ConfigError(f"a sensor is named twice in {self.sensors}")
        if UNIVERSAL not in self.sensors:
            raise ConfigError(f"the sensor table needs a row named {UNIVERSAL!r}")

    @property
    def patches(self) -> int:
        """Number of patch positions N = (image_size / patch)^2."""
        return (self.image_size // self.patch) ** 2

    @property
    def universal_row(self) -> int:
        """Row of the universal sensor tokens."""
        return self.sensors.index(UNIVERSAL)

    def sensor_row(self, name: str) -> int:
        """Row of the sensor called `name`. Raises ConfigError when the table does not have it."""
        if name in FIELD_SENSORS:
            raise ConfigError(f"sensor {name!r} measures a force field and has no images; leave it out of training")
        check_spelling(name, self.sensors)
        if name not in self.sensors:
            known, table = ", ".join(self.sensors), " ".join(self.sensors)
            raise ConfigError(
                f"unknown sensor {name!r}; known: {known}. A new one is named with the others: "
                f"--model.sensors {name} {table}"
            )
        return self.sensors.index(name)
