"""Variants of a workload: what they change, and how each is compiled, cold.

Imports nothing but jax, flax, optax, numpy.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

from anytouch_jax.train.mesh import donated
from experiments.benchmarks.workloads import Workload, embed_of, make_batch, step_of

Tree = Any


@dataclass(frozen=True)
class Variant:
    """A way to compute the same: changes of `config.model`, and `precision` of float32 products.

    A GPU may take TF32 for them.
    """

    name: str
    model: Mapping[str, Any] = field(default_factory=dict)
    precision: str | None = "highest"

    def of(self, work: Workload) -> Workload:
        """Return `work` as this variant computes it."""
        return replace(
            work, config=replace(work.config, model=replace(work.config.model, **self.model))
        )


BASELINE = Variant("float32")
BFLOAT16 = {"dtype": "bfloat16"}
_STEPS = (
    BASELINE,
    Variant("bfloat16", BFLOAT16),
    Variant("float32, attention by XLA", {"attention": "xla"}),
    Variant("float32, remat", {"remat": True}),
)


def variants_of(work: Workload, backend: str = "cpu") -> tuple[Variant, ...]:
    """The variants worth a row for a workload, the baseline first; on a GPU those of its
    hardware.
    """
    if backend != "cpu":
        fast = (
            BASELINE,
            Variant("float32, TF32 products", precision="tensorfloat32"),
            Variant("bfloat16", BFLOAT16, precision=None),
            Variant("bfloat16, cuDNN attention", BFLOAT16 | {"attention": "cudnn"}, precision=None),
        )
        if not work.trains:
            return fast
        remat = BFLOAT16 | {"attention": "cudnn", "remat": True}
        return (*fast, Variant("bfloat16, cuDNN attention, remat", remat, precision=None))
    if work.trains:
        return _STEPS
    return _STEPS[:2]


@dataclass
class Program:
    """A compiled variant, its compile times and its memory."""

    work: Workload
    variant: Variant
    call: Callable[..., Any]
    batch: Any
    trace_seconds: float
    compile_seconds: float
    peak_bytes: int
    temp_bytes: int
    copies: int


# Compiling
# --------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def cold() -> Iterator[None]:
    """Compile without the persistent cache."""
    before = getattr(jax.config, "jax_enable_compilation_cache")  # noqa: B009 (it has no type)
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        compilation_cache.reset_cache()


def compiled(variant: Variant, work: Workload, state: Tree) -> Program:
    """Compile a variant, timed, cold.

    `state` is a TrainState, or parameters for an embedding (shapes will do).
    """
    work = variant.of(work)
    batch = make_batch(work)
    if work.trains:
        function = jax.jit(step_of(work.config), donate_argnums=donated())
        args = (state, batch, jax.eval_shape(lambda: jax.random.key(0)))
        batch = jax.device_put(batch)
    else:
        function = jax.jit(embed_of(work.config))
        args = (state, *batch[:2])
    with cold(), jax.default_matmul_precision(variant.precision):
        start = time.perf_counter()
        lowered = function.lower(*args)
        traced = time.perf_counter()
        program = lowered.compile()
        done = time.perf_counter()
    memory: Any = program.memory_analysis()
    sizes = (memory.argument_size_in_bytes, memory.output_size_in_bytes, memory.temp_size_in_bytes)
    return Program(
        work=work,
        variant=variant,
        call=program,
        batch=batch,
        trace_seconds=traced - start,
        compile_seconds=done - traced,
        peak_bytes=sum(sizes) - memory.alias_size_in_bytes,
        temp_bytes=memory.temp_size_in_bytes,
        copies=(program.as_text() or "").count(" copy("),
    )
