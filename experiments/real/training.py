"""Networks trained with labels: a small CNN from scratch, and an encoder whose weights are trained with its head.

Both give the scores of `scores.HEADS`: an option (here the number of epochs) and the probabilities of all frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from anytouch_jax.data.transforms import subtract_background
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.objectives import normalise_touch
from experiments.real.recordings import Recordings

Array = np.ndarray
Logits = Callable[[Any, jax.Array], jax.Array]
SIDE, EPOCHS, BATCH, SHIFT = 64, (4, 8, 16), 32, 0.06  # pixels; passes over the frames; frames; share of a side


class SmallCnn(nnx.Module):
    """Four convolutions of stride 2, each with a layer norm, their mean over the picture, and a linear head."""

    def __init__(self, classes: int, seed: int = 0, channels: Sequence[int] = (32, 64, 128, 128)) -> None:
        rngs, before = nnx.Rngs(seed), 6
        convolutions, norms = [], []
        for after in channels:
            convolutions.append(nnx.Conv(before, after, (3, 3), strides=2, rngs=rngs))
            norms.append(nnx.LayerNorm(after, rngs=rngs))
            before = after
        self.convolutions, self.norms = nnx.List(convolutions), nnx.List(norms)
        self.head = nnx.Linear(before, classes, rngs=rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return logits (B, classes) of pictures (B, SIDE, SIDE, 6)."""
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            x = nnx.gelu(norm(convolution(x)))
        return self.head(x.mean((1, 2)))


def cnn_pictures(data: Recordings) -> Array:
    """Return frames and their differences from the background, u8 (n, SIDE, SIDE, 6)."""
    pictures = np.empty((len(data.frames), SIDE, SIDE, 6), np.uint8)
    for picture, frame, place in zip(pictures, data.frames, data.background, strict=True):
        change = subtract_background([frame], data.backgrounds[place])[0]
        for at, part in ((0, frame), (3, change)):
            picture[..., at : at + 3] = cv2.resize(part, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    return pictures


def cnn_scores(x: Array, y: Array, classes: int, fit: Array, weights: Array) -> list[tuple[float, Array]]:
    """Train a `SmallCnn` on the rows `fit` of `cnn_pictures` from scratch."""
    graph, params = nnx.split(SmallCnn(classes))

    def logits(params: Any, pictures: jax.Array) -> jax.Array:
        return nnx.merge(graph, params)((pictures.astype(jnp.float32) - 128) / 64)

    return _train(logits, params, 1e-3, x, y, fit, weights)


def fine_tuned_scores(encoder: Encoder, sensor: str = "gelsight_mini") -> Callable[..., list[tuple[float, Array]]]:
    """Return a function like `cnn_scores` that trains the encoder and a linear head on preprocessed touches."""
    net, row = encoder.net, encoder.sensor_row(sensor)

    def scores(x: Array, y: Array, classes: int, fit: Array, weights: Array) -> list[tuple[float, Array]]:
        width = 2 * net.model.embed
        params = {"touch": encoder.params, "scale": jnp.ones(width), "head": jnp.zeros((width, classes))}

        def logits(params: Any, touches: jax.Array) -> jax.Array:
            rows = jnp.full(len(touches), row)
            token, mean = net.encode_poolings(params["touch"], normalise_touch(touches[:, None]), rows)
            z = jnp.concatenate([token, mean], -1)
            z = (z - z.mean(-1, keepdims=True)) / (z.std(-1, keepdims=True) + 1e-6)
            return jnp.asarray((z * params["scale"][None]) @ params["head"])

        return _train(logits, params, 2e-4, x, y, fit, weights)

    return scores


def _train(
    logits: Logits, params: Any, rate: float, x: Array, y: Array, fit: Array, weights: Array
) -> list[tuple[float, Array]]:
    """Return (epochs, probabilities (n, classes)) after each number of EPOCHS. Frames are drawn by `weights`."""
    steps = max(1, len(fit) // BATCH)
    schedule = optax.warmup_cosine_decay_schedule(0.0, rate, steps, steps * EPOCHS[-1], 0.1 * rate)
    optimiser = optax.adamw(schedule, weight_decay=0.05)

    @jax.jit
    def step(params: Any, state: Any, pictures: jax.Array, labels: jax.Array) -> tuple[Any, Any]:
        def loss(params: Any) -> jax.Array:
            return optax.softmax_cross_entropy_with_integer_labels(logits(params, pictures), labels).mean()

        updates, state = optimiser.update(jax.grad(loss)(params), state, params)
        return optax.apply_updates(params, updates), state

    predict = jax.jit(lambda params, pictures: jax.nn.softmax(logits(params, pictures)))
    state, rng, results = optimiser.init(params), np.random.default_rng(0), []
    for epoch in range(1, EPOCHS[-1] + 1):
        for _ in range(steps):
            rows = rng.choice(fit, BATCH, p=weights / weights.sum())
            params, state = step(params, state, _shifted(x[rows], rng), y[rows])
        if epoch in EPOCHS:
            parts = [predict(params, x[np.arange(at, at + 128) % len(x)]) for at in range(0, len(x), 128)]
            results.append((float(epoch), np.concatenate(parts)[: len(x)]))
    return results


def _shifted(pictures: Array, rng: np.random.Generator) -> Array:
    """Return pictures moved by up to SHIFT of their side, with the border repeated."""
    most = round(SHIFT * pictures.shape[1])
    moves = rng.integers(-most, most + 1, (len(pictures), 2))
    rows = np.clip(np.arange(pictures.shape[1])[None] + moves[:, :1], 0, pictures.shape[1] - 1)
    columns = np.clip(np.arange(pictures.shape[2])[None] + moves[:, 1:], 0, pictures.shape[2] - 1)
    return pictures[np.arange(len(pictures))[:, None, None], rows[:, :, None], columns[:, None, :]]
