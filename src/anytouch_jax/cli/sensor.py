"""`anytouch sensor fit`: a simulator of your own sensor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from anytouch_jax.cli.output import check_home, log
from anytouch_jax.config.parsing import Above0


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Fit the look of your sensor to 5 to 50 pictures of it, for the simulator.

    Example: anytouch sensor fit pictures/ --name mine --width-mm 18.6 --out mine.sensor

    Press all kinds of objects into the gel, at changing places, and add a few pictures of the untouched gel. The folder
    has readable numbers (sensor.json), which say how sure each is, and real next to simulated pictures (look.png).
    `data simulate --sensors`, `train --simulated.sensors` and `adapt --sensor` take it like the name of a sensor.
    """

    frames: Annotated[Path, Positional]  # Folder of pictures of one unit, upright and not cropped.
    name: str  # Name of the sensor.
    width_mm: Above0[float]  # Width of the gel that a picture shows, mm.
    out: Path  # Folder to write, NAME.sensor.
    background: Path | None = None  # Picture of the untouched gel. Without it, the median of all pictures.
    ball_mm: Above0[float | None] = None  # All presses are of a ball of this diameter, mm. Its slopes are known.


def run(options: FitOptions) -> int:
    """Fit a sensor and write its folder."""
    from anytouch_jax.data.images import decode, list_images, to_rgb
    from anytouch_jax.fitting.fit import check_name, fit_sensor
    from anytouch_jax.fitting.touches import compare
    from anytouch_jax.train.mesh import enable_compilation_cache

    check_name(options.name)
    check_home(options.out)
    enable_compilation_cache()
    files, named = list_images(options.frames)
    background = options.background or named.get("background")
    gel = None if background is None else to_rgb(decode(background), background)
    fitted = fit_sensor(
        [to_rgb(decode(file), file) for file in files], options.name, options.width_mm, options.out, background=gel,
        ball_mm=options.ball_mm,
    )  # fmt: skip
    for part, words in fitted.numbers.sure.items():
        log(f"{part}: {words}")
    log("simulating touches of it, about two minutes at the first time")
    seen, picture = fitted.seen, options.out / "look.png"
    share = compare(seen.frames[seen.pressed], seen.gel, options.out, picture, ball_mm=options.ball_mm)
    print(f"{options.out}: {options.name}, {fitted.colour.source}")
    print(
        f"{picture}: real pictures above simulated ones. A linear classifier knows one from the other in {share:.0%} "
        "of the cases, where 50 % is chance."
    )
    return 0
