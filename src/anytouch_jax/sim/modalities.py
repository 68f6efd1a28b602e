"""RGB images and captions of the objects that are touched in training.

They are made once, before training starts: rendering is for the CPU, and the simulator runs on the
device.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from anytouch_jax.config import Config
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.tokenizer import Tokenizer, load_tokenizer, train_tokenizer
from anytouch_jax.sim import endless, scene
from anytouch_jax.sim.draws import Leaf
from anytouch_jax.sim.sensing.photo import seeded_photograph
from anytouch_jax.sim.world.objects import Object, caption

WORDINGS = 8  # captions of each object
VOCABULARY = 2048


class Texts(NamedTuple):
    """Token ids and masks (n, S) of all captions.

    They are WORDINGS for each simulated object, then those of real rows, then an empty one.
    """

    ids: Leaf
    mask: Leaf


def training_objects(config: Config) -> tuple[Object, ...]:
    """Return the objects that are touched in training: the train split, and variants of it."""
    scenes = scene.training_scenes(config.simulated)
    return endless.objects_of(scenes, "train", variants=config.simulated.variants)


def wordings(things: Sequence[Object], count: int = WORDINGS) -> list[str]:
    """Return `count` captions of each object."""
    return [
        caption(thing, np.random.default_rng([thing.seed, scene.CAPTION, number]))
        for thing in things
        for number in range(count)
    ]


def real_captions(manifest: Manifest | None) -> list[str]:
    """Return the distinct captions of a manifest, in the order of their codes."""
    if manifest is None:
        return []
    encoded = manifest.column("text").combine_chunks().dictionary_encode()
    return [str(text) for text in encoded.dictionary.to_pylist()]


def caption_tokenizer(config: Config, manifest: Manifest | None) -> Tokenizer:
    """Return the tokenizer `data.tokenizer`, or one trained on captions of the objects and of the
    manifest.
    """
    if config.data.tokenizer is not None:
        return load_tokenizer(config.data.tokenizer)
    assert config.model.text is not None
    texts = [*wordings(training_objects(config), 4 * WORDINGS), *real_captions(manifest)]
    return train_tokenizer(texts, min(VOCABULARY, config.model.text.vocab))


def photo_bank(things: Sequence[Object], places: np.ndarray, size: int) -> np.ndarray:
    """Return RGB images of places (objects, places, 2) mm on each object.

    They are u8 (objects, places, size, size, 3).
    """
    jobs = [
        (thing, place, (thing.seed, scene.PHOTO))
        for thing, spots in zip(things, places, strict=True)
        for place in spots
    ]
    images = endless.over_cores(partial(seeded_photograph, size=size), jobs)
    return np.stack(images).reshape(*places.shape[:2], size, size, 3)
