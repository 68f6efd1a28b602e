"""Names of live touch by a head, and the nearest touches."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from anytouch_jax.encoder.arrays import Array, unit_rows
from anytouch_jax.encoder.calibration import support
from anytouch_jax.encoder.number_head import NumberHead

if TYPE_CHECKING:
    from anytouch_jax.encoder.linear_head import Head
    from anytouch_jax.live.page.feature_map import FeatureMap

_SEARCH = 0.5  # seconds between searches for the nearest touches


def name_touch(head: Head | None, values: Array) -> dict[str, Any]:
    """Return the name of features (E,), and whether to believe it.

    `p` is never more than the recordings of the head support. Without a `limit` there are too few
    of them to tell anything new.
    """
    if head is None:
        return {}
    if isinstance(head, NumberHead):
        return _number(head, values)
    if head.calibration is None:
        (label,), p = head(values[None])
        return {"label": str(label), "p": round(float(p.max()), 3)}
    one = head.assess(values[None])
    limit = head.calibration.novelty_limit
    return {
        "label": str(one.label[0]),
        # A touch far from all others is far from the borders between classes, too.
        "p": round(min(float(one.p.max()), support(head.calibration.recordings)), 3),
        "recordings": head.calibration.recordings,
        "novel": bool(one.novel[0]),
        "set": head.classes[one.in_set[0]].tolist(),
        "novelty": round(float(one.novelty[0]), 3),
        # JSON has no infinity: of few recordings nothing is novel.
        "limit": round(limit, 3) if limit < 1e9 else None,
    }


def _number(head: NumberHead, values: Array) -> dict[str, Any]:
    """Return the number of features (E,) as a name, with half of its interval."""
    one = head.assess(values[None])
    half = float(one.high[0] - one.value[0])
    name = f"{head.label} {one.value[0]:.3g}"
    if np.isfinite(half):
        name += f" ± {half:.2g}"
    return {"label": name, "novel": bool(one.novel[0])}


class NearestTouches:
    """The nearest known touches, searched for at most every half second."""

    def __init__(self) -> None:
        self._found: dict[str, Any] = {}
        self._at = 0.0

    def __call__(self, values: Array, spaces: dict[str, FeatureMap | None]) -> dict[str, Any]:
        """Return the nearest touches to features (E,) in each space that there is, by its name."""
        if time.perf_counter() - self._at > _SEARCH:
            unit = unit_rows(values[None])[0]
            self._found = {}
            for name, space in spaces.items():
                if space is not None:
                    self._found[name] = space.near(unit, count=5)
            self._at = time.perf_counter()
        return self._found
