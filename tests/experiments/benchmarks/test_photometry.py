"""Real presses against rendered ones."""

from __future__ import annotations

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.sim.sensing.calibration import PITCH, Presses
from experiments.benchmarks import photometry
from experiments.benchmarks.photometry import Renderer, Score

RNG = np.random.default_rng(0)
REAL = RNG.integers(60, 200, (40, 50, 3), dtype=np.uint8)


def test_measures_of_known_differences():
    same = photometry.measure(REAL, REAL, np.array([25.0, 20.0]), 8)
    np.testing.assert_allclose(same, [0, 10 * np.log10(255**2 / 1e-6), 1, 0], atol=1e-9)
    mae, psnr, ssim, ring = photometry.measure(REAL + 3, REAL, np.array([25.0, 20.0]), 8)
    assert mae == ring == 3
    np.testing.assert_allclose(psnr, 20 * np.log10(255 / 3))
    assert 0.98 < ssim < 1
    rows, columns = np.mgrid[:40, :50]
    inside = np.hypot(columns - 25, rows - 20) < 8
    outer = np.where(inside[..., None], REAL, 0)
    mae, _, _, ring = photometry.measure(outer, REAL, np.array([25.0, 20.0]), 8)
    assert mae == 0 and ring > 100


def test_structure_is_lost_in_noise_and_not_in_brightness():
    noise = RNG.integers(60, 200, REAL.shape, dtype=np.uint8)
    assert photometry.ssim_map(noise, REAL).mean() < 0.1
    np.testing.assert_allclose(photometry.ssim_map(REAL, noise), photometry.ssim_map(noise, REAL))
    one = np.full((12, 12, 1), 100, np.uint8)
    c1 = (0.01 * 255) ** 2
    expected = (2 * 100 * 120 + c1) / (100**2 + 120**2 + c1)
    np.testing.assert_allclose(photometry.ssim_map(one, np.full_like(one, 120)).ravel(), expected, rtol=1e-6)


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

    rows = photometry.compare(
        "s", stub(), np.array([1, 2]), [renderer("ours", 2), renderer("other", 5, in_sample=True, timed=False)]
    )
    assert calls == [("ours", 1), ("other", 1), ("ours", 1), ("other", 1), ("ours", 2), ("other", 2)]
    assert [(r.renderer, r.presses, r.mae, r.in_sample) for r in rows] == [("ours", 2, 2, False), ("other", 2, 5, True)]
    assert rows[0].ms is not None and rows[1].ms is None
    with pytest.raises(UserError, match="no press of s"):
        photometry.compare("s", stub(), np.array([], int), [])


def test_the_table_states_ratios_and_what_is_in_sample():
    rows = [
        Score("a", "ours", 2, 3.0, 30.0, 0.95, 2.0, 10.0, False),
        Score("a", "taxim", 2, 4.0, 29.0, 0.94, 5.0, 85.0, True),
        Score("a", "background only", 2, 20.0, 19.0, 0.9, 9.0, None, False),
    ]
    lines = photometry.to_markdown(rows).splitlines()
    assert len(lines) == 5 and all(line.count("|") == lines[0].count("|") for line in lines)
    assert lines[2] == "| a | ours | 2 | 3.00 | 30.00 | 0.9500 | 2.00 | 10.0 | 1.0 |"
    assert "taxim (in-sample)" in lines[3] and lines[3].endswith("| 85.0 | 8.5 |")
    assert lines[4].endswith("| 9.00 |  |  |")


def test_taxims_ball_meets_its_gel_on_the_circle():
    gel = np.full((120, 160), -0.3)
    height = photometry.taxim_height(np.array([80.0, 60.0]), 30, 2.0, gel)
    np.testing.assert_allclose(height[60, 110], -0.3, atol=1e-6)  # 30 pixels to the right
    depth = 2 - np.sqrt(4 - (30 * PITCH) ** 2)
    np.testing.assert_allclose(height.min(), -0.3 - depth, atol=1e-9)  # smaller is nearer to the camera
    assert height[0, 0] == 1


def test_held_out_presses_are_drawn_close_to_the_real_ones():
    rows = photometry.score(("gelsight",), limit=2, rivals=False)
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
        rows = photometry.score((name,), limit=6)
        ours = next(r for r in rows if r.renderer == "ours")
        rivals = [r for r in rows if r.renderer.startswith("taxim")]
        assert len(rivals) >= 2 and all(r.in_sample for r in rivals)
        assert ours.mae < min(r.mae for r in rivals)
        assert ours.psnr > max(r.psnr for r in rivals)
        assert ours.ring_mae < min(r.ring_mae for r in rivals)
