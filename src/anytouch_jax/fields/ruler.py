"""A ruler of one device: depth and contact by its own colours, from a few presses of a ball.

Two readers are fitted to presses of a ball of known size. One is photometric stereo: a polynomial
of the change of colour gives the normal of the gel at each pixel, and a Poisson equation the
surface (Yuan et al. 2017, "GelSight", Sec. 3.3). The other is the depth of the network, times a
factor. The first follows lights that the network never met, the second needs no presses at all
places. Each press is left out in turn, and the reader counts that is less far off then.

It is stored as ruler.npz in the folder of the sensor, NAME.sensor.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.fft import dctn, idctn
from threadpoolctl import threadpool_limits

from anytouch_jax.data.background.condition import Condition, check_condition
from anytouch_jax.data.background.dots import Dots, find_dots
from anytouch_jax.data.background.estimate import DIFFERENT, UntouchedBackground, change_of_light
from anytouch_jax.data.background.rule import reduced
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write, check_array, read_arrays
from anytouch_jax.sim.fitting.balls import (
    normals_of,
    pixel_grid,
    place_balls,
    usual_strength,
)
from anytouch_jax.sim.fitting.fit import colour_changes

FILE = "ruler.npz"
FEWEST = 3  # presses: with fewer, none can be left out to see how sure the rest is
LONG = 112  # pixels of the long side of a depth map
_POWERS = tuple(
    (i, j, k) for i in range(4) for j in range(4 - i) for k in range(4 - i - j) if i + j + k
)
_TERMS = len(_POWERS) + 6  # and the three colours, drifting along u and v
_COLOUR = 5.0  # brings changes of colour (0 to 1) to the order of one
_RIDGE = 1e-3
# Weights of pixels inside of a contact, next to it, and of the rest, which is flat.
_NEXT = 0.7
_FAR = 0.3
_STEEPEST = 0.93  # sine of the tilt: steeper walls cannot be seen
_SMOOTH = 0.9  # pixels of the blur of a colour change
# Depth over that of the deepest place around, from which on a pixel is more likely in contact than
# not. The step is as wide as hand-drawn rims are uncertain.
_STEP = 0.04
_SHALLOW = 0.05  # mm: less is no contact, whatever is around
# What a fit must explain, and how far off it may be when a press is left out.
_EXPLAINS = 0.7
_DEEPEST = 0.955  # radius of a contact over that of its ball
_OFF = 0.35
# Factor on the network's depth, up to which it is a reader of this device.
_READS = 1.6
_LEAST_SPREAD = 0.03
# What the condition of a sensor does to its ruler: it is refused, or deviations are so much wider.
_REFUSED = ("device", "pressed")
_WIDER = {"gel": 2.0, "worn": 2.0}
_NOISE = 0.01  # mm
# Strength of the colours of a device of no known family: the geometric mean of the table's sensors.
_USUAL = 0.30
# The strength of colours over that of usual devices: of this family, or of all. A ball of twice the
# size has about 1.7 times the strength, and units of one family differ by a quarter.
_UNUSUAL = 1.45
_UNUSUAL_AMONG_ALL = 1.6
_WEAKEST = 0.5
_DOUBTFUL = 1.2


@dataclass(frozen=True, eq=False)
class Ruler:
    """What presses of a ball say of a device.

    Attributes:
        background: its untouched gel u8 (h, w, 3), at most 320 pixels long.
        colours: (25, 2), sines of the tilt along x and y by powers of the colour change.
        width_mm: what the width of an image shows.
        gain: by which a reader's depth is multiplied.
        by_network: whether the network is the reader, and not the colours.
        weights: fingerprint of the network.
        rim: depth of a rim over that of the deepest place around.
        reach_mm: how far around the deepest place is looked for.
        spread: standard deviation of depth over depth, of presses that were left out.
        noise_mm: standard deviation of depth where nothing touches.
        ball_mm: diameter of the ball.
        presses: how many there were.
        explained: fraction of the colour change that the ball explains.
        strength: of the colours over that of usual devices.
        is_usual: whether the strength is one that devices have.
    """

    background: Array
    colours: Array
    width_mm: float
    gain: float
    by_network: bool
    weights: str
    rim: float
    reach_mm: float
    spread: float
    noise_mm: float
    ball_mm: float
    presses: int
    explained: float
    strength: float
    is_usual: bool

    @property
    def _shape(self) -> float:
        return float(self.background.shape[0] / self.background.shape[1])

    @cached_property
    def _dots(self) -> Dots | None:
        return _cached_dots(self.background.tobytes(), self.background.shape)

    def read(
        self, frames: Sequence[Array], network: Array, touched: Array
    ) -> tuple[Array, Array, Array]:
        """Return depth mm, its deviation, and the probability of contact, f32 (n, h, w) each.

        Args:
            frames: n images RGB u8 of the proportions of `background`.
            network: (n, h, w), depth mm that the network reads of them.
            touched: (n, h, w), the probability of contact by the network. It says that something
                touches, and the ruler where its rim is.
        """
        if self.by_network:
            depth = self.gain * network
        else:
            depth = _resized(self.gain * self._surfaces(frames), network.shape[1:])
        contact = np.stack([self._contact(one) for one in depth])
        deviation = np.hypot(self.noise_mm, self.spread * depth)
        return depth, deviation, np.minimum(contact, touched)

    def _surfaces(self, frames: Sequence[Array]) -> Array:
        """Return depths (n, h, w) by colours, without gain."""
        changes = [self._change(frame) for frame in frames]
        return np.stack([surface_of(one, self.colours, self.width_mm) for one in changes])

    def _change(self, frame: Array) -> Array:
        """Return the colour change f32 (h, w, 3) of a frame, as `colour_changes` does."""
        if self._dots is None:
            # The same from small images, in a quarter of the time, because there is no ink.
            size = self._small.shape[1::-1]
            change = cv2.resize(frame, size, interpolation=cv2.INTER_AREA) - self._small
            return np.asarray((change - change_of_light(change)) / 255, np.float32)
        height, width = self.background.shape[:2]
        if frame.shape != self.background.shape:
            frame = cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(colour_changes([frame], self.background, self._dots, LONG)[0][0])

    @cached_property
    def _small(self) -> Array:
        """The background f32, with LONG pixels."""
        height, width = self.background.shape[:2]
        shrink = LONG / max(height, width)
        size = (round(width * shrink), round(height * shrink))
        small = cv2.resize(self.background.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return np.asarray(small)

    def _contact(self, depth: Array) -> Array:
        """Return the probability of contact (h, w) of a depth."""
        reach = self.reach_mm / self.width_mm * depth.shape[1]
        shallow = max(_SHALLOW, 2 * self.noise_mm) / self.rim
        ratio = depth / np.maximum(_deepest_around(depth, reach, self._shape), shallow)
        return np.asarray(1 / (1 + np.exp(-np.clip((ratio - self.rim) / _STEP, -40, 40))))

    def describe(self) -> dict[str, str]:
        """Return what was fitted, and how sure it is, in words."""
        reader = "the network's, scaled" if self.by_network else "from the colours of this device"
        strength = f"{self.strength:.2f} times those of usual devices"
        if not self.is_usual:
            smaller = self.ball_mm / self.strength
            strength += (
                f", which is unusual: a ball of {smaller:.2g} mm would have usual ones. Check its "
                "diameter"
            )
        return {
            "ball": f"{self.presses} presses of {self.ball_mm:g} mm, which explain "
            f"{self.explained:.0%} of the colours",
            "depth": f"{reader}; a press that is left out is {self.spread:.0%} off",
            "strength of colours": strength,
        }

    def check_network(self, weights: str) -> None:
        """Raise UserError for another network than that of the fit, if that reads depth."""
        if self.by_network and weights != self.weights:
            raise another_encoder()


def ruler_of_today(
    ruler: Ruler, background: Array, log: Callable[[str], None]
) -> tuple[Ruler, bool]:
    """Return a ruler with the background of today, and whether the gel is that of its calibration.

    Another gel and a worn one widen the deviations, and `log` gets a sentence.

    Raises UserError for another device, and for a background that shows a press.
    """
    small = reduced(background)
    found = _cached_condition(
        ruler.background.tobytes(), ruler.background.shape, small.tobytes(), small.shape
    )
    chance = found.probabilities[found.state]
    said = f"the background shows {found.words} ({chance:.0%}) beside that of the calibration"
    if found.state in _REFUSED:
        raise UserError(f"{said}. {found.advice}")
    today = replace(ruler, background=small)
    if found.state not in _WIDER:
        return today, True
    log(f"{said}: deviations are wider. {found.advice}")
    return replace(today, spread=_WIDER[found.state] * ruler.spread), False


def another_encoder() -> UserError:
    """Return the error of a calibration that another network was asked for."""
    return UserError(
        "the sensor was calibrated with another encoder. Calibrate it for this one with `anytouch "
        "sensor calibrate`, or name that one with --model."
    )


def _resized(maps: Array, shape: tuple[int, ...]) -> Array:
    """Return maps (n, h, w) at another height and width."""
    return np.stack([cv2.resize(one.astype(np.float32), (shape[1], shape[0])) for one in maps])


# Every batch of frames asks for the same background.
@lru_cache(maxsize=4)
def _cached_dots(values: bytes, shape: tuple[int, ...]) -> Dots | None:
    return find_dots(np.frombuffer(values, np.uint8).reshape(shape))


@lru_cache(maxsize=4)
def _cached_condition(
    stored: bytes, shape: tuple[int, ...], today: bytes, shape_today: tuple[int, ...]
) -> Condition:
    return check_condition(
        np.frombuffer(stored, np.uint8).reshape(shape),
        np.frombuffer(today, np.uint8).reshape(shape_today),
    )


def _deepest_around(depth: Array, reach: float, shape: float) -> Array:
    """Return the depth of the deepest place within `reach` columns of each.

    `shape` is the height of the image over its width, because pixels of a map are not square.
    """
    height, width = depth.shape
    down = reach * height / (width * shape)
    sides = (2 * round(reach) + 1, 2 * round(down) + 1)
    return cv2.dilate(depth.astype(np.float32), np.ones(sides[::-1], np.uint8))


@lru_cache(maxsize=4)
def _places(shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the places -1 to 1 of pixels, f32 (h * w,) each."""
    grid = pixel_grid(shape, 1.0)
    return grid.u.ravel().astype(np.float32), grid.v.ravel().astype(np.float32)


def _features(change: Array) -> Array:
    """Return powers of a colour change (h, w, 3), f32 (_TERMS, h * w)."""
    u, v = _places(change.shape[:2])
    one = _COLOUR * cv2.GaussianBlur(change.astype(np.float32), (0, 0), _SMOOTH).reshape(-1, 3)
    red, green, blue = ([np.ones_like(c), c, c * c, c * c * c] for c in one.T)
    columns = [red[i] * green[j] * blue[k] for i, j, k in _POWERS]
    columns += [c * at for c in one.T for at in (u, v)]
    return np.stack(columns)


def surface_of(change: Array, colours: Array, width_mm: float) -> Array:
    """Return the depth mm (h, w) of a colour change (h, w, 3): 0 along the border in the median.

    Args:
        change: 0 to 1.
        colours: (25, 2), see `Ruler`.
        width_mm: what the width of the image shows.
    """
    height, width = change.shape[:2]
    # Not a product of BLAS, whose threads wait for each other in a live stream.
    sines = np.einsum("fn,fd->dn", _features(change), colours.astype(np.float32))
    sines = sines.T.reshape(height, width, 2)
    length = np.hypot(sines[..., 0], sines[..., 1])
    most = np.minimum(length, _STEEPEST)
    # The slope into the gel, for a step of one pixel.
    factor = most / np.maximum(length, 1e-9) / np.sqrt(1 - most**2) * width_mm / width
    depth = -integrated(sines[..., 0] * factor, sines[..., 1] * factor)
    return np.asarray(depth - _border_plane(depth), np.float32)


def _border_plane(depth: Array) -> Array:
    """Return the plane through most of the border of a surface (h, w), where the gel is flat.

    Small errors of all normals tilt the whole surface.
    """
    height, width = depth.shape
    y, x = np.mgrid[:height, :width]
    terms = np.stack([np.ones(depth.size), x.ravel() / width - 0.5, y.ravel() / height - 0.5], 1)
    at_border = ((x == 0) | (y == 0) | (x == width - 1) | (y == height - 1)).ravel()
    border = terms[at_border]
    values = depth.ravel()[at_border]
    weight = np.ones(len(values))
    for _ in range(5):
        # Least absolute deviations by weights: a contact that leaves the image is no border.
        plane = np.linalg.solve(border.T @ (weight[:, None] * border), border.T @ (weight * values))
        weight = 1 / np.maximum(np.abs(values - border @ plane), 1e-3)
    return np.asarray((terms @ plane).reshape(height, width))


def integrated(along_x: Array, along_y: Array) -> Array:
    """Return the surface (h, w) whose steps from pixel to pixel fit slopes best (Poisson).

    Its mean is 0, and its edges are free, so a cosine transform solves it (Frankot and Chellappa
    1988).
    """
    height, width = along_x.shape
    across = (along_x[:, 1:] + along_x[:, :-1]) / 2
    down = (along_y[1:] + along_y[:-1]) / 2
    divergence = np.zeros((height, width))
    divergence[:, :-1] += across
    divergence[:, 1:] -= across
    divergence[:-1] += down
    divergence[1:] -= down
    waves = [2 - 2 * np.cos(np.pi * np.arange(count) / count) for count in (height, width)]
    square = waves[0][:, None] + waves[1]
    square[0, 0] = 1.0
    values = -dctn(divergence, norm="ortho") / square
    values[0, 0] = 0.0
    return np.asarray(idctn(values, norm="ortho"))


def pressed_frames(frames: Sequence[Array], background: Array) -> list[Array]:
    """Return those of some frames RGB u8 (h, w, 3) that show a press.

    Raises UserError for too few, or for a background of another size.
    """
    gel = reduced(background)
    if any(reduced(frame).shape != gel.shape for frame in frames):
        raise UserError(
            "the background has another size than the presses. Take all with one setting of the "
            "camera."
        )
    untouched = UntouchedBackground(gel)
    pressed = [frame for frame in frames if untouched.score(frame) >= DIFFERENT]
    if len(pressed) < FEWEST:
        raise UserError(
            f"{len(pressed)} of {len(frames)} images show a press. Press the ball {FEWEST} times "
            "or more, at changing places and depths; 5 are good."
        )
    return pressed


def fit_ruler(
    frames: Sequence[Array],
    network: Array,
    background: Array,
    *,
    width_mm: float,
    ball_mm: float,
    family: str = "",
    weights: str = "",
) -> Ruler:
    """Fit a ruler to presses of a ball.

    Args:
        frames: N presses RGB u8 (h, w, 3) by one device (`pressed_frames`).
        network: (N, H, W), depth mm of them that the network reads.
        background: the untouched gel.
        width_mm: what the width of an image shows.
        ball_mm: diameter of the ball.
        family: the sensor of the table that the device is one of.
        weights: fingerprint of the network.

    Raises:
        UserError: presses that no ball of this size can make.
    """
    if not 1 <= ball_mm <= 40:
        raise UserError(f"a ball of {ball_mm:g} mm cannot be used. Take one of 3 to 12 mm.")
    gel = reduced(background)
    changes, clear = colour_changes([reduced(frame) for frame in frames], gel, find_dots(gel), LONG)
    placed = place_balls(changes, clear, width_mm, ball_mm)
    if float(np.median(placed.poses[:, 2])) > _DEEPEST * ball_mm / 2:
        raise UserError(
            f"the contacts are as wide as a ball of {ball_mm:g} mm, or wider. Check --ball-mm and "
            "--width-mm, or press less deep."
        )
    if placed.explained < _EXPLAINS:
        raise UserError(
            f"a ball of {ball_mm:g} mm explains {placed.explained:.0%} of the colours of these "
            "presses, and 90 % are usual. Press one ball by itself, and nothing else."
        )
    presses = _Presses(changes, placed.poses, width_mm, ball_mm / 2)
    read = _resized(network, changes.shape[1:3])
    everyone = range(len(frames))
    colours = presses.colours(everyone)
    seen = presses.surfaces(colours)
    off = presses.left_out(read)
    gains = (presses.gain(seen, everyone), presses.gain(read, everyone))
    # A network that is far off in size does not see this device's slopes.
    by_network = 1 / _READS < gains[1] < _READS and off[1] < off[0]
    spread = off[by_network]
    if spread > _OFF:
        raise UserError(
            f"depth of a press that is left out is {spread:.0%} off, so these presses are no "
            "ruler. Press the ball more often, at places all over the gel."
        )
    gain = gains[by_network]
    depths = gain * (read if by_network else seen)
    usual = usual_strength(family)
    limit = _UNUSUAL_AMONG_ALL if usual is None else _UNUSUAL
    strength = placed.strength / (usual or _USUAL)
    return Ruler(
        background=gel,
        colours=colours,
        width_mm=width_mm,
        gain=gain,
        by_network=by_network,
        weights=weights,
        rim=presses.rim(depths),
        reach_mm=1.2 * float(placed.poses[:, 2].max()),
        spread=max(spread, _LEAST_SPREAD),
        noise_mm=presses.noise(depths),
        ball_mm=ball_mm,
        presses=len(frames),
        explained=placed.explained,
        strength=strength,
        is_usual=_is_usual(strength, limit, gains[1]),
    )


def _is_usual(strength: float, limit: float, gain: float) -> bool:
    """Whether devices have such a strength. What the network's depth lacks is a second witness.

    Args:
        strength: of the colours over that of usual devices.
        limit: the largest that is usual.
        gain: of the network's depth.
    """
    is_large = strength > limit or (strength > _DOUBTFUL and gain < 1 / _READS)
    is_small = strength < _WEAKEST or (strength < 1 / _DOUBTFUL and gain > _READS)
    return not (is_large or is_small)


def write_ruler(folder: Path, ruler: Ruler) -> None:
    """Write ruler.npz of a folder NAME.sensor."""
    data = io.BytesIO()
    np.savez(
        data, allow_pickle=False, **{one.name: getattr(ruler, one.name) for one in fields(Ruler)}
    )
    atomic_write(folder / FILE, data.getvalue())


def read_ruler(folder: Path) -> Ruler | None:
    """Return the ruler of a folder NAME.sensor, None if it has none.

    Raises UserError for a damaged file.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        arrays = read_arrays(path)
        check_array("colours", arrays["colours"], (_TERMS, 2), "f")
        check_array("background", arrays["background"], (*arrays["background"].shape[:2], 3), "u")
        values: dict[str, Any] = {
            one.name: arrays[one.name] if arrays[one.name].ndim else arrays[one.name].item()
            for one in fields(Ruler)
        }
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{path} is damaged ({error}). Calibrate the sensor again.") from None
    return Ruler(**values)


class _Presses:
    """Presses of a ball at known poses, to which readers of depth are fitted.

    Args:
        changes: colour changes f32 (N, h, w, 3), 0 to 1.
        poses: (N, 3) of `Balls`.
        width_mm: what the width of an image shows.
        radius: that of the ball, mm.
    """

    def __init__(self, changes: Array, poses: Array, width_mm: float, radius: float) -> None:
        self._changes = changes
        self._width_mm = width_mm
        self._radius = radius
        self._contacts = poses[:, 2]
        grid = pixel_grid(changes.shape[1:3], width_mm)
        self._away = [np.hypot(grid.x - x, grid.y - y) for x, y, _ in poses]
        rows = [_features(change).T.astype(np.float64) for change in changes]
        self._normal = [
            self._equations(row, np.stack(normals_of(grid, pose, radius), -1), n)
            for n, (row, pose) in enumerate(zip(rows, poses, strict=True))
        ]

    def _equations(self, row: Array, sines: Array, press: int) -> tuple[Array, Array]:
        """Return the normal equations of a press for the colours of its normals."""
        ratio = self._away[press].ravel() / self._contacts[press]
        weight = np.where(ratio < 1, 1.0, np.where(ratio < 1.5, _NEXT, _FAR))[:, None]
        with threadpool_limits(1):
            return row.T @ (weight * row), row.T @ (weight * sines.reshape(-1, 2))

    def colours(self, kept: Sequence[int]) -> Array:
        """Return the colours (25, 2) of the normals of some presses, by ridge regression."""
        gram = sum(self._normal[n][0] for n in kept)
        right = sum(self._normal[n][1] for n in kept)
        scale = np.sqrt(np.diag(gram)) + 1e-12
        scaled = gram / scale / scale[:, None] + _RIDGE * np.eye(_TERMS)
        return np.asarray(np.linalg.solve(scaled, right / scale[:, None]) / scale[:, None])

    def surfaces(self, colours: Array) -> Array:
        """Return depths (N, h, w) by colours."""
        return np.stack([surface_of(one, colours, self._width_mm) for one in self._changes])

    def above_rim(self, depth: Array, press: int) -> tuple[Array, Array, float]:
        """Return measured and true depth (n,) over the rim in a contact, and the rim's own depth.

        What the gel does outside of the contact is not known, so the rim is the zero.
        """
        contact = float(self._contacts[press])
        away = self._away[press]
        inside = away < contact
        pixel = contact * np.sqrt(np.pi / max(1, inside.sum()))
        level = float(np.median(depth[np.abs(away - contact) < pixel]))
        true = np.sqrt(self._radius**2 - away[inside] ** 2)
        return depth[inside] - level, true - np.sqrt(self._radius**2 - contact**2), level

    def gain(self, depths: Array, kept: Sequence[int]) -> float:
        """Return the factor on depths that fits some presses best."""
        pairs = [self.above_rim(depths[n], n)[:2] for n in kept]
        product = sum(float((own * true).sum()) for own, true in pairs)
        square = sum(float((own**2).sum()) for own, _ in pairs)
        return max(product, 0.0) / max(square, 1e-12)

    def left_out(self, read: Array) -> tuple[float, float]:
        """Return how far off colours and the network's depths (N, h, w) are, as fractions.

        Each press is left out in turn, and the median over presses counts.
        """
        errors = []
        for out in range(len(self._changes)):
            kept = [n for n in range(len(self._changes)) if n != out]
            seen = self.surfaces(self.colours(kept))
            pair = []
            for depths in (seen, read):
                own, true, _ = self.above_rim(self.gain(depths, kept) * depths[out], out)
                pair.append(float(np.sqrt(((own - true) ** 2).mean() / (true**2).mean())))
            errors.append(pair)
        by_colours, by_network = np.median(errors, axis=0)
        return float(by_colours), float(by_network)

    def rim(self, depths: Array) -> float:
        """Return the depth of a rim over the deepest one, the median over presses."""
        levels = [
            self.above_rim(depth, n)[2] / max(float(depth.max()), 1e-9)
            for n, depth in enumerate(depths)
        ]
        return float(np.clip(np.median(levels), 0.1, 0.9))

    def noise(self, depths: Array) -> float:
        """Return the deviation mm of depth where nothing touches, far from the presses."""
        far = [
            np.median(np.abs(depth[away > 3 * contact]))
            for depth, away, contact in zip(depths, self._away, self._contacts, strict=True)
            if (away > 3 * contact).any()
        ]
        return max(_NOISE, 0.3 * float(np.median(far))) if far else _NOISE
