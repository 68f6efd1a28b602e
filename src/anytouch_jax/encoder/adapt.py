"""Adaptation to a new sensor: its own tokens, fitted to a few labelled frames with all else frozen
(Sec. 3.5).
"""

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pyarrow as pa

from anytouch_jax.config import FIELD_SENSORS, UNIVERSAL, Config, check_spelling, to_json
from anytouch_jax.data.background.rule import UnitGels
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Log, unit_rows
from anytouch_jax.encoder.base import precision
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import find_tokenizer, load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_folder, atomic_write
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.ops import losses
from anytouch_jax.shown import shown_short
from anytouch_jax.train.loop import Work
from anytouch_jax.train.tuning import tune_for_steps
from anytouch_jax.weights import checkpoint, convert, registry
from anytouch_jax.weights.load import Loaded, load_model
from anytouch_jax.zoo.families import load_family

Params = dict[str, Any]
Loss = Callable[[Params, jax.Array, jax.Array], jax.Array]  # of (params, clip u8, class i32)
BATCH = 16  # frames of a step
MEASURED = 64  # frames on which the loss is measured before and after
PROTOTYPE_ROWS = 1000  # frames of the known sensors for the prototypes of the classes


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


def adapt(
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
    """Return the model of `run` with tokens for `sensor`, fitted to `frames` of its stills in split
    train.

    `run` is what `load_encoder` takes. The tokens start as the universal ones. The embedding of
    each frame is drawn to the mean embedding of the known sensors' frames of its class in column
    `labels`. Raises UserError.
    """
    if frames < 0 or steps < 1:
        raise UserError(f"frames are 0 or more and steps 1 or more, not {frames} and {steps}")
    if frames and labels is None:
        raise UserError(
            "the tokens are fitted to classes; name a column with --labels, or copy with --frames 0"
        )
    loaded, params = read_model(run)
    stored = loaded.metadata if loaded.from_run else {}
    config, params, row = with_row(loaded, params, sensor, str(run), log)
    source = {
        "run": str(run),
        "sensor": sensor,
        "frames": frames,
        "labels": labels,
        "manifest": manifest.content_hash,
    }
    metadata: dict[str, Any] = {
        name: stored[name] for name in ("preprocessing", "data") if name in stored
    }
    metadata |= {"sensors": list(config.model.sensors), "source": source}
    metadata |= (
        {} if loaded.trained_sensors is None else {"seen": [*loaded.trained_sensors, sensor]}
    )
    if labels is None or not frames:
        return Adapted(config, params, (), float("nan"), float("nan"), "fitted", metadata)
    with precision(config):
        classes, prototypes = _classes(run, manifest, sensor, labels, log)
        if config.data.background == "subtract":
            rows = np.flatnonzero((manifest.text_column("sensor") == sensor) & (classes >= 0))
            classes[np.setdiff1d(rows, rows[UnitGels(manifest).has(rows)])] = -1
        fitted = choose_frames(manifest, sensor, "train", frames, classes, seed)
        in_val = (
            (manifest.text_column("sensor") == sensor)
            & (manifest.text_column("split") == "val")
            & (classes >= 0)
        )
        rows = fitted[:MEASURED]
        measured = "fitted"
        if count := min(int(in_val.sum()), MEASURED):
            rows = choose_frames(manifest, sensor, "val", count, classes, seed)
            measured = "val"
        net = build(
            usable(replace(config.model, image=None, text=None, match_head="none", lora_rank=0))
        )
        touch = {"touch": params["touch"]}

        def loss(params: Params, clip: jax.Array, target: jax.Array) -> jax.Array:
            z = net.encode_touch(params, normalise_touch(clip), jnp.full(clip.shape[0], row))
            logits = losses.normalise(z) @ jnp.asarray(prototypes).T / net.model.temperature
            return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, target))

        measure = partial(jax.jit(loss), clip=_read(manifest, config, rows), target=classes[rows])
        clip = _read(manifest, config, fitted)
        tokens, history = _fit(
            loss,
            touch,
            row,
            Labelled(clip, classes[fitted]),
            config=config,
            steps=steps,
            rate=rate,
            seed=seed,
        )
        before = float(measure(touch))
        after = float(measure(put_tokens(touch, row, tokens)))
        return Adapted(
            config, put_tokens(params, row, tokens), history, before, after, measured, metadata
        )


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
        lines = (
            json.dumps({"step": step, "loss": loss}) + "\n"
            for step, loss in enumerate(adapted.losses)
        )
        atomic_write(folder / "metrics.jsonl", "".join(lines))
        state = {"trainable": trainable, "frozen": adapted.params | {"touch": touch}}
        store = checkpoint.Checkpoints(
            folder / "checkpoints", keep=1, config_json=text, metadata=adapted.metadata
        )
        with contextlib.closing(store):
            store.save(len(adapted.losses), state, {"loss": adapted.after})


def choose_frames(
    manifest: Manifest,
    sensor: str,
    split: str,
    count: int,
    classes: np.ndarray | None = None,
    seed: int = 0,
) -> np.ndarray:
    """Return `count` rows i64 of a sensor in a split, from as many sequences as possible, in order.

    With `classes` i32 (rows of the manifest,) only rows that have a class (not -1). Raises
    UserError for too few rows.
    """
    sensors = manifest.text_column("sensor")
    usable_rows = (sensors == sensor) & (manifest.text_column("split") == split)
    rows = np.flatnonzero(usable_rows if classes is None else usable_rows & (classes >= 0))
    if len(rows) < count:
        raise UserError(
            f"split {split!r} has {len(rows)} usable frames of {sensor}, not {count}; ask for "
            "fewer, or name another "
            f"sensor ({', '.join(sorted(set(sensors)))})"
        )
    rows = np.random.default_rng([seed % 2**63, 77]).permutation(rows)
    sequence = manifest.codes("sequence", own=True)[rows]
    order = np.argsort(sequence, kind="stable")
    # rows of the same sequence before a row
    turn = np.empty(len(rows), np.int64)
    turn[order] = np.arange(len(rows)) - np.searchsorted(sequence[order], sequence[order])
    return np.sort(rows[np.argsort(turn, kind="stable")[:count]])


def read_model(run: str | Path) -> tuple[Loaded, Params]:
    """Return the model, and its stored parameters.

    Raises UserError for an encoder of another family.
    """
    path = registry.locate(run)
    family, weights = load_family(path)
    if family is not None:
        raise UserError(
            f"{run} is {family.family.title}, which has no tokens to fit; name an encoder of "
            "AnyTouch"
        )
    loaded = load_model(path, stored_rows=True, weights=weights)
    return loaded, checkpoint.load_params(path)[0] if loaded.from_run else loaded.params


def with_row(
    loaded: Loaded, params: Params, sensor: str, run: str, log: Log
) -> tuple[Config, Params, int]:
    """Return the model with a row for `sensor` that equals the universal tokens, and the row."""
    config, model, trained = loaded.config, loaded.config.model, loaded.trained_sensors
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


def _classes(
    run: str | Path, manifest: Manifest, sensor: str, labels: str, log: Log
) -> tuple[np.ndarray, np.ndarray]:
    """Return the class i32 of every row, -1 for none, and unit-norm prototypes f32 (classes, E)."""
    column = next(
        (name for name in (f"label.{labels}", labels) if name in manifest.table.column_names), None
    )
    if column is None:
        raise UserError(
            f"the manifest has no column {labels!r} or 'label.{labels}' for --labels; name another"
        )
    if pa.types.is_floating(manifest.table[column].type):
        raise UserError(f"--labels {labels} is a column of measurements; name a column of classes")
    value = manifest.text_column(column)
    sensors = manifest.text_column("sensor")
    encoder = load_encoder(run)
    known = np.isin(sensors, encoder.config.model.sensors) & (sensors != sensor)
    labelled = known & (value != "") & (manifest.text_column("split") == "train")
    rows = np.random.default_rng(0).permutation(np.flatnonzero(labelled))[:PROTOTYPE_ROWS]
    if not rows.size:
        raise UserError(
            f"--labels needs frames of sensors that {run} knows, with a {labels}, in split 'train'"
        )
    rows, values = embed_rows(encoder, manifest, np.sort(rows), log=log)
    names, class_ids = np.unique(value[rows], return_inverse=True)
    if len(names) < 2 or len(names) == len(rows):
        raise UserError(
            f"--labels {labels} must name classes: two values or more, each of several frames"
        )
    unit = unit_rows(values)
    mean = np.stack([unit[class_ids == number].mean(axis=0) for number in range(len(names))])
    place = np.minimum(np.searchsorted(names, value), len(names) - 1)
    classes = np.where(names[place] == value, place, -1).astype(np.int32)
    return classes, unit_rows(mean)


def _read(manifest: Manifest, config: Config, rows: np.ndarray) -> np.ndarray:
    """Return stills u8 (rows, 1, H, W, 3)."""
    config = config.with_settings(
        {"data.batch_size": min(64, len(rows)), "data.on_bad_sample": "error"}
    )
    return np.concatenate(
        [part.clip[: len(ids)] for ids, part in evaluation(manifest, rows, config)]
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
