"""Layout of images: turned, mirrored and recoloured ones are found, and correct ones are not."""

import numpy as np
import pytest

import anytouch_jax as at
from anytouch_jax.data.background.layout import UnitFrames, check_layout, known_backgrounds
from anytouch_jax.fields.faults import faults_of


def checked(sensor: str, gel: np.ndarray, others: list[np.ndarray], **options):
    unit = UnitFrames(sensor, "", [[np.ascontiguousarray(gel)]])
    return check_layout(unit, others, **options)


@pytest.mark.parametrize("sensor", ["gelsight_mini", "digit"])
def test_turns_may_be_allowed_and_exchanged_colours_are_still_found(sensor):
    backgrounds = known_backgrounds(sensor)
    for number, gel in enumerate(backgrounds):
        others = backgrounds[:number] + backgrounds[number + 1 :]
        # upside down, or in a mirror: a GelSight Mini looks the same in one from left to right
        for turned in (gel[::-1, ::-1], gel[::-1]):
            found = checked(sensor, turned, others)
            assert found.ok is False
            assert "--rotate 180" in found.advice or "--flip" in found.advice
        for one in (gel, gel[:, ::-1], gel[::-1, ::-1], gel[::-1]):
            assert checked(sensor, one, others, may_be_turned=True).ok
        found = checked(sensor, gel[..., ::-1], others, may_be_turned=True)
        assert found.ok is False and "red and blue exchanged" in found.value


def test_no_example_of_the_package_is_called_faulty():
    """Simulated instances are mirrored half of the time, one of these examples among them."""
    for touch in at.example_touches():
        for frame in (touch.frame, touch.background):
            assert faults_of(frame, touch.background, touch.sensor, None) == (), touch.press
    ring = next(one for one in at.example_touches() if (one.press, one.sensor) == ("ring", "digit"))
    # its own image is what tells that it was made so
    assert faults_of(ring.frame, None, "digit", None)
    assert faults_of(ring.frame[:, ::-1], ring.background, "digit", None)


def test_a_background_that_shows_a_press_is_a_fault():
    for touch in at.example_touches():
        if touch.press == "ring":  # the other press looks like the dots of a gel
            swapped = faults_of(touch.background, touch.frame, touch.sensor, None)
            assert any("shows a press" in fault for fault in swapped), touch.sensor


def test_an_unknown_family_has_no_references():
    assert known_backgrounds("duragel") == known_backgrounds("new_finger") == []
    found = checked("duragel", np.zeros((30, 40, 3), np.uint8), [])
    assert found.ok is None and found.value == "no reference of this sensor"
