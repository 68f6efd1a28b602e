"""Pictures of the questions, from records alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import synthetic

from experiments.tables import pictures, plan
from experiments.tables.results import read

LEAVES = plan.leaves(plan.FULL)


def test_the_four_spaces_have_a_mark_for_every_touch_and_sensor(tmp_path):
    synthetic.write(tmp_path / "matrix.jsonl", [leaf for leaf in LEAVES if leaf.question == "q2" and leaf.seed == 0])
    runs = read(tmp_path / "matrix.jsonl")
    path = pictures.q2(runs, tmp_path / "four.png")
    whole = cv2.imread(str(path)).shape[1]
    partly = pictures.q2([run for run in runs if run.name in ("masked", "matched")], tmp_path / "two.png")
    assert abs(cv2.imread(str(partly)).shape[1] - whole / 2) < 8
    assert pictures.q2(runs, tmp_path / "none.png", seed=5) is None and not (tmp_path / "none.png").exists()
    coloured = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2HSV)
    hues = np.unique(coloured[..., 0][coloured[..., 1] > 120])
    assert len(hues) > 8  # a colour a touch


@pytest.mark.slow
def test_the_four_spaces_are_of_one_seed(tmp_path):
    synthetic.write(tmp_path / "matrix.jsonl", [leaf for leaf in LEAVES if leaf.question == "q2" and leaf.seed != 0])
    runs = [run for run in read(tmp_path / "matrix.jsonl") if (run.name, run.seed) != ("masked", 1)]
    chosen, reported = pictures.q2(runs, tmp_path / "a.png"), pictures.q2(runs, tmp_path / "b.png", seed=2)
    assert chosen.read_bytes() == reported.read_bytes()  # masked has no seed 1, so all are of seed 2
    first = pictures.q2(read(tmp_path / "matrix.jsonl"), tmp_path / "first.png")
    assert first.read_bytes() == pictures.q2(read(tmp_path / "matrix.jsonl"), tmp_path / "one.png", seed=1).read_bytes()
    apart = [run for run in runs if (run.name == "masked") == (run.seed == 2)]
    assert pictures.q2(apart, tmp_path / "c.png") is None


@pytest.mark.slow
def test_a_touch_without_points_in_one_space_is_left_out_of_it(tmp_path):
    synthetic.write(tmp_path / "matrix.jsonl", [leaf for leaf in LEAVES if leaf.question == "q2" and leaf.seed == 0])
    runs = read(tmp_path / "matrix.jsonl")
    matched = next(run for run in runs if run.name == "matched")
    matched.about["points"] = [point for point in matched.about["points"] if point["touch"] != 3]
    assert pictures.q2(runs, tmp_path / "four.png") is not None
