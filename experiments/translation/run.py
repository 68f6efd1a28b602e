"""A translation from the command line: images of one sensor to images, or fields, of another."""

from __future__ import annotations

import io
import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.transforms import subtract_background, touch_evaluation
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write
from anytouch_jax.train.mesh import enable_compilation_cache
from anytouch_jax.train.progress import to_stderr as log
from experiments.command import run_script
from experiments.translation import generator, pairs, training


@dataclass(frozen=True)
class Translate:
    """Translate images of one sensor into images, or fields, of another.

    With --fit, train that translation.

    Example: python -m experiments.translation.run frame.png --model runs/stage2 --source
    gelsight_mini --target duragel

    Train it first, with --fit --data pairs/manifest.parquet. Pairs are frames with equal touch and
    frame_index (anytouch data simulate --grade fine --units one). A translation is stored in
    MODEL/generators/SOURCE-TARGET. Images come out at the model's size as PNG, fields (tac3d) as
    .npy, in mm and N.
    """

    images: tuple[Path, ...]
    """Images of the source sensor."""
    model: Path | None = None
    """Run folder or weights file of the encoder. A run folder also stores its translations."""
    source: str = "gelsight_mini"
    """Sensor of the images."""
    target: str = "duragel"
    """Sensor to translate to."""
    background: Path | None = None
    """Image of the untouched gel, for an encoder trained on background-subtracted frames."""
    out: Path | None = None
    """File or folder to write (default: the folder of each image). With --fit, the folder of the
    translation.
    """
    generator: Path | None = None
    """Folder of a translation that is not in the run."""
    fit: bool = False
    """Train the translation on split train of --data, score it on split test, and store it."""
    data: tuple[Path, ...] = ()
    """Manifests with fine-aligned pairs."""
    steps: int = 800
    """Training steps."""
    batch: int = 32
    """Pairs a step."""
    learning_rate: float = 1e-3
    """Peak of the learning rate."""
    tune: Literal["frozen", "fine"] = "frozen"
    """Freeze the encoder, or train it too at a tenth of the rate."""
    adversarial: float = 0.02
    """Weight of the critic of images, in units of the error of copying the mean image. 0 trains
    without a critic.
    """
    seed: int = 0
    """Seed of everything drawn."""


def run(options: Translate) -> int:
    """Translate images, or train a translation."""
    enable_compilation_cache()
    if options.fit and options.images:
        raise UserError("--fit takes its images from --data. Translate in a second call.")
    if options.fit:
        return _fit(options)
    return _translate(options)


def _home(options: Translate, folder: Path | None) -> Path:
    """Return the folder of the translation: `folder`, or its place in the run."""
    if folder is not None:
        return folder
    if options.model is None or not options.model.is_dir():
        raise UserError(
            f"--model {options.model} is no run folder, which stores translations. Give "
            "--generator."
        )
    return options.model / "generators" / f"{options.source}-{options.target}"


def _fit(options: Translate) -> int:
    home = _home(options, options.out or options.generator)
    if options.model is None or not options.data:
        raise UserError("--fit needs the encoder of --model and the pairs of --data.")
    if (home / generator.GENERATOR).exists():
        raise UserError(f"{home} holds a translation already. Choose another folder with --out.")
    names = ("steps", "batch", "learning_rate", "tune", "adversarial", "seed")
    fit = generator.Fit(**{name: getattr(options, name) for name in names})
    encoder = load_encoder(options.model)
    table = manifests.read(options.data)
    split = pairs.find_pairs(table, options.source, options.target)
    encoder.sensor_row(options.source, log)
    log(
        f"{len(split.train.source)} pairs to train on, {len(split.test.source)} of held-out "
        "objects to test on"
    )
    size = encoder.config.model.image_size
    (x, y), val, (test_x, test_y) = (
        pairs.read_pairs(table, part, size, subtract=encoder.subtracts) for part in split
    )
    made, losses = training.fit(
        encoder, x, y, source=options.source, target=options.target, val=val, options=fit, log=log
    )
    error = training.errors(made, test_x, test_y).mean()
    mean = training.mean_errors(made, test_y).mean()
    report = {"error": error, "mean target": mean, "test pairs": len(test_x), "losses": losses}
    report["critic"] = made.design.has_critic
    atomic_write(home / "report.json", json.dumps(report, indent=2, allow_nan=False) + "\n")
    generator.save(made, home)  # last: a folder that holds it is whole
    print(f"{home}: error {error:.4f} on held-out objects (copying the mean target: {mean:.4f})")
    return 0


def _translate(options: Translate) -> int:
    home = _home(options, options.generator)
    made = generator.load(home)
    design = made.design
    if (design.source, design.target) != (options.source, options.target):
        wanted = f"{options.source} to {options.target}"
        raise UserError(f"{home} translates {design.source} to {design.target}, not {wanted}.")
    if not options.images:
        raise UserError("Give an image to translate, or --fit to train a translation.")
    targets = _targets(options, ".npy" if design.shape.field else ".png")
    images = [decode(path) for path in options.images]
    if design.subtracts != (options.background is not None):
        need = (
            "needs a --background, which is subtracted"
            if design.subtracts
            else "takes no --background"
        )
        raise UserError(f"The encoder of {home} {need}.")
    if options.background is not None:
        images = [subtract_background([one], decode(options.background))[0] for one in images]
    inputs = np.concatenate(
        [touch_evaluation([one], design.shape.model.image_size) for one in images]
    )
    for target, result in zip(targets, made(inputs), strict=True):
        _write(target, result)
        print(target)
    return 0


def _targets(options: Translate, suffix: str) -> list[Path]:
    """Return where each result goes.

    Raises UserError for a file that is read, and for two results in one place.
    """
    out = options.out
    images = options.images
    if out is not None and out.suffix and not out.is_dir():
        if len(images) > 1 or out.suffix.lower() != suffix:
            raise UserError(f"--out {out} must be a folder, or a {suffix} file for a single image.")
        return [out]
    targets = [(out or path.parent) / f"{path.stem}_{options.target}{suffix}" for path in images]
    if len(set(targets)) < len(targets):
        raise UserError("Two images have the same name. Translate them into different folders.")
    return targets


def _write(path: Path, result: Any) -> None:
    if result.dtype == np.uint8:
        atomic_write(path, cv2.imencode(".png", result[..., ::-1])[1].tobytes())
        return
    data = io.BytesIO()
    np.save(data, result, allow_pickle=False)
    atomic_write(path, data.getvalue())


main = partial(run_script, Translate, run)

if __name__ == "__main__":
    sys.exit(main())
