from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.ops import losses
from anytouch_jax.ops.losses import alignment_loss, info_nce

RNG = np.random.default_rng(0)
# A program for each shape, and not one for each operation.
nce = jax.jit(info_nce, static_argnames="groups")
nce_grad = jax.jit(jax.value_and_grad(info_nce, argnums=(0, 1)))
normalise, normalise_patches, centered = map(
    jax.jit, (losses.normalise, losses.normalise_patches, losses.centered)
)


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
    a = unit(8, seed=1)
    b = unit(8, seed=2)
    ours = nce(a, b, 1 / tau, present)
    np.testing.assert_allclose(
        ours, loop_info_nce(a, b, 1 / tau, present), rtol=2e-5, atol=2e-5 / tau
    )


@pytest.mark.parametrize("garbage", [0.0, 1e6, np.nan, np.inf])
def test_absent_rows_touch_neither_value_nor_gradient(garbage):
    present = PRESENCE["mixed"]
    a = unit(8, seed=1)
    b = unit(8, seed=2)
    dirty_a, dirty_b = (np.where(present[:, None], z, garbage) for z in (a, b))

    clean = nce_grad(a, b, 14.0, present)
    dirty = nce_grad(dirty_a, dirty_b, 14.0, present)
    jax.tree.map(np.testing.assert_array_equal, clean, dirty)
    assert not np.asarray(clean[1][0])[~present].any()


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_info_nce_is_finite_on_duplicates_and_zeros(dtype):
    same = np.broadcast_to(unit(1), (5, 6)).astype(dtype)
    present = np.ones(5, bool)
    value_and_grad = jax.jit(
        jax.value_and_grad(lambda z, scale: info_nce(*[losses.normalise(z)] * 2, scale, present))
    )
    for scale in (0.01, 100.0):
        # Identical rows: every candidate is as likely as the right one.
        np.testing.assert_allclose(value_and_grad(same, scale)[0], np.log(5), rtol=1e-3)
        value, grad = value_and_grad(np.zeros((5, 6), dtype), scale)
        assert np.isfinite(value) and np.isfinite(np.asarray(grad, np.float32)).all()


def test_the_products_of_info_nce_are_whole_on_every_device():
    """An accelerator's default is TF32 or bfloat16: a hundredth of a logit that is multiplied by
    100.
    """
    a = np.ones((4, 8), np.float32)
    present = np.ones(4, bool)
    text = str(jax.make_jaxpr(jax.grad(info_nce, argnums=(0, 1)))(a, a, np.float32(100.0), present))
    # of both operands
    assert text.count("dot_general[") == 3 and text.count("HIGHEST") == 6, text


def test_groups_keep_negatives_in_their_fraction():
    a = unit(8, seed=1)
    b = unit(8, seed=2)
    present = PRESENCE["mixed"]
    ours = nce(a, b, 9.0, present, groups=2)
    fractions = [loop_info_nce(a[s], b[s], 9.0, present[s]) for s in (slice(0, 4), slice(4, 8))]
    np.testing.assert_allclose(ours, np.mean(fractions), rtol=1e-5)
    # the other fraction has no pair: 0, and it counts in the mean
    half = present & (np.arange(8) < 4)
    ours = nce(a, b, 9.0, half, groups=2)
    np.testing.assert_allclose(ours, loop_info_nce(a[:4], b[:4], 9.0, half[:4]) / 2, rtol=1e-5)


def test_centred_embeddings_that_are_all_one_are_nothing_not_noise():
    """Rounding is not blown up to unit length, nor is its gradient."""
    present = np.arange(64) < 7
    spread = unit(64, 32, 3).astype("f4")
    same = np.concatenate(
        [np.repeat(unit(1, 32), 7, axis=0), RNG.standard_normal((57, 32))]
    ).astype("f4")
    assert np.abs(centered(same, present)).max() < 1e-3
    grad = jax.jit(
        jax.grad(
            lambda x: info_nce(
                losses.centered(x, present), unit(64, 32, 2), jnp.float32(14.0), present
            )
        )
    )(same)
    assert np.abs(grad).max() < 1e4
    np.testing.assert_allclose(
        np.linalg.norm(centered(spread, np.ones(64, bool)), axis=1), 1.0, atol=1e-5
    )


def test_normalised_patches_use_the_unbiased_variance_and_survive_constants():
    patches = RNG.standard_normal((2, 3, 1, 12)) * 5 + 2
    expected = (patches - patches.mean(-1, keepdims=True)) / np.sqrt(
        patches.var(-1, ddof=1, keepdims=True) + 1e-6
    )
    np.testing.assert_allclose(normalise_patches(patches), expected, rtol=1e-4, atol=1e-5)
    # a patch of one value too
    for size in (12, 1):
        total = jax.jit(jax.value_and_grad(lambda x: losses.normalise_patches(x).sum()))
        value, grad = total(np.full((1, 1, 1, size), 3.0, "f4"))
        assert value == 0 and np.isfinite(grad).all()


def test_normalise_is_exact_and_has_a_finite_gradient_at_zero():
    """Below eps a vector is divided by 1e-12, as in torch.

    A gradient above 1e13 would be infinite further down.
    """
    x = np.concatenate([RNG.standard_normal((4, 6)), np.zeros((1, 6)), np.full((1, 6), 1e-13)])
    expected = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)
    np.testing.assert_allclose(normalise(x), expected, rtol=1e-6)
    grad = jax.jit(jax.grad(lambda z: losses.normalise(z).sum()))(np.zeros((2, 6), "f4"))
    assert 0 < np.abs(grad).max() < 1e13


def test_normalise_gives_length_one_to_every_length():
    """Only the direction matters: the gradient along it is 0."""
    size = np.array([1e-11, 1e-7, 1e-3, 1.0, 1e20, 3e38])[:, None]
    direction = unit(1, seed=3)
    z, pull = jax.jit(lambda x, g: (z := jax.vjp(losses.normalise, x), (z[0], *z[1](g)))[1])(
        (direction * size).astype("f4"), np.repeat(unit(1, seed=4), 6, 0).astype("f4")
    )
    np.testing.assert_allclose(z, np.repeat(direction, 6, 0), rtol=2e-6)
    assert np.isfinite(pull).all()
    np.testing.assert_allclose(np.asarray(pull, np.float64) @ direction.T * size, 0.0, atol=2e-6)


def test_normalise_keeps_every_digit_of_the_plain_formula():
    x = (RNG.standard_normal((64, 96)) * 10.0 ** RNG.uniform(-3, 3, (64, 1))).astype("f4")
    plain = jax.jit(lambda x: x * jax.lax.rsqrt(jnp.sum(x * x, axis=-1, keepdims=True)))
    np.testing.assert_array_equal(normalise(x), plain(x))


def test_matching_loss_is_stable_at_huge_logits():
    loss = jax.jit(jax.value_and_grad(lambda x: losses.matching_loss(x, -x)))
    for size in (0.0, 3.0, 1e4):
        right, _ = loss(np.full(3, size))
        wrong, grad = loss(np.full(3, -size))
        np.testing.assert_allclose(right, 2 * np.log1p(np.exp(-size)), rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(wrong - right, 2 * size, rtol=1e-4)
        assert np.isfinite(grad).all()


B = 6
E = 5
WEIGHTS = (0.5, 0.25, 0.1)
HAS_IMAGE, HAS_TEXT = np.array([[1, 1, 0, 1, 1, 0], [0, 1, 1, 1, 0, 1]], bool)


def draw():
    return tuple(np.random.default_rng(0).standard_normal((3, B, E)).astype("f4"))


@partial(jax.jit, static_argnums=1)
@partial(jax.value_and_grad, has_aux=False)
def loss_and_grads(z, center):
    return alignment_loss(*z, HAS_IMAGE, HAS_TEXT, jnp.float32(5.0), WEIGHTS, center=center)[0]


def loss(z, center=True):
    return float(loss_and_grads(tuple(z), center)[0])


def test_rows_have_unit_length_and_mean_zero_before_it():
    (x, _, _) = draw()
    z = np.asarray(jax.jit(centered)(x, HAS_IMAGE))
    there = HAS_IMAGE
    np.testing.assert_allclose(np.linalg.norm(z[there], axis=1), 1.0, rtol=1e-6)
    own = x[there] - x[there].mean(0)
    np.testing.assert_allclose(
        z[there], own / np.linalg.norm(own, axis=1, keepdims=True), rtol=1e-5
    )
    np.testing.assert_array_equal(z[~there], 0.0)


@pytest.mark.parametrize("which", range(3))
def test_what_all_samples_fraction_does_not_count(which):
    z = draw()
    moved = [x + (10.0 * np.arange(E, dtype="f4") if i == which else 0.0) for i, x in enumerate(z)]
    np.testing.assert_allclose(loss(moved), loss(z), rtol=1e-4)
    assert abs(loss(moved, center=False) - loss(z, center=False)) > 0.1


@pytest.mark.parametrize("garbage", [1e30, np.nan, np.inf])
def test_absent_rows_are_not_in_the_mean_nor_in_the_gradient(garbage):
    touch, image, text = draw()
    value, (_, grad, _) = loss_and_grads(
        (touch, np.where(HAS_IMAGE[:, None], image, np.float32(garbage)), text), True
    )
    np.testing.assert_allclose(value, loss((touch, image, text)), rtol=1e-6)
    assert np.isfinite(grad).all() and not np.any(grad[~HAS_IMAGE])


def test_the_gradient_does_not_vanish_near_the_collapsed_point():
    """Almost equal embeddings: without centring nothing pulls them apart, with it the pull grows as
    they near.
    """
    near = tuple(np.float32(1.0) + np.float32(1e-3) * x for x in draw())

    def pull(center):
        value = lambda x: loss_and_grads.__wrapped__((normalise(x), *near[1:]), center)[0]  # noqa: E731
        return float(np.abs(jax.jit(jax.grad(value))(near[0])).max())

    assert pull(True) > 100 * pull(False)


def test_equal_embeddings_and_a_single_pair_have_a_finite_gradient():
    assert all(
        np.isfinite(grad).all() for grad in loss_and_grads((np.ones((B, E), "f4"),) * 3, True)[1]
    )
    one = np.ones((1, E), "f4")
    single = jax.jit(
        lambda z: alignment_loss(z, z, None, None, None, jnp.float32(5.0), WEIGHTS, center=True)[0]
    )
    assert float(single(one)) == 0.0
