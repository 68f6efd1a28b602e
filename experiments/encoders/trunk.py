"""The convolutional trunk of the touch encoder (`anytouch_jax.nn.sight`): the touches that it is
distilled on, and how it joins an encoder.

    python -m experiments.encoders.trunk touches --real data/real/*/manifest.csv --out runs/trunk
    python experiments/encoders/distil.py ...   (PyTorch, writes runs/trunk/trunk.npz)
    python -m experiments.encoders.trunk join anytouch-tiny runs/trunk --real
    data/real/pack2/manifest.csv

`join` fits a linear map to the means over the trunk's feature maps, and writes the encoder with
both. All its other parameters stay as they are, so it may run after each of their trainings.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np
from jax import Array

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.transforms import subtract_background, touch_evaluation
from anytouch_jax.encoder.arrays import run_in_batches
from anytouch_jax.nn.sight import MEANS, feature_means
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.sim.batches import SimulatedLoader
from anytouch_jax.train.progress import to_stderr as log
from anytouch_jax.weights.load import load_model
from anytouch_jax.weights.registry import DEFAULT, PARTS, locate, write_encoder
from anytouch_jax.weights.tree import nest
from experiments.encoders.train import configure

Images = np.ndarray  # u8 (n, SIDE, SIDE, 3)
Params = dict[str, Any]

SIDE = 112
PAIRS = 120  # batches of 16 simulated touches, each by two sensors
DRAWN = 3000  # images
SIMULATED = 0.5  # weight of simulated pairs beside real ones
SHRINKAGE = 0.1  # of the scatter between units
# Deviation of a value over touches, a fifth of that of the class token: neighbours by cosine gain
# on real touch, and the same touch by another sensor is found as often as without the trunk.
DEVIATION = 0.2


# Touches ------------------------------------------------------------------------------------------


class RealTouches(NamedTuple):
    """Frames of train less their untouched gels, the touch that each shows ("": none), its unit."""

    images: Images
    touch: np.ndarray
    unit: np.ndarray


def real_touches(path: Path) -> RealTouches:
    """Return the train frames of a manifest of `experiments.encoders.real` that have a gel.

    The unit is the camera of the gripper, whose gels were changed: the name of the unit up to its
    first "_".
    """
    manifest = manifests.read(path)
    gel_of = Backgrounds(manifest).shared(lambda image: image)
    images = []
    kept = []
    for row in manifest.rows_of("train"):
        gel = gel_of(int(row))
        if gel is not None:
            less = subtract_background([decode(manifest.file(int(row)))], gel)
            images.append(touch_evaluation(less, SIDE)[0])
            kept.append(row)
    is_contact = manifest.number_column("label.contact") == 1
    touch = np.where(is_contact, manifest.text_column("touch"), "")[kept]
    unit = np.array([name.partition("_")[0] for name in manifest.text_column("unit")[kept]])
    return RealTouches(np.stack(images), touch, unit)


def plain_frames(path: Path) -> Images:
    """Return the train frames of a manifest as they are."""
    manifest = manifests.read(path)
    files = [manifest.file(int(row)) for row in manifest.rows_of("train")]
    return np.concatenate([touch_evaluation([decode(file)], SIDE) for file in files])


def simulated_pairs(batches: int, seed: int = 7) -> tuple[Images, Images]:
    """Return touches (n, 2, SIDE, SIDE, 3) by two simulated sensors each, less their gels and
    plain.
    """
    changes = {
        "data.batch_size": 16,
        "data.clip_fraction": 0.0,
        "model.fields": 0,
        "model.text": None,
        "simulated.wild": 0.3,
        "simulated.reuse": 1,
    }
    loader = SimulatedLoader(configure(2, [], seed, changes))
    less = []
    plain = []
    for number in range(batches):
        touches = loader.touches(number)
        frames = np.asarray(touches.clip)[:, :, 0]
        gels = np.asarray(touches.background)
        plain.append(frames)
        for two, own in zip(frames, gels, strict=True):
            pair = zip(two, own, strict=True)
            less.append([subtract_background([frame], gel)[0] for frame, gel in pair])
    return np.array(less, np.uint8), np.concatenate(plain)


def drawn_image(rng: np.random.Generator) -> np.ndarray:
    """Return shapes that hide each other, with textures, lines and dots (after Lee et al. 2001)."""
    image = _texture(rng)
    for _ in range(int(rng.integers(0, 25))):
        mask = _shape(rng)
        if rng.random() < 0.4:
            mask = cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(0.3, 4)))
        share = mask[..., None].astype(np.float32) / 255
        image = image * (1 - share) + share * _texture(rng)
    return np.clip(image, 0, 255).astype(np.uint8)


def _shape(rng: np.random.Generator) -> np.ndarray:
    """Return the mask of an ellipse, a polygon, a line or a grid of dots."""
    mask = np.zeros((SIDE, SIDE), np.uint8)
    centre = rng.integers(0, SIDE, 2)
    size = float(np.exp(rng.uniform(np.log(2), np.log(50))))
    kind = rng.integers(4)
    if kind == 0:
        axes = (max(1, int(size)), max(1, int(size * rng.uniform(0.2, 1))))
        turn = float(rng.uniform(0, 180))
        cv2.ellipse(mask, centre.tolist(), axes, turn, 0, 360, 255, -1, cv2.LINE_AA)
    elif kind == 1:
        corners = centre + rng.normal(0, size, (int(rng.integers(3, 7)), 2))
        cv2.fillPoly(mask, [corners.astype(np.int32)], 255, cv2.LINE_AA)
    elif kind == 2:
        end = (centre + rng.normal(0, 2 * size, 2)).astype(int)
        cv2.line(mask, centre.tolist(), end.tolist(), 255, int(rng.integers(1, 6)), cv2.LINE_AA)
    else:
        pitch = int(rng.integers(5, 24))
        radius = int(rng.integers(1, 4))
        for x in range(int(rng.integers(pitch)), SIDE, pitch):
            for y in range(int(rng.integers(pitch)), SIDE, pitch):
                cv2.circle(mask, (x, y), radius, 255, -1, cv2.LINE_AA)
    return mask


def _texture(rng: np.random.Generator) -> np.ndarray:
    """Return a plain, a striped or a cloudy image f32 (SIDE, SIDE, 3)."""
    colour = np.full(3, rng.uniform(0, 255)) if rng.random() < 0.3 else rng.uniform(0, 255, 3)
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    kind = rng.integers(3)
    wave = np.zeros((SIDE, SIDE), np.float32)
    if kind == 1:
        angle = rng.uniform(0, np.pi)
        pitch = np.exp(rng.uniform(np.log(3), np.log(60)))
        wave = np.sin(2 * np.pi * (np.cos(angle) * x + np.sin(angle) * y) / pitch)
    elif kind == 2:
        side = int(rng.integers(3, SIDE))
        wave = cv2.resize(rng.standard_normal((side, side)).astype(np.float32), (SIDE, SIDE))
    depth = rng.normal(0, 40, 3) if rng.random() < 0.5 else np.full(3, rng.normal(0, 40))
    return np.asarray(colour + wave[..., None] * depth, np.float32)


def write_touches(real: Sequence[Path], folder: Path) -> None:
    """Write the images that `distil.py` takes, and the simulated pairs that `join` takes."""
    folder.mkdir(parents=True, exist_ok=True)
    less, plain = simulated_pairs(PAIRS)
    np.save(folder / "pairs.npy", less)
    rng = np.random.default_rng(5)
    albums = {
        "simulated": less.reshape(-1, SIDE, SIDE, 3),
        "simulated, plain": plain.reshape(-1, SIDE, SIDE, 3),
        "drawn": np.stack([drawn_image(rng) for _ in range(DRAWN)]),
    }
    for number, path in enumerate(real):
        albums[f"real {number}"] = real_touches(path).images
        albums[f"real {number}, plain"] = plain_frames(path)
    np.savez(folder / "touches.npz", **albums)
    log(f"{folder}: {', '.join(f'{len(album)} {name}' for name, album in albums.items())}")


# The readout --------------------------------------------------------------------------------------


def means_of(trunk: Params, images: Images) -> np.ndarray:
    """Return the means over the trunk's feature maps (n, MEANS) of images (n, SIDE, SIDE, 3)."""

    @jax.jit
    def run(images: Array) -> Array:
        return feature_means(trunk, normalise_touch(images[:, None])[:, 0])

    return run_in_batches(run, images, 8)


def scatter_within(real: np.ndarray, touches: RealTouches, pairs: np.ndarray) -> np.ndarray:
    """Return how features differ between units that feel one touch, (d, d), of trace d.

    Args:
        real: Features (n, d) of `touches`.
        touches: What they show.
        pairs: Features (m, 2, d) of touches by two simulated sensors.
    """
    apart = []
    for name in np.unique(touches.touch[touches.touch != ""]):
        shown = touches.touch == name
        units = np.unique(touches.unit[shown])
        means = np.stack([real[shown & (touches.unit == unit)].mean(0) for unit in units])
        if len(units) > 1:
            apart.append(means - means.mean(0))
    total = np.zeros((real.shape[1], real.shape[1]))
    for off, weight in (
        (np.concatenate(apart), 1.0),
        (pairs[:, 0] - pairs[:, 1], SIMULATED),
    ):
        scatter = off.T @ off
        total += weight * scatter / np.trace(scatter)
    return total * len(total) / np.trace(total)


def whitening(within: np.ndarray) -> np.ndarray:
    """Return the symmetric map (d, d) that makes a scatter (d, d) the same in all directions."""
    values, vectors = np.linalg.eigh(within + SHRINKAGE * np.eye(len(within)))
    return np.asarray(vectors / np.sqrt(values) @ vectors.T)


def readout(trunk: Params, touches: RealTouches, pairs: Images) -> Params:
    """Return the kernel and the bias of `nn.sight.Sight.read`.

    They give the means of the trunk, less what differs between units that feel one touch: a
    symmetric whitening of that (within-class covariance normalisation, Hatch et al. 2006). Without
    it a head that was fitted on one camera names a third of the objects by another one.
    """
    real = means_of(trunk, touches.images)
    is_contact = touches.touch != ""
    mean = real[is_contact].mean(0)
    deviation = real[is_contact].std(0) + 1e-6
    real = (real - mean) / deviation
    simulated = (means_of(trunk, pairs.reshape(-1, SIDE, SIDE, 3)) - mean) / deviation
    within = scatter_within(real, touches, simulated.reshape(len(pairs), 2, -1))
    kernel = whitening(within)
    kernel = kernel * (DEVIATION / (real[is_contact] @ kernel).std(0)) / deviation[:, None]
    return {"kernel": kernel.astype(np.float32), "bias": (-mean @ kernel).astype(np.float32)}


def join(encoder: str, folder: Path, real: Path, out: Path) -> Path:
    """Write an encoder with the trunk of a folder. Its other parameters stay as they are."""
    with np.load(folder / "trunk.npz") as file:
        trunk = nest(dict(file))
    read = readout(trunk, real_touches(real), np.load(folder / "pairs.npy"))
    path = locate(encoder)
    loaded = load_model(path)
    config = replace(loaded.config, model=replace(loaded.config.model, sight=MEANS))
    touch = loaded.params["touch"] | {"sight": {"trunk": trunk, "read": read}}
    loaded = replace(loaded, config=config, params=loaded.params | {"touch": touch})
    notes = Path(__file__).with_name(f"{DEFAULT}.md").read_text(encoding="utf-8")
    tokenizer = path.with_name("tokenizer.json")
    return write_encoder(out, loaded, notes, parts=PARTS, tokenizer=tokenizer)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    touches = commands.add_parser("touches", help="write what the trunk is distilled on")
    touches.add_argument("--real", type=Path, nargs="+", required=True, help="manifests")
    touches.add_argument("--out", type=Path, default=Path("runs/trunk"))
    joined = commands.add_parser("join", help="write an encoder with the trunk")
    joined.add_argument("encoder", help="the encoder without it, or with another")
    joined.add_argument("folder", type=Path, help="that of trunk.npz and pairs.npy")
    joined.add_argument("--real", type=Path, required=True, help="recordings by two units")
    joined.add_argument("--out", type=Path, default=Path("runs/trunk/anytouch-tiny"))
    options = parser.parse_args()
    if options.command == "touches":
        write_touches(options.real, options.out)
    else:
        print(join(options.encoder, options.folder, options.real, options.out))


if __name__ == "__main__":
    main()
