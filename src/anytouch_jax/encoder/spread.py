"""Spread of features: are they nearly constant? Only numpy is imported, so that `anytouch info` answers at once."""

from __future__ import annotations

import numpy as np

SPREAD_ROWS, SPREAD_LEAST = 2000, 0.99  # rows that are compared, and the mean cosine of nearly constant features


def spread_lines(values: np.ndarray) -> list[str]:
    """Return a line with the mean cosine of pairs of features (n, d), and a warning if they are nearly constant.

    At most SPREAD_ROWS rows, evenly spaced, are compared. Fewer than two give no line.
    """
    rows = np.asarray(values[np.linspace(0, len(values) - 1, min(len(values), SPREAD_ROWS)).astype(int)], np.float64)
    if len(rows) < 2 or not np.isfinite(rows).all():
        return []
    unit = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    count = len(unit)
    cosine = (np.square(unit.sum(axis=0)).sum() - np.square(unit).sum()) / (count * (count - 1))
    lines = [f"spread: the mean cosine of two features is {cosine:.4f}"]
    if cosine > SPREAD_LEAST:
        lines.append(
            f"The features are nearly constant: a mean cosine above {SPREAD_LEAST} cannot distinguish touches. "
            "Train longer, and check background subtraction and that the frames differ."
        )
    return lines
