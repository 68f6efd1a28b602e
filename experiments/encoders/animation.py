"""The animation of the README: presses on a simulated sensor, named and measured.

python -m experiments.encoders.animation docs/pictures/press.webp

Every object is taught by TAUGHT presses. Then it is pressed at another place, at another angle and
to another depth, and the encoder of the package says its name, the depth and the force.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import anytouch_jax as at
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.sim.recorder import RELIEF, SPACING
from anytouch_jax.sim.world.shapes import Shape, relief
from anytouch_jax.train.mesh import enable_compilation_cache

SENSOR = "gelsight_mini"
OBJECTS = {
    "ring": Shape("ring", size=3.2),
    "screw": Shape("screw", size=4.0, texture_pitch=1.6),
    "letter H": Shape("letters", size=8.0, letter="H"),
    "ball": Shape("sphere", size=5.0),
}
TAUGHT = 5  # presses of each object that are named
FRAMES = 26  # of a press
DEEPEST = 0.75  # mm
MILLISECONDS = 70  # a frame is shown
# Inches, and pixels an inch.
WIDTH = 11.4
HEIGHT = 3.0
DPI = 90
# Colours of the page in its dark theme.
BACK = "#121416"
TEXT = "#e8eaec"
SOFT = "#a0abb5"
ACCENT = "#62c9d2"
LINE = "#33393e"
MOST = 3_000_000  # bytes of the file


class Shown(NamedTuple):
    """A frame of the animation."""

    image: np.ndarray
    depth: np.ndarray  # mm
    deepest: float  # mm, measured
    name: str
    force: float  # N, measured
    true_force: float


def pressed(name: str, rng: np.random.Generator, depth: np.ndarray, *, still: bool) -> Any:
    """Return simulated presses of an object to some depths (n,) in mm.

    They are at one place if it is `still`, else each is at another one.
    """
    count = 1 if still else len(depth)
    place = rng.uniform(-0.8, 0.8, (count, 2))
    turn = rng.uniform(-0.5, 0.5, (count, 1))
    poses = np.broadcast_to(np.concatenate([place, turn], 1), (len(depth), 3))
    height_map = relief(OBJECTS[name], RELIEF, SPACING)
    return jax.device_get(simulate(height_map, np.concatenate([poses, depth[:, None]], 1)))


simulate = jax.jit(partial(at.simulate_touch, sensor=SENSOR, size=240))


def features_of(encoder: Encoder, touches: Any) -> np.ndarray:
    """Return features (n, E) of simulated touches."""
    images = zip(touches.image, touches.background, strict=True)
    frames = np.stack([encoder.preprocess(*pair) for pair in images])
    return np.asarray(encoder.encode_touch(frames, sensor=SENSOR))


def video_of(encoder: Encoder, seed: int = 3) -> list[Shown]:
    """Return the frames: each object is taught, then pressed once."""
    rng = np.random.default_rng(seed)
    taught = {
        name: features_of(encoder, pressed(name, rng, rng.uniform(0.3, 0.9, FRAMES), still=False))
        for name in OBJECTS
    }
    middle = np.concatenate([one[:TAUGHT] for one in taught.values()]).mean(0)
    means = np.stack([one[:TAUGHT].mean(0) - middle for one in taught.values()])
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    rise = np.clip(1.6 * np.sin(np.linspace(0, np.pi, FRAMES)) - 0.25, 0, 1)
    frames = []
    for name in OBJECTS:
        touches = pressed(name, rng, DEEPEST * rise, still=True)
        named = np.argmax((features_of(encoder, touches) - middle) @ means.T, 1)
        measured = encoder.measure(touches.image, touches.background[0], SENSOR)
        assert measured.force is not None
        shown = measured.at(*touches.image.shape[1:3])
        for number in range(FRAMES):
            deepest = float(shown.depth[number].max())
            feels = deepest > 0.08
            frames.append(
                Shown(
                    touches.image[number],
                    shown.depth[number],
                    deepest,
                    list(OBJECTS)[named[number]] if feels else "",
                    float(measured.force[number, 2]),
                    float(touches.force[number, 2]),
                )
            )
    return frames


class Canvas:
    """The figure that shows one frame after the other."""

    def __init__(self, frames: list[Shown]) -> None:
        self.frames = frames
        self.figure = Figure(figsize=(WIDTH, HEIGHT), dpi=DPI, facecolor=BACK)
        FigureCanvasAgg(self.figure)
        shape = frames[0].image.shape
        tall = 0.72
        wide = tall * HEIGHT / WIDTH * shape[1] / shape[0]
        image = self.figure.add_axes((0.025, 0.13, wide, tall))
        depth = self.figure.add_axes((0.045 + wide, 0.13, wide, tall))
        for axis, title in ((image, "a press"), (depth, "depth")):
            axis.set_axis_off()
            axis.set_title(title, color=SOFT, fontsize=11, loc="left", pad=7)
        self.image = image.imshow(frames[0].image)
        self.depth = depth.imshow(frames[0].depth, cmap="viridis", vmin=0, vmax=DEEPEST)
        bar = self.figure.add_axes((0.055 + 2 * wide, 0.13, 0.012, tall))
        scale = self.figure.colorbar(self.depth, cax=bar, ticks=[0, DEEPEST])
        scale.ax.set_yticklabels(["0", f"{DEEPEST} mm"], color=SOFT, fontsize=10)
        scale.outline.set_edgecolor(LINE)
        bar.tick_params(length=0)
        left = 0.14 + 2 * wide
        self.name = self.figure.text(left, 0.74, "", color=TEXT, fontsize=24, weight="bold")
        self.force = self.figure.text(left, 0.57, "", color=ACCENT, fontsize=15)
        curve = self.figure.add_axes((left, 0.17, 0.965 - left, 0.32), facecolor=BACK)
        most = 1.15 * max(max(one.true_force, one.force) for one in frames)
        curve.set(xlim=(0, FRAMES - 1), ylim=(-0.02 * most, most), xticks=[], yticks=[])
        for side in curve.spines.values():
            side.set_color(LINE)
        self.truth = curve.plot([], [], color=SOFT, linestyle=":", linewidth=1.6)[0]
        self.felt = curve.plot([], [], color=ACCENT, linewidth=2.4)[0]
        self.figure.text(left, 0.055, "force", color=ACCENT, fontsize=10)
        self.figure.text(left + 0.045, 0.055, "and the true one", color=SOFT, fontsize=10)
        about = f"named after {TAUGHT} other presses of each object"
        self.figure.text(left, 0.89, about, color=SOFT, fontsize=10)

    def draw(self, number: int) -> np.ndarray:
        """Return a frame RGB u8 (h, w, 3)."""
        one = self.frames[number]
        begin = number - number % FRAMES
        past = self.frames[begin : number + 1]
        self.image.set_data(one.image)
        self.depth.set_data(one.depth)
        self.name.set_text(one.name or "–")
        self.name.set_color(TEXT if one.name else SOFT)
        told = f"{one.force:.1f} N    {one.deepest:.2f} mm deep" if one.name else "nothing touches"
        self.force.set_text(told)
        self.force.set_color(ACCENT if one.name else SOFT)
        self.truth.set_data(range(len(past)), [each.true_force for each in past])
        self.felt.set_data(range(len(past)), [each.force for each in past])
        canvas = self.figure.canvas
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]


def write(out: Path, frames: list[Shown], quality: int = 93) -> int:
    """Write the animation as WebP, and return its bytes."""
    canvas = Canvas(frames)
    animation = cv2.Animation()
    animation.frames = [
        np.ascontiguousarray(canvas.draw(number)[..., ::-1]) for number in range(len(frames))
    ]
    animation.durations = np.full(len(frames), MILLISECONDS, np.int32)  # type: ignore[assignment]
    out.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwriteanimation(str(out), animation, [cv2.IMWRITE_WEBP_QUALITY, quality]):
        raise OSError(f"{out} was not written")
    return out.stat().st_size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="the animation to write, .webp")
    parser.add_argument("model", nargs="?", default="anytouch-tiny", help="an encoder")
    options = parser.parse_args()
    enable_compilation_cache()
    frames = video_of(at.load_encoder(options.model))
    size = write(options.out, frames)
    pairs = list(zip(frames, np.repeat(list(OBJECTS), FRAMES), strict=True))
    right = np.mean([one.name == name for one, name in pairs if one.name])
    off = np.mean([abs(one.force / one.true_force - 1) for one in frames if one.name])
    print(f"{len(frames)} frames, {size} bytes, {right:.0%} named rightly, force off by {off:.0%}")
    if size > MOST:
        raise SystemExit(f"{options.out} has {size} bytes, {MOST} at most are wanted")


if __name__ == "__main__":
    main()
