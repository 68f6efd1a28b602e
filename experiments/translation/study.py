"""The translation study: one sensor's touch as another feels it (App. "Cross-sensor generation", Table 7).

Images of a DuraGel are painted from those of a GelSight Mini. The 20 x 20 field of a Tac3D is regressed from a GelSight
Mini or a DIGIT. The pairs are simulated: one device of each sensor and one motion for all, frame by frame. A quarter of
the objects, by whole pairs of primitive and texture, is tested on. Training stops where the error on a third split is
smallest. Each translation is compared with copying the mean target, and with a network on pixels from scratch.

`make translation` trains the encoders too, one of each a seed, on the scenes of `make experiments` without the objects
of the pairs (`encoders.py`). In the environment: `RUNS="anytouch=runs/stage2 t3=a,b,c"` takes encoders of yours (a
path, or one a seed). `STEPS1=3000` gives stage 1 so many steps, and its table a separate page. `STUDY=`, `WORK=`
and `OUT=` are folders of the scenes, the pairs and the results. `TOUCHES=`, `STEPS=`, `SEEDS=` and `TUNE=` change the
size, and `QUICK=1` is a trial of minutes.
"""

from __future__ import annotations

import re
import time
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import preset
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import select_rows
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.sim.dataset import simulate, version
from anytouch_jax.sim.scene import Scenes
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.records import write_record
from experiments.tables import env, plan
from experiments.tables.work import Work
from experiments.translation import encoders as own_encoders
from experiments.translation import pairs, training
from experiments.translation.generator import Fit
from experiments.translation.networks import Translation
from experiments.translation.settings import PIXELS, TASKS, one_table, runs_of

QUICK = env.switch("QUICK")
USUAL = plan.QUICK if QUICK else plan.FULL
SIZE = replace(USUAL, steps1=env.number("STEPS1", USUAL.steps1))
LONGER = {} if SIZE == USUAL else {"steps1": SIZE.steps1}
NAME = "_".join(["translation", *(["quick"] if QUICK else []), *map(str, LONGER.values())])
WORK, OUT = env.path("WORK", "runs/translation"), env.path("OUT", "experiments/results")
RUNS, STUDY = env.runs(), env.path("STUDY", f"runs/matrix{'-quick' if QUICK else ''}")
TOUCHES, STEPS = env.number("TOUCHES", 24 if QUICK else 400), env.number("STEPS", 40 if QUICK else 600)
SEEDS = env.numbers("SEEDS", "0" if QUICK else "0,1,2")
TUNE = env.names("TUNE", "frozen", ("frozen", "fine"))
RESULTS = OUT / f"{NAME}.jsonl"

# Names of objects say texture, material and primitive.
SCENES = Scenes(
    touches=TOUCHES, objects=24 if QUICK else 60, sensors=("gelsight_mini", "digit", "duragel", "tac3d"),
    seed=7, grade="fine", units="one", frames=6, size=128, vision=0.0, text=0.0,
)  # fmt: skip
PAIRS = WORK / f"pairs-{TOUCHES}-{version(SCENES.sensors)}"


def view_of(encoder: Encoder) -> tuple[int, bool]:
    """Return the picture size of an encoder, and whether it subtracts the background."""
    return encoder.config.model.image_size, encoder.subtracts


def source_of(encoder: Encoder | None) -> str:
    """Return the source of an encoder and the fingerprint of its weights."""
    if encoder is None:
        return PIXELS
    return f"{Path(encoder.source).name} (weights {encoder.fingerprint})"


def settings(
    task: tuple[str, str], name: str, encoder: Encoder | None, view: tuple[int, bool], tune: str, seed: int, data: str
) -> dict[str, Any]:
    return {
        "from": task[0], "to": task[1], "name": name, "encoder": source_of(encoder),
        "size": view[0], "subtracts": view[1],
        "fit": asdict(Fit(steps=STEPS, tune="fine" if tune == "fine" else "frozen", seed=seed)), "touches": TOUCHES,
        "pairs": data, "version": training.VERSION, "simulator": version(task), **LONGER,
    }  # fmt: skip


def one_run(about: dict[str, Any], encoder: Encoder | None, data: Any, key: str) -> None:
    """Train, score on held-out objects and write the record of a run."""
    (x, y), val, (test_x, test_y) = data
    begun = time.perf_counter()
    field = () if y.dtype == np.uint8 else y.shape[1:]
    shape = None if encoder else Translation(replace(preset("tiny").model, image_size=about["size"]), field=field)
    made, losses = training.fit(
        encoder, x, y, source=about["from"], target=about["to"], val=val, options=Fit(**about["fit"]), shape=shape
    )
    seconds = time.perf_counter() - begun
    away = made(test_x).astype(np.float64) - test_y
    each = training.errors(made, test_x, test_y)
    record = {
        "settings": about,
        "error": float(each.mean()),
        "each": [round(float(value), 5) for value in each],
        "mean_target": float(training.mean_errors(made, test_y).mean()),
        "train_error": losses[-1]["error"],
        "rms": [float(value) for value in np.sqrt((away**2).mean(axis=tuple(range(away.ndim - 1))))],
        "pairs": [len(x), len(val[0]), len(test_x)],
        "seconds": round(seconds, 1),
        "critic": made.design.has_critic,
    }
    write_record(RESULTS, key, record)
    print(f"{key}: error {record['error']:.4f}, mean target {record['mean_target']:.4f}, {seconds:.0f} s")


def of_sensors(table: manifests.Manifest, names: tuple[str, str]) -> str:
    """The hash of the rows of two sensors: what a translation from the one to the other is of."""
    rows = np.flatnonzero(np.isin(table.column("sensor").to_pylist(), names))
    return select_rows(table, rows).content_hash[:16]


def encoders(table: manifests.Manifest) -> dict[str, dict[int, Encoder]]:
    """By the name that they have in the table, and by seed: those of RUNS, else those that this page trains."""
    if RUNS:
        loaded = {path: load_encoder(path) for paths in RUNS.values() for path in paths}
        return {name: {seed: loaded[paths[seed % len(paths)]] for seed in SEEDS} for name, paths in RUNS.items()}
    by_seed = {seed: own_encoders.encoders(Work(STUDY), SIZE, seed, table) for seed in SEEDS}
    return {name: {seed: by_seed[seed][name] for seed in SEEDS} for name in by_seed[SEEDS[0]]}


def make_all() -> None:
    """Make every missing run, task by task: frames are read once a task."""
    simulate(SCENES, PAIRS, progress=lambda done, of: print(f"pairs: {done} of {of} touches", end="\r", flush=True))
    table = manifests.read(PAIRS / "manifest.parquet")
    known = encoders(table)
    plain = view_of(known[next(iter(known))][SEEDS[0]])  # one view for all, the references too
    content = {task: of_sensors(table, task) for task in TASKS}
    wanted = [(name, tune) for name, tune in product(known, TUNE) if RUNS or (name, tune) not in own_encoders.NOT_TUNED]
    plans = [*wanted, (PIXELS, "scratch")]
    every = {}
    for (task, seed), (name, tune) in product(product(TASKS, SEEDS), plans):
        encoder = known[name][seed] if name in known else None
        about = settings(task, name, encoder, view_of(encoder) if encoder else plain, tune, seed, content[task])
        stem = re.sub(r"[^a-z0-9_]+", "-", f"{task[0]}-{task[1]}-{name}-{tune}-{seed}".lower())
        every[stem] = (about, encoder)
    others = [record["settings"] for key, record in runs_of(RESULTS).items() if key not in every]
    one_table([*(about for about, _ in every.values()), *others], RESULTS)
    for source, target in TASKS:
        mine = [(*one, key) for key, one in every.items() if (one[0]["from"], one[0]["to"]) == (source, target)]
        done = runs_of(RESULTS)
        todo = [one for one in mine if done.get(one[2], {}).get("settings") != one[0]]
        if not todo:
            continue
        split = pairs.find_pairs(table, source, target)
        data = [pairs.read_pairs(table, part, plain[0], subtract=plain[1]) for part in split]
        for about, encoder, key in todo:
            one_run(about, encoder, data, key)


def main() -> None:
    if RUNS and LONGER:
        raise UserError(
            "STEPS1 is for encoders that this study trains; leave it out with RUNS, whose encoders are trained"
        )
    enable_compilation_cache()
    make_all()


if __name__ == "__main__":
    main()
