"""A new sensor in minutes: tokens of its own, fitted to a few of its frames with everything else frozen (Sec. 3.5)."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pyarrow as pa

from anytouch_jax import objectives
from anytouch_jax.config import FIELD_SENSORS, UNIVERSAL, Config, from_json, to_json
from anytouch_jax.data.loading.evaluation import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.embed import embed_rows, text_column
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_folder, atomic_write
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.ops import losses
from anytouch_jax.train.metrics import Record
from anytouch_jax.weights import checkpoint, compatible

Params = dict[str, Any]
Log = Callable[[str], None]
Loss = Callable[[Params, jax.Array, jax.Array, jax.Array], jax.Array]  # of (params, clip u8, class i32, key)
BATCH = 16  # frames a step; fewer frames come again under other masks
MEASURED = 64  # frames on which the loss is measured before and after
PROTOTYPE_ROWS = 1000  # frames of the known sensors that make the classes' prototypes


class Adapted(NamedTuple):
    """A model with a fitted row: `params` of the whole run, `losses` (steps,); mean losses `before` and `after` on
    `measured` frames ("val", or "fitted" where the sensor has none in val); metadata `about`."""

    config: Config
    params: Params
    losses: tuple[float, ...]
    before: float
    after: float
    measured: str
    about: dict[str, Any]


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
    """Give `sensor` tokens of its own in the model of `run`, from `frames` of its stills in split train.

    They start as the universal tokens and with 0 frames stay so. Without `labels` they are fitted by masked
    reconstruction (Eq. 1) through the run's decoder. With `labels`, a column, each frame's embedding is drawn to its
    class: the mean embedding of the known sensors' frames of that class in `manifest`. Raises UserError.
    """
    if frames < 0 or steps < 1:
        raise UserError(f"frames are 0 or more and steps 1 or more, not {frames} and {steps}")
    params, text, about = checkpoint.load_params(run)
    config, params, row = _with_row(from_json(text), params, about, sensor, run, log)
    seen = {"seen": [*about["seen"], sensor]} if "seen" in about else {}
    kept: dict[str, Any] = {name: about[name] for name in ("preprocessing", "data") if name in about}
    source = {"run": str(run), "sensor": sensor, "frames": frames, "labels": labels, "manifest": manifest.content_hash}
    about = {**kept, "sensors": list(config.model.sensors), **seen, "source": source}
    if not frames:
        return Adapted(config, params, (), float("nan"), float("nan"), "fitted", about)
    if config.stage == 2 and not (config.objective.reconstruct or labels):
        log(
            "this stage 2 did not train the decoder, through which the tokens are fitted: they may be worse than the "
            "universal ones; take a stage-1 run, or fit with --labels"
        )
    classes, prototypes = _classes(run, manifest, sensor, labels, log)
    fitted = choose(manifest, sensor, "train", frames, classes, seed)
    clip, target = _read(manifest, config, fitted), classes[fitted]
    shown, on = _measured(manifest, sensor, classes, seed, fitted)
    core = replace(config, model=replace(config.model, image=None, text=None, match_head="none", lora_rank=0))
    loss = _loss(build(usable(core.model)), core, row, prototypes)
    small: Params = {name: params[name] for name in ("touch", "decoder", "force") if name in params}
    measure = partial(_mean, loss, clip=_read(manifest, config, shown), target=classes[shown])
    tokens, history = _fit(loss, small, row, clip, target, steps=steps, rate=rate, seed=seed)
    new = _put(params, row, tokens)
    after = measure(_put(small, row, tokens))
    return Adapted(config, new, history, measure(small), after, on, about)


def check_empty(out: Path) -> None:
    """Raise UserError when the folder of a new run holds something already."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} is not empty; give another --out")


def save(adapted: Adapted, run: str | Path, out: str | Path) -> None:
    """Write a run folder that embed, probe and retrieve read. Raises UserError when `out` holds something already, and
    when the disk has no room for it."""
    out = Path(out)
    check_empty(out)
    disk = next(folder for folder in out.absolute().parents if folder.is_dir())
    size, free = sum(leaf.nbytes for leaf in jax.tree.leaves(adapted.params)), shutil.disk_usage(disk).free
    if size > free:
        raise UserError(f"{out} takes {size / 1e6:.1f} MB and {disk} has {free / 1e6:.1f} MB left; free some space")
    with atomic_folder(out) as folder:
        _save(adapted, Path(run), folder)


def _save(adapted: Adapted, run: Path, out: Path) -> None:
    text = to_json(adapted.config)
    atomic_write(out / "config.json", text + "\n")
    tokenizer = run / "tokenizer.json"
    if tokenizer.exists():
        shutil.copyfile(tokenizer, out / "tokenizer.json")
    record = Record(out, 0)
    for step, loss in enumerate(adapted.losses):
        record.write(step, {"loss": loss})
    record.close()
    touch = {name: leaf for name, leaf in adapted.params["touch"].items() if name != "sensor_tokens"}
    state = {
        "trainable": {"touch": {"sensor_tokens": adapted.params["touch"]["sensor_tokens"]}},
        "frozen": adapted.params | {"touch": touch},
    }
    checkpoints = checkpoint.Checkpoints(
        out / "checkpoints", keep=1, config_json=text, metadata=adapted.about
    )  # fmt: skip
    try:
        checkpoints.save(len(adapted.losses), state, {"loss": adapted.after})
    finally:
        checkpoints.close()


def choose(
    manifest: Manifest, sensor: str, split: str, count: int, classes: np.ndarray | None = None, seed: int = 0
) -> np.ndarray:
    """`count` rows i64 of a sensor in a split, drawn from as many sequences as there are, in order.

    `classes` i32 (rows of the manifest,): only rows of a class (not -1). Raises UserError when there are too few.
    """
    here = (text_column(manifest, "sensor") == sensor) & (text_column(manifest, "split") == split)
    if classes is not None:
        here &= classes >= 0
    rows = np.flatnonzero(here)
    if count < 0:
        raise UserError(f"{count} frames cannot be chosen; 0 or more")
    if len(rows) < count:
        known = ", ".join(sorted(set(text_column(manifest, "sensor"))))
        raise UserError(
            f"{count} frames of {sensor} are wanted, but split {split!r} has {len(rows)} that can be used "
            f"(sensors there: {known})"
        )
    rows = np.random.default_rng([seed % 2**63, 77]).permutation(rows)
    sequence = manifest.codes("sequence", own=True)[rows]
    order = np.argsort(sequence, kind="stable")
    first = np.searchsorted(sequence[order], sequence[order])
    turn = np.empty(len(rows), np.int64)
    turn[order] = np.arange(len(rows)) - first  # how many rows of its sequence come before a row
    return np.sort(rows[np.argsort(turn, kind="stable")[:count]])


def _with_row(
    config: Config, params: Params, about: dict[str, Any], sensor: str, run: str | Path, log: Log
) -> tuple[Config, Params, int]:
    """The model with a row for `sensor`, as the universal tokens are."""
    model = config.model
    if sensor in FIELD_SENSORS or sensor == UNIVERSAL:
        raise UserError(f"{sensor!r} has no tokens to fit: {'they serve all' if sensor == UNIVERSAL else 'no images'}")
    if "touch" not in params or "decoder" not in params:
        raise UserError(f"{run} holds no touch encoder and decoder; give a stage-1 or stage-2 run")
    if not model.sensor_tokens or model.patch_encoder == "sensor":
        raise UserError(f"{run} tells sensors apart by other means than tokens; there is nothing to fit")
    if sensor in about.get("seen", ()):
        raise UserError(f"{run} was trained on {sensor}; adapt is for a sensor that it has not seen")
    if sensor in model.sensors and "seen" not in about:
        log(
            f"{run} does not tell on which sensors it was trained: the tokens of {sensor} start from the universal ones"
        )
    drawn = config.objective.universal_start + config.objective.universal_end > 0
    served = compatible.serve_unseen(params["touch"], model, about.get("seen", ()), universal_drawn=drawn)
    start = np.asarray(served["sensor_tokens"])[model.universal_row]
    tokens = np.asarray(params["touch"]["sensor_tokens"])
    if sensor not in model.sensors:
        model = replace(model, sensors=(*model.sensors, sensor))
        tokens = np.concatenate([tokens, start[None]])
    row = model.sensors.index(sensor)
    params = params | {"touch": params["touch"] | {"sensor_tokens": tokens}}
    return replace(config, model=model), _put(params, row, start), row


def _put(params: Params, row: int, tokens: Any) -> Params:
    """`params` with the tokens (S, D) of one sensor replaced."""
    table = jnp.asarray(params["touch"]["sensor_tokens"]).at[row].set(tokens)
    return params | {"touch": params["touch"] | {"sensor_tokens": table}}


def _classes(
    run: str | Path, manifest: Manifest, sensor: str, labels: str | None, log: Log
) -> tuple[np.ndarray, np.ndarray | None]:
    """Class i32 (rows of the manifest,) of every row, -1 for none, and unit prototypes f32 (classes, E) of the known
    sensors; without `labels` all rows are of class 0 and there are no prototypes."""
    if labels is None:
        return np.zeros(len(manifest), np.int32), None
    column = next((c for c in (f"label.{labels}", labels) if c in manifest.table.column_names), None)
    if column is None:
        raise UserError(f"the manifest has no column {labels!r} or 'label.{labels}' for --labels")
    if pa.types.is_floating(manifest.table[column].type):
        raise UserError(f"--labels {labels} is a column of measurements; name one of classes")
    value, felt = text_column(manifest, column), text_column(manifest, "sensor")
    encoder = load_encoder(run)
    known = np.isin(felt, encoder.config.model.sensors) & (felt != sensor)
    usable = known & (value != "") & (text_column(manifest, "split") == "train")
    rows = np.random.default_rng(0).permutation(np.flatnonzero(usable))[:PROTOTYPE_ROWS]
    if not rows.size:
        raise UserError(f"--labels needs frames of sensors that {run} knows, with a {labels}, in split 'train'")
    rows, values = embed_rows(encoder, manifest, np.sort(rows), log=log)
    names, of = np.unique(value[rows], return_inverse=True)
    if len(names) < 2 or len(names) == len(rows):
        raise UserError(f"--labels {labels} must name classes, of two values or more that frames share")
    unit = values / np.linalg.norm(values, axis=1, keepdims=True)
    mean = np.stack([unit[of == one].mean(axis=0) for one in range(len(names))])
    place = np.minimum(np.searchsorted(names, value), len(names) - 1)
    classes = np.where(names[place] == value, place, -1).astype(np.int32)
    return classes, mean / np.linalg.norm(mean, axis=1, keepdims=True)


def _measured(
    manifest: Manifest, sensor: str, classes: np.ndarray, seed: int, fitted: np.ndarray
) -> tuple[np.ndarray, str]:
    """Rows on which to measure: frames of the sensor in split val, or else those that are fitted."""
    here = (text_column(manifest, "sensor") == sensor) & (text_column(manifest, "split") == "val") & (classes >= 0)
    count = min(int(here.sum()), MEASURED)
    if not count:
        return fitted[:MEASURED], "fitted"
    return choose(manifest, sensor, "val", count, classes, seed), "val"


def _read(manifest: Manifest, config: Config, rows: np.ndarray) -> np.ndarray:
    """Stills u8 (rows, 1, H, W, 3)."""
    config = replace(config, data=replace(config.data, batch_size=min(64, len(rows)), on_bad_sample="error"))
    return np.concatenate([part.clip[: len(ids)] for ids, part in evaluation(manifest, rows, config)])


def _loss(net: Net, config: Config, row: int, prototypes: np.ndarray | None) -> Loss:
    """The mean loss of a batch of stills of the sensor in `row`."""

    def reconstruction(params: Params, clip: jax.Array, target: jax.Array, key: jax.Array) -> jax.Array:
        noise = jax.random.uniform(key, (clip.shape[0], net.model.patches))
        sensor, pixels = jnp.full(clip.shape[0], row), objectives.normalise_touch(clip)
        loss, _ = objectives.stage1_terms(params, pixels, sensor, noise, net=net, config=config)
        return loss

    def to_class(params: Params, clip: jax.Array, target: jax.Array, key: jax.Array) -> jax.Array:
        z = net.apply(params, "encode", objectives.normalise_touch(clip), jnp.full(clip.shape[0], row))
        logits = losses.normalise(z) @ jnp.asarray(prototypes).T / net.model.temperature
        return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(logits, target))

    return reconstruction if prototypes is None else to_class


def _fit(
    loss: Loss, params: Params, row: int, clip: np.ndarray, target: np.ndarray, *, steps: int, rate: float, seed: int
) -> tuple[np.ndarray, tuple[float, ...]]:
    """The tokens (S, D) of the row after `steps` of Adam with a falling rate, and the loss of each step."""
    tx = optax.adam(optax.cosine_decay_schedule(rate, steps))
    arrays = jax.device_put((params, clip, target))

    @jax.jit
    def step(tokens: jax.Array, state: Any, key: jax.Array, arrays: Any) -> tuple[jax.Array, Any, jax.Array]:
        params, clip, target = arrays
        key_rows, key_loss = jax.random.split(key)
        # All frames in turn would need another shape for every number of frames.
        rows = jax.random.randint(key_rows, (BATCH,), 0, clip.shape[0])
        value, grad = jax.value_and_grad(lambda t: loss(_put(params, row, t), clip[rows], target[rows], key_loss))(
            tokens
        )
        updates, state = tx.update(grad, state)
        return optax.apply_updates(tokens, updates), state, value

    tokens = jnp.asarray(params["touch"]["sensor_tokens"][row])
    state, root, history = tx.init(tokens), jax.random.key(seed), []
    for number in range(steps):
        tokens, state, value = step(tokens, state, jax.random.fold_in(root, number), arrays)
        history.append(value)
    return np.asarray(tokens), tuple(float(value) for value in history)


def _mean(loss: Loss, params: Params, *, clip: np.ndarray, target: np.ndarray) -> float:
    """The loss on given frames, under masks that are the same each time."""
    return float(jax.jit(loss)(params, clip, target, jax.random.key(0)))
