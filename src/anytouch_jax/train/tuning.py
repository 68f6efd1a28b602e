"""Tuning: a few parameters trained with all others frozen, such as the tokens of a new sensor.

It is the loop of `train.loop` with plain Adam on one device.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from anytouch_jax.config import Config, OptimConfig, RunConfig
from anytouch_jax.progress import bar
from anytouch_jax.train.loop import FitOptions, FitResult, Work, fit_work
from anytouch_jax.train.mesh import make_mesh
from anytouch_jax.train.pace import MeasuredPace
from anytouch_jax.train.progress import Advance, Log

TIMED = 16  # steps whose speed decides how many there are
MOST_STEPS = 10**9
SAVE_EVERY = 100


def tune_for_steps(config: Config, work: Work, *, rate: float, steps: int) -> FitResult:
    """Train `work` for `steps` by Adam, from `rate` down to 0 along a cosine. Nothing is stored."""
    options = FitOptions(mesh=_one_device(), display=_steps_bar)
    return fit_work(_adam(config, rate, steps), work, None, options)


def tune_for_seconds(
    config: Config,
    work: Work,
    *,
    rate: float,
    seconds: float,
    run_dir: Path | None,
    log: Log,
    timed: int = TIMED,
) -> FitResult:
    """Train `work` for about `seconds` by Adam, from `rate` down to 0 along a cosine.

    Args:
        config: The model's, of which `optim` and `run` are replaced.
        work: What is trained.
        rate: The first learning rate. It falls once the number of steps is known.
        seconds: Time after the first step, which is compiled.
        run_dir: Folder in which an interrupted training is kept, and continues. None keeps
            nothing.
        log: Gets one sentence at a time.
        timed: Steps whose speed decides how many there are.
    """
    pace = MeasuredPace(seconds, timed=timed)

    @contextlib.contextmanager
    def display(start: int, stop: int) -> Iterator[Advance]:
        with bar(round(seconds), "seconds of training") as advance:

            def show(row: Mapping[str, Any]) -> None:
                total = row.get("total_steps")
                advance(0 if total is None else round(seconds * (row["step"] + 1) / total))

            yield show

    options = FitOptions(pace=pace, log=log, mesh=_one_device(), display=display)
    return fit_work(_adam(config, rate, MOST_STEPS), work, run_dir, options)


@contextlib.contextmanager
def _steps_bar(start: int, stop: int) -> Iterator[Advance]:
    """Show a bar of the steps on a terminal, and nothing elsewhere."""
    with bar(stop, "steps") as advance:

        def show(row: Mapping[str, Any]) -> None:
            advance(row["step"] + 1)

        yield show


def _one_device() -> jax.sharding.Mesh:
    # The batches are small, and their rows need not divide among many devices.
    return make_mesh(1, devices=jax.devices()[:1])


def _adam(config: Config, rate: float, steps: int) -> Config:
    """Return the configuration of plain Adam (Kingma and Ba, 2015) with a cosine schedule."""
    optim = OptimConfig(learning_rate=rate, warmup=0, decay="cosine", beta2=0.999, weight_decay=0.0)
    run = RunConfig(steps=steps, save_every=SAVE_EVERY, keep=1, figure_every=0)
    return replace(config, optim=optim, run=run)
