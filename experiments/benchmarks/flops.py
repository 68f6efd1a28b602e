"""Useful operations of a step, by formula: the matrix products that the paper's sums cannot do without.

A product of (m, k) and (k, n) is 2 m k n operations, and twice as many again in the backward pass, once where its
input needs no gradient (pixels). Norms, softmax, activations, masks and the optimiser are left out: they are not what
a matmul peak measures. So are recomputation (remat), empty slots and hidden patches: a variant that does more work
for the same result is not thereby faster. So is what the last block of touch would do for tokens that nobody reads.
"""

from __future__ import annotations

from anytouch_jax.config import Config, ModelConfig, Stack
from anytouch_jax.ops import masking

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


def encoder(
    model: ModelConfig, batch: int, frames: int, patches: int, *, train: bool = True, read: int | None = None
) -> float:
    """The touch encoder over `patches` positions of `batch` touches, projection apart; 1 frame is a still."""
    kernels = 1 if frames == 1 else model.frames
    blocks = _blocks(model.touch, batch, _special(model) + patches, read)
    first = _patches(model, model.touch.width, batch * patches, kernels)
    return first * (_FIRST if train else 1) + blocks * (_TRAINED if train else 1)


def stage1(config: Config, batch: int, frames: int) -> float:
    """A stage-1 step over `batch` touches of `frames` (1, 3 or 4): forward and backward."""
    model, objective = config.model, config.objective
    frames = frames if objective.next_frame else min(frames, model.frames)
    kept = int(model.patches * objective.keep_ratio)
    seen = batch * (_special(model) + kept)
    decoder = _dense(seen, model.touch.width, model.embed) + _dense(seen, model.embed, model.decoder.width)
    decoder += _blocks(model.decoder, batch, _special(model) + model.patches)
    decoder += _dense(batch * model.patches, model.decoder.width, frames * model.patch**2 * 3)
    return encoder(model, batch, frames, kept) + _TRAINED * decoder


def embedding(model: ModelConfig, batch: int, frames: int, *, train: bool = False) -> float:
    """Touch embeddings of whole frames: forward only, or with the backward pass."""
    last = _dense(batch, model.touch.width, model.embed) * (_TRAINED if train else 1)
    return encoder(model, batch, frames, model.patches, train=train, read=1) + last


def image_tower(model: ModelConfig, images: int) -> float:
    """The image tower over so many images, forward and backward, trained whole."""
    if model.image is None or not images:
        return 0.0
    rest = _blocks(model.image, images, 1 + model.patches) + _dense(images, model.image.width, model.embed)
    return _FIRST * _patches(model, model.image.width, images * model.patches) + _TRAINED * rest


def text_tower(model: ModelConfig, texts: int, length: int) -> float:
    """The text tower over so many texts of `length` tokens, forward and backward, trained whole."""
    if model.text is None or not texts:
        return 0.0
    stack = model.text.stack
    return _TRAINED * (_blocks(stack, texts, length) + _dense(texts, stack.width, model.embed))


def align(config: Config, batch: int, frames: int, images: int, texts: int, length: int) -> float:
    """A stage-2 alignment step with so many images and texts present, reconstruction where the recipe keeps it."""
    model = config.model
    logits = sum(_dense(batch, model.embed, batch) for there in (images, texts, images and texts) if there)
    total = embedding(model, batch, min(frames, model.frames), train=True) + 2 * _TRAINED * logits
    total += image_tower(model, images) + text_tower(model, texts, length)
    return total + (stage1(config, batch, frames) if config.objective.reconstruct else 0.0)


def match(config: Config, batch: int, frames: int) -> float:
    """A stage-2 matching step over `batch` triples: three embeddings each, and the head on two products; or two
    embeddings of the patches that are kept, and their cosines."""
    model = config.model
    if model.match_head == "cosine":
        kept = masking.kept(model.patches, config.objective.match_keep)
        last = _dense(2 * batch, model.touch.width, model.embed) + 2 * _dense(batch, model.embed, batch)
        return encoder(model, 2 * batch, frames, kept, train=True, read=1) + _TRAINED * last
    head = _dense(2 * batch, model.embed, 1)
    if model.match_head == "mlp":
        head += _dense(2 * batch, model.embed, model.embed)
    return embedding(model, 3 * batch, frames, train=True) + _TRAINED * head
