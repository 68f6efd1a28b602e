"""Real recordings on the device, next to simulated touches.

A batch is put together on the device. So all frames of the training split are there, at the
model's size, and a batch takes rows of them.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from anytouch_jax.config import Config
from anytouch_jax.data.loading.pools import MatchPool, Pools, epoch_weights, find_pools
from anytouch_jax.data.loading.samples import SampleReader, read_image
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.transforms import touch_evaluation
from anytouch_jax.errors import UserError
from anytouch_jax.sim.draws import Leaf

MOST_PIXELS = 4_000_000_000  # bytes of real frames that are kept on the device


class Windows(NamedTuple):
    """Stills or clips of real frames."""

    rows: Leaf  # i32 (W, T)
    fraction: Leaf  # f32 (W,) cumulative probability


class Pairs(NamedTuple):
    """Stills or clips of places that others touched too.

    Those of one place are neighbours in `order`: those of touch n are the `many[n]` from `low[n]`.
    """

    rows: Leaf  # i32 (W, T)
    fraction: Leaf  # f32 (W,) cumulative probability
    order: Leaf  # i32 (W,)
    low: Leaf  # i32 (W,)
    many: Leaf  # i32 (W,)
    place: Leaf  # i32 (W,)
    unit: Leaf  # i32 (W,)


class Real(NamedTuple):
    """Real frames on the device.

    `windows` and `pairs` have an entry for stills and one for clips, or None.
    """

    frame: Leaf  # u8 (N, S, S, 3)
    # u8 (G, 2, S, S, 3): the stored image of the untouched gel, and the median of the unit
    gel: Leaf
    gel_of: Leaf  # i32 (N,)
    sensor: Leaf  # i32 (N,)
    caption: Leaf  # i32 (N,), -1 without
    windows: tuple[Windows | None, ...]
    pairs: tuple[Pairs | None, ...]


def load_real(manifest: Manifest, config: Config, log: Callable[[str], None]) -> Real:
    """Return the real frames of the training split on the device.

    Raises UserError if they are too many.
    """
    plain = config.with_settings({"data.background": "keep"})
    pools: Pools = find_pools(manifest, plain.with_settings({"data.tokenizer": None}), None, 1)
    for note in pools.notes:
        log(note)
    size = config.model.image_size
    windows = [pool.windows for pool in pools.touch]
    windows += [pool.windows for pool in pools.match if pool is not None]
    rows = np.unique(np.concatenate([part.ravel() for part in windows]))
    if len(rows) * size * size * 3 > MOST_PIXELS:
        raise UserError(
            f"{len(rows)} real frames of {size} x {size} pixels do not fit on the device next to "
            "simulated touches; give fewer recordings, or train on them without `simulated`"
        )
    # From a row of the manifest to its place on the device.
    place = np.full(len(manifest), -1, np.int32)
    place[rows] = np.arange(len(rows))
    reader = SampleReader(manifest, plain)
    frame = np.concatenate([reader.touch(row[None], None) for row in rows])
    backgrounds, gel_of = _real_backgrounds(manifest, rows, frame, size)
    texts = manifest.column("text").combine_chunks().dictionary_encode()
    caption = texts.indices.fill_null(-1).to_numpy(False)[rows].astype(np.int32)
    weights, _ = epoch_weights(manifest, config, rows)
    if weights is None:
        weights = np.ones(len(manifest))
    kinds: list[Windows | None] = [
        Windows(place[pool.windows], _cumulative(weights[pool.windows[:, -1]]))
        for pool in pools.touch
    ]
    kinds += [None] * (2 - len(kinds))
    real = Real(
        frame=frame,
        gel=backgrounds,
        gel_of=gel_of,
        sensor=pools.sensor[rows].astype(np.int32),
        caption=caption,
        windows=tuple(kinds),
        pairs=tuple(_pairs(manifest, match, place, weights) for match in pools.match),
    )
    return jax.device_put(real)


def _real_backgrounds(
    manifest: Manifest, rows: np.ndarray, frame: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return images of untouched gels u8 (G, 2, S, S, 3), and the number of each row's.

    A gel has its stored image and the median of its unit, which is both where none is stored.
    """
    stored = manifest.codes("background_path")[rows]
    unit = manifest.codes("unit")[rows]
    sensor = manifest.codes("sensor")[rows]
    # Rows without a unit belong to one of their sensor.
    owner = np.where(unit >= 0, unit, -1 - sensor)
    _, first, group = np.unique(
        np.stack([owner, stored]), axis=1, return_index=True, return_inverse=True
    )
    medians = dict[int, np.ndarray]()
    backgrounds = []
    for place in first:
        own = int(owner[place])
        if own not in medians:
            same = np.flatnonzero(owner == own)
            # Some 300 frames are enough for a median.
            some = frame[same[:: max(1, len(same) // 300)]]
            medians[own] = np.median(some, axis=0).astype(np.uint8)
        shown = medians[own]
        if stored[place] >= 0:
            image = read_image(manifest, int(rows[place]), "background_path")
            shown = touch_evaluation([image], size)[0]
        backgrounds.append(np.stack([shown, medians[own]]))
    return np.stack(backgrounds), group.ravel().astype(np.int32)


def _cumulative(weights: np.ndarray) -> np.ndarray:
    """Return cumulative probabilities f32 of weights."""
    return (np.cumsum(weights) / weights.sum()).astype(np.float32)


def _pairs(
    manifest: Manifest, match: MatchPool | None, place: np.ndarray, weights: np.ndarray
) -> Pairs | None:
    """Return the windows of a pool for matching, sorted by place."""
    if match is None:
        return None
    windows = match.windows[match.matches.anchors]
    last = windows[:, -1]
    touch = manifest.codes("touch", own=True)[last]
    order = np.argsort(touch, kind="stable")
    low = np.searchsorted(touch[order], touch)
    count = np.searchsorted(touch[order], touch, side="right") - low
    return Pairs(
        rows=place[windows],
        fraction=_cumulative(weights[last]),
        order=order.astype(np.int32),
        low=low.astype(np.int32),
        many=count.astype(np.int32),
        place=touch.astype(np.int32),
        unit=manifest.codes("unit")[last].astype(np.int32),
    )
