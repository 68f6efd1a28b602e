import numpy as np
import pytest

from experiments.pouring import table as pouring_table
from experiments.pouring.physics import Task
from experiments.pouring.trials import Trials
from experiments.records import write_record

TASK, RESULTS = Task(), "pouring.jsonl"


def write(folder, name, mode, poured, seed=0, **settings):
    steps = np.where(np.asarray(poured) == 100, TASK.limit, 9)
    trials = Trials(np.asarray(poured), steps, *[np.zeros((1, 1))] * 5, None)
    record = pouring_table.record(name, mode, seed, trials, TASK, "runs/x", {"trials": len(poured)} | settings, {})
    write_record(folder / RESULTS, f"{name}-{mode}-{seed}", record)


def test_differences_are_paired_run_by_run(tmp_path):
    write(tmp_path, "anytouch", "frozen", [60, 70, 80])
    write(tmp_path, "static", "frozen", [61, 71, 81])
    write(tmp_path, "static", "frozen", [0, 0, 0], seed=1)
    rows = {row.name: row for row in pouring_table.read_rows(tmp_path / RESULTS)}
    found = pouring_table.difference(rows["anytouch"], rows["static"])
    assert found == (-1, None, None, 1) and not found.differs  # one seed is shared: one learned policy each
    assert len(rows["static"].runs) == 6


def test_a_sign_is_decided_over_seeds_not_over_runs(tmp_path):
    for seed, worse in enumerate((0.1, 8.0, 16.0)):  # ten runs each would be sure of it; three policies are not
        write(tmp_path, "anytouch", "frozen", np.full(10, 61.0), seed)
        write(tmp_path, "static", "frozen", np.full(10, 61.0 + worse), seed)
    rows = {row.name: row for row in pouring_table.read_rows(tmp_path / RESULTS)}
    found = pouring_table.difference(rows["anytouch"], rows["static"])
    assert found.low < 0 < found.high and not found.differs
    mean, low, high, _ = rows["static"].error
    assert (
        mean == pytest.approx(9 + 1 / 30) and low < 0 and high - mean == pytest.approx(4.303 * 7.95 / 3**0.5, rel=1e-3)
    )
