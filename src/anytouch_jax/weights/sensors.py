"""Sensor tokens by name: those of a file or run for another table, and what serves sensors that training never saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from anytouch_jax.config import SENSORS, UNIVERSAL, Config, ModelConfig
from anytouch_jax.weights.detect import MODEL_KEY, SEEN_KEY

Params = dict[str, Any]
RELEASED = SENSORS[:5]  # what the authors' weights were trained on, beside the universal tokens


def seen_by_file(metadata: Mapping[str, str], model: ModelConfig) -> tuple[str, ...] | None:
    """The sensors that AnyTouch weights were trained on: as their metadata tells, as that of `anytouch convert` does,
    else the authors' for a file of no metadata of ours and of their table, else None (nothing tells)."""
    if SEEN_KEY in metadata:
        return tuple(metadata[SEEN_KEY].split(","))
    return RELEASED if MODEL_KEY not in metadata and model.sensors == SENSORS else None


def match_sensors(tokens: np.ndarray, stored: Sequence[str], wanted: Sequence[str]) -> np.ndarray:
    """Sensor tokens (R, 5, D) of the table `stored`, rearranged by name for `wanted`.

    A sensor that is not stored starts from the universal tokens, which were trained to serve it.
    """
    return np.stack([tokens[stored.index(name if name in stored else UNIVERSAL)] for name in wanted])


def serve_unseen(touch: Params, model: ModelConfig, seen: Sequence[str], *, universal_drawn: bool) -> Params:
    """A touch encoder whose rows of sensors never `seen` in training are the universal ones (Sec. 3.5: at inference).

    Where training never drew the universal row either (`universal_drawn`), that row is the mean of those seen. Covers
    the sensor tokens, and the patch kernels where each sensor has its own.
    """
    rows = [row for row, name in enumerate(model.sensors) if name in seen and name != UNIVERSAL]
    unseen = [row for row in range(len(model.sensors)) if row not in rows]
    if not rows:
        return touch

    def served(table: np.ndarray) -> np.ndarray:
        table = np.array(table)
        table[unseen] = table[model.universal_row] if universal_drawn else table[rows].mean(axis=0)
        return table

    touch = touch | {"sensor_tokens": served(touch["sensor_tokens"])}
    if model.patch_encoder == "sensor":
        touch |= {"patch": {"kernel": served(touch["patch"]["kernel"])}}
    return touch


def served(params: Params, config: Config, told: Mapping[str, Any]) -> Params:
    """The parameters of a run as they are used: sensors that it never saw (its metadata `told`) by `serve_unseen`."""
    if "touch" not in params or "seen" not in told:
        return params
    drawn = config.objective.universal_start + config.objective.universal_end > 0
    return params | {"touch": serve_unseen(params["touch"], config.model, told["seen"], universal_drawn=drawn)}
