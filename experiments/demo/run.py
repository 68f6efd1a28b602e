"""The demo: a sensor that the encoder in the package has never met learns to name shapes.

    python -m experiments.demo.run --out runs/demo --minutes 2

It simulates touches of that sensor, trains the encoder of the package on them for some minutes, and
the same network from nothing for as many steps, and tests both on objects that are held out. The
first page is there within a minute, and the whole takes less than ten on two cores.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path

import numpy as np

from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.evaluate.discriminant import discriminant_path
from anytouch_jax.progress import tracked
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.demo.report import PACKAGE, Findings, first_report, write_findings
from experiments.demo.touches import (
    NAMES,
    Touches,
    simulate,
    unstretched,
    write_ring_light,
)
from experiments.demo.training import (
    FRESH_RATE,
    RATE,
    Learner,
    from_nothing,
    shown,
    train_course,
    with_head,
)

TRAIN = 1536  # touches
TEST = 512
MEASURED = 128  # touches of test whose force is measured, one by one
SMALL = 4  # pixels that are averaged along each side for the head on pixels
COMPONENTS = 192  # of the pixels: as many as features of the encoder


def pixel_names(learner: Learner, train: Touches, test: Touches) -> np.ndarray:
    """Return the shapes (n,) that a linear head on pixels, less the background, gives."""
    rows = [shown(learner, one)[:, 0].astype(np.float32) for one in (train, test)]
    count = len(rows[0])
    x = np.concatenate(rows)
    side = x.shape[1] // SMALL
    x = x.reshape(len(x), side, SMALL, side, SMALL, 3).mean((2, 4)).reshape(len(x), -1)
    middle = x[:count].mean(0)
    axes = np.linalg.svd(x[:count] - middle, full_matrices=False)[2][:COMPONENTS]
    x = (x - middle) @ axes.T
    x /= x[:count].std()
    head = next(discriminant_path(x[:count], train.shape, len(NAMES), [1.0]))
    return np.asarray((x[count:] @ head.weights + head.bias).argmax(1))


def measured_force(encoder: Encoder, sensor: Path, test: Touches) -> np.ndarray:
    """Return the force (m,) in N of the first MEASURED test touches."""
    force = []
    pairs = list(zip(test.frame, test.background, strict=True))[:MEASURED]
    for frame, background in tracked(pairs, "force"):
        seen = unstretched(frame), unstretched(background)
        fields = encoder.measure(*seen, str(sensor), log=_tell_fault)
        assert fields.force is not None  # the sensor knows its width
        force.append(fields.force[0, 2])
    return np.array(force)


def _tell_fault(line: str) -> None:
    """Print what is wrong with a touch, but not that nobody made tokens of a new sensor."""
    if "has no tokens of its own" not in line:
        print(line, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/demo"))
    parser.add_argument("--minutes", type=float, default=2.0, help="of each of the two trainings")
    parser.add_argument("--train", type=int, default=TRAIN, help="touches to learn from")
    parser.add_argument("--test", type=int, default=TEST, help="touches to be tested on")
    options = parser.parse_args()
    begun = time.monotonic()

    def say(text: str) -> None:
        print(f"{time.monotonic() - begun:4.0f} s  {text}", flush=True)

    enable_compilation_cache()
    page = first_report(options.out).with_suffix(".html")
    say(f"{page}: the first figures")
    sensor = write_ring_light(options.out / "ring_light.sensor")
    train, test = (
        simulate(sensor, split, count, say)
        for split, count in (("train", options.train), ("test", options.test))
    )
    encoder = load_encoder(PACKAGE, engine="xla")
    settings = {"data.background": "subtract", "data.affine": (10.0, 0.05, 0.15)}
    learner = Learner(encoder.net, encoder.config.with_settings(settings))
    pixels = pixel_names(learner, train, test)
    force = measured_force(encoder, sensor, test)
    say("force is measured")
    course = partial(train_course, learner, data=(train, test), log=say)
    say(f"training {PACKAGE}")
    params = with_head(learner, encoder.params["touch"], train)
    package = course(params, rate=RATE, seconds=60 * options.minutes)
    say("training the same network from nothing")
    steps = package.points[-1].step
    nothing = course(from_nothing(learner), rate=FRESH_RATE, steps=steps)
    found = Findings(
        test,
        package,
        nothing,
        pixels,
        int(np.bincount(train.shape).argmax()),
        force,
        float(np.median(train.force)),
        len(train.shape),
    )
    write_findings(found, options.out, (time.monotonic() - begun) / 60)
    say(f"{page}: open it in a browser")


if __name__ == "__main__":
    main()
