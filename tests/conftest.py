"""The strict ground all tests stand on: four CPU devices, no silent broadcasting, warnings are errors (pyproject)."""

from __future__ import annotations

import os

# Set before jax is imported; child processes of the tests inherit it. The four devices below they do not.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax

jax.config.update("jax_num_cpu_devices", 4)
jax.config.update("jax_numpy_rank_promotion", "raise")
