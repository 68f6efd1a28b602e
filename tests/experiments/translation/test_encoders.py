"""Encoders without the objects of the pairs: which manifests they learn from, what is made and what is found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from anytouch_jax.data.manifest import manifest as manifests
from experiments.tables import plan
from experiments.tables.work import Work
from experiments.translation import encoders


def table(path: Path, objects: list[str]) -> manifests.Manifest:
    path.parent.mkdir(parents=True, exist_ok=True)
    names = [f"{i}.png" for i in range(len(objects))]
    columns = {"path": names, "sensor": ["digit"] * len(names), "object": objects, "split": ["train"] * len(names)}
    columns |= {"sequence": names, "frame_index": [0] * len(names)}
    return manifests.from_columns(columns, path)


class Study(Work):
    """`Work` without frames or networks; it remembers what it was asked for."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.sets, self.trained = [], []

    def made(self, one, size):
        return one.name in self.sets

    def make(self, one, size):
        self.sets.append(one.name)
        for part in ("contact", *one.sensors):
            path = self.folder / one.name / f"{part}.parquet"
            manifests.write(table(path, ["bolt", "cup", "coin"]), path)

    def ready(self, leaf):
        return {*self.sets, *(one.key for one in self.trained)}

    def train(self, one):
        for name in one.config.data.manifests:
            assert set(manifests.read(self.manifest(name)).column("object").to_pylist()) == {"bolt", "coin"}
        self.trained.append(one)


def test_encoders_learn_from_what_remains_and_are_trained_once(tmp_path):
    taken, study = table(tmp_path / "pairs" / "manifest.parquet", ["cup"]), Study(tmp_path)
    runs = encoders.train(study, plan.FULL, 3, taken)
    assert set(study.sets) == {"own", "fine", "coarse"}  # nobody trains on `other`
    assert list(runs) == ["anytouch", "anytouch_layer_decay", "stage1", "t3"] and len(set(runs.values())) == 4
    assert [one.config.stage for one in study.trained] == [1, 2, 2, 1]
    of = {one.key: one for one in study.trained}
    whole, kept, first, _ = (of[path.name] for path in runs.values())
    assert whole.init == kept.init == first and kept.config.optim.layer_decay == 0.1
    usual = plan.training(plan.FULL, "anytouch", 3)
    assert whole.key != usual.key and first.key != usual.init.key  # of other data: another run folder
    before = list(study.trained)
    assert encoders.train(study, plan.FULL, 3, taken) == runs and study.trained == before


def test_nothing_but_the_manifests_differs_from_the_tables_of_the_paper():
    for name, one in encoders.trainings(plan.FULL, 0).items():
        if name in ("anytouch", "t3"):
            usual = plan.training(plan.FULL, name, 0)
            for mine, theirs in zip(one.chain, usual.chain, strict=True):
                alike = replace(mine.config.data, manifests=theirs.config.data.manifests)
                assert alike == theirs.config.data
                assert (mine.config.model, mine.config.objective) == (theirs.config.model, theirs.config.objective)
                assert all(result.endswith(encoders.LESS) for result in mine.config.data.manifests)
