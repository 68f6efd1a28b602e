import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from adam_moments import moments
from train_toy import toy_batch, toy_config, toy_loss, toy_params, toy_trained

from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch
from anytouch_jax.errors import ConfigError
from anytouch_jax.train.optim import optimizer, schedule
from anytouch_jax.train.step import init_state, make_step, merge, micro_batches, split
from anytouch_jax.weights.tree import flatten

KEY = jax.random.key(5)


def quiet_loss(params, batch, key, progress):
    """The toy loss without its noise, so that any cut of the batch has the same mean."""
    return toy_loss(params, batch, jax.random.key(0), progress)


def build(config=None, loss=toy_loss, **more):
    config = config or toy_config()
    step = make_step(
        loss, optimizer(config), total_steps=config.run.steps, trained=toy_trained, **more
    )
    return jax.jit(init_state, static_argnums=1)(toy_params(), config), jax.jit(step)


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_split_and_merge_are_inverse_and_disjoint():
    params = toy_params()
    rules = ((r"decoder/.*_head/kernel", True), (r"idle", True), (r"", False))
    trainable, frozen = split(params, rules)
    assert set(flatten(frozen)) == {
        "decoder/still_head/kernel",
        "decoder/clip_head/kernel",
        "idle/kernel",
    }
    assert not set(flatten(frozen)) & set(flatten(trainable))
    assert jax.tree.structure(merge(trainable, frozen)) == jax.tree.structure(params)
    assert_same(merge(trainable, frozen), params)
    with pytest.raises(ValueError, match="kernel is both"):
        merge(params, frozen)


def test_a_step_is_the_gradient_of_the_loss_through_adamw():
    config = toy_config()
    state, step = build(config)
    state = state._replace(step=np.int32(3))
    new, metrics = step(state, toy_batch(3), KEY)
    key = jax.random.fold_in(KEY, 3)

    def loss(trainable):
        return toy_loss(merge(trainable, state.frozen), toy_batch(3), key, 3 / config.run.steps)[0]

    value, grads = jax.device_get(jax.jit(jax.value_and_grad(loss))(state.trainable))
    rate = float(schedule(config)(3))
    assert metrics["loss"] == pytest.approx(float(value), rel=1e-6)
    assert metrics["p_u"] == pytest.approx(0.75 * 3 / config.run.steps)
    assert metrics["learning_rate"] == pytest.approx(rate)
    change = jax.tree.map(
        lambda a, b: np.asarray(a) - np.asarray(b), new.trainable, state.trainable
    )

    def norm(tree):
        return np.sqrt(sum(np.sum(np.square(x, dtype=np.float64)) for x in jax.tree.leaves(tree)))

    assert metrics["grad_norm"] == pytest.approx(norm(grads), rel=1e-5)
    assert metrics["param_norm"] == pytest.approx(norm(state.trainable), rel=1e-6)
    assert metrics["update_norm"] == pytest.approx(norm(change), rel=1e-4)
    # The first step of Adam is the sign of the gradient; biases do not decay.
    bias = grads["trunk"]["bias"]
    np.testing.assert_allclose(change["trunk"]["bias"], -rate * np.sign(bias), rtol=1e-3)
    assert {m.shape for m in metrics.values()} == {()} and {m.dtype for m in metrics.values()} == {
        jnp.dtype("float32")
    }


def test_a_kind_of_batch_leaves_the_head_it_does_not_use():
    state, step = build()
    # stills, clips, stills, clips, stills
    for index in range(5):
        before = state
        state, _ = step(state, toy_batch(index), KEY)
        idle = "clip_head" if index % 2 == 0 else "still_head"
        assert_same(state.trainable["decoder"][idle], before.trainable["decoder"][idle])
        now, then = (moments(s.opt_state, s.trainable)["decoder"][idle] for s in (state, before))
        assert_same(now, then)
    held = moments(state.opt_state, state.trainable)
    heads = [held["decoder"][f"{kind}_head"]["kernel"].updates for kind in ("clip", "still")]
    assert [*heads, held["idle"]["kernel"].updates, held["trunk"]["kernel"].updates] == [2, 3, 0, 5]
    assert_same(state.trainable["idle"], toy_params()["idle"])
    assert_same(state.frozen, {"decoder": {"position": toy_params()["decoder"]["position"]}})


@pytest.mark.parametrize(("index", "accumulate"), [(2, 2), (3, 8)])
def test_accumulation_equals_the_large_batch(index, accumulate):
    # Without Adam, which turns the sign of a gradient near zero into a whole step.
    state = init_state(toy_params(), toy_config())._replace(opt_state=optax.sgd(0.1).init(None))
    (whole, metrics), (parts, part_metrics) = (
        jax.jit(make_step(quiet_loss, optax.sgd(0.1), total_steps=8, accumulate=count))(
            state, toy_batch(index), KEY
        )
        for count in (1, accumulate)
    )
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6),
        whole.trainable,
        parts.trainable,
    )
    for name in ("loss", "reconstruction", "grad_norm", "update_norm", "p_u"):
        assert part_metrics[name] == pytest.approx(float(metrics[name]), rel=1e-5)


def test_micro_batches_have_their_own_keys_and_skip_unused_heads():
    config = toy_config(optim={"warmup": 0})

    def loss(params, batch, key, progress):
        value, metrics = toy_loss(params, batch, key, progress)
        return value, metrics | {"draw": jax.random.uniform(key)}

    state, step = build(config, loss, accumulate=4)
    new, metrics = step(state, toy_batch(0), KEY)
    key = jax.random.fold_in(KEY, 0)
    draws = [float(jax.random.uniform(jax.random.fold_in(key, m))) for m in range(4)]
    assert metrics["draw"] == pytest.approx(np.mean(draws), rel=1e-6)
    assert_same(new.trainable["decoder"]["clip_head"], state.trainable["decoder"]["clip_head"])
    assert moments(new.opt_state, new.trainable)["decoder"]["clip_head"]["kernel"].updates == 0


def test_rows_are_dealt_out_to_micro_batches():
    parts = micro_batches({"x": np.arange(8), "none": np.zeros((0, 3))}, 2)
    np.testing.assert_array_equal(parts["x"], [[0, 2, 4, 6], [1, 3, 5, 7]])
    assert parts["none"].shape == (2, 0, 3)
    with pytest.raises(ConfigError, match=r"8 rows is not divisible by --optim.accumulate 3"):
        micro_batches({"x": np.arange(8)}, 3)


def test_packed_slots_are_refused_by_accumulation_and_empty_ones_are_not():
    def stage2(slots):
        clip = np.zeros((4, 3, 2, 2, 3), np.uint8)
        ids = np.zeros(4, np.int32)
        image = np.zeros((slots, 2, 2, 3), np.uint8)
        rows = np.zeros(slots, np.int32)
        empty = np.zeros((0, 5), np.int32)
        align = AlignBatch(clip, ids, image, rows, empty, empty.astype(bool), np.zeros(0, np.int32))
        return Stage2Batch(align, MatchBatch(clip, ids, clip, ids, clip, ids))

    with pytest.raises(
        ConfigError, match=r"optim\.accumulate must be 1 for batches with images or texts"
    ):
        micro_batches(stage2(2), 2)
    assert micro_batches(stage2(0), 2).align.clip.shape == (2, 2, 3, 2, 2, 3)


@pytest.mark.parametrize("what", ["loss", "gradient"])
def test_a_step_that_is_not_finite_changes_nothing_and_is_counted(what):
    def loss(params, batch, key, progress):  # finite value, infinite slope
        value, metrics = toy_loss(params, batch, key, progress)
        return value + jnp.sum(jnp.sqrt(jnp.square(params["trunk"]["bias"]) * 0.0)), metrics

    config = toy_config(optim={"warmup": 0})
    state, good_step = build(config)
    bad_step = build(config, loss)[1] if what == "gradient" else good_step
    state, metrics = good_step(state, toy_batch(0), KEY)
    assert metrics["skipped"] == 0
    after, metrics = bad_step(state, toy_batch(2, bad=what == "loss"), KEY)
    assert (
        metrics["skipped"] == 1
        and metrics["update_norm"] == 0
        and not np.isfinite(metrics["grad_norm"])
    )
    assert np.isfinite(metrics["loss"]) == (what == "gradient")
    assert after.step == 2
    assert_same(after._replace(step=state.step), state)


def test_frozen_parameters_are_not_differentiated():
    def loss(params, batch, key, progress):
        @jax.custom_vjp
        def guard(x):
            return x

        def never(_, g):
            raise AssertionError("the frozen table was differentiated")

        guard.defvjp(lambda x: (x, None), never)
        decoder = params["decoder"] | {"position": guard(params["decoder"]["position"])}
        return toy_loss(params | {"decoder": decoder}, batch, key, progress)

    config = toy_config()
    step = make_step(loss, optimizer(config), total_steps=8)
    state = init_state(toy_params(), config)
    new, _ = jax.eval_shape(step, state, toy_batch(0), KEY)
    assert jax.tree.map(jnp.shape, new.frozen) == {"decoder": {"position": (4,)}}
    assert "decoder/position" not in flatten(state.trainable)
    thawed = state._replace(
        trainable=toy_params(), frozen={}, opt_state=optimizer(config).init(toy_params())
    )
    with pytest.raises(AssertionError, match="frozen table"):
        jax.eval_shape(step, thawed, toy_batch(0), KEY)
