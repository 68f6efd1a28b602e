from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny_models import compiled, full_model

from anytouch_jax.nn.clip import merge_lora

NET = compiled(full_model())
PARAMS = NET.params
IDS = np.asarray([[48, 5, 6, 49, 49, 49, 49, 49], [48, 7, 8, 9, 10, 11, 49, 49]], np.int32)
RNG = np.random.default_rng(0)


def changed(ids, place, value):
    ids = ids.copy()
    ids[place] = value
    return ids


@jax.jit
def read(ids):
    """Hidden states and the pooled one."""
    text = NET.bind(PARAMS).text
    return text.hidden(ids), text.pooled(ids)


def test_text_is_causal():
    def state(embedded):
        params = PARAMS | {"text": PARAMS["text"] | {"position": embedded}}
        hidden = NET.bind(params).text.hidden(IDS)[0, 3]
        # the plain sum of what a norm gives is always 0
        return hidden @ np.arange(1.0, len(hidden) + 1)

    grad = np.asarray(jax.jit(jax.grad(state))(PARAMS["text"]["position"]))
    assert not grad[4:].any() and (np.abs(grad[:4]).max(axis=1) > 0).all()


def test_padding_behind_the_end_token_changes_nothing():
    mask = np.asarray([[1, 1, 1, 1, 0, 0, 0, 0], [1] * 8], bool)
    other = changed(IDS, (0, slice(4, None)), 3)
    a = NET.encode_text(PARAMS, IDS, mask)
    b = NET.encode_text(PARAMS, other, mask)
    np.testing.assert_allclose(a, b, atol=1e-6)
    np.testing.assert_allclose(a, NET.encode_text(PARAMS, IDS), atol=1e-6)


@pytest.mark.parametrize("outside", [50, -1])
def test_a_token_outside_the_vocabulary_is_nan(outside):
    hidden = np.asarray(read(changed(IDS, (1, 2), outside))[0])
    assert np.isfinite(hidden[0]).all() and np.isnan(hidden[1, 2:]).all()


def test_the_pooled_token_is_the_largest_id_or_the_end_token_named():
    hidden, pooled = map(np.asarray, read(IDS))
    np.testing.assert_allclose(pooled, hidden[[0, 1], [3, 6]], rtol=1e-5, atol=1e-6)
    named = compiled(replace(NET.net.model, text=replace(NET.net.model.text, end_token=8)))
    pooled = jax.jit(lambda ids: named.bind(PARAMS).text.pooled(ids))(
        ids := changed(IDS, (0, 1), 8)
    )
    np.testing.assert_allclose(pooled[0], read(ids)[0][0, 1], rtol=1e-5, atol=1e-6)


def test_lora_starts_as_no_change_and_is_added_to_the_kernels():
    net = compiled(full_model(lora_rank=2, lora_alpha=6.0))
    params = jax.device_get(net.params)
    image = RNG.standard_normal((2, 28, 28, 3)).astype("f4")
    plain = {name: value for name, value in params.items() if name != "lora"}
    before = np.asarray(NET.encode_image(plain, image))
    np.testing.assert_allclose(net.encode_image(params, image), before, atol=1e-6)

    params["lora"]["value"]["b"] = np.ones_like(params["lora"]["value"]["b"])
    merged = jax.jit(merge_lora, static_argnums=1)(params, 6.0)
    kernel, old = (
        tree["image"]["blocks"]["attention"]["value"]["kernel"] for tree in (merged, params)
    )
    change = 3.0 * params["lora"]["value"]["a"].sum(axis=-1, keepdims=True) * np.ones((1, 1, 16))
    np.testing.assert_allclose(np.asarray(kernel) - old, change, rtol=1e-4, atol=1e-6)
    after = np.asarray(net.encode_image(params, image))
    assert np.abs(after - before).max() > 1e-3
    np.testing.assert_allclose(after, NET.encode_image(merged, image), atol=1e-5)
