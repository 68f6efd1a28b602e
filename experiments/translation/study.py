"""The translation study: one sensor's touch as another feels it (App.

"Cross-sensor generation", Table 7).

Images of a DuraGel are painted from those of a GelSight Mini. The 20 x 20 field of a Tac3D is
regressed from a GelSight Mini or a DIGIT. The pairs are simulated: one device of each sensor and
one motion for all, frame by frame. A quarter of the objects, by whole pairs of primitive and
texture, is tested on. Training stops where the error on a third split is smallest. Each translation
is compared with copying the mean target, and with a network on pixels from scratch.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from anytouch_jax.config import preset
from anytouch_jax.config.parsing import Count
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest, select_rows
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.sim.dataset import VERSION, simulate
from anytouch_jax.sim.scene import Scenes
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.command import run_script, runs_by_name
from experiments.records import check_alike, read_records, write_record
from experiments.tables import plan
from experiments.tables.work import Work
from experiments.translation import encoders as own_encoders
from experiments.translation import pairs, training
from experiments.translation.generator import Fit
from experiments.translation.networks import Translation
from experiments.translation.settings import PIXELS, TASKS, shared

Known = dict[str, dict[int, Encoder]]  # encoders by name and seed


@dataclass(frozen=True)
class Options:
    """Run what is missing of the translation study.

    It trains the encoders too, on the scenes of `make experiments` without the objects of the
    pairs.

    Example: python -m experiments.translation.study --runs anytouch=runs/stage2 t3=a,b,c
    """

    runs: tuple[str, ...] = ()
    """Encoders of yours: NAME=PATH, or NAME=A,B,C for one a seed."""
    study: Path | None = None
    """Folder of `make experiments` (default: runs/matrix)."""
    work: Path = Path("runs/translation")
    """Folder of the pairs."""
    out: Path | None = None
    """File of results (default: translation.jsonl in experiments/results, with the steps of
    --steps1 in its name).
    """
    steps1: Count[int | None] = None
    """Steps of stage 1 of the encoders that the study trains."""
    touches: Count[int] = 400
    """Simulated touches of the pairs."""
    steps: Count[int] = 600
    """Steps of each translation."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds."""
    tune: tuple[Literal["frozen", "fine"], ...] = ("frozen",)
    """What is done with the encoder."""
    quick: bool = False
    """A trial of minutes, at toy size."""


def view_of(encoder: Encoder) -> tuple[int, bool]:
    """Return the image size of an encoder, and whether it subtracts the background."""
    return encoder.config.model.image_size, encoder.subtracts


def one_run(about: dict[str, Any], encoder: Encoder | None, data: Any) -> dict[str, Any]:
    """Train, score on held-out objects and return the record of a run."""
    (x, y), val, (test_x, test_y) = data
    begun = time.perf_counter()
    field = () if y.dtype == np.uint8 else y.shape[1:]
    shape = (
        None
        if encoder
        else Translation(replace(preset("tiny").model, image_size=about["size"]), field=field)
    )
    made, losses = training.fit(
        encoder,
        x,
        y,
        source=about["from"],
        target=about["to"],
        val=val,
        options=Fit(**about["fit"]),
        shape=shape,
    )
    seconds = round(time.perf_counter() - begun, 1)
    away = made(test_x).astype(np.float64) - test_y
    each = training.errors(made, test_x, test_y)
    return {
        "settings": about,
        "error": float(each.mean()),
        "each": [round(float(value), 5) for value in each],
        "mean_target": float(training.mean_errors(made, test_y).mean()),
        "train_error": losses[-1]["error"],
        "rms": [
            float(value) for value in np.sqrt((away**2).mean(axis=tuple(range(away.ndim - 1))))
        ],
        "pairs": [len(x), len(val[0]), len(test_x)],
        "seconds": seconds,
        "critic": made.design.has_critic,
    }


def encoders_of(options: Options, size: plan.Size, table: Manifest) -> Known:
    """Return encoders by name and seed: those of --runs, else those that the study trains."""
    if runs := runs_by_name(options.runs):
        loaded = {path: load_encoder(path) for paths in runs.values() for path in paths}
        return {
            name: {seed: loaded[paths[seed % len(paths)]] for seed in options.seeds}
            for name, paths in runs.items()
        }
    work = Work(options.study or Path(f"runs/matrix{'-quick' * options.quick}"))
    by_seed = {seed: own_encoders.train(work, size, seed, table) for seed in options.seeds}
    names = by_seed[options.seeds[0]]
    return {
        name: {seed: load_encoder(by_seed[seed][name]) for seed in options.seeds} for name in names
    }


def wanted_runs(
    options: Options, table: Manifest, known: Known, plain: tuple[int, bool], longer: dict[str, int]
) -> Iterator[tuple[str, tuple[dict[str, Any], Encoder | None]]]:
    """Yield the key of each run, its settings and its encoder, None for the network on pixels."""
    sensors = table.text_column("sensor")
    data_of = {
        task: select_rows(table, np.flatnonzero(np.isin(sensors, task))).content_hash[:16]
        for task in TASKS
    }
    plans = [
        (name, tune)
        for name, tune in product(known, options.tune)
        if options.runs or (name, tune) not in own_encoders.NOT_TUNED
    ]
    for task, seed, (name, tune) in product(TASKS, options.seeds, [*plans, (PIXELS, "scratch")]):
        encoder = known[name][seed] if name in known else None
        side, subtracts = view_of(encoder) if encoder else plain
        key = re.sub(r"[^a-z0-9_]+", "-", f"{task[0]}-{task[1]}-{name}-{tune}-{seed}".lower())
        about = {
            "from": task[0],
            "to": task[1],
            "name": name,
            "size": side,
            "subtracts": subtracts,
            "encoder": f"{Path(encoder.source).name} (weights {encoder.fingerprint})"
            if encoder
            else PIXELS,
            "fit": asdict(
                Fit(steps=options.steps, tune="fine" if tune == "fine" else "frozen", seed=seed)
            ),
            "touches": options.touches,
            "version": training.VERSION,
            "simulator": VERSION,
            **longer,
            "pairs": data_of[task],
        }
        yield key, (about, encoder)


def run(options: Options) -> int:
    """Make every missing run, task by task: frames are read once a task."""
    if options.runs and options.steps1:
        raise UserError("--steps1 is for encoders that the study trains. Leave it out with --runs.")
    enable_compilation_cache()
    usual = {"touches": 24, "steps": 40, "seeds": (0,)} if options.quick else {}
    options = replace(
        options, **{k: v for k, v in usual.items() if getattr(options, k) == getattr(Options(), k)}
    )
    longer = {"steps1": options.steps1} if options.steps1 else {}
    size = replace(plan.QUICK if options.quick else plan.FULL, **longer)
    name = "_".join(["translation", *["quick"] * options.quick, *map(str, longer.values())])
    out = options.out or Path("runs" if options.quick else "experiments/results") / f"{name}.jsonl"
    scenes = Scenes(
        touches=options.touches,
        objects=24 if options.quick else 60,
        seed=7,
        grade="fine",
        units="one",
        frames=6,
        sensors=("gelsight_mini", "digit", "duragel", "tac3d"),
        size=128,
        vision=0.0,
        text=0.0,
    )
    folder = options.work / f"pairs-{options.touches}-{VERSION}"
    simulate(
        scenes,
        folder,
        progress=lambda done, of: print(f"pairs: {done} of {of} touches", end="\r", flush=True),
    )
    table = manifests.read(folder / "manifest.parquet")
    known = encoders_of(options, size, table)
    # one view for all, the references too
    plain = view_of(known[next(iter(known))][options.seeds[0]])
    wanted = dict(wanted_runs(options, table, known, plain, longer))
    done = read_records(out)
    others = [record["settings"] for key, record in done.items() if key not in wanted]
    check_alike(
        out, [shared(about) for about in (*(about for about, _ in wanted.values()), *others)]
    )
    for source, target in TASKS:
        todo = [
            (key, *one)
            for key, one in wanted.items()
            if (one[0]["from"], one[0]["to"]) == (source, target)
            and done.get(key, {}).get("settings") != one[0]
        ]
        if not todo:
            continue
        split = pairs.find_pairs(table, source, target)
        data = [pairs.read_pairs(table, part, plain[0], subtract=plain[1]) for part in split]
        for key, about, encoder in todo:
            record = one_run(about, encoder, data)
            write_record(out, key, record)
            print(
                f"{key}: error {record['error']:.4f}, mean target {record['mean_target']:.4f}, "
                f"{record['seconds']} s"
            )
    return 0


main = partial(run_script, Options, run)

if __name__ == "__main__":
    sys.exit(main())
