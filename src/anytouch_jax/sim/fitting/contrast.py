"""Contrast that fits the tokens of your own sensor: its batches and its loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax.config import Config
from anytouch_jax.encoder.adapt import Params, put_tokens
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.ops import losses
from anytouch_jax.sim.batches import prepared
from anytouch_jax.sim.endless import SimulatedTouches
from anytouch_jax.sim.fitting.touches import COUNT

# Learning rates of tokens and of blocks.
RATE = 1e-3
DEEP_RATE = 1e-4
FIRST = 2  # blocks that are trained with `deep`
KEPT = 480  # features of touches before, that a touch must not be taken for
TEMPERATURE = 0.07  # of the contrast
REUSE = 4  # steps with the same touches in other light
Array = jax.Array
State = dict[str, Any]


class Felt(NamedTuple):
    """A step: touches that a known sensor (`other`) and yours (`own`) felt at once.

    Clips u8 (B, T, H, W, 3), rows i32 (B,) of the token table. `target` (B, E) are the features
    that the frozen encoder has of `other`, `queue` (KEPT, E) those of touches before, of which
    `filled` (KEPT,) are there. `by_known` (B,) is False where the partner is your sensor too.
    """

    own: Array
    own_row: Array
    other: Array
    other_row: Array
    by_known: Array | np.ndarray
    target: Array
    queue: Array | np.ndarray
    filled: Array | np.ndarray


class Contrast:
    """InfoNCE between the features of your sensor and those of a known one."""

    def __init__(self, config: Config, row: int, rows: np.ndarray, deep: bool) -> None:
        model = replace(config.model, image=None, text=None, match_head="none", lora_rank=0)
        self.net = build(usable(model))
        self.config = config
        # Held-out touches are scored as the model is used: with the background subtracted, or not.
        background = "keep" if config.data.background == "keep" else "subtract"
        self.plain = config.with_settings({"data.background": background})
        self.row = row
        self.rows = rows  # of the token table, for each simulated sensor
        self.deep = deep

    def encode(self, params: Params, clip: Any, sensor: Any) -> Array:
        """Return unit-norm features (B, E)."""
        return losses.normalise(self.net.encode_touch(params, normalise_touch(clip), sensor))

    def merged(self, train: State, frozen: Params) -> Params:
        """Return the frozen encoder with what is trained in its place."""
        trained = {name: train[name] for name in ("patch", "blocks") if name in train}
        return put_tokens({"touch": frozen["touch"] | trained}, self.row, train["tokens"])

    def prepare(self, frozen: Params, key: Any, touches: SimulatedTouches) -> Felt:
        """Return a step without a queue, in other light for each key."""
        key_other, key_own = jax.random.split(key)
        clip, background = touches.clip, touches.background
        other = prepared(key_other, clip[:, 0], background[:, 0], self.config)
        own = prepared(key_own, clip[:, 1], background[:, 1], self.config)
        of = jnp.asarray(self.rows)[touches.sensor]
        target = self.encode(frozen, other, of[:, 0])
        by_known = touches.sensor[:, 0] > 0
        nothing = jnp.zeros((0, target.shape[1]))
        return Felt(own, of[:, 1], other, of[:, 0], by_known, target, nothing, jnp.zeros(0, bool))

    def loss(
        self, params: Params, batch: Felt, key: Any, progress: Any
    ) -> tuple[Array, dict[str, Array]]:
        """Return the cross-entropy of finding the same touch by the known sensor."""
        merged = self.merged(params, params["frozen"])
        z = self.encode(merged, batch.own, batch.own_row)
        # A place of the queue that is not filled yet has the lowest cosine.
        among = jnp.where(batch.filled[None], z @ batch.queue.T, -1.0)
        logits = jnp.concatenate([z @ batch.target.T, among], 1) / TEMPERATURE
        cost = optax.softmax_cross_entropy_with_integer_labels(logits, jnp.arange(len(z)))
        value = jnp.sum(cost * batch.by_known) / jnp.maximum(batch.by_known.sum(), 1)
        if self.deep:
            # The first blocks serve the known sensors too, whose features are held.
            held = self.encode(merged, batch.other, batch.other_row)
            value = value + 10.0 * jnp.mean(1 - jnp.sum(held * batch.target, 1))
        return value, {}

    def features(
        self, train: State, frozen: Params, touches: SimulatedTouches
    ) -> tuple[Array, Array]:
        """Return features of held-out touches by your sensor and by the known one."""
        key = jax.random.key(0)
        of = jnp.asarray(self.rows)[touches.sensor]
        merged = self.merged(train, frozen)

        def encoded(take: int) -> Array:
            clip, background = touches.clip[:, take], touches.background[:, take]
            shown = prepared(key, clip, background, self.plain, jitter=False)
            return self.encode(merged, shown, of[:, take])

        return encoded(1), encoded(0)


def rate_of(name: str, shape: tuple[int, ...]) -> Array | float:
    """Return the factor on RATE: 1 for tokens, less for the first blocks, 0 for the others."""
    if name == "tokens":
        return 1.0
    if name.startswith("blocks/"):
        trained = (jnp.arange(shape[0]) < FIRST) * (DEEP_RATE / RATE)
        return jnp.expand_dims(trained, range(1, len(shape)))
    return DEEP_RATE / RATE


def felt_batches(
    start: int,
    stop: int,
    *,
    contrast: Contrast,
    frozen: Params,
    root: Any,
    touches_of: Callable[[int], SimulatedTouches],
) -> Iterator[tuple[int, Felt, dict[str, Any]]]:
    """Yield (step, batch, nothing) for steps start .. stop - 1.

    A batch depends on the seed and the step alone. The touches of REUSE steps are the same in
    other light, and the queue has the features of the KEPT touches before them.

    Args:
        start: first step.
        stop: step after the last.
        contrast: the objective, which knows the network.
        frozen: parameters that do not move.
        root: key of the seed.
        touches_of: gives the touches of a step.
    """
    prepare = jax.jit(contrast.prepare)

    def prepared_step(number: int, touches: SimulatedTouches) -> Felt:
        key = jax.random.fold_in(jax.random.fold_in(root, 1 << 30), number)
        return prepare(frozen, key, touches)

    queue = np.zeros((KEPT, contrast.config.model.embed), np.float32)

    def keep(number: int, batch: Felt) -> None:
        place = number // REUSE * COUNT % KEPT
        queue[place : place + COUNT] = np.asarray(batch.target)

    # A training that continues fills the queue again, from the first steps of the touches in it.
    fresh = start // REUSE
    oldest = max(0, fresh - KEPT // COUNT)
    for group in range(oldest, fresh):
        keep(group * REUSE, prepared_step(group * REUSE, touches_of(group)))
    touches = None
    for number in range(start, stop):
        if touches is None or number % REUSE == 0:
            touches = touches_of(number // REUSE)
        batch = prepared_step(number, touches)
        is_first = number % REUSE == 0
        if start == number and not is_first:
            first = number - number % REUSE
            keep(first, prepared_step(first, touches))
        # The other steps of the same touches have their first features in the queue.
        count = (number // REUSE + (not is_first)) * COUNT
        filled = np.arange(KEPT) < count
        yield number, batch._replace(queue=queue.copy(), filled=filled), {}
        if is_first:
            keep(number, batch)
