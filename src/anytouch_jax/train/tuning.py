"""Tuning: a loaded model trained on, in part (the tokens of a new sensor) or whole (labels).

It is the loop of `train.loop` on one device. Nothing but the last function decays weights.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

from anytouch_jax.config import Config, OptimConfig, RunConfig
from anytouch_jax.progress import bar
from anytouch_jax.train.loop import FitOptions, FitResult, Tree, Work, fit_work
from anytouch_jax.train.mesh import make_mesh
from anytouch_jax.train.pace import Budget, MeasuredPace
from anytouch_jax.train.progress import Advance, Log, silent

TIMED = 16  # steps whose speed decides how many there are
MOST_STEPS = 10**9
SAVE_EVERY = 100


def tune_for_steps(config: Config, work: Work, *, rate: float, steps: int) -> FitResult:
    """Train `work` for `steps` by Adam, from `rate` down to 0 along a cosine. Nothing is stored.

    Args:
        config: with batch size and seed.
        work: parameters, loss and batches.
        rate: the first learning rate.
        steps: of the training.
    """
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


class Tuning(NamedTuple):
    """How a model is trained on a user's labels.

    Attributes:
        rate: the largest learning rate, which `Work.rates` scale.
        weight_decay: of matrices.
        steps: at most.
        until: time of `time.monotonic` at which it ends.
        watch_every: steps between calls of `watch`.
        seed: of all draws.
    """

    rate: float
    weight_decay: float
    steps: int
    until: float
    watch_every: int
    seed: int


def tune_watched(
    config: Config,
    work: Work,
    tuning: Tuning,
    watch: Callable[[float, Tree], None],
    ended: Callable[[], bool],
) -> FitResult:
    """Train `work` by AdamW while somebody watches, along a cosine. Nothing is stored.

    Args:
        config: the model's, of which `optim` and `run` are replaced.
        work: what is trained.
        tuning: how.
        watch: gets the ratio of the run that is done and all parameters.
        ended: ends the run once it is True.

    Raises:
        KeyboardInterrupt: at once, because nothing is stored that a step could damage.
    """
    optim = OptimConfig(
        learning_rate=tuning.rate,
        warmup=max(1, tuning.steps // 10),
        decay="cosine",
        beta2=0.999,
        weight_decay=tuning.weight_decay,
        # The first batches of labels are far from what the encoder was trained on.
        grad_clip=1.0,
    )
    run = RunConfig(
        steps=tuning.steps, save_every=0, figure_every=tuning.watch_every, seed=tuning.seed
    )
    # A figure that cannot be drawn does not end a run, but a look that fails must not pass.
    failed: list[Exception] = []
    pace = Budget(tuning.until, tuning.steps, lambda: bool(failed) or ended())

    def report(done: int, params: Tree, batch: Any) -> None:
        try:
            watch(float(pace.progress(done) or 0), params)
        except Exception as error:
            failed.append(error)

    options = FitOptions(
        pace=pace, on_report=report, log=silent, mesh=_one_device(), display=_no_display
    )
    result = fit_work(replace(config, optim=optim, run=run), work, None, options)
    if failed:
        raise failed[0]
    return result


@contextlib.contextmanager
def _no_display(start: int, stop: int) -> Iterator[Advance]:
    yield lambda row: None


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
