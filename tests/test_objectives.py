from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_models import compiled, tiny_config

from anytouch_jax import objectives
from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.nn.functional import build
from anytouch_jax.train.mesh import batch_sharding, make_mesh, put_batch, replicated
from anytouch_jax.train.optim import optimizer
from anytouch_jax.train.step import init_state, make_step, merge
from anytouch_jax.weights.tree import flatten

RNG = np.random.default_rng(0)
SENSOR = np.asarray([0, 3, 1, 9], np.int32)
CONFIG1 = tiny_config(1)
CONFIG2 = tiny_config(2)
COMPILED1 = compiled(CONFIG1.model)
COMPILED2 = compiled(CONFIG2.model)
NET1 = COMPILED1.net
PARAMS1 = COMPILED1.params
NET2 = COMPILED2.net
PARAMS2 = COMPILED2.params
NOISE = RNG.random((4, 16)).astype("f4")
KEY = jax.random.key(3)


def floats(*shape):
    return RNG.standard_normal((*shape, 28, 28, 3)).astype("f4")


CLIP4 = floats(4, 4)


def set_at(array, place, value):
    array = np.array(array)
    array[place] = value
    return array


def flops(function, *args):
    return jax.jit(function).lower(*args).cost_analysis()["flops"]


def changed(config, **objective):
    return replace(config, objective=replace(config.objective, **objective))


@cache
def stage1_terms(config=CONFIG1):
    return jax.jit(
        jax.value_and_grad(partial(objectives.stage1_terms, net=NET1, config=config), has_aux=True)
    )


@jax.jit
def reconstruct(params, clip):
    def total(clip):
        pred, hidden = objectives.reconstruct(params, clip, SENSOR, NOISE, net=NET1, config=CONFIG1)
        return jnp.sum(pred**2), (pred, hidden)

    return jax.value_and_grad(total, has_aux=True)(clip)


def test_hidden_patches_and_the_future_frame_have_exactly_no_influence():
    (_, (pred, hidden)), grad = reconstruct(PARAMS1, CLIP4)
    grad = np.asarray(grad)
    hidden = np.asarray(hidden)
    assert pred.shape == (4, 16, 4, 147) and hidden.sum(axis=1).tolist() == [12] * 4
    # another mask for every sample
    assert len({tuple(row) for row in hidden.tolist()}) == 4
    assert not grad[:, 3].any()
    cells = (
        grad[:, :3].reshape(4, 3, 4, 7, 4, 7, 3).transpose(0, 2, 4, 1, 3, 5, 6).reshape(4, 16, -1)
    )
    assert not cells[hidden].any() and (np.abs(cells[~hidden]).max(axis=-1) > 0).all()
    (_, (other, _)), _ = reconstruct(PARAMS1, set_at(CLIP4, (slice(None), 3), 7.0))
    np.testing.assert_array_equal(other, pred)


def test_the_loss_is_hidden_patches_of_three_frames_and_all_of_the_next():
    (_, (pred, hidden)), _ = reconstruct(PARAMS1, CLIP4)
    cells = (
        np.asarray(CLIP4)
        .reshape(4, 4, 4, 7, 4, 7, 3)
        .transpose(0, 2, 4, 1, 3, 5, 6)
        .reshape(4, 16, 4, 147)
    )
    error = ((np.asarray(pred) - cells) ** 2).mean(axis=-1)
    (loss, metrics), _ = stage1_terms()(PARAMS1, CLIP4, SENSOR, NOISE)
    np.testing.assert_allclose(
        metrics["reconstruction"], error[..., :3].mean(-1)[np.asarray(hidden)].mean(), rtol=1e-5
    )
    np.testing.assert_allclose(metrics["next_frame"], error[..., 3].mean(), rtol=1e-5)
    np.testing.assert_allclose(loss, metrics["reconstruction"] + metrics["next_frame"], rtol=1e-6)


def test_without_next_frame_the_fourth_frame_is_as_if_it_were_not_there():
    off = changed(CONFIG1, next_frame=False)
    (four, metrics), grads = stage1_terms(off)(PARAMS1, CLIP4, SENSOR, NOISE)
    (three, _), others = stage1_terms()(PARAMS1, CLIP4[:, :3], SENSOR, NOISE)
    assert set(metrics) == {"reconstruction"}
    np.testing.assert_array_equal(four, three)
    jax.tree.map(np.testing.assert_array_equal, grads, others)


def test_bfloat16_stays_near_float32():
    half = replace(CONFIG1, model=replace(CONFIG1.model, dtype="bfloat16"))
    terms = partial(objectives.stage1_terms, net=build(half.model), config=half)
    (value, _), grads = jax.jit(jax.value_and_grad(terms, has_aux=True))(
        PARAMS1, CLIP4, SENSOR, NOISE
    )
    (exact, _), wanted = stage1_terms()(PARAMS1, CLIP4, SENSOR, NOISE)
    assert value.dtype == jnp.float32
    assert 0 < abs(float(value) - float(exact)) < 5e-3 * float(exact)
    norm = lambda tree: np.sqrt(sum(np.sum(np.square(x)) for x in jax.tree.leaves(tree)))  # noqa: E731
    grads, wanted = jax.device_get((grads, wanted))
    assert norm(jax.tree.map(np.subtract, grads, wanted)) < 0.03 * norm(wanted)


def align_batch():
    """Four touches; images of rows 2 and 0, texts of rows 3, 2 and 1... and one slot of each that
    is not used.
    """
    text = set_at(RNG.integers(1, 40, (4, 8)).astype(np.int32), (slice(None), slice(5, None)), 49)
    mask = np.asarray([[True] * 6 + [False] * 2] * 4)
    rows = np.asarray([2, 0, 4], np.int32), np.asarray([3, 2, 4, 0], np.int32)
    return AlignBatch(floats(4, 3), SENSOR, floats(3), rows[0], text, mask, rows[1])


ALIGN = align_batch()
MATCH = MatchBatch(floats(4, 1), SENSOR, floats(4, 1), SENSOR[::-1], floats(4, 1), SENSOR)
# Eq. 4 as it stands
PAPER2 = replace(CONFIG2, objective=replace(CONFIG2.objective, center_embeddings=False))
FUNCTION2 = partial(objectives.stage2_terms, noise=None, net=NET2, config=PAPER2)
embed = jax.jit(partial(objectives.touch_embeddings, net=NET2))
TERMS2 = jax.jit(jax.value_and_grad(FUNCTION2, has_aux=True))


def terms2(align=ALIGN, params=PARAMS2):
    return TERMS2(params, Stage2Batch(align, MATCH))


def test_packed_slots_reach_their_rows():
    (touch,) = embed(PARAMS2, [(ALIGN.clip, ALIGN.sensor)])
    z = jax.jit(partial(objectives.align_embeddings, net=NET2))(PARAMS2, ALIGN, touch)
    assert z.has_image.tolist() == [True, False, True, False] and z.has_text.tolist() == [
        True,
        False,
        True,
        True,
    ]
    unit = lambda x: np.asarray(x) / np.linalg.norm(x, axis=-1, keepdims=True)  # noqa: E731
    image = unit(COMPILED2.encode_image(PARAMS2, ALIGN.image))
    text = unit(COMPILED2.encode_text(PARAMS2, ALIGN.text, ALIGN.text_mask))
    for row, slot in ((2, 0), (0, 1)):
        np.testing.assert_allclose(z.image[row], image[slot], atol=1e-5)
    for row, slot in ((3, 0), (2, 1), (0, 3)):
        np.testing.assert_allclose(z.text[row], text[slot], atol=1e-5)
    assert not np.asarray(z.image)[[1, 3]].any() and not np.asarray(z.text)[1].any()
    (_, metrics), _ = terms2()
    np.testing.assert_allclose(
        metrics["touch_to_vision"], loop(z.touch, z.image, [0, 2]), rtol=1e-4
    )
    np.testing.assert_allclose(metrics["vision_to_text"], loop(z.image, z.text, [0, 2]), rtol=1e-4)
    np.testing.assert_allclose(
        metrics["text_to_touch"], loop(z.text, z.touch, [0, 2, 3]), rtol=1e-4
    )
    assert [int(metrics[f"{p}_pairs"]) for p in ("touch_vision", "touch_text", "vision_text")] == [
        2,
        3,
        2,
    ]


def loop(a, b, rows):
    """InfoNCE over the rows that are there, written out."""
    a = np.asarray(a, np.float64)[rows]
    b = np.asarray(b, np.float64)[rows]
    logits = a @ b.T / 0.07
    return float(np.mean([np.log(np.exp(row - row[i]).sum()) for i, row in enumerate(logits)]))


def test_garbage_in_unused_slots_changes_nothing():
    text = set_at(ALIGN.text, 2, 1_000_000)
    mask = set_at(ALIGN.text_mask, 2, False)
    spoilt = ALIGN._replace(image=set_at(ALIGN.image, 2, np.nan), text=text, text_mask=mask)
    jax.tree.map(np.testing.assert_array_equal, terms2(spoilt), terms2())
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(terms2(spoilt)))


def test_towers_that_nothing_is_shown_to_cost_nothing_and_need_not_exist():
    slots = ("image", "image_row", "text", "text_mask", "text_row")
    none = ALIGN._replace(**{name: getattr(ALIGN, name)[:0] for name in slots})

    def terms(p, b):
        batch = Stage2Batch(b, None)
        return objectives.stage2_terms(p, batch, None, net=NET2, config=CONFIG2)

    # no towers, no decoder, no matching head
    touch = {name: PARAMS2[name] for name in ("touch", "logit_scale")}
    encode = flops(lambda p: NET2.encode_touch(p, ALIGN.clip, SENSOR), touch)
    assert flops(terms, touch, none) < 1.02 * encode
    assert flops(terms, PARAMS2, ALIGN) > 1.3 * encode
    loss, metrics = jax.jit(terms)(touch, none)
    assert float(loss) == 0 and set(metrics) == {"align", "temperature"}


@pytest.mark.parametrize("recipe", ["paper", "release"])
def test_the_weights_of_the_sum(recipe):
    config = tiny_config(2, recipe)
    net = compiled(config.model)
    terms = jax.jit(partial(objectives.stage2_terms, net=net.net, config=config))
    align = ALIGN._replace(clip=CLIP4)
    total, m = terms(net.params, Stage2Batch(align, MATCH), NOISE)
    # the release does not halve the touch-text pair (golden Q9)
    text = {"paper": 0.5, "release": 1.0}[recipe]
    weights = (("touch", "vision", 0.5), ("touch", "text", text), ("vision", "text", 0.1))
    by_hand = sum(weight * (m[f"{a}_to_{b}"] + m[f"{b}_to_{a}"]) for a, b, weight in weights)
    np.testing.assert_allclose(m["align"], by_hand, rtol=1e-6)
    pixel_loss = m["reconstruction"] + m["next_frame"] if recipe == "release" else 0.0
    assert ("reconstruction" in m) == (recipe == "release")
    np.testing.assert_allclose(total, by_hand + 0.1 * m["match"] + pixel_loss, rtol=1e-6)
    np.testing.assert_allclose(m["temperature"], 0.07, rtol=1e-6)
    assert 0 <= float(m["match_accuracy"]) <= 1


def test_touches_of_one_shape_fraction_a_pass_and_keep_their_rows():
    touches = [*zip(MATCH[:6:2], MATCH[1::2], strict=True), (MATCH.clip[:2], MATCH.sensor[:2])]
    z = embed(PARAMS2, touches)
    for (clip, sensor), got in zip(touches, z, strict=True):
        wanted = np.asarray(COMPILED2.encode_touch(PARAMS2, clip, sensor))
        np.testing.assert_allclose(
            got, wanted / np.linalg.norm(wanted, axis=1, keepdims=True), rtol=1e-4, atol=1e-5
        )
    scans = lambda touches: str(jax.make_jaxpr(embed)(PARAMS2, touches)).count(" scan[")  # noqa: E731
    assert scans(touches) == 2 * scans(touches[:3]) == 2 * scans(touches[:1]) > 0


def test_cosine_matching_has_the_other_places_of_the_batch_as_negatives():
    config = replace(CONFIG2, model=replace(CONFIG2.model, match_head="cosine"))
    # never looked at
    net = compiled(config.model)
    nothing = np.full((4, 1, 28, 28, 3), np.nan, "f4")
    match = MatchBatch(floats(4, 1), SENSOR, floats(4, 1), SENSOR, nothing, SENSOR)
    terms = jax.jit(partial(objectives.stage2_terms, noise=None, net=net.net, config=config))
    total, metrics = terms(net.params, Stage2Batch(None, match))
    both = [np.asarray(x, np.float64) for x in embed(net.params, [match[:2], match[2:4]])]
    logits = both[0] @ both[1].T / config.model.temperature
    away = lambda x: np.log(np.exp(x).sum(1)) - np.diag(x)  # noqa: E731
    np.testing.assert_allclose(
        metrics["match"], (away(logits).mean() + away(logits.T).mean()) / 2, rtol=1e-4
    )
    np.testing.assert_allclose(
        total, config.objective.match_weight * float(metrics["match"]), rtol=1e-6
    )
    assert float(metrics["match_accuracy"]) == (logits.argmax(1) == np.arange(4)).mean()
    place = np.array([7, 2, 7, 2])
    _, metrics = terms(net.params, Stage2Batch(None, match._replace(place=place)))
    # no negatives: they are of the same place
    logits[(place[:, None] == place) & ~np.eye(4, dtype=bool)] = -np.inf
    np.testing.assert_allclose(
        metrics["match"], (away(logits).mean() + away(logits.T).mean()) / 2, rtol=1e-4
    )
    assert float(metrics["match_accuracy"]) >= (logits.argmax(1) == np.arange(4)).mean()


@pytest.mark.parametrize(
    ("fraction", "count"), [(0.25, 4), (0.01, 1)]
)  # one patch stays, however small the fraction
def test_patches_that_matching_drops_have_no_influence(fraction, count):
    config = changed(CONFIG2, match_keep=fraction)
    noise = RNG.random((3, 4, 16)).astype("f4")
    match = MatchBatch(floats(4, 1), SENSOR, floats(4, 1), SENSOR, floats(4, 1), SENSOR)

    def loss(clip):
        batch = Stage2Batch(None, match._replace(positive=clip))
        return objectives.stage2_terms(
            PARAMS2, batch, None, net=NET2, config=config, match_noise=noise
        )[0]

    slope = (
        np.asarray(jax.jit(jax.grad(loss))(match.positive))
        .reshape(4, 4, 7, 4, 7, 3)
        .transpose(0, 1, 3, 2, 4, 5)
    )
    felt = np.abs(slope.reshape(4, 16, -1)).max(-1) > 0
    kept = np.asarray(noise[1]).argsort(1)[:, :count]
    np.testing.assert_array_equal(
        np.sort(np.nonzero(felt)[1].reshape(4, count), 1), np.sort(kept, 1)
    )


@pytest.mark.parametrize("stage", [1, 2])
def test_no_key_is_used_twice(monkeypatch, stage):
    """Masks, tokens and kept patches are drawn apart: a key that is used again ties them
    together.
    """
    drawn = []
    uniform = jax.random.uniform

    def spy(key, *given, **options):
        drawn.append(jax.random.key_data(key))
        return uniform(key, *given, **options)

    monkeypatch.setattr(jax.random, "uniform", spy)
    u8 = lambda *shape: np.zeros((*shape, 28, 28, 3), np.uint8)  # noqa: E731
    if stage == 1:
        batch = TouchBatch(u8(4, 1), SENSOR)
        net = NET1
        params = PARAMS1
        config = CONFIG1
        loss = objectives.stage1_loss
    else:
        align = ALIGN._replace(clip=u8(4, 1), image=u8(len(ALIGN.image)))
        batch = Stage2Batch(align, MatchBatch(u8(4, 1), SENSOR, u8(4, 1), SENSOR, u8(4, 1), SENSOR))
        net = NET2
        params = PARAMS2
        config = changed(CONFIG2, match_keep=0.5)
        loss = objectives.stage2_loss
    keys = jax.jit(
        lambda key: (loss(params, batch, key, jnp.float32(0.5), net=net, config=config), drawn)[1]
    )(KEY)
    assert len(keys) == len({np.asarray(key).tobytes() for key in keys}) == (2 if stage == 1 else 6)


def test_a_batch_without_matching_or_without_alignment_costs_nothing_for_it():
    terms = lambda p, b: objectives.stage2_terms(p, b, None, net=NET2, config=CONFIG2)[0]  # noqa: E731
    both = flops(terms, PARAMS2, Stage2Batch(ALIGN, MATCH))
    headless = {name: value for name, value in PARAMS2.items() if name != "matcher"}
    align = flops(terms, headless, Stage2Batch(ALIGN, None))
    touch = {name: PARAMS2[name] for name in ("touch", "matcher")}
    match = flops(terms, touch, Stage2Batch(None, MATCH))
    assert both == pytest.approx(align + match, rel=0.01) and match > 0.2 * both


def drawn(monkeypatch, config, progress, rows=64):
    """The sensor rows that stage 2 ends up with: (align, anchor, positive, negative), each
    (rows,).
    """
    received = []

    def spy(params, batch, noise, *, net, config, decoder_sensor, match_noise):
        received.extend((decoder_sensor, batch.align.sensor, *batch.match[1::2]))
        return jnp.zeros(()), {}

    monkeypatch.setattr(objectives, "stage2_terms", spy)
    one = np.zeros((rows, 1, 28, 28, 3), np.uint8)
    sensor = np.full(rows, 2, np.int32)
    empty = np.zeros((0, 28, 28, 3), np.uint8), np.zeros(0, np.int32)
    text = np.zeros((0, 8), np.int32), np.zeros((0, 8), bool), np.zeros(0, np.int32)
    batch = Stage2Batch(AlignBatch(one, sensor, *empty, *text), MatchBatch(*(one, sensor) * 3))

    def run(p):
        objectives.stage2_loss({}, batch, KEY, p, net=NET2, config=config)
        return received

    own, *rows = map(np.asarray, jax.jit(run)(np.float32(progress)))
    # the decoder gets the sensor's own tokens
    np.testing.assert_array_equal(own, sensor)
    return rows


def test_the_draw_of_universal_tokens(monkeypatch):
    for rows in drawn(monkeypatch, CONFIG2, 0.0):
        assert (rows == 2).all()
    align, anchor, positive, negative = drawn(monkeypatch, CONFIG2, 1.0)
    for rows in (align, anchor, positive, negative):
        # p_u = 0.75 at the end
        assert set(rows.tolist()) == {2, 9} and 0.55 < (rows == 9).mean() < 0.92
    assert (anchor != positive).any() and (anchor != negative).any() and (align != anchor).any()
    _, anchor, positive, negative = drawn(monkeypatch, tiny_config(2, "release"), 1.0)
    assert (
        (anchor == positive).all() and (anchor == negative).all() and set(anchor.tolist()) == {2, 9}
    )


def test_at_the_start_no_universal_token_is_touched():
    batch = TouchBatch(
        RNG.integers(0, 256, (2, 1, 28, 28, 3), np.uint8), np.asarray([0, 3], np.int32)
    )
    loss = jax.jit(
        jax.grad(lambda *a: objectives.stage1_loss(*a, net=NET1, config=CONFIG1), has_aux=True)
    )
    for progress, used in ((0.0, [0, 3]), (1e6, [9])):
        grad, metrics = loss(PARAMS1, batch, KEY, np.float32(progress))
        rows = np.abs(np.asarray(grad["touch"]["sensor_tokens"])).max(axis=(1, 2))
        assert np.flatnonzero(rows).tolist() == used and metrics["p_u"] == np.float32(
            0.75 * min(progress, 1)
        )


def real_config(stage):
    config = tiny_config(stage)
    return config.with_settings(
        {"optim.learning_rate": (6e-3, 2e-3)[stage - 1], "optim.warmup": 1, "run.steps": 100}
    )


def real_batch(stage):
    rng = np.random.default_rng(7)
    draw = lambda *shape: rng.integers(0, 256, (*shape, 28, 28, 3), np.uint8)  # noqa: E731
    sensor = np.asarray([0, 1, 3, 0, 1, 3, 0, 1], np.int32)
    if stage == 1:
        smooth = np.repeat(np.repeat(rng.integers(0, 256, (8, 4, 2, 2, 3), np.uint8), 14, 2), 14, 3)
        return TouchBatch(smooth, sensor)
    text = rng.integers(1, 40, (4, 8)).astype(np.int32)
    text[:, 6:] = 49
    rows = np.asarray([1, 4, 6, 8], np.int32), np.asarray([1, 2, 4, 7], np.int32)
    align = AlignBatch(draw(8, 1), sensor, draw(4), rows[0], text, text < 100, rows[1])
    return Stage2Batch(
        align, MatchBatch(draw(8, 1), sensor, draw(8, 1), sensor[::-1].copy(), draw(8, 1), sensor)
    )


@cache
def real_step(stage, devices=1):
    """(compiled step, first state, placed batch) on a mesh of so many devices."""
    config = real_config(stage)
    net = build(config.model)
    loss = objectives.stage1_loss if stage == 1 else objectives.stage2_loss
    mesh = make_mesh(devices=jax.devices()[:devices])
    state = jax.device_put(init_state(compiled(config.model).params, config), replicated(mesh))
    plain = make_step(
        partial(loss, net=net, config=config), optimizer(config), total_steps=config.run.steps
    )
    step = jax.jit(plain, out_shardings=replicated(mesh))
    key = jax.device_put(jax.random.key(0), replicated(mesh))
    return step, state, lambda batch: put_batch(batch, batch_sharding(mesh)), key


def steps(stage, devices, count, batch=None):
    step, state, place, key = real_step(stage, devices)
    batch = place(real_batch(stage) if batch is None else batch)
    values = []
    for _ in range(count):
        state, metrics = step(state, batch, key)
        values.append(metrics)
    return state, jax.device_get(values)


@pytest.mark.parametrize("stage", [1, 2])
def test_the_loss_falls_on_a_fixed_batch(stage):
    _, result = steps(stage, 1, 40)
    losses = [row["loss"] for row in result]
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:5]), losses
    assert not any(row["skipped"] for row in result)
    if stage == 2:
        assert result[-1]["match"] < result[0]["match"] and result[-1]["align"] < result[0]["align"]


@pytest.mark.parametrize(
    ("stage", "devices"),
    [
        (1, 2),
        pytest.param(1, 4, marks=pytest.mark.slow),
        pytest.param(2, 2, marks=pytest.mark.slow),
        (2, 4),
    ],
)
def test_devices_fraction_the_batch_and_change_nothing(stage, devices):
    (one, wanted) = steps(stage, 1, 2)
    (many, result) = steps(stage, devices, 2)
    for a, b in zip(result, wanted, strict=True):
        np.testing.assert_allclose(a["loss"], b["loss"], rtol=1e-5)
        np.testing.assert_allclose(a["grad_norm"], b["grad_norm"], rtol=1e-4)
    params = [flatten(merge(state.trainable, state.frozen)) for state in (many, one)]
    for name, value in params[1].items():
        # A key's bias has no gradient but rounding noise, which Adam blows up to a step of the
        # learning rate.
        noise = 2 * real_config(stage).optim.learning_rate if name.endswith("key/bias") else 1e-5
        np.testing.assert_allclose(params[0][name], value, rtol=0, atol=noise, err_msg=name)
    first = flatten(real_step(stage)[1].trainable)["touch/patch/kernel"]
    moved = np.asarray(params[0]["touch/patch/kernel"]) - np.asarray(first)
    assert np.abs(moved).max() > 1e-4


def test_a_sensor_outside_the_table_skips_the_step_and_counts_it():
    batch = real_batch(1)
    wrong = batch._replace(sensor=np.where(np.arange(8) == 5, 10, batch.sensor).astype(np.int32))
    _, start, _, _ = real_step(1)
    state, (row,) = steps(1, 1, 1, wrong)
    assert row["skipped"] == 1 and row["update_norm"] == 0 and not np.isfinite(row["loss"])
    jax.tree.map(
        np.testing.assert_array_equal,
        (state.trainable, state.opt_state),
        (start.trainable, start.opt_state),
    )
    assert int(state.step) == 1
