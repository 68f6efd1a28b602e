"""Timed workloads: training steps and embeddings on made-up batches, and their useful operations.

Imports nothing but jax, flax, optax, numpy and what of ours stands on them: a bare accelerator
image can run it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from anytouch_jax import objectives
from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import Config, ModelConfig, Recipe, preset
from anytouch_jax.nn.functional import build
from anytouch_jax.ops import losses
from anytouch_jax.train.mesh import gathering
from anytouch_jax.train.optim import optimizer
from anytouch_jax.train.step import init_state, make_step

Tree = Any
# fractions of a stage-2 batch that have an RGB image, a caption
VISION = 0.25
TEXT = 0.5
# samples a step, where none is asked for
BATCHES = {"tiny": 16, "small": 16, "base": 8, "large": 4}
_STEPS = 1000


@dataclass(frozen=True)
class Workload:
    """A thing to time: its name, its configuration, how many samples a call has and how many frames
    a sample.
    """

    name: str
    config: Config
    samples: int
    frames: int

    @property
    def trains(self) -> bool:
        """Whether a call is a training step (or an embedding)."""
        return not self.name.startswith("embed")

    @cached_property
    def operations(self) -> float:
        """Operations of the matrix products of a call in float32, without recomputation."""
        return _useful(self)

    def resized(self, samples: int) -> Workload:
        """The same with another number of samples."""
        return replace(self, samples=samples)


def _fraction(samples: int, fraction: float) -> int:
    return max(1, round(samples * fraction))


def workloads(
    what: str, name: str, batch: int | None = None, recipe: Recipe = "release"
) -> list[Workload]:
    """The workloads of stage1, stage2 (towers from scratch; by `recipe`) or embed for a preset."""
    batch = batch or BATCHES[name]
    one = replace(preset(name), run=replace(preset(name).run, steps=_STEPS))
    if what == "stage1":
        return [Workload("stage1 clips", one, batch, 4), Workload("stage1 stills", one, batch, 1)]
    if what == "stage2":
        two = preset(name, stage=2, recipe=recipe, towers="scratch")
        two = replace(two, run=one.run)
        return [
            Workload("stage2 align", two, batch, 4),
            Workload("stage2 match", two, max(2, batch // 2), 3),
        ]
    return [Workload("embed one still", one, 1, 1), Workload("embed one clip", one, 1, 3)] + (
        [Workload("embed clips", one, batch, 3)] if batch > 1 else []
    )


# Batches
# --------------------------------------------------------------------------------------------------


def make_batch(work: Workload, seed: int = 0) -> TouchBatch | Stage2Batch:
    """A made-up uint8 batch of a workload, the same for the same seed: noise, every sensor of the
    release's table.
    """
    rng = np.random.default_rng(seed)
    side = work.config.model.image_size

    def touches(frames: int) -> tuple[np.ndarray, np.ndarray]:
        sensor = np.arange(work.samples, dtype=np.int32) % 5
        return rng.integers(0, 256, (work.samples, frames, side, side, 3), np.uint8), sensor

    if work.config.stage == 1 or not work.trains:
        return TouchBatch(*touches(work.frames))
    if work.name.endswith("match"):
        return Stage2Batch(
            None, MatchBatch(*touches(work.frames), *touches(work.frames), *touches(work.frames))
        )
    part = touches(work.frames)
    image_row = _rows(work, VISION, 0)
    text_row = _rows(work, TEXT, 1)
    image = rng.integers(0, 256, (len(image_row), side, side, 3), np.uint8)
    text, mask = _captions(rng, work.config.model, len(text_row))
    align = AlignBatch(*part, image, image_row, text, mask, text_row)
    return Stage2Batch(align, None)


def _rows(work: Workload, fraction: float, offset: int) -> np.ndarray:
    """Rows of the batch that have a modality, spread evenly."""
    count = _fraction(work.samples, fraction)
    return np.sort((np.arange(count) * work.samples // count + offset) % work.samples).astype(
        np.int32
    )


def _captions(
    rng: np.random.Generator, model: ModelConfig, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Token ids (L, S) of eight to twenty words and the end token, and which may be read."""
    assert model.text is not None
    vocab = model.text.vocab
    length = model.text.length
    words = rng.integers(min(8, length // 2), min(20, length - 1) + 1, count)
    ids = rng.integers(1, vocab - 1, (count, length)).astype(np.int32)
    at = np.arange(length)[None]
    ids = np.where(at < words[:, None], ids, vocab - 1).astype(np.int32)
    return ids, at <= words[:, None]


# Programs
# --------------------------------------------------------------------------------------------------


def first_state(config: Config) -> Tree:
    """The state before the first step, on the device."""
    return jax.jit(partial(init_state, config=config))(build(config.model).init(jax.random.key(0)))


def abstract_state(config: Config) -> Tree:
    """Its shapes; allocates nothing."""
    return jax.eval_shape(partial(init_state, config=config), build(config.model).abstract())


def step_of(config: Config, mesh: Mesh | None = None) -> Callable[..., Any]:
    """The training step of a configuration, as `train.loop.fit` builds it: (state, batch, key) ->
    (state, metrics).
    """
    loss = objectives.stage1_loss if config.stage == 1 else objectives.stage2_loss
    loss_fn: Callable[..., Any] = partial(loss, net=build(config.model), config=config)
    loss_fn = loss_fn if mesh is None else gathering(loss_fn, mesh)
    trained = partial(objectives.trained_by, config=config)
    return make_step(loss_fn, optimizer(config), total_steps=config.run.steps, trained=trained)


def embed_of(config: Config) -> Callable[..., jax.Array]:
    """(params, clip u8, sensor) -> features (B, E) float32, as `evaluate.features` computes
    them.
    """
    net = build(config.model)

    def embed(params: Tree, clip: jax.Array, sensor: jax.Array) -> jax.Array:
        return net.encode_touch(params, objectives.normalise_touch(clip), sensor).astype(
            jnp.float32
        )

    return embed


def values_of(config: Config, trains: bool = True) -> Callable[..., dict[str, Any]]:
    """(params, normalised batch, noise) -> {"output", and for a training step "loss" and
    "gradient"}.

    Nothing is drawn inside, so that the same call in float64 is the reference of all others. The
    output of stage 1 is the painted pixels, of alignment and matching the touch embeddings, of an
    embedding itself.
    """
    net = build(config.model)

    def values(params: Tree, batch: Any, noise: jax.Array) -> dict[str, Any]:
        if not trains:
            return {"output": net.encode_touch(params, batch.clip, batch.sensor)}
        trained = {name: value for name, value in params.items() if name != "decoder"} | {
            "decoder": {
                name: value for name, value in params["decoder"].items() if name != "position"
            }
        }

        def loss(trained: Tree) -> tuple[jax.Array, Any]:
            whole = trained | {
                "decoder": trained["decoder"] | {"position": params["decoder"]["position"]}
            }
            return _terms(whole, batch, noise, net, config)

        (value, output), gradient = jax.value_and_grad(loss, has_aux=True)(trained)
        return {"output": output, "loss": value, "gradient": gradient}

    return values


def _terms(
    params: Tree, batch: Any, noise: jax.Array, net: Any, config: Config
) -> tuple[jax.Array, jax.Array]:
    if config.stage == 1:
        pred, _ = objectives.reconstruct(
            params, batch.clip, batch.sensor, noise, net=net, config=config
        )
        value, _ = objectives.stage1_terms(
            params, batch.clip, batch.sensor, noise, net=net, config=config
        )
        return value, pred
    value, _ = objectives.stage2_terms(params, batch, noise, net=net, config=config)
    clip, sensor = (batch.align or batch.match)[:2]
    output = losses.normalise(net.encode_touch(params, clip[:, : net.model.frames], sensor))
    return value, output


def normalised(batch: Any) -> Any:
    """A uint8 batch with its pixels as float32 numpy, normalised."""
    touch = lambda clip: np.asarray(objectives.normalise_touch(jnp.asarray(clip)))  # noqa: E731
    if isinstance(batch, TouchBatch):
        return batch._replace(clip=touch(batch.clip))
    align = batch.align
    match = batch.match
    if align is not None:
        image = np.asarray(objectives.normalise_image(jnp.asarray(align.image)))
        align = align._replace(clip=touch(align.clip), image=image)
    if match is not None:
        match = match._replace(
            **{name: touch(getattr(match, name)) for name in ("clip", "positive", "negative")}
        )
    return batch._replace(align=align, match=match)


# Useful operations
# --------------------------------------------------------------------------------------------------


def products(jaxpr: Any) -> float:
    """Return the operations of the matrix products and convolutions of a jaxpr; a loop's body
    counts for each turn.
    """
    total = 0.0
    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        params = eqn.params
        if name == "dot_general":
            (contracted, _), _ = params["dimension_numbers"]
            total += (
                2
                * eqn.outvars[0].aval.size
                * math.prod(eqn.invars[0].aval.shape[i] for i in contracted)
            )
        elif name == "conv_general_dilated":
            kernel = eqn.invars[1].aval
            total += (
                2
                * eqn.outvars[0].aval.size
                * kernel.size
                / kernel.shape[params["dimension_numbers"].rhs_spec[0]]
            )
        inner = [
            getattr(one, "jaxpr", one)
            for one in jax.tree.leaves(list(params.values()), is_leaf=_is_jaxpr)
        ]
        total += params.get("length", 1) * sum(products(one) for one in inner if _is_jaxpr(one))
    return total


def _is_jaxpr(value: Any) -> bool:
    return hasattr(value, "eqns")


def _useful(work: Workload) -> float:
    model = replace(work.config.model, dtype="float32", attention="xla", remat=False)
    config = replace(work.config, model=model)
    net = build(model)
    params = build(model).abstract()
    batch = normalised(make_batch(work))
    noise = np.zeros((work.samples, model.patches), np.float32)
    if not work.trains:
        run: Callable[..., Any] = lambda p: net.encode_touch(p, batch.clip, batch.sensor)  # noqa: E731
    else:
        one = objectives.stage1_terms
        two = objectives.stage2_terms
        terms: Callable[..., Any] = (
            (lambda p: one(p, batch.clip, batch.sensor, noise, net=net, config=config)[0])
            if config.stage == 1
            else (lambda p: two(p, batch, noise, net=net, config=config)[0])
        )
        run = jax.grad(terms)
    return products(jax.make_jaxpr(run)(params).jaxpr)
