"""Parameter trees: nested dicts of arrays, and their flat form by name
("touch/blocks/norm1/scale").
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.renamed import keywords


def flatten(tree: Any) -> dict[str, Any]:
    """Return the leaves of a pytree by the path of names, joined with "/".

    Raises UserError for two of one name.
    """
    flat: dict[str, Any] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        if name in flat:
            raise UserError(f"two arrays of the tree are called {name!r}; rename one of them")
        flat[name] = leaf
    return flat


def nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nested dict of named leaves, as `flatten` reads it.

    Raises UserError if one name begins another.
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
            raise UserError(
                f"the name {name!r} is also the beginning of another array's name; rename one of "
                "them"
            )
        node[last] = leaf
    return tree


@keywords(share="fraction")
def interpolate(
    first: Mapping[str, Any], second: Mapping[str, Any], fraction: float
) -> dict[str, Any]:
    """Return parameters `fraction` of the way from `first` to `second` (WiSE-FT, Wortsman et al.
    2022).

    Arrays that `first` lacks are those of `second`. Raises UserError for arrays of different
    shapes.
    """
    start = flatten(first)
    end = flatten(second)
    for name in start.keys() & end.keys():
        if np.shape(start[name]) != np.shape(end[name]):
            raise UserError(
                f"{name} has shape {np.shape(start[name])} in one and {np.shape(end[name])} in the "
                "other; give two models of one configuration"
            )
        end[name] = (1 - fraction) * np.asarray(start[name]) + fraction * np.asarray(end[name])
    return nest(end)
