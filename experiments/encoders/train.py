"""Training of the encoders in the package: stage 1, stage 2 in two parts, then the folder with its card.

    python -m experiments.encoders.train --corpus data/corpus --real a.csv b.csv --out runs/anytouch-tiny

The same command again continues. The recipe is the paper's two losses. The pictures lie in the memory of the device
(`resident.py`). The first two parts are for a GPU, the last one fits a CPU: stills only, small batches. `--without
SENSOR` leaves a sensor out of stage 2, to test what carries over to it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pyarrow.compute as pc
import pyarrow.parquet as pq

from anytouch_jax.cli import train
from anytouch_jax.cli.app import main as anytouch
from anytouch_jax.cli.output import log
from anytouch_jax.files import atomic_path
from anytouch_jax.pretrain import pretrain
from experiments.encoders.resident import ResidentLoader

DATA = [
    "--preset", "tiny", "--data.background", "subtract", "--data.contact-only", "--data.jitter", "0", "0", "0", "0",
    "--data.affine", "8", "0.04", "0.1", "--run.figure-every", "0",
]  # fmt: skip
CONV = [*DATA, "--model.patch-encoder", "convolutional"]
SMALL = ("width=128", "depth=2", "heads=4", "mlp=512")  # the image tower: photographs are few and simple
STAGE2 = [
    "--optim.layer-decay", "0.75", "--model.match-head", "cosine", "--objective.match-weight", "8",
    "--data.negatives", "same_sensor", "--model.text.stack.depth", "2",
    *(word for part in SMALL for word in (f"--model.image.{part.partition('=')[0]}", part.partition("=")[2])),
]  # fmt: skip


def real_share(slip: int, press: int) -> list[str]:
    """Return the options that say how often an epoch draws each real recording."""
    return ["--data.weights", "incipient_slip-gelsight_mini_markers", str(slip), "gelslam-gelsight_mini", str(press)]


WIDE1 = ["--batch", "256", "--optim.learning-rate", "1.5e-3", "--objective.norm-pix-loss"]
WIDE2 = [
    *STAGE2, "--batch", "256", "--optim.learning-rate", "1e-3", "--objective.match-keep", "0.75",
    "--data.clip-share", "0.2",
]  # fmt: skip
LAST = [*STAGE2, "--optim.learning-rate", "5e-4", "--objective.match-keep", "0.5", "--data.clip-share", "0"]
# Folder, stage, steps, steps after which it stops, options, draws of real recordings. Each starts from the one before.
RECIPES = {
    "anytouch-tiny": (
        ("stage1", 1, 12666, None, [*DATA, *WIDE1], real_share(10, 20)),
        ("stage2-wide", 2, 2109, 175, [*DATA, *WIDE2], real_share(8, 20)),
        ("stage2", 2, 850, None, [*DATA, *LAST, "--batch", "64", "--optim.warmup", "30"], real_share(8, 20)),
    ),
    "anytouch-tiny-conv": (
        ("stage1", 1, 12000, None, [*CONV, *WIDE1], real_share(5, 10)),
        ("stage2-wide", 2, 12000, 3221, [*CONV, *WIDE2], real_share(5, 10)),
        ("stage2", 2, 400, None,
         [*CONV, *LAST, "--batch", "128", "--optim.warmup", "20", "--objective.alpha-tv", "0", "--objective.alpha-vl",
          "0"], real_share(30, 75)),
    ),
}  # fmt: skip


def leave_out(manifest: Path, sensor: str) -> Path:
    """Write the rows of the other sensors to a manifest next to this one, and return its path."""
    table, path = pq.read_table(manifest), manifest.with_name(f"without_{sensor}.parquet")
    with atomic_path(path) as part:
        pq.write_table(table.filter(pc.not_equal(pc.cast(table["sensor"], "string"), sensor)), part)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--encoder", choices=RECIPES, default="anytouch-tiny", help="which encoder to train")
    parser.add_argument("--corpus", type=Path, required=True)
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="manifests of real recordings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--without", help="a simulated sensor that stage 2 does not see")
    parser.add_argument("--processes", type=int, default=2, help="processes that read the pictures")
    options = parser.parse_args()
    shards = sorted(options.corpus.glob("*/manifest.parquet"))
    init: list[str] = []
    ResidentLoader.processes = options.processes
    for folder, stage, steps, stop, recipe, share in RECIPES[options.encoder]:
        if stage == 2 and options.without:
            shards = [leave_out(path.with_name("manifest.parquet"), options.without) for path in shards]
        data = [str(path) for path in (*shards, *options.real)]
        run, more = str(options.out / folder), [*recipe, *(share if options.real else []), *init]
        words = ["--stage", str(stage), "--data", *data, "--run", run, "--steps", str(steps), *more]
        request = train.parse(train.TrainOptions, "train", words)
        result = pretrain(
            request.config, run, init=request.options.init, stop_after=stop, make_loader=ResidentLoader, log=log
        )
        if result.interrupted:
            raise SystemExit(130)
        init = ["--init", run]
    notes = Path(__file__).with_name(f"{options.encoder}.md")
    anytouch(["export", "--card", str(options.out / options.encoder), "--model", run, "--notes", str(notes)])


if __name__ == "__main__":
    main()
