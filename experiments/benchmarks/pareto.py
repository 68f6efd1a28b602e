"""Pareto plots: time ratio against error, on logarithmic axes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.plots import panels, write_figure

Array = npt.NDArray[Any]


def pareto(
    path: Path, points: Mapping[str, tuple[float, float]], *, x: str = "time ratio", y: str = "error", title: str = ""
) -> None:
    """Draw named points (time ratio, error) on logarithmic axes, with the Pareto front.

    Raises UserError for a point that is not positive and finite.
    """
    values = np.array(list(points.values()), np.float64).reshape(-1, 2)
    bad = [name for name, point in points.items() if not all(np.isfinite(point)) or min(point) <= 0]
    if bad or not points:
        raise UserError(f"a point on logarithmic axes must be positive and finite: {', '.join(bad) or 'none is given'}")
    figure, axes = panels(1, 1, 7.6, 4.4)
    axis, best = axes[0][0], front(values)
    axis.set(xscale="log", yscale="log", xlabel=x, ylabel=y, title=title)
    axis.plot(values[best, 0], values[best, 1], drawstyle="steps-post", color="#999999", linewidth=1.2, zorder=1)
    for number, (name, (across, up)) in enumerate(points.items()):
        marker = "oXs^vD"[number // 10 % 6]  # ten colours, then another marker
        axis.scatter(across, up, s=26, color=f"C{number % 10}", marker=marker, label=name)
    axis.xaxis.set_major_formatter("{x:g}")
    wide = values.max(0) > 10 * values.min(0)  # then the numbers between powers of ten have no room
    axis.xaxis.set_minor_formatter("" if wide[0] else "{x:g}")
    if not wide[1]:
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
    axis.margins(x=0.1, y=0.1)
    axis.grid(alpha=0.25, which="both")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8)
    write_figure(path, figure)


def front(values: Array) -> Array:
    """Return the Pareto front: rows of (n, 2) that no other row beats or equals in both columns (smaller is better)."""
    order = np.lexsort((values[:, 1], values[:, 0]))
    second = values[order, 1]
    before = np.concatenate([[np.inf], np.minimum.accumulate(second)[:-1]])
    return order[second < before]
