"""The pouring study: 60 g of beads by touch alone, in the form of the paper's Table 4.

Two fingers hold a cylinder with 100 g of beads, one of them a GelSight Mini. Three actions (pour, wait, retract) tilt
it, five times a second. Cylinder, beads, gel and camera are simulated, and differ from run to run. An expert that sees
the scales demonstrates. A small MLP imitates it, over features of four segments: the last two, the first of the lifted
cylinder, and that of the standing one. The encoder is frozen or fine-tuned.

`make pouring` takes the encoders of `make experiments`, one a seed, and trains the missing ones (`STUDY=`).
`RUNS="anytouch=path static=path t3=a,b,c"` takes encoders of yours: a path, or one a seed. `none` without a path is an
untrained encoder, `static` the run of `anytouch` on single frames. A row without a run is left out. Finished rows are
not run again. `QUICK=1` is a trial of minutes. `SEEDS=`, `TRIALS=`, `DEMOS=` (a thousand of 84 pixels take 9 GB),
`TUNE=` (steps of fine-tuning), `MODES=`, `NAME=` (of the records) and `OUT=` change size and place.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from anytouch_jax.config import preset
from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.image_tower import image_tower_encoder
from experiments.pouring import bounds as pouring_bounds
from experiments.pouring import policy as pouring_policy
from experiments.pouring import table
from experiments.pouring import trials as pouring
from experiments.pouring.physics import VERSION, Task
from experiments.records import read_records, write_record
from experiments.tables import env, plan
from experiments.tables.work import Work

QUICK = env.switch("QUICK")
RUNS, STUDY = env.runs(), env.path("STUDY", f"runs/matrix{'-quick' if QUICK else ''}")
SEEDS = env.numbers("SEEDS", "0" if QUICK else "0,1,2")
MODES = env.names("MODES", "frozen" if QUICK else "frozen,fine-tuned", table.MODES)
TRIALS, DEMOS = env.number("TRIALS", 10 if QUICK else 60), env.number("DEMOS", 12 if QUICK else 1000)
TUNE = env.number("TUNE", 20 if QUICK else max(400, DEMOS))
OUT = env.path("OUT", "experiments/results")
NAME = env.path("NAME", "pouring-quick" if QUICK else "pouring").name
RESULTS = OUT / f"{NAME}.jsonl"
TASK = Task()


@cache
def of_the_tables(seed: int) -> dict[str, Path]:
    """The runs of Tables 2 to 4 by the names of the rows; the image tower of AnyTouch's is the one untouched."""
    size = plan.QUICK if QUICK else plan.FULL
    recipes = {"none": "anytouch", "t3": "t3", "static": "static_only", "anytouch": "anytouch"}
    return Work(STUDY).runs({name: plan.training(size, recipe, seed) for name, recipe in recipes.items()}, size)


def path_of(name: str, seed: int) -> str | None:
    """The run of a row: one for all seeds, or one each."""
    if not RUNS:
        return str(of_the_tables(seed)[name])
    paths = RUNS.get(name) or (RUNS.get("anytouch") if name == "static" else None)
    return paths[seed % len(paths)] if paths else None


@cache
def encoder_of(name: str, seed: int) -> Encoder | None:
    path = path_of(name, seed)
    if path is not None:
        return image_tower_encoder(path) if name == "none" else load_encoder(path)
    if name == "none":
        known = next((load_encoder(paths[0]).config for paths in RUNS.values()), preset("tiny"))
        return random_encoder(known, seed)
    return None


def source_of(name: str, seed: int, encoder: Encoder) -> str:
    """Return the source of a row's encoder and the fingerprint of its weights."""
    shown = "" if name in RUNS or name == "none" or not RUNS else f", {table.SHOWN}"
    path = path_of(name, seed)
    return f"{'untrained' if path is None else Path(path).name} (weights {encoder.fingerprint}{shown})"


LEARNING = {name: value for name, value in asdict(pouring_policy.Learning(tune_steps=TUNE)).items() if name != "seed"}
SETTINGS = {"trials": TRIALS, "demonstrations": DEMOS, "version": VERSION, "policy": pouring_policy.VERSION}
SETTINGS |= {name: value for name, value in LEARNING.items() if not name.startswith("tune")}


def key_of_row(name: str, mode: str, seed: int) -> str:
    return f"{name}-{mode}-{seed}"


def settings_of(mode: str) -> dict[str, Any]:
    tuning = {name: value for name, value in LEARNING.items() if name.startswith("tune")}
    return SETTINGS | (tuning if mode == "fine-tuned" else {})


def finished(key: str, settings: dict[str, Any], source: str) -> bool:
    """Return whether a row has a record of these settings and this encoder."""
    record = read_records(RESULTS).get(key, {})
    return bool(record.get("settings") == settings and record.get("source") == source)


def do_seed(seed: int) -> None:
    learning = pouring_policy.Learning(seed=seed, tune_steps=TUNE)
    setups, keys = pouring.draw_runs(TASK, seed + pouring_policy.UNSEEN, TRIALS)
    shown: dict[int, pouring.Trials] = {}
    grasps = cache(lambda side: pouring.hold(setups, side=side))

    def demonstrations(side: int) -> pouring.Trials:
        if side not in shown:
            shown.clear()
            shown[side] = pouring_policy.demonstrate(TASK, seed, DEMOS, side=side)
        return shown[side]

    def write(name: str, mode: str, trials: pouring.Trials, source: str, since: float, **about: float) -> None:
        about["seconds"] = round(time.time() - since, 1)
        record = table.record(name, mode, seed, trials, TASK, source, settings_of(mode), about)
        write_record(RESULTS, key_of_row(name, mode, seed), record)
        mean = pouring.error(trials.poured, TASK.target).mean
        print(f"seed {seed}, {name}, {mode}: {mean:.1f} g, {about['seconds']:.0f} s", flush=True)

    bounds = {
        "blind": lambda: pouring_bounds.learn_blind(TASK, seed, DEMOS, learning),
        "count": lambda: pouring.best_counter(TASK, *pouring.draw_runs(TASK, seed, DEMOS)),
        "load": lambda: pouring_bounds.Scales(TASK, setups, pouring_bounds.learn_loads(TASK, seed, DEMOS, learning)),
        "expert": lambda: pouring.Expert(TASK),
    }
    for name, make in bounds.items():
        if not finished(key_of_row(name, "bound", seed), SETTINGS, name):
            since = time.time()
            write(name, "bound", pouring.run(TASK, setups, keys, make()), name, since)
    for name in table.PAPER:
        encoder, stills = encoder_of(name, seed), name not in table.DYNAMIC
        if encoder is None:
            if seed == SEEDS[0]:
                print(f"no run is given for row {name}: it is left out")
            continue
        source = source_of(name, seed, encoder)
        left = [m for m in MODES if not finished(key_of_row(name, m, seed), settings_of(m), source)]
        todo = sorted(left, key=("frozen", "fine-tuned").index)  # fine-tuning goes on from the frozen policy
        if not todo:
            continue
        since, side = time.time(), encoder.config.model.image_size
        policy = pouring_policy.learn_frozen(encoder, demonstrations(side), learning, stills=stills)
        for mode in todo:
            if mode == "fine-tuned":
                since, policy = time.time(), pouring_policy.fine_tune(policy, demonstrations(side), learning)
            trials = pouring.run(TASK, setups, keys, policy, side=side, grasps=grasps(side))
            write(name, mode, trials, source, since, loss=round(policy.loss, 4))


def main() -> None:
    if unknown := set(RUNS) - set(table.PAPER):
        raise UserError(f"RUNS names {', '.join(table.PAPER)}, not {', '.join(sorted(unknown))}")
    enable_compilation_cache()
    for seed in SEEDS:
        do_seed(seed)


if __name__ == "__main__":
    main()
