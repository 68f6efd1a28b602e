"""The work of a run on disk: data sets are simulated and cut, stages trained, encoders scored.

Under one folder: the data sets by name, `trained/<key>` a run folder each, `cache` features by
content. `done.json` in a folder says that it is finished, and of what: one of other data is made
again, one without it is gone on with.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import shutil
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

import anytouch_jax
from anytouch_jax.config import Config, to_json
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write, lock
from anytouch_jax.sim.dataset import VERSION, simulate
from anytouch_jax.sim.scene import Scenes as Simulated
from anytouch_jax.sim.scene import objects_and_splits
from anytouch_jax.training import pretrain
from experiments.benchmarks import machine
from experiments.tables import cuts, plan, scores
from experiments.tables.cuts import content_hash
from experiments.tables.plan import Leaf, Scenes, Size, Training
from experiments.tables.results import noted

Log = Callable[[str], None]
DONE = "done.json"
BEGUN = "begun.json"


class Work:
    """Data sets and runs in `folder`."""

    def __init__(self, folder: Path, *, log: Log = print) -> None:
        self.folder = folder
        self.log = log

    def ready(self, leaf: Leaf) -> set[str]:
        """Return names of the finished data sets and keys of the finished trainings."""
        sets = {one.name for one in plan.scenes(leaf.size) if self.made(one, leaf.size)}
        return sets | {one.key for one in leaf.trainings if self._trained(one, sets)}

    def run_of(self, one: Training) -> Path:
        """The run folder of a training."""
        return self.folder / "trained" / one.key

    def manifest(self, name: str) -> Path:
        """The file of a manifest by its name in a plan: a data set, or data set/sensor."""
        dataset, _, part = name.partition("/")
        return self.folder / dataset / (f"{part}.parquet" if part else cuts.WHOLE)

    def claim(self, name: str) -> AbstractContextManager[bool]:
        """A lock on `name` that dies with the process; whether it was free."""
        path = self.folder / "claims" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return lock(path)

    def make(self, one: Scenes, size: Size) -> None:
        check_objects(size)
        start = time.perf_counter()
        folder = self.folder / one.name
        simulate(_simulated(one, size), folder)
        cuts.mark(folder, size.contact)
        cuts.cut_all(folder)
        self._finish(
            folder, {"seconds": round(time.perf_counter() - start, 1), "of": _of(one, size)}
        )

    def made(self, one: Scenes, size: Size) -> bool:
        """Whether a data set is there, and of this size and this simulator."""
        return bool(noted(self.folder / one.name / DONE).get("of") == _of(one, size))

    def _trained(self, one: Training, sets: set[str]) -> bool:
        """Whether a training is finished, on the data that are there now."""
        of = noted(self.run_of(one) / DONE).get("of")
        needed = {name.partition("/")[0] for name in one.manifests}
        return of is not None and needed <= sets and of == self._contents(one)

    def _contents(self, one: Training) -> dict[str, str]:
        """{name: content hash} of the manifests that a training and those before it learn from."""
        return {name: content_hash(self.manifest(name)) for name in one.manifests}

    def train(self, one: Training) -> None:
        start = time.perf_counter()
        run = self.run_of(one)
        of = self._contents(one)
        before = noted(run / BEGUN) or noted(run / DONE)
        if before.get("of", of) != of:
            self.log(f"  {run.name} was trained on other data: it starts again")
            shutil.rmtree(run)
            before = {}
        about = {
            "of": of,
            "parts": before.get("parts", 0) + 1,
            "seconds": before.get("seconds", 0.0),
        }
        run.mkdir(parents=True, exist_ok=True)
        atomic_write(run / BEGUN, json.dumps(about) + "\n")
        init = self.run_of(one.init) if one.init else None
        try:
            result = pretrain(self.resolved(one.config), run, init=init, log=lambda _: None)
        finally:  # the next part adds to this one's time; what a part that was killed took is lost
            about["seconds"] = round(about["seconds"] + time.perf_counter() - start, 1)
            atomic_write(run / BEGUN, json.dumps(about) + "\n")
        if result.interrupted is not None:
            raise KeyboardInterrupt
        self._finish(run, about | {"resumed_at_step": result.resumed})
        self._forget()

    def make_sets(self, manifests: Collection[str], size: Size) -> None:
        """Make the data sets that these manifests are cut from, where they are not there yet."""
        wanted = {name.partition("/")[0] for name in manifests}
        for one in plan.scenes(size):
            if one.name in wanted and not self.made(one, size):
                self.make(one, size)

    def runs(self, asked: Mapping[str, Training], size: Size) -> dict[str, Path]:
        """The run folders of trainings by name; what is not trained yet is, and its data are
        made.
        """
        for name, last in asked.items():
            self.make_sets(last.manifests, size)
            leaf = Leaf("encoders", name, last.config.run.seed, last, size)
            for one in leaf.trainings:
                if one.key not in self.ready(leaf):
                    self.train(one)
        return {name: self.run_of(last) for name, last in asked.items()}

    def resolved(self, config: Config) -> Config:
        """A plan's configuration with the names of manifests made files."""
        files = tuple(str(self.manifest(name)) for name in config.data.manifests)
        return replace(config, data=replace(config.data, manifests=files))

    def score(self, leaf: Leaf) -> dict[str, Any]:
        start = time.perf_counter()
        outcome = scores.score(leaf, self)
        self._forget()
        trained = []
        data = {name: content_hash(self.manifest(name)) for name in outcome.pop("data")}
        for one in leaf.trainings:
            about = noted(self.run_of(one) / DONE)
            # what it learned from, whatever is there now
            data |= about.pop("of")
            of = {
                "key": one.key,
                "stage": one.config.stage,
                "config": json.loads(to_json(one.config)),
            }
            trained.append(of | about)
        return {
            "size": leaf.size.name,
            "settings": dataclasses.asdict(leaf.size),
            "trained": trained,
            "untrained": None
            if trained or leaf.name == scores.PIXELS
            else json.loads(to_json(scores.untrained(leaf))),
            "data": dict(sorted(data.items())),
            "version": anytouch_jax.__version__,
            "machine": machine.describe().sentence(),
            "seconds": round(time.perf_counter() - start, 1),
        } | outcome

    def _finish(self, folder: Path, about: dict[str, Any]) -> None:
        atomic_write(folder / DONE, json.dumps(about) + "\n")
        self.log(f"  {folder.name}: {about['seconds']:.0f} s")

    def _forget(self) -> None:
        """Programs of one training are of no use to the next and hold their memory."""
        jax.clear_caches()
        gc.collect()


def check_objects(size: Size) -> None:
    """Raise UserError where an object would stand in two splits of data sets that share their
    objects.

    What is held out of `own` must not be met in training on `aligned`. Data sets of one seed draw
    from one catalogue, in which a name is one object; which of them are held out hangs on how many
    there are.
    """
    known: dict[tuple[int, str], tuple[str, str]] = {}
    for one in plan.scenes(size):
        things, splits = objects_and_splits(_simulated(one, size))
        for thing, split in zip(things, splits, strict=True):
            name, before = known.setdefault((one.seed, thing.name), (one.name, split))
            if before != split:
                least = min(other.touches for other in plan.scenes(size) if other.seed == one.seed)
                raise UserError(
                    f"the object {thing.name} would be in {before} of {name} and in {split} of "
                    f"{one.name}: give both the same objects, for example --set "
                    f"objects={min(size.objects, least)}"
                )


def _simulated(one: Scenes, size: Size) -> Simulated:
    return Simulated(
        touches=one.touches,
        sensors=one.sensors,
        seed=one.seed,
        grade=one.grade,
        frames=size.frames,
        objects=min(size.objects, one.touches),
        held_out=one.held_out,
        size=size.pixels,
        first=one.first,
    )


def _of(one: Scenes, size: Size) -> str:
    return repr((one, size.frames, size.objects, size.pixels, size.contact, VERSION))
