"""Does it pay that touches never repeat? Stage 1 on endless touches and on fixed ones, judged on held-out objects.

    python -m experiments.encoders.endless --out experiments/results/endless.jsonl

Both runs have the same network, schedule, number of steps and simulator. The fixed run draws the same touches again and
again, with new masks. The error is that of hidden patches on touches of objects that neither run draws.
"""

from __future__ import annotations

import argparse
import tempfile
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from anytouch_jax import objectives
from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Config, Stack, preset
from anytouch_jax.evaluate.statistics import plain
from anytouch_jax.nn.functional import build
from anytouch_jax.sim import endless, scene
from anytouch_jax.sim.endless import SimulatedTouches
from anytouch_jax.simulated import SIMULATED, SimulatedLoader
from anytouch_jax.train.loop import fit
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.benchmarks import machine
from experiments.records import write_record

BATCH, EVERY, HELD_OUT = 32, 100, 512
SMALL = Stack(width=128, depth=2, heads=4, mlp=512)  # the network of `make demo`, so that a run takes minutes


class FixedLoader(SimulatedLoader):
    """Draws the touches of the first steps again and again, in the same order."""

    def __init__(self, config: Config, distinct: int) -> None:
        super().__init__(config)
        self._known = lru_cache(distinct)(super().touches) if distinct else super().touches
        self._distinct = distinct or 1 << 30

    def touches(self, step: int) -> SimulatedTouches:
        return self._known(step % self._distinct)


def held_out(loader: SimulatedLoader, config: Config) -> list[TouchBatch]:
    """Return batches of stills of objects that are held out from training."""
    simulated = config.simulated
    scenes = scene.Scenes(objects=simulated.objects, seed=simulated.seed, depth=simulated.depth)
    loader._world = jax.device_put(endless.make_world(endless.objects_of(scenes, "val"), simulated.sensors))
    steps = range(10_000, 10_000 + HELD_OUT // BATCH)
    return [batch for step in steps if isinstance(batch := loader.batch(step), TouchBatch)]


def main() -> None:
    """Train both runs and store an error for every EVERY steps."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--touches", type=int, default=3392, help="distinct touches of the fixed run")
    parser.add_argument("--out", type=Path, default=Path("runs/endless.jsonl"))
    given = parser.parse_args()
    enable_compilation_cache()
    config = preset("tiny", stage=1).with_settings({
        "data.manifests": (SIMULATED,), "data.batch_size": BATCH, "data.clip_share": 0.0, "data.background": "subtract",
        "data.jitter": (0.0,) * 4, "objective.next_frame": False, "run.steps": given.steps, "optim.warmup": 100,
        "optim.learning_rate": 1e-3, "run.figure_every": EVERY, "run.save_every": 0,
        "model.image_size": 84, "model.touch": SMALL,
    })  # fmt: skip
    net = build(config.model)
    loss = partial(objectives.stage1_loss, net=net, config=config)
    score = jax.jit(lambda params, batch: loss(params, batch, jax.random.key(0), np.float32(1))[1]["reconstruction"])
    tests = held_out(SimulatedLoader(config), config)
    for name, distinct in (("endless", 0), ("fixed", given.touches // BATCH)):
        loader = FixedLoader(config, distinct)
        about = {"touches": name, "machine": plain(machine.describe())}

        def report(step: int, params: Any, _: Any, name: str = name, about: dict[str, Any] = about) -> None:
            error = float(np.mean([score(params, batch) for batch in tests]))
            write_record(given.out, f"{name}, {step}", {"step": step, "error": error} | about)

        with tempfile.TemporaryDirectory() as run:
            fit(config, params=net.init(jax.random.key(0)), loss_fn=loss, batches=loader.stream, run_dir=run,
                on_report=report, examples=loader.examples)  # fmt: skip


if __name__ == "__main__":
    main()
