"""Timed workloads: training steps and embeddings on made-up batches, and their useful operations.

Imports nothing but jax, flax, optax, numpy and what of ours stands on them: a bare accelerator image can run it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from anytouch_jax import objectives
from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import Config, ModelConfig, Recipe, Stack, preset
from anytouch_jax.nn.functional import build
from anytouch_jax.ops import losses, masking
from anytouch_jax.train.mesh import gathering
from anytouch_jax.train.optim import optimizer
from anytouch_jax.train.step import init_state, make_step

Tree = Any
VISION, TEXT = 0.25, 0.5  # shares of a stage-2 batch that have a photograph, a caption
BATCHES = {"tiny": 16, "small": 16, "base": 8, "large": 4}  # samples a step, where none is asked for
_STEPS = 1000


@dataclass(frozen=True)
class Workload:
    """A thing to time: its name, its configuration, how many samples a call has and how many frames a sample.

    `dense`: every row of a stage-2 batch has a slot for an image and for a text, used or not.
    """

    name: str
    config: Config
    samples: int
    frames: int
    dense: bool = False

    @property
    def trains(self) -> bool:
        """Whether a call is a training step (or an embedding)."""
        return not self.name.startswith("embed")

    @property
    def operations(self) -> float:
        """Useful operations of a call; by the formulas below."""
        config, samples = self.config, self.samples
        if not self.trains:
            return embedding_flops(config.model, samples, self.frames)
        if config.stage == 1:
            return stage1_flops(config, samples, self.frames)
        if self.name.endswith("match"):
            return match_flops(config, samples, self.frames)
        length = config.model.text.length if config.model.text else 0
        return align_flops(config, samples, self.frames, _share(samples, VISION), _share(samples, TEXT), length)

    def resized(self, samples: int) -> Workload:
        """The same with another number of samples."""
        return replace(self, samples=samples)


def _share(samples: int, share: float) -> int:
    return max(1, round(samples * share))


def workloads(what: str, name: str, batch: int | None = None, recipe: Recipe = "release") -> list[Workload]:
    """The workloads of stage1, stage2 (towers from scratch; by `recipe`) or embed for a preset."""
    batch = batch or BATCHES[name]
    one = replace(preset(name), run=replace(preset(name).run, steps=_STEPS))
    if what == "stage1":
        return [Workload("stage1 clips", one, batch, 4), Workload("stage1 stills", one, batch, 1)]
    if what == "stage2":
        two = preset(name, stage=2, recipe=recipe, towers="scratch")
        two = replace(two, run=one.run)
        return [Workload("stage2 align", two, batch, 4), Workload("stage2 match", two, max(2, batch // 2), 3)]
    return [Workload("embed one still", one, 1, 1), Workload("embed one clip", one, 1, 3)] + (
        [Workload("embed clips", one, batch, 3)] if batch > 1 else []
    )


# Batches ------------------------------------------------------------------------------------------------------------


def make_batch(work: Workload, seed: int = 0) -> TouchBatch | Stage2Batch:
    """A made-up uint8 batch of a workload, the same for the same seed: noise, every sensor of the release's table."""
    rng, side = np.random.default_rng(seed), work.config.model.image_size

    def touches(frames: int) -> tuple[np.ndarray, np.ndarray]:
        sensor = np.arange(work.samples, dtype=np.int32) % 5
        return rng.integers(0, 256, (work.samples, frames, side, side, 3), np.uint8), sensor

    if work.config.stage == 1 or not work.trains:
        return TouchBatch(*touches(work.frames))
    if work.name.endswith("match"):
        return Stage2Batch(None, MatchBatch(*touches(work.frames), *touches(work.frames), *touches(work.frames)))
    part = touches(work.frames)
    image_row, text_row = _rows(work, VISION, 0), _rows(work, TEXT, 1)
    image = rng.integers(0, 256, (len(image_row), side, side, 3), np.uint8)
    text, mask = _captions(rng, work.config.model, len(text_row))
    align = AlignBatch(*part, image, image_row, text, mask, text_row)
    return Stage2Batch(_spread(align) if work.dense else align, None)


def _rows(work: Workload, share: float, offset: int) -> np.ndarray:
    """Rows of the batch that have a modality, spread evenly."""
    count = _share(work.samples, share)
    return np.sort((np.arange(count) * work.samples // count + offset) % work.samples).astype(np.int32)


def _spread(align: AlignBatch) -> AlignBatch:
    """The same batch with a slot for every row; what is not there is zeros."""
    rows = len(align.clip)

    def full(values: np.ndarray, row: np.ndarray) -> np.ndarray:
        spread = np.zeros((rows, *values.shape[1:]), values.dtype)
        spread[row] = values
        return spread

    slots = np.arange(rows, dtype=np.int32)
    there = [np.where(np.isin(slots, row), slots, rows).astype(np.int32) for row in (align.image_row, align.text_row)]
    return align._replace(
        image=full(align.image, align.image_row),
        image_row=there[0],
        text=full(align.text, align.text_row),
        text_mask=full(align.text_mask, align.text_row),
        text_row=there[1],
    )


def _captions(rng: np.random.Generator, model: ModelConfig, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Token ids (L, S) of eight to twenty words and the end token, and which may be read."""
    assert model.text is not None
    vocab, length = model.text.vocab, model.text.length
    words = rng.integers(min(8, length // 2), min(20, length - 1) + 1, count)
    ids = rng.integers(1, vocab - 1, (count, length)).astype(np.int32)
    at = np.arange(length)[None]
    ids = np.where(at < words[:, None], ids, vocab - 1).astype(np.int32)
    return ids, at <= words[:, None]


# Programs -----------------------------------------------------------------------------------------------------------


def first_state(config: Config) -> Tree:
    """The state before the first step, on the device."""
    return jax.jit(partial(init_state, config=config))(build(config.model).init(jax.random.key(0)))


def abstract_state(config: Config) -> Tree:
    """Its shapes; allocates nothing."""
    return jax.eval_shape(partial(init_state, config=config), build(config.model).abstract())


def step_of(config: Config, mesh: Mesh | None = None) -> Callable[..., Any]:
    """The training step of a configuration, as `train.loop.fit` builds it: (state, batch, key) -> (state, metrics)."""
    loss = objectives.stage1_loss if config.stage == 1 else objectives.stage2_loss
    loss_fn: Callable[..., Any] = partial(loss, net=build(config.model), config=config)
    loss_fn = loss_fn if mesh is None else gathering(loss_fn, mesh)
    trained = partial(objectives.trained_by, config=config)
    return make_step(loss_fn, optimizer(config), total_steps=config.run.steps, trained=trained)


def embed_of(config: Config) -> Callable[..., jax.Array]:
    """(params, clip u8, sensor) -> features (B, E) float32, as `evaluate.features` computes them."""
    net = build(config.model)

    def embed(params: Tree, clip: jax.Array, sensor: jax.Array) -> jax.Array:
        return net.encode_touch(params, objectives.normalise_touch(clip), sensor).astype(jnp.float32)

    return embed


def values_of(config: Config, trains: bool = True) -> Callable[..., dict[str, Any]]:
    """(params, normalised batch, noise) -> {"output", and for a training step "loss" and "gradient"}.

    Nothing is drawn inside, so that the same call in float64 is the reference of all others. The output of stage 1 is
    the painted pixels, of alignment and matching the touch embeddings, of an embedding itself.
    """
    net = build(config.model)

    def values(params: Tree, batch: Any, noise: jax.Array) -> dict[str, Any]:
        if not trains:
            return {"output": net.encode_touch(params, batch.clip, batch.sensor)}
        trained = {name: value for name, value in params.items() if name != "decoder"} | {
            "decoder": {name: value for name, value in params["decoder"].items() if name != "position"}
        }

        def loss(trained: Tree) -> tuple[jax.Array, Any]:
            whole = trained | {"decoder": trained["decoder"] | {"position": params["decoder"]["position"]}}
            return _terms(whole, batch, noise, net, config)

        (value, output), gradient = jax.value_and_grad(loss, has_aux=True)(trained)
        return {"output": output, "loss": value, "gradient": gradient}

    return values


def _terms(params: Tree, batch: Any, noise: jax.Array, net: Any, config: Config) -> tuple[jax.Array, jax.Array]:
    if config.stage == 1:
        pred, _ = objectives.reconstruct(params, batch.clip, batch.sensor, noise, net=net, config=config)
        value, _ = objectives.stage1_terms(params, batch.clip, batch.sensor, noise, net=net, config=config)
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
    align, match = batch
    if align is not None:
        image = np.asarray(objectives.normalise_image(jnp.asarray(align.image)))
        align = align._replace(clip=touch(align.clip), image=image)
    if match is not None:
        match = match._replace(**{name: touch(getattr(match, name)) for name in ("clip", "positive", "negative")})
    return Stage2Batch(align, match)


# Useful operations ----------------------------------------------------------------------------------------------------
#
# These are the matrix products that the paper's sums need. A product of (m, k) and (k, n) is 2 m k n operations, and
# twice as many again in the backward pass, or once for an input without gradient (pixels). Norms, softmax, activations,
# masks and the optimiser are left out, since a matmul peak does not measure them. So are recomputation (remat), empty
# slots and hidden patches: a variant that does more work for the same result is not faster.

_TRAINED, _FIRST = 3, 2  # forward and backward, with or without a gradient of the input


def _dense(rows: int, inputs: int, outputs: int) -> float:
    return 2.0 * rows * inputs * outputs


def _block(stack: Stack, sequences: int, length: int, read: int) -> float:
    """Forward operations of a block over `sequences` of `length` tokens of which `read` are wanted: keys and values of
    all; queries, scores and sums, MLP of these."""
    rows = sequences * read
    attention = 2 * _dense(rows, stack.width, stack.width) + 2 * _dense(rows, length, stack.width)
    keys = 2 * _dense(sequences * length, stack.width, stack.width)
    return keys + attention + 2 * _dense(rows, stack.width, stack.mlp)


def _blocks(stack: Stack, sequences: int, length: int, read: int | None = None) -> float:
    """Forward operations of a stack; of the last block `read` tokens of each sequence are wanted, or all."""
    last = _block(stack, sequences, length, length if read is None else read)
    return (stack.depth - 1) * _block(stack, sequences, length, length) + last


def _special(model: ModelConfig) -> int:
    return 1 + model.sensor_tokens


def _patches(model: ModelConfig, width: int, rows: int, frames: int = 1) -> float:
    return _dense(rows * frames, model.patch**2 * 3, width)


def encoder_flops(
    model: ModelConfig, batch: int, frames: int, patches: int, *, train: bool = True, read: int | None = None
) -> float:
    """The touch encoder over `patches` positions of `batch` touches, projection apart; 1 frame is a still."""
    kernels = 1 if frames == 1 else model.frames
    blocks = _blocks(model.touch, batch, _special(model) + patches, read)
    first = _patches(model, model.touch.width, batch * patches, kernels)
    return first * (_FIRST if train else 1) + blocks * (_TRAINED if train else 1)


def stage1_flops(config: Config, batch: int, frames: int) -> float:
    """A stage-1 step over `batch` touches of `frames` (1, 3 or 4): forward and backward."""
    model, objective = config.model, config.objective
    frames = frames if objective.next_frame else min(frames, model.frames)
    kept = int(model.patches * objective.keep_ratio)
    seen = batch * (_special(model) + kept)
    decoder = _dense(seen, model.touch.width, model.embed) + _dense(seen, model.embed, model.decoder.width)
    decoder += _blocks(model.decoder, batch, _special(model) + model.patches)
    decoder += _dense(batch * model.patches, model.decoder.width, frames * model.patch**2 * 3)
    return encoder_flops(model, batch, frames, kept) + _TRAINED * decoder


def embedding_flops(model: ModelConfig, batch: int, frames: int, *, train: bool = False) -> float:
    """Touch embeddings of whole frames: forward only, or with the backward pass."""
    last = _dense(batch, model.touch.width, model.embed) * (_TRAINED if train else 1)
    return encoder_flops(model, batch, frames, model.patches, train=train, read=1) + last


def image_flops(model: ModelConfig, images: int) -> float:
    """The image tower over so many images, forward and backward, trained whole."""
    if model.image is None or not images:
        return 0.0
    rest = _blocks(model.image, images, 1 + model.patches) + _dense(images, model.image.width, model.embed)
    return _FIRST * _patches(model, model.image.width, images * model.patches) + _TRAINED * rest


def text_flops(model: ModelConfig, texts: int, length: int) -> float:
    """The text tower over so many texts of `length` tokens, forward and backward, trained whole."""
    if model.text is None or not texts:
        return 0.0
    stack = model.text.stack
    return _TRAINED * (_blocks(stack, texts, length) + _dense(texts, stack.width, model.embed))


def align_flops(config: Config, batch: int, frames: int, images: int, texts: int, length: int) -> float:
    """A stage-2 alignment step with so many images and texts present, reconstruction where the recipe keeps it."""
    model = config.model
    logits = sum(_dense(batch, model.embed, batch) for there in (images, texts, images and texts) if there)
    total = embedding_flops(model, batch, min(frames, model.frames), train=True) + 2 * _TRAINED * logits
    total += image_flops(model, images) + text_flops(model, texts, length)
    return total + (stage1_flops(config, batch, frames) if config.reconstructs else 0.0)


def match_flops(config: Config, batch: int, frames: int) -> float:
    """A stage-2 matching step over `batch` triples: three embeddings each, and the head on two products; or two
    embeddings of the patches that are kept, and their cosines."""
    model = config.model
    if model.match_head == "cosine":
        kept = masking.kept(model.patches, config.objective.match_keep)
        last = _dense(2 * batch, model.touch.width, model.embed) + 2 * _dense(batch, model.embed, batch)
        return encoder_flops(model, 2 * batch, frames, kept, train=True, read=1) + _TRAINED * last
    head = _dense(2 * batch, model.embed, 1)
    if model.match_head == "mlp":
        head += _dense(2 * batch, model.embed, model.embed)
    return embedding_flops(model, 3 * batch, frames, train=True) + _TRAINED * head
