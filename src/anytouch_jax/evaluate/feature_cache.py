"""Feature caches: features by manifest row, of an encoder, a features file or raw pixels.

They are kept in memory and, with a folder, on disk. A file is named by everything its features
depend on, so a change to weights, images or settings is another file, and nothing is ever stale.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import jax
import numpy as np
from sklearn.decomposition import PCA

from anytouch_jax.data.background.rule import ADVICE, Backgrounds
from anytouch_jax.data.loading.samples import read_image
from anytouch_jax.data.manifest.files import read_file, split_shard_path
from anytouch_jax.data.manifest.manifest import Manifest, distinct_files
from anytouch_jax.data.transforms import FORM
from anytouch_jax.encoder.arrays import Aggregation, Array, Log, Pooling
from anytouch_jax.encoder.embed import Features, embed_rows, read_npz, save_npz
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.heads import Scaling
from anytouch_jax.evaluate.tasks import TaskRows
from anytouch_jax.files import read_arrays

Order = Literal["right", "shuffled", "repeated"]
Compute = Callable[[Array, int], Array]  # (rows i64 (n,), frames) -> features f32 (n, d)

VERSION = 4  # of the features; a change to their computation raises it
RAW_SIZE = (240, 320)  # of an image before its area averages
SMALL = (24, 32)
COMPONENTS = 200  # principal components of raw pixels


class FeatureStore:
    """Features by row and length of clip, each computed once.

    With a `folder` they are stored in an .npz named by content. `describe()` names everything
    else that they depend on. It is called only if there is a folder, because it reads images.
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
            self._known[frames] = self._read(frames)
        known, values = self._known[frames]
        missing = np.setdiff1d(rows, known)
        if not len(missing):
            return
        computed = self._compute(missing, frames)
        if len(known):
            computed = np.concatenate([values, computed])
        every = np.concatenate([known, missing])
        order = np.argsort(every)
        every = every[order]
        values = computed[order]
        self._known[frames] = every, values
        if self._folder is not None:
            save_npz(self.file(frames), Features(values, every, {}), {"about": self._text(frames)})

    def _read(self, frames: int) -> tuple[Array, Array]:
        """Return the rows, in order, and features that are stored; none without a file."""
        if self._folder is not None:
            # a damaged file is written again
            with contextlib.suppress(OSError, ValueError, KeyError):
                arrays = read_arrays(self.file(frames))
                return arrays["rows"], arrays["features"]
        return np.zeros(0, np.int64), np.zeros((0, 0), np.float32)

    def get(self, rows: Array, frames: int) -> Array:
        """Return features f32 (n, k * d) of `rows` (n, k), those of a row joined."""
        self.add(rows, frames)
        known, values = self._known[frames]
        return values[np.searchsorted(known, rows)].reshape(len(rows), -1)

    def file(self, frames: int) -> Path:
        """Return the file of features of clips of this length."""
        name = hashlib.sha256(self._text(frames).encode()).hexdigest()[:32]
        return Path(self._folder or ".") / f"{name}.npz"

    def _text(self, frames: int) -> str:
        return json.dumps(self._about | {"frames": frames}, sort_keys=True)


@dataclass(frozen=True)
class Encoding:
    """How features of a manifest are computed.

    Attributes:
        pooling: class token, mean of the patch tokens, or both.
        aggregation: how the segments of a clip longer than the model's are joined.
        order: of the frames of a clip: as recorded, shuffled, or the last one repeated.
        universal: the universal tokens for every sensor, as for unknown ones.
        folder: keeps features on disk.
        backgrounds: backgrounds of the manifest's sensor instances, found anew without.
        log: is called with sentences on what is done.
    """

    pooling: Pooling = "class"
    aggregation: Aggregation = "mean"
    order: Order = "right"
    universal: bool = False
    folder: Path | None = None
    backgrounds: Backgrounds | None = None
    log: Log = lambda _: None


def encoder_features(
    encoder: Encoder, table: Manifest, encoding: Encoding | None = None, **changes: Any
) -> FeatureStore:
    """Return the features of an encoder; `changes` are fields of `Encoding` by name."""
    how = replace(encoding or Encoding(), **changes)
    backgrounds = how.backgrounds or Backgrounds(table)

    def describe() -> dict[str, Any]:
        content = _content(table, encoder_digest(encoder), how.order)
        content |= {
            "pooling": how.pooling,
            "join": how.aggregation,
            "universal": how.universal,
            "background": encoder.config.data.background,
        }
        if encoder.subtracts:
            content["gels"] = backgrounds.digest()
        return content

    def compute(rows: Array, frames: int) -> Array:
        sensor_row = encoder.config.model.universal_row if how.universal else None
        return embed_rows(
            encoder,
            table,
            rows,
            frames,
            how.pooling,
            how.aggregation,
            sensor_row=sensor_row,
            edit=partial(reorder_frames, order=how.order),
            backgrounds=backgrounds,
            log=how.log,
        )[1]

    return FeatureStore(compute, describe, how.folder)


def pixel_features(
    table: Manifest,
    *,
    order: Order = "right",
    folder: Path | None = None,
    backgrounds: Backgrounds | None = None,
) -> FeatureStore:
    """Return raw pixels of the last frame, and every frame minus the background.

    Both are area averages of 24 x 32 x 3 in 0..1. They are the control that needs no network.

    Args:
        table: the frames.
        order: of the frames in a clip.
        folder: keeps features by content, None keeps nothing.
        backgrounds: the untouched gels, by default those of the table.
    """
    known = backgrounds or Backgrounds(table)
    # Every image comes to one size first, so that devices with other resolutions, or with odd
    # sizes that 24 x 32 does not divide, are averaged over the same areas.
    read = _pair_reader(
        table, known, lambda image: cv2.resize(image, RAW_SIZE[::-1], interpolation=cv2.INTER_AREA)
    )

    def describe() -> dict[str, Any]:
        return _content(table, "raw pixels in colour", order) | {"gels": known.digest()}

    def compute(rows: Array, frames: int) -> Array:
        clips = np.arange(len(table))[:, None]
        if frames > 1:
            clips = table.clips(frames)
        windows = reorder_frames(clips[np.searchsorted(clips[:, -1], rows)], rows, order)
        # Clips of neighbouring rows share frames: each is read once.
        single, places = np.unique(windows, return_inverse=True)
        pixels = np.stack([raw_pixels(*read(int(row))) for row in single])
        last, differences = np.split(pixels, 2, axis=1)
        places = places.reshape(windows.shape)
        every_difference = differences[places].reshape(len(rows), -1)
        return np.concatenate([last[places[:, -1]], every_difference], axis=1)

    return FeatureStore(compute, describe, folder)


def file_features(path: Path, table: Manifest) -> FeatureStore:
    """Return the features of an .npz file: `features` (n, d) and `rows` (n,) of the manifest.

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
    # Paths of joined manifests are relative to several folders, so they are not compared.
    if paths is not None and len(table.files) == 1:
        differs = (paths != table.text_column("path")[rows]).any()
    else:
        differs = False
    if differs:
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
    """Return clips (n, T, ...) with their frames in another order.

    "right" leaves them, "repeated" repeats the last, and "shuffled" draws an order by the row's
    number, never the right one. What a probe loses by it is what it had from motion.
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
    """Return what all features of a manifest depend on."""
    return {
        "version": VERSION,
        "order": order,
        "parameters": parameters,
        "manifest": table.content_hash,
        "pictures": image_digest(table),
    }


def encoder_digest(encoder: Encoder) -> str:
    """Return SHA-256 over the parameters and the model config."""
    digest = hashlib.sha256(encoder.contract.encode())
    leaves = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(encoder.params):
        leaves[jax.tree_util.keystr(path, simple=True, separator="/")] = leaf
    for name in sorted(leaves):
        array = np.ascontiguousarray(leaves[name])
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.view(np.uint8).data if array.size else b"")
    return digest.hexdigest()


def image_digest(table: Manifest, count: int = 32) -> str:
    """Return SHA-256 over what tells that images changed under an equal manifest.

    That is size and mtime of each frame (or its shard), the bytes of all backgrounds, and those of
    `count` sampled frames: reading all would take as long as encoding them. A copy of the folder
    that keeps its times has the same digest.
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
            if shard:
                file = shard[0]
            about = os.stat(file)
            digest.update(f"{about.st_size} {about.st_mtime_ns} ".encode())
    for row in np.unique(np.linspace(0, len(table) - 1, count).astype(int)):
        with contextlib.suppress(OSError, ValueError):
            digest.update(read_file(table.file(int(row))))
    return digest.hexdigest()


def raw_pixels(frame: Array, background: Array | None) -> Array:
    """Return pixels in colour, then minus the background, f32 (2 * 24 * 32 * 3,).

    `frame` and `background` are u8 RGB (h, w, 3). Without a background the second half is 0.
    """
    pixels = _small(frame)
    difference = np.zeros_like(pixels)
    if background is not None:
        difference = pixels - _small(background)
    return np.concatenate([pixels, difference])


def _pair_reader(
    table: Manifest, backgrounds: Backgrounds, prepare: Callable[[Array], Any]
) -> Callable[[int], tuple[Any, Any]]:
    """Return a function from a row to its prepared frame and untouched gel, None without one."""
    gel = backgrounds.shared(prepare)
    return lambda row: (prepare(read_image(table, row)), gel(row))


def background_difference(
    table: Manifest, rows: Array, backgrounds: Backgrounds | None = None
) -> Array:
    """Return frames minus their untouched gel in RGB: f32 (n, 24 * 32 * 3) in -1..1.

    Raises UserError without one.
    """

    def prepare(image: Array) -> tuple[Array, float]:
        return _small(image), image.shape[1] / image.shape[0]

    read = _pair_reader(table, backgrounds or Backgrounds(table), prepare)
    values = np.zeros((len(rows), SMALL[0] * SMALL[1] * 3), np.float32)
    for place, row in enumerate(map(int, rows)):
        (frame, proportion), background = read(row)
        if background is None:
            raise UserError(f"{table.where(row)} has no image of the untouched gel. {ADVICE}")
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

    Only rows of train decide the directions, as a component of test rows would be fitted on test.
    Raises UserError without any.

    Args:
        features: f32 (n, d).
        train: bool (n,), rows that decide the directions.
        components: most directions.
        solver: of scikit-learn's PCA.
    """
    fitted = features[np.asarray(train, bool)]
    if not len(fitted):
        raise UserError("No row is marked as train. The principal components need some.")
    pca = PCA(min(components, *fitted.shape), svd_solver=solver, random_state=0)
    return np.asarray(pca.fit(fitted).transform(features), np.float32)


def _small(image: Array) -> Array:
    """Return area averages, f32 (24 * 32 * 3,) in 0..1, of an image u8 (h, w, 3)."""
    return cv2.resize(
        image.astype(np.float32) / 255, SMALL[::-1], interpolation=cv2.INTER_AREA
    ).ravel()


def pixel_components(store: FeatureStore, rows: TaskRows) -> Array:
    """Return the principal components of raw pixels, fitted on the rows of train.

    Where there are none, as where groups are left out in turn, all rows decide them.
    """
    train = rows.split == "train"
    if not train.any():
        train = ~train
    return principal_components(store.get(rows.rows, 1), train)


class FeatureSource(NamedTuple):
    """Features with their name, and how a probe treats them.

    `encoder` is None for a features file and for raw pixels. `scaling` is that of a linear head.
    "common" says too that the features are pixels, of which principal components are probed. A
    `is_control` is what a user would compare with.
    """

    name: str
    store: FeatureStore
    encoder: Encoder | None = None
    scaling: Scaling = "column"
    is_control: bool = False

    def notes(self, sensors: Array) -> list[str]:
        """Return a note on sensors that the encoder was not trained on, or nothing."""
        if self.encoder is None:
            return []
        trained = self.encoder.trained_sensors
        if trained is None:
            trained = self.encoder.config.model.sensors
        unknown = sorted(set(sensors) - set(trained))
        if unknown:
            return [f"universal tokens for {', '.join(unknown)}"]
        return []
