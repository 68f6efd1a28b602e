"""Which engine is faster for how many touches at once? onnxruntime beside XLA, in turns.

    python -m experiments.benchmarks.batches

Both are called one after the other in every round, so that other work on the machine slows both.
The ratio is the median over rounds, with its quartiles. `encoder.base.FEW` is chosen by it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.evaluate.tables import plain
from experiments.benchmarks import machine
from experiments.records import write_record


def seconds(run: Callable[[], object]) -> float:
    """Return the seconds of one call."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", default="anytouch-tiny")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 2, 4, 8, 16, 64])
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--out", type=Path, default=Path("experiments/results"))
    given = parser.parse_args()
    xla = load_encoder(given.model, engine="xla")
    engine = load_encoder(given.model, engine="onnxruntime")
    side = xla.config.model.image_size
    rng = np.random.default_rng(0)
    for count in given.batches:
        touches = rng.integers(0, 256, (count, 1, side, side, 3), np.uint8)
        ways = [partial(one.encode_touch, touches, "digit") for one in (xla, engine)]
        for way in ways:
            way()  # compiles
        times = np.array([[seconds(way) for way in ways] for _ in range(given.rounds)])
        low, middle, high = np.percentile(times[:, 1] / times[:, 0], (25, 50, 75))
        own = {"touches": count, "ratio": middle, "low": low, "high": high}
        own |= {"xla_ms": 1e3 * np.median(times[:, 0]), "rounds": given.rounds}
        about = own | {"machine": plain(machine.describe())}
        write_record(given.out / "batches.jsonl", f"{given.model}/{count}", about)
        print({name: round(float(value), 3) for name, value in own.items()}, flush=True)


if __name__ == "__main__":
    main()
