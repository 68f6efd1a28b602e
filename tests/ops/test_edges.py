import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_models import full_model

from anytouch_jax import objectives
from anytouch_jax.nn.functional import build
from anytouch_jax.ops import losses, tokens

RNG = np.random.default_rng(0)
NET = build(full_model())
Z, OTHER = RNG.standard_normal((2, 6, 4)).astype("f4")
PRESENT = np.array([1, 0, 1, 1, 0, 1], bool)
PRED, TARGET = RNG.standard_normal((2, 6, 5, 4, 3)).astype("f4")
HIDDEN = np.array([[1, 1, 0, 0, 1]] * 6, bool)
CLIP = RNG.standard_normal((6, 2, 8, 4, 3)).astype("f4")
NOISE = RNG.random((6, 5)).astype("f4")
IDS = np.array([[3, 1]] * 6)
# Every function of losses and tokens with the arrays that it takes: the first axis of each is the
# batch.
CALLS = {
    "normalise": (losses.normalise, Z),
    "normalise_patches": (losses.normalise_patches, PRED),
    "reconstruction_loss": (
        lambda *x: losses.reconstruction_loss(*x, next_frame=False),
        PRED,
        TARGET,
        HIDDEN,
    ),
    "next frame": (
        lambda *x: losses.reconstruction_loss(*x, next_frame=True),
        PRED,
        TARGET,
        HIDDEN,
    ),
    "info_nce": (lambda a, b, has: losses.info_nce(a, b, 14.0, has), Z, OTHER, PRESENT),
    "places": (
        lambda a, b, has, at: losses.info_nce(a, b, 14, has, place=at),
        Z,
        OTHER,
        PRESENT,
        np.arange(6) // 2,
    ),
    "centered": (losses.centered, Z, PRESENT),
    "alignment_loss": (
        lambda a, b, c, *has: losses.alignment_loss(
            a, b, c, *has, 14.0, (1, 1.0, 0.2), center=True
        ),
        Z,
        OTHER,
        Z[::-1],
        PRESENT,
        ~PRESENT,
    ),
    "contrast_loss": (
        lambda a, b, at: losses.contrast_loss(a, b, 14.0, place=at),
        Z,
        OTHER,
        np.arange(6) // 2,
    ),
    "laplace_loss": (lambda x, y: losses.laplace_loss(x, y).sum(), Z, OTHER),
    "binary_loss": (lambda x, y: losses.binary_loss(x, y).sum(), Z, NOISE[:, :4]),
    "matching_loss": (losses.matching_loss, Z[:, 0], OTHER[:, 0]),
    "patchify": (lambda x: tokens.patchify(x, 4), CLIP),
    "unpatchify": (
        lambda x: tokens.unpatchify(x, 4, 8),
        RNG.standard_normal((6, 2, 2, 48)).astype("f4"),
    ),
    "segments": (lambda x: tokens.segments(x, 2), CLIP),
    "draw_tokens": (
        lambda ids, u: tokens.draw_tokens(ids, u, 0.5, 9),
        np.arange(6, dtype="i4"),
        NOISE[:, 0],
    ),
    "universal_probability": (lambda x: tokens.universal_probability(x, 0.0, 0.75), NOISE[:, 0]),
    "random_mask": (lambda x: tokens.random_mask(x, 2), NOISE),
    "keep": (tokens.keep, PRED, IDS),
    "restore": (
        lambda x, ids: tokens.restore(x, [0.0] * 4, ids),
        OTHER[:, None],
        IDS[:, [0, 1, 0]] % 2,
    ),
    "normalise_touch": (objectives.normalise_touch, RNG.integers(0, 256, (6, 2, 2, 3), np.uint8)),
}


@pytest.mark.parametrize("name", CALLS)
def test_array_likes_strict_types_and_empty_batches(name):
    call, *arrays = CALLS[name]
    wanted = call(*map(jnp.asarray, arrays))
    for given in (arrays, [x.tolist() for x in arrays]):
        with jax.numpy_dtype_promotion("strict"):
            jax.tree.map(
                lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-6), call(*given), wanted
            )
    empty = call(*(x[:0] for x in arrays))
    for x, whole in zip(*map(jax.tree.leaves, (empty, wanted)), strict=True):
        assert (
            np.isfinite(x).all()
            and x.shape == (whole.shape and (0, *whole.shape[1:]))
            and x.dtype == whole.dtype
        )
        assert x.shape or float(x) == 0  # the loss of nothing is 0


@pytest.mark.parametrize("factor", [1, -0.5])
@pytest.mark.parametrize(
    "name",
    ["reconstruction_loss", "next frame", "info_nce", "places", "centered", "alignment_loss"],
)
def test_a_mask_is_what_is_not_zero(name, factor):
    call, *arrays = CALLS[name]
    masks = [x * factor if x.dtype == bool else x for x in arrays]
    jax.tree.map(np.testing.assert_array_equal, call(*masks), call(*arrays))


@pytest.mark.parametrize("log", [90.0, 88.0, 20.0])
def test_an_absurd_temperature_gives_no_nan_and_can_fall_again(log):
    def loss(log, a):
        return losses.info_nce(a, OTHER, NET.scale({"logit_scale": log}), PRESENT)

    value, (slope, rows) = jax.value_and_grad(loss, (0, 1))(np.float32(log), Z)
    np.testing.assert_allclose(value, losses.info_nce(Z, OTHER, 100.0, PRESENT), rtol=1e-4)
    assert np.isfinite(slope) and slope and np.isfinite(rows).all()
    for scale in (np.float32(1e38), np.inf):
        value, rows = jax.value_and_grad(losses.info_nce)(Z, OTHER, scale, PRESENT)
        assert np.isfinite(value) and np.isfinite(rows).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e38])
@pytest.mark.parametrize("next_frame", [False, True])
def test_patches_that_do_not_count_reach_neither_loss_nor_gradient(bad, next_frame):
    counts = np.broadcast_to(HIDDEN[:, :, None, None], PRED.shape).copy()
    counts[:, :, -1] |= next_frame
    dirty = [np.where(counts, x, bad).astype("f4") for x in (PRED, TARGET)]

    def loss(pred, target):
        return losses.reconstruction_loss(pred, target, HIDDEN, next_frame=next_frame)[0]

    value, slope = jax.value_and_grad(loss, (0, 1))(*dirty)
    wanted, right = jax.value_and_grad(loss, (0, 1))(PRED, TARGET)
    np.testing.assert_allclose(value, wanted, rtol=1e-6)
    for ours, theirs in zip(slope, right, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: losses.reconstruction_loss(
                PRED[:, :, :1], TARGET[:, :, :1], HIDDEN, next_frame=True
            ),
            "2 or more",
        ),
        (
            lambda: losses.reconstruction_loss(PRED, TARGET[:, :, :1], HIDDEN, next_frame=False),
            "one shape",
        ),
        (
            lambda: losses.reconstruction_loss(PRED, TARGET, HIDDEN[0], next_frame=False),
            r"hidden \(B, N\)",
        ),
        (lambda: losses.info_nce(Z, OTHER, 14, PRESENT, groups=4), "4 groups"),
        (lambda: losses.info_nce(Z, OTHER, 14, PRESENT[:3]), r"present \(B,\)"),
        (lambda: losses.alignment_loss(Z, OTHER, None, None, None, 14, (1, 1)), "three"),
        (lambda: tokens.patchify(CLIP, 0), "0 pixels"),
        (lambda: tokens.patchify(CLIP[0], 4), "B, T, H, W, C"),
        (lambda: tokens.unpatchify(CLIP[:, :, 0], 4, 0), "height 0"),
        (lambda: tokens.random_mask(NOISE, 6), "not 6"),
        (lambda: tokens.random_mask(NOISE[0], 1), "B, N"),
        (lambda: tokens.count_visible(4, 1.5), "not 1.5"),
        (lambda: tokens.sincos_table(0, 4), "not 0"),
        (lambda: tokens.segments(CLIP, 0), "not 0"),
        (lambda: tokens.restore(Z[:, None], Z[0], np.zeros((6, 0), int)), "do not fit"),
    ],
)
def test_a_static_mistake_is_one_sentence(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_the_universal_probability_stays_at_its_ends():
    np.testing.assert_allclose(
        tokens.universal_probability([-1, 0, 0.5, 1, 1.5], 0, 0.75), [0, 0, 0.375, 0.75, 0.75]
    )
