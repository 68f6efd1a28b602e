"""Pictures of translations: input, output, truth and difference."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from anytouch_jax.evaluate.plots import sample_grid
from experiments.translation.generator import Generator

_Z = 2  # displacement along the normal, mm, the channel of a field that is drawn
_GAIN = 2.0  # by which the difference of images is enlarged


def picture_grid(path: Path, generator: Generator, images: np.ndarray, targets: np.ndarray, rows: int = 6) -> None:
    """A grid of `rows` pairs spread over those given: a PNG, four columns.

    Images: the difference is twice enlarged about grey. Fields: indentation, on one scale a row; the difference from
    blue (too little) through white to red. Raises OSError.
    """
    chosen = np.linspace(0, len(images) - 1, min(rows, len(images))).round().astype(int)
    given, truth = images[chosen], targets[chosen]
    made = generator(given)
    draw = _field_pictures if generator.design.shape.field else _image_pictures
    names = [f"pair {row}" for row in chosen]
    design = generator.design
    columns = (f"input: {design.source}", f"output: {design.target}", "truth", "output - truth")
    sample_grid(path, [[x, *draw(a, b)] for x, a, b in zip(given, made, truth, strict=True)], names, columns)


def _image_pictures(made: np.ndarray, truth: np.ndarray) -> list[np.ndarray]:
    away = _GAIN * (made.astype(np.float32) - truth) + 128
    return [made, truth, np.clip(away, 0, 255).astype(np.uint8)]


def _field_pictures(made: np.ndarray, truth: np.ndarray) -> list[np.ndarray]:
    from matplotlib import colormaps

    a, b = made[..., _Z], truth[..., _Z]
    low, high = float(b.min()), float(b.max())
    span = max(high - low, 1e-9)
    plain = [colormaps["viridis"](np.clip((one - low) / span, 0, 1)) for one in (a, b)]
    coloured = [*plain, colormaps["bwr"](np.clip((a - b) / span + 0.5, 0, 1))]
    return [np.rint(255 * one[..., :3]).astype(np.uint8) for one in coloured]
