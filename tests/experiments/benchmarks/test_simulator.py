"""Benchmarks of the simulator: its mechanics against a converged solution, its pictures against real presses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from experiments.benchmarks import simulator
from experiments.benchmarks.presses import PITCH, Presses
from experiments.benchmarks.simulator import SCENES, PressSetting, Renderer, SolverVariant, speed_against_error

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


# Pictures against real ones -------------------------------------------------------------------------------------------

RNG = np.random.default_rng(0)
REAL = RNG.integers(60, 200, (40, 50, 3), dtype=np.uint8)


def test_measures_of_known_differences():
    same = simulator.image_errors(REAL, REAL, np.array([25.0, 20.0]), 8)
    np.testing.assert_allclose(same, [0, 10 * np.log10(255**2 / 1e-6), 1, 0], atol=1e-9)
    mae, psnr, ssim, ring = simulator.image_errors(REAL + 3, REAL, np.array([25.0, 20.0]), 8)
    assert mae == ring == 3
    np.testing.assert_allclose(psnr, 20 * np.log10(255 / 3))
    assert 0.98 < ssim < 1
    rows, columns = np.mgrid[:40, :50]
    inside = np.hypot(columns - 25, rows - 20) < 8
    outer = np.where(inside[..., None], REAL, 0)
    mae, _, _, ring = simulator.image_errors(outer, REAL, np.array([25.0, 20.0]), 8)
    assert mae == 0 and ring > 100


def test_structure_is_lost_in_noise_and_not_in_brightness():
    noise = RNG.integers(60, 200, REAL.shape, dtype=np.uint8)
    assert simulator.ssim_map(noise, REAL).mean() < 0.1
    np.testing.assert_allclose(simulator.ssim_map(REAL, noise), simulator.ssim_map(noise, REAL))
    one = np.full((12, 12, 1), 100, np.uint8)
    c1 = (0.01 * 255) ** 2
    expected = (2 * 100 * 120 + c1) / (100**2 + 120**2 + c1)
    np.testing.assert_allclose(simulator.ssim_map(one, np.full_like(one, 120)).ravel(), expected, rtol=1e-6)


def stub(count=3):
    centre = np.tile([25.0, 20.0], (count, 1))
    radius = np.full(count, 8.0)
    frames = np.stack([REAL + k for k in range(count)])
    return Presses(REAL, frames, centre, radius, np.concatenate([centre, radius[:, None]], 1))


def test_renderers_take_turns_and_a_first_drawing_is_not_counted():
    calls = []

    def renderer(name, offset, **settings):
        def draw(k):
            calls.append((name, k))
            return REAL + k + offset

        return Renderer(name, lambda k: np.uint8(k), draw, **settings)

    rows = simulator.compare_renderers(
        "s", stub(), np.array([1, 2]), [renderer("ours", 2), renderer("other", 5, in_sample=True, timed=False)]
    )
    assert calls == [("ours", 1), ("other", 1), ("ours", 1), ("other", 1), ("ours", 2), ("other", 2)]
    assert [(r.renderer, r.presses, r.mae, r.in_sample) for r in rows] == [("ours", 2, 2, False), ("other", 2, 5, True)]
    assert rows[0].ms is not None and rows[1].ms is None
    with pytest.raises(UserError, match="no press of s"):
        simulator.compare_renderers("s", stub(), np.array([], int), [])


def test_taxims_ball_meets_its_gel_on_the_circle():
    gel = np.full((120, 160), -0.3)
    height = simulator.taxim_height(np.array([80.0, 60.0]), 30, 2.0, gel)
    np.testing.assert_allclose(height[60, 110], -0.3, atol=1e-6)  # 30 pixels to the right
    depth = 2 - np.sqrt(4 - (30 * PITCH) ** 2)
    np.testing.assert_allclose(height.min(), -0.3 - depth, atol=1e-9)  # smaller is nearer to the camera
    assert height[0, 0] == 1


@pytest.mark.slow
def test_held_out_presses_are_drawn_close_to_the_real_ones():
    rows = simulator.score_presses(("gelsight",), limit=2, rivals=False)
    assert [r.renderer for r in rows] == ["background only", "ours", "ours, no shadow"]
    plain, ours, hard = rows
    assert ours.mae < 5 and ours.mae < plain.mae / 4
    assert ours.ring_mae < plain.ring_mae / 2
    assert ours.psnr > plain.psnr + 10 and ours.ssim > plain.ssim
    assert hard.mae < plain.mae / 3
    assert not any(r.in_sample for r in rows)


@pytest.mark.slow
def test_no_worse_than_taxim_on_its_own_presses():
    for name in ("gelsight", "gelsight_mini"):
        rows = simulator.score_presses((name,), limit=6)
        ours = next(r for r in rows if r.renderer == "ours")
        rivals = [r for r in rows if r.renderer.startswith("taxim")]
        assert len(rivals) >= 2 and all(r.in_sample for r in rivals)
        assert ours.mae < min(r.mae for r in rivals)
        assert ours.psnr > max(r.psnr for r in rivals)
        assert ours.ring_mae < min(r.ring_mae for r in rivals)
