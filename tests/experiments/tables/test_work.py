import json
from types import SimpleNamespace

import pytest

from anytouch_jax.data.manifest import manifest as manifests
from experiments.tables import plan
from experiments.tables import work as works
from experiments.tables.work import DONE, Work

LEAF = next(leaf for leaf in plan.leaves(plan.QUICK) if leaf.name == "+".join(plan.SENSORS[:2]))
FIRST = LEAF.trainings[0]


def write_data(folder, text):
    """Both sensors' manifests with a row of `text`, and every data set marked as made."""
    for name in LEAF.model.manifests:
        path = folder / f"{name}.parquet"
        columns = {"path": ["a.jpg"], "sensor": ["digit"], "sequence": ["a"], "frame_index": [0], "split": ["train"]}
        manifests.write(manifests.from_columns(columns | {"text": [text]}, path), path)
    for one in plan.scenes(LEAF.size):
        (folder / one.name).mkdir(exist_ok=True)
        (folder / one.name / DONE).write_text(json.dumps({"of": works._of(one, LEAF.size), "seconds": 1}))


class Trainer:
    """Stands for `pretrain`: takes ten seconds of its clock, is interrupted on request."""

    def __init__(self, patch):
        self.calls, self.time, self.stop = [], 0.0, False
        patch.setattr(works, "pretrain", self)
        patch.setattr(works.time, "perf_counter", lambda: self.time)

    def __call__(self, config, run, *, init, log):
        self.calls.append((run.name, (run / "weights").exists()))
        (run / "weights").touch()
        self.time += 10
        return SimpleNamespace(interrupted=7 if self.stop else None, resumed=0)


@pytest.fixture
def trainer(monkeypatch):
    return Trainer(monkeypatch)


@pytest.fixture
def work(tmp_path):
    write_data(tmp_path, "one")
    lines = []
    result = Work(tmp_path, log=lines.append)
    result.said = lines
    return result


def test_a_training_on_other_data_is_not_finished_and_starts_again(work, trainer):
    sets = {"own", "fine", "coarse", "other"}
    assert work.ready(LEAF) == sets
    for one in LEAF.trainings:
        work.train(one)
    assert work.ready(LEAF) == sets | {one.key for one in LEAF.trainings}
    write_data(work.folder, "two")
    assert work.ready(LEAF) == sets
    work.train(FIRST)
    assert trainer.calls[-1] == (FIRST.key, False)  # nothing is left of the first one
    assert f"  {FIRST.key} was trained on other data: it starts again" in work.said
    assert work.ready(LEAF) == sets | {FIRST.key}
