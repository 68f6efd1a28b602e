import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.nn import attention as module
from anytouch_jax.nn.attention import attention, mapped

SHAPES = [(2, 7, 3, 4), (1, 1, 1, 2), (3, 70, 6, 8)]


def draw(shape, dtype=np.float32, scale=1.0):
    rng = np.random.default_rng(0)
    return [(scale * rng.standard_normal(shape)).astype(dtype) for _ in range(4)]


def plain(q, k, v):
    logits = jnp.einsum("bqhd,bkhd->bhqk", q, k) / np.sqrt(q.shape[-1])
    return jnp.einsum("bhqk,bkhd->bqhd", jax.nn.softmax(logits, axis=-1), v)


def both(function, q, k, v, g):
    """Output and gradients, by one program that is compiled for this call."""

    @jax.jit
    def run(q, k, v, g):
        out, vjp = jax.vjp(function, q, k, v)
        return (out, *vjp(g))

    return jax.device_get(run(q, k, v, g))


@pytest.mark.parametrize("shape", SHAPES)
def test_values_and_gradients_equal_the_definition_in_float64(shape):
    with jax.enable_x64(True):
        parts = draw(shape, np.float64)
        for ours, true in zip(both(mapped, *parts), both(plain, *parts), strict=True):
            assert ours.dtype == np.float64
            np.testing.assert_allclose(ours, true, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("cache", [1, 4 * 7 * 7 * 2, 10**9])
def test_the_size_of_the_groups_changes_nothing(cache, monkeypatch):
    parts = draw((2, 7, 3, 4))
    true = both(plain, *parts)
    monkeypatch.setattr(module, "CACHE", cache)
    for ours, wanted in zip(both(mapped, *parts), true, strict=True):
        np.testing.assert_allclose(ours, wanted, rtol=2e-6, atol=2e-6)


def test_large_logits_stay_finite_and_equal_the_limit():
    """Logits of 1e8: one key takes everything; nothing overflows, forward or backward."""
    q, k, v, g = draw((2, 7, 3, 4), scale=1e4)
    out, *grads = both(mapped, q, k, v, g)
    assert np.isfinite(out).all() and all(np.isfinite(grad).all() for grad in grads)
    winner = np.argmax(np.einsum("bqhd,bkhd->bhqk", q, k, dtype=np.float64), axis=-1)
    np.testing.assert_allclose(out[0, :, 0], v[0, winner[0, 0], 0], rtol=1e-6)


def test_equal_keys_average_the_values_and_nan_stays_in_its_sample():
    q, k, v, _ = draw((3, 5, 2, 4))
    run = jax.jit(mapped)
    out = run(q, np.broadcast_to(k[:, :1], k.shape), v)
    np.testing.assert_allclose(
        out, np.broadcast_to(v.mean(1, keepdims=True), v.shape), rtol=1e-5, atol=1e-6
    )
    q[1, 0] = np.nan
    out = np.asarray(run(q, k, v))
    assert np.isnan(out[1, 0]).all() and np.isfinite(out[0]).all() and np.isfinite(out[2]).all()


def test_bfloat16_keeps_its_type_and_its_error():
    parts = draw((2, 20, 2, 8))
    narrow = [x.astype(jnp.bfloat16) for x in parts]
    for ours, true in zip(both(mapped, *narrow), both(plain, *parts), strict=True):
        assert ours.dtype == jnp.bfloat16
        assert np.abs(ours.astype("f4") - true).max() < 0.03 * np.abs(true).max()


def test_a_masked_or_causal_call_takes_the_plain_form(monkeypatch):
    monkeypatch.setattr(module, "mapped", lambda *_: pytest.fail("mapped knows no mask"))
    q, k, v, _ = draw((2, 5, 2, 4))
    run = jax.jit(attention, static_argnames=("implementation", "causal"))
    out = run(
        q,
        k,
        v,
        implementation="mapped",
        mask=np.asarray([[True] * 5, [True, True, False, False, False]]),
    )
    np.testing.assert_allclose(
        out[1], jax.jit(plain)(q[1:], k[1:, :2], v[1:, :2])[0], rtol=1e-5, atol=1e-6
    )
    causal = run(q, k, v, implementation="auto", causal=True)
    np.testing.assert_allclose(causal[:, 0], v[:, 0], rtol=1e-6)


def test_auto_maps_on_one_cpu_and_nowhere_else(monkeypatch):
    q, k, v, _ = draw((2, 5, 2, 4))
    calls = []
    monkeypatch.setattr(module, "mapped", lambda q, k, v: calls.append(1) or v)
    for devices, wanted in ((1, 1), (4, 0)):
        calls.clear()
        monkeypatch.setattr(jax, "device_count", lambda n=devices: n)
        jax.eval_shape(lambda: attention(q, k, v, implementation="auto"))
        assert len(calls) == wanted


@pytest.mark.parametrize(
    ("dtype", "length", "masked", "asked"),
    [
        (jnp.bfloat16, 262, False, "cudnn"),
        (jnp.bfloat16, 257, False, "xla"),  # it takes no odd length
        (jnp.bfloat16, 262, True, "xla"),  # nor a mask of keys
        (jnp.float32, 262, False, "xla"),  # nor 32 bits
    ],
)
def test_cudnn_does_what_it_can_and_xla_the_rest(monkeypatch, dtype, length, masked, asked):
    reported = []
    monkeypatch.setattr(
        jax.nn,
        "dot_product_attention",
        lambda q, *_, implementation, **__: reported.append(implementation) or q,
    )
    q = np.zeros((1, length, 2, 4), dtype)
    mask = np.ones((1, length), bool) if masked else None
    jax.eval_shape(lambda q: attention(q, q, q, implementation="cudnn", mask=mask), q)
    assert reported == [asked]
