"""Simulated touches: frames a second, error of the fast solver against the exact one, fraction of
the roofline.

    python -m experiments.benchmarks.simulator --out experiments/results/simulator.jsonl

One program serves all sensors, so a sensor is compiled only once for a size, a number of frames and
a fidelity. It runs on any device of jax.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.evaluate.tables import plain
from anytouch_jax.sim import endless
from anytouch_jax.sim.contact.mechanics import Fidelity
from anytouch_jax.sim.endless import CAMERAS, Sampling, SimulatedTouches, World
from anytouch_jax.sim.scene import Scenes
from experiments.benchmarks import machine
from experiments.command import with_status
from experiments.records import write_record

FIELDS = ("displacement", "pressure")
TOUCHED = 0.01  # mm of displacement from which a pixel counts as touched


def parse(args: Sequence[str] | None) -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sensors", nargs="*", default=CAMERAS, choices=CAMERAS)
    parser.add_argument(
        "--sizes", nargs="*", type=int, default=(112, 224), help="pixels of an image's side"
    )
    parser.add_argument("--frames", nargs="*", type=int, default=(1, 3), help="frames of a touch")
    parser.add_argument("--batch", type=int, default=16, help="touches a call; a GPU wants 1024")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--peak-size", type=int, help="side of the matrices of the peak")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/bench/simulator.jsonl"), help="file of results"
    )
    return parser.parse_args(args)


def program(world: World, sampling: Sampling, count: int) -> Any:
    """Return the compiled program (key, world) -> touches."""
    sample = jax.jit(partial(endless.sample_touches, sampling=sampling, count=count))
    return sample.lower(jax.random.key(0), world).compile()


def timed(call: Any, rounds: int) -> tuple[float, float]:
    """Return the least seconds of a call by the clock, and the median of processor time."""
    jax.block_until_ready(call())
    clock = []
    processor = []
    for _ in range(rounds):
        start = time.perf_counter()
        used = time.process_time()
        jax.block_until_ready(call())
        clock.append(time.perf_counter() - start)
        processor.append(time.process_time() - used)
    return min(clock), float(np.median(processor))


def errors(fast: SimulatedTouches, exact: SimulatedTouches) -> dict[str, float]:
    """Return root mean squares of fast minus exact where the gel is touched: mm, kPa and grey
    levels.
    """
    touched = np.asarray(exact.fields[..., 0]) > TOUCHED
    change = np.asarray(fast.fields - exact.fields)[touched]
    mm, kpa = np.sqrt(np.mean(change**2, 0)) if len(change) else (0.0, 0.0)
    levels = np.asarray(fast.clip[:, :, -1], float) - np.asarray(exact.clip[:, :, -1], float)
    return {
        "mm": float(mm),
        "kpa": float(kpa),
        "levels": float(np.sqrt(np.mean(levels[touched] ** 2))),
    }


def peaks(size: int | None) -> tuple[float, float]:
    """Return operations and bytes a second that this device reaches: a product of matrices, and a
    copy.
    """
    product, operations = machine.matmul("float32", size)
    block = jnp.ones(1 << (22 if size else 27), jnp.float32)
    copy = jax.jit(lambda x: x + 1).lower(block).compile()
    return operations / timed(product, 3)[0], 2 * block.nbytes / timed(lambda: copy(block), 3)[0]


def run(options: argparse.Namespace) -> int:
    """Measure, and store each result at once."""
    about = plain(machine.describe())
    (fastest, widest) = peaks(options.peak_size)
    things = endless.objects_of(Scenes(objects=options.objects))
    worlds = {name: jax.device_put(endless.make_world(things, (name,))) for name in options.sensors}
    any_world = next(iter(worlds.values()))
    key = jax.random.key(3)
    fidelities: tuple[Fidelity, ...] = ("fast", "exact")
    for size in options.sizes:
        for frames in options.frames:
            made: dict[str, Any] = {}
            for fidelity in fidelities:
                sampling = Sampling(
                    frames=frames, size=size, fields=FIELDS, field_size=size, fidelity=fidelity
                )
                start = time.perf_counter()
                made[fidelity] = program(any_world, sampling, options.batch)
                print(
                    f"{size}, {frames}, {fidelity}: {time.perf_counter() - start:.0f} s to compile",
                    file=sys.stderr,
                )
            for name, world in worlds.items():
                wrong = errors(*(jax.device_get(made[one](key, world)) for one in fidelities))
                for fidelity, call in made.items():
                    count = options.batch * frames
                    cost = call.cost_analysis()
                    seconds, processor = timed(partial(call, key, world), options.rounds)
                    least = max(cost["flops"] / fastest, cost["bytes accessed"] / widest)
                    record = {
                        "sensor": name,
                        "size": size,
                        "frames": frames,
                        "fidelity": fidelity,
                        "batch": options.batch,
                        "frames_s": count / seconds,
                        "processor_ms": 1e3 * processor / count,
                        "mflop": cost["flops"] / count / 1e6,
                        "mbyte": cost["bytes accessed"] / count / 1e6,
                        "roofline": least / seconds,
                        "machine": about,
                    } | (wrong if fidelity == "fast" else {})
                    write_record(
                        options.out,
                        f"{about['device']}, {size}, {frames}, {name}, {fidelity}",
                        record,
                    )
    return 0


def main(args: Sequence[str] | None = None) -> int:
    """Run the script with these arguments, and return its exit status."""
    return with_status(lambda: run(parse(args)))


if __name__ == "__main__":
    sys.exit(main())
