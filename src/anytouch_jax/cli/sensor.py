"""`anytouch sensor fit` and `anytouch adapt`: a simulator of your own sensor, and tokens for it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.cli.output import check_home, log, refuse_unused
from anytouch_jax.config import OWN_SENSOR
from anytouch_jax.config.parsing import Above0, Count, NotNegative, Seed
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.sim.fitting.comparison import Comparison


@dataclass(frozen=True, kw_only=True)
class FitSensorOptions:
    """Fit the look of your sensor to 5 to 50 images of it, for the simulator.

    Example: anytouch sensor fit pictures/ --name mine --width-mm 18.6 --out mine.sensor

    Press all kinds of objects into the gel, at changing places, and add a few images of the
    untouched gel. The folder has readable numbers (sensor.json), which say how sure each is, and
    real next to simulated images (look.png). `data simulate --sensors`, `train
    --simulated.sensors` and `adapt --sensor` take it like the name of a sensor. A folder whose
    numbers you edited or calibrated is not written over.
    """

    # Folder of images of one unit, upright and not cropped.
    frames: Annotated[Path, Positional]
    name: str  # Name of the sensor.
    width_mm: Above0[float]  # Width of the gel that an image shows, mm.
    out: Path  # Folder to write, NAME.sensor.
    # Image of the untouched gel. Without it, the median of all images.
    background: Path | None = None
    # All presses are of a ball of this diameter, mm. Its slopes are known.
    ball_mm: Above0[float | None] = None


def run_fit(options: FitSensorOptions) -> int:
    """Fit a sensor and write its folder."""
    from anytouch_jax.data.images import decode, list_images, to_rgb
    from anytouch_jax.sim.fitting.fit import check_name, fit_sensor
    from anytouch_jax.sim.fitting.touches import compare
    from anytouch_jax.sim.sensing.own import check_unedited
    from anytouch_jax.train.mesh import enable_compilation_cache

    check_name(options.name)
    check_home(options.out)
    check_unedited(options.out)
    enable_compilation_cache()
    files, named = list_images(options.frames)
    background = options.background or named.get("background")
    gel = None if background is None else to_rgb(decode(background), background)
    images = [to_rgb(decode(file), file) for file in files]
    fitted = fit_sensor(
        images,
        options.name,
        options.width_mm,
        options.out,
        background=gel,
        ball_mm=options.ball_mm,
    )
    for part, words in fitted.numbers.sure.items():
        log(f"{part}: {words}")
    log("simulating touches of it, about two minutes at the first time")
    seen = fitted.seen
    image = options.out / "look.png"
    fraction = compare(
        seen.frames[seen.pressed], seen.gel, options.out, image, ball_mm=options.ball_mm
    )
    print(f"{options.out}: {options.name}, {fitted.colour.source}")
    print(
        f"{image}: real images above simulated ones. A linear classifier knows one from the "
        f"other in {fraction:.0%} of the cases, where 50 % is chance."
    )
    return 0


@dataclass(frozen=True)
class AdaptOptions:
    """Make tokens for a new sensor: trained on simulated touches of it, or fitted to a few labelled
    frames.

    Example: anytouch adapt --sensor mine.sensor --minutes 6 --out runs/mine

    A sensor of `anytouch sensor fit` needs no data. Ctrl-C keeps the state, and the same command
    continues. If the new tokens are not shown to find more simulated touches than the universal
    ones, the run keeps the universal ones and says so. With --data, tokens are fitted to --labels.
    """

    # Folder NAME.sensor of `anytouch sensor fit`, or a name in the column sensor of the manifest.
    sensor: str
    out: Path  # Run folder to write, for embed, probe and retrieve.
    # Encoder: a name (`anytouch info encoders`), a run, a weights file, or hf://user/repo.
    model: Path = Path(DEFAULT)
    minutes: Above0[float] = 6.0  # Minutes of training on simulated touches.
    deep: bool = False  # Train the first blocks too, and hold the features of known sensors.
    data: tuple[Path, ...] = ()  # Manifests with labelled frames of the sensor in split train.
    frames: NotNegative[int] = 100
    """Number of frames to fit on, spread over the recordings. 0 copies the universal tokens
    unchanged.
    """
    # Label column whose classes the frames are fitted to. Known sensors need examples.
    labels: str | None = None
    steps: Count[int] = 200  # Steps of the fit.
    seed: Seed = 0  # Random seed.


def run_adapt(options: AdaptOptions) -> int:
    """Make the tokens of a new sensor and write a run folder; 130 after Ctrl-C."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.encoder.adapt import adapt, check_empty, save
    from anytouch_jax.train.mesh import enable_compilation_cache

    simulated = Path(options.sensor).suffix == OWN_SENSOR
    _check_adapt(options, simulated)
    check_empty(options.out)
    check_home(options.out)
    enable_compilation_cache()
    if simulated:
        return _simulated(options)
    table = manifests.read([str(path) for path in options.data])
    adapted = adapt(
        options.model,
        table,
        options.sensor,
        frames=options.frames,
        labels=options.labels,
        steps=options.steps,
        seed=options.seed,
        log=log,
    )
    save(adapted, options.model, options.out)
    if not options.frames:
        print(f"{options.out}: {options.sensor} has the universal tokens")
        return 0
    where = "of split val" if adapted.measured == "val" else "of the fit"
    print(
        f"{options.out}: tokens of {options.sensor} fitted to {options.frames} frames. "
        f"The loss on frames {where} went from {adapted.before:.4f} to {adapted.after:.4f}."
    )
    return 0


def _check_adapt(options: AdaptOptions, simulated: bool) -> None:
    """Raise UserError for options that do not go together, before anything is loaded."""
    if simulated:
        unused = ("data", "frames", "labels", "steps")
        refuse_unused(options, unused, f"with a sensor of {OWN_SENSOR}, which is simulated")
    elif not options.data:
        raise UserError(
            f"name frames of {options.sensor} with --data, or a sensor of `anytouch sensor fit` as "
            "--sensor"
        )
    else:
        refuse_unused(
            options, ("minutes", "deep"), "with --data, where the frames are what is fitted"
        )
    if not options.frames:
        refuse_unused(options, ("labels", "steps", "seed"), "with --frames 0, which fits nothing")


def _simulated(options: AdaptOptions) -> int:
    """Train the tokens of a sensor of `anytouch sensor fit`."""
    from anytouch_jax.encoder.adapt import save
    from anytouch_jax.sim.fitting.comparison import Comparison
    from anytouch_jax.sim.fitting.tokens import adapt_by_simulation

    state = options.out.with_name(f"{options.out.name}.part")
    log("compiling the simulator: about two minutes at first")
    adapted = adapt_by_simulation(
        options.model,
        options.sensor,
        minutes=options.minutes,
        deep=options.deep,
        state=state,
        seed=options.seed,
        log=log,
    )
    if adapted is None:
        log(f"interrupted: {state} keeps the state. Run the same command again to continue.")
        return 130
    save(adapted, options.model, options.out)
    shutil.rmtree(state, ignore_errors=True)
    source = adapted.metadata["source"]
    name = source["sensor"]
    compared = Comparison(**source["compared"])
    trained = f"tokens of {name} trained for {len(adapted.losses)} steps"
    if compared.shown:
        print(f"{options.out}: {trained}. {_compared(compared, name)}")
        return 0
    print(
        f"{options.out}: {name} keeps the universal tokens, because {trained} are not shown to be "
        f"better. {_compared(compared, name)} Look at look.png of {options.sensor}, or give more "
        "--minutes."
    )
    return 0


def _compared(compared: Comparison, name: str) -> str:
    """Return sentences about how many touches are found with new and with universal tokens."""
    interval = "no interval, because all touches are of one object"
    if compared.low is not None and compared.high is not None:
        interval = (
            f"95 % interval {100 * compared.low:+.1f} to {100 * compared.high:+.1f}, of "
            f"{compared.objects} objects"
        )
    gain = 100 * (compared.trained - compared.universal)
    return (
        f"Of {compared.touches} held-out simulated touches by {name}, the nearest one by a known "
        f"sensor is the same touch in {compared.trained:.1%}, and with universal tokens in "
        f"{compared.universal:.1%}: {gain:+.1f} points ({interval})."
    )
