import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.ops import losses

RNG = np.random.default_rng(0)
HIDDEN = np.array([[1, 0, 1, 1], [0, 1, 1, 1]], bool)
SOME = np.arange(8) % 3 > 0
OTHERS = np.arange(8) % 3 == 0
WEIGHTS = (0.5, 0.25, 0.1)


def align(has_image, has_text, center=False):
    return lambda *z: losses.alignment_loss(
        *z, has_image, has_text, jnp.float32(14.0), WEIGHTS, center=center
    )[0]


def draw(*shape):
    return RNG.standard_normal(shape) * 3 + 1


def constant(patches):
    patches[0, 1] = 3.0
    return patches


def zero(x):
    x[2] = 0.0
    return x


def unit(*shape):
    x = RNG.standard_normal(shape)
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


CASES = {
    "reconstruction": (
        lambda *x: losses.reconstruction_loss(*x, HIDDEN, next_frame=True)[0],
        [draw(2, 4, 3, 12), draw(2, 4, 3, 12)],
    ),
    "normalised patches, one constant": (losses.normalise_patches, [constant(draw(2, 3, 2, 12))]),
    "normalised vectors, one zero": (losses.normalise, [zero(draw(4, 6))]),
    "matching": (losses.matching_loss, [np.array([1e4, -1e4, 0.3]), np.array([-1e4, 1e4, 0.7])]),
    "alignment": (align(SOME, np.arange(8) < 6), [unit(8, 16) for _ in range(3)]),
    "alignment, centered": (
        align(SOME, np.arange(8) < 6, center=True),
        [unit(8, 16) for _ in range(3)],
    ),
    "alignment of disjoint sets": (align(SOME, OTHERS), [unit(8, 16) for _ in range(3)]),
    "centered": (lambda x: losses.centered(x, SOME), [draw(8, 16)]),
}


@pytest.mark.parametrize("name", CASES)
def test_bfloat16_is_widened_before_it_is_computed_with(name):
    function, inputs = CASES[name]
    halves = [x.astype(jnp.bfloat16) for x in inputs]

    def weighed(*inputs):
        out = function(*inputs)
        return jnp.sum(out * np.cos(np.arange(out.size)).reshape(out.shape)), out

    @jax.jit
    def run(*inputs):
        return jax.value_and_grad(weighed, argnums=tuple(range(len(inputs))), has_aux=True)(*inputs)

    (_, result), grads = run(*halves)
    with jax.enable_x64(True):
        (_, exact), wanted = run(*(np.asarray(x, np.float64) for x in halves))
    assert result.dtype == jnp.float32 and exact.dtype == np.float64
    np.testing.assert_allclose(result, exact, rtol=2e-5, atol=1e-5)
    for grad, right in zip(grads, wanted, strict=True):
        assert grad.dtype == jnp.bfloat16 and np.isfinite(np.asarray(grad, np.float32)).all()
        # Rounded to 8 bits where a use of the input ends, and nowhere before.
        np.testing.assert_allclose(
            np.asarray(grad, np.float32), right, rtol=2**-7, atol=2**-8 * np.abs(right).max()
        )
