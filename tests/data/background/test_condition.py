"""The condition of a sensor: each state is told from the others on images of a made gel."""

import cv2
import numpy as np
import pytest
from ball_presses import POSES, presses

from anytouch_jax.data.background.condition import STATES, check_condition
from anytouch_jax.errors import UserError


def gel(seed: int, side: int = 160) -> np.ndarray:
    """Return a gel f64 (120, 160, 3): broad colours, and details of its own."""
    rng = np.random.default_rng(seed)
    broad = cv2.resize(rng.normal(0, 25, (3, 4, 3)), (side, 120), interpolation=cv2.INTER_CUBIC)
    fine = cv2.GaussianBlur(rng.normal(0, 6, (120, side, 1)), (0, 0), 1.2)[..., None]
    return 120 + broad + fine


def filmed(image: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1.3, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def scaled(one: np.ndarray, other: np.ndarray, levels: float) -> np.ndarray:
    change = other - one
    return one + change * levels / np.sqrt((change**2).mean())


@pytest.mark.parametrize("seed", range(5))
def test_states_are_told_apart(seed):
    one = gel(seed)
    scratched = one.copy()
    for shift in (0, 40):
        cv2.line(scratched, (30 + shift, 20), (60 + shift, 90), (170, 172, 168), 1)
    x = np.linspace(-0.5, 0.5, one.shape[1])[None, :, None]
    made = presses(POSES[2:3], seed=seed)
    images = {
        "same": one + 1,
        "gel": scaled(one, gel(100 + seed), 15),
        "device": scaled(one, gel(200 + seed), 27),
        "worn": scratched,
        "light": one * (1.1 + np.array([0.1, -0.05, 0.02]) + 0.15 * x),
        "pressed": one + (made.frames[0].astype(float) - made.background),
    }
    wrong = []
    for state, image in images.items():
        found = check_condition(filmed(one, seed), filmed(image, 50 + seed))
        assert set(found.probabilities) == set(STATES)
        assert sum(found.probabilities.values()) == pytest.approx(1)
        if found.state != state:
            wrong.append((state, found.state))
    # Another gel and another device differ in size alone here.
    assert [pair for pair in wrong if set(pair) != {"gel", "device"}] == []


def test_an_unchanged_gel_gives_no_alarm():
    alarms = [
        check_condition(filmed(gel(seed), seed), filmed(gel(seed), 1000 + seed)).state != "same"
        for seed in range(40)
    ]
    assert not any(alarms)


def test_images_of_other_proportions_are_refused():
    with pytest.raises(UserError, match="other proportions"):
        check_condition(filmed(gel(0), 0), filmed(gel(0)[:80], 0))
