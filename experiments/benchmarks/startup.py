"""How long a fresh process takes to its first step: imports, tracing, compiling, without and with the cache."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import jax

from anytouch_jax.evaluate.statistics import markdown
from anytouch_jax.train.mesh import donated, enable_compilation_cache
from experiments.benchmarks.memory import ask
from experiments.benchmarks.workloads import abstract_state, make_batch, step_of, workloads

# Programs of training: what to ask `workloads` for, its name there, the recipe (the release reconstructs in stage 2).
STAGE1 = (("stage1", "stage1 clips", "paper"),)
STEPS = (
    *STAGE1,
    ("stage2", "stage2 align", "paper"),
    ("stage2", "stage2 match", "paper"),
    ("stage2", "stage2 align", "release"),
)


@dataclass(frozen=True)
class Start:
    """Seconds of a fresh process; `imports` counts from its start. `cached`: it finds its program in the cache."""

    workload: str
    recipe: str
    preset: str
    samples: int
    cached: bool
    imports: float
    trace: float
    compile: float

    @property
    def total(self) -> float:
        return self.imports + self.trace + self.compile


def starts(preset: str, steps: Sequence[tuple[str, str, str]] = STEPS, batch: int | None = None) -> list[Start]:
    """Two fresh processes for each of `steps`: one fills a new cache, the next reads it."""
    found = []
    for step in steps:
        with tempfile.TemporaryDirectory() as folder:
            for cached in (False, True):
                found.append(Start(**ask("startup", json.dumps([*step, preset, batch, cached, folder, time.time()]))))
    return found


def answer(question: str) -> None:
    """What the child process does."""
    what, name, recipe, preset, batch, cached, folder, begun = json.loads(question)
    enable_compilation_cache(folder)
    work = next(work for work in workloads(what, preset, batch, recipe) if work.name == name)
    args = abstract_state(work.config), make_batch(work), jax.eval_shape(lambda: jax.random.key(0))
    imports, ready = time.time() - begun, time.perf_counter()
    lowered = jax.jit(step_of(work.config), donate_argnums=donated()).lower(*args)
    traced = time.perf_counter()
    lowered.compile()
    done = time.perf_counter()
    start = Start(work.name, recipe, preset, work.samples, cached, imports, traced - ready, done - traced)
    sys.stdout.write(json.dumps(asdict(start)) + "\n")


def to_markdown(found: Sequence[Start]) -> str:
    """A line a process."""
    heads = ("workload", "recipe", "preset", "batch", "cache", "imports s", "trace s", "compile s", "sum s")
    rows = [
        [s.workload, s.recipe, s.preset, str(s.samples), "filled" if s.cached else "empty"]
        + [f"{x:.2f}" for x in (s.imports, s.trace, s.compile, s.total)]
        for s in found
    ]
    return markdown(heads, rows) + "\n"
