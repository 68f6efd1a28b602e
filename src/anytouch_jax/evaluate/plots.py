"""Charts as PNG files, written atomically: losses, t-SNE, sample grids, bars with intervals, Pareto fronts."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = npt.NDArray[Any]
TERMS = ("reconstruction", "next_frame", "align", "match")  # the terms of a loss that get a curve
_DPI = 110
_LEGEND = 12  # more names than that are colours without a legend


class ShareBar(NamedTuple):
    """A share (0..1) with its interval and the chance level; None is not drawn."""

    value: float
    low: float | None = None
    high: float | None = None
    chance: float | None = None


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure as PNG; the same figure gives the same bytes. Raises OSError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)  # without pyplot: no global state, no display
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=_DPI, metadata={"Software": None})
    atomic_write(path, data.getvalue())


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Return the lines of metrics.jsonl of a run folder, or of the file. Raises UserError if there are none."""
    file = run / "metrics.jsonl" if run.is_dir() else run
    try:
        lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise UserError(f"{file} is not a metrics.jsonl of a run ({error}); give a run folder") from None
    if not lines:
        raise UserError(f"{file} has no step yet; train first")
    return lines


def loss_curves(path: Path, runs: Mapping[str, Path]) -> None:
    """Draw loss against step, a panel for each run {title: run folder or metrics.jsonl}, raw and smoothed."""
    figure, axes = _panels(1, len(runs), 5.0, 3.4)
    for axis, (title, run) in zip(axes[0], runs.items(), strict=True):
        lines = read_metrics(Path(run))
        names = [name for name in TERMS if any(name in line for line in lines)]
        for colour, name in enumerate(names if len(names) else ["loss"]):
            points = [(line["step"], line[name]) for line in lines if line.get(name) is not None]
            steps, values = np.array(points, np.float64).T if points else np.zeros((2, 0))
            axis.plot(steps, values, color=f"C{colour}", alpha=0.25, linewidth=0.8)
            axis.plot(steps, smoothed(values), color=f"C{colour}", linewidth=1.6, label=name.replace("_", " "))
        axis.set(title=title, xlabel="step", ylabel="loss term")
        axis.set_ylim(bottom=0)
        axis.legend(frameon=False)
        axis.grid(alpha=0.25)
    write_figure(path, figure)


def smoothed(values: Array) -> Array:
    """Return the running mean over a twentieth of the values; windows are cut at both ends."""
    width = max(1, len(values) // 20)
    if width == 1:
        return np.asarray(values)
    kernel = np.ones(width)
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")


def tsne_panels(path: Path, spaces: Mapping[str, Array], sensors: Any, objects: Any) -> None:
    """Draw points (n, 2) of each named space, coloured by sensor above and by object below."""
    figure, axes = _panels(2, len(spaces), 4.0, 3.8)
    for labels, what, row in ((sensors, "sensor", axes[0]), (objects, "object", axes[1])):
        names, codes = np.unique(np.asarray(labels).astype(str), return_inverse=True)
        colours = _colours(len(names))
        for axis, (title, points) in zip(row, spaces.items(), strict=True):
            axis.scatter(points[:, 0], points[:, 1], s=9, c=colours[codes], linewidths=0)
            axis.set(title=f"{title}, by {what}", xticks=[], yticks=[])
        if len(names) <= _LEGEND:
            marks = [row[-1].scatter([], [], s=20, color=colours[i]) for i in range(len(names))]
            row[-1].legend(marks, names, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        else:
            row[-1].set_xlabel(f"{len(names)} {what}s", loc="right")
    write_figure(path, figure)


def sample_grid(
    path: Path, images: Sequence[Sequence[Array | None]], rows: Sequence[str], columns: Sequence[str]
) -> None:
    """Draw a grid of pictures RGB u8 (h, w, 3), or fields (h, w) as colour maps; None is an empty cell."""
    figure, axes = _panels(len(rows), len(columns), 1.75, 1.6)
    for i, (line, title) in enumerate(zip(images, rows, strict=True)):
        for j, (image, column) in enumerate(zip(line, columns, strict=True)):
            axis = axes[i][j]
            axis.set(xticks=[], yticks=[])
            if image is None:
                axis.set_facecolor("#f2f2f2")
                axis.text(0.5, 0.5, "none", ha="center", va="center", color="#999999", transform=axis.transAxes)
            else:
                axis.imshow(image, cmap="viridis", aspect="equal")
            for side in axis.spines.values():
                side.set_visible(False)
            if i == 0:
                axis.set_title(column, fontsize=9)
            if j == 0:
                axis.set_ylabel(title, fontsize=8)
    write_figure(path, figure)


def bars(path: Path, series: Mapping[str, Mapping[str, ShareBar]], *, label: str = "share") -> None:
    """Draw horizontal bars of shares with their intervals, {panel: {name: ShareBar}}; dashes mark chance."""
    longest = max(len(one) for one in series.values())
    figure, axes = _panels(1, len(series), 4.2, 0.9 + 0.34 * longest, sharex=True, sharey=True)
    names = list(dict.fromkeys(name for one in series.values() for name in one))
    for axis, (title, values) in zip(axes[0], series.items(), strict=True):
        for name, bar in values.items():
            place = names.index(name)
            axis.barh(place, 100 * bar.value, color=f"C{place % 10}", alpha=0.85, height=0.7)
            if bar.low is not None and bar.high is not None:
                axis.plot([100 * bar.low, 100 * bar.high], [place, place], color="#222222", linewidth=1.4)
            if bar.chance is not None:
                axis.plot([100 * bar.chance] * 2, [place - 0.45, place + 0.45], "--", color="#222222", linewidth=1)
        axis.set(title=title, xlabel=f"{label}, % (95 % interval)", xlim=(0, None))
        axis.set_yticks(range(len(names)), names)
        axis.grid(axis="x", alpha=0.25)
    axes[0][0].invert_yaxis()
    write_figure(path, figure)


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
    figure, axes = _panels(1, 1, 7.6, 4.4)
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


def _panels(rows: int, columns: int, width: float, height: float, **options: Any) -> tuple[Figure, list[list[Axes]]]:
    from matplotlib.figure import Figure

    if not rows or not columns:
        raise UserError("there is nothing to draw")
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options).tolist()


def _colours(count: int) -> Array:
    """Return RGB colours (count, 3): ten distinct ones, or hues in an order that separates neighbours."""
    from matplotlib import colormaps

    if count <= 10:
        return np.asarray(colormaps["tab10"].colors)[:count]  # type: ignore[attr-defined]
    return np.asarray(colormaps["hsv"](np.arange(count) * 0.618 % 1.0))[:, :3] * 0.85
