"""Condition of a sensor: its background of today beside the stored one.

The same gel, another gel, another device, a worn gel, other light, or something that presses:
features of the two images tell these states apart, with probabilities (multinomial logistic
regression). It was fitted to simulated pairs at distances that were measured in public: another gel
on one device differs by 15 grey levels (root mean square), another device by 26, and noise is 1.3
(`experiments.real.states`, which fits it, and counts how often it is right).
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.data.background.estimate import scale_image
from anytouch_jax.errors import UserError
from anytouch_jax.files import read_arrays

Array = npt.NDArray[Any]
STATES = ("same", "gel", "device", "worn", "light", "pressed")
# What a state is called, and what to do.
WORDS = {
    "same": ("the same gel", "Go on."),
    "gel": (
        "another gel",
        "Record its background, and calibrate it: anytouch sensor calibrate.",
    ),
    "device": (
        "another device",
        "Name its own sensor, or calibrate it: anytouch sensor calibrate.",
    ),
    "worn": (
        "a worn or damaged gel",
        "Clean it and look at it. If it stays, exchange the gel and calibrate it.",
    ),
    "light": ("the same gel in other light", "Record the background again."),
    "pressed": (
        "something presses on the gel",
        "Take it off, and record the background again.",
    ),
}
FILE = "condition.npz"
# An unchanged gel is called so as long as this much speaks for it: a false alarm is worse than a
# change that is noticed with the next background.
_SAME = 0.05
_TRIMMED = 0.6  # fraction of the pixels that a change of light is fitted to
_ROUNDS = 4
_SIDE = 160
_BORDER = 3
_NOTHING = 0.3  # grey levels
_SHAPE = 0.03  # difference of the logarithm of height over width


class Condition(NamedTuple):
    """The state of a sensor.

    Attributes:
        state: one of STATES.
        probabilities: of all STATES, by name.
        distance: of the two backgrounds, grey levels (root mean square).
    """

    state: str
    probabilities: dict[str, float]
    distance: float

    @property
    def words(self) -> str:
        """What the state is called."""
        return WORDS[self.state][0]

    @property
    def advice(self) -> str:
        """What to do."""
        return WORDS[self.state][1]


def check_condition(stored: Array, today: Array) -> Condition:
    """Return the state of a sensor from two images u8 (h, w, 3) of its untouched gel.

    Raises UserError for images of other proportions.
    """
    values = features_of(stored, today)
    with (files("anytouch_jax.data.background") / FILE).open("rb") as file:
        model = _model(file.read())
    logits = model["intercept"] + model["weights"] @ expanded(
        (values - model["mean"]) / model["scale"]
    )
    chances = np.exp(logits - logits.max())
    chances = chances / chances.sum()
    probabilities = {name: float(p) for name, p in zip(STATES, chances, strict=True)}
    state = max(probabilities, key=lambda name: probabilities[name])
    if probabilities["same"] > _SAME:
        state = "same"
    return Condition(state, probabilities, float(np.exp(values[0]) - _NOTHING))


@lru_cache(maxsize=1)
def _model(data: bytes) -> dict[str, Array]:
    import io

    return read_arrays(io.BytesIO(data))


def expanded(values: Array) -> Array:
    """Return standardised features (..., d) with their products of two, each bounded."""
    values = np.clip(values, -4, 4)
    left, right = np.triu_indices(values.shape[-1])
    return np.concatenate([values, values[..., left] * values[..., right]], -1)


def features_of(stored: Array, today: Array) -> Array:
    """Return the features f64 (12,) of two images, most of them logarithms of grey levels."""
    if abs(np.log(stored.shape[0] * today.shape[1] / (stored.shape[1] * today.shape[0]))) > _SHAPE:
        raise UserError(
            "the two backgrounds have other proportions. Take both with one setting of the camera."
        )
    before = scale_image(stored, _SIDE).astype(np.float32)
    after = scale_image(today, _SIDE)
    if after.shape != before.shape:
        after = cv2.resize(after, before.shape[1::-1], interpolation=cv2.INTER_AREA)
    after = after.astype(np.float32)
    light = _light(before, after)
    left = (after - before - light)[_BORDER:-_BORDER, _BORDER:-_BORDER]
    change = (after - before)[_BORDER:-_BORDER, _BORDER:-_BORDER]
    light = light[_BORDER:-_BORDER, _BORDER:-_BORDER]
    blurs = [left, *(cv2.GaussianBlur(left, (0, 0), sigma) for sigma in (0.7, 2.0, 6.0))]
    fine = blurs[1] - blurs[2]
    middle = blurs[2] - blurs[3]
    broad = blurs[3]
    size = np.abs(cv2.GaussianBlur(left, (0, 0), 1.5)).max(2)
    strongest = float(np.percentile(size, 99))
    changed = size > max(0.4 * strongest, 1.0)
    inside = left[changed] if changed.any() else np.zeros((1, 3), np.float32)
    grey = inside.mean(1, keepdims=True)
    calm = ~cv2.dilate(changed.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    same = _texture(before, after, calm)
    return np.array(
        [
            _log(_rms(change)),
            _log(_rms(light)),
            _log(float(np.percentile(size, 50))),
            _log(_rms(broad)),
            _log(_rms(middle)),
            _log(_rms(fine)),
            _log(strongest),
            _log(float(np.percentile(size, 90))),
            np.log(changed.mean() + 1e-3),
            _rms(inside - grey) / (_rms(inside) + 0.3),
            same,
            _log(_rms(fine[changed]) if changed.any() else 0.0)
            - _log(_rms(middle[changed]) if changed.any() else 0.0),
        ]
    )


def _light(before: Array, after: Array) -> Array:
    """Return the change f32 (h, w, 3) that lamps make: a factor and an offset, each a plane.

    They are fitted again and again to the pixels that they fit best (least trimmed squares), so a
    press or a scratch has no say.
    """
    height, width = before.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    plane = [np.ones_like(x), x / width - 0.5, y / height - 0.5]
    result = np.empty_like(before)
    few = np.s_[::3, ::3]
    for colour in range(3):
        one = before[..., colour] / 128
        terms = np.stack([*(one * part for part in plane), *plane], -1)
        change = after[..., colour] - before[..., colour]
        rows = terms[few].reshape(-1, 6)
        values = change[few].ravel()
        kept = np.arange(len(values))
        for _ in range(_ROUNDS):
            chosen = rows[kept]
            gram = chosen.T @ chosen + 1e-3 * np.eye(6)
            found = np.linalg.solve(gram, chosen.T @ values[kept])
            away = np.abs(values - rows @ found)
            kept = np.argpartition(away, int(_TRIMMED * len(away)))[: int(_TRIMMED * len(away))]
        result[..., colour] = terms @ found
    return result


def _texture(before: Array, after: Array, calm: Array) -> float:
    """Return the correlation of fine details of two images, where nothing changed strongly."""
    details = []
    for image in (before, after):
        grey = image.mean(2)
        detail = cv2.GaussianBlur(grey, (0, 0), 0.7) - cv2.GaussianBlur(grey, (0, 0), 2.5)
        details.append(detail[_BORDER:-_BORDER, _BORDER:-_BORDER][calm])
    if calm.sum() < 100:
        return 0.0
    one, other = (np.clip(d, -3 * np.std(d), 3 * np.std(d)) for d in details)
    return float((one * other).mean() / (np.sqrt((one**2).mean() * (other**2).mean()) + 0.02))


def _rms(values: Array) -> float:
    return float(np.sqrt((np.asarray(values, np.float64) ** 2).mean()))


def _log(value: float) -> float:
    """Return the logarithm of grey levels, of which a third is nothing: noise differs."""
    return float(np.log(value + _NOTHING))
