"""Real looks of camera sensors, fitted once: `python -m experiments.benchmarks.looks PACK PACK2 OUT.npz`.

It reads two packs of real pictures, and Taxim's colour tables of a DIGIT. It writes what `sim/sensing/looks.npz` holds:

* `NAME.bases` u8 (units, 30 or 40, 30 or 40, 3): pictures of untouched gels of several units, without marker dots. Of
  sensors that are lights set by eye, f32 in 0..1.
* `NAME.normal`, `.halo`, `.steepest`, `.widest`: the `Photometry` of a sensor.

No picture with a non-commercial licence is read.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.sim.sensing.sensors import SENSORS, Photometry
from experiments.benchmarks import photometry, presses

Array = npt.NDArray[Any]
SHORT, LONG = 30, 40  # pixels of a stored picture
SLIP = "incipient_slip-gelsight_mini_markers/backgrounds"
# Taxim's tables hold a colour change over picture places of 240 x 320 pixels, for bins of tilt and direction.
TABLE = (240, 320)


def read(path: Path) -> Array:
    """Return a picture u8 (H, W, 3) RGB."""
    image = cv2.imread(str(path))
    if image is None:
        raise SystemExit(f"cannot read {path}")
    return image[..., ::-1]


def small(image: Array) -> Array:
    """Return an image with 30 pixels on the short side."""
    width, height = (LONG, SHORT) if image.shape[1] > image.shape[0] else (SHORT, LONG)
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def without_dots(image: Array) -> Array:
    """Paint over dark marker dots: each is replaced by the paint around it."""
    grey = image.mean(-1).astype(np.float32)
    dark = cv2.GaussianBlur(grey, (0, 0), image.shape[0] / 10) - grey > 6
    mask = cv2.dilate(dark.astype(np.uint8), np.ones((9, 9), np.uint8))
    weight = 1.0 - mask.astype(np.float32)
    total, parts = np.zeros(image.shape, np.float64), np.zeros(grey.shape, np.float64)
    for sigma in (6.0, 14.0):  # the nearest clear paint counts most
        share = cv2.GaussianBlur(weight, (0, 0), sigma)
        total = total + cv2.GaussianBlur(image * weight[..., None], (0, 0), sigma) * (1.0 if sigma < 10 else 0.05)
        parts = parts + share * (1.0 if sigma < 10 else 0.05)
    return np.where(mask[..., None] > 0, total / np.maximum(parts, 1e-6)[..., None], image).astype(np.uint8)


def smoothed(image: Array) -> Array:
    """Return a polynomial in the place that follows most of an image, and not the dents and dots in it."""
    grey = small(image).astype(np.float64)
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, grey.shape[1]), np.linspace(-1, 1, grey.shape[0])))
    rows = np.stack([u**i * v**j for i in range(6) for j in range(6 - i)], 1)
    weight = np.ones(len(u))
    for _ in range(12):
        fit = rows @ np.linalg.lstsq(rows * weight[:, None], grey.reshape(-1, 3) * weight[:, None], rcond=None)[0]
        weight = 1 / (1 + np.abs(grey.reshape(-1, 3) - fit).max(1) / 3)
    return np.clip(fit.reshape(grey.shape), 0, 255).astype(np.uint8)


def digit_model(tables: Path, drift: float = 0.6) -> Photometry:
    """Return the model of a DIGIT, fitted to Taxim's tables.

    Presses near a corner are rare, so that `drift` of the change with the place is believed.
    """
    with np.load(tables) as pack:
        bins = int(pack["bins"])
        table = np.stack([pack[f"grad_{c}"] for c in "rgb"], 2)  # (tilt, direction, channel, 6)
    tilt = np.arange(bins) * 0.5 * np.pi / (bins - 1)
    turn = np.arange(bins) * 2 * np.pi / (bins - 1) - np.pi
    steep = tilt < np.arcsin(0.85)
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-0.7, 0.7, 5), np.linspace(-0.7, 0.7, 5)))
    x, y = ((a * drift + 1) / 2 * n for a, n in zip((u, v), TABLE, strict=True))
    place = np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)])  # (6, places)
    colour = np.einsum("tdck,kp->tdpc", table[steep], place) / 255
    colour = colour * np.minimum(np.sin(tilt[steep]) / 0.12, 1)[:, None, None, None]  # a table starts with noise
    shape = colour.shape[:3]
    sine = np.sin(tilt[steep])[:, None, None]
    nx = np.broadcast_to(sine * np.sin(turn)[None, :, None], shape).ravel()
    ny = np.broadcast_to(sine * np.cos(turn)[None, :, None], shape).ravel()
    across, down = (np.broadcast_to(a[None, None, :], shape).ravel() for a in (u, v))
    rows = photometry.design(nx, ny, across, down)
    model = photometry.assemble(photometry.ridge(rows, colour.reshape(-1, 3), 1e-4), float(np.float32(0.85)))
    return model._replace(widest=np.full(3, 9.0, np.float32))


def models() -> dict[str, Photometry]:
    """Return the models of all sensors but the DIGIT, whose tables are in a pack."""
    fitted = {name: presses.fit_photometry(name)[0] for name in presses.INDENTERS}
    lit = {name: photometry.lit(lights) for name, lights in photometry.LIGHTS.items()}
    return fitted | lit | {"9dtact": photometry.darkening()}


def build(pack: Path, second: Path) -> dict[str, Array]:
    """Return the arrays of `looks.npz`."""
    unical = [read(path) for path in sorted((second / "unical/GelSight").glob("*.jpg"))]
    smooth = [read(path) for path in sorted((second / "unical/9DTact").glob("*.jpg"))]
    bases = {
        "gelsight": [presses.read_background("gelsight"), smoothed(np.median(unical, 0))],
        "gelsight_mini": [
            presses.read_background("gelsight_mini"),
            read(pack / "gelslam-gelsight_mini/background.png"),
            read(next((pack / "normalflow-gelsight_mini").glob("*.png"))),
            *(smoothed(without_dots(read(path))) for path in sorted((second / SLIP).glob("*.png"))),
        ],
        "digit": [
            read(pack / "aurova_grasping-digit/background_0.png"),
            read(pack / "aurova_grasping-digit/background_1.png"),
            read(pack / "tacto-digit/background.jpg"),
        ],
        "9dtact": [
            read(pack / "9dtact-9dtact/sensor_1/ref.png"),
            read(second / "9dtact_sensor_2/ref.jpg"),
            smoothed(np.median(smooth, 0)),
        ],
    }
    arrays: dict[str, Array] = {
        f"{name}.bases": np.stack([small(one) for one in several]) for name, several in bases.items()
    }
    for name, lights in photometry.LIGHTS.items():
        arrays[f"{name}.bases"] = photometry.untouched(lights, SENSORS[name].field)
    digit = digit_model(pack / "taxim-calibration/digit/polycalib.npz")
    for name, model in (models() | {"digit": digit}).items():
        arrays |= {f"{name}.{part}": np.asarray(value) for part, value in model._asdict().items()}
    return arrays


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, what in (("pack", "a pack of real pictures"), ("pack2", "another"), ("out", "the .npz file to write")):
        parser.add_argument(name, type=Path, help=what)
    options = parser.parse_args()
    np.savez_compressed(options.out, **build(options.pack, options.pack2))
