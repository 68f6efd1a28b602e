"""`anytouch sensor check`: the background of today beside the stored one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    import numpy as np

_GOOD = ("same", "light")  # states in which the calibration holds


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Compare the untouched gel of today with the stored one: the same, or what has changed?

    Example: anytouch sensor check today.png --sensor mine.sensor

    It tells the same gel, another gel, another device, a worn gel, other light, and something that
    presses, with probabilities and advice. The exit status is 1 if the calibration does not hold
    any more.
    """

    # Image of the untouched gel of today, or a folder or video of it.
    today: Annotated[Path, Positional]
    sensor: Path | None = None  # Folder NAME.sensor of `anytouch sensor calibrate`.
    background: Path | None = None  # Or the stored image itself.


def run(options: CheckOptions) -> int:
    """Print the state, and return 1 if something is wrong."""
    from anytouch_jax.data.background.condition import STATES, WORDS, check_condition

    stored = _stored(options)
    found = check_condition(stored, _today(options.today))
    print(f"{found.words}: {found.probabilities[found.state]:.0%}. {found.advice}")
    print(f"The two differ by {found.distance:.1f} grey levels (root mean square).")
    for state in sorted(STATES, key=lambda name: -found.probabilities[name]):
        print(f"{found.probabilities[state]:7.1%}  {WORDS[state][0]}")
    return 0 if found.state in _GOOD else 1


def _stored(options: CheckOptions) -> np.ndarray:
    """Return the stored background. Raises UserError."""
    from anytouch_jax.data.images import decode
    from anytouch_jax.fields.ruler import read_ruler

    if (options.sensor is None) == (options.background is None):
        raise UserError("name the stored background: --sensor mine.sensor, or --background gel.png")
    if options.background is not None:
        return decode(options.background)
    assert options.sensor is not None
    ruler = read_ruler(options.sensor.expanduser())
    if ruler is None:
        raise UserError(
            f"{options.sensor} has no stored background: make one with `anytouch sensor calibrate "
            "--ball-mm`, or name an image with --background"
        )
    return ruler.background


def _today(path: Path) -> np.ndarray:
    """Return the image of today: of several frames the median, which has less noise."""
    from anytouch_jax.cli.inputs import some_frames
    from anytouch_jax.data.background.rule import alike, median, reduced

    if not path.exists():
        raise UserError(f"there is no image, folder or video at {path}")
    frames = alike([reduced(frame) for frame in some_frames(path)])
    if not frames:
        raise UserError(f"no frame of {path} can be read")
    return median(frames)
