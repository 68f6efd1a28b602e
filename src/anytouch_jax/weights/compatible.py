"""Compatibility of weights with a model: checks of its form, resized positions, sensor rows by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import UNIVERSAL, Config, ModelConfig
from anytouch_jax.errors import UserError
from anytouch_jax.nn.vit import cubic

Params = dict[str, Any]

# Settings that must be equal: some leave no trace in shapes.
_FORM: tuple[str, ...] = ("patch", "patch_encoder", "embed", "frames", "sensor_tokens")
_FORM += tuple(f"{tower}.{size}" for tower in ("touch", "decoder") for size in ("width", "depth", "mlp"))
_FORM += ("touch.heads", "decoder.heads", "norm_eps", "decoder_norm_eps", "pre_norm")


def check_activation(path: Path, trained: str | None, config: Config) -> None:
    """Raise UserError if weights were trained with another activation than the run's; None means unknown."""
    ours = config.model.activation
    if trained not in (None, ours):
        raise UserError(
            f"{path} was trained with {trained}, this run would use {ours}: add --model.activation {trained}"
        )


def check_form(path: Path, before: ModelConfig, config: Config, preset: str = "custom") -> None:
    """Raise UserError with the missing options if weights, of this preset, belong to another network than the run's."""
    pairs = {name: tuple(attrgetter(name)(model) for model in (before, config.model)) for name in _FORM}
    differing = {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
    if not differing:
        return
    trained = ", ".join(f"{name} {theirs}" for name, (theirs, _) in differing.items())
    used = ", ".join(str(ours) for _, ours in differing.values())
    options = " ".join(_option(name.replace("_", "-"), theirs) for name, (theirs, _) in differing.items())
    if differing.keys() & {"touch.width", "touch.depth"} and preset not in (config.preset, "custom"):
        trained, used, options = f"preset {preset}", f"preset {config.preset}", f"--preset {preset}"
    raise UserError(f"{path} was trained with {trained}, this run would use {used}: add {options}")


def _option(name: str, value: Any) -> str:
    """Return the option that gives a setting of the model a value."""
    return f"--model.{name} {value}" if type(value) is not bool else f"--model.{'' if value else 'no-'}{name}"


def check_clip(path: Path, clip: ModelConfig, config: Config, *, touch: bool) -> None:
    """Raise UserError if CLIP's image tower has another size than the run's image tower or, with `touch`, encoder."""
    theirs = (clip.touch.width, clip.touch.depth, clip.patch)
    for name, stack in (("image tower", config.model.image), ("touch encoder", config.model.touch if touch else None)):
        if stack is None or (ours := (stack.width, stack.depth, config.model.patch)) == theirs:
            continue
        sizes = [f"width {width}, depth {depth} and patches of {patch}" for width, depth, patch in (theirs, ours)]
        raise UserError(
            f"the image tower in {path} has {sizes[0]}, this run's {name} {sizes[1]}: --preset large fits ViT-L/14, "
            "--preset base fits ViT-B/16; add the one that fits, or give other --clip-weights"
        )


def match_sensors(table: np.ndarray, stored: Sequence[str], wanted: Sequence[str]) -> np.ndarray:
    """Return a table with one row a sensor (R, ...), its rows rearranged by name from `stored` to `wanted`.

    A sensor that is not stored starts from the universal row, which was trained to serve it.
    """
    return np.stack([table[stored.index(name if name in stored else UNIVERSAL)] for name in wanted])


def map_sensors(touch: Params, model: ModelConfig, change: Callable[[np.ndarray], np.ndarray]) -> Params:
    """Return a touch encoder with its tables of sensors changed: the tokens, and the patch kernels if each has one."""
    changed: Params = {"sensor_tokens": change(np.asarray(touch["sensor_tokens"]))}
    if model.patch_encoder == "sensor":
        changed["patch"] = {"kernel": change(np.asarray(touch["patch"]["kernel"]))}
    return touch | changed


def serve_unseen(touch: Params, model: ModelConfig, trained: Sequence[str], *, universal_drawn: bool) -> Params:
    """Return a touch encoder in which sensors outside `trained` have the universal row (Sec. 3.5, at inference).

    Where training never drew the universal row (`universal_drawn`), the mean of the trained rows replaces it.
    """
    rows = [row for row, name in enumerate(model.sensors) if name in trained and name != UNIVERSAL]
    unseen = [row for row in range(len(model.sensors)) if row not in rows]
    if not rows:
        return touch

    def served(table: np.ndarray) -> np.ndarray:
        table = np.array(table)
        table[unseen] = table[model.universal_row] if universal_drawn else table[rows].mean(axis=0)
        return table

    return map_sensors(touch, model, served)


def resize_position(table: np.ndarray, rows: int) -> np.ndarray:
    """Return a (1 + M, D) table of a square grid resized to (`rows`, D); row 0, the class token's, is unchanged.

    Equal to torch's `interpolate(mode="bicubic", align_corners=False, antialias=False)`, computed in float64.
    Raises ValueError if either grid is not square.
    """
    old, new = math.isqrt(len(table) - 1), math.isqrt(rows - 1)
    if old**2 != len(table) - 1 or new**2 != rows - 1 or not old or not new:
        raise ValueError(f"a position table of {len(table)} rows cannot become {rows}: the grids must be square")
    weights = cubic(old, new)
    grid = table[1:].astype(np.float64).reshape(old, old, -1)
    grid = np.einsum("ij,jkd->ikd", weights, grid)
    grid = np.einsum("kl,ild->ikd", weights, grid)
    return np.concatenate([table[:1], grid.reshape(new * new, -1).astype(table.dtype)])
