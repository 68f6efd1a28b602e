"""The pouring study: 60 g of beads by touch alone, in the form of the paper's Table 4 (`make
pouring`).

Two fingers hold a cylinder with 100 g of beads, one of them a GelSight Mini. Three actions (pour,
wait, retract) tilt it, five times a second. Cylinder, beads, gel and camera are simulated, and
differ from run to run. An expert that sees the scales demonstrates. A small MLP imitates it, over
features of four segments: the last two, the first of the lifted cylinder, and that of the standing
one. The encoder is frozen or fine-tuned.
"""

from __future__ import annotations

import sys
import time
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, Literal

from anytouch_jax.config import preset
from anytouch_jax.config.parsing import Count
from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.command import run_script, runs_by_name
from experiments.image_tower import image_tower_encoder
from experiments.pouring import bounds, policy, table, trials
from experiments.pouring.physics import VERSION, Task
from experiments.records import read_records, write_record
from experiments.tables import plan
from experiments.tables.paper import TABLE4
from experiments.tables.work import Work

TASK = Task()
RECIPES = {"none": "anytouch", "t3": "t3", "static": "static_only", "anytouch": "anytouch"}


@dataclass(frozen=True)
class Options:
    """Run what is missing of the pouring study.

    Its encoders are those of `make experiments`, trained if missing.

    Example: python -m experiments.pouring.study --runs anytouch=runs/stage2 t3=a,b,c
    """

    runs: tuple[str, ...] = ()
    """Encoders of yours by row, NAME=PATH, or NAME=A,B,C for one a seed. `none` without a path is
    an untrained encoder, `static` the run of `anytouch` on single frames. A row without a run is
    left out.
    """
    study: Path = Path("runs/matrix")
    """Folder of `make experiments`."""
    out: Path = Path("experiments/results/pouring.jsonl")
    """File of results."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds."""
    modes: tuple[Literal["frozen", "fine-tuned"], ...] = ("frozen", "fine-tuned")
    """What is done with the encoder."""
    trials: Count[int] = 60
    """Runs of each policy."""
    demos: Count[int] = 1000
    """Demonstrations. A thousand of 84 pixels take 9 GB."""
    tune: Count[int | None] = None
    """Steps of fine-tuning (default: as many as demonstrations, 400 or more)."""
    quick: bool = False
    """A trial of minutes, at toy size."""


QUICK: dict[str, Any] = {"seeds": (0,), "modes": ("frozen",), "trials": 10, "demos": 12, "tune": 20}
QUICK |= {"study": Path("runs/matrix-quick"), "out": Path("runs/pouring-quick.jsonl")}


class Study:
    """The rows of the table, a seed after the other."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.runs = runs_by_name(options.runs, TABLE4)
        self.tune = options.tune or max(400, options.demos)
        learning = asdict(policy.Learning(tune_steps=self.tune))
        learning.pop("seed")
        self.tuning = {name: value for name, value in learning.items() if name.startswith("tune")}
        self.settings = {
            "trials": options.trials,
            "demonstrations": options.demos,
            "version": VERSION,
        }
        self.settings |= {"policy": policy.VERSION} | {
            k: v for k, v in learning.items() if k not in self.tuning
        }
        self.trained = cache(self._trained)

    def _trained(self, seed: int) -> dict[str, Path]:
        """The runs of Tables 2 to 4 by the names of the rows; the image tower of AnyTouch's is the
        one untouched.
        """
        size = plan.QUICK if self.options.quick else plan.FULL
        return Work(self.options.study).runs(
            {k: plan.training(size, r, seed) for k, r in RECIPES.items()}, size
        )

    def path_of(self, name: str, seed: int) -> str | None:
        """The run of a row: one for all seeds, or one each."""
        if not self.runs:
            return str(self.trained(seed)[name])
        paths = self.runs.get(name) or (self.runs.get("anytouch") if name == "static" else None)
        if paths:
            return paths[seed % len(paths)]
        return None

    def encoder_of(self, name: str, seed: int) -> tuple[Encoder, str] | None:
        """The encoder of a row with its source and the fingerprint of its weights, None without a
        run.
        """
        path = self.path_of(name, seed)
        if path is not None:
            encoder = image_tower_encoder(path) if name == "none" else load_encoder(path)
        elif name == "none":
            known = next(
                (load_encoder(paths[0]).config for paths in self.runs.values()), preset("tiny")
            )
            encoder = random_encoder(known, seed)
        else:
            return None
        shown = (
            f", {table.SHOWN}" if self.runs and name == "static" and name not in self.runs else ""
        )
        return (
            encoder,
            f"{'untrained' if path is None else Path(path).name} (weights "
            f"{encoder.fingerprint}{shown})",
        )

    def wanted(self, name: str, mode: str, seed: int, source: str) -> bool:
        """Whether a row has no record of these settings and this encoder."""
        record = read_records(self.options.out).get(f"{name}-{mode}-{seed}", {})
        return (record.get("settings"), record.get("source")) != (self.settings_of(mode), source)

    def settings_of(self, mode: str) -> dict[str, Any]:
        return self.settings | (self.tuning if mode == "fine-tuned" else {})

    def write(
        self,
        name: str,
        mode: str,
        seed: int,
        tried: trials.Trials,
        source: str,
        since: float,
        **about: float,
    ) -> None:
        about |= {"seconds": round(time.time() - since, 1)}
        settings = self.settings_of(mode)
        record = table.record(
            tried, TASK, row=name, mode=mode, seed=seed, source=source, settings=settings, **about
        )
        write_record(self.options.out, f"{name}-{mode}-{seed}", record)
        print(
            f"seed {seed}, {name}, {mode}: {record['mean_error']:.1f} g, {about['seconds']:.0f} s",
            flush=True,
        )

    def run(self, seed: int) -> None:
        """Run the missing rows of a seed."""
        count = self.options.demos
        learning = policy.Learning(seed=seed, tune_steps=self.tune)
        setups, keys = trials.draw_runs(TASK, seed + policy.UNSEEN, self.options.trials)
        shown = lru_cache(1)(lambda side: policy.demonstrate(TASK, seed, count, side=side))
        grasps = cache(lambda side: trials.hold(setups, side=side))
        negatives = {
            "blind": lambda: bounds.learn_blind(TASK, seed, count, learning),
            "load": lambda: bounds.Scales(
                TASK, setups, bounds.learn_loads(TASK, seed, count, learning)
            ),
            "expert": lambda: trials.Expert(TASK),
        }
        for name, make in negatives.items():
            if self.wanted(name, "bound", seed, name):
                since = time.time()
                self.write(name, "bound", seed, trials.run(TASK, setups, keys, make()), name, since)
        for name in TABLE4:
            if (found := self.encoder_of(name, seed)) is None:
                print(f"no run is given for row {name}: it is left out")
                continue
            encoder, source = found
            # fine-tuning goes on from the frozen policy
            modes = [
                m
                for m in ("frozen", "fine-tuned")
                if m in self.options.modes and self.wanted(name, m, seed, source)
            ]
            if not modes:
                continue
            since = time.time()
            side = encoder.config.model.image_size
            learned = policy.learn_frozen(
                encoder, shown(side), learning, stills=name not in table.DYNAMIC
            )
            for mode in modes:
                if mode == "fine-tuned":
                    since = time.time()
                    learned = policy.fine_tune(learned, shown(side), learning)
                tried = trials.run(TASK, setups, keys, learned, side=side, grasps=grasps(side))
                self.write(name, mode, seed, tried, source, since, loss=round(learned.loss, 4))


def run(options: Options) -> int:
    """Run the study."""
    enable_compilation_cache()
    usual = {
        name: value
        for name, value in QUICK.items()
        if getattr(options, name) == getattr(Options(), name)
    }
    study = Study(replace(options, **usual) if options.quick else options)
    for seed in study.options.seeds:
        study.run(seed)
    return 0


main = partial(run_script, Options, run)

if __name__ == "__main__":
    sys.exit(main())
