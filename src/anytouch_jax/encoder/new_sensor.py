"""A stored model with a row of tokens for a new sensor, and its run folder."""

from __future__ import annotations

import contextlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from anytouch_jax.config import FIELD_SENSORS, UNIVERSAL, Config, check_spelling, to_json
from anytouch_jax.encoder.arrays import Log, Params
from anytouch_jax.encoder.encoder import find_tokenizer
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_folder, atomic_write
from anytouch_jax.shown import shown_short
from anytouch_jax.weights import checkpoint, convert, registry
from anytouch_jax.weights.load import Loaded, load_model, open_family


@shown_short
class Adapted(NamedTuple):
    """A model with a fitted row of tokens, and how well it fits.

    `params` and `metadata` are of the new run. `before` and `after` are mean losses on frames of
    `measured`.
    """

    config: Config
    params: Params
    losses: tuple[float, ...]
    before: float
    after: float
    measured: str
    metadata: dict[str, Any]


def check_empty(out: Path) -> None:
    """Raise UserError if the folder of a new run has files already."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} is not empty; give another --out")


def save(adapted: Adapted, run: str | Path, out: str | Path) -> None:
    """Write a run folder for embed, probe and retrieve, whole or not at all.

    Raises UserError if `out` is not empty.
    """
    check_empty(Path(out))
    text = to_json(adapted.config)
    tokenizer = find_tokenizer(registry.locate(run))
    touch = dict(adapted.params["touch"])
    trainable = {"touch": {"sensor_tokens": touch.pop("sensor_tokens")}}
    with atomic_folder(Path(out)) as folder:
        atomic_write(folder / "config.json", text + "\n")
        if tokenizer is not None:
            shutil.copyfile(tokenizer, folder / tokenizer.name)
        lines = [
            json.dumps({"step": step, "loss": loss}) + "\n"
            for step, loss in enumerate(adapted.losses)
        ]
        atomic_write(folder / "metrics.jsonl", "".join(lines))
        state = {"trainable": trainable, "frozen": adapted.params | {"touch": touch}}
        store = checkpoint.Checkpoints(
            folder / "checkpoints", keep=1, config_json=text, metadata=adapted.metadata
        )
        with contextlib.closing(store):
            store.save(len(adapted.losses), state, {"loss": adapted.after})


def read_model(run: str | Path) -> tuple[Loaded, Params]:
    """Return the model, and its stored parameters.

    Raises UserError for an encoder of another family.
    """
    path = registry.locate(run)
    family, weights = open_family(path)
    if family is not None:
        raise UserError(
            f"{run} is {family.family.title}, which has no tokens to fit; name an encoder of "
            "AnyTouch"
        )
    loaded = load_model(path, stored_rows=True, weights=weights)
    if loaded.from_run:
        # `load_model` puts other tokens into the rows of sensors that training never saw. The new
        # run keeps what was stored.
        return loaded, checkpoint.load_params(path)[0]
    return loaded, loaded.params


def with_row(
    loaded: Loaded, params: Params, sensor: str, run: str, log: Log
) -> tuple[Config, Params, int]:
    """Return the model with a row for `sensor` that equals the universal tokens, and the row.

    Args:
        loaded: the model.
        params: its stored parameters.
        sensor: the name of the new sensor.
        run: the name of the model, for sentences.
        log: takes sentences.

    Raises:
        UserError: the model or the sensor has no tokens, or it was trained on the sensor.
    """
    config = loaded.config
    model = loaded.config.model
    trained = loaded.trained_sensors
    check_spelling(sensor, model.sensors)
    if sensor in FIELD_SENSORS or sensor == UNIVERSAL:
        why = "they serve all sensors" if sensor == UNIVERSAL else "it has no images"
        raise UserError(f"{sensor!r} has no tokens to fit: {why}; name a camera-based sensor")
    if "touch" not in params:
        raise UserError(f"{run} has no touch encoder; give a stage-1 or stage-2 run")
    if not model.sensor_tokens or model.patch_encoder == "sensor":
        raise UserError(
            f"{run} distinguishes sensors without tokens, so none can be fitted; give another run"
        )
    if sensor in (trained or ()):
        raise UserError(f"{run} was trained on {sensor}; name a new sensor")
    if sensor in model.sensors and trained is None:
        log(
            f"{run} does not store its trained sensors: the tokens of {sensor} start from the "
            "universal ones"
        )
    served = convert.serve_unseen(
        params["touch"], model, trained or (), universal_drawn=loaded.universal_drawn
    )
    start = np.asarray(served["sensor_tokens"])[model.universal_row]
    tokens = np.asarray(params["touch"]["sensor_tokens"])
    if sensor not in model.sensors:
        model = replace(model, sensors=(*model.sensors, sensor))
        tokens = np.concatenate([tokens, start[None]])
    row = model.sensors.index(sensor)
    params = params | {"touch": params["touch"] | {"sensor_tokens": tokens}}
    return replace(config, model=model), put_tokens(params, row, start), row


def put_tokens(params: Params, row: int, tokens: Any) -> Params:
    """Return `params` with other tokens (S, D) in one row."""
    table = jnp.asarray(params["touch"]["sensor_tokens"]).at[row].set(tokens)
    return params | {"touch": params["touch"] | {"sensor_tokens": table}}


def metadata_of(
    loaded: Loaded, config: Config, sensor: str, source: dict[str, Any]
) -> dict[str, Any]:
    """Return what the checkpoint of an adapted model says about it.

    Args:
        loaded: the model before.
        config: of the model with the new sensor.
        sensor: the new one.
        source: what it was adapted from and by.
    """
    stored = loaded.metadata if loaded.from_run else {}
    metadata: dict[str, Any] = {
        name: stored[name] for name in ("preprocessing", "data") if name in stored
    }
    metadata["sensors"] = list(config.model.sensors)
    metadata["source"] = source
    if loaded.trained_sensors is not None:
        metadata["seen"] = [*loaded.trained_sensors, sensor]
    return metadata
