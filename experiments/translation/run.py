"""`anytouch translate`: images of one sensor as another would feel the touch; with --fit that is trained."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from anytouch_jax.cli.output import check_home
from anytouch_jax.cli.unused import refuse
from anytouch_jax.cli.words import log
from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.config.parsing import SEED, in_range
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write
from experiments.command import run_script
from experiments.translation.generator import GENERATOR

_OF_FIT = ("data", "steps", "batch", "learning_rate", "tune", "adversarial", "seed")


@dataclass(frozen=True)
class Translate:
    """Translate images of one sensor into images, or fields, of another; with --fit train that translation.

    Example: python -m experiments.translation.run --run runs/stage2 --from gelsight_mini --to duragel frame.png

    First: anytouch translate --fit --data pairs/manifest.parquet --run runs/stage2 --from gelsight_mini --to duragel.
    Pairs are frames with equal touch and frame_index (anytouch simulate --grade fine --units one). A translation is
    kept in RUN/generators/FROM-TO. Images come out at the model's size as PNG, fields (tac3d) as .npy, mm and N.
    """

    images: tuple[Path, ...]
    """Images of the sensor that is given."""
    run: Path | None = None
    """Run folder or weights file of the encoder; where its translations are kept."""
    source: str = "gelsight_mini"
    """Sensor that is given."""
    to: str = "duragel"
    """Sensor that is wanted."""
    background: Path | None = None
    """Picture of the untouched gel, for an encoder trained on differences from it."""
    out: Path | None = None
    """File or folder to write (default: beside each image). With --fit: the folder of the translation."""
    generator: Path | None = None
    """Folder of a translation, when it is not in the run."""
    fit: bool = False
    """Train the translation on the pairs of --data (split train), score it on split test, and keep it."""
    data: tuple[Path, ...] = ()
    """Manifests with fine-aligned pairs."""
    steps: int = 800
    """Training steps."""
    batch: int = 32
    """Pairs a step."""
    learning_rate: float = 1e-3
    """Peak of the learning rate."""
    tune: Literal["frozen", "fine"] = "frozen"
    """Keep the encoder as it is, or train it too, at a tenth of the rate."""
    adversarial: float = 0.02
    """Weight of the critic's verdict on images, in units of the error of copying the mean image; 0 for none."""
    seed: int = 0
    """Seed of everything drawn."""


def run(options: Translate) -> int:
    """Translate images, or train a translation."""
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    in_range("--", options, seed=SEED)
    if options.fit and options.images:
        raise UserError("--fit takes its images from --data; translate in a second call")
    if options.fit:
        refuse(options, ("background",), "with --fit: the pairs of --data name their backgrounds")
        if options.out is not None:
            refuse(options, ("generator",), "beside --fit --out, which names the folder of what is trained")
    else:
        refuse(options, _OF_FIT, "without --fit, which trains a translation")
        if options.generator is not None:
            refuse(options, ("run",), "beside --generator, which holds its encoder")
    return _fit(options) if options.fit else _translate(options)


def _home(options: Translate, given: Path | None, asked: str) -> Path:
    """The folder of the translation: as given, or its place in the run."""
    if given is not None:
        return given
    if options.run is None:
        raise UserError(f"give --run, where translations are kept, or --{asked}")
    if not options.run.exists():
        raise UserError(f"no run folder or weights file at {options.run}")
    if options.run.is_file():
        raise UserError(f"{options.run} is a file and keeps no translations; give their folder with --{asked}")
    return options.run / "generators" / f"{options.source}-{options.to}"


def _fit(options: Translate) -> int:
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.encoder.encoder import load_encoder
    from experiments.translation import generator, pairs, training
    from experiments.translation.figures import picture_grid

    home = _home(options, options.out or options.generator, "out")
    if options.run is None or not options.data:
        raise UserError("--fit needs the encoder of --run and the pairs of --data")
    if options.to in FIELD_SENSORS:
        refuse(options, ("adversarial",), f"to {options.to}, whose fields have no critic")
    check_home(home)
    if (home / GENERATOR).exists():
        raise UserError(f"{home} holds a translation already; remove it, or choose another folder with --out")
    how = generator.Fit(
        steps=options.steps,
        batch=options.batch,
        learning_rate=options.learning_rate,
        tune=options.tune,
        adversarial=options.adversarial,
        seed=options.seed,
    )
    encoder = load_encoder(options.run)
    table = manifests.read(options.data)
    split = pairs.find_pairs(table, options.source, options.to)
    encoder.sensor_row(options.source, log)
    log(f"{len(split.train.source)} pairs to train on, {len(split.test.source)} of objects never seen to test on")
    size = encoder.config.model.image_size
    (x, y), val, (test_x, test_y) = (pairs.read_pairs(table, part, size, subtract=encoder.subtracts) for part in split)
    made, losses = training.fit(encoder, x, y, source=options.source, target=options.to, val=val, options=how, log=log)
    ours, mean = training.errors(made, test_x, test_y), training.mean_errors(made, test_y)
    picture_grid(home / "pairs.png", made, test_x, test_y)
    report = {"error": ours.mean(), "mean target": mean.mean(), "test pairs": len(ours), "losses": losses}
    report["critic"] = made.design.has_critic
    atomic_write(home / "report.json", json.dumps(report, indent=2, allow_nan=False) + "\n")
    generator.save(made, home)  # last: a folder that holds it is whole
    print(f"{home}: error {ours.mean():.4f} on objects never seen (copying the mean target: {mean.mean():.4f})")
    return 0


def _translate(options: Translate) -> int:
    from anytouch_jax.data.images import decode
    from anytouch_jax.data.transforms import subtract_background, touch_evaluation
    from experiments.translation import generator

    home = _home(options, options.generator, "generator")
    made = generator.load(home)
    design = made.design
    if (design.source, design.target) != (options.source, options.to):
        raise UserError(f"{home} translates {design.source} to {design.target}, not {options.source} to {options.to}")
    if not options.images:
        raise UserError("give an image to translate, or --fit to train a translation")
    targets = _targets(options, ".npy" if design.shape.field else ".png")
    size = design.shape.model.image_size
    images = [decode(path) for path in options.images]
    if design.subtracts:
        if options.background is None:
            raise UserError("this encoder sees touches less the untouched gel: name its picture by --background")
        images = [subtract_background([one], decode(options.background))[0] for one in images]
    elif options.background is not None:
        raise UserError("this encoder sees touches as the camera gives them: leave --background away")
    seen = np.concatenate([touch_evaluation([one], size) for one in images])
    for target, result in zip(targets, made(seen), strict=True):
        _write(target, result)
        print(target)
    return 0


def _targets(options: Translate, suffix: str) -> list[Path]:
    """Where each result goes. Raises UserError for a file that was read, and for two results in one place."""
    out, images = options.out, options.images
    if out is not None and out.suffix and not out.is_dir():
        if len(images) > 1:
            raise UserError(f"{out} is one file for {len(images)} images; give a folder")
        if out.suffix.lower() != suffix:
            raise UserError(f"{out} must end in {suffix}")
        targets = [out]
    else:
        targets = [(out or path.parent) / f"{path.stem}_{options.to}{suffix}" for path in images]
    if len(set(targets)) < len(targets):
        raise UserError("two images have the same name: translate them into different folders")
    for path in (*images, *((options.background,) if options.background else ())):
        if path.resolve() in {target.resolve() for target in targets}:
            raise UserError(f"{path} is an image that is read; name another file")
    return targets


def _write(path: Path, result: Any) -> None:

    if result.dtype == np.uint8:
        import cv2

        atomic_write(path, cv2.imencode(".png", result[..., ::-1])[1].tobytes())
        return
    data = io.BytesIO()
    np.save(data, result, allow_pickle=False)
    atomic_write(path, data.getvalue())


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line `args`; return the exit status."""
    return run_script(Translate, run, args)


if __name__ == "__main__":
    sys.exit(main())
