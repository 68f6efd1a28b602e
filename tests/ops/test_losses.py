"""The losses against loops, and the hard cases they must survive."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.ops import losses
from anytouch_jax.ops.losses import (
    alignment_loss,
    info_nce,
    matching_loss,
    normalise,
    normalise_patches,
    reconstruction_loss,
)

RNG = np.random.default_rng(0)


def unit(n, e=6, seed=0):
    z = np.random.default_rng(seed).standard_normal((n, e))
    return z / np.linalg.norm(z, axis=1, keepdims=True)


def loop_info_nce(a, b, scale, present):
    """Eq. 3 as it is written: a loop over the present pairs."""
    rows = np.flatnonzero(present)
    if not len(rows):
        return 0.0
    total = 0.0
    for i in rows:
        logits = np.array([scale * a[i] @ b[j] for j in rows])
        total -= scale * a[i] @ b[i] - (logits.max() + np.log(np.exp(logits - logits.max()).sum()))
    return total / len(rows)


PRESENCE = {
    "all": np.ones(8, bool),
    "none": np.zeros(8, bool),
    "one": np.arange(8) == 3,
    "two": np.isin(np.arange(8), (1, 6)),
    "mixed": np.array([1, 0, 1, 1, 0, 0, 1, 1], bool),
}


@pytest.mark.parametrize("present", PRESENCE.values(), ids=PRESENCE)
@pytest.mark.parametrize("tau", [0.01, 0.07, 1.0, 100.0])
def test_info_nce_equals_the_loop(present, tau):
    a, b = unit(8, seed=1), unit(8, seed=2)
    ours = info_nce(jnp.asarray(a), jnp.asarray(b), jnp.asarray(1 / tau), jnp.asarray(present))
    np.testing.assert_allclose(ours, loop_info_nce(a, b, 1 / tau, present), rtol=2e-5, atol=2e-5 / tau)


@pytest.mark.parametrize("garbage", [0.0, 1e6, np.nan, np.inf])
def test_absent_rows_touch_neither_value_nor_gradient(garbage):
    present = PRESENCE["mixed"]
    a, b = unit(8, seed=1), unit(8, seed=2)
    dirty_a, dirty_b = (np.where(present[:, None], z, garbage) for z in (a, b))

    def loss(a, b):
        return info_nce(a, b, jnp.asarray(14.0), jnp.asarray(present))

    clean = jax.value_and_grad(loss, argnums=(0, 1))(jnp.asarray(a), jnp.asarray(b))
    dirty = jax.value_and_grad(loss, argnums=(0, 1))(jnp.asarray(dirty_a), jnp.asarray(dirty_b))
    jax.tree.map(np.testing.assert_array_equal, clean, dirty)
    assert not np.asarray(clean[1][0])[~present].any()


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
@pytest.mark.parametrize("tau", [0.01, 100.0])
def test_info_nce_is_finite_on_duplicates_and_zeros(dtype, tau):
    same = jnp.broadcast_to(jnp.asarray(unit(1)), (5, 6)).astype(dtype)
    present = jnp.ones(5, bool)
    # Identical rows: every candidate is as likely as the right one.
    np.testing.assert_allclose(info_nce(same, same, jnp.asarray(1 / tau), present), np.log(5), rtol=1e-3)
    value, grad = jax.value_and_grad(lambda z: info_nce(normalise(z), normalise(z), jnp.asarray(1 / tau), present))(
        jnp.zeros((5, 6), dtype)
    )
    assert np.isfinite(value) and np.isfinite(np.asarray(grad, np.float32)).all()


def test_bfloat16_inputs_are_summed_in_float32():
    a, b = (jnp.asarray(unit(64, 32, s)).astype(jnp.bfloat16) for s in (1, 2))
    present = np.arange(64) % 3 > 0
    ours = info_nce(a, b, jnp.asarray(14.0), jnp.asarray(present))
    assert ours.dtype == jnp.float32
    wide_a, wide_b = (np.asarray(z, np.float64) for z in (a, b))
    np.testing.assert_allclose(ours, loop_info_nce(wide_a, wide_b, 14.0, present), rtol=1e-5)


def test_the_products_of_info_nce_are_whole_on_every_device():
    """An accelerator's default is TF32 or bfloat16: a hundredth of a logit that is multiplied by 100."""
    a, b, present = jnp.ones((4, 8)), jnp.ones((4, 8)), jnp.ones(4, bool)
    loss = lambda a, b: info_nce(a, b, jnp.asarray(100.0), present)  # noqa: E731
    text = str(jax.make_jaxpr(jax.grad(loss, argnums=(0, 1)))(a, b))
    assert text.count("dot_general[") == 3 and text.count("HIGHEST") == 6, text  # of both operands


def test_groups_keep_negatives_in_their_share():
    a, b, present = unit(8, seed=1), unit(8, seed=2), PRESENCE["mixed"]
    ours = info_nce(jnp.asarray(a), jnp.asarray(b), jnp.asarray(9.0), jnp.asarray(present), groups=2)
    shares = [loop_info_nce(a[s], b[s], 9.0, present[s]) for s in (slice(0, 4), slice(4, 8))]
    np.testing.assert_allclose(ours, np.mean(shares), rtol=1e-5)
    half = present & (np.arange(8) < 4)  # the other share has no pair: 0, and it counts in the mean
    ours = info_nce(jnp.asarray(a), jnp.asarray(b), jnp.asarray(9.0), jnp.asarray(half), groups=2)
    np.testing.assert_allclose(ours, loop_info_nce(a[:4], b[:4], 9.0, half[:4]) / 2, rtol=1e-5)


def test_alignment_weighs_the_pairs_and_counts_them():
    touch, image, text = (jnp.asarray(unit(8, seed=s)) for s in (1, 2, 3))
    has_image, has_text = jnp.asarray(PRESENCE["mixed"]), jnp.asarray(np.arange(8) < 4)
    scale = jnp.asarray(14.0)
    loss, metrics = alignment_loss(touch, image, text, has_image, has_text, scale, (0.5, 1.0, 0.1))
    both = np.asarray(has_image & has_text)
    everyone = np.ones(8, bool) & True
    parts = {
        "touch_to_vision": loop_info_nce(touch, image, 14.0, np.asarray(has_image)),
        "text_to_touch": loop_info_nce(text, touch, 14.0, np.asarray(has_text) & everyone),
        "vision_to_text": loop_info_nce(image, text, 14.0, both),
    }
    for name, value in parts.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-5)
    expected = sum(
        weight * (metrics[f"{a}_to_{b}"] + metrics[f"{b}_to_{a}"])
        for weight, a, b in ((0.5, "touch", "vision"), (1.0, "touch", "text"), (0.1, "vision", "text"))
    )
    np.testing.assert_allclose(loss, expected, rtol=1e-6)
    assert (int(metrics["touch_vision_pairs"]), int(metrics["vision_text_pairs"])) == (5, both.sum())


def test_alignment_without_a_modality_or_with_disjoint_sets():
    touch, image, text = (jnp.asarray(unit(4, seed=s)) for s in (1, 2, 3))
    scale, weights = jnp.asarray(14.0), (0.5, 0.5, 0.1)
    loss, metrics = alignment_loss(touch, None, None, None, None, scale, weights)
    assert loss == 0 and metrics == {}
    first, last = jnp.asarray([True, True, False, False]), jnp.asarray([False, False, True, True])
    _, metrics = alignment_loss(touch, image, text, first, last, scale, weights)
    assert metrics["vision_to_text"] == 0 and metrics["touch_to_vision"] > 0


def test_centred_embeddings_that_are_all_one_are_nothing_not_noise():
    """Rounding is not blown up to unit length, nor is its gradient."""
    one = losses.normalise(jax.random.normal(jax.random.key(0), (1, 32)))
    same = jnp.concatenate([jnp.repeat(one, 7, axis=0), jax.random.normal(jax.random.key(1), (57, 32))])
    present = jnp.arange(64) < 7
    assert float(jnp.abs(losses.centered(same, present)).max()) < 1e-3
    other = losses.normalise(jax.random.normal(jax.random.key(2), (64, 32)))
    loss = lambda x: losses.info_nce(losses.centered(x, present), other, jnp.asarray(14.0), present)  # noqa: E731
    assert float(jnp.abs(jax.grad(loss)(same)).max()) < 1e4
    spread = losses.normalise(jax.random.normal(jax.random.key(3), (64, 32)))
    length = jnp.linalg.norm(losses.centered(spread, jnp.ones(64, bool)), axis=1)
    np.testing.assert_allclose(length, 1.0, atol=1e-5)


def test_reconstruction_counts_hidden_patches_and_the_whole_next_frame():
    pred, target = (RNG.standard_normal((2, 4, 3, 5)) for _ in range(2))
    hidden = np.array([[1, 0, 1, 1], [0, 1, 1, 1]], bool)
    error = ((pred - target) ** 2).mean(-1)
    still = error.mean(-1)[hidden].mean()
    loss, metrics = reconstruction_loss(jnp.asarray(pred), jnp.asarray(target), jnp.asarray(hidden), next_frame=False)
    np.testing.assert_allclose(loss, still, rtol=1e-6)
    assert set(metrics) == {"reconstruction"}
    loss, metrics = reconstruction_loss(jnp.asarray(pred), jnp.asarray(target), jnp.asarray(hidden), next_frame=True)
    np.testing.assert_allclose(metrics["reconstruction"], error[..., :2].mean(-1)[hidden].mean(), rtol=1e-6)
    np.testing.assert_allclose(metrics["next_frame"], error[..., 2].mean(), rtol=1e-6)
    np.testing.assert_allclose(loss, metrics["reconstruction"] + metrics["next_frame"], rtol=1e-6)


def test_nothing_hidden_costs_nothing():
    loss, _ = reconstruction_loss(
        jnp.ones((1, 4, 1, 3)), jnp.zeros((1, 4, 1, 3)), jnp.zeros((1, 4), bool), next_frame=False
    )
    assert loss == 0


def test_normalised_patches_use_the_unbiased_variance_and_survive_constants():
    patches = RNG.standard_normal((2, 3, 1, 12)) * 5 + 2
    expected = (patches - patches.mean(-1, keepdims=True)) / np.sqrt(patches.var(-1, ddof=1, keepdims=True) + 1e-6)
    np.testing.assert_allclose(normalise_patches(jnp.asarray(patches)), expected, rtol=1e-4, atol=1e-5)
    value, grad = jax.value_and_grad(lambda x: normalise_patches(x).sum())(jnp.full((1, 1, 1, 12), 3.0))
    assert value == 0 and np.isfinite(np.asarray(grad)).all()
    assert np.isfinite(np.asarray(normalise_patches(jnp.ones((1, 1, 1, 1))))).all()  # a patch of one value


def test_normalise_is_exact_and_has_a_finite_gradient_at_zero():
    x = RNG.standard_normal((4, 6))
    np.testing.assert_allclose(normalise(jnp.asarray(x)), x / np.linalg.norm(x, axis=1, keepdims=True), rtol=1e-6)
    grad = jax.grad(lambda z: normalise(z).sum())(jnp.zeros((2, 6)))
    assert 0 < float(jnp.abs(grad).max()) < 1e13  # a larger one would end in infinity further down
    assert not np.asarray(normalise(jnp.zeros((1, 6)))).any()


@pytest.mark.parametrize("length", [1e-11, 1e-7, 1e-3, 1.0, 1e20, 3e38])
def test_normalise_gives_length_one_to_every_length(length):
    direction = unit(1, e=6, seed=3)
    z, grad = jax.vjp(normalise, jnp.asarray(direction * length, jnp.float32))
    np.testing.assert_allclose(z, direction, rtol=2e-6)
    (pull,) = grad(jnp.asarray(unit(1, e=6, seed=4), jnp.float32))
    assert np.isfinite(np.asarray(pull)).all()
    along = np.asarray(pull, np.float64) @ direction.T * length  # only the direction matters
    np.testing.assert_allclose(along, 0.0, atol=2e-6)


def test_normalise_keeps_every_digit_of_the_plain_formula():
    x = jnp.asarray(RNG.standard_normal((64, 96)) * 10.0 ** RNG.uniform(-3, 3, (64, 1)), jnp.float32)
    plain = x * jax.lax.rsqrt(jnp.sum(x * x, axis=-1, keepdims=True))
    np.testing.assert_array_equal(normalise(x), plain)
    tiny = jnp.full((1, 4), 1e-13, jnp.float32)  # below eps as torch: divided by 1e-12
    np.testing.assert_allclose(normalise(tiny), 0.1, rtol=1e-6)


@pytest.mark.parametrize("size", [0.0, 3.0, 1e4])
def test_matching_loss_is_stable_at_huge_logits(size):
    right = matching_loss(jnp.full(3, size), jnp.full(3, -size))
    wrong, grad = jax.value_and_grad(lambda x: matching_loss(-x, x))(jnp.full(3, size))
    np.testing.assert_allclose(right, 2 * np.log1p(np.exp(-size)), rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(wrong - right, 2 * size, rtol=1e-4)
    assert np.isfinite(np.asarray(grad)).all()
