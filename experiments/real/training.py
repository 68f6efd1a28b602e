"""A small CNN that is trained with labels from scratch, as a head of `scores.HEADS` whose option is
the epochs.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from anytouch_jax.data.transforms import subtract_background
from anytouch_jax.encoder.embed import run_in_batches
from experiments.real.recordings import Recordings

Array = np.ndarray
# pixels; passes over the frames; frames
SIDE = 64
EPOCHS = (4, 8, 16)
BATCH = 32
RATE = 1e-3
SHIFT = 0.06  # of a side


class SmallCnn(nnx.Module):
    """Four convolutions of stride 2, each with a layer norm, their mean over the image, and a
    linear head.
    """

    def __init__(
        self, classes: int, seed: int = 0, channels: Sequence[int] = (32, 64, 128, 128)
    ) -> None:
        rngs = nnx.Rngs(seed)
        before = 6
        convolutions = []
        norms = []
        for after in channels:
            convolutions.append(nnx.Conv(before, after, (3, 3), strides=2, rngs=rngs))
            norms.append(nnx.LayerNorm(after, rngs=rngs))
            before = after
        self.convolutions = nnx.List(convolutions)
        self.norms = nnx.List(norms)
        self.head = nnx.Linear(before, classes, rngs=rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return logits (B, classes) of images (B, SIDE, SIDE, 6)."""
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            x = nnx.gelu(norm(convolution(x)))
        return self.head(x.mean((1, 2)))


def cnn_images(data: Recordings) -> Array:
    """Return frames and their differences from the untouched gel, u8 (n, SIDE, SIDE, 6)."""
    both = (
        np.concatenate([frame, subtract_background([frame], gel)[0]], -1)
        for frame, gel in data.pairs()
    )
    return np.stack([cv2.resize(pair, (SIDE, SIDE), interpolation=cv2.INTER_AREA) for pair in both])


def cnn_scores(
    x: Array, y: Array, classes: int, fit: Array, weights: Array
) -> list[tuple[float, Array]]:
    """Train a `SmallCnn` on the rows `fit` of `cnn_images`, drawn by `weights`.

    Return (epochs, probabilities (n, classes)) after each number of EPOCHS.
    """
    graph, params = nnx.split(SmallCnn(classes))
    steps = max(1, len(fit) // BATCH)
    schedule = optax.warmup_cosine_decay_schedule(0.0, RATE, steps, steps * EPOCHS[-1], 0.1 * RATE)
    optimiser = optax.adamw(schedule, weight_decay=0.05)

    def logits(params: Any, images: jax.Array) -> jax.Array:
        return nnx.merge(graph, params)((images.astype(jnp.float32) - 128) / 64)

    @jax.jit
    def step(params: Any, state: Any, images: jax.Array, labels: jax.Array) -> tuple[Any, Any]:
        def loss(params: Any) -> jax.Array:
            return optax.softmax_cross_entropy_with_integer_labels(
                logits(params, images), labels
            ).mean()

        updates, state = optimiser.update(jax.grad(loss)(params), state, params)
        return optax.apply_updates(params, updates), state

    predict = jax.jit(lambda params, images: jax.nn.softmax(logits(params, images)))
    state = optimiser.init(params)
    rng = np.random.default_rng(0)
    results = []
    for epoch in range(1, EPOCHS[-1] + 1):
        for _ in range(steps):
            rows = rng.choice(fit, BATCH, p=weights / weights.sum())
            params, state = step(params, state, _shifted(x[rows], rng), y[rows])
        if epoch in EPOCHS:
            results.append((float(epoch), run_in_batches(partial(predict, params), x, 128)))
    return results


def _shifted(images: Array, rng: np.random.Generator) -> Array:
    """Return images moved by up to SHIFT of their side, with the border repeated."""
    most = round(SHIFT * images.shape[1])
    moves = rng.integers(-most, most + 1, (len(images), 2))
    rows = np.clip(np.arange(images.shape[1])[None] + moves[:, :1], 0, images.shape[1] - 1)
    columns = np.clip(np.arange(images.shape[2])[None] + moves[:, 1:], 0, images.shape[2] - 1)
    return images[np.arange(len(images))[:, None, None], rows[:, :, None], columns[:, None, :]]
