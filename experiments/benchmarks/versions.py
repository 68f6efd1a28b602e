"""Versions of jax and flags of its CPU compiler, in turns: speed against error.

    python -m experiments.benchmarks.versions --python PATH PATH --preset tiny

Each PATH is the interpreter of an environment with another jax and the packages of this project. The interpreter that
runs the command is the baseline. A version and its flags are a process of their own, since flags hold for a process.
One process works at a time, and each round begins with another. A line for each row goes to `versions.jsonl`, and
`make results` makes the page from that file alone.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import PresetName
from anytouch_jax.errors import UserError
from experiments.benchmarks.speed import relative
from experiments.command import run_script
from experiments.records import write_record

ROOT = Path(__file__).resolve().parents[2]
NAME = "versions.jsonl"
NO_YNN = "--xla_cpu_experimental_ynn_fusion_type="
FLAGS = {
    "": "",
    "no YNNPACK": NO_YNN,
    "oneDNN": f"--xla_cpu_experimental_onednn_custom_call=true {NO_YNN}",
    "fast runtime": f"--xla_cpu_opt_preset=CPU_OPT_PRESET_FAST_RUNTIME {NO_YNN}",
    "concurrent schedule": f"--xla_cpu_scheduler_type=CPU_SCHEDULER_TYPE_CONCURRENCY_OPTIMIZED {NO_YNN}",
}
WORKS = ("stage1 clips", "stage2 align", "stage2 match", "embed one clip", "embed clips")
SINGLE = 10  # calls a round of what is timed one sample at a time


@dataclass(frozen=True)
class VersionOptions:
    """Time steps and embeddings under several versions of jax, with and without flags of its compiler."""

    python: tuple[Path, ...] = ()  # Interpreters to compare with this one.
    flags: tuple[str, ...] = tuple(FLAGS)  # Names of flags, for those interpreters.
    works: tuple[str, ...] = WORKS  # What is timed.
    dtypes: tuple[str, ...] = ("float32", "bfloat16")  # Types of the products.
    preset: PresetName = "tiny"  # Sizes of the network.
    batch: int = 16  # Samples of a step.
    rounds: int = 5  # Timed rounds.
    out: Path = ROOT / "experiments" / "results" / NAME  # JSON lines.
    worker: str = ""  # Used by the command itself.


# The process of one version ------------------------------------------------------------------------------------------


def work_on(options: VersionOptions) -> int:
    """Compile a workload, and time a call for each line that arrives."""
    from experiments.benchmarks import machine, speed
    from experiments.benchmarks.variants import Variant, compiled
    from experiments.benchmarks.workloads import first_state, workloads

    name, dtype = options.works[0], options.dtypes[0]
    several = workloads(name.split()[0], options.preset, options.batch)
    work = next(one for one in several if one.name == name)
    variant = Variant(dtype, {"dtype": dtype})
    state = first_state(variant.of(work).config)
    import jax

    touch = jax.device_put(jax.device_get({**state.trainable, **state.frozen})["touch"]) if not work.trains else None
    program = compiled(variant, work, state if work.trains else {"touch": touch})
    calls = speed.step_calls([program], state) if work.trains else speed.embed_calls([program], touch)
    text = program.call.as_text() or ""
    facts = {
        "jax": jax.__version__, "compile_s": program.compile_seconds, "temp_bytes": program.temp_bytes,
        "onednn": text.count("__onednn"), "ynnpack": text.count("__ynn"), "machine": asdict(machine.describe()),
    }  # fmt: skip
    calls[0]()
    print(json.dumps(facts), flush=True)
    for line in sys.stdin:
        question, _, path = line.strip().partition(" ")
        if question == "time":
            answer = speed.interleaved(calls, 1, [SINGLE if work.samples == 1 else 1])[0].ravel().tolist()
        else:
            answer = None
            chosen = replace(variant, model={"dtype": "float64"}) if question == "exact" else variant
            _write_values(Path(path), chosen, work)
        print(json.dumps(answer), flush=True)
    return 0


def _write_values(path: Path, variant: Any, work: Any) -> None:
    """Write what a workload computes on a few samples, in the types of `variant`."""
    import jax

    from anytouch_jax.train.step import merge
    from experiments.benchmarks import speed
    from experiments.benchmarks.workloads import first_state

    small, state = work.resized(min(work.samples, speed.ERROR_SAMPLES)), first_state(work.config)
    noise = np.random.default_rng(1).random((small.samples, small.config.model.patches)).astype(np.float32)
    values = speed.values_in(variant, small, jax.device_get(merge(state.trainable, state.frozen)), noise)
    arrays = {f"{name}/{number}": x for name, several in values.items() for number, x in enumerate(several)}
    np.savez(path, **{name: x.astype(np.float64) for name, x in arrays.items()})


# The command ----------------------------------------------------------------------------------------------------------


class _Worker:
    """A process of one version of jax with some flags."""

    def __init__(self, python: Path, flags: str, work: str, dtype: str, options: VersionOptions) -> None:
        command = [str(python), "-m", "experiments.benchmarks.versions", "--worker", "yes", "--works", work]
        command += ["--dtypes", dtype, "--preset", options.preset, "--batch", str(options.batch)]
        clean = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
        clean |= {"XLA_FLAGS": flags, "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}", "JAX_PLATFORMS": "cpu"}
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=clean, cwd=ROOT)
        self.facts = self._answer()

    def ask(self, question: str) -> Any:
        assert self._process.stdin
        self._process.stdin.write(question + "\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self._process.stdout
        line = self._process.stdout.readline()
        if not line:
            self.close()
            raise UserError(f"{' '.join(self._process.args)} failed. Its reason is above.")  # type: ignore[arg-type]
        return json.loads(line)

    def close(self) -> None:
        with self._process:  # its end closes the pipes
            self._process.kill()


@contextlib.contextmanager
def _workers(work: str, dtype: str, options: VersionOptions) -> Iterator[dict[str, _Worker]]:
    """Yield a process for each version and flag, the baseline first."""
    found: dict[str, _Worker] = {}
    try:
        for python, flags in [(Path(sys.executable), ""), *((p, f) for p in options.python for f in options.flags)]:
            one = _Worker(python, FLAGS[flags], work, dtype, options)
            found[f"jax {one.facts['jax']}{f', {flags}' if flags else ''}"] = one
            print(f"{work}, {dtype}: {list(found)[-1]}", file=sys.stderr, flush=True)
        yield found
    finally:
        for one in found.values():
            one.close()


def compare(work: str, dtype: str, options: VersionOptions) -> None:
    """Time one workload in one type under all versions, and store a line for each."""
    with _workers(work, dtype, options) as workers, tempfile.TemporaryDirectory() as folder:
        times: dict[str, list[np.ndarray]] = {name: [] for name in workers}
        names = list(workers)
        for turn in range(options.rounds):
            for name in names[turn % len(names) :] + names[: turn % len(names)]:
                times[name].append(np.array(workers[name].ask("time")))
        base = np.median(times[names[0]], 1)
        exact = _values_of(workers[names[0]], "exact", Path(folder))
        for name, one in workers.items():
            seconds = np.array(times[name])
            ratio = np.median(seconds, 1) / base
            low, high = np.percentile(ratio, [25, 75])
            record = one.facts | {
                "work": work, "dtype": dtype, "version": name, "preset": options.preset, "batch": options.batch,
                "ms": 1e3 * float(np.median(seconds)), "p99_ms": 1e3 * float(np.percentile(seconds, 99)),
                "ratio": float(np.median(ratio)), "ratio_low": float(low), "ratio_high": float(high),
                "error": _errors(_values_of(one, "values", Path(folder)), exact),
            }  # fmt: skip
            write_record(options.out, f"{options.preset}, {work}, {dtype}, {name}", record)
            print(f"{work}, {dtype}, {name}: {record['ms']:.1f} ms, {record['ratio']:.2f}", flush=True)


def _values_of(worker: _Worker, question: str, folder: Path) -> dict[str, np.ndarray]:
    worker.ask(f"{question} {folder / question}.npz")
    with np.load(folder / f"{question}.npz") as file:
        return dict(file)


def _errors(values: dict[str, np.ndarray], exact: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the relative L2 error of the output, the loss and the gradient."""
    found = {}
    for kind in dict.fromkeys(name.partition("/")[0] for name in exact):
        names = [name for name in exact if name.startswith(f"{kind}/")]
        found[kind] = relative([values[name] for name in names], [exact[name] for name in names])
    return found


def run(options: VersionOptions) -> int:
    """Compare versions for every workload and type. Raises UserError for an unknown name."""
    if options.worker:
        return work_on(options)
    for given, known, what in ((options.flags, FLAGS, "flags"), (options.works, WORKS, "works")):
        if unknown := sorted(set(given) - set(known)):
            raise UserError(f"{unknown[0]} is none of the {what}. Choose among {', '.join(map(repr, known))}.")
    for work in options.works:
        for dtype in options.dtypes:
            compare(work, dtype, options)
    return 0


if __name__ == "__main__":
    sys.exit(run_script(VersionOptions, run))
