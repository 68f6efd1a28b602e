"""Benchmarks of compilation: memory and communication on 1 to 64 devices, and the first step of a fresh process.

No such devices are needed: memory and communication are read from the compiled program. A child process with that many
simulated CPU devices compiles the very step that `train.loop.fit` would run, from
shapes alone. What a compiler for real accelerators adds is not in it: it may overlap communication, merge small
messages, and turn an all-reduce whose result is cut up at once into a reduce-scatter (half the bytes).
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import jax

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import markdown_table
from anytouch_jax.train.mesh import (
    batch_sharding,
    donated,
    enable_compilation_cache,
    make_mesh,
    replicated,
    state_sharding,
)
from experiments.benchmarks.workloads import Workload, abstract_state, make_batch, step_of, workloads

MESHES = tuple((n, f) for n in (1, 2, 4, 8, 16, 32, 64) for f in dict.fromkeys((1, n)))
_WIDTH = {"pred": 1, "s8": 1, "u8": 1, "s16": 2, "u16": 2, "bf16": 2, "f16": 2, "s32": 4, "u32": 4, "f32": 4}
_WIDTH |= {"s64": 8, "u64": 8, "f64": 8, "c64": 8}
_KINDS = ("all-reduce", "all-gather", "reduce-scatter", "all-to-all", "collective-permute")
_OPERATION = re.compile(rf"= (?P<type>.*?) (?P<kind>{'|'.join(_KINDS)})(?:-start)?\(")
_ARRAY = re.compile(r"([a-z]+\d*)\[([\d,]*)\]")
_CALLED = re.compile(r"(?:body|condition|calls|to_apply|branch_computations)=\{?(%[\w.\-]+(?:, *%[\w.\-]+)*)")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')


@dataclass(frozen=True)
class Layout:
    """A step on `devices`, `fsdp` of which share one copy of the state. Bytes are those of one device and one step.

    `state`: parameters and optimiser. `temporary`: activations, gradients, gathered parameters. `sent`: what it sends
    by ring algorithms, by kind of collective in `kinds`; `counts`: how many. `exact`: every loop's length was known.
    """

    devices: int
    fsdp: int
    batch_per_device: int
    state: int
    arguments: int
    temporary: int
    sent: float
    kinds: dict[str, float]
    counts: dict[str, int]
    exact: bool
    compile_seconds: float


def communicated(text: str, devices: int) -> tuple[dict[str, float], dict[str, int], bool]:
    """(bytes that a device sends by kind, number of collectives by kind, every trip count known) of a compiled program.

    Ring algorithms over a group of n: an all-reduce of N bytes sends 2 N (n - 1) / n, the gathering, scattering
    and exchanging ones N (n - 1) / n of their whole array, a permutation N. A loop's body counts as often as it runs.
    """
    bodies, entry = _computations(text)
    sent, counts, exact = dict.fromkeys(_KINDS, 0.0), dict.fromkeys(_KINDS, 0), [True]

    def visit(name: str, times: int) -> None:
        for line in bodies.get(name, ()):
            result = _OPERATION.search(line)
            if result:
                kind, size = result["kind"], _bytes(result["type"], result["kind"], "-start(" in line)
                sent[kind] += times * _on_the_wire(kind, size, _group(line, devices))
                counts[kind] += times
                continue  # what it applies is an addition
            again = 1
            if " while(" in line:
                trips = _TRIPS.search(line)
                exact[0] &= trips is not None
                again = int(trips[1]) if trips else 1
            for names in _CALLED.findall(line):
                for inner in names.split(","):
                    visit(inner.strip(), times * again)

    visit(entry, 1)
    return {k: v for k, v in sent.items() if v}, {k: v for k, v in counts.items() if v}, exact[0]


def _computations(text: str) -> tuple[dict[str, list[str]], str]:
    """The lines of every computation of a module by its name, and the entry's name."""
    bodies: dict[str, list[str]] = {}
    entry = name = ""
    for line in text.splitlines():
        head = re.match(r"(ENTRY )?(%[\w.\-]+) .*\{$", line)
        if head and not line.startswith(" "):
            name = head[2]
            bodies[name] = []
            entry = name if head[1] else entry
        elif name:
            bodies[name].append(line)
    return bodies, entry


def _bytes(type_: str, kind: str, started: bool) -> int:
    """Bytes of an operation's result; an asynchronous start holds operands and results, of which the results count."""
    sizes = [_size(dtype, dims) for dtype, dims in _ARRAY.findall(type_) if dtype in _WIDTH]
    if started and kind != "all-reduce" and len(sizes) > 1:
        return sum(sizes[len(sizes) // 2 :])
    return sum(sizes)


def _size(dtype: str, dims: str) -> int:
    size = _WIDTH[dtype]
    for n in dims.split(",") if dims else ():
        size *= int(n)
    return size


def _group(line: str, devices: int) -> int:
    """How many devices take part: of replica_groups {{0,1},{2,3}} or [2,4]<=[8] (groups, members)."""
    iota = re.search(r"replica_groups=\[(\d+),(\d+)\]", line)
    if iota:
        return int(iota[2])
    listed = re.search(r"replica_groups=\{\{([\d,]+)\}", line)
    return len(listed[1].split(",")) if listed else devices


def _on_the_wire(kind: str, size: int, group: int) -> float:
    if kind == "collective-permute":
        return float(size)
    if kind == "reduce-scatter":  # its result is one share
        return float(size * (group - 1))
    return size * (group - 1) / group * (2 if kind == "all-reduce" else 1)


def layout_of(work: Workload, devices: int, fsdp: int) -> Layout:
    """Compile the step of a workload on a mesh of the devices of *this* process, and read what it needs."""
    mesh = make_mesh(devices // fsdp, fsdp)
    state = abstract_state(work.config)
    places = state_sharding(state, mesh)
    args = (
        _placed(state, places),
        _placed(make_batch(work), batch_sharding(mesh)),
        _placed(jax.eval_shape(lambda: jax.random.key(0)), replicated(mesh)),
    )
    step = jax.jit(step_of(work.config, mesh), donate_argnums=0, out_shardings=(places, replicated(mesh)))
    start = time.perf_counter()
    program = step.lower(*args).compile()
    memory: Any = program.memory_analysis()
    kinds, counts, exact = communicated(program.as_text() or "", devices)
    leaves = zip(jax.tree.leaves(state), jax.tree.leaves(places), strict=True)
    return Layout(
        devices=devices,
        fsdp=fsdp,
        batch_per_device=work.samples // devices,
        state=sum(math.prod(place.shard_shape(x.shape)) * x.dtype.itemsize for x, place in leaves),
        arguments=memory.argument_size_in_bytes,
        temporary=memory.temp_size_in_bytes,
        sent=sum(kinds.values()),
        kinds=kinds,
        counts=counts,
        exact=exact,
        compile_seconds=time.perf_counter() - start,
    )


def _placed(tree: Any, sharding: Any) -> Any:
    """The shapes of a tree with their place: one for all, or a tree of them."""
    places = jax.tree.map(lambda _: sharding, tree) if isinstance(sharding, jax.sharding.Sharding) else sharding
    return jax.tree.map(lambda x, place: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place), tree, places)


def simulate(preset: str, devices: int, fsdp: int, batch_per_device: int) -> Layout:
    """`layout_of` stage 1 on clips, in a child process with so many simulated devices. Raises UserError."""
    question = json.dumps([preset, devices, fsdp, batch_per_device])
    return Layout(**ask(answer_layout, question, devices))


def ask(answer: Callable[[str], None], question: str, devices: int = 1) -> dict[str, Any]:
    """Run `answer(question)` of this module in a fresh process and return the JSON of its last line."""
    clean = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES")}
    code = f"import sys; from {__name__} import {answer.__name__}; {answer.__name__}(sys.stdin.read())"
    paths = os.pathsep.join(one or os.getcwd() for one in sys.path)
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=question,
        env=clean | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": str(devices)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        errors = done.stderr.strip().splitlines()
        raise UserError(f"the child process of {answer.__name__} failed: {errors[-1] if errors else done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def answer_layout(question: str) -> None:
    """What the child process does."""
    preset, devices, fsdp, batch = json.loads(question)
    work = workloads("stage1", preset, batch * devices)[0]
    sys.stdout.write(json.dumps(asdict(layout_of(work, devices, fsdp))) + "\n")


def layout_table(layouts: Sequence[Layout]) -> str:
    """A line a mesh; MiB a device, and a step."""
    heads = ("devices", "data x fsdp", "batch", "state MiB", "temporary MiB", "sent MiB a step", "collectives")
    mib = 2**20
    rows = [
        [
            str(x.devices),
            f"{x.devices // x.fsdp} x {x.fsdp}",
            str(x.devices * x.batch_per_device),
            f"{x.state / mib:.1f}",
            f"{x.temporary / mib:.1f}",
            f"{'' if x.exact else 'at least '}{x.sent / mib:.1f}",
            ", ".join(f"{x.counts[kind]} {kind} ({size / mib:.1f})" for kind, size in x.kinds.items()) or "none",
        ]
        for x in layouts
    ]
    return markdown_table(heads, rows) + "\n"


# Start-up -------------------------------------------------------------------------------------------------------------

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


def first_steps(preset: str, steps: Sequence[tuple[str, str, str]] = STEPS, batch: int | None = None) -> list[Start]:
    """Two fresh processes for each of `steps`: one fills a new cache, the next reads it."""
    result = []
    for step in steps:
        with tempfile.TemporaryDirectory() as folder:
            for cached in (False, True):
                result.append(
                    Start(**ask(answer_start, json.dumps([*step, preset, batch, cached, folder, time.time()])))
                )
    return result


def answer_start(question: str) -> None:
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


def start_table(result: Sequence[Start]) -> str:
    """A line a process."""
    heads = ("workload", "recipe", "preset", "batch", "cache", "imports s", "trace s", "compile s", "sum s")
    rows = [
        [s.workload, s.recipe, s.preset, str(s.samples), "filled" if s.cached else "empty"]
        + [f"{x:.2f}" for x in (s.imports, s.trace, s.compile, s.total)]
        for s in result
    ]
    return markdown_table(heads, rows) + "\n"
