"""Augmentation of touch images: one table for its numpy form and its JAX form.

Real recordings are augmented by numpy and OpenCV in the loader's threads (`data.transforms`). Next
to simulated touches they are on the device, and so is their augmentation (`sim.preparation`). Both
mirror, turn, shift and zoom by the same settings, and a test compares them on the same draws. They
differ where the table says so.
"""

from __future__ import annotations

from typing import NamedTuple

from anytouch_jax.config.train import DataConfig


class TouchAugmentation(NamedTuple):
    """What changes a touch image at random, with one draw for all frames of a clip."""

    # Both forms, by --data.flip and --data.affine.
    flip: float  # probability of a mirror image, for each direction
    turn: float  # degrees, at most, to both sides
    shift: float  # of the side, at most, to both sides
    zoom: float  # a factor of at most 1 + this, or of its inverse

    # numpy only, by --data.jitter: colours change as in the release, about the mean of an image.
    jitter: tuple[float, float, float, float]  # brightness, contrast, saturation, hue

    # JAX only. Simulated cameras have any proportions, and real ones are stretched likewise.
    stretch: float = 1.25  # largest height over width, or its inverse
    # Colours change about the grey of the untouched gel, because the background may be subtracted:
    # factors of normal logarithm, and a shift.
    brightness: float = 0.15  # standard deviation of the logarithm
    colour: float = 0.08  # the same, for each colour
    level: float = 3.0  # standard deviation of the shift of each colour, grey levels

    @classmethod
    def of(cls, data: DataConfig) -> TouchAugmentation:
        """Return the augmentation of a run."""
        return cls(data.flip, *data.affine, jitter=data.jitter)
