"""The settings of the network: sizes of its stacks, what it is built of, the table of sensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from anytouch_jax.strict_json import ABOVE_0, COUNT, NOT_NEGATIVE, ConfigError, in_range

UNIVERSAL = "universal"
SENSORS = (
    "gelsight", "digit", "gelslim", "gelsight_mini", "duragel", "9dtact", "allsight", "tacto", "taxim", UNIVERSAL,
)  # fmt: skip
FIELD_SENSORS = ("tac3d",)  # force fields, not images: left out of training


@dataclass(frozen=True)
class Stack:
    """A stack of transformer blocks: `width` channels, `depth` blocks, `heads`, `mlp` hidden channels."""

    width: int
    depth: int
    heads: int
    mlp: int

    def __post_init__(self) -> None:
        in_range("", self, width=COUNT, depth=NOT_NEGATIVE, heads=COUNT, mlp=COUNT)
        if self.width % self.heads:
            raise ConfigError(f"width {self.width} must be a multiple of heads {self.heads}")


@dataclass(frozen=True)
class TextTower:
    """CLIP's text tower. `end_token` None pools at the largest id (CLIP), else at its first occurrence."""

    stack: Stack
    vocab: int = 49408
    length: int = 77
    end_token: int | None = None

    def __post_init__(self) -> None:
        in_range("--model.text.", self, vocab=COUNT, length=COUNT)


@dataclass(frozen=True)
class Model:
    """Everything that decides the shapes and the arithmetic of the network.

    `image` and `text` None leave the towers out (stage 1); `lora_rank` 0: no LoRA. `sensors` names the rows of sensor
    tokens (Sec. 3.5) and of patch encoders if each has its own (T3); row "universal" serves sensors never seen.
    `match_head` "cosine" is ours, see `ops.losses.contrast_loss`. `embed`: values of an embedding; `frames` of a clip;
    `temperature` of InfoNCE at the start (it is learned); `attention`: "auto" is the fastest form on this machine, all
    give the same numbers (`nn/attention.py`); `remat`: activations are computed again instead of kept.
    """

    image_size: int
    patch: int
    embed: int
    touch: Stack
    decoder: Stack
    image: Stack | None = None
    text: TextTower | None = None
    frames: int = 3
    sensors: tuple[str, ...] = SENSORS
    sensor_tokens: int = 5
    activation: Literal["gelu", "quick_gelu"] = "gelu"
    norm_eps: float = 1e-5
    decoder_norm_eps: float = 1e-12
    decoder_sensor_tokens: bool = False
    patch_encoder: Literal["shared", "sensor"] = "shared"
    force_head: bool = False
    match_head: Literal["mlp", "linear", "cosine", "none"] = "none"
    lora_rank: int = 0
    lora_alpha: float = 16.0
    temperature: float = 0.07
    dtype: Literal["float32", "bfloat16", "float64"] = "float32"
    attention: Literal["auto", "xla", "mapped", "cudnn"] = "auto"
    remat: bool = False

    def __post_init__(self) -> None:
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
        if name not in self.sensors:
            known, table = ", ".join(self.sensors), " ".join(self.sensors)
            raise ConfigError(
                f"unknown sensor {name!r}; known: {known}. A new one is named with the others: "
                f"--model.sensors {name} {table}"
            )
        return self.sensors.index(name)
