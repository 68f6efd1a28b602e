"""Faults of jaxlib that training would not notice."""

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np


def test_a_sum_is_that_of_its_parts_whatever_the_number_of_rows() -> None:
    """jaxlib 0.10.2 computes something else here, on CPUs, where more than 32,768 sums come out of
    one fusion.
    """
    rng = np.random.default_rng(0)
    x, place, scale = (
        rng.normal(size=size).astype(np.float32)
        for size in ((100, 400, 49), (1, 400, 49), (100, 400))
    )

    @jax.jit
    def summed(x: jax.Array, scale: jax.Array) -> jax.Array:
        return scale * jnp.sum(place * (x - place * scale[..., None]), -1)

    parts = np.concatenate([summed(x[i : i + 25], scale[i : i + 25]) for i in range(0, 100, 25)])
    reported = f"jaxlib {jaxlib.__version__} sums wrongly; install one that pyproject.toml allows"
    np.testing.assert_allclose(summed(x, scale), parts, rtol=1e-4, atol=1e-4, err_msg=reported)
