"""Benchmarks of the simulator: its mechanics against a converged solution."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from experiments.benchmarks import simulator
from experiments.benchmarks.simulator import SCENES, PressSetting, SolverVariant, speed_against_error

SETTING = PressSetting(size=8.0)
VARIANTS = (
    SolverVariant("exact", 32),
    SolverVariant("exact", 16),
    SolverVariant("exact", 16, 1),
    SolverVariant("fast", 32),
)


@pytest.fixture(scope="module")
def rows():
    scenes = {name: SCENES[name] for name in ("sphere", "ring")}
    return speed_against_error(VARIANTS, scenes, setting=SETTING, reference=32, rounds=2)


@pytest.mark.slow
def test_a_row_a_variant_with_times_and_errors(rows):
    assert [(row.fidelity, row.grid, row.iterations) for row in rows] == [dataclasses.astuple(one) for one in VARIANTS]
    for row in rows:
        assert row.press_ms > 0 and row.shear_ms > 0
        assert set(row.rms) == set(row.largest) == set(row.image) == {"sphere", "ring"}
        assert all(0 <= row.rms[name] <= row.largest[name] < 1 for name in row.rms)
        assert np.isfinite([row.shear, row.force, *row.image.values()]).all()


@pytest.mark.slow
def test_the_reference_itself_has_no_error(rows):
    same = rows[0]
    assert max(same.largest.values()) < 1e-3 and same.force < 1e-3 and same.shear < 5e-3 and same.converged == 2
    assert max(same.image.values()) < 0.05  # a rounded grey level here and there


@pytest.mark.slow
def test_errors_are_reported(rows):
    same, coarse, hasty, quick = rows
    assert coarse.converged == 2 and hasty.converged < 2
    assert max(hasty.rms.values()) > max(coarse.rms.values()) > 5 * max(same.rms.values())
    assert max(same.rms.values()) < max(quick.rms.values()) < 0.05
    for name in ("sphere", "ring"):
        assert hasty.image[name] > coarse.image[name] > max(5 * same.image[name], 0.1)


def test_only_what_a_touch_changes_is_scored():
    bare, right = np.zeros((4, 4, 3)), np.zeros((4, 4, 3))
    right[0, 0] = 30, 0, 0
    result = right.copy()
    result[0, 0, 0], result[3, 3] = 24, 9
    assert simulator._picture_error(result, right, bare) == 2 and simulator._picture_error(result, bare, bare) == 0


@pytest.mark.slow
def test_shear_moves_the_markers_of_the_picture():
    still, pushed = np.zeros((32, 32)), np.full((32, 32), 0.1)
    aside = np.zeros((32, 32, 2))
    aside[..., 0] = 0.4
    pictures = [simulator._picture(pushed, moved, SETTING) for moved in (np.zeros_like(aside), aside)]
    assert abs(pictures[1] - pictures[0]).mean() > 1
    assert pictures[0].shape == simulator._picture(still, aside, SETTING).shape == (224, 299, 3)


def test_own_scenes_are_pressed_and_not_empty():
    for name, surface in SCENES.items():
        heights = simulator._heights(PressSetting(), surface, 64)
        assert heights.shape == (64, 64), name
        assert -0.1 < heights.max() <= 0 and (heights + PressSetting().depth > 0).sum() > 20


def test_mistakes_are_named():
    for variants, scenes, rounds in (((), SCENES, 1), (VARIANTS, {}, 1), (VARIANTS, SCENES, 0)):
        with pytest.raises(UserError, match="at least one"):
            speed_against_error(variants, scenes, rounds=rounds)
