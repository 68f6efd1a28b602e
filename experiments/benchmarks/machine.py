"""The machine that a benchmark ran on: what it is, and the matrix product it reaches at best.

Imports nothing but jax and numpy, so that a bare accelerator image can run it.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

# of the square matrices whose product is the peak
SIZES = {"cpu": 2048, "gpu": 8192, "tpu": 8192}
# flags of Linux, the widest first
VECTORS = {"amx_tile": "AMX", "avx512f": "AVX-512", "avx2": "AVX2"}


@dataclass(frozen=True)
class Machine:
    """Where figures were measured.

    `memory_gib` is the host's, `load` the mean of its last minute, as it began.

    `vectors` is the widest kind of vector instructions: AMX, AVX-512 or AVX2; empty where the
    system does not say.
    """

    device: str
    devices: int
    processor: str
    cores: int
    memory_gib: float
    load: float
    python: str
    jax: str
    system: str
    vectors: str = ""

    def sentence(self) -> str:
        """One line for a report."""
        processor = f"{self.processor}{' with ' * bool(self.vectors)}{self.vectors}"
        parts = [
            f"{self.devices} x {self.device}",
            f"{processor}, {self.cores} cores, {self.memory_gib:.0f} GiB",
        ]
        parts += [f"Python {self.python}", f"jax {self.jax}", self.system]
        return f"{'; '.join(parts)}; load {self.load:.1f} at the start."


def describe() -> Machine:
    """The machine of this process."""
    first = jax.devices()[0]
    pages = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return Machine(
        device=first.device_kind,
        devices=jax.device_count(),
        processor=_cpuinfo("model name") or platform.machine(),
        cores=len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1,
        memory_gib=pages / 2**30,
        load=os.getloadavg()[0],
        python=platform.python_version(),
        jax=jax.__version__,
        system=platform.system(),
        vectors=next(
            (name for flag, name in VECTORS.items() if flag in _cpuinfo("flags").split()), ""
        ),
    )


def _cpuinfo(field: str) -> str:
    """Return a field of the first processor, empty where the system does not have it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith(field)), "")


def matmul(
    dtype: str, size: int | None = None, precision: str | None = "highest"
) -> tuple[Callable[[], object], float]:
    """(run, operations): `run` multiplies two square matrices of `dtype` on the first device and
    waits for the product.

    float32 is full float32, unless `precision` (tensorfloat32) says otherwise; a 16-bit product
    keeps its type, but on a CPU is float32, which alone is fast there (`nn/product.py`).
    """
    size = size or SIZES.get(jax.default_backend(), 2048)
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.standard_normal((size, size)), dtype) for _ in range(2))
    own = None if dtype != "float32" else precision
    result = jnp.float32 if jax.default_backend() == "cpu" and a.dtype.itemsize == 2 else None
    product = (
        jax.jit(partial(jnp.matmul, precision=own, preferred_element_type=result))
        .lower(a, b)
        .compile()
    )
    # queued: else an accelerator waits for the host in between
    times = 1 if jax.default_backend() == "cpu" else 16

    def run() -> object:
        return jax.block_until_ready([product(a, b) for _ in range(times)])

    return run, 2.0 * size**3 * times
