"""Speed against error: variants of a workload in turns in one process, and a float64 reference.

A variant's time is a ratio to the float32 baseline *of the same round*, so that a busy machine
slows both. Errors are those of the same parameters and the same batch computed in float64. Imports
nothing but jax, flax, optax, numpy.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.tables import plain
from anytouch_jax.train.step import merge
from experiments.benchmarks import machine
from experiments.benchmarks.variants import BASELINE, Program, Variant, cold, compiled, variants_of
from experiments.benchmarks.workloads import (
    Workload,
    first_state,
    make_batch,
    normalised,
    values_of,
)

Tree = Any
Log = Callable[[str], None]
NAN = float("nan")
ERROR_SAMPLES = 4  # the float64 reference of a large model takes twice the memory of a step
_LATENCY_CALLS = 20  # calls a round of what is timed one sample at a time


@dataclass(frozen=True)
class SpeedRow:
    """The figures of a variant.

    Seconds and ratios are medians over rounds, `*_iqr` their interquartile ranges.

    `operations`: useful ones a call (`workloads`); `peak_fraction` of the matrix product of the
    variant's own type, and `float32_fraction` of the float32 one, in the same rounds. `error_*`:
    relative L2 against float64 (of the loss: relative). `peak_bytes`: arguments, results and
    temporaries of the compiled program. `copies`: copy instructions in it. `p50`, `p99`: seconds of
    single calls.
    """

    workload: str
    variant: str
    samples: int
    seconds: float = NAN
    seconds_iqr: float = NAN
    ratio: float = NAN
    ratio_iqr: float = NAN
    operations: float = NAN
    peak_fraction: float = NAN
    float32_fraction: float = NAN
    p50: float = NAN
    p99: float = NAN
    calls: int = 0
    trace_seconds: float = NAN
    compile_seconds: float = NAN
    peak_bytes: int = 0
    temp_bytes: int = 0
    copies: int = 0
    error_output: float | None = None
    error_loss: float | None = None
    error_gradient: float | None = None
    note: str = ""

    @property
    def samples_per_second(self) -> float:
        return self.samples / self.seconds

    @property
    def gflops(self) -> float:
        """Useful operations a nanosecond."""
        return self.operations / self.seconds / 1e9


# Error
# --------------------------------------------------------------------------------------------------


def errors(variants: Sequence[Variant], work: Workload, params: Tree) -> list[dict[str, float]]:
    """Relative errors {"output", "loss", "gradient"} of each variant against float64, on a batch of
    a few samples.
    """
    small = work.resized(min(work.samples, ERROR_SAMPLES))
    rng = np.random.default_rng(1)
    noise = rng.random((small.samples, small.config.model.patches)).astype(np.float32)
    exact = values_in(replace(BASELINE, model={"dtype": "float64"}), small, params, noise)
    found = []
    for variant in variants:
        values = values_in(variant, small, params, noise)
        found.append({name: relative(values[name], exact[name]) for name in exact})
        del values
    return found


def values_in(
    variant: Variant, small: Workload, params: Tree, noise: Any
) -> dict[str, list[np.ndarray]]:
    """Return what a workload computes in the types of a variant, in float64 if it asks for that."""
    work = variant.of(small)
    wide = work.config.model.dtype == "float64"
    batch = normalised(make_batch(work))
    with jax.enable_x64(wide), cold(), jax.default_matmul_precision(variant.precision):
        if wide:
            params, batch, noise = jax.tree.map(widened, (params, batch, noise))
        values = jax.jit(values_of(work.config, work.trains))(params, batch, noise)
        return {
            name: [np.asarray(x) for x in jax.tree.leaves(value)] for name, value in values.items()
        }


def widened(x: Any) -> np.ndarray:
    """Return a float32 array as float64, and any other unchanged."""
    x = np.asarray(x)
    if x.dtype == np.float32:
        return x.astype(np.float64)
    return x


def relative(found: Sequence[np.ndarray], exact: Sequence[np.ndarray]) -> float:
    """||found - exact|| / ||exact|| over all arrays."""
    wrong = sum(
        float(np.sum(np.square(a.astype(np.float64) - b)))
        for a, b in zip(found, exact, strict=True)
    )
    right = sum(float(np.sum(np.square(b.astype(np.float64)))) for b in exact)
    if right:
        return (wrong / right) ** 0.5
    return wrong**0.5


# Timing
# --------------------------------------------------------------------------------------------------


def interleaved(
    calls: Sequence[Callable[[], object]], rounds: int, repeats: Sequence[int] | None = None
) -> list[Any]:
    """Seconds (rounds, repeats) of each call.

    All take turns, each round begins with another; one round warms up.
    """
    if rounds < 1 or not calls:
        raise UserError("a benchmark needs at least one round and one thing to time")
    repeats = repeats or [1] * len(calls)
    times = [np.zeros((rounds, count)) for count in repeats]
    for call in calls:
        call()
    for turn in range(rounds):
        for i in range(len(calls)):
            k = (i + turn) % len(calls)
            for again in range(repeats[k]):
                start = time.perf_counter()
                calls[k]()
                times[k][turn, again] = time.perf_counter() - start
    return times


def measure(
    work: Workload,
    variants: Sequence[Variant] | None = None,
    *,
    rounds: int = 9,
    with_errors: bool = True,
    peak_size: int | None = None,
    log: Log = lambda _: None,
) -> list[SpeedRow]:
    """The rows of a workload, the baseline first.

    A variant that cannot be compiled or run here is a row with a note.

    Raises UserError when there is no round, or when the baseline itself fails.
    """
    backend = jax.default_backend()
    variants = variants_of(work, backend) if variants is None else variants
    state = first_state(work.config)
    whole = jax.device_get(merge(state.trainable, state.frozen))
    programs = []
    failed = []
    for variant in variants:
        log(f"{work.name}: compiling {variant.name}")
        try:
            programs.append(
                compiled(variant, work, state if work.trains else {"touch": whole["touch"]})
            )
        except Exception as error:
            if variant == variants[0]:
                raise UserError(
                    f"{work.name}, {variant.name} cannot be compiled here: {error}"
                ) from error
            failed.append((variant, f"{type(error).__name__}: {str(error).splitlines()[0]}"))
    log(f"{work.name}: {rounds} rounds")
    peaks = {
        kind: machine.matmul(kind[0], peak_size, kind[1]) for kind in {_FULL, *map(_kind, programs)}
    }
    try:
        times = _timed(programs, work, whole, state, peaks, rounds)
    except RuntimeError:  # most often out of memory, at a first call: which of them can do it?
        del state
        gc.collect()
        programs, broken = _those_that_run(programs, work, whole)
        failed += broken
        times = _timed(programs, work, whole, first_state(work.config), peaks, rounds)
    gc.collect()
    best = {
        d: peaks[d][1] / float(np.median(t))
        for d, t in zip(peaks, times[len(programs) :], strict=True)
    }
    wrong: list[dict[str, float]] = [{} for _ in programs]
    if with_errors:
        log(f"{work.name}: errors against float64")
        try:
            wrong = errors([program.variant for program in programs], work, whole)
        except (
            RuntimeError
        ) as error:  # most often out of memory: the times are still worth something
            log(
                f"{work.name}: no errors, the float64 reference failed: "
                f"{str(error).splitlines()[0]}"
            )
    rows = [_row(p, times[i], times[0], best, wrong[i]) for i, p in enumerate(programs)]
    return rows + [_empty(work, variant, note) for variant, note in failed]


_FULL = ("float32", "highest")


def _kind(program: Program) -> tuple[str, str | None]:
    """Type and precision of a program's products: what peak it is to be compared with."""
    dtype = program.work.config.model.dtype
    return dtype, (program.variant.precision or "highest") if dtype == "float32" else None


def _timed(
    programs: Sequence[Program],
    work: Workload,
    whole: Tree,
    state: Tree,
    peaks: Mapping[Any, Any],
    rounds: int,
) -> list[Any]:
    """Seconds of every program, then of every peak."""
    calls = (
        step_calls(programs, state)
        if work.trains
        else embed_calls(programs, jax.device_put(whole["touch"]))
    )
    del state
    repeats = [_LATENCY_CALLS if work.samples == 1 else 1] * len(programs) + [1] * len(peaks)
    return interleaved([*calls, *(run for run, _ in peaks.values())], rounds, repeats)


def _those_that_run(
    programs: Sequence[Program], work: Workload, whole: Tree
) -> tuple[list[Program], list[tuple[Variant, str]]]:
    """The programs whose first call succeeds, and the others with the reason.

    Raises UserError for the baseline.
    """
    good = []
    failed = []
    for program in programs:
        try:
            if work.trains:
                step_calls([program], first_state(work.config))[0]()
            else:
                embed_calls([program], jax.device_put(whole["touch"]))[0]()
            good.append(program)
        except RuntimeError as error:
            reason = f"{type(error).__name__}: {str(error).splitlines()[0]}"
            if program is programs[0]:
                raise UserError(
                    f"{work.name}, {program.variant.name} cannot be run here: {reason}"
                ) from error
            failed.append((program.variant, reason))
        gc.collect()
    return good, failed


def step_calls(programs: Sequence[Program], state: Tree) -> list[Callable[[], object]]:
    """A call is a step of training that goes on from the state that the call before left, whichever
    variant it was.
    """
    held = [state]
    key = jax.random.key(0)

    def step(program: Program) -> object:
        held[0], metrics = program.call(held[0], program.batch, key)
        return jax.block_until_ready((held[0], metrics))

    return [partial(step, program) for program in programs]


def embed_calls(programs: Sequence[Program], touch: Tree) -> list[Callable[[], object]]:
    """A call takes pixels from the host and brings features back, as a control loop would."""
    return [
        partial(lambda p: np.asarray(p.call({"touch": touch}, *p.batch[:2])), program)
        for program in programs
    ]


def _row(
    program: Program, times: Any, base: Any, peaks: Mapping[Any, float], wrong: Mapping[str, float]
) -> SpeedRow:
    mine = np.median(times, axis=1)
    theirs = np.median(base, axis=1)
    seconds = float(np.median(mine))
    ratios = mine / theirs
    operations = program.work.operations
    rate = operations / seconds
    return SpeedRow(
        workload=program.work.name,
        variant=program.variant.name,
        samples=program.work.samples,
        seconds=seconds,
        seconds_iqr=_iqr(mine),
        ratio=float(np.median(ratios)),
        ratio_iqr=_iqr(ratios),
        operations=operations,
        peak_fraction=rate / peaks[_kind(program)],
        float32_fraction=rate / peaks[_FULL],
        p50=float(np.percentile(times, 50)),
        p99=float(np.percentile(times, 99)),
        calls=times.size,
        trace_seconds=program.trace_seconds,
        compile_seconds=program.compile_seconds,
        peak_bytes=program.peak_bytes,
        temp_bytes=program.temp_bytes,
        copies=program.copies,
        error_output=wrong.get("output"),
        error_loss=wrong.get("loss"),
        error_gradient=wrong.get("gradient"),
    )


def _empty(work: Workload, variant: Variant, note: str) -> SpeedRow:
    return SpeedRow(work.name, variant.name, work.samples, note=note)


def _iqr(values: Any) -> float:
    low, high = np.percentile(values, [25, 75])
    return float(high - low)


def record_of(row: Any) -> dict[str, Any]:
    """Return a record as JSON takes it: a number that is not finite is null."""
    values: dict[str, Any] = plain(row)
    if isinstance(row, SpeedRow):
        values |= plain({"samples_per_second": row.samples_per_second, "gflops": row.gflops})
    return values
