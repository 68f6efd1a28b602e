"""A loader that keeps the pictures in the memory of the accelerator, and augments them there.

Reading and decoding cost more than a step of a small network on a GPU. Here each frame is read once. The rows of a
step are those of `Loader`. Its partners of matching and its augmentation are drawn in another way. Flips and affine
maps are those of the configuration. Colours are not jittered, and a photograph has VIEWS fixed views.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import lru_cache, partial
from multiprocessing import get_context
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates

from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import Config
from anytouch_jax.data.loading.loader import Batch, Info, Loader
from anytouch_jax.data.loading.pools import MatchPool, Pool
from anytouch_jax.data.loading.samples import SampleReader
from anytouch_jax.data.loading.sampling import BOTH, TEXT, VISION
from anytouch_jax.data.manifest import manifest as manifests

VIEWS = 4  # views of each photograph
TRIES = 32  # draws in which a partner is looked for
CHUNK = 256  # rows that a process reads at a time


class ResidentLoader(Loader):
    """`Loader` with its pictures on the device. `processes` processes read them, once."""

    processes = 2

    def __init__(self, manifest: manifests.Manifest, config: Config, **options: Any) -> None:
        super().__init__(manifest, config, **options)
        windows = [pool.windows.ravel() for pool in (*self._pools, *(pool for pool in self._match_pools if pool))]
        rows = np.unique(np.concatenate(windows))
        self._place = np.full(len(manifest), -1, np.int32)
        self._place[rows] = np.arange(len(rows))
        with_image = [
            pool.windows[ids, -1] for pool in self._pools for ids in (pool.members[VISION], pool.members[BOTH])
        ]
        photo_rows = np.concatenate([*with_image, np.empty(0, np.int64)])
        codes = manifest.codes("image_path")
        _, first, which = np.unique(codes[photo_rows], return_index=True, return_inverse=True)
        self._photo = np.full(len(manifest), -1, np.int32)
        self._photo[photo_rows] = which
        self._frames = jax.device_put(read_all(config, rows, None, self.processes))
        views = [read_all(config, photo_rows[first], view, self.processes) for view in range(VIEWS)]
        self._photos = jax.device_put(np.stack(views, 1))
        self._key = jax.random.key(config.run.seed)
        self._captions, self._caption = self._encode_captions()

    def _encode_captions(self) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Return the tokens and masks of all captions, the empty one last, and the caption of each row."""
        column = self.manifest.column("text").combine_chunks().dictionary_encode()
        if self.tokenizer is None:
            return (np.zeros((1, 0), np.int32), np.zeros((1, 0), bool)), np.zeros(len(self.manifest), np.int64)
        words = [str(text) for text in column.dictionary.to_pylist()]
        return self.tokenizer.encode([*words, ""], self._text_length), column.indices.fill_null(-1).to_numpy(False)

    def stream(self, start: int, stop: int) -> Iterator[tuple[int, Batch, Info]]:
        """Yield (step, batch on the device, info) for steps start .. stop - 1."""
        for step in range(start, stop):
            align, info = self._draw_align(step)
            if self.config.stage == 1:
                yield step, TouchBatch(align.clip, align.sensor), info
            else:
                yield step, Stage2Batch(align, self._draw_match(step)), info

    def _touches(self, windows: np.ndarray, step: int, part: int) -> jax.Array:
        """Return augmented clips u8 (B, T, H, W, 3) of windows of rows (B, T)."""
        data = self.config.data
        rows = self._place[windows]
        return gather(self._frames, rows, self._key, step, part, flip=data.flip, affine=data.affine)

    def _draw_align(self, step: int) -> tuple[AlignBatch, Info]:
        kind, rank = self._align.at(step)
        pool: Pool = self._pools[kind]
        before, counts = pool.quota.at(rank)
        ids, strata = [], []
        for stratum, sampler in enumerate(pool.samplers):
            draws = sampler.take(int(before[stratum]), int(counts[stratum]))
            ids += [int(pool.members[stratum][item]) for item, _ in draws]
            strata += [stratum] * len(draws)
        windows = pool.windows[ids]
        last, stratum_of, size = windows[:, -1], np.array(strata), len(ids)
        with_image = np.flatnonzero(np.isin(stratum_of, (VISION, BOTH)))
        with_text = np.flatnonzero(np.isin(stratum_of, (BOTH, TEXT)))
        image_row = np.full(pool.quota.images, size, np.int32)
        text_row = np.full(pool.quota.texts if self.tokenizer is not None else 0, size, np.int32)
        image_row[: len(with_image)], text_row[: len(with_text)] = with_image, with_text
        rng = np.random.default_rng([self._seed, step])
        photo = np.zeros((len(image_row), 2), np.int32)
        photo[: len(with_image), 0] = self._photo[last[with_image]]
        photo[:, 1] = rng.integers(VIEWS, size=len(photo))
        caption = np.full(len(text_row), -1)
        caption[: len(with_text)] = self._caption[last[with_text]]
        batch = AlignBatch(
            self._touches(windows, step, 0), self._sensor[last].astype(np.int32), take(self._photos, photo), image_row,
            self._captions[0][caption], self._captions[1][caption], text_row,
        )  # fmt: skip
        return batch, {"images": len(with_image), "texts": len(with_text), "skipped_samples": 0}

    def _draw_match(self, step: int) -> MatchBatch | None:
        kind, rank = self._match.at(step)
        pool: MatchPool | None = self._match_pools[kind] if kind >= 0 else None
        if pool is None:
            return None
        rows = self._match_size
        anchors = pool.matches.anchors[[item for item, _ in pool.anchors.take(rank * rows, rows)]]
        gallery = self._gallery_sensor(step, pool)
        positives = partners(
            pool, anchors, -1 if gallery is None else gallery, np.random.default_rng([self._seed, step, 1])
        )
        last = pool.windows[:, -1]
        swap = self._sensor[last[anchors]] == gallery
        first, second = np.where(swap, positives, anchors), np.where(swap, anchors, positives)
        place = pool.matches._keys.touch[last[anchors]].astype(np.int32)
        return MatchBatch(
            self._touches(pool.windows[first], step, 1), self._sensor[last[first]].astype(np.int32),
            self._touches(pool.windows[second], step, 2), self._sensor[last[second]].astype(np.int32), place=place,
        )  # fmt: skip


def partners(pool: MatchPool, anchors: np.ndarray, gallery: int, rng: np.random.Generator) -> np.ndarray:
    """Return a touch of each anchor's place by another sensor, `gallery` if it touched it, or else by another unit.

    The best of TRIES draws is taken. An anchor for which they find none is its own partner.
    """
    matches, keys = pool.matches, pool.matches._keys
    row = matches.pool[anchors]
    low = np.searchsorted(matches._sorted, keys.touch[row])
    count = np.searchsorted(matches._sorted, keys.touch[row], side="right") - low
    tries = matches._order[low[:, None] + (rng.random((len(anchors), TRIES)) * count[:, None]).astype(np.int64)]
    other = matches.pool[tries]
    sensor, unit = keys.sensor[other] != keys.sensor[row][:, None], keys.unit[other] != keys.unit[row][:, None]
    score = 4 * (sensor & (keys.sensor[other] == gallery)) + 2 * sensor + (unit & (keys.unit[other] >= 0))
    best = score.argmax(1)
    return np.where(score.max(1) > 0, tries[np.arange(len(anchors)), best], anchors)


@partial(jax.jit, static_argnames=("flip", "affine"))
def gather(
    frames: jax.Array, rows: jax.Array, key: jax.Array, step: int, part: int, *,
    flip: float, affine: tuple[float, ...],
) -> jax.Array:  # fmt: skip
    """Return frames u8 (B, T, H, W, 3) of `rows` (B, T), with one flip and one affine map for each clip.

    The draws depend on `step` and on `part`, the number of the array in its batch.
    """
    clip = frames[rows]
    toss, turn = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, step), part))
    across, down = jax.random.bernoulli(toss, flip, (2, len(rows), 1, 1, 1, 1))
    clip = jnp.where(across, clip[:, :, :, ::-1], clip)
    clip = jnp.where(down, clip[:, :, ::-1], clip)
    if not any(affine):
        return clip
    return jax.vmap(partial(_warp, affine=affine))(clip, jax.random.uniform(turn, (len(rows), 4), minval=-1.0))


def _warp(clip: jax.Array, draw: jax.Array, affine: tuple[float, ...]) -> jax.Array:
    """Turn, zoom and shift a clip u8 (T, H, W, 3) about its centre by shares `draw` (4,) of the largest amounts."""
    degrees, share, growth = affine
    angle, zoom = jnp.deg2rad(draw[0] * degrees), (1 + growth) ** draw[1]
    height, width = clip.shape[1:3]
    y, x = jnp.mgrid[:height, :width]
    y, x = y - (height - 1) / 2 - draw[2] * share * height, x - (width - 1) / 2 - draw[3] * share * width
    source = jnp.stack([jnp.cos(angle) * y - jnp.sin(angle) * x, jnp.sin(angle) * y + jnp.cos(angle) * x]) / zoom
    source = source + jnp.array([(height - 1) / 2, (width - 1) / 2])[:, None, None]
    planes = jnp.moveaxis(clip, -1, 1).reshape(-1, height, width).astype(jnp.float32)
    warped = jax.vmap(lambda plane: map_coordinates(plane, source, order=1, mode="mirror"))(planes)
    warped = jnp.round(warped).astype(jnp.uint8).reshape(clip.shape[0], 3, height, width)
    return jnp.moveaxis(warped, 1, -1)


@jax.jit
def take(pictures: jax.Array, at: jax.Array) -> jax.Array:
    """Return pictures u8 (N, H, W, 3) at `at` (N, 2): which picture, which view."""
    return pictures[at[:, 0], at[:, 1]] if pictures.shape[0] else jnp.zeros((len(at), *pictures.shape[2:]), jnp.uint8)


def read_all(config: Config, rows: np.ndarray, view: int | None, processes: int) -> np.ndarray:
    """Return the frames (`view` None) or the photographs of rows, u8 (rows, H, W, 3), read by several processes."""
    size = config.model.image_size
    out = np.empty((len(rows), size, size, 3), np.uint8)
    chunks = [slice(at, at + CHUNK) for at in range(0, len(rows), CHUNK)]
    with ExitStack() as stack:
        read = map
        if processes > 1 and chunks:
            read = stack.enter_context(ProcessPoolExecutor(processes, get_context("spawn"))).map
        for chunk, pictures in zip(chunks, read(partial(_read, config, view), [rows[c] for c in chunks]), strict=True):
            out[chunk] = pictures
    return out


def _read(config: Config, view: int | None, rows: np.ndarray) -> np.ndarray:
    """Return the pictures of a chunk of rows."""
    reader = _reader(config)
    if view is None:
        return np.concatenate([reader.touch(row[None], None) for row in rows])
    return np.stack([reader.vision(int(row), view) for row in rows])


@lru_cache(1)
def _reader(config: Config) -> SampleReader:
    """Return the reader of this process."""
    return SampleReader(manifests.read(config.data.manifests), config)
