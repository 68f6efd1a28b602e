"""A new sensor with few frames of it: universal tokens as they are, or tokens fitted to the frames (`anytouch adapt`).

Unlabelled frames fit the tokens by reconstruction, and the probe learns from the other sensors alone. Labelled ones
stand among the training rows of the probe, and fit the tokens by the material they show. All are tested on the same
touches of the new sensor.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anytouch_jax.cli.app import main
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import load_encoder, text_column
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.feature_cache import encoder_digest
from anytouch_jax.files import atomic_write
from experiments.tables import cuts, plan
from experiments.tables.plan import Leaf

if TYPE_CHECKING:
    from experiments.tables.work import Work

FRAMES = (4, 18, 100)
TOLD = "label.material"
TASKS = ("material", "roughness", "hardness")
Probes = Callable[..., list[dict[str, Any]]]


def rows(leaf: Leaf, work: Work, probes: Probes) -> list[dict[str, Any]]:
    """Probes of the new sensor: views `<tokens>, <n> unlabelled` and `<tokens>, <n> labelled`; `seen` where it was."""
    run, own = work.run_of(leaf.model), work.folder / "own"  # type: ignore[arg-type]
    plain, options = (
        load_encoder(run),
        {"test_sensors": (plan.UNSEEN,), "max_rows": None, "protocols": ("honest", "published")},
    )
    if leaf.name == "seen":
        return probes(leaf, work, f"own/{cuts.STATIC}", TASKS, "seen", plain, **options)
    name = labelled(own, 0)
    found = probes(leaf, work, name, TASKS, "universal, 0 unlabelled", plain, **options)
    for frames in FRAMES:
        several = labelled(own, frames)
        without = load_encoder(adapted(work, run, own / f"{plan.UNSEEN}.parquet", frames))
        told = load_encoder(adapted(work, run, work.folder / several, frames, TOLD))
        for view, table, encoder in (
            (f"fitted, {frames} unlabelled", name, without),
            (f"universal, {frames} labelled", several, plain),
            (f"fitted, {frames} labelled", several, told),
        ):
            found += probes(leaf, work, table, TASKS, view, encoder, **options)
    return found


def adapted(work: Work, run: Path, data: Path, frames: int, labels: str | None = None) -> Path:
    """The run with tokens fitted to so many frames of the new sensor, by reconstruction or by a label's classes.

    It is kept beside the trainings, and made again when the run's weights or the data are others. Raises UserError
    where `anytouch adapt` fails.
    """
    out = work.folder / "trained" / f"{run.name}-{'told' if labels else 'adapted'}{frames}"
    note, of = out / "adapted.json", {"run": encoder_digest(load_encoder(run)), "data": cuts.content_hash(data)}
    if not (note.exists() and json.loads(note.read_text(encoding="utf-8")) == of):
        shutil.rmtree(out, ignore_errors=True)  # begun and not finished
        table = manifests.read(data)
        mine = (text_column(table, "sensor") == plan.UNSEEN) & (text_column(table, "split") == "train")
        if mine.sum() < frames:  # toy sizes
            print(f"  {data.name} has {mine.sum()} frames of {plan.UNSEEN}, not {frames}: all of them are taken")
            frames = int(mine.sum())
        words = ["adapt", "--run", run, "--data", data, "--sensor", plan.UNSEEN, "--frames", frames, "--out", out]
        if main([str(word) for word in (*words, *(("--labels", labels) if labels else ()))]):
            raise UserError(f"anytouch adapt failed with {frames} frames of {plan.UNSEEN}; its message is above")
        atomic_write(note, json.dumps(of) + "\n")
    return out


def labelled(folder: Path, frames: int) -> str:
    """A manifest in `folder` whose training rows are those of the other sensors and so many of the new one."""
    path = folder / f"new{frames}.parquet"
    if not path.exists():
        table = manifests.read(folder / cuts.STATIC)
        new, split = text_column(table, "sensor") == plan.UNSEEN, text_column(table, "split")
        mine = np.flatnonzero(new & (split == "train"))
        some = np.random.default_rng(0).permutation(mine)[:frames]
        keep = ~new | (split == "test")
        keep[some] = True
        cuts.cut(table, np.flatnonzero(keep), path)
    return f"{folder.name}/{path.name}"
