"""Charts as PNG files (losses, t-SNE, sample grids, bars), and the geometry of a feature space."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from anytouch_jax.config import parse_json
from anytouch_jax.encoder.arrays import unit_rows
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.splits import subsample
from anytouch_jax.evaluate.statistics import Array
from anytouch_jax.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TERMS = ("reconstruction", "next_frame", "align", "match")  # the terms of a loss that get a curve
MOST = 4000  # rows that are compared in pairs
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
    """Return the lines of metrics.jsonl of a run folder, or of the file.

    Raises UserError if there are none.
    """
    file = run / "metrics.jsonl" if run.is_dir() else run
    try:
        lines = [parse_json(line) for line in file.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise UserError(
            f"{file} is not the metrics.jsonl of a run ({error}). Give a run folder."
        ) from None
    for number, line in enumerate(lines, 1):
        row = line if isinstance(line, dict) else {}
        values = [
            row.get("step"),
            *(row[name] for name in (*TERMS, "loss") if row.get(name) is not None),
        ]
        if not all(isinstance(value, int | float) for value in values):
            raise UserError(
                f"Line {number} of {file} has no step, or a loss that is not a number. Remove the "
                "line."
            )
    if not lines:
        raise UserError(f"{file} has no step yet. Train first.")
    return lines


def loss_curves(path: Path, runs: Mapping[str, Path]) -> None:
    """Draw loss against step, a panel for each run {title: run folder or metrics.jsonl}, raw and
    smoothed.
    """
    figure, axes = panels(1, len(runs), 5.0, 3.4)
    for axis, (title, run) in zip(axes[0], runs.items(), strict=True):
        lines = read_metrics(Path(run))
        names = [name for name in TERMS if any(name in line for line in lines)]
        for colour, name in enumerate(names if len(names) else ["loss"]):
            points = [(line["step"], line[name]) for line in lines if line.get(name) is not None]
            steps, values = np.array(points, np.float64).T if points else np.zeros((2, 0))
            axis.plot(steps, values, color=f"C{colour}", alpha=0.25, linewidth=0.8)
            axis.plot(
                steps,
                smoothed(values),
                color=f"C{colour}",
                linewidth=1.6,
                label=name.replace("_", " "),
            )
        axis.set(title=title, xlabel="step", ylabel="loss term")
        axis.locator_params(axis="x", integer=True)
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
    figure, axes = panels(2, len(spaces), 4.0, 3.8)
    for labels, what, row in ((sensors, "sensor", axes[0]), (objects, "object", axes[1])):
        names, codes = np.unique(np.asarray(labels).astype(str), return_inverse=True)
        colours = _colours(len(names))
        for axis, (title, points) in zip(row, spaces.items(), strict=True):
            axis.scatter(points[:, 0], points[:, 1], s=9, c=colours[codes], linewidths=0)
            axis.set(title=f"{title}, by {what}", xticks=[], yticks=[])
        if len(names) <= _LEGEND:
            marks = [row[-1].scatter([], [], s=20, color=colours[i]) for i in range(len(names))]
            row[-1].legend(
                marks, names, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False
            )
        else:
            row[-1].set_xlabel(f"{len(names)} {what}s", loc="right")
    write_figure(path, figure)


def sample_grid(
    path: Path,
    images: Sequence[Sequence[Array | None]],
    rows: Sequence[str],
    columns: Sequence[str],
) -> None:
    """Draw a grid of pictures RGB u8 (h, w, 3), or fields (h, w) as colour maps; None is an empty
    cell.
    """
    figure, axes = panels(len(rows), len(columns), 1.75, 1.6)
    for i, (line, title) in enumerate(zip(images, rows, strict=True)):
        for j, (image, column) in enumerate(zip(line, columns, strict=True)):
            axis = axes[i][j]
            # the titles of all columns at one height
            axis.set(xticks=[], yticks=[], anchor="N")
            if image is None:
                axis.set_facecolor("#f2f2f2")
                axis.text(
                    0.5,
                    0.5,
                    "none",
                    ha="center",
                    va="center",
                    color="#999999",
                    transform=axis.transAxes,
                )
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
    """Draw horizontal bars of shares with their intervals, {panel: {name: ShareBar}}; dashes mark
    chance.
    """
    longest = max(len(one) for one in series.values())
    figure, axes = panels(1, len(series), 4.2, 0.9 + 0.34 * longest, sharex=True, sharey=True)
    names = list(dict.fromkeys(name for one in series.values() for name in one))
    for axis, (title, values) in zip(axes[0], series.items(), strict=True):
        for name, bar in values.items():
            place = names.index(name)
            axis.barh(place, 100 * bar.value, color=f"C{place % 10}", alpha=0.85, height=0.7)
            if bar.low is not None and bar.high is not None:
                axis.plot(
                    [100 * bar.low, 100 * bar.high], [place, place], color="#222222", linewidth=1.4
                )
            if bar.chance is not None:
                axis.plot(
                    [100 * bar.chance] * 2,
                    [place - 0.45, place + 0.45],
                    "--",
                    color="#222222",
                    linewidth=1,
                )
        axis.set(title=title, xlabel=f"{label}, % (95 % interval)", axisbelow=True)
        axis.set_yticks(range(len(names)), names)
        axis.grid(axis="x", alpha=0.25)
    # after all panels, which share it: a limit ends its growth
    axes[0][0].set_xlim(left=0)
    axes[0][0].invert_yaxis()
    write_figure(path, figure)


def panels(
    rows: int, columns: int, width: float, height: float, **options: Any
) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure and its grid of axes, each `width` x `height` inches.

    Raises UserError without any.
    """
    from matplotlib.figure import Figure

    if not rows or not columns:
        raise UserError("There is nothing to draw.")
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options).tolist()


def _colours(count: int) -> Array:
    """Return RGB colours (count, 3): ten distinct ones, or hues in an order that separates
    neighbours.
    """
    from matplotlib import colormaps

    if count <= 10:
        return np.asarray(colormaps["tab10"].colors)[:count]  # type: ignore[attr-defined]
    return np.asarray(colormaps["hsv"](np.arange(count) * 0.618 % 1.0))[:, :3] * 0.85


@dataclass(frozen=True)
class Space:
    """Numbers of one feature space; see the functions of the same names.

    None: not defined for these labels.
    """

    name: str
    alignment: float | None
    uniformity: float
    silhouette_sensor: float | None
    silhouette_object: float | None
    rows: int


def alignment(first: Array, second: Array) -> float:
    """Return the mean squared distance of unit-norm positive pairs (n, d); 0 is best (Wang & Isola,
    2020).
    """
    first = _unit(first)
    second = _unit(second)
    if first.shape != second.shape or not len(first):
        raise UserError(f"Alignment needs pairs of rows, not {first.shape} and {second.shape}.")
    return float(np.mean(np.linalg.norm(first - second, axis=1) ** 2))


def uniformity(features: Array) -> float:
    """Return the log of the mean of exp(-2 |x - y|^2) over pairs of unit-norm rows, -8 to 0 (Wang &
    Isola, 2020).
    """
    x = _unit(subsample(np.asarray(features), MOST))
    if len(x) < 2:
        raise UserError("Uniformity needs two rows or more.")
    likeness = (x @ x.T)[np.triu_indices(len(x), 1)]
    return float(np.log(np.mean(np.exp(-2.0 * np.maximum(2 - 2 * likeness, 0.0)))))


def silhouette(features: Array, labels: Any) -> float | None:
    """Return the mean silhouette by cosine distance, -1..1; None with fewer than two labels, or as
    many as rows.
    """
    from sklearn.metrics import silhouette_score

    labels = subsample(np.asarray(labels).astype(str), MOST)
    count = len(np.unique(labels))
    if not 2 <= count < len(labels):
        return None
    return float(
        silhouette_score(_unit(subsample(np.asarray(features), MOST)), labels, metric="cosine")
    )


def tsne(features: Array, *, seed: int = 0) -> Array:
    """Return a t-SNE of features (n, d) by cosine distance, f32 (n, 2).

    Raises UserError below 4 rows or 2 columns.
    """
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits

    if (
        (features := np.asarray(features)).ndim != 2
        or features.shape[0] < 4
        or features.shape[1] < 2
    ):
        raise UserError(f"A t-SNE needs 4 rows of 2 columns or more, not {features.shape}.")
    x = _unit(features)
    # Squared Euclidean distances of unit-norm rows are twice the cosine distances.
    model = TSNE(
        perplexity=min(30.0, (len(x) - 1) / 3), init="pca", max_iter=600, random_state=seed
    )
    # its threads wait for each other at every step, very long on a busy machine
    with threadpool_limits(1):
        return np.asarray(model.fit_transform(x.astype(np.float32)), np.float32)


def describe(
    features: Array, sensors: Any, objects: Any, touches: Any, *, name: str = "features"
) -> Space:
    """Return all numbers of features (n, d); positive pairs are the rows of one touch by different
    sensors.
    """
    x = np.asarray(features)
    sensors = np.asarray(sensors).astype(str)
    objects = np.asarray(objects).astype(str)
    known = objects != ""
    members = dict[str, list[int]]()
    for row, touch in enumerate(np.asarray(touches).astype(str)):
        members.setdefault(touch, []).append(row)
    several = [combinations(rows, 2) for _, rows in sorted(members.items())]
    pairs = [(a, b) for a, b in chain.from_iterable(several) if sensors[a] != sensors[b]]
    first, second = np.array(pairs, np.int64).reshape(-1, 2).T
    aligned = alignment(x[first], x[second]) if pairs else None
    by_sensor = silhouette(x, sensors)
    by_object = silhouette(x[known], objects[known])
    return Space(name, aligned, uniformity(x), by_sensor, by_object, len(x))


def _unit(features: Array) -> Array:
    x = np.asarray(features, np.float64)
    if x.ndim != 2 or not np.isfinite(x).all():
        raise UserError(f"Features must be finite numbers (n, d), not {x.shape} with NaN or Inf.")
    return unit_rows(x)
