"""Batches that travel from the loader to the device: NamedTuples of arrays.

The shape is the data type: T is 1 for stills, 3 for clips, 4 for clips with their next frame.
Pixels are uint8, channel last (RGB); normalisation happens on the device. B batch, V image slots, L
text slots, S text length.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from anytouch_jax.shown import shown_short

Array = Any  # a numpy or a jax array


@shown_short
class FieldBatch(NamedTuple):
    """Touches with exact fields of their last frame (h, w), free of scale as the head's outputs.

    `clip` u8 (B, T, H, W, 3), `sensor` i32 (B,), `aspect` f32 (B,) logarithm of height over width.
    `depth` (B, h, w) and `shear` (B, h, w, 2) are shares of the picture's width, `pressure` (B, h,
    w) is over the gel's modulus. `force` (B, 3), tangential x and y and normal, is over modulus
    times width squared, `torque` (B,) over modulus times width cubed. `slip` (B,) is the share of
    the contact that slides.
    """

    clip: Array
    sensor: Array
    aspect: Array
    depth: Array
    shear: Array
    pressure: Array
    force: Array
    torque: Array
    slip: Array


class FieldOutput(NamedTuple):
    """What the head of fields predicts (B, h, w) at half the picture's resolution, free of scale.

    `*_log` are logarithms of Laplace deviations.

    `depth`, `shear` (..., 2) along x and y of the picture, `pressure` over the gel's modulus.
    `contact` are logits. `force` (B, 3): tangential x and y and normal, over modulus times width
    squared. `torque` (B,) over modulus times width cubed. `slip` (B,) logits of the fraction of the
    contact that slides.
    """

    depth: Array
    shear: Array
    contact: Array
    pressure: Array
    depth_log: Array
    shear_log: Array
    force: Array
    torque: Array
    slip: Array
    force_log: Array  # (B, 2): tangential, and of the logarithm of the normal force
    torque_log: Array
    slip_log: Array


@shown_short
class TouchBatch(NamedTuple):
    """Stage 1: `clip` u8 (B, T, H, W, 3), `sensor` i32 (B,) rows of the sensor table, touches with
    fields or None.
    """

    clip: Array
    sensor: Array
    fields: FieldBatch | None = None


@shown_short
class AlignBatch(NamedTuple):
    """Stage 2, alignment. Images and texts are packed into V and L slots; an unused slot has row B.

    `clip` u8 (B, T, H, W, 3), `sensor` i32 (B,), `image` u8 (V, H, W, 3), `text` i32 (L, S).
    `text_mask` bool (L, S) is True for tokens. `image_row` i32 (V,) and `text_row` i32 (L,) are the
    rows of the batch that the slots belong to.
    """

    clip: Array
    sensor: Array
    image: Array
    image_row: Array
    text: Array
    text_mask: Array
    text_row: Array


@shown_short
class MatchBatch(NamedTuple):
    """Stage 2, matching triples: three times (clip u8 (B, T, H, W, 3), sensor i32 (B,)).

    If the other pairs of the batch are the negatives, there is no third touch. Then `place` i32
    (B,) is equal for pairs of one place, which are not negatives of each other.
    """

    clip: Array
    sensor: Array
    positive: Array
    positive_sensor: Array
    negative: Array = None
    negative_sensor: Array = None
    place: Array = None


@shown_short
class Stage2Batch(NamedTuple):
    """One stage-2 step: both parts (recipe paper) or one of them (recipe release), and touches with
    fields or None.
    """

    align: AlignBatch | None
    match: MatchBatch | None
    fields: FieldBatch | None = None


class BatchSource(Protocol):
    """Batches of a run: `data.loading.loader.Loader`, or a row of `doors.BATCHES`.

    The batch of a step depends on the seed and the step alone, so that a run that continues gets
    what it would have got. `notes` are sentences for the user.
    """

    notes: list[str]

    @property
    def steps_per_epoch(self) -> int:
        """Steps until every sample was drawn once."""

    @property
    def trained_sensors(self) -> list[str]:
        """Names of the sensors that batches are drawn from."""

    @property
    def examples(self) -> Sequence[tuple[Any, Callable[[], Any]]]:
        """A batch of each structure, as shapes and a function that makes it.

        Their steps are compiled side by side. Empty: each is compiled when it comes.
        """

    def stream(
        self, start: int, stop: int
    ) -> Iterator[tuple[int, TouchBatch | Stage2Batch, Mapping[str, Any]]]:
        """Yield (step, batch, numbers for the log) for steps start .. stop - 1."""
