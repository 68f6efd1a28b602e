"""A small loss with two heads, its batches and configs; run as a script it trains, for the tests
that kill it.
"""

import dataclasses
import itertools
import os
import signal
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Config, DataConfig, OptimConfig, RunConfig, preset

ROWS = 8
PIXELS = 12
WIDTH = 4


def toy_config(
    *, steps: int = 8, optim: dict | None = None, data: dict | None = None, **run
) -> Config:
    tiny = preset("tiny")
    settings = {"save_every": 3, "figure_every": 0, "steps": steps, "max_skipped": 3} | run
    return dataclasses.replace(
        tiny,
        optim=OptimConfig(**({"learning_rate": 0.05, "warmup": 2} | (optim or {}))),
        data=DataConfig(**({"batch_size": ROWS} | (data or {}))),
        run=RunConfig(**settings),
    )


def toy_params(wide: int = WIDTH) -> dict:
    """Two heads, of which a batch uses one; a frozen table; a head that nothing uses."""
    rng = np.random.default_rng(0)

    def draw(*shape):
        return rng.normal(size=shape).astype(np.float32)

    return {
        "trunk": {"kernel": draw(PIXELS, wide), "bias": draw(wide)},
        "decoder": {
            "position": draw(wide),
            "still_head": {"kernel": draw(wide, 2)},
            "clip_head": {"kernel": draw(wide, 3)},
        },
        "idle": {"kernel": draw(3, 3)},
    }


def toy_loss(params, batch, key, progress):
    """Mean square of a head's output plus noise: the still head for one frame, the clip head for
    more.

    A sensor of -1 makes it NaN.
    """
    pixels = batch.clip.astype(jnp.float32) / 255.0
    flat = pixels.reshape(*pixels.shape[:2], -1).mean(1)
    trunk = params["trunk"]
    decoder = params["decoder"]
    hidden = jnp.tanh(flat @ trunk["kernel"] + trunk["bias"][None] + decoder["position"][None])
    kind = "still_head" if batch.clip.shape[1] == 1 else "clip_head"
    out = hidden @ decoder[kind]["kernel"]
    noise = jax.random.uniform(key)
    loss = jnp.mean(jnp.square(out - 0.1 * noise)) * jnp.where(batch.sensor[0] < 0, jnp.nan, 1.0)
    return loss, {"reconstruction": loss, "p_u": 0.75 * progress}


def toy_trained(batch):
    """The rules of which parameters a batch trains."""
    still = batch.clip.shape[1] == 1
    return (("still_head", still), ("clip_head", not still), ("idle", False), ("", True))


def toy_batch(step: int, *, rows: int = ROWS, bad: bool = False) -> TouchBatch:
    """Stills on even steps, clips on odd ones; a function of the step alone."""
    rng = np.random.default_rng((7, step))
    frames = 1 if step % 2 == 0 else 4
    clip = rng.integers(0, 256, (rows, frames, 2, 2, 3), dtype=np.uint8)
    return TouchBatch(clip, np.full(rows, -1 if bad else 0, np.int32))


def toy_batches(start: int, stop: int, *, bad=()):
    for step in range(start, stop):
        yield step, toy_batch(step, bad=step in bad), {"samples": ROWS, "skipped_samples": 0}


def stopping_batches(start: int, stop: int, *, at: int, number: int):
    """Like toy_batches, but sends this process a signal before step `at`."""
    for item in itertools.islice(toy_batches(start, stop), stop - start):
        if item[0] == at:
            os.kill(os.getpid(), number)
        yield item


def main(run_dir: str, at: int, number: int) -> None:
    """Train in `run_dir`; at step `at` (or never, if -1) this process gets the signal `number`."""
    from anytouch_jax.train.loop import fit

    def batches(start, stop):
        return stopping_batches(start, stop, at=at, number=number)

    result = fit(
        toy_config(), params=toy_params(), loss_fn=toy_loss, batches=batches, run_dir=Path(run_dir)
    )
    sys.exit(130 if result.interrupted == signal.SIGINT else 0)


if __name__ == "__main__":
    jax.config.update("jax_num_cpu_devices", 4)
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
