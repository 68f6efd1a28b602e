"""Batches that travel from the loader to the device: NamedTuples of arrays.

The shape is the data type: T is 1 for stills, 3 for clips, 4 for clips with their next frame.
Pixels are uint8, channel last (RGB), because a quarter of the bytes travel; normalisation happens
on the device. B batch, V image slots, L text slots, S text length.

A loader fills batches of numpy arrays, `TouchBatch[np.ndarray]`. A step sees the same batches with
jax arrays, `TouchBatch[jax.Array]`. Where they come from is a `BatchSource`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol, TypeVar

from anytouch_jax.shown import shown_short

if TYPE_CHECKING:  # this module loads no jax, so that workers which read files start fast
    import jax
    import numpy as np

A = TypeVar("A", bound="np.ndarray | jax.Array")


@shown_short
class FieldBatch(NamedTuple, Generic[A]):
    """Touches with exact fields of their last frame (h, w), free of scale.

    The units are those of the gel, so that one network serves sensors of any size and stiffness:
    lengths over the width of the image, pressure over the gel's modulus.

    Attributes:
        clip: u8 (B, T, H, W, 3).
        sensor: i32 (B,), rows of the sensor table.
        aspect: f32 (B,), logarithm of height over width of the image.
        depth: f32 (B, h, w), over the width.
        shear: f32 (B, h, w, 2), over the width.
        pressure: f32 (B, h, w), over the modulus.
        force: f32 (B, 3), tangential x and y and normal, over modulus times width squared.
        torque: f32 (B,), over modulus times width cubed.
        slip: f32 (B,), the fraction of the contact that slides.
    """

    clip: A
    sensor: A
    aspect: A
    depth: A
    shear: A
    pressure: A
    force: A
    torque: A
    slip: A


class FieldOutput(NamedTuple, Generic[A]):
    """Fields (B, h, w) at half the image's resolution, each with its deviation.

    Attributes:
        depth: over the width of the image.
        shear: (..., 2) along x and y of the image, over its width.
        contact: logits.
        pressure: over the gel's modulus.
        depth_log: logarithms of Laplace deviations of the depth, over LENGTH of
            `fields.outputs`.
        shear_log: those of the shear, over LENGTH.
        force: (B, 3), tangential x and y and normal, over modulus times width squared.
        torque: (B,), over modulus times width cubed.
        slip: (B,), logits of the fraction of the contact that slides.
        force_log: (B, 2), of the tangential force over FORCE, and of the logarithm of the normal
            force.
        torque_log: (B,), over TORQUE.
        slip_log: (B,).
    """

    depth: A
    shear: A
    contact: A
    pressure: A
    depth_log: A
    shear_log: A
    force: A
    torque: A
    slip: A
    force_log: A
    torque_log: A
    slip_log: A


@shown_short
class TouchBatch(NamedTuple, Generic[A]):
    """Stage 1.

    Attributes:
        clip: u8 (B, T, H, W, 3).
        sensor: i32 (B,), rows of the sensor table.
        fields: Touches with fields, or None.
    """

    clip: A
    sensor: A
    fields: FieldBatch[A] | None = None


@shown_short
class AlignBatch(NamedTuple, Generic[A]):
    """Stage 2, alignment. Images and texts are packed into V and L slots.

    V and L are fixed for a run, because each shape is compiled once. An unused slot has row B,
    which a scatter with `mode="drop"` drops. A row of -1 would overwrite the last one.

    Attributes:
        clip: u8 (B, T, H, W, 3).
        sensor: i32 (B,), rows of the sensor table.
        image: u8 (V, H, W, 3).
        image_row: i32 (V,), the row of the batch that each image belongs to.
        text: i32 (L, S), ids of tokens.
        text_mask: bool (L, S), true on tokens, false on padding.
        text_row: i32 (L,), the row of the batch that each text belongs to.
    """

    clip: A
    sensor: A
    image: A
    image_row: A
    text: A
    text_mask: A
    text_row: A


@shown_short
class MatchBatch(NamedTuple, Generic[A]):
    """Stage 2, matching: a touch, one of the same place by another sensor, and one of elsewhere.

    If the other pairs of the batch are the negatives, there is no third touch. Then `place` is
    equal for pairs of one place, which are not negatives of each other.

    Attributes:
        clip: u8 (B, T, H, W, 3), and `positive` and `negative` likewise.
        sensor: i32 (B,), and `positive_sensor` and `negative_sensor` likewise.
        place: i32 (B,), codes of places.
    """

    clip: A
    sensor: A
    positive: A
    positive_sensor: A
    negative: A | None = None
    negative_sensor: A | None = None
    place: A | None = None


@shown_short
class Stage2Batch(NamedTuple, Generic[A]):
    """One stage-2 step: both parts (recipe paper) or one of them (recipe release).

    Attributes:
        align: The rows of alignment, or None.
        match: The triples of matching, or None.
        fields: Touches with fields, or None.
    """

    align: AlignBatch[A] | None
    match: MatchBatch[A] | None
    fields: FieldBatch[A] | None = None


class BatchSource(Protocol):
    """Batches of a run: `data.loading.loader.Loader`, or what a row of `doors.BATCHES` names.

    The batch of a step depends on the seed and the step alone, so that a run that continues gets
    what it would have got.

    Attributes:
        notes: Sentences for the user.
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
    ) -> Iterator[tuple[int, TouchBatch[Any] | Stage2Batch[Any], Mapping[str, Any]]]:
        """Yield (step, batch, numbers for the log) for steps start .. stop - 1."""
