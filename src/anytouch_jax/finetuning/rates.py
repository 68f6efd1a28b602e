"""Learning rates by depth: the nearer a parameter is to the features, the faster it is trained."""

from __future__ import annotations

import re

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.config import ModelConfig
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.finetuning.options import Recipe

HEAD = "head"  # name of the head among the parameters


def depth_factor(
    name: str, shape: tuple[int, ...], recipe: Recipe, model: ModelConfig, depths: dict[str, int]
) -> jax.Array | float:
    """Return the factor on the learning rate of a parameter.

    It is a number, or for stacked blocks (L, 1, ...) one for each. Every trunk is treated alike:
    its last block has 1, each block before it `depth_decay` times the next, and what lies before
    the blocks that of the first block times `depth_decay`. What lies behind them has 1.

    Args:
        name: of the parameter, parts joined by "/".
        shape: its shape.
        recipe: the rates.
        model: of the encoder, whose blocks are stacked.
        depths: the number of blocks of each other trunk, see `trunk_depths`.
    """
    if name.startswith(f"{HEAD}/"):
        return recipe.head_rate / recipe.rate
    trunk, number = trunk_of(name)
    if trunk in depths:
        return recipe.depth_decay ** (depths[trunk] - 1 - number)
    for other, count in depths.items():
        # what lies beside the blocks of a trunk, such as its stem, comes before them
        if name.startswith(other.rpartition("/")[0] + "/"):
            return recipe.depth_decay**count
    depth = model.touch.depth
    if name.startswith("touch/blocks/"):
        each = recipe.depth_decay ** jnp.arange(depth - 1, -1, -1.0)
        return jnp.expand_dims(each, range(1, len(shape)))
    if re.match(r"touch/(patch|class_token|position|pre_norm)\b", name):
        return recipe.depth_decay**depth
    return 1.0


def steadiness(mean: Array, scale: Array) -> float:
    """Return how much of the size of features varies, 0..1, the median over features.

    Where features of all touches are nearly equal, their differences are magnified for the head,
    and so is every change of the encoder. Its rate is multiplied by this, and a head is not upset.
    """
    return float(np.median(scale / np.sqrt(mean**2 + scale**2)))


def trunk_of(name: str) -> tuple[str, int]:
    """Return the trunk and the number of the block that a parameter belongs to.

    Blocks of a trunk are numbered in their names, as in touch/sight/block3/kernel. ("", 0) is a
    parameter of no numbered block.
    """
    found = re.match(r"(.*?)(\d+)(?=/)", name)
    if found is None or name.startswith("touch/blocks/"):
        return "", 0
    return found[1], int(found[2])


def trunk_depths(names: list[str]) -> dict[str, int]:
    """Return the number of blocks of each trunk whose blocks are numbered."""
    depths: dict[str, int] = {}
    for name in names:
        trunk, number = trunk_of(name)
        if trunk:
            depths[trunk] = max(depths.get(trunk, 0), number + 1)
    return depths
