"""Simulated touches of your own sensor and of known ones: for its image, and for its tokens."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import jax
import numpy as np

from anytouch_jax.config import SimulatedConfig
from anytouch_jax.data.images import encode
from anytouch_jax.files import atomic_write
from anytouch_jax.sim import endless
from anytouch_jax.sim.endless import CAMERAS, Sampling, SimulatedTouches, World
from anytouch_jax.sim.recorder import RELIEF, ball
from anytouch_jax.sim.scene import training_scenes

Array = np.ndarray
OBJECTS = 160  # of a world
COUNT = 24  # touches of a batch, each by a known sensor and by yours
SIZE = 112  # pixels of a side
FOLDS = 5
COLUMNS = 6  # of the image
TILE = 150  # pixels of an image's height in it

sample = jax.jit(endless.sample_touches, static_argnames=("sampling", "count"))


def own_world(
    sensor: str | Path,
    split: Literal["train", "test"],
    known: Sequence[str] = CAMERAS,
    ball_mm: float | None = None,
) -> World:
    """Return the world of your sensor (family 0) and of the `known` ones.

    Its objects are those of a split of the usual training, so the encoder of the package has seen
    no object of split test.

    Args:
        sensor: Folder of your sensor.
        split: Of the usual training, whose objects are touched.
        known: Names of sensors of the table.
        ball_mm: Diameter, if all objects shall be balls.
    """
    scenes = training_scenes(SimulatedConfig())
    things = endless.objects_of(scenes, split, variants=2)[:OBJECTS]
    world = endless.make_world(things, (str(sensor), *known))
    if ball_mm is not None:
        # Around the ball there is a floor at the height of its middle.
        edge = RELIEF // 4
        one = np.pad(ball(ball_mm, RELIEF - 2 * edge), edge, constant_values=-ball_mm / 2)
        world = world._replace(relief=np.broadcast_to(one.astype(np.float16), world.relief.shape))
    return jax.device_put(world)


def own_touches(key: Any, world: World, *, size: int = SIZE) -> SimulatedTouches:
    """Return COUNT touches of `world`. The second take of each is by family 0, your sensor."""
    return sample(key, world, sampling=Sampling(takes=2, size=size), count=COUNT, gallery=0)


def compare(
    frames: Array,
    gel: Array,
    sensor: str | Path,
    out: Path,
    *,
    ball_mm: float | None = None,
    seed: int = 0,
) -> float:
    """Write an image of real frames above simulated ones, and measure how different they are.

    Args:
        frames: Real frames u8 (N, h, w, 3) of presses.
        gel: Their background u8 (h, w, 3).
        sensor: The folder NAME.sensor.
        out: The image to write.
        ball_mm: Diameter of the ball, if all presses are of one.
        seed: Of the simulated touches and of the classifier's folds.

    Returns:
        The fraction of held-out images that a linear classifier names rightly as real or
        simulated: 0.5 is chance.
    """
    world = own_world(sensor, "train", ball_mm=ball_mm)
    count = min(len(frames), 2 * COUNT)
    real = frames[np.unique(np.linspace(0, len(frames) - 1, count).astype(int))]
    parts = [
        jax.device_get(own_touches(jax.random.fold_in(jax.random.key(seed), n), world))
        for n in range(-(-len(real) // COUNT))
    ]
    made = np.concatenate([part.clip[:, 1, -1] for part in parts])[: len(real)]
    behind = np.concatenate([part.background[:, 1] for part in parts])[: len(real)]
    atomic_write(out, encode(_image(real, made)))
    # Changes are compared, and not images: the backgrounds of units differ more than their dents.
    real_changes = [_small(frame) - _small(gel) for frame in real]
    made_changes = [a.astype(np.float32) - b for a, b in zip(made, behind, strict=True)]
    return separable(real_changes, made_changes, seed)


def _small(image: Array) -> Array:
    """Return an image f32 in the size of the simulated ones."""
    return cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA).astype(np.float32)


def _image(real: Array, made: Array) -> Array:
    """Return two rows of real images above two rows of simulated ones, u8."""
    wide = round(TILE * real.shape[2] / real.shape[1])
    rows = []
    for group in (real, made):
        chosen = group[np.linspace(0, len(group) - 1, 2 * COLUMNS).astype(int)]
        tiles = [cv2.resize(one, (wide, TILE), interpolation=cv2.INTER_AREA) for one in chosen]
        rows += [np.concatenate(tiles[first : first + COLUMNS], 1) for first in (0, COLUMNS)]
    line = np.full((6, rows[0].shape[1], 3), 255, np.uint8)
    return np.concatenate([*rows[:2], line, *rows[2:]])


def separable(real: list[Array], made: list[Array], seed: int = 0) -> float:
    """Return the fraction of changes f32 (h, w, 3) that a classifier names rightly, held out.

    It is a ridge classifier on a few statistics of each, in FOLDS folds.
    """
    rows = np.stack([_statistics(one) for one in (*real, *made)])
    kind = np.repeat([1.0, -1.0], [len(real), len(made)])
    order = np.random.default_rng(seed).permutation(len(rows))
    right = []
    for fold in range(FOLDS):
        test = order[fold::FOLDS]
        train = np.setdiff1d(order, test)
        middle = rows[train].mean(0)
        scale = rows[train].std(0) + 1e-6
        x = (rows[train] - middle) / scale
        y = kind[train]
        # There are about as many images as statistics, so the penalty is a strong one.
        weights = np.linalg.solve(x.T @ x + 10.0 * np.eye(x.shape[1]), x.T @ (y - y.mean()))
        guess = ((rows[test] - middle) / scale) @ weights + y.mean()
        right.append(np.sign(guess) == kind[test])
    return float(np.concatenate(right).mean())


def _statistics(change: Array) -> Array:
    """Return means, tails and detail at three scales of a change f32 (h, w, 3), and its colours."""
    parts: list[Array] = [change.mean((0, 1)), *np.percentile(change, (2, 10, 90, 98), axis=(0, 1))]
    for blur in (0.0, 1.5, 4.0):
        one = cv2.GaussianBlur(change, (0, 0), blur) if blur else change
        parts.append(np.log(1e-2 + np.abs(np.diff(one, axis=0)).mean((0, 1))))
        parts.append(np.log(1e-2 + np.abs(np.diff(one, axis=1)).mean((0, 1))))
    # Correlations of the colours. The unit on the diagonal keeps those of a flat image finite.
    colours = np.cov(change.reshape(-1, 3).T) + np.eye(3)
    deviation = np.sqrt(np.outer(np.diag(colours), np.diag(colours)))
    parts.append((colours / deviation)[np.triu_indices(3, 1)])
    return np.concatenate(parts)
