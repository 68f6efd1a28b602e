"""AdamW: how its arrays are packed and stored, speed against error.

    python -m experiments.benchmarks.optimiser MANIFEST

An update of all parameters of a preset is timed by itself, and all ways take turns. The error of 16-bit moments is
that of the loss after 1,000 steps of stage 1 on the pictures of MANIFEST. A line for each way goes to
`optimiser.jsonl`, and `make results` makes the page from that file alone.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import optax
from tyro.conf import Positional

from anytouch_jax import objectives
from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Config, PresetName, preset
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.nn.functional import build
from anytouch_jax.train import optim
from anytouch_jax.train.step import TrainState, init_state, make_step
from experiments.benchmarks import machine
from experiments.benchmarks.speed import interleaved
from experiments.command import run_script
from experiments.records import write_record

NAME = "optimiser.jsonl"
SIDE, TAIL = 56, 100  # pixels of the trained pictures, and last steps whose loss is averaged
HALF = jnp.bfloat16


@dataclass(frozen=True)
class Way:
    """How AdamW works: `small` packs arrays below it into one vector, `mu` and `nu` are the types of the moments."""

    name: str
    small: int = optim.SMALL
    mu: Any = jnp.float32
    nu: Any = jnp.float32
    optax: bool = False


WAYS = (
    Way("ours: small arrays packed"),
    Way("each array alone", small=0),
    Way("all arrays packed", small=2**40),
    Way("optax.adamw", optax=True),
    Way("first moment in bfloat16", mu=HALF),
    Way("both moments in bfloat16", mu=HALF, nu=HALF),
)


@dataclass(frozen=True)
class OptimiserOptions:
    """Time an update of AdamW in several forms, and train with 16-bit moments."""

    data: Positional[Path]  # Manifest whose pictures are learned.
    presets: tuple[PresetName, ...] = ("tiny", "small")  # Sizes of the timed updates.
    rounds: int = 15  # Timed rounds.
    steps: int = 1000  # Training steps.
    seeds: int = 3  # Trainings of each way.
    out: Path = Path(__file__).parents[1] / "results" / NAME  # JSON lines.


def update_of(way: Way, config: Config, params: Any) -> tuple[Callable[[], object], dict[str, Any]]:
    """Return a call that updates all parameters once, and the facts of its program."""
    tx = optax.adamw(1e-3, b1=0.9, b2=0.99, weight_decay=0.05) if way.optax else optim.optimizer(config)

    def step(params: Any, grads: Any, state: Any) -> Any:
        more = {} if way.optax else {"step": jnp.float32(10)}
        updates, state = tx.update(grads, state, params, **more)
        return optax.apply_updates(params, updates), state

    with mock.patch.object(optim, "packing", partial(optim.packing, small=way.small)):
        state = tx.init(params)
        if not way.optax:
            state = stored(state, way)
        start = time.perf_counter()
        program = jax.jit(step).lower(params, params, state).compile()
    held = [params, state]

    def run() -> object:
        held[:] = program(held[0], params, held[1])
        return jax.block_until_ready(held)

    size = sum(x.nbytes for x in jax.tree.leaves(state))
    return run, {"compile_s": time.perf_counter() - start, "state_bytes": size}


def stored(state: optim.OptState, way: Way) -> optim.OptState:
    """Return the state with its moments in the types of `way`."""
    mu, nu = (tuple(x.astype(kind) for x in some) for some, kind in ((state.mu, way.mu), (state.nu, way.nu)))
    return state._replace(mu=mu, nu=nu)


def losses(way: Way, pictures: np.ndarray, seed: int, steps: int) -> np.ndarray:
    """Return the loss f32 (steps,) of stage 1 on stills u8 (n, SIDE, SIDE, 3)."""
    whole = preset("tiny")
    model = replace(whole.model, image_size=SIDE)
    config = replace(whole, model=model, run=replace(whole.run, steps=steps))
    net = build(model)
    loss = partial(objectives.stage1_loss, net=net, config=config)
    trained = partial(objectives.trained_by, config=config)
    step = jax.jit(make_step(loss, optim.optimizer(config), total_steps=steps, trained=trained))
    first = init_state(net.init(jax.random.key(seed)), config)
    state: TrainState = first._replace(opt_state=stored(first.opt_state, way))
    rng, values, sensor = np.random.default_rng(seed), [], np.zeros(16, np.int32)
    for _ in range(steps):
        clip = pictures[rng.integers(0, len(pictures), 16)][:, None]
        state, metrics = step(state, TouchBatch(clip, sensor), jax.random.key(seed))
        values.append(metrics["loss"])
    return np.asarray(jax.device_get(values))


def run(options: OptimiserOptions) -> int:
    """Measure all ways and store a line for each. Raises UserError for a manifest that cannot be read."""
    about = asdict(machine.describe())
    results: dict[str, dict[str, Any]] = {way.name: {"machine": about} for way in WAYS}
    for name in options.presets:
        config = preset(name)
        params = jax.device_put(build(config.model).init(jax.random.key(0)))
        calls, facts = zip(*(update_of(way, config, params) for way in WAYS), strict=True)
        times = np.stack([one.ravel() for one in interleaved(calls, options.rounds)])
        ratio = times / times[0]
        for number, way in enumerate(WAYS):
            low, high = np.percentile(ratio[number], [25, 75])
            results[way.name][name] = facts[number] | {
                "ms": 1e3 * float(np.median(times[number])), "ratio": float(np.median(ratio[number])),
                "ratio_low": float(low), "ratio_high": float(high),
            }  # fmt: skip
    save(results, options)
    table = manifests.read([options.data])
    rows = np.linspace(0, len(table) - 1, min(len(table), 2000)).astype(int)
    pictures = np.stack([cv2.resize(decode(table.file(int(row))), (SIDE, SIDE)) for row in rows])
    plain: list[float] = []
    for way in (WAYS[0], *(way for way in WAYS if way.mu == HALF)):
        ends = [float(losses(way, pictures, seed, options.steps)[-TAIL:].mean()) for seed in range(options.seeds)]
        plain = plain or ends
        results[way.name]["loss"] = ends
        results[way.name]["loss_ratio"] = [one / base for one, base in zip(ends, plain, strict=True)]
        save(results, options)
    return 0


def save(results: dict[str, dict[str, Any]], options: OptimiserOptions) -> None:
    """Write and print what was measured so far."""
    for name, record in results.items():
        write_record(options.out, name, record | {"steps": options.steps})
        print(name, {key: value for key, value in record.items() if key != "machine"}, flush=True)


if __name__ == "__main__":
    sys.exit(run_script(OptimiserOptions, run))
