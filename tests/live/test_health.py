from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
from checked_world import columns

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.live import health
from anytouch_jax.live.health import UnitFrames
from experiments.real.faults import FAULTS, LAYOUT, each, most_different

SHARED = Path(__file__).parents[3] / "shared"


def gel(number: int = 0) -> np.ndarray:
    """A gel 120 x 160 with coloured light from three sides, and a grain that the camera sees."""
    y, x = np.mgrid[-1:1:120j, -1:1:160j]
    light = [
        np.exp(-((x - cx) ** 2 + (y - cy) ** 2)) for cx, cy in ((-1, 0.3), (0.9, -0.8), (0.3, 1.1))
    ]
    tint = np.array([1.0, 0.9, 1.1]) + 0.02 * number
    rng = np.random.default_rng(number)
    # weave, and noise
    grain = rng.normal(0, 4, (120, 160, 1)) + 11 * np.sin(np.pi / 4 * np.arange(160))[:, None]
    return np.clip(60 + 110 * np.stack(light, 2) * tint + grain, 0, 250).astype(np.uint8)


def made_unit(number: int = 0, recordings: int = 9, frames: int = 2) -> UnitFrames:
    """Presses at changing places, with camera noise."""
    rng = np.random.default_rng(100 + number)
    background = gel(number)
    videos = []
    y, x = np.mgrid[:120, :160]
    for _ in range(recordings):
        cy, cx = rng.uniform((20, 20), (100, 140))
        dent = np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / 160)[..., None] * (60, -40, 30)
        video = [
            background + depth * dent + rng.normal(0, 1.5, background.shape)
            for depth in np.linspace(0.3, 1, frames)
        ]
        videos.append([np.clip(frame, 0, 255).astype(np.uint8) for frame in video])
    return UnitFrames("digit", f"u{number}", videos, background, np.ones(400), recordings * frames)


UNITS = [made_unit(number) for number in range(4)]
REFERENCES = [gel(number) for number in range(10, 16)]


def check(unit: UnitFrames, name: str, others=()) -> health.Check:
    (one,) = health.examine(unit, REFERENCES, others, only=name).checks
    assert one.name == name
    return one


def large(unit: UnitFrames) -> UnitFrames:
    return each(unit, lambda frame: cv2.resize(frame, None, fx=2, fy=2))


def test_good_units_raise_no_alarm():
    for result in health.check_units([large(unit) for unit in UNITS], {"digit": REFERENCES}):
        assert result.verdict == "good" and not result.faults
        assert all(one.ok for one in result.checks), [one for one in result.checks if not one.ok]


@pytest.mark.parametrize("fault", [name for name in FAULTS if name != "two units mixed"])
def test_a_made_fault_is_reported_by_its_check_with_advice(fault):
    name, make = FAULTS[fault]
    for unit in UNITS[:2]:
        unit = large(unit) if name == "focus" else unit
        found = check(make(unit, None, np.random.default_rng(0)), name)
        assert found.ok is False and found.advice, (fault, found)
        if name == LAYOUT:
            assert fault in found.value


def test_a_good_unit_that_looks_odd_raises_no_alarm():
    """Too small an image, deep touches of a soft gel, and one odd reference of three."""
    assert check(UNITS[0], "focus").ok is None
    rng = np.random.default_rng(1)
    deep = []
    for frames in UNITS[0].recordings:
        press = cv2.resize(
            rng.uniform(-90, 90, (3, 4, 3)), (160, 120), interpolation=cv2.INTER_CUBIC
        )
        deep.append([np.clip(frame + press, 0, 255).astype(np.uint8) for frame in frames])
    assert check(replace(UNITS[0], recordings=deep), "one unit").ok
    own, *noise = rng.uniform(-60, 60, (4, 16, 16, 3))
    # of the image and its mirror image: the last is odd
    fractions = ((0.8, 0.7), (0.8, 0.7), (0.3, 0.9))
    known = [
        a * own + b * own[:, ::-1] + 0.2 * grain
        for (a, b), grain in zip(fractions, noise, strict=True)
    ]
    own, *known = (np.clip(128 + look, 0, 255).astype(np.uint8) for look in (own, *known))
    assert health.check_layout(replace(UNITS[0], background=own), known).ok


@pytest.mark.parametrize("sensor", ["gelsight_mini", "digit"])
def test_a_lamp_that_is_stronger_is_no_fault_and_a_turned_or_recoloured_unit_is(sensor):
    """Real units of a family, each against the others.

    One side is up to a fifth brighter in one colour.
    """
    for number, background_of_unit in enumerate(backgrounds := health.known_backgrounds(sensor)):
        others = backgrounds[:number] + backgrounds[number + 1 :]
        side = np.linspace(-1, 1, background_of_unit.shape[1])
        for colour, fraction in product(range(3), (-0.2, -0.1, 0.1, 0.2)):
            gain = 1 + fraction * side[:, None] * (np.arange(3) == colour)
            lit = np.clip(background_of_unit * gain, 0, 255).astype(np.uint8)
            assert health.check_layout(UnitFrames(sensor, "", [[lit]]), others).ok
        for wrong in (
            background_of_unit[::-1, ::-1],
            background_of_unit[::-1],
            background_of_unit[..., ::-1],
        ):
            assert (
                health.check_layout(
                    UnitFrames(sensor, "", [[np.ascontiguousarray(wrong)]]), others
                ).ok
                is False
            )


def test_recordings_of_another_unit_are_reported():
    other = made_unit(3)
    dark = replace(
        other,
        recordings=[[f // 2 for f in r] for r in other.recordings],
        background=other.background // 2,
    )
    assert most_different(UNITS[0], [UNITS[0], dark]) is dark
    mixed = FAULTS["two units mixed"][1](UNITS[0], dark, np.random.default_rng(0))
    found = check(mixed, "one unit", [dark])
    assert found.ok is False and "look like u3" in found.value
    assert check(mixed, "one unit").ok is False


def test_what_cannot_be_decided_is_no_alarm():
    still = UnitFrames("digit", "", [[gel()]])
    result = health.examine(still)
    assert result.verdict == "good"
    assert {one.name for one in result.checks if one.ok is None} >= {
        LAYOUT,
        "frozen frames",
        "background",
        "one unit",
    }
    smooth = replace(
        UNITS[0],
        recordings=[[cv2.GaussianBlur(f, (0, 0), 12) for f in r] for r in UNITS[0].recordings],
    )
    assert check(smooth, "focus").ok is None
    odd = replace(UNITS[0], background=UNITS[0].background[:, :80])
    assert check(odd, "background").ok is None


def test_contact_that_features_show_is_visible():
    rng = np.random.default_rng(0)
    contact = np.arange(60) % 2 == 0
    features = rng.standard_normal((60, 5))
    assert health.contact_visible(features + 2 * contact[:, None], contact).ok is True
    alarms = [
        health.contact_visible(rng.standard_normal((60, 5)), contact, 50).ok is True
        for _ in range(60)
    ]
    assert np.mean(alarms) < 0.2  # 5 % by chance
    assert health.contact_visible(features, np.zeros(60, bool)).ok is None


def test_units_of_a_manifest_are_read_with_their_gaps(tmp_path):
    frames = [0, 1, 2, 4, 0, 1, 2, 3]
    table = columns(
        8,
        unit=["a"] * 8,
        sequence=["s0"] * 4 + ["s1"] * 4,
        frame_index=frames,
        background_path=["gel.png"] * 8,
    )
    cv2.imwrite(str(tmp_path / "gel.png"), gel()[..., ::-1])
    for number in range(8):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((120, 160, 3), 10 * number, np.uint8))
    (tmp_path / "0.png").write_bytes(b"damaged")
    (unit,) = health.read_units(manifests.from_columns(table, tmp_path / "m.parquet"))
    assert (unit.sensor, unit.unit, unit.rows, [len(r) for r in unit.recordings]) == (
        "digit",
        "a",
        8,
        [3, 4],
    )
    np.testing.assert_array_equal(unit.steps, [1, 1, 2, 1, 1, 1])
    np.testing.assert_array_equal(unit.background, gel())
    health.health_sheet([health.examine(unit)], tmp_path / "h.png")
    assert decode(tmp_path / "h.png").shape == (132, 720, 3)


@pytest.mark.skipif(not (SHARED / "real_touch").is_dir(), reason="the real packs are not here")
@pytest.mark.slow
@pytest.mark.parametrize("pack", ["real_touch", "real_touch2"])
def test_real_units_raise_no_alarm(pack):
    units = [
        unit
        for unit in health.read_units(manifests.read(SHARED / pack / "manifest.csv"))
        if "unknown" not in unit.unit
    ]
    assert {unit.unit: unit.verdict for unit in health.check_units(units, {}) if unit.faults} == {}
