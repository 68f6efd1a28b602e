"""Nested dicts of arrays and their flat form, a dict from "touch/blocks/norm1/scale" to the array."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from anytouch_jax.errors import UserError


def flatten(tree: Any, is_leaf: Callable[[Any], bool] | None = None) -> dict[str, Any]:
    """Leaves of a pytree by name, the path joined with "/" (keys, field names, indices).

    Raises UserError when two leaves get the same name.
    """
    flat: dict[str, Any] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree, is_leaf=is_leaf)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        if name in flat:
            raise UserError(f"two arrays of the tree are called {name!r}; rename one of them")
        flat[name] = leaf
    return flat


def nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """The nested dict whose leaves have these names; the inverse of `flatten` for nested dicts.

    Raises UserError when one name is the beginning of another.
    """
    tree: dict[str, Any] = {}
    for name, leaf in flat.items():
        *parents, last = name.split("/")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                break
        if not isinstance(node, dict) or last in node:
            raise UserError(f"the name {name!r} is also the beginning of another array's name; rename one of them")
        node[last] = leaf
    return tree


def between(first: Mapping[str, Any], second: Mapping[str, Any], share: float) -> dict[str, Any]:
    """Parameters `share` of the way from `first` to `second` (WiSE-FT, Wortsman et al. 2022); what `first` has not is
    as in `second`. Raises UserError for arrays of different shapes."""
    start, found = flatten(first), flatten(second)
    for name in start.keys() & found.keys():
        if np.shape(start[name]) != np.shape(found[name]):
            raise UserError(f"{name} is {np.shape(start[name])} in the one and {np.shape(found[name])} in the other")
        found[name] = (1 - share) * np.asarray(start[name]) + share * np.asarray(found[name])
    return nest(found)
