"""Training loop: compile, feed, log, save, continue.

Its side effects are here and in `progress.py`.
"""

import contextlib
import functools
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from anytouch_jax.config import Config, to_json
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.shown import shown_short
from anytouch_jax.train import mesh as meshes
from anytouch_jax.train import progress
from anytouch_jax.train.optim import RateFn, optimizer
from anytouch_jax.train.pace import Deadline, Pace, StepPace
from anytouch_jax.train.progress import Display, Log, Record, silent, to_stderr, writing
from anytouch_jax.train.step import (
    LossFn,
    Rules,
    StepFn,
    TrainedFn,
    TrainState,
    init_state,
    make_step,
    merge,
)
from anytouch_jax.weights.checkpoint import PARTIAL, Checkpoints

Tree = Any
Example = tuple[Any, Callable[[], Any]]  # the shapes of a batch, and a function that makes it
# Metrics of a step that its all-reduce of flags adds.
_SIGNAL = "signal"
_SKIPPED = "skipped_samples"
# batches(start, stop) -> (step, batch, numbers of the loader for the log) for each step of the
# range
Item = tuple[int, Any, Mapping[str, Any]]
Batches = Callable[[int, int], Iterator[Item]]
Report = Callable[[int, Tree, Any], None]


@shown_short
@dataclass(frozen=True)
class FitResult:
    """Result of a run or a part of one: the state after `step` steps, and the last metrics."""

    state: TrainState
    step: int
    metrics: dict[str, Any] = field(default_factory=dict)
    traces: int = 0  # how often the step was traced: once a batch structure
    resumed: int = 0  # the step that the run continued from
    interrupted: signal.Signals | None = None  # the signal that ended it early
    losses: tuple[float, ...] = ()  # of every step of the run, NaN where it was not finite

    @property
    def params(self) -> Tree:
        """All parameters, trained and frozen, as one nested dict."""
        return merge(self.state.trainable, self.state.frozen)


@dataclass(frozen=True)
class Work:
    """What a run trains, and from what.

    `params` are the first parameters; when a run continues, only their shapes matter. `loss_fn` and
    `trained` are those of `make_step`. `examples` are a batch of each structure, its shapes and a
    function that makes it, whose steps are compiled side by side. `metadata` goes into every
    checkpoint.
    """

    params: Tree
    loss_fn: LossFn
    batches: Batches
    trained: TrainedFn | None = None
    frozen: Rules | None = None  # (regex over parameter names, frozen?). None: `config.frozen`
    rates: RateFn | None = None  # factors on learning rates. None: those of `config.optim`
    examples: Sequence[Example] = ()
    metadata: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class FitOptions:
    """How a run goes: when it ends, on which devices, and what it reports.

    `stop_after` ends it after that many steps in all, without changing the schedule, and `pace` by
    time. `on_report(step, params, batch)` draws figures and must not keep the arrays. `display`
    gives a function for each line of metrics; None shows a bar on a terminal, with a `curve` of the
    loss, or writes lines to `log`.
    """

    stop_after: int | None = None
    pace: Pace | None = None
    on_report: Report | None = None
    log: Log | None = None
    mesh: Mesh | None = None
    curve: bool = False
    display: Display | None = None


def fit(  # noqa: PLR0913  a keyword for each field of both records, as before there were records
    config: Config,
    *,
    params: Tree,
    loss_fn: LossFn,
    batches: Batches,
    run_dir: Path | str,
    trained: TrainedFn | None = None,
    stop_after: int | None = None,
    on_report: Report | None = None,
    metadata: Mapping[str, Any] | None = None,
    log: Log | None = None,
    mesh: Mesh | None = None,
    curve: bool = False,
    until: float | None = None,
    examples: Sequence[Example] = (),
) -> FitResult:
    """Train `config.run.steps` steps in a run folder, or continue from its latest checkpoint.

    See `fit_work`, whose records have these fields. `until` ends the run at that time of
    `time.monotonic`, which the schedule then follows.
    """
    work = Work(params, loss_fn, batches, trained, examples=examples, metadata=metadata or {})
    pace = None if until is None else Deadline(until)
    options = FitOptions(stop_after, pace, on_report, log, mesh, curve)
    return fit_work(config, work, run_dir, options)


def fit_work(
    config: Config, work: Work, run_dir: Path | str | None, options: FitOptions | None = None
) -> FitResult:
    """Train `config.run.steps` steps in a run folder, or continue from its latest checkpoint.

    SIGTERM and Ctrl-C, in one of several processes, finish the step, save and return.

    Args:
        config: Its `optim` and `run` decide the optimiser, the schedule and what is saved.
        work: What is trained.
        run_dir: The run folder, made if it is missing. None keeps nothing, for work of a minute.
        options: How it goes.

    Raises:
        UserError: For settings that changed since the start, too many skipped steps in a row, a
            full disk, an unreadable checkpoint, and a folder that some process cannot see.
    """
    refuse_forked()
    options = options or FitOptions()
    mesh = options.mesh or meshes.make_mesh(fsdp=config.run.fsdp)
    log = options.log or to_stderr
    lead = jax.process_index() == 0
    if not lead:
        log = silent
    pace = options.pace or StepPace()
    stop = config.run.steps
    if options.stop_after is not None:
        stop = min(stop, options.stop_after)
    with contextlib.ExitStack() as stack:
        checkpoints = None
        if run_dir is not None:
            run_dir = Path(run_dir)
            checkpoints = _open(run_dir, config, work.metadata, stack)
        state, start = _first_state(config, work, checkpoints, mesh)
        record = Record(run_dir, start, tensorboard=config.run.tensorboard, lead=lead)
        stack.enter_context(contextlib.closing(record))
        pace.resume(record.last)
        stop = min(stop, pace.total or stop)
        if start:
            of_total = f" of {pace.total}" if pace.total else ""
            log(f"continuing from the checkpoint of step {start}{of_total}")
        if start >= stop:
            log(f"nothing to do: {start} of {pace.total or config.run.steps} steps are done")
            return FitResult(state, start, resumed=start, losses=tuple(record.losses))
        if checkpoints is not None:
            checkpoints.check_space(state)
        display = options.display
        if display is None:
            display = functools.partial(progress.progress, log=log, curve=options.curve)
        advance = stack.enter_context(display(start, stop))
        loop = _Loop(config, work, mesh, checkpoints, record, log, advance, options.on_report, pace)
        interrupt: list[signal.Signals] = []
        if checkpoints is not None:
            # Where nothing is kept, a signal ends the work at once.
            interrupt = stack.enter_context(progress.signals())
        result = loop.run(state, start, stop, interrupt)
    if result.interrupted and run_dir is not None:
        # After the bar has gone, which would draw over the line.
        log(
            f"stopped by {result.interrupted.name} after step {result.step} and saved in "
            f"{run_dir}, the same command continues from here"
        )
    return result


def _open(
    run_dir: Path, config: Config, metadata: Mapping[str, Any], stack: contextlib.ExitStack
) -> Checkpoints:
    """Make, lock and check a run folder until `stack` ends, and return its checkpoints."""
    if jax.process_index() == 0:
        stack.enter_context(progress.alone_in(run_dir))
        progress.open_run(run_dir, config)
    else:
        # each process reports a changed setting
        progress.continues(run_dir, config)
    meshes.check_shared(run_dir / "figures")
    folder = run_dir / "checkpoints"
    with writing(folder):
        checkpoints = Checkpoints(
            folder, keep=config.run.keep, config_json=to_json(config), metadata=dict(metadata)
        )
    stack.push(checkpoints.leave)
    return checkpoints


@dataclass
class _Loop:
    """The loop, and its state between steps."""

    config: Config
    work: Work
    mesh: Mesh
    checkpoints: Checkpoints | None
    record: Record
    log: Log
    advance: Callable[[Mapping[str, Any]], None]
    on_report: Report | None
    pace: Pace
    # the step before, whose metrics are read while the next one runs
    pending: tuple[int, dict[str, jax.Array], dict[str, Any]] | None = None
    row: dict[str, Any] = field(default_factory=dict)
    # since the last checkpoint: their mean decides which is the best
    losses: list[float] = field(default_factory=list)
    traces: int = 0
    # the signal that one of several processes received
    shared_signal: signal.Signals | None = None
    waited: float = 0.0

    def __post_init__(self) -> None:
        self.flags = meshes.FlagReduction(self.mesh) if jax.process_count() > 1 else None
        self.clock = time.perf_counter()
        self.last = LastStep()

    def run(
        self, state: TrainState, start: int, stop: int, interrupt: list[signal.Signals]
    ) -> FitResult:
        """Run steps `start` to `stop`, or until a signal arrives or the pace ends it."""
        every = self.config.run.save_every
        figures = self.config.run.figure_every
        sharding = meshes.batch_sharding(self.mesh)
        # Under jit, for the devices of other processes too; and without a transfer of the seed.
        seed_key = jax.jit(
            lambda: jax.random.key(self.config.run.seed), out_shardings=meshes.replicated(self.mesh)
        )()
        step_fn = self.ahead(self.compile(state), state, seed_key)
        done = start
        saved = start
        reported = start
        placed = None
        with contextlib.closing(self.awaited(start, stop)) as feed:
            for step, batch, info in feed:
                placed = meshes.put_batch(batch, sharding)
                state, metrics = step_fn(state, placed, seed_key, *self.progress(step))
                if self.flags:
                    received = int(interrupt[0]) if interrupt else 0
                    flags = self.flags.cast(received, int(info.get(_SKIPPED, 0)))
                    metrics = metrics | dict(zip((_SIGNAL, _SKIPPED), flags, strict=True))
                # Those of the step before, while this one runs: reading them waits for the device,
                # which would then have nothing to do until the next batch is there.
                self.log_metrics()
                self.last.began(metrics)
                done = step + 1
                is_over = self.pace.stepped(done, metrics)
                samples = jax.tree.leaves(batch)[0].shape[0] * jax.process_count()
                numbers = {"samples": samples} | dict(info) | self.pace.numbers()
                self.pending = (step, metrics, numbers)
                if every > 0 and done % every == 0:
                    saved = self.save(done, state, done - saved)
                if figures > 0 and done % figures == 0:
                    reported = self.report(done, state, placed)
                if is_over or self.signalled(interrupt):
                    break
        if saved < done:
            self.save(done, state, done - saved)
        if self.checkpoints is not None:
            self.checkpoints.wait()
        signalled = self.signalled(interrupt)
        if figures > 0 and reported < done and not signalled:
            self.report(done, state, placed)
        losses = tuple(self.record.losses)
        return FitResult(state, done, self.row, self.traces, start, signalled, losses)

    def signalled(self, interrupt: list[signal.Signals]) -> signal.Signals | None:
        """Return the signal that ends the run, the same in each of several processes."""
        if self.flags:
            return self.shared_signal
        return next(iter(interrupt), None)

    def ahead(self, step_fn: Any, state: TrainState, key: jax.Array) -> Callable[..., Any]:
        """Return the step, compiled for the batch of each example side by side.

        Others compile when they come.
        """
        examples = self.work.examples

        def form(batch: Any) -> Any:
            shapes = tuple((x.shape, x.dtype) for x in jax.tree.leaves(batch))
            return jax.tree.structure(batch), shapes

        sharding = meshes.batch_sharding(self.mesh)

        def build(shapes: Any) -> tuple[Any, Any]:
            def placed(x: Any) -> jax.ShapeDtypeStruct:
                return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding)

            batch = jax.tree.map(placed, shapes)
            return form(batch), step_fn.lower(state, batch, key, *self.progress(0)).compile()

        if len(examples) < 2:
            return step_fn
        # XLA compiles outside of Python's lock, so that two steps and the programs that make their
        # batches take as long as the slowest.
        with ThreadPoolExecutor(2 * len(examples)) as pool:
            made = [pool.submit(make) for _, make in examples]
            programs = dict(pool.map(build, [shapes for shapes, _ in examples]))
            for one in made:
                one.result()

        def compiled(state: TrainState, batch: Any, *rest: Any) -> Any:
            return programs.get(form(batch), step_fn)(state, batch, *rest)

        return compiled

    def progress(self, step: int) -> tuple[np.float32, ...]:
        """Return the last arguments of a step: its progress, or nothing where it knows its own."""
        ratio = self.pace.progress(step)
        return () if ratio is None else (ratio,)

    def awaited(self, start: int, stop: int) -> Generator[Item, None, None]:
        """Yield the batches of steps `start` to `stop`, and count the time that lacked one.

        Raises UserError if they end early. Closes their source.
        """
        source = self.work.batches(start, stop)
        expected = start
        requested = time.perf_counter()
        try:
            for step, batch, info in source:
                if step != expected:
                    raise ValueError(f"the batches gave step {step} instead of step {expected}")
                # The device waits from the end of the step before. While that step runs, a late
                # batch costs nothing.
                ended = self.last.ended() if self.pending else requested
                if ended is not None:
                    self.waited += time.perf_counter() - max(requested, ended)
                yield step, batch, info
                expected = expected + 1
                requested = time.perf_counter()
                if expected == stop:
                    return
            raise UserError(
                f"the data ended after {expected} of {stop} steps. Pass batches for every step."
            )
        finally:
            # A loader's threads stop. A plain iterator has nothing to close.
            close = getattr(source, "close", None)
            if close is not None:
                close()

    def compile(self, state: TrainState) -> StepFn:
        """Return the jitted step, traced once a batch structure.

        It keeps the sharding of the state.
        """
        step = make_step(
            meshes.gathering(self.work.loss_fn, self.mesh),
            optimizer(self.config, self.work.rates),
            total_steps=self.config.run.steps,
            accumulate=self.config.optim.accumulate,
            trained=self.work.trained,
        )

        @functools.wraps(step)
        def counted(*args: Any) -> Any:
            self.traces += 1
            return step(*args)

        places = jax.tree.map(lambda x: x.sharding, state)
        return jax.jit(
            counted,
            donate_argnums=meshes.donated(),
            out_shardings=(places, meshes.replicated(self.mesh)),
        )

    def log_metrics(self) -> None:
        """Fetch and write the metrics of the pending step.

        Raises UserError when too many steps were skipped in a row.
        """
        if self.pending is None:
            return
        step, metrics, info = self.pending
        self.pending = None
        numbers = jax.device_get(metrics)
        if number := int(numbers.pop(_SIGNAL, 0)):
            self.shared_signal = signal.Signals(number)
        if _SKIPPED in numbers:  # the sum over all processes
            info[_SKIPPED] = int(numbers.pop(_SKIPPED))
        now = time.perf_counter()
        elapsed = max(now - self.clock, 1e-9)
        rate = {"samples_per_second": info["samples"] / elapsed}
        rate |= {"wait": self.waited, "wait_fraction": self.waited / elapsed}
        self.clock = now
        self.waited = 0.0
        self.row = self.record.write(step, {"loss": numbers["loss"]} | numbers | info | rate)
        if self.row["loss"] is not None:
            self.losses.append(self.row["loss"])
        self.advance(self.row)
        if self.record.in_a_row > self.config.run.max_skipped:
            raise UserError(
                f"{self.record.in_a_row} steps in a row, up to step {step}, had a loss or a "
                "gradient that is not finite and were skipped. In another run folder, lower "
                "--optim.learning-rate, set --optim.grad-clip, or look for NaN in the data."
            )

    def save(self, done: int, state: TrainState, since: int) -> int:
        """Write a checkpoint in the background, after the metrics of its `since` steps.

        Its loss is the mean over these steps, marked `partial` for few steps, because it could be
        the best by chance. Returns `done`.
        """
        # The lines come first: a checkpoint never has steps that metrics.jsonl lacks.
        self.log_metrics()
        if self.checkpoints is None:
            return done
        self.record.sync()
        metrics = {
            name: value for name, value in self.row.items() if isinstance(value, int | float)
        }
        if self.losses:
            metrics["loss"] = sum(self.losses) / len(self.losses)
        if since < self.config.run.save_every:
            metrics[PARTIAL] = 1
        with writing(self.checkpoints.folder):
            self.checkpoints.save(done, state, metrics)
        self.losses = []
        return done

    def report(self, done: int, state: TrainState, batch: Any) -> int:
        """Draw figures. An error in them does not end the run."""
        if self.on_report is not None:
            self.log_metrics()
            params = merge(state.trainable, state.frozen)
            try:
                self.on_report(done, meshes.gather(params), meshes.gather(batch))
            except Exception as error:
                self.log(f"no figures at step {done}: {type(error).__name__}: {error}")
        return done


def _first_state(
    config: Config, work: Work, checkpoints: Checkpoints | None, mesh: Mesh
) -> tuple[TrainState, int]:
    """Return the state of the latest checkpoint and its step, or a new one, sharded over the mesh.

    A checkpoint counts when it is complete.
    """
    init = functools.partial(init_state, config=config, frozen=work.frozen)
    shapes = jax.eval_shape(init, work.params)
    places = meshes.state_sharding(shapes, mesh)
    if checkpoints is not None:
        # All processes continue from the step that process 0 sees.
        latest = meshes.broadcast(checkpoints.latest() or 0)
        if latest:

            def wanted(x: Any, at: Any) -> jax.ShapeDtypeStruct:
                return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=at)

            return checkpoints.restore(jax.tree.map(wanted, shapes, places), latest), latest
    params = meshes.put_state(work.params, meshes.state_sharding(work.params, mesh))
    return jax.jit(init, out_shardings=places)(params), 0


class LastStep:
    """The time at which the latest step ended. A thread waits for it."""

    def __init__(self) -> None:
        self._end: list[float] = []

    def began(self, metrics: Mapping[str, Any]) -> None:
        """Wait for the step that returns these metrics."""
        end = self._end = []  # the thread of an older step has another list

        def wait() -> None:
            # the loop raises the error when it reads the metrics
            with contextlib.suppress(Exception):
                jax.block_until_ready(metrics)
                end.append(time.perf_counter())

        # A daemon thread: a step never ends when a process is lost, but the run must.
        threading.Thread(target=wait, name="last step", daemon=True).start()

    def ended(self) -> float | None:
        """Return when the step ended, or None if it still runs or failed."""
        if self._end:
            return self._end[0]
        return None
