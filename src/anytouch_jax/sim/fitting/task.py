"""Training task of tokens: features by your sensor next to those by a known one.

Each touch is felt by your sensor and by a known one. The features of yours are drawn to those that
the frozen encoder has of the known one, among the features of other touches: InfoNCE with the known
sensor as a fixed target. No touch repeats.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax.config import Config
from anytouch_jax.encoder.adapt import Params, put_tokens
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.ops import losses
from anytouch_jax.sim.endless import SimulatedTouches
from anytouch_jax.sim.fitting.touches import COUNT
from anytouch_jax.sim.preparation import prepared

# of Adam, for tokens and for blocks
RATE = 1e-3
DEEP_RATE = 1e-4
FIRST = 2  # blocks that are trained with `deep`
KEPT = 480  # features of earlier touches, which serve as negatives
HEAT = 0.07  # temperature of InfoNCE
HOLD = 10.0  # weight that holds the features of known sensors with `deep`
REUSE = 4  # steps with the same touches in other light
State = dict[str, Any]
Kept = tuple[State, Any, Any]  # what is trained, its moments, and features of earlier touches


def touch_net(config: Config) -> Net:
    """Return the network of a model without its towers: touch alone is encoded."""
    model = replace(config.model, image=None, text=None, match_head="none", lora_rank=0)
    return build(usable(model))


@dataclass(frozen=True, eq=False)
class TokenTask:
    """What is trained, and for what. `rows` are those of the families in a world, yours first."""

    config: Config
    net: Net
    rows: np.ndarray
    deep: bool

    def start(self, params: Params) -> State:
        """Return what is trained, as it is in a model."""
        touch = params["touch"]
        train: State = {"tokens": jnp.asarray(touch["sensor_tokens"][self.rows[0]])}
        if self.deep:
            for name in ("patch", "blocks"):
                train[name] = jax.tree.map(jnp.asarray, touch[name])
        return train

    def merged(self, train: State, frozen: Params) -> Params:
        """Return the parameters of touch with what is trained in its place."""
        trained = {name: part for name, part in train.items() if name != "tokens"}
        touch = frozen["touch"] | trained
        return put_tokens({"touch": touch}, int(self.rows[0]), train["tokens"])

    def encode(self, weights: Params, clip: jax.Array, of: jax.Array) -> jax.Array:
        """Return normalised features of clips u8 by the sensors of rows `of`."""
        return losses.normalise(self.net.encode_touch(weights, normalise_touch(clip), of))

    def loss(
        self,
        train: State,
        frozen: Params,
        key: jax.Array,
        touches: SimulatedTouches,
        queue: jax.Array,
        seen: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        """Return InfoNCE from your sensor to a known one, and the features by the known one.

        `queue` (KEPT, E) are features of earlier touches, of which `seen` (KEPT,) are filled.
        """
        keys = jax.random.split(key)
        other, own = (
            prepared(keys[m], touches.clip[:, m], touches.background[:, m], self.config)
            for m in (0, 1)
        )
        of = jnp.asarray(self.rows)[touches.sensor]
        # The frozen encoder is the teacher, so it is not drawn to the new sensor.
        target = jax.lax.stop_gradient(self.encode(frozen, other, of[:, 0]))
        z = self.encode(self.merged(train, frozen), own, of[:, 1])
        among = jnp.where(seen[None], z @ queue.T, -1.0)  # -1 is the least similar of all
        logits = jnp.concatenate([z @ target.T, among], 1) / HEAT
        # A touch that your sensor felt twice has no target by a known one.
        by_known = touches.sensor[:, 0] > 0
        cost = optax.softmax_cross_entropy_with_integer_labels(logits, jnp.arange(len(z)))
        value = jnp.sum(cost * by_known) / jnp.maximum(by_known.sum(), 1)
        if self.deep:
            held = self.encode(self.merged(train, frozen), other, of[:, 0])
            value = value + HOLD * jnp.mean(1 - jnp.sum(held * target, 1))
        return value, target

    def make_step(self) -> Callable[..., tuple[Kept, jax.Array]]:
        """Return a compiled step of Adam."""
        tx = optax.scale_by_adam()

        @jax.jit
        def step(
            kept: Kept, frozen: Params, key: Any, touches: Any, number: Any, rate: Any
        ) -> tuple[Kept, jax.Array]:
            train, moments, queue = kept
            # Touches are shown REUSE times. Their features enter the queue once, at the first time,
            # and are negatives from the next batch on.
            at = number // REUSE * COUNT
            seen = jnp.arange(KEPT) < jnp.where(number % REUSE == 0, at, at + COUNT)
            (value, target), grad = jax.value_and_grad(self.loss, has_aux=True)(
                train, frozen, key, touches, queue, seen
            )
            updates, moments = tx.update(grad, moments)
            moved = {}
            for name, part in updates.items():
                own_rate = RATE if name == "tokens" else DEEP_RATE
                moved[name] = jax.tree.map(lambda x, r=own_rate: -rate * r * x, part)
            if self.deep:
                moved["blocks"] = jax.tree.map(lambda x: x.at[FIRST:].set(0), moved["blocks"])
            new = jax.lax.dynamic_update_slice(queue, target.astype(queue.dtype), (at % KEPT, 0))
            queue = jnp.where(number % REUSE == 0, new, queue)
            return (optax.apply_updates(train, moved), moments, queue), value

        return step

    def features(
        self, train: State, frozen: Params, touches: SimulatedTouches
    ) -> tuple[jax.Array, jax.Array]:
        """Return features of touches by your sensor and by the other one, in the light as it is."""
        key = jax.random.key(0)
        of = jnp.asarray(self.rows)[touches.sensor]
        # A score must not depend on a draw, so "either" is "subtract" here.
        background = "keep" if self.config.data.background == "keep" else "subtract"
        plain = self.config.with_settings({"data.background": background})
        other, own = (
            prepared(key, touches.clip[:, m], touches.background[:, m], plain, jitter=False)
            for m in (0, 1)
        )
        weights = self.merged(train, frozen)
        return self.encode(weights, own, of[:, 1]), self.encode(weights, other, of[:, 0])
