"""One ball, five times: how well is a device read before and after its calibration?

    python -m experiments.real.circles anytouch-tiny

The contact circles of 42 presses of a ball of 4.7 mm were drawn by hand by another lab (FOTS), on
its own GelSight. The presses are read without a calibration, and after five of them, drawn at
random, have calibrated the device, on the other 37: with the true diameter, half of it and twice
of it. Contact is a probability above one half, its centre the mean place and its radius the root of
the area over pi. Depth is above the drawn rim. Medians over presses, of all draws. Rows go to
`experiments/results/circles.jsonl`.
"""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from tyro.conf import Positional

from anytouch_jax.data.images import decode
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.encoder.measured import Fields
from anytouch_jax.errors import UserError
from anytouch_jax.fields.ruler import Ruler, fit_ruler
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.command import run_script
from experiments.records import write_record

Array = npt.NDArray[Any]
FAMILY = "gelsight"
_PRESSES = 5


@dataclass(frozen=True)
class CircleOptions:
    """Compare with circles that were drawn by hand."""

    model: Positional[Path]  # Encoder that measures.
    data: Path = Path("../shared/real_touch3")  # Folder with balls.csv.
    draws: int = 5  # Of the presses that calibrate.
    out: Path = Path("experiments/results/circles.jsonl")  # JSON lines.


class Circle(NamedTuple):
    """A circle in pixels, and the mm of one and of the radius of the ball."""

    x: float
    y: float
    radius: float
    mm: float
    ball: float


def read_pack(folder: Path) -> tuple[Array, Array, list[Circle]]:
    """Return the presses (N, h, w, 3), the background and the circles. Raises UserError."""
    try:
        rows = list(csv.DictReader((folder / "balls.csv").open(encoding="utf-8")))
    except OSError as error:
        raise UserError(f"{folder}: {error.strerror}. Name the pack with --data.") from None
    circles = [
        Circle(
            *(float(row[f"{name}_px"]) for name in ("centre_x", "centre_y", "contact_radius")),
            1 / float(row["pixels_per_mm"]),
            float(row["ball_diameter_mm"]) / 2,
        )
        for row in rows
    ]
    frames = np.stack([decode(folder / row["path"]) for row in rows])
    return frames, decode(folder / rows[0]["background_path"]), circles


def errors_of(depth: Array, contact: Array, circle: Circle) -> tuple[float, float, float, float]:
    """Return centre mm off, radius over the drawn one, depth over the true one, and the deepest."""
    height, width = depth.shape
    y, x = np.mgrid[:height, :width]
    away = np.hypot(x - circle.x, y - circle.y)
    inside = contact > 0.5
    centre = np.nan
    if inside.any():
        centre = float(np.hypot(x[inside].mean() - circle.x, y[inside].mean() - circle.y))
    top = circle.ball - np.sqrt(circle.ball**2 - (circle.mm * circle.radius) ** 2)
    above = depth[away < 4].mean() - np.median(depth[np.abs(away - circle.radius) < 2])
    return (
        centre * circle.mm,
        float(np.sqrt(inside.sum() / np.pi) / circle.radius),
        float(above / top),
        float(depth.max()),
    )


def summary(rows: list[tuple[float, ...]]) -> dict[str, float]:
    """Return medians over presses."""
    centre, radius, depth, deepest = np.array(rows).T
    return {
        "presses": len(rows),
        "centre": float(np.nanmedian(centre)),
        "radius": float(np.nanmedian(radius)),
        "depth": float(np.nanmedian(depth)),
        "deepest": float(np.nanmedian(deepest)),
    }


def run(options: CircleOptions) -> int:
    """Write the errors before and after."""
    enable_compilation_cache()
    frames, background, circles = read_pack(options.data)
    height, width = background.shape[:2]
    width_mm = width * circles[0].mm
    encoder = load_encoder(options.model)

    def read(sensor: str) -> Fields:
        return encoder.measure(frames, background, sensor, width_mm=width_mm, log=lambda _: None)

    records: dict[str, Any] = {}
    for name, sensor in (("as a GelSight", FAMILY), ("as unknown", "universal")):
        fields = read(sensor).at(height, width)
        rows = [errors_of(*one) for one in zip(fields.depth, fields.contact, circles, strict=True)]
        records[f"not calibrated, {name}"] = summary(rows)
    known = read(FAMILY)
    rng = np.random.default_rng(73)
    rows = []
    noticed = {0.5: 0, 1.0: 0, 2.0: 0}
    for _ in range(options.draws):
        chosen = rng.permutation(len(frames))[:_PRESSES]
        for factor in noticed:
            try:
                ruler = fit_ruler(
                    list(frames[chosen]),
                    known.depth[chosen],
                    background,
                    width_mm=width_mm,
                    ball_mm=2 * circles[0].ball * factor,
                    family=FAMILY,
                )
            except UserError as error:
                print(f"{factor:g} times the diameter: {error}")
                noticed[factor] += 1
                continue
            noticed[factor] += not ruler.is_usual
            if factor == 1:
                rest = np.setdiff1d(np.arange(len(frames)), chosen)
                rows += read_by(ruler, known, frames, circles, rest)
    records["after five presses"] = summary(rows) | {
        f"noticed at {factor:g} times the diameter": count / options.draws
        for factor, count in noticed.items()
    }
    for name, record in records.items():
        write_record(options.out, name, record)
        print(name, record)
    return 0


def read_by(
    ruler: Ruler, known: Fields, frames: Array, circles: list[Circle], rest: Array
) -> list[tuple[float, ...]]:
    """Return the errors of a ruler on the presses that did not calibrate it."""
    depth, deviation, contact = ruler.read(
        list(frames[rest]), known.depth[rest], known.contact[rest]
    )
    height, width = frames.shape[1:3]
    maps = Fields(**{**vars(known[0]), "depth": depth, "depth_std": deviation, "contact": contact})
    larger = maps.at(height, width)
    return [
        errors_of(larger.depth[n], larger.contact[n], circles[row]) for n, row in enumerate(rest)
    ]


if __name__ == "__main__":
    sys.exit(run_script(CircleOptions, run))
