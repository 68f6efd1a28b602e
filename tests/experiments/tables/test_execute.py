"""Running the plan with a trainer that only takes notes: order, sharing, resumption, failures."""

from __future__ import annotations

from contextlib import nullcontext

import pytest

from anytouch_jax.errors import UserError
from experiments.records import read_records, write_record
from experiments.tables import plan
from experiments.tables.execute import PAUSE, execute
from experiments.tables.work import Work

LEAVES = [
    leaf
    for leaf in plan.leaves(plan.FULL)
    if leaf.seed == 0 and leaf.question in ("q2", "ablations") and leaf.model and leaf.name != "matched_mlp"
]

NAME = "matrix.jsonl"


class Notes:
    """A worker that only notes what it is asked for."""

    def __init__(self, fail: str = "", stop_at: str = "") -> None:
        self.done: set[str] = set()
        self.calls: list[str] = []
        self.fail, self.stop_at = fail, stop_at
        self.elsewhere: set[str] = set()  # what another process works on

    def claim(self, name):
        return nullcontext(name not in self.elsewhere)

    def ready(self, leaf):
        return self.done

    def make(self, one, size):
        self._did(one.name)

    def train(self, one):
        assert one.init is None or one.init.key in self.done
        if one.key == self.stop_at:
            self.stop_at = ""
            raise KeyboardInterrupt
        self._did(one.key)

    def score(self, leaf):
        assert all(one.key in self.done for one in leaf.trainings)
        if leaf.name == self.fail:
            raise UserError("no such column")
        self.calls.append(leaf.key)
        return {"rows": []}

    def _did(self, name):
        assert name not in self.done, "made twice"
        self.calls.append(name)
        self.done.add(name)


def run(work, out, **options):
    lines: list[str] = []
    return execute(LEAVES, work, out / NAME, log=lines.append, **options), lines


def test_each_training_is_made_once_and_every_run_leaves_a_record(tmp_path):
    work = Notes()
    result, _ = run(work, tmp_path)
    assert (
        result.made
        == [leaf.key for leaf in LEAVES]
        == [name for name in work.calls if name in {leaf.key for leaf in LEAVES}]
    )
    keys = {one.key for leaf in LEAVES for one in leaf.trainings}
    assert sorted(set(work.calls) & keys) == sorted(keys) and work.calls[:4] == ["own", "fine", "coarse", "other"]
    stored = read_records(tmp_path / NAME)[LEAVES[0].key]
    assert stored["identity"] == LEAVES[0].identity and stored["seed"] == 0 and stored["question"] == LEAVES[0].question


def test_a_finished_run_is_not_repeated_and_one_of_other_settings_is(tmp_path):
    run(Notes(), tmp_path)
    work = Notes()
    result, lines = run(work, tmp_path)
    assert not result.made and not work.calls and not lines and len(result.kept) == len(LEAVES)
    write_record(tmp_path / NAME, LEAVES[2].key, {"identity": "of other settings"})
    result, _ = run(Notes(), tmp_path)
    assert result.made == [LEAVES[2].key]


def test_a_half_done_run_is_continued(tmp_path):
    last = LEAVES[1].trainings[-1].key
    work = Notes(stop_at=last)
    with pytest.raises(KeyboardInterrupt):
        run(work, tmp_path)
    assert [*read_records(tmp_path / NAME)] == [LEAVES[0].key]
    first = list(work.calls)
    result, _ = run(work, tmp_path)
    assert result.kept == [LEAVES[0].key] and result.made == [leaf.key for leaf in LEAVES[1:]]
    assert work.calls[len(first)] == last  # nothing that was there is made again


def test_a_run_that_fails_is_logged_and_the_others_go_on(tmp_path):
    result, lines = run(Notes(fail="no_text"), tmp_path)
    assert list(result.failed.values()) == ["no such column"] and "no_text-0 failed" in "\n".join(lines)
    assert len(result.made) == len(LEAVES) - 1 and "ablations-no_text-0" not in read_records(tmp_path / NAME)


def test_what_another_process_works_on_is_left_to_it(tmp_path):
    work, training = Notes(), LEAVES[0].trainings[0]
    need = [leaf for leaf in LEAVES if training in leaf.trainings]
    work.elsewhere = {"coarse", training.key, LEAVES[-1].key}

    def pause(seconds):  # meanwhile the other one finishes a thing
        assert seconds == PAUSE and work.elsewhere
        name = "coarse" if "coarse" in work.elsewhere else min(work.elsewhere)
        work.elsewhere.remove(name)
        if name == LEAVES[-1].key:
            write_record(tmp_path / NAME, name, {"identity": LEAVES[-1].identity})
        else:
            work.done.add(name)

    result, _ = run(work, tmp_path, pause=pause)
    assert 1 < len(need) < len(LEAVES) - 1 and LEAVES[-1] not in need
    assert result.kept == [LEAVES[-1].key] and sorted(result.made) == sorted(leaf.key for leaf in LEAVES[:-1])
    assert not {"coarse", training.key, LEAVES[-1].key} & set(work.calls)
    assert {leaf.key for leaf in need} == set(result.made[-len(need) :])  # the others did not wait for it


def test_a_claim_is_one_process_alone_and_ends_with_it(tmp_path):
    one, other = Work(tmp_path), Work(tmp_path)
    with one.claim("own") as first, other.claim("own") as second, other.claim("coarse") as third:
        assert first and not second and third
    with other.claim("own") as again:
        assert again
