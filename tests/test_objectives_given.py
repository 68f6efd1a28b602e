from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_models import compiled, tiny_config

from anytouch_jax import objectives
from anytouch_jax.batch import AlignBatch, FieldBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.nn.functional import build

RNG = np.random.default_rng(0)
SENSOR = np.asarray([0, 3, 1, 9, 2, 0, 4, 9], np.int32)
CLIP = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def pixels(*shape):
    return RNG.integers(0, 256, (*shape, 28, 28, 3), np.uint8)


def floats(*shape):
    return RNG.standard_normal((*shape, 28, 28, 3)).astype("f4")


def changed(config, model=None, **objective):
    model = replace(config.model, **(model or {}))
    objective = replace(config.objective, **objective)
    return replace(config, model=model, objective=objective)


@pytest.mark.parametrize("head", ["mlp", "cosine"])
def test_photographs_have_clips_statistics_and_touches_those_of_imagenet(monkeypatch, head):
    received = []

    def spy(params, batch, noise, **options):
        received.append(batch)
        return jnp.zeros(()), {}

    monkeypatch.setattr(objectives, "stage2_terms", spy)
    config = changed(tiny_config(2), {"match_head": head})
    text = np.zeros((0, 8), np.int32), np.zeros((0, 8), bool), np.zeros(0, np.int32)
    align = AlignBatch(pixels(4, 3), SENSOR[:4], pixels(2), np.asarray([0, 2], np.int32), *text)
    match = MatchBatch(pixels(4, 1), SENSOR[:4], pixels(4, 1), SENSOR[:4])
    if head == "mlp":
        match = match._replace(negative=pixels(4, 1), negative_sensor=SENSOR[:4])
    net = build(config.model)
    args = (Stage2Batch(align, match), jax.random.key(0), np.float32(0.5))
    run = lambda *args: (objectives.stage2_loss({}, *args, net=net, config=config), received)[1]  # noqa: E731
    ((shown, reported, _),) = jax.device_get(jax.jit(run)(*args))
    pairs = [(shown.image, align.image, CLIP), (shown.clip, align.clip, IMAGENET)]
    pairs += [(reported[i], match[i], IMAGENET) for i in ((0, 2, 4) if head == "mlp" else (0, 2))]
    for result, given, (mean, std) in pairs:
        assert result.dtype == jnp.float32
        np.testing.assert_allclose(
            result, (given / 255 - np.array(mean)) / np.array(std), atol=1e-5
        )


def test_objectives_take_lists_under_strict_types():
    def lists(x):
        if hasattr(x, "_fields"):
            return type(x)(*map(lists, x))
        if x is None:
            return x
        return np.asarray(x).tolist()

    text = np.ones((1, 8), np.int32), np.ones((1, 8), bool), np.asarray([1], np.int32)
    align = AlignBatch(pixels(2, 3), SENSOR[:2], pixels(2), np.asarray([0, 2], np.int32), *text)
    match = MatchBatch(pixels(2, 1), SENSOR[:2], pixels(2, 1), SENSOR[:2], pixels(2, 1), SENSOR[:2])
    batches = TouchBatch(pixels(2, 4), SENSOR[:2]), Stage2Batch(align, match)
    for stage, batch in enumerate(batches, 1):
        loss = objectives.stage1_loss if stage == 1 else objectives.stage2_loss
        config = tiny_config(stage)
        net = build(config.model)
        for given, progress in ((batch, jnp.float32(0.5)), (lists(batch), 0.5)):
            run = partial(
                loss, batch=given, key=jax.random.key(0), progress=progress, net=net, config=config
            )
            with jax.numpy_dtype_promotion("strict"):
                (value, metrics), _ = jax.eval_shape(
                    jax.value_and_grad(run, has_aux=True), net.abstract()
                )
            assert value.shape == () and value.dtype == jnp.float32 and metrics
            assert objectives.trained_by(given, config=config) == objectives.trained_by(
                batch, config=config
            )


@pytest.mark.parametrize("stage", [1, 2])
def test_an_empty_batch_has_a_loss_of_0(stage):
    shapes = ((), (14, 14), (14, 14, 2), (14, 14), (3,), (), ())
    fields = FieldBatch(pixels(0, 1), SENSOR[:0], *(np.zeros((0, *one), "f4") for one in shapes))
    text = np.zeros((0, 8), np.int32), np.zeros((0, 8), bool), SENSOR[:0]
    align = AlignBatch(pixels(0, 3), SENSOR[:0], pixels(0), SENSOR[:0], *text)
    match = MatchBatch(*(pixels(0, 1), SENSOR[:0]) * 3)
    batch = (
        TouchBatch(pixels(0, 4), SENSOR[:0], fields) if stage == 1 else Stage2Batch(align, match)
    )
    config = tiny_config(stage, **({"fields": 8} if stage == 1 else {}))
    config = replace(config, model=replace(config.model, attention="mapped"))
    net = build(config.model)
    loss = (objectives.stage1_loss, objectives.stage2_loss)[stage - 1]
    run = lambda p: loss(p, batch, jax.random.key(0), 0.5, net=net, config=config)[0]  # noqa: E731
    value, slopes = jax.jit(jax.value_and_grad(run))(net.init(jax.random.key(0)))
    assert float(value) == 0 and all(np.isfinite(one).all() for one in jax.tree.leaves(slopes))


def half(batch, i):
    """Half 0 or 1 of eight rows, and of the six slots of each kind."""
    rows = slice(4 * i, 4 * i + 4)
    slots = slice(3 * i, 3 * i + 3)
    if isinstance(batch, MatchBatch):
        return MatchBatch(*(None if part is None else part[rows] for part in batch))
    touch = batch.clip[rows], batch.sensor[rows]
    image = batch.image[slots], batch.image_row[slots] - 4 * i
    return AlignBatch(
        *touch, *image, batch.text[slots], batch.text_mask[slots], batch.text_row[slots] - 4 * i
    )


@pytest.mark.parametrize("what", ["align", "match"])
def test_groups_are_halves_that_do_not_know_of_each_other(what):
    config = changed(tiny_config(2), {"match_head": "cosine"}, center_embeddings=False)
    net = compiled(config.model).net
    params = compiled(config.model).params
    if what == "align":
        text = RNG.integers(1, 40, (6, 8)).astype(np.int32)
        rows = np.asarray([1, 0, 2, 7, 4, 6]), np.asarray([3, 1, 2, 4, 7, 6])
        batch = AlignBatch(floats(8, 1), SENSOR, floats(6), rows[0], text, text > 0, rows[1])
    else:
        # some twice in a half, some in both
        place = np.asarray([5, 2, 5, 1, 2, 3, 3, 5])
        batch = MatchBatch(floats(8, 1), SENSOR, floats(8, 1), SENSOR, place=place)

    @partial(jax.jit, static_argnums=1)
    def terms(batch, groups):
        batch = Stage2Batch(batch, None) if what == "align" else Stage2Batch(None, batch)
        return objectives.stage2_terms(
            params, batch, None, net=net, config=changed(config, groups=groups)
        )

    total, result = terms(batch, 2)
    halves = [terms(half(batch, i), 1) for i in (0, 1)]
    names = (
        ["align", "touch_to_vision", "text_to_touch", "vision_to_text"]
        if what == "align"
        else ["match"]
    )
    for name in names:
        np.testing.assert_allclose(
            result[name], np.mean([half[name] for _, half in halves]), rtol=1e-5
        )
    np.testing.assert_allclose(total, np.mean([value for value, _ in halves]), rtol=1e-5)
    assert abs(float(terms(batch, 1)[1][what]) / float(result[what]) - 1) > 0.05


@pytest.mark.parametrize("head", ["mlp", "linear"])
def test_the_accuracy_of_matching_is_the_fraction_of_right_verdicts(head):
    config = changed(tiny_config(2), {"match_head": head})
    net = compiled(config.model)
    params = net.params
    # an odd number: never half of them right
    touches = [(floats(5, 1), SENSOR[:5]) for _ in range(3)]
    z = [np.asarray(net.encode_touch(params, *touch)) for touch in touches]
    z = [x / np.linalg.norm(x, axis=1, keepdims=True) for x in z]
    same, other = (np.asarray(net.match(params, z[0], x)) for x in z[1:])
    match = MatchBatch(*(array for touch in touches for array in touch))
    terms = jax.jit(partial(objectives.stage2_terms, noise=None, net=net.net, config=config))
    _, metrics = terms(params, Stage2Batch(None, match))
    right = np.count_nonzero(same > 0) + np.count_nonzero(other < 0)
    np.testing.assert_allclose(metrics["match_accuracy"], right / 10, rtol=1e-6)


@pytest.mark.parametrize("frames", [1, 4], ids=["still", "clip"])
@pytest.mark.parametrize("ratio", [0.0, 1.0])
def test_all_shown_or_all_hidden_is_finite_even_of_one_row(ratio, frames):
    config = changed(tiny_config(1), mask_ratio=ratio)
    net = compiled(config.model)
    terms = jax.jit(
        jax.value_and_grad(
            partial(objectives.stage1_terms, net=net.net, config=config), has_aux=True
        )
    )
    noise = RNG.random((1, 16)).astype("f4")
    (loss, metrics), grads = terms(net.params, floats(1, frames), SENSOR[:1], noise)
    assert np.isfinite(loss) and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))
    assert (float(metrics["reconstruction"]) == 0) == (ratio == 0)
    assert (float(loss) > 0) == (ratio == 1 or frames == 4)
