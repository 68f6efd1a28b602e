"""Encoders of Tables 2 to 4 trained anew without some objects: the paper takes the coarse data of the objects that a
translation is tested on out of pre-training (App. "Cross-sensor generation"); here every row of such an object."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.weights.tree import interpolate
from experiments.tables import cuts, plan
from experiments.tables.plan import Size, Training
from experiments.tables.work import Work
from experiments.translation import pairs

LESS = "_remaining"
SHARE = 0.5  # of the way from stage 1 to stage 2, of the encoder between them
LAYER_DECAY = 0.1  # by the error of images of the third split, seed 0: 0.0347, with 0.3 0.0363, with 1 0.0365
NOT_TUNED = (("stage1", "fine"),)  # it tells why a frozen row is what it is


def write_remaining(path: Path, taken: Manifest) -> Path:
    """The manifest at `path` without the objects of `taken`, beside it. Raises UserError when nothing is left."""
    whole = manifests.read(path)
    kept = pairs.without_objects(whole, taken)
    target = path.with_name(f"{path.stem}{LESS}{path.suffix}")
    manifests.write(kept, target)
    print(f"{target}: {len(kept)} of {len(whole)} rows are of objects that the pairs do not have")
    return target


def trainings(size: Size, seed: int) -> dict[str, Training]:
    """AnyTouch, its stage 1, its stage 2 with the lower layers kept nearly as stage 1 left them, and T3-style."""
    whole, t3 = (plan.training(size, recipe, seed) for recipe in ("anytouch", "t3"))
    assert whole.init is not None
    kept = replace(whole.config, optim=replace(whole.config.optim, layer_decay=LAYER_DECAY))
    found = {"anytouch": whole, "anytouch_layer_decay": Training(kept, whole.init), "stage1": whole.init, "t3": t3}
    return {name: less(one) for name, one in found.items()}


def less(one: Training) -> Training:
    """The training, and those before it, on what remains of their manifests."""
    names = tuple(
        f"{name}{LESS}" if "/" in name else f"{name}/{Path(cuts.WHOLE).stem}{LESS}"
        for name in one.config.data.manifests
    )
    config = replace(one.config, data=replace(one.config.data, manifests=names))
    return Training(config, less(one.init) if one.init else None)


def train(work: Work, size: Size, seed: int, taken: Manifest) -> dict[str, Path]:
    """Run folders by name, trained where they are not there yet, on data sets of `work` that are made alike."""
    asked = trainings(size, seed)
    names = sorted({name for one in asked.values() for name in one.manifests})
    work.make_sets(names, size)
    for name in names:
        write_remaining(work.manifest(name.removesuffix(LESS)), taken)
    return work.runs(asked, size)


def encoders(work: Work, size: Size, seed: int, taken: Manifest) -> dict[str, Encoder]:
    """Those of `train`, and the one half-way from AnyTouch's stage 1 to its stage 2."""
    found = {name: load_encoder(run) for name, run in train(work, size, seed, taken).items()}
    first, second = found["stage1"], found["anytouch"]
    params = interpolate(first.params, second.params, SHARE)
    return found | {"anytouch_between": replace(second, params=params, source=f"{second.source}-between")}
