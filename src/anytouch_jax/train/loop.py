"""The training loop: compile, feed, log, save, continue.

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
from anytouch_jax.train.optim import optimizer
from anytouch_jax.train.progress import Log, Record, silent, to_stderr, writing
from anytouch_jax.train.step import LossFn, TrainedFn, TrainState, init_state, make_step, merge
from anytouch_jax.weights.checkpoint import PARTIAL, Checkpoints

Tree = Any
Example = tuple[Any, Callable[[], Any]]  # the shapes of a batch, and a function that makes it
# the metrics of a step that its ballot adds
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
    """The result of a run or a part of one: the state after `step` steps and the last line of
    metrics.
    """

    state: TrainState
    step: int
    metrics: dict[str, Any] = field(default_factory=dict)
    traces: int = 0  # how often the step was traced: once a batch structure
    resumed: int = 0  # the step that the run continued from
    interrupted: signal.Signals | None = None  # the signal that ended it early

    @property
    def params(self) -> Tree:
        """All parameters, trained and frozen, as one nested dict."""
        return merge(self.state.trainable, self.state.frozen)


def fit(
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
    """Train `config.run.steps` steps in a run folder, or continue from its latest complete
    checkpoint.

    `params` are the first parameters; when a run continues, only their shapes matter. `loss_fn` and
    `trained` are those of `make_step`. `stop_after` ends the run after that many steps in all,
    without changing the schedule. `on_report(step, params, batch)` draws figures and must not keep
    the arrays. `curve` shows the loss on a terminal. `until` ends the run at that time of
    `time.monotonic`, which the schedule then follows. `examples` are a batch of each structure, its
    shapes and a function that makes it, whose steps are compiled side by side. SIGTERM and Ctrl-C,
    in one of several processes, finish the step, save and return. Raises UserError for settings
    that changed since the start, too many skipped steps in a row, a full disk, an unreadable
    checkpoint, and a folder that some process cannot see.
    """
    refuse_forked()
    run_dir = Path(run_dir)
    mesh = mesh or meshes.make_mesh(fsdp=config.run.fsdp)
    log = log or to_stderr
    lead = jax.process_index() == 0
    stop = min(config.run.steps, config.run.steps if stop_after is None else stop_after)
    with contextlib.ExitStack() as stack:
        if lead:
            stack.enter_context(progress.alone_in(run_dir))
            progress.open_run(run_dir, config)
        else:
            # each process reports a changed setting
            progress.continues(run_dir, config)
            log = silent
        meshes.check_shared(run_dir / "figures")
        with writing(folder := run_dir / "checkpoints"):
            text = to_json(config)
            about = dict(metadata or {})
            checkpoints = Checkpoints(
                folder, keep=config.run.keep, config_json=text, metadata=about
            )
        stack.push(checkpoints.leave)
        state, start = _first_state(config, params, checkpoints, mesh)
        if start:
            log(f"continuing from the checkpoint of step {start}")
        if start >= stop:
            log(f"nothing to do: {start} of {config.run.steps} steps are done")
            return FitResult(state, start, resumed=start)
        checkpoints.check_space(state)
        record = Record(run_dir, start, tensorboard=config.run.tensorboard, lead=lead)
        stack.enter_context(contextlib.closing(record))
        advance = stack.enter_context(progress.progress(start, stop, log, curve=curve))
        loop = _Loop(config, mesh, checkpoints, record, log, advance, on_report, until)
        interrupt = stack.enter_context(progress.signals())
        return loop.run(state, start, stop, batches, loss_fn, trained, interrupt, examples)


@dataclass
class _Loop:
    """The loop, and its state between steps."""

    config: Config
    mesh: Mesh
    checkpoints: Checkpoints
    record: Record
    log: Log
    advance: Callable[[Mapping[str, Any]], None]
    on_report: Report | None
    until: float | None = None
    begun: float | None = None  # when the first step had ended, in a run for a time
    pending: tuple[int, dict[str, jax.Array], dict[str, Any]] | None = None
    row: dict[str, Any] = field(default_factory=dict)
    # since the last checkpoint: their mean decides which is the best
    losses: list[float] = field(default_factory=list)
    traces: int = 0
    # the signal that one of several processes received
    shared_signal: signal.Signals | None = None
    waited: float = 0.0

    def __post_init__(self) -> None:
        self.ballot = meshes.Ballot(self.mesh) if jax.process_count() > 1 else None
        self.clock = time.perf_counter()
        self.last = LastStep()

    def run(
        self,
        state: TrainState,
        start: int,
        stop: int,
        batches: Batches,
        loss_fn: LossFn,
        trained: TrainedFn | None,
        interrupt: list[signal.Signals],
        examples: Sequence[Example] = (),
    ) -> FitResult:
        """Run steps `start` to `stop`, or until a signal arrives."""
        every = self.config.run.save_every
        figures = self.config.run.figure_every
        step_fn = self.compile(state, loss_fn, trained)
        sharding = meshes.batch_sharding(self.mesh)
        # Under jit, for the devices of other processes too; and without a transfer of the seed.
        seed_key = jax.jit(
            lambda: jax.random.key(self.config.run.seed), out_shardings=meshes.replicated(self.mesh)
        )()
        step_fn = self.ahead(step_fn, state, seed_key, examples)
        done = start
        saved = start
        reported = start
        placed = None
        with contextlib.closing(self.awaited(batches, start, stop)) as feed:
            for step, batch, info in feed:
                placed = meshes.put_batch(batch, sharding)
                state, metrics = step_fn(state, placed, seed_key, *self.progress())
                if self.ballot:
                    votes = self.ballot.cast(
                        int(interrupt[0]) if interrupt else 0, int(info.get(_SKIPPED, 0))
                    )
                    metrics = metrics | dict(zip((_SIGNAL, _SKIPPED), votes, strict=True))
                self.log_metrics()  # of the step before, while this one runs
                self.last.began(metrics)
                samples = jax.tree.leaves(batch)[0].shape[0] * jax.process_count()
                self.pending = (step, metrics, {"samples": samples} | dict(info))
                done = step + 1
                if self.until is not None and self.begun is None:  # compiled
                    jax.block_until_ready(metrics)
                    self.begun = time.monotonic()
                if every > 0 and done % every == 0:
                    saved = self.save(done, state, done - saved)
                if figures > 0 and done % figures == 0:
                    reported = self.report(done, state, placed)
                if self.shared_signal if self.ballot else interrupt:
                    break
                if self.until is not None and time.monotonic() >= self.until:
                    break
        if saved < done:
            self.save(done, state, done - saved)
        self.checkpoints.wait()
        signalled = self.shared_signal if self.ballot else next(iter(interrupt), None)
        if figures > 0 and reported < done and not signalled:
            self.report(done, state, placed)
        if signalled:
            self.log(
                f"stopped by {signalled.name} after step {done} and saved, the same command "
                "continues from here"
            )
        return FitResult(state, done, self.row, self.traces, start, signalled)

    def ahead(
        self, step_fn: Any, state: TrainState, key: jax.Array, examples: Sequence[Example]
    ) -> Callable[..., Any]:
        """Return the step, compiled for the batch of each example side by side.

        Others compile when they come.
        """

        def form(batch: Any) -> Any:
            return jax.tree.structure(batch), tuple(
                (x.shape, x.dtype) for x in jax.tree.leaves(batch)
            )

        sharding = meshes.batch_sharding(self.mesh)

        def build(shapes: Any) -> tuple[Any, Any]:
            batch = jax.tree.map(
                lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), shapes
            )
            return form(batch), step_fn.lower(state, batch, key, *self.progress()).compile()

        if len(examples) < 2:
            return step_fn
        with ThreadPoolExecutor(2 * len(examples)) as pool:
            made = [pool.submit(make) for _, make in examples]
            programs = dict(pool.map(build, [shapes for shapes, _ in examples]))
            for one in made:
                one.result()
        return lambda state, batch, *rest: programs.get(form(batch), step_fn)(state, batch, *rest)

    def progress(self) -> tuple[np.float32, ...]:
        """Return the share of the time that has passed, nothing in a run of a given number of
        steps.
        """
        if self.until is None:
            return ()
        if self.begun is None:
            return (np.float32(0),)
        return (
            np.float32(
                min((time.monotonic() - self.begun) / max(self.until - self.begun, 1e-3), 1.0)
            ),
        )

    def awaited(self, batches: Batches, start: int, stop: int) -> Generator[Item, None, None]:
        """Yield the batches of steps `start` to `stop` in order, count the time without one, and
        close their source.
        """
        source = batches(start, stop)
        expected = start
        requested = time.perf_counter()
        try:
            for step, batch, info in source:
                if step != expected:
                    raise ValueError(f"the batches gave step {step} instead of step {expected}")
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
            getattr(source, "close", lambda: None)()

    def compile(
        self, state: TrainState, loss_fn: LossFn, trained: TrainedFn | None
    ) -> Callable[..., tuple[TrainState, dict[str, jax.Array]]]:
        """Return the jitted step, which keeps the sharding of the state and is traced once a batch
        structure.
        """
        loss_fn = meshes.gathering(loss_fn, self.mesh)
        tx = optimizer(self.config)
        options = self.config.optim
        step = make_step(
            loss_fn,
            tx,
            total_steps=self.config.run.steps,
            accumulate=options.accumulate,
            trained=trained,
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
        """Fetch and write the metrics of the pending step; stop the run when too many were skipped
        in a row.
        """
        if self.pending is None:
            return
        (step, metrics, info) = self.pending
        self.pending = None
        numbers = jax.device_get(metrics)
        if number := int(numbers.pop(_SIGNAL, 0)):
            self.shared_signal = signal.Signals(number)
        if _SKIPPED in numbers:  # the sum over all processes
            info[_SKIPPED] = int(numbers.pop(_SKIPPED))
        now = time.perf_counter()
        elapsed = max(now - self.clock, 1e-9)
        rate = {"samples_per_second": info["samples"] / elapsed}
        rate |= {"wait": self.waited, "wait_share": self.waited / elapsed}
        self.clock = now
        self.waited = 0.0
        self.row = self.record.write(step, {"loss": numbers["loss"]} | numbers | info | rate)
        self.losses += [] if self.row["loss"] is None else [self.row["loss"]]
        self.advance(self.row)
        if self.record.in_a_row > self.config.run.max_skipped:
            raise UserError(
                f"{self.record.in_a_row} steps in a row, up to step {step}, had a loss or a "
                "gradient that is not "
                "finite and were skipped. In another run folder, lower --optim.learning-rate, set "
                "--optim.grad-clip, "
                "or look for NaN in the data."
            )

    def save(self, done: int, state: TrainState, since: int) -> int:
        """Write a checkpoint in the background, after the metrics of its `since` steps, and return
        `done`.

        Its loss is the mean over these steps, marked `partial` for few steps: it could be the best
        by chance.
        """
        self.log_metrics()
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
            try:
                self.on_report(
                    done, meshes.gather(merge(state.trainable, state.frozen)), meshes.gather(batch)
                )
            except Exception as error:
                self.log(f"no figures at step {done}: {type(error).__name__}: {error}")
        return done


def _first_state(
    config: Config, params: Tree, checkpoints: Checkpoints, mesh: Mesh
) -> tuple[TrainState, int]:
    """Return the state of the latest complete checkpoint and its step, or a new state, sharded over
    the mesh.
    """
    init = functools.partial(init_state, config=config)
    shapes = jax.eval_shape(init, params)
    places = meshes.state_sharding(shapes, mesh)
    if latest := meshes.broadcast(checkpoints.latest() or 0):
        wanted = jax.tree.map(
            lambda x, at: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=at), shapes, places
        )
        return checkpoints.restore(wanted, latest), latest
    return jax.jit(init, out_shardings=places)(
        meshes.put_state(params, meshes.state_sharding(params, mesh))
    ), 0


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
