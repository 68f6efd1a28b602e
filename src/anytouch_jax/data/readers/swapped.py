"""Which recordings have their touch and vision folders swapped."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from anytouch_jax.data.images import ImageError, decode

TOUCH_SIZE = {240, 320}  # a DIGIT's picture, upright or lying
THUMB = 16
MARGIN = 0.3  # of correlation, by which vision must look more like touch than touch does


def swapped(pairs: Mapping[str, tuple[Path, ...]]) -> set[str]:
    """The recordings whose picture (touch, vision) are the wrong way round; `pairs`: one of each a recording.

    By size, where only one of the two has a DIGIT's. Else by likeness: the median of all pictures said to be touch
    (of the same size class) stands for touch, and a recording is swapped when its vision correlates with it better by
    MARGIN than its touch. A recording whose pictures cannot be read is left as it is.
    """
    thumbs, turned, unclear = {}, set(), []
    for name, (touch, vision) in pairs.items():
        try:
            pictures = decode(touch), decode(vision)
        except ImageError:
            continue
        is_touch = [set(picture.shape[:2]) == TOUCH_SIZE for picture in pictures]
        if is_touch == [False, True]:
            turned.add(name)
        elif is_touch != [True, False]:
            unclear.append(name)
            thumbs[name] = tuple(_thumb(picture) for picture in pictures)
    if len(unclear) < 3:
        return turned  # a majority of two is none
    normal = np.median([thumbs[name][0] for name in unclear], axis=0).ravel()
    for name in unclear:
        likeness = [float(np.corrcoef(normal, thumb.ravel())[0, 1]) for thumb in thumbs[name]]
        if likeness[1] > likeness[0] + MARGIN:
            turned.add(name)
    return turned


def _thumb(picture: np.ndarray) -> np.ndarray:
    """Means over THUMB x THUMB cells, f32; an upright picture is laid down. A faint ramp keeps a flat one varied."""
    if picture.shape[0] > picture.shape[1]:
        picture = np.rot90(picture)
    rows = np.linspace(0, picture.shape[0] - 1, THUMB * 4).astype(int)
    cols = np.linspace(0, picture.shape[1] - 1, THUMB * 4).astype(int)
    cells = picture[rows][:, cols].astype(np.float32).reshape(THUMB, 4, THUMB, 4, 3).mean(axis=(1, 3))
    return cells + np.linspace(0, 1e-3, cells.size, dtype=np.float32).reshape(cells.shape)
