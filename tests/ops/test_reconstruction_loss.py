"""The loss of masked reconstruction and of the next frame (Eq. 1, 2), against loops."""

from functools import partial

import jax
import numpy as np
import pytest

from anytouch_jax.ops.losses import reconstruction_loss

B, N, T, C = 3, 5, 4, 6
# The rows hide 1, 4 and 2 positions: a mean over rows would differ from one over positions.
HIDDEN = np.array([[0, 1, 0, 0, 0], [1, 1, 0, 1, 1], [0, 0, 1, 1, 0]], bool)


@partial(jax.jit, static_argnames="next_frame")
def value_and_grad(pred, target, hidden, next_frame):
    loss = partial(reconstruction_loss, target=target, hidden=hidden, next_frame=next_frame)
    return jax.value_and_grad(loss, has_aux=True)(pred)


def drawn():
    """Return predictions and targets. The row that hides the most has the largest errors."""
    rng = np.random.default_rng(0)
    pred, target = rng.standard_normal((2, B, N, T, C)).astype(np.float32)
    factor = np.array([1.0, 4.0, 2.0], np.float32)[:, None, None, None]
    return factor * pred, factor * target


def looped(pred, target, hidden, next_frame):
    """Return both terms as they are written: means over hidden and over all positions."""
    past = T - next_frame
    hidden_errors, future_errors = [], []
    for row in range(B):
        for place in range(N):
            error = np.square(np.float64(pred[row, place]) - target[row, place]).mean(-1)
            if hidden[row, place]:
                hidden_errors.append(error[:past].mean())
            if next_frame:
                future_errors.append(error[-1])
    return np.mean(hidden_errors or [0.0]), np.mean(future_errors or [0.0])


@pytest.mark.parametrize("hidden", [HIDDEN, ~HIDDEN, HIDDEN & False, HIDDEN | True])
@pytest.mark.parametrize("next_frame", [False, True])
def test_the_loss_equals_the_loop(hidden, next_frame):
    pred, target = drawn()
    (loss, metrics), _ = value_and_grad(pred, target, hidden, next_frame)
    past, future = looped(pred, target, hidden, next_frame)
    assert set(metrics) == ({"reconstruction", "next_frame"} if next_frame else {"reconstruction"})
    np.testing.assert_allclose(metrics["reconstruction"], past, rtol=1e-5)
    np.testing.assert_allclose(loss, past + future, rtol=1e-5)
    if next_frame:
        np.testing.assert_allclose(metrics["next_frame"], future, rtol=1e-5)


@pytest.mark.parametrize("garbage", [1e30, np.nan, np.inf])
@pytest.mark.parametrize("next_frame", [False, True])
def test_what_does_not_count_touches_neither_value_nor_gradient(garbage, next_frame):
    """The past of a visible position was an input. Predicting it is no task."""
    pred, target = drawn()
    past = np.arange(T) < T - next_frame
    ignored = (~HIDDEN[:, :, None] & past)[..., None]
    (loss, _), grad = value_and_grad(pred, target, HIDDEN, next_frame)
    dirty = np.where(ignored, np.float32(garbage), pred)
    dirty_target = np.where(ignored, np.float32(-garbage), target)
    (again, _), again_grad = value_and_grad(dirty, dirty_target, HIDDEN, next_frame)
    np.testing.assert_array_equal(again, loss)
    np.testing.assert_array_equal(again_grad, grad)
    counts = np.broadcast_to(~ignored, grad.shape)
    grad = np.asarray(grad)
    assert not grad[~counts].any() and (grad[counts] != 0).all()


def test_every_hidden_position_pulls_alike():
    """The gradient is 2 / (count of values in the mean) times the error, whatever the row."""
    pred, target = drawn()
    _, grad = value_and_grad(pred, target, HIDDEN, True)
    error = pred - target
    pull = np.asarray(grad) / (2 * error)
    past = pull[..., :-1, :][HIDDEN]
    np.testing.assert_allclose(past, 1 / (HIDDEN.sum() * (T - 1) * C), rtol=1e-4)
    np.testing.assert_allclose(pull[..., -1, :], 1 / (B * N * C), rtol=1e-4)
