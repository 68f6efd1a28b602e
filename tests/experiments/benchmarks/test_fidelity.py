"""The table of speed against error, at a size for tests."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from experiments.benchmarks import fidelity
from experiments.benchmarks.fidelity import SCENES, Row, Setting, Variant, speed_against_error, to_markdown

SETTING = Setting(size=8.0)
VARIANTS = (Variant("exact", 32), Variant("exact", 16), Variant("exact", 16, 1), Variant("fast", 32))


@pytest.fixture(scope="module")
def rows():
    scenes = {name: SCENES[name] for name in ("sphere", "ring")}
    return speed_against_error(VARIANTS, scenes, setting=SETTING, reference=32, rounds=2)


def test_a_row_a_variant_with_times_and_errors(rows):
    assert [(row.fidelity, row.grid, row.iterations) for row in rows] == [dataclasses.astuple(one) for one in VARIANTS]
    for row in rows:
        assert row.press_ms > 0 and row.shear_ms > 0
        assert set(row.rms) == set(row.largest) == set(row.image) == {"sphere", "ring"}
        assert all(0 <= row.rms[name] <= row.largest[name] < 1 for name in row.rms)
        assert np.isfinite([row.shear, row.force, *row.image.values()]).all()


def test_the_reference_itself_has_no_error(rows):
    same = rows[0]
    assert max(same.largest.values()) < 1e-3 and same.force < 1e-3 and same.shear < 5e-3 and same.converged == 2
    assert max(same.image.values()) < 0.05  # a rounded grey level here and there


def test_errors_are_told(rows):
    same, coarse, hasty, quick = rows
    assert coarse.converged == 2 and hasty.converged < 2
    assert max(hasty.rms.values()) > max(coarse.rms.values()) > 5 * max(same.rms.values())
    assert max(same.rms.values()) < max(quick.rms.values()) < 0.05
    for name in ("sphere", "ring"):
        assert hasty.image[name] > coarse.image[name] > max(5 * same.image[name], 0.1)


def test_only_what_a_touch_changes_is_scored():
    bare, right = np.zeros((4, 4, 3)), np.zeros((4, 4, 3))
    right[0, 0] = 30, 0, 0
    found = right.copy()
    found[0, 0, 0], found[3, 3] = 24, 9
    assert fidelity._picture_error(found, right, bare) == 2 and fidelity._picture_error(found, bare, bare) == 0


def test_shear_moves_the_markers_of_the_picture():
    still, pushed = np.zeros((32, 32)), np.full((32, 32), 0.1)
    aside = np.zeros((32, 32, 2))
    aside[..., 0] = 0.4
    pictures = [fidelity._picture(pushed, moved, SETTING) for moved in (np.zeros_like(aside), aside)]
    assert abs(pictures[1] - pictures[0]).mean() > 1
    assert pictures[0].shape == fidelity._picture(still, aside, SETTING).shape == (224, 299, 3)


def test_markdown_and_json(rows):
    lines = to_markdown(rows).splitlines()
    assert len(lines) == 2 + len(rows)
    assert len({line.count("|") for line in lines}) == 1
    assert "sphere: rms / max %" in lines[0] and "ring: picture" in lines[0]
    assert lines[2].startswith("| exact | 32 | own |") and lines[4].startswith("| exact | 16 | 1 |")
    assert Row(**json.loads(json.dumps(dataclasses.asdict(rows[0])))) == rows[0]


def test_own_scenes_are_pressed_and_not_empty():
    for name, surface in SCENES.items():
        heights = fidelity._heights(Setting(), surface, 64)
        assert heights.shape == (64, 64), name
        assert -0.1 < heights.max() <= 0 and (heights + Setting().depth > 0).sum() > 20


def test_mistakes_are_named():
    for variants, scenes, rounds in (((), SCENES, 1), (VARIANTS, {}, 1), (VARIANTS, SCENES, 0)):
        with pytest.raises(UserError, match="at least one"):
            speed_against_error(variants, scenes, rounds=rounds)
