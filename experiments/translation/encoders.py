"""Encoders of the translation study: trained without the objects of its pairs.

The paper takes the coarse data of the objects that a translation is tested on out of pre-training
(App. "Cross-sensor generation"). Here every row of such an object is left out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from experiments.tables import cuts, plan
from experiments.tables.plan import Size, Training
from experiments.tables.work import Work
from experiments.translation import pairs

LESS = "_remaining"
NOT_TUNED = (("stage1", "fine"),)  # it explains a frozen row


def write_remaining(path: Path, taken: Manifest) -> Path:
    """Write the manifest at `path` without the objects of `taken` next to it.

    Raises UserError when no row is left.
    """
    whole = manifests.read(path)
    kept = pairs.without_objects(whole, taken)
    target = path.with_name(f"{path.stem}{LESS}{path.suffix}")
    manifests.write(kept, target)
    print(f"{target}: {len(kept)} of {len(whole)} rows are of objects that the pairs do not have")
    return target


def trainings(size: Size, seed: int) -> dict[str, Training]:
    """Return AnyTouch, its stage 1, and T3-style, by name."""
    whole, t3 = (plan.training(size, recipe, seed) for recipe in ("anytouch", "t3"))
    assert whole.init is not None
    return {
        name: reduced(one)
        for name, one in (("anytouch", whole), ("stage1", whole.init), ("t3", t3))
    }


def reduced(one: Training) -> Training:
    """Return the training, and those before it, on manifests without the objects of the pairs."""
    names = tuple(
        f"{name}{LESS}" if "/" in name else f"{name}/{Path(cuts.WHOLE).stem}{LESS}"
        for name in one.config.data.manifests
    )
    config = replace(one.config, data=replace(one.config.data, manifests=names))
    return Training(config, reduced(one.init) if one.init else None)


def train(work: Work, size: Size, seed: int, taken: Manifest) -> dict[str, Path]:
    """Train what is not trained yet on the data sets of `work`, and return the run folders by
    name.
    """
    wanted = trainings(size, seed)
    names = sorted({name for one in wanted.values() for name in one.manifests})
    work.make_sets(names, size)
    for name in names:
        write_remaining(work.manifest(name.removesuffix(LESS)), taken)
    return work.runs(wanted, size)
