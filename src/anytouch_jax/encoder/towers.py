"""Image and text towers of an encoder: embeddings, similarity and matching."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from anytouch_jax.config import ModelConfig
from anytouch_jax.data.images import to_rgb
from anytouch_jax.data.tokenizer import Tokenizer, load_tokenizer
from anytouch_jax.data.transforms import vision_evaluation
from anytouch_jax.encoder import arrays
from anytouch_jax.encoder.arrays import Params
from anytouch_jax.encoder.features import network, precision
from anytouch_jax.encoder.interface import TouchEncoder
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import Net
from anytouch_jax.objectives import normalise_image
from anytouch_jax.ops import losses

PART_NAMES = {
    "image": "image tower",
    "text": "text tower",
    "matcher": "matching head",
    "logit_scale": "temperature",
}


class Towers(TouchEncoder):
    """What an encoder does with the other parts of its model.

    Attributes:
        whole: the model with its towers, None if the weights have none.
        others: parameters of towers, decoder and heads, by part.
        tokenizer_file: the tokenizer.json of the text tower.
    """

    whole: ModelConfig | None
    others: Params
    tokenizer_file: Path | None

    @cached_property
    def net(self) -> Net:
        """The network of the touch encoder."""
        return network(self.config.model)

    @cached_property
    def _compiled(self) -> dict[Any, Any]:
        """What was called: touch by pooling and join, other parts by their method."""
        return {}

    @cached_property
    def tokenizer(self) -> Tokenizer | None:
        """The tokenizer of the text tower."""
        if self.tokenizer_file is None:
            return None
        return load_tokenizer(self.tokenizer_file)

    def encode_image(self, images: Any, *, batch: int = 64) -> np.ndarray:
        """Return embeddings f32 (B, E) of RGB images (h, w, 3), not unit-norm.

        Raises UserError without an image tower.
        """

        def run(net: Net, params: Params, pixels: jax.Array) -> jax.Array:
            return net.encode_image(params, normalise_image(pixels)).astype(jnp.float32)

        tower = self._part("encode_image", run, "image", "lora")
        size = self.config.model.image_size
        images = [images] if getattr(images, "ndim", 0) == 3 else images
        pixels = (
            vision_evaluation(to_rgb(np.asarray(image), "the image"), size) for image in images
        )
        return self._embeddings(tower, pixels, batch)

    def encode_text(self, texts: str | Sequence[str], *, batch: int = 64) -> np.ndarray:
        """Return embeddings f32 (L, E) of texts, not unit-norm.

        Raises UserError without a text tower or tokenizer.
        """

        def run(net: Net, params: Params, batch: tuple[jax.Array, jax.Array]) -> jax.Array:
            return net.encode_text(params, *batch).astype(jnp.float32)

        tower = self._part("encode_text", run, "text")
        assert self.whole is not None and self.whole.text is not None
        tokenizer = self.tokenizer
        text = self.whole.text
        if tokenizer is None:
            raise UserError(
                f"there is no tokenizer.json in the folder of {self.source}; copy the one of its "
                "training"
            )
        if tokenizer.vocab_size > text.vocab:
            raise UserError(
                f"{self.tokenizer_file} has {tokenizer.vocab_size} tokens, the text tower of "
                f"{self.source} has {text.vocab}; copy the tokenizer of its training"
            )
        texts = [texts] if isinstance(texts, str) else list(texts)
        if not all(isinstance(sentence, str) for sentence in texts):
            raise UserError("texts must be a string or a sequence of strings")
        ids, mask = tokenizer.encode(texts, text.length)
        return self._embeddings(tower, zip(ids, mask, strict=True), batch)

    def _embeddings(self, tower: Callable[[Any], jax.Array], items: Any, batch: int) -> np.ndarray:
        """Return embeddings f32 (n, E) of n items by a tower, in batches."""
        values = arrays.run_in_batches(
            lambda part: tower(jax.tree.map(arrays.filled, part)), items, batch
        )
        if len(values):
            return values
        return np.zeros((0, self.config.model.embed), np.float32)

    def similarity(
        self,
        touch: npt.ArrayLike,
        texts: str | Sequence[str] | np.ndarray,
        *,
        probabilities: bool = False,
    ) -> np.ndarray:
        """Return the cosine similarity f32 (B, L) of touch features and texts.

        Args:
            touch: features (B, E) with pooling class.
            texts: L texts, or their embeddings (L, E).
            probabilities: return their softmax with the learned temperature, a zero-shot
                classifier.

        Raises:
            UserError: there is no text tower, or features have another width.
        """
        if isinstance(texts, np.ndarray) and texts.dtype.kind == "f":
            embeddings = texts
        else:
            embeddings = self.encode_text(texts)  # type: ignore[arg-type]
        z_touch = self._aligned(touch)
        z_text = np.asarray(embeddings, np.float32)
        if z_touch.ndim != 2 or z_text.ndim != 2 or z_touch.shape[1] != z_text.shape[1]:
            width = z_text.shape[-1]
            raise UserError(
                f"touch must be features (B, {width}) with pooling class, not {z_touch.shape}"
            )
        cosine = _unit(z_touch) @ _unit(z_text).T
        if not probabilities:
            return np.asarray(np.clip(cosine, -1, 1))
        scale = self._part("scale", lambda net, params: net.scale(params), "logit_scale")
        return np.asarray(jax.nn.softmax(scale() * cosine, axis=1))

    def match(self, first: npt.ArrayLike, second: npt.ArrayLike) -> np.ndarray:
        """Return matching logits f32 (B,) of two sets of touch features (B, E), pooling class.

        A positive logit predicts the same place (Eq. 5). Raises UserError without a matching head,
        and for other shapes.
        """

        def run(net: Net, params: Params, first: jax.Array, second: jax.Array) -> jax.Array:
            return net.match(params, losses.normalise(first), losses.normalise(second))

        head = self._part("match", run, "matcher")
        one = self._aligned(first)
        other = self._aligned(second)
        if one.shape != other.shape or one.ndim != 2:
            raise UserError(
                f"match takes two sets of features of one shape (B, E), not {one.shape}, "
                f"{other.shape}"
            )
        return np.asarray(head(arrays.filled(one), arrays.filled(other)))[: len(one)]

    def _aligned(self, touch: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Return touch features (B, E) without the values of `nn.sight`, if they have any.

        Towers and matching head were trained with AnyTouch's embedding alone.
        """
        values = np.asarray(touch, np.float32)
        model = self.config.model
        if values.ndim == 2 and values.shape[1] == model.embed + model.sight:
            return values[:, : model.embed]
        return values

    def _part(
        self, method: str, run: Callable[..., jax.Array], name: str, *more: str
    ) -> Callable[..., jax.Array]:
        """Return `run` (net, params, ...) compiled, once for each `method`.

        The parameters `name`, and `more` if the weights have them, go to the device.
        """
        params = {name: self.part_params(name)}
        if method not in self._compiled:
            params |= {key: self.others[key] for key in more if key in self.others}
            net = network(self.whole or self.config.model)
            with precision(self.config):
                self._compiled[method] = partial(jax.jit(partial(run, net)), jax.device_put(params))
        compiled = self._compiled[method]

        def call(*arguments: Any) -> jax.Array:
            with precision(self.config):
                return compiled(*arguments)

        return call

    def part_params(self, name: str) -> Params:
        """Return the parameters of a part: image, text, decoder, matcher or logit_scale.

        Raises UserError.
        """
        if name not in self.others:
            raise UserError(
                f"{self.source} has no {PART_NAMES.get(name, name)}; give a run or file that has "
                "one"
            )
        return dict(self.others)[name]


def _unit(values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return rows divided by their length, or by 1e-12 if that is larger, as `losses.normalise`."""
    wide = np.asarray(values, np.float64)
    length = np.linalg.norm(wide, axis=-1, keepdims=True)
    return np.asarray(wide / np.maximum(length, 1e-12), np.float32)
