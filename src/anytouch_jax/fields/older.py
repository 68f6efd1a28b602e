"""Weights of decoders that predicted depth itself, as those that integrate its gradient."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from anytouch_jax.fields.outputs import DIFFERENCE

Array = npt.NDArray[np.float32]


def with_gradient(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return arrays of a model by name, with those that its decoder of fields lacks.

    Depth was linear in the last features. So its differences are a convolution of them, their
    integral is the same depth, and the constant is that of the depth at the border.
    """
    if "fields/maps/kernel" not in arrays or "fields/slope/kernel" in arrays:
        return dict(arrays)
    depth = arrays["fields/maps/kernel"][:, 0] / DIFFERENCE
    width = len(depth)
    # Rows, columns, inputs and outputs of a window of 3 x 3 pixels.
    kernel = np.zeros((3, 3, width, 4), np.float32)
    kernel[1, 1, :, :2] = -depth[:, None]
    kernel[1, 2, :, 0] = depth
    kernel[2, 1, :, 1] = depth
    return dict(arrays) | {
        "fields/slope/kernel": kernel.reshape(-1, 4),
        "fields/slope/bias": np.zeros(4, np.float32),
        "fields/press/up/kernel": np.zeros((width + 1, width), np.float32),
        "fields/press/up/bias": np.zeros(width, np.float32),
        "fields/press/down/kernel": np.zeros((width, 2), np.float32),
        "fields/press/down/bias": np.zeros(2, np.float32),
    }
