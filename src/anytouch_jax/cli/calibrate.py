"""`anytouch sensor calibrate`: depth by a ball of known size, force by a known weight."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.cli.output import check_home, log
from anytouch_jax.config import OWN_SENSOR, UNIVERSAL
from anytouch_jax.config.parsing import Above0
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    import numpy as np

_COLUMNS = ("frame", "newton")


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """Set the depth of your device by presses of a ball, and its force by a known weight.

    Example: anytouch sensor calibrate balls/ --sensor digit --ball-mm 6.35 --out mine.sensor

    Press a ball 5 times, at changing places. Then press any object with a known force, for instance
    on a kitchen scale (1 kg is 9.81 N), and call it again with --sensor mine.sensor and --newton.
    The folder takes the place of a sensor's name, in every command and function.
    """

    # Folder of images of one device, upright. background.png in it is the untouched gel.
    frames: Annotated[Path, Positional]
    sensor: str = UNIVERSAL
    """What your device is: the name of a known sensor, or a folder NAME.sensor that gets a further
    calibration.
    """
    out: Path | None = None  # Folder NAME.sensor to write (default: that of --sensor).
    ball_mm: Above0[float | None] = None  # Diameter of the ball that is pressed, mm.
    newton: str | None = None
    """Force of the presses into the gel: one number, N, or a CSV file with the columns frame (the
    name of an image) and newton.
    """
    # What the width of an image shows, mm. Known and fitted sensors need none.
    width_mm: Above0[float | None] = None
    # Image of the untouched gel. Without it, background.png, else the median of all images.
    background: Path | None = None
    # Encoder that measures: a name, a run, a weights file, or hf://user/repo.
    model: Path = Path(DEFAULT)


def run(options: CalibrateOptions) -> int:
    """Calibrate a sensor and write its folder."""
    out = _place(options)
    if options.ball_mm is None and options.newton is None:
        raise UserError("name what is known of the presses: --ball-mm, --newton, or both")
    files, background, frames = _read(options)
    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.encoder.measured import missing
    from anytouch_jax.fields.calibration import (
        calibrate_depth,
        calibrate_force,
        sensor_numbers,
        write_calibration,
    )
    from anytouch_jax.train.mesh import enable_compilation_cache

    numbers = sensor_numbers(options.sensor, out, frames[0].shape, options.width_mm)
    newtons = None if options.newton is None else _forces(options.newton, files)
    enable_compilation_cache()
    encoder = load_encoder(options.model)
    if not encoder.measures:
        raise missing(encoder.source)
    ruler = None
    if options.ball_mm is not None:
        ruler = calibrate_depth(encoder, frames, background, numbers, options.ball_mm)
    if newtons is not None:
        known = [frame for frame, file in zip(frames, files, strict=True) if file.name in newtons]
        numbers = calibrate_force(encoder, known, background, numbers, list(newtons.values()))
    write_calibration(out, numbers, ruler)
    if ruler is not None:
        for part, words in ruler.describe().items():
            log(f"{part}: {words}")
    if newtons is not None:
        log(f"force: {numbers.sure['force_factor']}")
    print(f"{out}: use it in place of a sensor's name, as in --sensor {out}")
    return 0


def _place(options: CalibrateOptions) -> Path:
    """Return the folder to write. Raises UserError."""
    from anytouch_jax.sim.sensing.own import NUMBERS

    out = options.out
    if out is None:
        if Path(options.sensor).suffix != OWN_SENSOR:
            raise UserError(f"name the folder to write: --out mine{OWN_SENSOR}")
        out = Path(options.sensor)
    check_home(out)
    out = out.expanduser()
    is_further = Path(options.sensor).expanduser().resolve() == out.resolve()
    if (out / NUMBERS).exists() and not is_further:
        raise UserError(
            f"{out} is a sensor already, whose numbers would be lost. Calibrate it further with "
            f"--sensor {out}, or name another --out."
        )
    return out


def _read(options: CalibrateOptions) -> tuple[list[Path], np.ndarray, list[np.ndarray]]:
    """Return the images with their files, and the untouched gel between them.

    Raises UserError for images of several sizes, or too few for a median.
    """
    from anytouch_jax.data.background.rule import FEWEST, recording_gel
    from anytouch_jax.data.images import BACKGROUND, decode, list_images

    files, named = list_images(options.frames)
    if not files:
        raise UserError(f"there are no images in {options.frames}")
    frames = [decode(file) for file in files]
    sizes = {frame.shape for frame in frames}
    if len(sizes) > 1:
        raise UserError(f"the images have {len(sizes)} sizes. Give those of one camera.")
    path = options.background or named.get(BACKGROUND)
    if path is not None:
        return files, decode(path), frames
    if len(frames) < FEWEST:
        raise UserError(
            f"{len(frames)} images do not show the untouched gel. Name an image of it with "
            "--background."
        )
    log(f"untouched gel: the median of {len(frames)} images")
    return files, recording_gel(frames)[0], frames


def _forces(word: str, files: list[Path]) -> dict[str, float]:
    """Return the known force of each image by its name, in their order. Raises UserError."""
    try:
        force = float(word)
    except ValueError:
        pass
    else:
        return {file.name: force for file in files}
    path = Path(word)
    try:
        with path.open(newline="", encoding="utf-8") as lines:
            rows = list(csv.DictReader(lines))
        known = {row["frame"]: float(row["newton"]) for row in rows}
    except OSError as error:
        raise UserError(f"--newton is a number of N or a CSV file: {path}: {error}") from None
    except (KeyError, ValueError, TypeError):
        raise UserError(
            f"{path} must have the columns {' and '.join(_COLUMNS)}, with N in each line"
        ) from None
    names = {file.name for file in files}
    strange = [name for name in known if name not in names]
    if strange or not known:
        what = f"{strange[0]} of it is not" if strange else "none of its lines is"
        raise UserError(f"{path}: {what} among the images")
    return {file.name: known[file.name] for file in files if file.name in known}
