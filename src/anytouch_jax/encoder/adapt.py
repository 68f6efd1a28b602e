"""Adaptation to a new sensor: its own tokens, fitted to a few labelled frames (Sec. 3.5).

All other parameters are frozen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from anytouch_jax.config import Config
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder import labelled
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.encoder.arrays import Params as Params
from anytouch_jax.encoder.features import network, precision
from anytouch_jax.encoder.labelled import choose_frames as choose_frames
from anytouch_jax.encoder.new_sensor import Adapted as Adapted
from anytouch_jax.encoder.new_sensor import check_empty as check_empty
from anytouch_jax.encoder.new_sensor import metadata_of
from anytouch_jax.encoder.new_sensor import put_tokens as put_tokens
from anytouch_jax.encoder.new_sensor import read_model as read_model
from anytouch_jax.encoder.new_sensor import save as save
from anytouch_jax.encoder.new_sensor import with_row as with_row
from anytouch_jax.encoder.sensor_words import resolve_sensor
from anytouch_jax.errors import UserError
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.ops import losses
from anytouch_jax.train.loop import Work
from anytouch_jax.train.tuning import tune_for_steps

Loss = Callable[[Params, jax.Array, jax.Array], jax.Array]  # of (params, clip u8, class i32)
BATCH = 16  # frames of a step


@dataclass(frozen=True)
class FitSettings:
    """How tokens are fitted.

    Attributes:
        frames: how many stills of split train they are fitted to. 0 copies the universal tokens.
        labels: the column of classes.
        steps: of Adam.
        rate: the first learning rate.
        seed: of the frames that are chosen and drawn.
    """

    frames: int = 100
    labels: str | None = None
    steps: int = 200
    rate: float = 3e-3
    seed: int = 0


def adapt(  # noqa: PLR0913  the public call; `adapt_with` takes the record
    run: str | Path,
    manifest: Manifest,
    sensor: str,
    *,
    frames: int = 100,
    labels: str | None = None,
    steps: int = 200,
    rate: float = 3e-3,
    seed: int = 0,
    log: Log = print,
) -> Adapted:
    """Return the model of `run` with tokens for `sensor`, see `adapt_with`.

    Args:
        run: what `load_encoder` takes.
        manifest: labelled frames of the sensor, and of known ones.
        sensor: the name of the new sensor.
        frames: see `FitSettings`.
        labels: see `FitSettings`.
        steps: see `FitSettings`.
        rate: see `FitSettings`.
        seed: see `FitSettings`.
        log: takes sentences.
    """
    settings = FitSettings(frames=frames, labels=labels, steps=steps, rate=rate, seed=seed)
    return adapt_with(run, manifest, sensor, settings, log)


def adapt_with(
    run: str | Path, manifest: Manifest, sensor: str, settings: FitSettings, log: Log = print
) -> Adapted:
    """Return the model of `run` with tokens for `sensor`, fitted to stills of it in split train.

    The tokens start as the universal ones. The embedding of each frame is drawn to the mean
    embedding of the known sensors' frames of its class.

    Args:
        run: what `load_encoder` takes.
        manifest: labelled frames of the sensor, and of known ones.
        sensor: the name of the new sensor.
        settings: how its tokens are fitted.
        log: takes sentences.

    Raises:
        UserError: settings or a column that cannot be used, or too few frames.
    """
    if settings.frames < 0 or settings.steps < 1:
        raise UserError(
            f"frames are 0 or more and steps 1 or more, not {settings.frames} and {settings.steps}"
        )
    if settings.frames and settings.labels is None:
        raise UserError(
            "the tokens are fitted to classes; name a column with --labels, or copy with --frames 0"
        )
    sensor = resolve_sensor(sensor).name
    loaded, params = read_model(run)
    config, params, row = with_row(loaded, params, sensor, str(run), log)
    source = {
        "run": str(run),
        "sensor": sensor,
        "frames": settings.frames,
        "labels": settings.labels,
        "manifest": manifest.content_hash,
    }
    metadata = metadata_of(loaded, config, sensor, source)
    if settings.labels is None or not settings.frames:
        nothing = float("nan")
        return Adapted(config, params, (), nothing, nothing, "fitted", metadata)
    with precision(config):
        classes, prototypes = labelled.class_prototypes(run, manifest, sensor, settings.labels, log)
        if config.data.background == "subtract":
            labelled.drop_without_gel(classes, manifest, sensor)
        fitted = choose_frames(manifest, sensor, "train", settings.frames, classes, settings.seed)
        rows, measured = labelled.measured_rows(manifest, sensor, classes, fitted, settings.seed)
        net = network(replace(config.model, image=None, text=None, match_head="none", lora_rank=0))
        touch = {"touch": params["touch"]}

        def loss(params: Params, clip: jax.Array, target: jax.Array) -> jax.Array:
            z = net.encode_touch(params, normalise_touch(clip), jnp.full(clip.shape[0], row))
            logits = losses.normalise(z) @ jnp.asarray(prototypes).T / net.model.temperature
            return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, target))

        read = partial(labelled.read_stills, manifest, config)
        measure = partial(jax.jit(loss), clip=read(rows), target=classes[rows])
        clip = read(fitted)
        tokens, history = _fit(
            loss,
            touch,
            row,
            Labelled(clip, classes[fitted]),
            config=config,
            steps=settings.steps,
            rate=settings.rate,
            seed=settings.seed,
        )
        before = float(measure(touch))
        after = float(measure(put_tokens(touch, row, tokens)))
        return Adapted(
            config, put_tokens(params, row, tokens), history, before, after, measured, metadata
        )


class Labelled(NamedTuple):
    """Frames of a step: clip u8 (B, 1, H, W, 3), class i32 (B,)."""

    clip: np.ndarray
    target: np.ndarray


def _fit(
    loss: Loss,
    params: Params,
    row: int,
    frames: Labelled,
    *,
    config: Config,
    steps: int,
    rate: float,
    seed: int,
) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return the tokens (S, D) of the row after `steps` of Adam, and the loss of each step."""
    root = jax.random.key(seed)

    @jax.jit
    def drawn(number: Any) -> jax.Array:
        key_rows, _ = jax.random.split(jax.random.fold_in(root, number))
        # Drawn with replacement: epochs would need another shape for every number of frames.
        return jax.random.randint(key_rows, (BATCH,), 0, len(frames.clip))

    def batches(start: int, stop: int) -> Iterator[tuple[int, Labelled, dict[str, Any]]]:
        for number in range(start, stop):
            rows = np.asarray(drawn(number))
            yield number, Labelled(frames.clip[rows], frames.target[rows]), {}

    def loss_of(
        params: Params, batch: Labelled, key: jax.Array, progress: jax.Array
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        merged = put_tokens(params["frozen"], row, params["tokens"])
        return loss(merged, jnp.asarray(batch.clip), jnp.asarray(batch.target)), {}

    tokens = params["touch"]["sensor_tokens"][row]
    work = Work(
        {"tokens": tokens, "frozen": params},
        loss_of,
        batches,
        frozen=(("^frozen/", True), ("", False)),
    )
    result = tune_for_steps(config, work, rate=rate, steps=steps)
    return np.asarray(result.state.trainable["tokens"]), result.losses
