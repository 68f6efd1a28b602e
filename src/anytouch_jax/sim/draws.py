"""Random draws of the simulator: one description of a distribution serves numpy and JAX.

A distribution is a function of an `Rng`: a numpy generator, or `Draws` from a JAX key inside a
compiled program. So a data set on disk and endless training draw from the same distributions,
though not the same numbers.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from scipy.stats import gamma as gamma_distribution

Leaf = npt.NDArray[Any] | jax.Array  # numpy, or jax under vmap and jit
Scalar = float | np.integer[Any] | Leaf  # one number, known or traced
Size = int | tuple[int, ...]


class Draws:
    """Draws from a JAX key, by those methods of `numpy.random.Generator` that the simulator uses.

    All values are parts of one block of uniform and one of normal numbers: a program with a random
    call for each value takes minutes to compile. Raises ValueError after `most` values of a kind.
    """

    def __init__(self, key: jax.Array, most: int = 64) -> None:
        uniform, normal = jax.random.split(key)
        self._block = {
            "uniform": jax.random.uniform(uniform, (most,)),
            "normal": jax.random.normal(normal, (most,)),
        }
        self._used = dict.fromkeys(self._block, 0)

    def _take(self, kind: str, shape: tuple[int, ...]) -> jax.Array:
        block = self._block[kind]
        first = self._used[kind]
        end = first + math.prod(shape)
        self._used[kind] = end
        # A slice that is too short would repeat nothing and warn of nothing, so it is an error.
        if end > len(block):
            raise ValueError(f"more than {len(block)} {kind} values; ask for a larger block")
        return block[first:end].reshape(shape)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Size | None = None) -> jax.Array:
        """Return uniform values in low..high."""
        low = jnp.asarray(low, jnp.float32)
        high = jnp.asarray(high, jnp.float32)
        shape = np.broadcast_shapes(low.shape, high.shape) if size is None else _shape(size)
        return low + (high - low) * self._take("uniform", shape)

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Size = ()) -> jax.Array:
        """Return normal values of mean `loc` and standard deviation `scale`."""
        return loc + scale * self._take("normal", _shape(size))

    def standard_normal(self, size: Size = ()) -> jax.Array:
        """Return normal values of mean 0 and standard deviation 1."""
        return self.normal(size=size)

    def gamma(self, shape: float, size: int) -> jax.Array:
        """Return gamma values of this shape and scale 1, by the quantiles of the distribution."""
        fraction, value = _gamma_quantiles(shape)
        return jnp.exp(jnp.interp(self.uniform(size=size), fraction, value))

    def random(self) -> jax.Array:
        """Return a uniform value in 0..1."""
        return self.uniform()

    def integers(self, low: int, high: int | None = None) -> jax.Array:
        """Return an integer from low to high - 1, or from 0 to low - 1.

        At most 2**23 values are distinct, because a uniform float32 has no more.
        """
        if high is None:
            low, high = 0, low
        # A uniform value is below 1, but its product may be rounded up to `high`.
        return jnp.minimum(low + (self.uniform() * (high - low)).astype(jnp.int32), high - 1)

    def choice(self, values: Any) -> jax.Array:
        """Return one of the values."""
        return jnp.asarray(values)[self.integers(len(values))]


def _shape(size: Size) -> tuple[int, ...]:
    if isinstance(size, int):
        return (size,)
    return tuple(size)


@lru_cache(maxsize=4)
def _gamma_quantiles(shape: float) -> tuple[np.ndarray, np.ndarray]:
    """Return probabilities in 0..1, dense at both ends, and the logarithms of the quantiles there.

    jax.random.gamma is a loop with rejection, which takes long to compile and cannot take its
    numbers from a block.
    """
    probability = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, 4096))
    probability = np.clip(probability, 1e-7, 1 - 1e-7)
    quantile = np.log(gamma_distribution.ppf(probability, shape))
    return probability.astype(np.float32), quantile.astype(np.float32)


Rng = np.random.Generator | Draws


def namespace_of(rng: Rng) -> ModuleType:
    """Return the array library of the draws, numpy or jax.numpy."""
    if isinstance(rng, Draws):
        return jnp
    return np


def either(rng: Rng, condition: Any, draw: Callable[[], Any], otherwise: Any) -> Any:
    """Return `draw()` if the condition holds, else `otherwise`.

    numpy draws only then. JAX always draws, because a traced condition is not known.

    Args:
        rng: of numpy, or the one of this module for JAX.
        condition: a bool, traced under JAX.
        draw: called for the value.
        otherwise: the value if the condition does not hold.
    """
    if isinstance(rng, Draws):
        return jnp.where(condition, draw(), otherwise)
    if condition:
        return draw()
    return otherwise
