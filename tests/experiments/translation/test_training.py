"""Translations: what is trained and what stays, the two references, the units of the error, files."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pair_world import arrays
from tiny_models import tiny_config

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD, Stack, to_json
from anytouch_jax.data.transforms import subtract_background
from anytouch_jax.encoder.encoder import random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import Part
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.weights.safetensors import write_safetensors
from anytouch_jax.weights.tree import flatten
from experiments.translation import training
from experiments.translation.generator import (
    GENERATOR,
    Design,
    Fit,
    Generator,
    features,
    judged,
    load,
    nameless,
    predict,
    save,
)
from experiments.translation.networks import STATES, Conv, Translation, UNet, doubled, halved, thumbnail_side

pytestmark = pytest.mark.slow

X, Y, FIELDS = arrays(24)
ENCODER = random_encoder(tiny_config())
MODEL = ENCODER.config.model
IMAGE = Translation(MODEL, decoder=Stack(16, 1, 2, 32), hidden=16, channels=(4, 8, 8))
FIELD = replace(IMAGE, field=(20, 20, 6))
SENSORS = {"source": "gelsight_mini", "target": "duragel"}


def design(shape=IMAGE, encoder="somewhere", **options) -> Design:
    return Design("gelsight_mini", "duragel", shape, encoder, Fit(**({"steps": 40, "batch": 8} | options)))


@pytest.fixture(scope="module")
def made() -> Generator:
    return training.fit(ENCODER, X, Y, **SENSORS, options=Fit(steps=2, batch=8), shape=IMAGE)[0]


@pytest.fixture(scope="module")
def regressed() -> Generator:
    options = Fit(steps=2, batch=8)
    return training.fit(ENCODER, X, FIELDS, source="digit", target="tac3d", options=options, shape=FIELD)[0]


# Training -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tune", "adversarial"),
    [("frozen", 0.0), ("frozen", 0.05), ("fine", 0.05)],
    ids=["frozen", "critic", "fine"],
)
def test_the_error_falls_on_a_fixed_batch(tune, adversarial):
    options = Fit(steps=40, batch=8, learning_rate=5e-3, tune=tune, adversarial=adversarial)
    result, losses = training.fit(ENCODER, X[:8], Y[:8], **SENSORS, options=options, shape=IMAGE)
    first, last = losses[0]["error"], losses[-1]["error"]
    assert last < 0.5 * first and all(np.isfinite(list(line.values())).all() for line in losses)
    assert ("critic" in losses[-1]) == (adversarial > 0) and losses[-1]["step"] == 40
    # better than copying the mean of the very images that it was trained on
    assert training.errors(result, X[:8], Y[:8]).mean() < 0.7 * training.mean_errors(result, Y[:8]).mean()


@pytest.mark.parametrize("shape", [IMAGE, FIELD], ids=["unet", "mlp"])
def test_the_references_learn_from_pixels_alone(shape):
    targets = FIELDS if shape.field else Y
    options = Fit(steps=40, batch=8, learning_rate=1e-2)
    result, losses = training.fit(None, X, targets, **SENSORS, options=options, shape=shape)
    assert set(result.params) == {"head", "fixed"} and "critic" not in losses[-1]
    assert training.errors(result, X, targets).mean() < 0.6 * training.mean_errors(result, targets).mean()


def test_frozen_encoders_stay_bit_for_bit(made):
    for name, value in flatten(ENCODER.params).items():
        np.testing.assert_array_equal(flatten(made.params["encoder"])[name], value)


@pytest.mark.slow
def test_tuned_encoders_move_a_tenth_as_fast(made):
    options = Fit(steps=1, batch=8, tune="fine")
    tuned = training.fit(ENCODER, X, Y, **SENSORS, options=options, shape=IMAGE)[0]
    moved = [np.abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (tuned.params, made.params)), strict=True)]
    assert max(moved) > 0
    kernel = lambda params: np.asarray(params["touch"]["blocks"]["mlp"]["up"]["kernel"])  # noqa: E731
    change = np.abs(kernel(tuned.params["encoder"]) - kernel(ENCODER.params))
    assert 0 < change.max() <= 0.1 * 1.05e-3  # Adam's first step is the rate: a tenth of it (and decay) for encoders


def test_the_state_that_does_best_on_other_objects_is_kept():
    """What is right for the training pairs is wrong for these: the first state is the best, and it is the one kept."""
    options = Fit(steps=40, batch=8, learning_rate=1e-2)
    val = X[:8], FIELDS[:8]
    result, losses = training.fit(None, X[:8], -FIELDS[:8], **SENSORS, val=val, options=options, shape=FIELD)
    reported = [line["val"] for line in losses]
    assert reported[-1] > 1.02 * min(reported) and len(reported) == 20
    np.testing.assert_allclose(training.errors(result, *val).mean(), min(reported), rtol=1e-5)
    empty = X[:0], FIELDS[:0]
    assert "val" not in training.fit(None, X, FIELDS, **SENSORS, val=empty, options=options, shape=FIELD)[1][-1]


@pytest.mark.slow
def test_weight_0_is_plain_regression():
    """No critic exists, and the update is that of the squared error alone."""
    one = design(adversarial=0.0)
    params = training.start(one, ENCODER, X, Y)
    state, still = training.begin(one, params)
    assert state.critic == {} and not one.has_critic
    mean, scale = 255 * np.asarray(IMAGENET_MEAN), 255 * np.asarray(IMAGENET_STD)
    y = ((Y[:8] - mean) / scale).astype(np.float32)
    x = np.asarray(features(one, params["encoder"], X[:8]))
    batch, rates = training.Batch(x, y, None), training.rates(one, params["fixed"], 0)
    after, metrics = training._step(nameless(one))(state, still, batch, rates)
    out = predict(one, params, x)
    np.testing.assert_allclose(metrics["error"], np.mean((np.asarray(out) - y) ** 2), rtol=1e-4)
    grad = jax.grad(lambda head: jnp.mean((predict(one, params | {"head": head}, x) - y) ** 2))(params["head"])
    rise = jax.tree.map(lambda g, a, b: jnp.sum(g * (b - a)), grad, state.made["head"], after.made["head"])
    assert sum(map(float, jax.tree.leaves(rise))) < 0


def test_the_critic_pays_for_a_steep_slope_at_real_touches():
    losses = {}
    real = np.random.default_rng(0).standard_normal((8, 2 * MODEL.touch.width)).astype(np.float32)
    for penalty in (0.0, 3.0):
        one = design(penalty=penalty)
        params = training.start(one, ENCODER, X, Y)
        state, still = training.begin(one, params)
        batch = training.Batch(
            np.asarray(features(one, params["encoder"], X[:8])), np.zeros((8, 28, 28, 3), np.float32), real
        )
        rates = training.rates(one, params["fixed"], 0)
        losses[penalty] = float(training._step(nameless(one))(state, still, batch, rates)[1]["critic"])
    slope = jax.grad(lambda x: jnp.sum(one.critic.apply(state.critic["head"], x)))(real)
    expected = 1.5 * np.mean(np.sum(np.square(slope), axis=1))
    np.testing.assert_allclose(losses[3.0] - losses[0.0], expected, rtol=1e-3)


def test_each_network_moves_against_the_other():
    """With the critic's weight alone, a step makes what is painted look more real; the critic's step, less."""
    one = design(adversarial=1e6, learning_rate=1e-4, penalty=0.0)
    params = training.start(one, ENCODER, X, Y)
    state, still = training.begin(one, params)
    x = np.asarray(features(one, params["encoder"], X[:8]))
    y = np.asarray(normalise_touch(Y[:8]))
    received = lambda pixels: judged(one, params["encoder"], pixels, None)  # noqa: E731
    batch, rates = training.Batch(x, y, np.asarray(received(y))), training.rates(one, params["fixed"], 1)
    after, _ = training._step(nameless(one))(state, still, batch, rates)

    def looks(made, critic, real=None):
        out = predict(one, made | still, x) if real is None else real
        return float(one.critic.apply(critic["head"], received(out)).mean())

    assert looks(after.made, state.critic) > looks(state.made, state.critic)
    gap = lambda critic: looks(None, critic, y) - looks(state.made, critic)  # noqa: E731
    assert gap(after.critic) > gap(state.critic)


@pytest.mark.slow
def test_an_encoder_that_knows_touches_less_the_gel_judges_them_so():
    """Its critic reads painted and real images as `subtract_background` would show them."""
    config = ENCODER.config
    less = replace(ENCODER, config=replace(config, data=replace(config.data, background="subtract")))
    gel = np.random.default_rng(1).integers(60, 200, Y.shape[1:], np.uint8)
    touched = np.where(np.arange(len(Y)) % 3 == 0, 1, 0)[:, None, None, None] * np.uint8(90)
    targets = np.clip(gel.astype(int) - touched, 0, 255).astype(np.uint8)  # a third of the pairs touch every place
    result, losses = training.fit(less, X, targets, **SENSORS, options=Fit(steps=2, batch=8), shape=IMAGE)
    assert result.design.has_critic and "critic" in losses[-1]
    bare = result.params["fixed"]["gel"]
    np.testing.assert_allclose(bare, np.asarray(normalise_touch(gel)), atol=1e-5)
    images = np.random.default_rng(2).integers(0, 256, Y.shape, np.uint8)
    shown = np.stack(subtract_background(images, gel))
    assert (shown == 0).any() and (shown == 255).any()  # clipped on both sides
    one, received = result.design, np.asarray(judged(result.design, less.params, normalise_touch(images), bare))
    np.testing.assert_allclose(received, judged(one, less.params, normalise_touch(shown), None), atol=1e-4)
    assert "gel" not in training.fit(ENCODER, X, Y, **SENSORS, options=Fit(steps=1), shape=IMAGE)[0].params["fixed"]


def test_equal_seeds_give_equal_generators_and_others_do_not(made):
    again = training.fit(ENCODER, X, Y, **SENSORS, options=Fit(steps=2, batch=8), shape=IMAGE)[0]
    jax.tree.map(np.testing.assert_array_equal, again.params, made.params)
    other = training.fit(ENCODER, X, Y, **SENSORS, options=Fit(steps=2, batch=8, seed=1), shape=IMAGE)[0]
    assert not np.array_equal(other(X[:1]), made(X[:1]))


@pytest.mark.slow
def test_a_field_that_is_linear_in_the_features_is_found_again():
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (1600, 28, 28, 3), np.uint8)
    shape = replace(FIELD, field=(2, 2, 3), hidden=64, few=8)
    one = design(shape)
    received = np.asarray(features(one, ENCODER.params, images))[:, one.shape.special :, :4].reshape(1600, -1)
    received = (received - received.mean(0)) / received.std(0)
    targets = (received @ rng.standard_normal((received.shape[1], 12)) / 8).reshape(-1, 2, 2, 3).astype(np.float32) + 4
    options = Fit(steps=400, batch=64, learning_rate=1e-2)
    result, _ = training.fit(
        ENCODER, images[:1500], targets[:1500], source="digit", target="tac3d", options=options, shape=shape
    )
    ours = training.errors(result, images[1500:], targets[1500:]).mean()
    assert ours < 0.1 * training.mean_errors(result, targets[1500:]).mean()
    away = result(images[1500:]) - targets[1500:]  # in the field's own units
    assert np.sqrt((away**2).mean()) < 0.25 * targets.std()


def test_the_embedded_patches_and_up_to_four_blocks_of_an_encoder_are_read():
    shapes = [training._design(ENCODER, X, y, "digit", "duragel", Fit(), None).shape for y in (Y, FIELDS)]
    assert [one.states for one in shapes] == [MODEL.touch.depth + 1] * 2 and MODEL.touch.depth + 1 < STATES == 5
    deep = replace(MODEL, touch=replace(MODEL.touch, depth=9))
    many = replace(ENCODER, config=replace(ENCODER.config, model=deep))
    assert training._design(many, X, Y, "digit", "duragel", Fit(), None).shape.states == STATES
    received = np.asarray(features(design(shapes[0]), ENCODER.params, X[:2]))
    assert received.shape == (2, IMAGE.special + MODEL.patches, shapes[0].read)
    last = np.asarray(features(design(), ENCODER.params, X[:2]))
    np.testing.assert_allclose(received[..., -last.shape[-1] :], last, atol=1e-6)


def test_tokens_are_whitened_and_faint_directions_stay_faint():
    rng = np.random.default_rng(0)
    mixed = rng.standard_normal((6, 6)) * np.array([10, 3, 1, 0.3, 0.1, 1e-4])[:, None]
    tokens = (rng.standard_normal((40, 50, 6)) @ mixed + 7).astype(np.float32)
    matrix = training.whitening(tokens)
    white = np.cov((tokens.reshape(-1, 6) - tokens.reshape(-1, 6).mean(0)) @ matrix, rowvar=False)
    values = np.linalg.eigvalsh(white)
    np.testing.assert_allclose(values[-3:], 1, atol=0.1)
    assert values[0] < 0.01 and np.isfinite(matrix).all()
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-4 * np.abs(matrix).max())
    assert np.isfinite(training.whitening(np.zeros((4, 3, 6), np.float32))).all()
    params = training.start(design(), ENCODER, X, Y)  # and a translation is given them so
    received = np.asarray(features(design(), ENCODER.params, X)).reshape(-1, MODEL.touch.width)
    given = (received - params["fixed"]["mean"]) @ params["fixed"]["whiten"]
    assert np.abs(np.linalg.eigvalsh(np.cov(given, rowvar=False))[-3:] - 1).max() < 0.1


def test_a_target_that_never_changes_is_copied():
    same = np.repeat(Y[:1], len(X), axis=0)
    options = Fit(steps=1, batch=8, learning_rate=1e-9)
    result = training.fit(ENCODER, X, same, **SENSORS, options=options, shape=IMAGE)[0]
    assert training.mean_errors(result, same).max() < 1e-9
    assert np.isfinite(training.errors(result, X, same)).all()


@pytest.mark.parametrize("change", [{"steps": 0}, {"batch": 0}, {"adversarial": -1.0}, {"learning_rate": 0.0}])
def test_settings_that_make_no_sense(change):
    with pytest.raises(UserError):
        Fit(**change)


def test_a_rate_that_diverges_is_reported():
    options = Fit(steps=20, batch=8, learning_rate=1e30)
    with pytest.raises(UserError, match="not finite at step"):
        training.fit(ENCODER, X, Y, **SENSORS, options=options, shape=IMAGE)


def test_images_of_another_size_are_refused():
    with pytest.raises(UserError, match="28 x 28"):
        training.fit(ENCODER, X[:, :14, :14], Y, **SENSORS, shape=IMAGE)
    with pytest.raises(UserError, match="needs its shape"):
        training.fit(None, X, Y, **SENSORS)


# References and units -----------------------------------------------------------------------------------------------


def test_copying_the_mean_image_is_what_numpy_says(made):
    mean, scale = 255 * np.asarray(IMAGENET_MEAN), 255 * np.asarray(IMAGENET_STD)
    pixels = (Y.astype(np.float64) - mean) / scale
    np.testing.assert_allclose(made.params["fixed"]["target"], pixels.mean(0), atol=1e-6)
    expected = ((pixels - pixels.mean(0)) ** 2).mean((1, 2, 3))
    np.testing.assert_allclose(training.mean_errors(made, Y), expected, rtol=1e-5)


def test_copying_the_mean_field_is_what_numpy_says(regressed):
    values = FIELDS.astype(np.float64)
    scale = values.reshape(-1, 6).std(0)
    expected = (((values - values.mean(0)) / scale) ** 2).mean((1, 2, 3))
    np.testing.assert_allclose(training.mean_errors(regressed, FIELDS), expected, rtol=1e-4)


def test_the_error_is_that_of_what_comes_out(made, regressed):
    away = (made(X).astype(np.float64) - Y) / (255 * np.asarray(IMAGENET_STD))
    np.testing.assert_allclose(training.errors(made, X, Y), (away**2).mean((1, 2, 3)), rtol=0.05)  # rounded to u8
    away = (regressed(X).astype(np.float64) - FIELDS) / FIELDS.reshape(-1, 6).std(0)
    np.testing.assert_allclose(training.errors(regressed, X, FIELDS), (away**2).mean((1, 2, 3)), rtol=1e-4)


def test_a_batch_gives_what_its_images_give(made):
    many = np.concatenate([X, X, X])  # more than one part, the last one not full
    together = made.normalised(many)
    assert together.shape == (72, 28, 28, 3)
    np.testing.assert_allclose(together[70], made.normalised(many[70:71])[0], atol=1e-4)


def test_each_sensor_has_its_own_tokens():
    one = design()
    own = features(one, ENCODER.params, X[:2])
    other = features(replace(one, source="digit"), ENCODER.params, X[:2])
    unknown = features(replace(one, source="mine"), ENCODER.params, X[:2])
    universal = features(replace(one, source="universal"), ENCODER.params, X[:2])
    assert not np.allclose(own, other) and not np.allclose(own, unknown)
    np.testing.assert_array_equal(unknown, universal)


# Files --------------------------------------------------------------------------------------------------------------


def test_a_saved_generator_comes_back_bit_for_bit(made, regressed, tmp_path):
    for one, images in ((made, X), (regressed, X)):
        folder = tmp_path / one.design.target
        save(one, folder)
        assert [file.name for file in folder.iterdir()] == [GENERATOR]
        back = load(folder)
        assert back.design == one.design
        jax.tree.map(np.testing.assert_array_equal, back.params, jax.tree.map(np.asarray, one.params))
        np.testing.assert_array_equal(back(images), one(images))
        assert load(folder / GENERATOR).design == one.design


def test_what_is_no_generator_is_named(tmp_path):
    with pytest.raises(UserError, match=r"there is no generator in .*--fit"):
        load(tmp_path / "none")
    for name in ("digit-duragel", "gelslim-duragel"):
        (tmp_path / name).mkdir()
        (tmp_path / name / GENERATOR).touch()
    with pytest.raises(UserError, match=r"none \(there are digit-duragel, gelslim-duragel\); train one"):
        load(tmp_path / "none")
    write_safetensors(tmp_path / GENERATOR, {"a": np.zeros(2, np.float32)}, {"config": "{}"})
    with pytest.raises(UserError, match="holds no generator"):
        load(tmp_path)
    before = to_json(design()).replace('"states"', '"depths"')  # of blocks, without the embedded patches
    write_safetensors(tmp_path / GENERATOR, {"a": np.zeros(2, np.float32)}, {"generator": before})
    with pytest.raises(UserError, match="train it again"):
        load(tmp_path)
    (tmp_path / GENERATOR).write_bytes(b"nothing")
    with pytest.raises(UserError, match="not a whole safetensors file"):
        load(tmp_path)


# Networks -----------------------------------------------------------------------------------------------------------


def test_a_convolution_is_a_sum_over_neighbours():
    class Options:
        model = MODEL

    part = Part(lambda options: Conv(2, 3, options.model), Options())
    params = part.init(jax.random.key(0))
    params["bias"] = jnp.asarray([0.5, 0.0, -1.0])
    x = np.random.default_rng(0).standard_normal((1, 4, 5, 2)).astype(np.float32)
    kernel = np.asarray(params["kernel"]).reshape(3, 3, 2, 3)
    padded = np.pad(x[0], ((1, 1), (1, 1), (0, 0)))
    expected = np.zeros((4, 5, 3))
    for i in range(3):
        for j in range(3):
            expected += padded[i : i + 4, j : j + 5] @ kernel[i, j]
    np.testing.assert_allclose(part.apply(params, x)[0], expected + np.array([0.5, 0.0, -1.0]), atol=1e-5)


def test_the_unet_halves_while_the_side_is_even():
    names = set(Part(UNet, IMAGE).init(jax.random.key(0))["convs"])
    assert names == {"down0", "down1", "down2", "middle", "up0", "up1"}  # 28, 14, 7
    odd = replace(IMAGE, model=replace(MODEL, image_size=21))
    part = Part(UNet, odd)
    params = part.init(jax.random.key(0))
    assert set(params["convs"]) == {"down0", "middle"}
    assert part.apply(params, np.zeros((2, 21, 21, 3), np.float32)).shape == (2, 21, 21, 3)


def test_halving_and_doubling():
    x = jnp.arange(32.0).reshape(1, 4, 4, 2)
    np.testing.assert_array_equal(halved(x)[0, 0, 0], [(0 + 2 + 8 + 10) / 4, (1 + 3 + 9 + 11) / 4])
    np.testing.assert_array_equal(halved(doubled(x)), x)
    assert [thumbnail_side(side) for side in (28, 112, 224, 21, 29)] == [28, 28, 28, 21, 1]
