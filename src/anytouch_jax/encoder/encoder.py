"""Touch features from a trained encoder: of arrays, manifests, folders of frames and videos (`anytouch embed`)."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
import pyarrow as pa

from anytouch_jax.config import UNIVERSAL, Config, ModelConfig, check_spelling
from anytouch_jax.data.images import to_rgb
from anytouch_jax.data.loading.evaluation import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.transforms import Flip, orient_frame, subtract_background, touch_evaluation
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.weights import load

Pooling = Literal["class", "mean", "both"]
Join = Literal["mean", "sum", "concat"]
Log = Callable[[str], None]


def _warn(sentence: str) -> None:
    warnings.warn(sentence, stacklevel=4)


@dataclass(frozen=True)
class Encoder:
    """A touch encoder with its parameters. `source` says where they came from.

    `seen`: the sensors that it was trained on, None where nothing tells. `universal_drawn`: whether training drew the
    universal tokens; else the mean over the sensors seen stands in their place (`compatible.serve_unseen`).
    """

    config: Config
    params: dict[str, Any] = field(repr=False)
    source: str
    seen: tuple[str, ...] | None = None
    universal_drawn: bool = True

    @cached_property
    def net(self) -> Net:
        return build(self.config.model)

    def sensor_row(self, name: str, log: Log = _warn) -> int:
        """Row of a sensor's tokens. For one that training has not seen, or that the table does not have, these are the
        universal ones, said aloud. Raises SpellingError for a known name that is spelled otherwise."""
        model, name = self.config.model, str(name)
        drawn, known = self.universal_drawn or not self.seen, name in model.sensors
        if known and (drawn if name == UNIVERSAL else self.seen is None or name in self.seen):
            return model.sensors.index(name)
        check_spelling(name, model.sensors)
        why = f"is not in this model's table ({', '.join(model.sensors)})"
        if known:
            why = f"was not drawn in training (that saw {', '.join(self.seen or ())})"
        instead = "the universal tokens" if drawn else "the mean of the tokens that training saw (no universal ones)"
        log(f"sensor {name!r} {why}: using {instead}")
        return model.sensors.index(name) if known else model.universal_row

    def computed_in(self, dtype: Literal["trained", "float32", "bfloat16"]) -> Encoder:
        """The same encoder with other arithmetic: "float32", "bfloat16", or "trained" for that of its training."""
        if dtype == "trained":
            return self
        return replace(self, config=replace(self.config, model=replace(self.config.model, dtype=dtype)))

    @property
    def subtracts(self) -> bool:
        """Whether it was trained on touches less the untouched gel (`data.background`), and wants those."""
        return self.config.data.background == "subtract"

    @cached_property
    def mark(self) -> str:
        """A checksum of the parameters: a run that was trained anew is another encoder."""
        return f"{zlib.crc32(b''.join(np.ascontiguousarray(x).tobytes() for x in jax.tree.leaves(self.params))):08x}"

    def embed(
        self, clips: Any, sensor: str | Sequence[str] | np.ndarray = UNIVERSAL, *, pooling: Pooling = "class",
        join: Join = "mean",
    ) -> np.ndarray:  # fmt: skip
        """Features (B, E) of touches u8 RGB (B, T, H, W, 3), (B, H, W, 3) or one (H, W, 3), at the model's size.

        `sensor` is a name for all, names (B,), or rows i32 (B,). T is 1 (a still), 3 (a clip) or more: segments joined
        by `join`.
        An encoder that `subtracts` wants them less the untouched gel: see `Sight`.
        `pooling`: the class token's embedding (what alignment trains), the mean over patch tokens, or both (B, 2E).
        Raises UserError for another shape or type.
        """
        clips = np.asarray(clips)
        clips = clips[None, None] if clips.ndim == 3 else clips[:, None] if clips.ndim == 4 else clips
        side = self.config.model.image_size
        if clips.dtype != np.uint8 or clips.ndim != 5 or clips.shape[2:] != (side, side, 3):
            raise UserError(
                f"touches must be uint8 RGB of {side} x {side} pixels, (B, T, {side}, {side}, 3), not {clips.dtype} "
                f"{clips.shape}; `see = Sight(encoder)`, then `see(frame)`, resizes a frame"
            )
        check_frames(self.config.model, clips.shape[1])
        rows = np.full(len(clips), self.sensor_row(sensor)) if isinstance(sensor, str) else np.asarray(sensor)
        if rows.dtype.kind in "UO":
            rows = np.array([self.sensor_row(name) for name in rows.reshape(-1)], np.int32).reshape(rows.shape)
        if rows.shape != (len(clips),) or rows.dtype.kind not in "iu":
            raise UserError(
                f"sensor rows must be one integer for each of the {len(clips)} touches, not {rows.dtype} {rows.shape}"
            )
        if rows.min(initial=0) < 0 or rows.max(initial=0) >= len(self.config.model.sensors):
            raise UserError(f"sensor rows must be 0 to {len(self.config.model.sensors) - 1}")
        count, run = len(clips), self._run(pooling, join)
        if not count:  # the network has no shape for nothing: embed one and give none
            clips, rows = np.zeros((1, *clips.shape[1:]), np.uint8), np.zeros(1, np.int32)
        return np.asarray(run(self._placed, clips, rows.astype(np.int32)))[:count]

    def _run(self, pooling: Pooling, join: Join) -> Callable[..., jax.Array]:
        key = (pooling, join)
        if key not in self._compiled:
            self._compiled[key] = jax.jit(partial(touch_features, net=self.net, pooling=pooling, join=join))
        return self._compiled[key]

    @cached_property
    def _placed(self) -> dict[str, Any]:
        """The parameters on the device, where they stay."""
        return jax.device_put(self.params)

    @cached_property
    def _compiled(self) -> dict[Any, Callable[..., jax.Array]]:
        return {}


class Preprocess:
    """Frames of one sensor as an encoder was trained to see them: resized, and, where it `subtracts`, less `background`
    (a frame), the picture of the untouched gel; the first frame serves where none is given. `rotate` and `flip` turn
    both before (`data.transforms.orient_frame`)."""

    def __init__(
        self, encoder: Encoder, background: npt.ArrayLike | None = None, *, rotate: int = 0, flip: Flip = "none"
    ) -> None:
        self._encoder, self._turned = encoder, partial(orient_frame, rotate=rotate, flip=flip)
        self._background = None
        if background is not None:
            self._background = self._turned(to_rgb(np.asarray(background), "the background"))

    def __call__(self, frame: npt.ArrayLike) -> np.ndarray:
        """A frame (h, w, 3), or another form of picture that `data.images.decode` reads (grey, RGBA, u16, floats of
        0..1), as RGB u8 (size, size, 3). Raises ImageError for any other."""
        frame = np.ascontiguousarray(self._turned(to_rgb(np.asarray(frame), "the frame")))
        if self._encoder.subtracts:
            self._background = frame if self._background is None else self._background
            frame = subtract_background([frame], self._background)[0]
        return touch_evaluation([frame], self._encoder.config.model.image_size)[0]


def check_frames(model: ModelConfig, frames: int) -> None:
    """Raise UserError unless a touch may have so many frames: 1 (a still), or as many as the model's clips or more."""
    if frames != 1 and frames < model.frames:
        raise UserError(f"a clip needs {model.frames} frames or more (or 1, a still), not {frames}")


def touch_features(
    params: Any, clips: jax.Array, sensor: jax.Array, *, net: Net, pooling: Pooling, join: Join
) -> jax.Array:
    """Features f32 (B, E) of touches u8 (B, T, H, W, 3) and sensor rows (B,), to be traced: see `Encoder.embed`."""
    for name, value, kind in (("pooling", pooling, Pooling), ("join", join, Join)):
        if value not in get_args(kind):
            raise UserError(f"{name} is one of {', '.join(get_args(kind))}, not {value!r}")
    clips = normalise_touch(clips)
    if pooling == "class":
        return net.apply(params, "encode", clips, sensor, join).astype(jnp.float32)
    parts = net.apply(params, "encode_both", clips, sensor, join)  # what is not read is not computed
    return jnp.concatenate(parts if pooling == "both" else parts[1:], axis=-1).astype(jnp.float32)


def load_encoder(path: str | Path, *, step: int | None = None) -> Encoder:
    """The encoder of a run folder, a checkpoint folder or a weights file (.pth, .bin, .safetensors, .npz).

    Only the touch encoder is kept. A sensor that a run, or the authors' weights, was not trained on is served by the
    universal tokens (Sec. 3.5), whether or not the table has its name. A bad sample stops what it embeds, whatever
    training did with such. Raises UserError when there is no touch encoder, or weights that are not finite.
    """
    path = Path(path)
    if path.is_file():
        _refuse_features(path)
    loaded = load.load_model(path, step=step)
    if "touch" not in loaded.params:
        raise UserError(f"{path} has no touch encoder; give a stage-1 or stage-2 run, or AnyTouch weights")
    touch = loaded.params["touch"]
    if not all(bool(np.isfinite(leaf).all()) for leaf in jax.tree.leaves(touch)):
        raise UserError(f"{path} has weights that are not finite: its training diverged; take an earlier checkpoint")
    config = _touch_only(loaded.config)
    return Encoder(config, {"touch": touch}, str(path), loaded.trained_sensors, loaded.universal_drawn)


def _refuse_features(path: Path) -> None:
    """Raise UserError for what `anytouch embed` wrote."""
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {"features", "rows"} <= set(file.files)
    except Exception:  # weights of any kind: who reads them says what is wrong
        return
    if found:
        raise UserError(f"{path} is a features file, no encoder: `anytouch probe` takes it as --features")


def random_encoder(config: Config, seed: int = 0) -> Encoder:
    """An untrained encoder: the control of every probe."""
    config = _touch_only(config)
    return Encoder(config, {"touch": build(config.model).init(jax.random.key(seed))["touch"]}, f"random({seed})")


def _touch_only(config: Config) -> Config:
    bare = replace(usable(config.model), image=None, text=None, match_head="none", lora_rank=0, force_head=False)
    return replace(config, model=bare, data=replace(config.data, on_bad_sample="error"))


@dataclass(frozen=True)
class Features:
    """Features (n, d) f32 with the keys of their rows: manifest row numbers, or frame numbers of a video or folder.

    `said`: more arrays (n, ...), what a head says of them.
    """

    values: np.ndarray
    rows: np.ndarray
    keys: dict[str, np.ndarray]
    skipped: int = 0
    said: dict[str, np.ndarray] = field(default_factory=dict)


def embed_rows(
    encoder: Encoder,
    manifest: Manifest,
    rows: np.ndarray,
    frames: int = 1,
    pooling: Pooling = "class",
    join: Join = "mean",
    *,
    batch: int = 64,
    on_bad_sample: Literal["error", "skip"] = "error",
    log: Log = _warn,
) -> tuple[np.ndarray, np.ndarray]:
    """(row numbers, features) of manifest rows, each frame encoded once; `frames` is the length of a row's clip.

    A sensor that the model does not know gets the universal tokens, said aloud. With `on_bad_sample` "skip" rows that
    cannot be read are left out. Raises UserError.
    """
    if not len(rows):
        raise UserError("no rows are left to embed; check the split and the filters")
    for name in sorted(set(text_column(manifest, "sensor")[rows])):
        encoder.sensor_row(name, log)
    if on_bad_sample == "error":
        check_backgrounds(encoder, manifest, rows)
    data = replace(encoder.config.data, batch_size=min(batch, len(rows)), on_bad_sample=on_bad_sample)
    config = replace(encoder.config, data=data)
    kind: Literal["still", "clip"] = "still" if frames == 1 else "clip"
    ids, values = [], []
    for found, part in evaluation(manifest, rows, config, kind, frames=frames, unknown="universal"):
        ids.append(found)
        values.append(encoder.embed(part.clip, part.sensor, pooling=pooling, join=join)[: len(found)])
    if not ids:
        raise UserError(f"none of the {len(rows)} rows can be read; `anytouch verify` says what is wrong with them")
    return np.concatenate(ids), np.concatenate(values)


def check_backgrounds(encoder: Encoder, manifest: Manifest, rows: np.ndarray) -> None:
    """Raise UserError where the encoder takes the untouched gel off and some of `rows` name no picture of it."""
    bare = rows[~manifest.present("background_path")[rows]]
    if encoder.subtracts and len(bare):
        raise UserError(
            f"{manifest.where(int(bare[0]))} and {len(bare) - 1} other rows have no background_path, which "
            f"{encoder.source} takes off every touch; name one, or leave such rows out (embed: --on-bad-sample skip)"
        )


def text_column(manifest: Manifest, name: str) -> np.ndarray:
    """A column of a manifest as strings, "" where it is null."""
    return np.array(["" if value is None else str(value) for value in manifest.column(name).to_pylist()])


def plain_column(manifest: Manifest, name: str) -> np.ndarray:
    """A column of a manifest as an array without objects: numbers as they are, NaN where null; all else as text."""
    kind = manifest.column(name).type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return text_column(manifest, name)
    return np.asarray([np.nan if value is None else value for value in manifest.column(name).to_pylist()])


def save_npz(path: str | Path, features: Features, about: dict[str, str]) -> None:
    """Write features, row numbers, keys and a description as one `.npz`, whole or not at all. Raises OSError."""
    described = {f"about/{k}": np.asarray(v) for k, v in about.items()}
    keys = {f"key/{k}": v for k, v in features.keys.items()}
    arrays: dict[str, Any] = {"features": features.values, "rows": features.rows, **features.said, **keys, **described}
    with atomic_path(path) as part, open(part, "wb") as file:
        np.savez(file, **arrays)
