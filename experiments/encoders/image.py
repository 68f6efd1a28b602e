"""The image of the README: the example touches, and how alike their features are.

python -m experiments.encoders.image docs/pictures/first_touch.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import anytouch_jax as at


def draw(out: Path, model: str = "anytouch-tiny") -> None:
    """Draw the touches, one row a press and one column a sensor, beside the cosines of their
    centred features.
    """
    encoder = at.load_encoder(model)
    touches = at.example_touches()
    frames = np.stack([encoder.preprocess(touch.frame, touch.background) for touch in touches])
    features = encoder.encode_touch(frames, sensor=[touch.sensor for touch in touches])
    unit = features - features.mean(0)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    cosine = unit @ unit.T
    presses, sensors = (
        list(dict.fromkeys(values))
        for values in zip(*[(t.press, t.sensor) for t in touches], strict=True)
    )
    figure = plt.figure(figsize=(9.6, 3.6), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=(1.5, 1))
    axes = left.subplots(len(presses), len(sensors))
    for touch in touches:
        axis = axes[presses.index(touch.press), sensors.index(touch.sensor)]
        axis.imshow(touch.frame, aspect="auto")
        axis.set_xticks([])
        axis.set_yticks([])
        if touch.press == presses[0]:
            axis.set_title(touch.sensor.replace("_", " "), fontsize=10)
        if touch.sensor == sensors[0]:
            axis.set_ylabel(touch.press, fontsize=10)
    axis = right.subplots()
    names = [f"{touch.press}, {touch.sensor.replace('_', ' ')}" for touch in touches]
    axis.imshow(cosine, cmap="RdBu_r", vmin=-1, vmax=1)
    for (row, column), value in np.ndenumerate(cosine):
        axis.text(
            column,
            row,
            f"{value:.1f}".replace("-", "\u2212"),
            ha="center",
            va="center",
            fontsize=8,
            color="white" if abs(value) > 0.6 else "black",
        )
    axis.set_xticks([])
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.set_title("cosine of centred features", fontsize=10)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="the image to write")
    parser.add_argument(
        "model", nargs="?", default="anytouch-tiny", help="name or path of an encoder"
    )
    options = parser.parse_args()
    draw(options.out, options.model)
