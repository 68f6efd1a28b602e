"""Settings of the network: sizes of its stacks, its parts, the table of sensors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

from anytouch_jax.config.parsing import Above0, Finite, NotNegative, Range, check
from anytouch_jax.errors import ConfigError, edit_distance
from anytouch_jax.sensors import RECORDS
from anytouch_jax.shown import shown_short

UNIVERSAL = "universal"
# Stored weights count on the order of the rows: gelsight to duragel are those of the release.
SENSORS = (*(name for name, record in RECORDS.items() if record.has_tokens), UNIVERSAL)
_MOST = 1 << 20  # of every size: a damaged configuration must not ask for the whole memory
Size = Annotated[int, Range(1, _MOST, f"1 to {_MOST}")]
Number = Annotated[int, Range(0, _MOST, f"0 to {_MOST}")]
# force fields, not images: left out of training
FIELD_SENSORS = tuple(name for name, record in RECORDS.items() if record.measures == "field")
OWN_SENSOR = ".sensor"  # ending of a folder of `anytouch sensor fit`
# sensors without tokens whose names are nearly those of others
OTHER_SENSORS = tuple(
    name for name, record in RECORDS.items() if record.measures == "image" and not record.has_tokens
)
_LETTERS = 2  # by which a misspelt name differs from the right one


class SpellingError(ConfigError):
    """A sensor name that is nearly a known one."""


def check_spelling(name: str, known: Iterable[str] = ()) -> None:
    """Raise SpellingError for a name within two letters of a known one.

    Without this a misspelt sensor gets tokens of its own and trains them on what belongs to
    another. Case, - and blanks do not count as letters. Known are SENSORS, FIELD_SENSORS and
    `known`. A name with more digits, such as digit_2, is a new one. So are OTHER_SENSORS.
    """

    def plain(sensor: str) -> str:
        return sensor.lower().replace("-", "_").replace(" ", "_")

    def digits(sensor: str) -> int:
        return sum(map(str.isdecimal, sensor))

    names = {*known, *FIELD_SENSORS, *SENSORS}
    word = plain(name)
    if name in names or word in OTHER_SENSORS:
        return
    # Words of other lengths are further apart: the distance is the slow part.
    alike = [sensor for sensor in sorted(names) if abs(len(sensor) - len(name)) <= _LETTERS]
    distances = [(edit_distance(word, plain(one)), one) for one in alike]
    apart, nearest = min(distances, default=(_LETTERS + 1, ""))
    if apart <= _LETTERS and digits(word) <= digits(nearest):
        raise SpellingError(
            f"sensor {name!r} is not known: did you mean {nearest}? The name of a new sensor "
            f"differs from it by more than {_LETTERS} letters"
        )


@shown_short
@dataclass(frozen=True)
class Stack:
    """A stack of transformer blocks."""

    width: Size  # Channels.
    depth: Annotated[int, Range(0, 1024, "0 to 1024")]  # Blocks.
    heads: Size  # Attention heads.
    mlp: Size  # Hidden channels of the MLP in a block.

    def __post_init__(self) -> None:
        check(self)
        if self.width % self.heads:
            raise ConfigError(f"width {self.width} must be a multiple of heads {self.heads}")


@shown_short
@dataclass(frozen=True)
class TextTower:
    """CLIP's text tower."""

    stack: Stack
    vocab: Size = 49408  # Tokens of the vocabulary.
    length: Size = 77  # Tokens of a caption, with start and end.
    # Token to pool, at its first position. None pools the largest id (CLIP).
    end_token: NotNegative[int | None] = None

    def __post_init__(self) -> None:
        check(self, "--model.text.")


@shown_short
@dataclass(frozen=True)
class ModelConfig:
    """All shapes and arithmetic of the network.

    `sensors` names the rows of the sensor tokens, and of the patch encoders too in T3.
    """

    image_size: Size  # Side of an image, pixels.
    patch: Size  # Side of a patch, pixels.
    embed: Size  # Values of an embedding.
    touch: Stack  # Touch encoder.
    decoder: Stack  # Decoder of stage 1.
    image: Stack | None = None  # Image tower. Stage 1 has none.
    text: TextTower | None = None  # Text tower. Stage 1 has none.
    frames: Size = 3  # Frames of a clip.
    # Sensors with tokens. "universal" serves all other sensors.
    sensors: tuple[str, ...] = SENSORS
    sensor_tokens: Number = 5  # Tokens of each sensor.
    # Activation of the encoders. OpenAI CLIP needs quick_gelu.
    activation: Literal["gelu", "quick_gelu"] = "gelu"
    norm_eps: NotNegative[float] = 1e-5  # Epsilon of layer norms.
    # Layer norm before the blocks of the touch encoder (CLIP). DINOv2 and MAE have none.
    pre_norm: bool = True
    decoder_norm_eps: NotNegative[float] = 1e-12  # Epsilon of the decoder's layer norms.
    # Give the decoder the sensor tokens before encoding (release).
    decoder_sensor_tokens: bool = False
    patch_encoder: Literal["shared", "sensor"] = "shared"  # One, or one a sensor (T3).
    # Values of the convolutional trunk that join the features of touch. 0: no trunk.
    sight: Number = 0
    fields: Number = 0  # Channels of the decoder of depth, shear, contact and force. 0: none.
    # linear is the release, cosine is ours.
    match_head: Literal["mlp", "linear", "cosine", "none"] = "none"
    lora_rank: Number = 0  # Rank of the image tower's LoRA. 0: off.
    lora_alpha: Finite[float] = 16.0  # Scale of LoRA, divided by its rank.
    temperature: Above0[float] = 0.07  # Temperature of InfoNCE at the start. It is learned.
    # Type of the arithmetic. Parameters are float32.
    dtype: Literal["float32", "bfloat16", "float64"] = "float32"
    # Implementation. auto takes the fastest here.
    attention: Literal["auto", "xla", "mapped", "cudnn"] = "auto"
    remat: bool = False  # Recompute activations in the backward pass. Saves memory, takes time.

    def __post_init__(self) -> None:
        check(self, "--model.")
        if self.decoder.width % 4:
            raise ConfigError(
                "--model.decoder.width must be a multiple of 4 (sines and cosines of rows and "
                f"columns), not {self.decoder.width}"
            )
        if self.image_size % self.patch:
            raise ConfigError(
                f"image_size {self.image_size} must be a multiple of patch {self.patch}"
            )
        if len(set(self.sensors)) != len(self.sensors):
            raise ConfigError(f"a sensor is named twice in {self.sensors}")
        if UNIVERSAL not in self.sensors:
            raise ConfigError(f"the sensor table needs a row named {UNIVERSAL!r}")

    @property
    def patches(self) -> int:
        """The number of patch positions N = (image_size / patch)^2."""
        return (self.image_size // self.patch) ** 2

    @property
    def universal_row(self) -> int:
        """The row of the universal sensor tokens."""
        return self.sensors.index(UNIVERSAL)

    def sensor_row(self, name: str) -> int:
        """Return the row of a sensor. Raises ConfigError if the table does not have it."""
        if name in FIELD_SENSORS:
            raise ConfigError(
                f"sensor {name!r} measures a force field and has no images. Leave it out of "
                "training."
            )
        check_spelling(name, self.sensors)
        if name not in self.sensors:
            raise ConfigError(
                f"unknown sensor {name!r}. Choose one of {', '.join(self.sensors)}, or add it by "
                f"--model.sensors {name} {' '.join(self.sensors)}"
            )
        return self.sensors.index(name)
