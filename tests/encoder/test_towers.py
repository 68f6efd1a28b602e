from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from runs import run_config
from weights_world import save_run

from anytouch_jax.batch import AlignBatch
from anytouch_jax.config import to_json
from anytouch_jax.data.tokenizer import train_tokenizer
from anytouch_jax.data.transforms import vision_evaluation
from anytouch_jax.encoder.arrays import unit_rows
from anytouch_jax.encoder.encoder import load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import align_embeddings, normalise_image

RNG = np.random.default_rng(0)
TEXTS = ["a soft sponge", "a hard metal edge", "cloth"]
PHOTOS = RNG.integers(0, 256, (3, 40, 44, 3), np.uint8)
STILLS = RNG.integers(0, 256, (4, 28, 28, 3), np.uint8)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A stage-2 run with fresh weights and a trained tokenizer: its folder, configuration and
    parameters.
    """
    run = tmp_path_factory.mktemp("aligned") / "stage2"
    config = run_config(run / "manifest.csv", 2)
    params = build(config.model).init(jax.random.key(1))
    save_run(run, config, params, seen=["digit"])
    (run / "config.json").write_text(to_json(config))
    train_tokenizer(TEXTS, 400).save(run)
    return SimpleNamespace(run=run, config=config, params=params)


@pytest.fixture(scope="module")
def encoder(stored):
    return load_encoder(stored.run)


def test_towers_equal_those_of_training(encoder, stored):
    ids, mask = encoder.tokenizer.encode(TEXTS, 8)
    images = np.stack([vision_evaluation(photo, 28) for photo in PHOTOS])
    rows = np.arange(3, dtype=np.int32)
    net = build(stored.config.model)

    @jax.jit
    def embeddings(params):
        pixels = normalise_image(images)
        batch = AlignBatch(np.zeros((3, 1, 28, 28, 3), "f4"), rows, pixels, rows, ids, mask, rows)
        return align_embeddings(params, batch, jnp.ones((3, 12)), net=net)

    z = embeddings(stored.params)
    np.testing.assert_allclose(unit_rows(encoder.encode_text(TEXTS)), z.text, atol=1e-5)
    np.testing.assert_allclose(unit_rows(encoder.encode_image(PHOTOS)), z.image, atol=1e-5)


def test_similarity_is_a_cosine_and_a_softmax_at_the_learned_temperature(encoder, stored):
    touch = encoder.encode_touch(STILLS, "digit")
    texts = encoder.encode_text(TEXTS)
    cosine = encoder.similarity(touch, TEXTS)
    assert cosine.shape == (4, 3) and np.abs(cosine).max() <= 1
    wanted = (
        (touch @ texts.T)
        / np.linalg.norm(touch, axis=1)[:, None]
        / np.linalg.norm(texts, axis=1)[None]
    )
    np.testing.assert_allclose(cosine, wanted, atol=1e-5)
    # embeddings serve as well
    np.testing.assert_array_equal(encoder.similarity(touch, texts), cosine)
    np.testing.assert_allclose(np.diag(encoder.similarity(texts, texts)), 1, atol=1e-5)
    chances = encoder.similarity(touch, TEXTS, probabilities=True)
    scaled = cosine * np.exp(np.asarray(stored.params["logit_scale"]))
    np.testing.assert_allclose(chances, scipy.special.softmax(scaled, axis=1), atol=1e-5)
    np.testing.assert_allclose(chances.sum(1), 1, atol=1e-5)
    with pytest.raises(UserError, match="pooling class"):
        encoder.similarity(encoder.encode_touch(STILLS, "digit", pooling="both"), TEXTS)


def test_the_matching_head_of_a_run(encoder, stored):
    first, second = RNG.standard_normal((2, 7, 12)).astype(np.float32)
    net = build(stored.config.model)
    logits = encoder.match(first, second)
    wanted = jax.jit(net.match)(stored.params, unit_rows(first), unit_rows(second))
    np.testing.assert_allclose(logits, wanted, atol=1e-5)
    assert logits.shape == (7,) and np.ptp(logits) > 1e-4


def test_absent_towers_and_wrong_types_are_one_sentence(encoder, stored, tiny_run, tmp_path):
    for other in (load_encoder(tiny_run), random_encoder(stored.config)):
        for part, call in (
            ("text tower", lambda other=other: other.encode_text(TEXTS)),
            ("image tower", lambda other=other: other.encode_image(PHOTOS)),
            (
                "text tower",
                lambda other=other: other.similarity(np.ones((1, 12), np.float32), TEXTS),
            ),
            ("matching head", lambda other=other: other.match(np.ones((1, 12)), np.ones((1, 12)))),
        ):
            with pytest.raises(UserError, match=f"has no {part}") as error:
                call()
            assert "\n" not in str(error.value)
    with pytest.raises(UserError, match="the image"):
        encoder.encode_image([np.zeros((4, 4), np.int32)])
    with pytest.raises(UserError, match="texts"):
        encoder.encode_text([3])
    bare = load_encoder(stored.run)
    object.__setattr__(bare, "tokenizer_file", None)
    with pytest.raises(UserError, match=r"no tokenizer\.json"):
        bare.encode_text(TEXTS)
    train_tokenizer([f"word{i} and {'xyz' * i}" for i in range(900)], 3000).save(tmp_path)
    other = load_encoder(stored.run)
    object.__setattr__(other, "tokenizer_file", tmp_path / "tokenizer.json")
    with pytest.raises(UserError, match="tokens, the text tower"):
        other.encode_text(TEXTS)
