"""Feature caches: features by manifest row, of an encoder, a features file or raw pixels; in memory
and on disk.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import jax
import numpy as np
from sklearn.decomposition import PCA

from anytouch_jax.config import preset
from anytouch_jax.data.background.rule import ADVICE, UnitGels
from anytouch_jax.data.loading.samples import read_image
from anytouch_jax.data.manifest.files import read_file, split_shard_path
from anytouch_jax.data.manifest.manifest import Manifest, distinct_files
from anytouch_jax.data.transforms import FORM
from anytouch_jax.encoder.embed import Features, Join, Pooling, embed_rows, read_npz, save_npz
from anytouch_jax.encoder.encoder import Encoder, check_frames, load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.heads import Scaling
from anytouch_jax.evaluate.statistics import RANDOM, RAW, Array
from anytouch_jax.evaluate.tasks import TaskRows
from anytouch_jax.files import read_arrays

Order = Literal["right", "shuffled", "repeated"]
Compute = Callable[[Array, int], Array]  # (rows i64 (n,), frames) -> features f32 (n, d)

VERSION = 4  # of the features; a change to their computation raises it
RAW_SIZE = (240, 320)  # of a picture before its area averages
SMALL = (24, 32)
COMPONENTS = 200  # principal components of raw pixels


class FeatureStore:
    """Features by row and length of clip, each computed once and, with a `folder`, stored in an
    .npz named by content.

    `describe()` names everything else that they depend on. It is called only if there is a folder.
    """

    def __init__(
        self,
        compute: Compute,
        describe: Callable[[], Mapping[str, Any]] = dict,
        folder: Path | None = None,
    ) -> None:
        self._compute = compute
        self._folder = folder
        self._about = {} if folder is None else dict(describe())
        # rows, in order, and their features by length of clip
        self._known: dict[int, tuple[Array, Array]] = {}

    def add(self, rows: Array, frames: int) -> None:
        """Compute the missing features of these rows (any shape) in one pass."""
        if frames not in self._known:
            self._known[frames] = np.zeros(0, np.int64), np.zeros((0, 0), np.float32)
            if self._folder is not None:
                # a damaged file is written again
                with contextlib.suppress(OSError, ValueError, KeyError):
                    arrays = read_arrays(self.file(frames))
                    self._known[frames] = arrays["rows"], arrays["features"]
        known, values = self._known[frames]
        missing = np.setdiff1d(rows, known)
        if not len(missing):
            return
        computed = self._compute(missing, frames)
        every = np.concatenate([known, missing])
        order = np.argsort(every)
        every = every[order]
        values = np.concatenate([values, computed] if len(known) else [computed])[order]
        self._known[frames] = every, values
        if self._folder is not None:
            save_npz(self.file(frames), Features(values, every, {}), {"about": self._text(frames)})

    def get(self, rows: Array, frames: int) -> Array:
        """Return features f32 (n, k * d) of `rows` (n, k), those of a row joined."""
        self.add(rows, frames)
        known, values = self._known[frames]
        return values[np.searchsorted(known, rows)].reshape(len(rows), -1)

    def file(self, frames: int) -> Path:
        """Return the file of features of clips of this length."""
        return (
            Path(self._folder or ".")
            / f"{hashlib.sha256(self._text(frames).encode()).hexdigest()[:32]}.npz"
        )

    def _text(self, frames: int) -> str:
        return json.dumps(self._about | {"frames": frames}, sort_keys=True)


def encoder_features(
    encoder: Encoder,
    table: Manifest,
    *,
    pooling: Pooling = "class",
    join: Join = "mean",
    order: Order = "right",
    universal: bool = False,
    folder: Path | None = None,
    gels: UnitGels | None = None,
    log: Callable[[str], None] = lambda _: None,
) -> FeatureStore:
    """Return the features of an encoder; `universal`: the universal tokens for every sensor, as for
    unknown ones.
    """
    gels = gels or UnitGels(table)

    def describe() -> dict[str, Any]:
        about = {
            "pooling": pooling,
            "join": join,
            "universal": universal,
            "background": encoder.config.data.background,
        }
        content = _content(table, encoder_digest(encoder), order) | about
        return content | ({"gels": gels.digest()} if encoder.subtracts else {})

    def compute(rows: Array, frames: int) -> Array:
        sensor_row = encoder.config.model.universal_row if universal else None
        edit = partial(reorder_frames, order=order)
        about: dict[str, Any] = {"sensor_row": sensor_row, "edit": edit, "gels": gels, "log": log}
        return embed_rows(encoder, table, rows, frames, pooling, join, **about)[1]

    return FeatureStore(compute, describe, folder)


def pixel_features(
    table: Manifest,
    *,
    order: Order = "right",
    folder: Path | None = None,
    gels: UnitGels | None = None,
) -> FeatureStore:
    """Return raw pixels (24 x 32 x 3) of the last frame and every frame minus the background, in
    0..1.
    """
    gels = gels or UnitGels(table)
    read = _pair_reader(
        table, gels, lambda image: cv2.resize(image, RAW_SIZE[::-1], interpolation=cv2.INTER_AREA)
    )

    def compute(rows: Array, frames: int) -> Array:
        clips = table.clips(frames) if frames > 1 else np.arange(len(table))[:, None]
        windows = reorder_frames(clips[np.searchsorted(clips[:, -1], rows)], rows, order)
        single, places = np.unique(windows, return_inverse=True)
        pixels = np.stack([raw_pixels(*read(int(row))) for row in single])
        last, differences = np.split(pixels, 2, axis=1)
        places = places.reshape(windows.shape)
        return np.concatenate(
            [last[places[:, -1]], differences[places].reshape(len(rows), -1)], axis=1
        )

    name = "raw pixels in colour"
    return FeatureStore(
        compute, lambda: _content(table, name, order) | {"gels": gels.digest()}, folder
    )


def file_features(path: Path, table: Manifest) -> FeatureStore:
    """Return the features of an .npz file: arrays `features` (n, d) and `rows` (n,) of the
    manifest.

    Raises UserError for another file or manifest, and, when they are read, for other clips and
    missing rows.
    """
    features, about = read_npz(path)
    values = features.values
    rows = features.rows
    length = about.get("frames")
    if len(np.unique(rows)) < len(rows) or rows.min() < 0 or rows.max() >= len(table):
        raise UserError(
            f"{path}: rows must be distinct row numbers of the manifest, from 0 to "
            f"{len(table) - 1}."
        )
    paths = features.keys.get("path")
    if (
        paths is not None
        and (paths != table.text_column("path")[rows]).any()
        and len(table.files) == 1
    ):
        raise UserError(
            f"{path} holds features of another manifest. Its paths differ from those of these rows."
        )
    order = np.argsort(rows)
    rows = rows[order]
    values = values[order].astype(np.float32)

    def compute(wanted: Array, frames: int) -> Array:
        if length not in (None, str(frames)):
            raise UserError(
                f"{path} holds features of {length} frames a touch, not {frames}. Give --frames "
                f"{length}."
            )
        missing = len(np.setdiff1d(wanted, rows))
        if missing:
            raise UserError(
                f"{path} lacks {missing} of the {len(wanted)} rows to probe. Embed them too."
            )
        return values[np.searchsorted(rows, wanted)]

    return FeatureStore(compute)


def reorder_frames(clips: Array, rows: Array, order: Order) -> Array:
    """Return clips (n, T, ...) untouched, with frames shuffled (by the row's number), or with the
    last repeated.
    """
    frames = clips.shape[1]
    if order == "right" or frames == 1:
        return clips
    if order == "repeated":
        return np.repeat(clips[:, -1:], frames, axis=1)
    if order != "shuffled":
        raise UserError(f"Unknown order {order!r}. Choose right, shuffled or repeated.")
    shuffled = np.empty_like(clips)
    for place, row in enumerate(rows):
        rng = np.random.default_rng([13, int(row)])
        drawn = np.arange(frames)
        while (drawn == np.arange(frames)).all():
            drawn = rng.permutation(frames)
        shuffled[place] = clips[place, drawn]
    return shuffled


def _content(table: Manifest, parameters: str, order: Order) -> dict[str, Any]:
    about = {
        "parameters": parameters,
        "manifest": table.content_hash,
        "pictures": image_digest(table),
    }
    return {"version": VERSION, "order": order, **about}


def encoder_digest(encoder: Encoder) -> str:
    """Return SHA-256 over the parameters and the model config."""
    digest = hashlib.sha256(encoder.contract.encode())
    leaves = jax.tree_util.tree_leaves_with_path(encoder.params)
    for name, leaf in sorted(
        (jax.tree_util.keystr(path, simple=True, separator="/"), leaf) for path, leaf in leaves
    ):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.view(np.uint8).data if array.size else b"")
    return digest.hexdigest()


def image_digest(table: Manifest, count: int = 32) -> str:
    """Return SHA-256 over size and mtime of each frame (or its shard), all backgrounds and `count`
    sampled frames.

    Pictures may change under an equal manifest. A copy of the folder that keeps its times has the
    same digest.
    """
    digest = hashlib.sha256()
    files = distinct_files(table, ("path", "background_path"))
    for row, column in zip(files.row, files.column, strict=True):
        # an unreadable file raises when its features are computed
        with contextlib.suppress(OSError, ValueError):
            file = table.file(int(row), column)
            if column == "background_path":
                digest.update(read_file(file))
                continue
            shard = split_shard_path(file)
            about = os.stat(shard[0] if shard else file)
            digest.update(f"{about.st_size} {about.st_mtime_ns} ".encode())
    for row in np.unique(np.linspace(0, len(table) - 1, count).astype(int)):
        with contextlib.suppress(OSError, ValueError):
            digest.update(read_file(table.file(int(row))))
    return digest.hexdigest()


def raw_pixels(frame: Array, background: Array | None) -> Array:
    """Return pixels in colour, and minus the background (0 if None): u8 RGB (h, w, 3) -> f32 (2 *
    24 * 32 * 3,).
    """
    pixels = _small(frame)
    return np.concatenate(
        [pixels, np.zeros_like(pixels) if background is None else pixels - _small(background)]
    )


def _pair_reader(
    table: Manifest, gels: UnitGels, prepare: Callable[[Array], Any]
) -> Callable[[int], tuple[Any, Any]]:
    """Return a function from a row to its prepared frame and untouched gel, None without one."""
    gel = gels.shared(prepare)
    return lambda row: (prepare(read_image(table, row)), gel(row))


def background_difference(table: Manifest, rows: Array, gels: UnitGels | None = None) -> Array:
    """Return frames minus their untouched gel in RGB: f32 (n, 24 * 32 * 3) in -1..1.

    Raises UserError without one.
    """
    read = _pair_reader(
        table, gels or UnitGels(table), lambda one: (_small(one), one.shape[1] / one.shape[0])
    )
    values = np.zeros((len(rows), SMALL[0] * SMALL[1] * 3), np.float32)
    for place, row in enumerate(map(int, rows)):
        (frame, proportion), background = read(row)
        if background is None:
            raise UserError(f"{table.where(row)} has no picture of the untouched gel. {ADVICE}")
        if abs(proportion / background[1] - 1) > 1 / FORM:
            raise UserError(
                f"{table.where(row)}: its background_path has other proportions than the frame."
            )
        values[place] = frame - background[0]
    return values


def principal_components(
    features: Array,
    train: Array,
    components: int = COMPONENTS,
    solver: Literal["full", "randomized"] = "full",
) -> Array:
    """Return `features` (n, d) on the principal components of their `train` (n,) rows.

    Raises UserError without any.
    """
    fitted = features[np.asarray(train, bool)]
    if not len(fitted):
        raise UserError("No row is marked as train. The principal components need some.")
    pca = PCA(min(components, *fitted.shape), svd_solver=solver, random_state=0)
    return np.asarray(pca.fit(fitted).transform(features), np.float32)


def _small(image: Array) -> Array:
    """Return area averages, f32 (24 * 32 * 3,) in 0..1, of a picture u8 (h, w, 3)."""
    return cv2.resize(
        image.astype(np.float32) / 255, SMALL[::-1], interpolation=cv2.INTER_AREA
    ).ravel()


def pixel_components(store: FeatureStore, rows: TaskRows) -> Array:
    """Return the principal components of raw pixels, fitted on the rows of train (on all without
    these).
    """
    train = rows.split == "train"
    return principal_components(store.get(rows.rows, 1), train if train.any() else ~train)


class FeatureSource(NamedTuple):
    """Features with their name; `encoder` is None for a features file and for raw pixels."""

    name: str
    store: FeatureStore
    encoder: Encoder | None = None
    scaling: Scaling = "column"

    def notes(self, sensors: Array) -> list[str]:
        """Return a note on sensors that the encoder was not trained on, or nothing."""
        if self.encoder is None:
            return []
        trained = self.encoder.trained_sensors
        unknown = sorted(
            set(sensors) - set(self.encoder.config.model.sensors if trained is None else trained)
        )
        if unknown:
            return [f"universal tokens for {', '.join(unknown)}"]
        return []


def opened(models: Sequence[str | Path | FeatureSource]) -> list[Encoder | FeatureSource]:
    """Return the encoders of names and paths, and other sources unchanged."""
    return [one if isinstance(one, FeatureSource) else load_encoder(one) for one in models]


def with_gel(rows: TaskRows, gels: UnitGels, models: Sequence[Encoder | FeatureSource]) -> TaskRows:
    """Return the rows that all models can read, for those that need an untouched gel.

    Raises UserError without any.
    """
    encoders = [one if isinstance(one, Encoder) else one.encoder for one in models]
    if not any(encoder is not None and encoder.needs_background for encoder in encoders):
        return rows
    has = np.all(gels.has(rows.rows.ravel()).reshape(rows.rows.shape), axis=1)
    if not has.any():
        raise UserError(
            f"None of {len(rows.rows)} rows has a picture of the untouched gel to subtract. "
            f"{ADVICE}"
        )
    note = f"{(~has).sum()} rows are left out: they have no picture of the untouched gel"
    return rows.take(np.flatnonzero(has))._replace(
        notes=(*rows.notes, *([] if has.all() else [note]))
    )


def sources(
    table: Manifest,
    models: Sequence[Encoder | FeatureSource],
    features: Sequence[str | Path],
    controls: bool,
    cache: Path | None,
    rows: dict[int, Array],
    order: Order = "right",
    least: int = 1,
    *,
    gels: UnitGels,
    **encoding: Any,
) -> list[FeatureSource]:
    """Return models, the random encoder, features files and raw pixels, in this order.

    `rows` by length of clip: a file that lacks some is reported before the work. `least`: frames of
    every clip.
    """
    several = [model for model in models if isinstance(model, FeatureSource)]
    encoders = {model.source: model for model in models if isinstance(model, Encoder)}
    if controls:
        first = next(
            (one for one in (*encoders.values(), *(source.encoder for source in several)) if one),
            None,
        )
        encoders[RANDOM] = first.untrained() if first else random_encoder(preset("tiny"))
    for name, encoder in encoders.items():
        check_frames(encoder.config.model, least)
        store = encoder_features(encoder, table, order=order, folder=cache, gels=gels, **encoding)
        several.append(FeatureSource(name, store, encoder))
    for path in features:
        several.append(FeatureSource(str(path), file_features(Path(path), table)))
        for frames, ids in rows.items():
            several[-1].store.add(ids, frames)
    if controls:
        several.append(
            FeatureSource(
                RAW, pixel_features(table, order=order, folder=cache, gels=gels), None, "common"
            )
        )
    if not several:
        raise UserError(
            "There is nothing to probe. Give --model or --features, or keep the controls."
        )
    return several
