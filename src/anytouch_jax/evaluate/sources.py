"""Sources of features: the encoders and files of a user, and the controls beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from anytouch_jax.config import preset
from anytouch_jax.data.background.rule import ADVICE, Backgrounds
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.encoder import Encoder, check_frames, load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import feature_cache
from anytouch_jax.evaluate.feature_cache import Encoding, FeatureSource
from anytouch_jax.evaluate.statistics import IMAGENET, RANDOM, RAW
from anytouch_jax.evaluate.tasks import TaskRows
from anytouch_jax.weights import registry

_IMAGENET_NAME = "efficientnet_lite0"
Opened = Sequence[Encoder | FeatureSource]


def opened(models: Sequence[str | Path | FeatureSource]) -> list[Encoder | FeatureSource]:
    """Return the encoders of names and paths, and other sources unchanged."""
    return [one if isinstance(one, FeatureSource) else load_encoder(one) for one in models]


def _encoder_of(model: Encoder | FeatureSource) -> Encoder | None:
    if isinstance(model, FeatureSource):
        return model.encoder
    return model


def with_gel(rows: TaskRows, backgrounds: Backgrounds, models: Opened) -> TaskRows:
    """Return the rows that all models can read, for those that need a background.

    All sources are probed on the same rows, or their scores could not be compared in pairs. Raises
    UserError without any.
    """
    encoders = [_encoder_of(model) for model in models]
    if not any(encoder is not None and encoder.needs_background for encoder in encoders):
        return rows
    has = np.all(backgrounds.has(rows.rows.ravel()).reshape(rows.rows.shape), axis=1)
    if not has.any():
        raise UserError(
            f"None of {len(rows.rows)} rows has an image of the untouched gel to subtract. {ADVICE}"
        )
    notes = rows.notes
    if not has.all():
        notes += (f"{(~has).sum()} rows are left out: they have no image of the untouched gel",)
    return rows.take(np.flatnonzero(has))._replace(notes=notes)


def _random_source(table: Manifest, models: Opened, encoding: Encoding) -> FeatureSource:
    """Return the same architecture untrained: what training adds is the difference from it."""
    # The first encoder counts, before those of sources that are at hand.
    in_order = sorted(models, key=lambda model: isinstance(model, FeatureSource))
    encoders = [encoder for encoder in map(_encoder_of, in_order) if encoder is not None]
    encoder = encoders[0].untrained() if encoders else random_encoder(preset("tiny"))
    store = feature_cache.encoder_features(encoder, table, encoding)
    return FeatureSource(RANDOM, store, encoder, is_control=True)


def _pixel_source(table: Manifest, models: Opened, encoding: Encoding) -> FeatureSource:
    """Return raw pixels, which share one scale: unit spread for each would amplify noise."""
    store = feature_cache.pixel_features(
        table, order=encoding.order, folder=encoding.folder, backgrounds=encoding.backgrounds
    )
    return FeatureSource(RAW, store, None, "common", is_control=True)


def _imagenet_source(table: Manifest, models: Opened, encoding: Encoding) -> FeatureSource | None:
    """Return an ImageNet network off the shelf, None where its package is not installed."""
    if not registry.is_installed(_IMAGENET_NAME):
        return None
    encoder = load_encoder(_IMAGENET_NAME)
    # It has one kind of feature, so all poolings share what is stored.
    encoding = replace(encoding, pooling="class")
    store = feature_cache.encoder_features(encoder, table, encoding)
    return FeatureSource(IMAGENET, store, encoder, is_control=True)


# What a user would compare with, by name. A row adds a control to every probe: a function from
# the manifest, the opened models and the encoding to a source with `is_control`, or to None where
# it cannot be had.
CONTROLS: dict[str, Callable[[Manifest, Opened, Encoding], FeatureSource | None]] = {
    RANDOM: _random_source,
    RAW: _pixel_source,
    IMAGENET: _imagenet_source,
}


def gather_sources(
    table: Manifest,
    models: Opened,
    encoding: Encoding,
    rows: dict[int, Array],
    *,
    features: Sequence[str | Path] = (),
    controls: bool = True,
    least: int = 1,
) -> list[FeatureSource]:
    """Return models, controls that are encoders, features files, and other controls.

    Args:
        table: the manifest.
        models: encoders, and sources that are at hand.
        encoding: how features are computed.
        rows: rows to probe by length of clip. A file that lacks some is reported before the work.
        features: .npz files.
        controls: whether those of CONTROLS are added.
        least: frames of every clip, which all models must read.

    Raises:
        UserError: for clips that a model cannot read, and if there is nothing to probe.
    """
    several = [model for model in models if isinstance(model, FeatureSource)]
    # An encoder that is named twice is probed once.
    encoders = {model.source: model for model in models if isinstance(model, Encoder)}
    for name, encoder in encoders.items():
        check_frames(encoder.config.model, least)
        store = feature_cache.encoder_features(encoder, table, encoding)
        several.append(FeatureSource(name, store, encoder))
    others = list[FeatureSource]()
    if controls:
        made = [make(table, models, encoding) for make in CONTROLS.values()]
        others = [one for one in made if one is not None]
    for control in others:
        if control.encoder is not None:
            check_frames(control.encoder.config.model, least)
            several.append(control)
    for path in features:
        several.append(FeatureSource(str(path), feature_cache.file_features(Path(path), table)))
        for frames, ids in rows.items():
            several[-1].store.add(ids, frames)
    several += [one for one in others if one.encoder is None]
    if not several:
        raise UserError(
            "There is nothing to probe. Give --model or --features, or keep the controls."
        )
    return several
