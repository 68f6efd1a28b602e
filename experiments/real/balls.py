"""How far is the depth of a steel ball off? An encoder that measures, beside a calibration of the
unit itself.

    python -m experiments.real.balls anytouch-tiny
    python -m experiments.real.balls --calibration

A ball of known radius R that touches the gel in a circle of radius a has the profile sqrt(R^2 -
r^2) - sqrt(R^2 - a^2) above the rim of its contact. The circle is detected in the difference from
the untouched gel (`find_circle`). So depth is compared with the rim's: what the gel does outside
the contact is not known. `--image` draws real and simulated presses, and their colours by slope.

`--calibration` is what the field does for one unit: slopes of the ball are fitted to colours and
places on half of the presses, by a polynomial or a small network, and integrated (Poisson). The
halves are exchanged, so that every press is tested once. Intervals are 95 %, from 1000 draws of
presses. Rows go to `experiments/results/balls.jsonl`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np
import numpy.typing as npt
from scipy.fft import dctn, idctn
from scipy.optimize import least_squares
from sklearn.linear_model import Ridge
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler
from tyro.conf import Positional

from anytouch_jax.data.images import decode
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.plots import panels, write_figure
from anytouch_jax.sim.recorder import ball as ball_map
from anytouch_jax.sim.recorder import simulate_touch
from anytouch_jax.sim.sensing.sensors import SENSORS, identity_unit
from experiments.command import run_script
from experiments.records import write_record

Array = npt.NDArray[Any]
FOLDER = Path("../shared/real_touch")
_ANGLES = np.linspace(0, 2 * np.pi, 60, endpoint=False).astype(np.float32)
_WIDTH = 320  # pixels of the image in which circles are sought
_INNER = 0.9  # of the circle's radius: the part that the sphere is fitted to
_PIXELS = 800  # of each press inside its circle, and as many outside
DRAWS = 1000  # of a bootstrap over presses
_SHOWN = 3  # presses in the image


@dataclass(frozen=True)
class BallOptions:
    """Measure the error of depth on presses of balls."""

    models: Positional[tuple[str, ...]] = ()  # Encoders that measure.
    calibration: bool = False  # Also the calibration of the unit itself.
    image: Path | None = None  # PNG of real and simulated presses.
    data: Path = FOLDER  # Folder of the presses.
    out: Path = Path("experiments/results/balls.jsonl")  # JSON lines.


class Unit(NamedTuple):
    """Presses of balls on one unit.

    `width_mm` is what the width of its images shows, None if nobody says it.
    """

    name: str
    sensor: str
    gel: str
    # radius of the ball in mm (NaN: unknown), and the pattern of its images
    presses: dict[float, str]
    width_mm: float | None
    # pixels of a contact circle at least and at most, or None: it has no sharp rim
    radii: tuple[int, int] | None
    # of this ball every second press fitted the colours of the simulated sensor
    fitted: float | None = None


# The source's own configuration gives 0.0634 mm a pixel: https://github.com/rpl-cmu/gelslam,
# config.yaml (ppmm).
UNITS = (
    Unit(
        "GelSight Mini",
        "gelsight_mini",
        "gelslam-gelsight_mini/background.png",
        {3.155: "gelslam-gelsight_mini/6.310mm/*.png", 4.75: "gelslam-gelsight_mini/9.500mm/*.png"},
        320 * 0.0634,
        (20, 48),
        3.155,
    ),
    Unit(
        "9DTact",
        "9dtact",
        "9dtact-9dtact/sensor_1/ref.png",
        {float("nan"): "9dtact-9dtact/sensor_1/ball_press.png"},
        None,
        (40, 200),
    ),
    Unit(
        "GelSlim, gel a",
        "gelslim",
        "nc/mcubelab_gelslim-gelslim3/gel_a_ball/ref.jpg",
        {float("nan"): "nc/mcubelab_gelslim-gelslim3/gel_a_ball/press_*.jpg"},
        None,
        None,
    ),
    Unit(
        "GelSlim, gel b",
        "gelslim",
        "nc/mcubelab_gelslim-gelslim3/gel_b_ball/ref.jpg",
        {float("nan"): "nc/mcubelab_gelslim-gelslim3/gel_b_ball/press_*.jpg"},
        None,
        None,
    ),
)


class Press(NamedTuple):
    """A press of a ball of radius `ball` mm: the image and its contact circle in pixels."""

    name: str
    frame: Array
    ball: float
    x: float
    y: float
    radius: float

    @property
    def is_whole(self) -> bool:
        """Whether the circle lies in the image."""
        height, width = self.frame.shape[:2]
        return bool(self.radius <= min(self.x, self.y, width - 1 - self.x, height - 1 - self.y))


def difference(frame: Array, gel: Array) -> Array:
    """Return the colour difference f32 (h, w, 3) of a frame from the untouched gel, without a
    change of light.
    """
    change = frame.astype(np.float32) - gel
    return np.asarray(cv2.GaussianBlur(change - np.median(change, axis=(0, 1)), (0, 0), 1.0))


def find_disc(change: Array) -> tuple[float, float, float]:
    """Return centre x, y and radius in pixels of the disc whose area and centroid are those of the
    strongest change.
    """
    size = cv2.GaussianBlur(np.abs(change).max(2), (0, 0), 3)
    _, _, stats, centres = cv2.connectedComponentsWithStats(
        (size > 0.35 * float(size.max())).astype(np.uint8)
    )
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    return *map(float, centres[largest]), float(np.sqrt(stats[largest, cv2.CC_STAT_AREA] / np.pi))


def find_circle(change: Array, radii: tuple[float, float] | None) -> tuple[float, float, float]:
    """Return centre x, y and radius in pixels of the circle over which the colours of `change` jump
    most.

    After Daugman (1993): the jump is averaged along the circle, of which a third must lie in the
    image. Without `radii` in pixels it is `find_disc`.
    """
    if radii is None:
        return find_disc(change)
    scale = change.shape[1] / _WIDTH
    change = cv2.resize(
        change, (_WIDTH, round(change.shape[0] / scale)), interpolation=cv2.INTER_AREA
    )
    height, width = change.shape[:2]
    size = np.abs(change).max(2)
    ys, xs = np.nonzero(size > max(8, 0.3 * float(size.max())))
    middle = (float(np.median(xs)), float(np.median(ys))) if len(xs) else (width / 2, height / 2)

    def best(xs: Array, ys: Array, rs: Array) -> tuple[float, float, float]:
        x, y, r = (v.ravel().astype(np.float32)[:, None] for v in np.meshgrid(xs, ys, rs))
        rings = []
        for radius in (r - 2, r + 2):
            at = x + radius * np.cos(_ANGLES), y + radius * np.sin(_ANGLES)
            inside = (at[0] >= 1) & (at[0] < width - 2) & (at[1] >= 1) & (at[1] < height - 2)
            rings.append((cv2.remap(change, *at, cv2.INTER_LINEAR), inside))
        both = rings[0][1] & rings[1][1]
        jump = (np.abs(rings[0][0] - rings[1][0]).sum(2) * both).sum(1) / np.maximum(both.sum(1), 1)
        place = int(np.argmax(np.where(both.mean(1) >= 1 / 3, jump, -1)))
        return float(x[place, 0]), float(y[place, 0]), float(r[place, 0])

    low, high = (radius / scale for radius in radii)
    reach = 0.8 * low
    x, y, r = best(
        *(m + np.arange(-reach, reach + 1, 3) for m in middle), np.arange(low, high, 2.0)
    )
    for span, step in ((3, 1.0), (1, 0.25)):
        steps = np.arange(-span, span + step / 2, step)
        x, y, r = best(x + steps, y + steps, np.clip(r + steps, low, high))
    return (x + 0.5) * scale - 0.5, (y + 0.5) * scale - 0.5, r * scale


def read_presses(unit: Unit, folder: Path) -> tuple[Array, list[Press]]:
    """Return the untouched gel and the presses of a unit.

    A ball's radii lie within a quarter of their median.
    """
    gel = decode(folder / unit.gel)
    presses = list[Press]()
    for ball, pattern in unit.presses.items():
        files = sorted(file for file in folder.glob(pattern))
        changes = [difference(decode(file), gel) for file in files]
        circles = [find_circle(change, unit.radii) for change in changes]
        if len(files) > 3 and np.isfinite(ball):
            usual = float(np.median([r for _, _, r in circles]))
            near = (0.8 * usual, 1.25 * usual)
            circles = [find_circle(change, near) for change in changes]
        presses += [
            Press(f"{file.parent.name}/{file.stem}", decode(file), ball, *circle)
            for file, circle in zip(files, circles, strict=True)
        ]
    if not presses:
        raise UserError(
            f"there are no presses in {folder}. Name the folder of the pack with --data."
        )
    return gel, presses


def distance(press: Press) -> tuple[Array, Array, Array]:
    """Return x, y and distance in pixels (h, w) from the centre of the circle."""
    y, x = np.mgrid[: press.frame.shape[0], : press.frame.shape[1]].astype(np.float64)
    return x - press.x, y - press.y, np.hypot(x - press.x, y - press.y)


def true_depth(press: Press, mm: float) -> Array:
    """Return the depth (h, w) in mm above the rim of a ball's contact, NaN outside; `mm` is that of
    a pixel.
    """
    _, _, r = distance(press)
    inside = r < press.radius
    height = np.sqrt(np.maximum(press.ball**2 - (mm * r) ** 2, 0)) - np.sqrt(
        press.ball**2 - (mm * press.radius) ** 2
    )
    return np.where(inside, height, np.nan)


class Error(NamedTuple):
    """Errors of a press: radius of the ball as a fraction, depth of its centre and of its profile
    over the rim in mm.
    """

    radius: float
    centre: float
    profile: float
    true_centre: float


def error_of(depth: Array, press: Press, mm: float) -> Error:
    """Compare a measured depth (h, w) in mm with that of a ball."""
    _, _, r = distance(press)
    wanted = true_depth(press, mm)
    # the zero is that of the rim, from its inside
    near = (r > 0.85 * press.radius) & (r < press.radius - 1)
    own = depth - float(np.median((depth - wanted)[near]))
    inside = r < press.radius
    centre = float(np.mean(own[r < 3])) - float(np.nanmean(wanted[r < 3]))
    profile = float(np.nanmean(np.abs(own - wanted)[inside]))
    return Error(
        sphere(depth, press, mm) / press.ball - 1, centre, profile, float(np.nanmax(wanted))
    )


def sphere(depth: Array, press: Press, mm: float) -> float:
    """Return the radius mm of the sphere that fits a measured depth (h, w) in mm inside the
    circle.
    """
    x, y, r = distance(press)
    inside = r < _INNER * press.radius
    z = depth[inside]
    at = np.stack([x[inside], y[inside]]) * mm
    # a paraboloid to start from
    flat = np.column_stack([np.ones(len(z)), *at, np.square(at).sum(0)])
    bend = float(np.linalg.lstsq(flat, z, rcond=None)[0][3])
    start = np.clip(-0.5 / bend if bend < 0 else 100.0, 1.2 * press.radius * mm, 100.0)

    def off(given: Array) -> Array:
        height, x0, y0, log_radius = given
        square = np.square(at[0] - x0) + np.square(at[1] - y0)
        radius = np.exp(log_radius)
        return np.asarray(
            height - square / (radius + np.sqrt(np.maximum(radius**2 - square, 0))) - z
        )

    fit = least_squares(
        off, [float(z.max()), 0.0, 0.0, np.log(start)], loss="soft_l1", f_scale=0.05
    )
    return float(np.exp(fit.x[3]))


# The calibration of one unit
# ------------------------------------------------------------------------------------------


def inputs(press: Press, gel: Array) -> Array:
    """Return colour differences and places (h * w, 5) of a press."""
    height, width = gel.shape[:2]
    y, x = np.mgrid[:height, :width] / width - 0.5
    return np.column_stack([difference(press.frame, gel).reshape(-1, 3) / 50, x.ravel(), y.ravel()])


def slopes(press: Press, mm: float) -> tuple[Array, Array]:
    """Return slopes (h * w, 2) of the ball along x and y, 0 far outside of it, and where they are
    known (h * w,).
    """
    x, y, r = distance(press)
    height = np.sqrt(np.maximum(press.ball**2 - (mm * r) ** 2, 1e-6))
    inside = r < press.radius - 1
    outside = r > 1.7 * press.radius
    given = np.where(inside[..., None], -mm * np.stack([x, y], -1) / height[..., None], 0.0)
    return given.reshape(-1, 2), (inside | outside).ravel()


def calibrate(kind: str, presses: Sequence[Press], gel: Array, mm: float) -> Any:
    """Return the regression of slopes on colours and places.

    The outside of a press counts as much as its inside.
    """
    rng = np.random.default_rng(0)
    xs = []
    ys = []
    for press in presses:
        x = inputs(press, gel)
        (y, known) = slopes(press, mm)
        inside = np.flatnonzero(known & np.any(y != 0, axis=1))
        inside = rng.permutation(inside)[:_PIXELS]
        outside = rng.choice(np.flatnonzero(known & np.all(y == 0, axis=1)), len(inside))
        rows = np.concatenate([inside, outside])
        xs.append(x[rows])
        ys.append(y[rows])
    if kind == "polynomial":
        model = make_pipeline(PolynomialFeatures(3), StandardScaler(), Ridge(1.0))
    else:  # the size that gs_sdk takes
        sizes: dict[str, Any] = {"hidden_layer_sizes": (32, 32, 32), "activation": "tanh"}
        network = MLPRegressor(**sizes, early_stopping=True, max_iter=100, random_state=0)
        model = make_pipeline(StandardScaler(), network)
    return model.fit(np.concatenate(xs), np.concatenate(ys))


def integrate(slope: Array) -> Array:
    """Return the surface (h, w) whose slopes (h, w, 2) a pixel along x and y fit best (Poisson,
    free edges).
    """
    height, width = slope.shape[:2]
    divergence = np.zeros((height, width))
    across = (slope[:, 1:, 0] + slope[:, :-1, 0]) / 2
    down = (slope[1:, :, 1] + slope[:-1, :, 1]) / 2
    divergence[:, :-1] += across
    divergence[:, 1:] -= across
    divergence[:-1] += down
    divergence[1:] -= down
    waves = [2 - 2 * np.cos(np.pi * np.arange(count) / count) for count in (height, width)]
    spectrum = waves[0][:, None] + waves[1]
    spectrum[0, 0] = 1.0
    values = -dctn(divergence, norm="ortho") / spectrum
    values[0, 0] = 0.0
    surface = idctn(values, norm="ortho")
    return np.asarray(surface - np.median(surface))


def calibrated_depths(kind: str, gel: Array, presses: Sequence[Press], mm: float) -> list[Array]:
    """Return the depth (h, w) mm of every press, by a calibration on the other half of the
    presses.
    """
    depths: list[Array] = [np.zeros(0)] * len(presses)
    for half in (0, 1):
        model = calibrate(
            kind, [press for n, press in enumerate(presses) if n % 2 != half], gel, mm
        )
        for number, press in enumerate(presses):
            if number % 2 == half:
                slope = model.predict(inputs(press, gel)).reshape(*gel.shape[:2], 2)
                depths[number] = mm * integrate(slope)
    return depths


def measured_depths(
    encoder: Encoder, unit: Unit, gel: Array, presses: Sequence[Press]
) -> tuple[list[Array], Array, Array]:
    """Return depths (h, w) in mm, their deviations at the centre, and areas of contact in mm2, of
    every press.
    """
    depths = list[Array]()
    deviations = list[float]()
    areas = list[float]()
    for press in presses:
        fields = encoder.measure(press.frame, gel, unit.sensor, width_mm=unit.width_mm).at(
            *gel.shape[:2]
        )
        depths.append(fields.depth[0])
        deviations.append(float(fields.depth_std[0, round(press.y), round(press.x)]))
        areas.append(float(fields.area[0]))
    return depths, np.array(deviations), np.array(areas)


def interval(values: Array) -> list[float]:
    """Return the median of values (n,) and its 95 % interval over the presses."""
    rng = np.random.default_rng(0)
    draws = np.median(rng.choice(values, (DRAWS, len(values))), axis=1)
    return [round(float(x), 4) for x in (np.median(values), *np.percentile(draws, (2.5, 97.5)))]


def record_of(depths: Sequence[Array], presses: Sequence[Press], mm: float) -> dict[str, Any]:
    """Return medians with intervals of the errors on presses whose circle lies in the image, and
    those of each.
    """
    whole = [n for n, press in enumerate(presses) if press.is_whole]
    errors = [error_of(depths[n], presses[n], mm) for n in whole]
    record: dict[str, Any] = {"presses": len(whole), "left_out": len(presses) - len(whole)}
    for name in ("radius", "centre", "profile"):
        values = np.array([getattr(error, name) for error in errors])
        record[name] = interval(np.abs(values))
        record[f"{name}_bias"] = round(float(np.median(values)), 4)
    record["true_centre"] = round(float(np.median([error.true_centre for error in errors])), 4)
    record["each"] = {
        presses[n].name: [round(x, 4) for x in error[:3]]
        for n, error in zip(whole, errors, strict=True)
    }
    return record


def unknown_record(depths: Sequence[Array], presses: Sequence[Press], mm: float) -> dict[str, Any]:
    """Return what can be said without the size of the ball: do all presses give one radius?"""
    whole = [n for n, press in enumerate(presses) if press.is_whole]
    fitted = np.array([sphere(depths[n], presses[n], mm) for n in whole])
    spread = (
        float(np.subtract(*np.percentile(fitted, (75, 25))) / np.median(fitted))
        if len(fitted) > 3
        else None
    )
    return {
        "presses": len(whole),
        "fitted_radius_mm": interval(fitted),
        "quartiles_over_median": spread,
    }


def draw_colours(path: Path, unit: Unit, gel: Array, presses: Sequence[Press]) -> None:
    """Draw differences of presses above simulated ones of the same balls and circles, and their
    strength by slope.
    """
    mm = (unit.width_mm or 0.0) / gel.shape[1]
    kind = SENSORS[unit.sensor]
    device = identity_unit(kind)._replace(gain=np.full(3, kind.contrast, np.float32))
    simulate = jax.jit(partial(simulate_touch, sensor=unit.sensor, size=len(gel), unit=device))
    figure, axes = panels(2, _SHOWN + 1, 2.6, 2.0)
    inside: dict[str, list[tuple[Array, Array]]] = {"real": [], "simulated": []}
    for column, press in enumerate(presses[_SHOWN :: len(presses) // _SHOWN]):
        # of a layer, whose contact is wider than a half-space's
        depth = 0.57 * (mm * press.radius) ** 2 / press.ball
        place = (
            mm * (side / 2 - at)
            for side, at in zip(gel.shape[1::-1], (press.x, press.y), strict=True)
        )
        made = simulate(ball_map(2 * press.ball, 400), np.array([[*place, 0.0, depth]]))
        image, behind, dent, pressure = (np.asarray(one[0]) for one in (*made[:3], made.pressure))
        slope = np.hypot(*np.gradient(dent, kind.field[1] / dent.shape[1]))
        away = distance(press)[2]
        for axis, name, change, sine, touched in (
            (
                axes[0][column],
                "real",
                difference(press.frame, gel),
                mm * away / press.ball,
                away < press.radius - 1,
            ),
            (
                axes[1][column],
                "simulated",
                difference(image, behind),
                slope / np.hypot(slope, 1),
                pressure > 0.05 * pressure.max(),
            ),
        ):
            axis.imshow(np.clip(change + 128, 0, 255).astype(np.uint8))
            axis.set_axis_off()
            axis.set_title(f"{name}, {2 * press.ball:g} mm", fontsize=8)
            inside[name].append((sine[touched], np.linalg.norm(change, axis=2)[touched]))
    for row, (name, parts) in zip(axes, inside.items(), strict=True):
        sine, strength = (np.concatenate(part) for part in zip(*parts, strict=True))
        places = np.arange(0.025, sine.max(), 0.05)
        row[_SHOWN].plot(places, [np.median(strength[np.abs(sine - at) < 0.025]) for at in places])
        row[_SHOWN].set(xlim=(0, 0.7), ylim=(0, 90))
        row[_SHOWN].set_title(f"{name}: grey levels by sine of slope", fontsize=8)
    write_figure(path, figure)


def run(options: BallOptions) -> int:
    """Print and store the errors of every model and of the calibration on every unit."""
    if not options.models and not options.calibration:
        raise UserError("name encoders that measure, or pass --calibration")
    encoders = {name: load_encoder(name) for name in options.models}
    for unit in UNITS:
        gel, presses = read_presses(unit, options.data)
        known = all(np.isfinite(list(unit.presses)))
        if known and options.image is not None:
            draw_colours(options.image, unit, gel, [press for press in presses if press.is_whole])
        mm = (unit.width_mm or 0.0) / gel.shape[1]
        records = dict[str, dict[str, Any]]()
        if known and options.calibration:
            for kind in ("polynomial", "network"):
                records[f"calibration, {kind}"] = record_of(
                    calibrated_depths(kind, gel, presses, mm), presses, mm
                )
        fresh = [
            number
            for number, press in enumerate(presses)
            if number % 2 or press.ball != unit.fitted
        ]
        for name, encoder in encoders.items():
            depths, deviations, areas = measured_depths(encoder, unit, gel, presses)
            width = encoder.measure(
                presses[0].frame, gel, unit.sensor, width_mm=unit.width_mm
            ).width_mm
            mm = (width or 1.0) / gel.shape[1]
            circles = np.array([np.pi * (mm * press.radius) ** 2 for press in presses])
            record = (record_of if known else unknown_record)(depths, presses, mm)
            record |= {
                "area_over_circle": interval(areas / circles),
                "centre_std": interval(deviations),
            }
            records[name] = record
            if unit.fitted is not None:
                some = record_of([depths[n] for n in fresh], [presses[n] for n in fresh], mm)
                records[f"{name}, presses that fitted no colours"] = some
        for name, record in records.items():
            write_record(options.out, f"{unit.name}, {name}", record | {"mm_per_pixel": mm})
            shown = {key: value for key, value in record.items() if key != "each"}
            print(f"{unit.name}, {name}: {shown}")
    return 0


if __name__ == "__main__":
    sys.exit(run_script(BallOptions, run))
