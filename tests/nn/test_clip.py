"""CLIP's towers: causality, padding, the pooled token, LoRA."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_models import full_model

from anytouch_jax.nn.clip import merge_lora
from anytouch_jax.nn.functional import build

NET = build(full_model())
PARAMS = NET.init(jax.random.key(0))
IDS = jnp.asarray([[48, 5, 6, 49, 49, 49, 49, 49], [48, 7, 8, 9, 10, 11, 49, 49]])


def test_text_is_causal():
    def state(embedded):
        params = PARAMS | {"text": PARAMS["text"] | {"position": embedded}}
        hidden = NET.bind(params).text.hidden(IDS)[0, 3]
        return hidden @ jnp.arange(1.0, len(hidden) + 1)  # the plain sum of what a norm gives is always 0

    grad = np.asarray(jax.grad(state)(PARAMS["text"]["position"]))
    assert not grad[4:].any() and (np.abs(grad[:4]).max(axis=1) > 0).all()


def test_padding_behind_the_end_token_changes_nothing():
    mask = jnp.asarray([[1, 1, 1, 1, 0, 0, 0, 0], [1] * 8], bool)
    other = IDS.at[0, 4:].set(3)
    a, b = NET.encode_text(PARAMS, IDS, mask), NET.encode_text(PARAMS, other, mask)
    np.testing.assert_allclose(a, b, atol=1e-6)
    np.testing.assert_allclose(a, NET.encode_text(PARAMS, IDS), atol=1e-6)


@pytest.mark.parametrize("outside", [50, -1])
def test_a_token_outside_the_vocabulary_is_nan(outside):
    hidden = np.asarray(NET.bind(PARAMS).text.hidden(IDS.at[1, 2].set(outside)))
    assert np.isfinite(hidden[0]).all() and np.isnan(hidden[1, 2:]).all()


def test_the_pooled_token_is_the_largest_id_or_the_end_token_named():
    hidden = NET.bind(PARAMS).text.hidden(IDS)
    np.testing.assert_allclose(
        NET.bind(PARAMS).text.pooled(IDS), hidden[jnp.arange(2), jnp.asarray([3, 6])], rtol=1e-5, atol=1e-6
    )
    model = full_model()
    named = build(replace(model, text=replace(model.text, end_token=8)))
    ids = IDS.at[0, 1].set(8)
    np.testing.assert_allclose(
        named.bind(PARAMS).text.pooled(ids)[0], named.bind(PARAMS).text.hidden(ids)[0, 1], rtol=1e-5, atol=1e-6
    )


def test_lora_starts_as_no_change_and_is_added_to_the_kernels():
    model = full_model(lora_rank=2, lora_alpha=6.0)
    net = build(model)
    params = net.init(jax.random.key(0))
    image = jax.random.normal(jax.random.key(1), (2, 28, 28, 3))
    plain = {name: value for name, value in params.items() if name != "lora"}
    before = build(full_model()).encode_image(plain, image)
    np.testing.assert_allclose(net.encode_image(params, image), before, atol=1e-6)

    params["lora"]["value"]["b"] = jnp.ones_like(params["lora"]["value"]["b"])
    merged = merge_lora(params, 6.0)
    a = np.asarray(params["lora"]["value"]["a"])
    change = (
        merged["image"]["blocks"]["attention"]["value"]["kernel"]
        - params["image"]["blocks"]["attention"]["value"]["kernel"]
    )
    np.testing.assert_allclose(change, 3.0 * a.sum(axis=-1, keepdims=True) * np.ones((1, 1, 16)), rtol=1e-4, atol=1e-6)
    after = net.encode_image(params, image)
    assert np.abs(np.asarray(after - before)).max() > 1e-3
    np.testing.assert_allclose(after, build(full_model()).encode_image(merged, image), atol=1e-5)


def test_matching_heads():
    z = jnp.asarray(np.random.default_rng(0).standard_normal((3, 12)), jnp.float32)
    z = z / jnp.linalg.norm(z, axis=1, keepdims=True)
    assert NET.match(PARAMS, z, z[::-1]).shape == (3,)
    np.testing.assert_allclose(NET.match(PARAMS, z, z[::-1]), NET.match(PARAMS, z[::-1], z), rtol=1e-5)
    linear = build(full_model(match_head="linear"))
    params = linear.init(jax.random.key(0))
    expected = (z * z[::-1]) @ params["matcher"]["kernel"][:, 0] + params["matcher"]["bias"]
    np.testing.assert_allclose(linear.match(params, z, z[::-1]), expected, rtol=1e-5)
