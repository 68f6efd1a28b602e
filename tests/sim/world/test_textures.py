import math

import numpy as np
import pytest

from anytouch_jax.sim.world.shapes import GRAINS, TEXTURES, Shape, height


def axes(count, pitch):
    axis = (np.arange(count) - (count - 1) / 2) * pitch
    return np.meshgrid(axis, axis)


PERIODS = {
    "ridges": [(1.0, 0.0), (0.0, 0.37)],
    "grid": [(1.0, 0.0), (0.0, 1.0)],
    "dots": [(1.0, 0.0), (0.5, math.sqrt(0.75))],
    "weave": [(1.0, 1.0), (2.0, 0.0)],
    "knit": [(1.0, 0.0), (0.0, 0.75)],
}


@pytest.mark.parametrize("texture", PERIODS)
def test_patterns_repeat_at_their_pitch_and_not_before(texture):
    pitch = 1.7
    x, y = axes(64, 0.11)
    u = x + 20
    v = y - 30
    t = TEXTURES[texture](u, v, pitch, 3)
    assert t.min() >= 0 and t.max() <= 1 and np.ptp(t) > 0.9
    for du, dv in PERIODS[texture]:
        np.testing.assert_allclose(
            TEXTURES[texture](u + du * pitch, v + dv * pitch, pitch, 3), t, atol=1e-9
        )
        if (du, dv) != (0.0, 0.37):
            half = TEXTURES[texture](u + du * pitch / 2, v + dv * pitch / 2, pitch, 3)
            assert np.abs(half - t).max() > 0.15


@pytest.mark.parametrize("name", [*TEXTURES, *GRAINS])
def test_an_open_grid_gives_what_full_arrays_give(name):
    function = {**TEXTURES, **GRAINS}[name]
    x, y = axes(24, 0.3)
    full = function(x, y, 1.3, 5)
    np.testing.assert_allclose(
        np.broadcast_to(function(x[:1], y[:, :1], 1.3, 5), x.shape), full, atol=1e-9
    )
    assert full.min() >= 0 and full.max() <= 1


@pytest.mark.parametrize(
    ("texture", "pitch", "depth"), [("sand", 0.9, 0.12), ("sand", 2.0, 0.4), ("bark", 1.1, 0.3)]
)
def test_roughness_has_the_rms_and_the_correlation_lengths_that_it_states(texture, pitch, depth):
    fractions = {"sand": (12.0**-0.5, 0.35, 0.35), "bark": (0.31, 0.27, 1.03)}[texture]
    rms = fractions[0] * depth
    lengths = np.multiply(fractions[1:], pitch)
    step = min(lengths) / 5
    x, y = axes(200, step)
    found_rms = []
    found_lengths = []
    for seed in range(6):
        z = height(Shape("flat", texture, 1e3, pitch, depth, seed=seed), x, y)
        z = z - z.mean()
        found_rms.append(z.std())
        correlation = np.real(np.fft.ifft2(np.abs(np.fft.fft2(z)) ** 2))
        found_lengths.append(
            [falls(line[:100]) * step for line in (correlation[0], correlation[:, 0])]
        )
    assert np.mean(found_rms) == pytest.approx(rms, rel=0.03)
    np.testing.assert_allclose(np.mean(found_lengths, axis=0), lengths, rtol=0.1)
    if texture == "sand":
        assert np.mean(found_lengths) == pytest.approx(lengths[0], rel=0.04)


def falls(line):
    """Where a correlation falls to 1/e, in steps."""
    line = line / line[0]
    at = int(np.argmax(line < 1 / math.e))
    return at - 1 + (line[at - 1] - 1 / math.e) / (line[at - 1] - line[at])
