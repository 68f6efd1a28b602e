"""Force labels of stage 1: the force at the last frame that the encoder sees, and its change since the first one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.config import Config
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.errors import UserError

COLUMN = "label.force"
UNKNOWN = np.float32(np.nan)


class Force(NamedTuple):
    """`newton` f32 (rows of the manifest,), NaN where it is not known; `mean` and `spread` (standard deviation) of it
    over the split; `change_spread`, that of its change over the split's clips; `frames` that the encoder sees."""

    newton: np.ndarray
    mean: float
    spread: float
    change_spread: float
    frames: int

    def of(self, rows: np.ndarray) -> tuple[float, float]:
        """Force and change, in spreads, of a window of rows (a still: of one; a frame after those seen is not read).

        The change of a still is NaN: not known.
        """
        seen = self.newton[rows[: self.frames]]
        change = (seen[-1] - seen[0]) / self.change_spread if len(rows) > 1 else UNKNOWN
        return float((seen[-1] - self.mean) / self.spread), float(change)


def find_force(manifest: Manifest, config: Config, rows: np.ndarray, clips: np.ndarray | None) -> Force | None:
    """The labels of a run with `objective.force`, None for another run; `clips` i64 (windows, T) of the split.

    Raises UserError: no force head, no column, no known force among `rows` i64, or only one value of it.
    """
    if not config.objective.force or config.stage != 1:
        return None
    if not config.model.force_head:
        raise UserError("objective.force needs the network's head for it: set --model.force-head too")
    if COLUMN not in manifest.table.column_names:
        raise UserError(f"objective.force needs the column {COLUMN!r} (newtons), which the manifest lacks")
    try:
        newton = np.asarray(pc.fill_null(manifest.column(COLUMN).cast(pa.float32()), UNKNOWN))
    except pa.ArrowException:
        raise UserError(f"objective.force needs numbers (newtons) in the column {COLUMN!r}") from None
    known = newton[rows][np.isfinite(newton[rows])].astype(np.float64)
    if not known.size or known.std() == 0:
        raise UserError(
            f"objective.force: split {config.data.split!r} has {len(set(known))} value(s) of {COLUMN!r}; two are needed"
        )
    frames, spread = config.model.frames, float(known.std())
    changes = np.zeros(0) if clips is None else newton[clips[:, frames - 1]] - newton[clips[:, 0]]
    changes = changes[np.isfinite(changes)].astype(np.float64)
    change_spread = float(changes.std()) if changes.size else 0.0
    return Force(newton, float(known.mean()), spread, change_spread or spread, frames)
