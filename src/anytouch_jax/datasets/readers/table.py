"""The readers by the name that `anytouch data index` takes."""

from __future__ import annotations

from anytouch_jax.datasets.readers import (
    bags,
    containers,
    corpora,
    forces,
    hands,
    lerobot,
    recordings,
    robots,
)

_MODULES = (hands, robots, corpora, forces, lerobot, bags, containers, recordings)
READERS = {name: reader for module in _MODULES for name, reader in module.READERS.items()}
