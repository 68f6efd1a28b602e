"""What an accelerator does in four minutes: endless simulation, training of tiny and ViT-L,
embedding.

    python -m experiments.benchmarks.gpu --minutes 4 --out experiments/results/variants.jsonl

Each workload is printed and stored as soon as it is timed, and once more with its errors against
float32. Nothing is started after the time is over. `--quick` rehearses it on a CPU. Only jax, flax,
optax and numpy are needed, and what is not installed for the simulation is said in its row.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "src"))

import jax
import jax.numpy as jnp

from anytouch_jax.errors import UserError
from anytouch_jax.train.step import merge
from experiments.benchmarks import speed
from experiments.benchmarks.run import log, store
from experiments.benchmarks.variants import BASELINE, BFLOAT16, Variant
from experiments.benchmarks.workloads import Workload, first_state, workloads
from experiments.command import with_status

CUDNN = Variant("bfloat16, cuDNN attention", BFLOAT16 | {"attention": "cudnn"}, precision=None)
BATCHES = {"large": 32, "tiny": 256}  # samples a step, the preset of the paper first
WORKS = {"stage1": "stage1 clips", "stage2": "stage2 align", "embed": "embed clips"}
TOUCHES = 256  # simulated at a time
Row = dict[str, Any]


def simulation(count: int, rounds: int) -> Row:
    """Return frames a second of `sim.endless`: stills of 112 x 112 pixels, drawn and rendered on
    the device.
    """
    from anytouch_jax.sim import endless, scene

    world = jax.device_put(endless.make_world(endless.objects_of(scene.Scenes(objects=40))))
    draw = jax.jit(partial(endless.sample_touches, sampling=endless.Sampling(), count=count))
    times = []
    for number in range(rounds + 1):
        begin = time.perf_counter()
        jax.block_until_ready(draw(jax.random.key(number), world).clip)
        times.append(time.perf_counter() - begin)
    seconds = sorted(times[1:])[rounds // 2]
    return {
        "variant": "float32",
        "samples": count,
        "seconds": seconds,
        "frames_per_second": count / seconds,
        "compile_seconds": times[0] - seconds,
    }


def errors(work: Workload, fast: Variant) -> dict[str, float]:
    """Return relative errors of output, loss and gradient against float32, of a few samples."""
    small = work.resized(min(work.samples, speed.ERROR_SAMPLES))
    state = first_state(work.config)
    params = jax.device_get(merge(state.trainable, state.frozen))
    noise = (
        jnp.zeros((small.samples, small.config.model.patches))
        + jnp.arange(small.config.model.patches)[None]
    )
    exact, found = (speed.values_in(one, small, params, noise) for one in (BASELINE, fast))
    return {f"error_{name}": speed.relative(found[name], exact[name]) for name in exact}


def measured(options: argparse.Namespace, end: float) -> Iterator[tuple[str, str, list[Row]]]:
    """Yield preset, title and rows: of the simulation, then of each workload, without and with
    errors.
    """
    count, rounds = (4, 1) if options.quick else (TOUCHES, 5)
    try:
        yield "tiny", "endless simulation", [simulation(count, rounds)]
    except (ImportError, RuntimeError) as error:
        yield (
            "tiny",
            "endless simulation",
            [{"variant": "none", "note": str(error).splitlines()[0]}],
        )
    fast = CUDNN if jax.default_backend() == "gpu" else Variant("bfloat16", BFLOAT16)
    size, presets = (512, ["tiny"]) if options.quick else (None, list(BATCHES))
    for preset in presets:
        for what, name in WORKS.items():
            if time.monotonic() > end:
                log(f"{name}, preset {preset}: not started, the time is over")
                continue
            batch = 2 if options.quick else BATCHES[preset]
            work = next(one for one in workloads(what, preset, batch) if one.name == name)
            title = f"{name}, preset {preset}"
            try:
                rows = speed.measure(
                    work,
                    (BASELINE, fast),
                    rounds=1 if options.quick else 3,
                    with_errors=False,
                    peak_size=size,
                    log=log,
                )
                yield preset, title, [speed.record_of(row) for row in rows]
                if time.monotonic() < end:
                    rows[1:] = [replace(row, **errors(work, fast)) for row in rows[1:]]
                    rows[0] = replace(rows[0], error_output=0.0, error_loss=0.0, error_gradient=0.0)
                    yield preset, title, [speed.record_of(row) for row in rows]
            except (
                UserError,
                RuntimeError,
            ) as error:  # the other workloads are still worth their time
                log(f"{title}: {str(error).splitlines()[0]}")


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line `args` and return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=4, help="after which nothing is started")
    parser.add_argument(
        "--quick", action="store_true", help="preset tiny in tiny batches, to see that it works"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/bench/gpu.jsonl"), help="file of results"
    )
    options = parser.parse_args(args)
    end = time.monotonic() + 60 * options.minutes
    return with_status(lambda: store(measured(options, end), options) or 0)


if __name__ == "__main__":
    sys.exit(main())
