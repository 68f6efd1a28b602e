import functools
import itertools

import jax
import jax.ad_checkpoint
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from tiny_models import touch_model

from anytouch_jax.config import Stack
from anytouch_jax.nn.layers import Block, gelu, product, stored

# rows, inputs, outputs: wider, narrower, as wide
SHAPES = [(24, 12, 20), (24, 20, 12), (9, 8, 8)]
NOTHING = (0, 12, 20)


def draw(shape):
    (rows, inputs, outputs) = shape
    rng = np.random.default_rng(3)
    return tuple(
        rng.standard_normal(s).astype("f4")
        for s in ((rows, inputs), (inputs, outputs), (rows, outputs))
    )


@functools.partial(jax.jit, static_argnums=3)
def both(x, kernel, g, dtype):
    """Output and the two gradients for the cotangent `g`."""
    y, back = jax.vjp(lambda x, kernel: product(x, kernel, dtype), x, kernel)
    return y, *back(g.astype(y.dtype))


def rounded(x):
    return np.asarray(x.astype(jnp.bfloat16), np.float64)


@pytest.mark.parametrize("shape", [*SHAPES, NOTHING])
def test_a_product_and_its_gradients_are_those_of_the_rounded_operands(shape):
    x, kernel, g = draw(shape)
    a, b, c = (rounded(part) for part in (x, kernel, g))
    result = both(x, kernel, g, "bfloat16")
    for ours, wanted in zip(result, (a @ b, c @ b.T, a.T @ c), strict=True):
        assert ours.dtype == jnp.float32
        np.testing.assert_allclose(ours, wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_other_types_are_computed_as_they_are(dtype):
    with jax.enable_x64(dtype == "float64"):
        x, kernel, g = (part.astype(dtype) for part in draw(SHAPES[0]))
        for ours, wanted in zip(
            both(x, kernel, g, dtype), (x @ kernel, g @ kernel.T, x.T @ g), strict=True
        ):
            assert ours.dtype == dtype == stored(dtype)
            np.testing.assert_allclose(ours, wanted, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_narrow_products_have_the_one_form_that_a_cpu_computes_in_16_bits(shape):
    """A float32 result, the first operand contracted over its last axis (else XLA widens both, or
    cannot run it).
    """
    x, kernel, g = draw(shape)
    program = both.lower(x, kernel, g, "bfloat16").compile().as_text()
    dots = [line for line in program.splitlines() if " dot(" in line]
    assert len(dots) == 3
    for line in dots:
        assert " f32[" in line.split(" dot(")[0] and "lhs_contracting_dims={1}" in line
    assert program.count("bf16[") > 6 and "convert(%dot" not in program


@pytest.mark.parametrize("shape", SHAPES)
def test_what_is_not_finite_reaches_the_gradient_of_the_kernel(shape):
    for number, place, value in itertools.product((0, 2), ((0, 0), (3, 2)), (np.nan, np.inf)):
        parts = draw(shape)
        parts[number][place] = value
        assert not np.isfinite(both(*parts, "bfloat16")[2]).all()


def test_an_accelerator_stores_16_bits_between_products(monkeypatch):
    assert stored("bfloat16") == jnp.float32
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert stored("bfloat16") == jnp.bfloat16
    x, kernel, _ = draw(SHAPES[0])
    assert product(*jax.device_put((x, kernel)), "bfloat16").dtype == jnp.bfloat16


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_block_keeps_its_products_alone_for_the_backward_pass(dtype, capsys):
    width = 12
    hidden = 20
    b = 2
    s = 7
    model = touch_model(touch=Stack(width, 1, 2, hidden), dtype=dtype)
    graph, state = nnx.split(Block(model.touch, model, 1e-5, gelu))
    jax.ad_checkpoint.print_saved_residuals(
        lambda p, x: nnx.merge(graph, p)(x).sum(), state, np.ones((b, s, width), "f4")
    )
    kept = [
        line.split(" ")[0]
        for line in capsys.readouterr().out.splitlines()
        if " from the argument" not in line
    ]
    wide = [
        shape for shape in kept if shape in (f"f32[{b},{s},{hidden}]", f"f32[{b * s},{hidden}]")
    ]
    # what goes into the activation, not what comes out of it
    assert len(wide) == 1
    assert (
        len(
            [shape for shape in kept if shape in (f"f32[{b},{s},{width}]", f"f32[{b * s},{width}]")]
        )
        == 1
    )
