"""Variants of a workload: what they change, and how each is compiled, cold.

Imports nothing but jax, flax, optax, numpy.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from unittest import mock

import jax
from jax.experimental.compilation_cache import compilation_cache

from anytouch_jax.nn import functional, layers
from anytouch_jax.train.mesh import donated
from experiments.benchmarks.workloads import Workload, embed_of, make_batch, step_of

Tree = Any


@dataclass(frozen=True)
class Variant:
    """A way to compute the same: changes of `config.model`, and what no setting of the model changes.

    `activation` jax: GELU as jax.nn writes it, its derivative traced. `donate`: the step may overwrite its state; None
    as in training. `dense`: a slot for image and text in every row. `precision`: of float32 products (a GPU may take
    TF32 for them).
    """

    name: str
    model: Mapping[str, Any] = field(default_factory=dict)
    activation: str = "own"
    donate: bool | None = None
    dense: bool = False
    precision: str | None = "highest"

    def of(self, work: Workload) -> Workload:
        """`work` as this variant computes it."""
        config = replace(work.config, model=replace(work.config.model, **self.model))
        return replace(work, config=config, dense=self.dense)


BASELINE = Variant("float32")
BFLOAT16 = {"dtype": "bfloat16"}
_STEPS = (
    BASELINE,
    Variant("bfloat16", BFLOAT16),
    Variant("float32, attention by XLA", {"attention": "xla"}),
    Variant("float32, GELU of jax.nn", activation="jax"),
    Variant("float32, remat", {"remat": True}),
    Variant("float32, state donated", donate=True),
)


def variants_of(work: Workload, backend: str = "cpu") -> tuple[Variant, ...]:
    """The variants worth a row for a workload, the baseline first; on a GPU those of its hardware."""
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
    if not work.trains:
        return _STEPS[:2]
    dense = (Variant("float32, dense slots", dense=True),) if work.name == "stage2 align" else ()
    return _STEPS + dense


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


# Compiling ----------------------------------------------------------------------------------------------------------


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


@contextlib.contextmanager
def traced_as(variant: Variant) -> Iterator[None]:
    """Trace with a variant's activation and precision of products."""
    gelu = partial(jax.nn.gelu, approximate=False) if variant.activation == "jax" else layers.gelu

    def forget() -> None:
        functional._cached_skeleton.cache_clear()  # it keeps modules, and they their activation
        if variant.activation == "jax":
            jax.clear_caches()  # they keep what was traced with another activation

    forget()
    with mock.patch.object(layers, "gelu", gelu), jax.default_matmul_precision(variant.precision):
        yield
    forget()


def compiled(variant: Variant, work: Workload, state: Tree) -> Program:
    """Compile a variant, timed, cold. `state` is a TrainState, or parameters for an embedding (shapes will do)."""
    work = variant.of(work)
    batch = make_batch(work)
    if work.trains:
        donate = donated() if variant.donate is None else (0,) if variant.donate else ()
        function = jax.jit(step_of(work.config), donate_argnums=donate)
        args = (state, batch, jax.eval_shape(lambda: jax.random.key(0)))
        batch = jax.device_put(batch)
    else:
        function, args = jax.jit(embed_of(work.config)), (state, *batch[:2])
    with cold(), traced_as(variant):
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
