"""Training of the encoder in the package: both stages, then the folder with its card.

    python -m experiments.encoders.train --corpus data/corpus --real a.csv b.csv --out runs/anytouch-tiny

The same command again continues. The recipe is the paper's two losses. The pictures lie in the memory of the device
(`resident.py`), which should be a GPU. `--without SENSOR` leaves a sensor out of stage 2, to test what carries over.
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

NOTES = Path(__file__).with_name("anytouch-tiny.md")
DATA = [
    "--preset", "tiny", "--model.patch-encoder", "convolutional", "--batch", "256", "--data.background", "subtract",
    "--data.contact-only", "--data.jitter", "0", "0", "0", "0", "--data.affine", "8", "0.04", "0.1",
    "--run.figure-every", "0",
]  # fmt: skip
SMALL = ("width=128", "depth=2", "heads=4", "mlp=512")  # the image tower: photographs are few and simple
STAGE2 = [
    *DATA, "--data.clip-share", "0.2", "--optim.layer-decay", "0.75", "--model.match-head", "cosine",
    "--objective.match-weight", "8", "--objective.match-keep", "0.75",
    "--data.negatives", "same_sensor", "--model.text.stack.depth", "2",
    *(word for part in SMALL for word in (f"--model.image.{part.partition('=')[0]}", part.partition("=")[2])),
]  # fmt: skip


# How often an epoch draws each real recording.
REAL_SHARE = ["--data.weights", "incipient_slip-gelsight_mini_markers", "5", "gelslam-gelsight_mini", "10"]
# Folder, stage, steps, options. Each part starts from the one before.
PARTS = (
    ("stage1", 1, 12000, [*DATA, "--optim.learning-rate", "1.5e-3", "--objective.norm-pix-loss"]),
    ("stage2", 2, 12000, [*STAGE2, "--optim.learning-rate", "1e-3"]),
)


def leave_out(manifest: Path, sensor: str) -> Path:
    """Write the rows of the other sensors to a manifest beside this one, and return its path."""
    table, path = pq.read_table(manifest), manifest.with_name(f"without_{sensor}.parquet")
    with atomic_path(path) as part:
        pq.write_table(table.filter(pc.not_equal(pc.cast(table["sensor"], "string"), sensor)), part)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--corpus", type=Path, required=True)
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="manifests of real recordings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--without", help="a sensor that stage 2 does not see")
    parser.add_argument("--processes", type=int, default=2, help="processes that read the pictures")
    options = parser.parse_args()
    shards, init = sorted(options.corpus.glob("*/manifest.parquet")), list[str]()
    ResidentLoader.processes = options.processes
    for folder, stage, steps, recipe in PARTS:
        if stage == 2 and options.without:
            shards = [leave_out(path, options.without) for path in shards]
        data, run = [str(path) for path in (*shards, *options.real)], str(options.out / folder)
        words = ["--stage", str(stage), "--data", *data, "--run", run, "--steps", str(steps), *recipe, *init]
        request = train.parse(train.TrainOptions, "train", words + (REAL_SHARE if options.real else []))
        result = pretrain(request.config, run, init=request.options.init, make_loader=ResidentLoader, log=log)
        if result.interrupted:
            raise SystemExit(130)
        init = ["--init", run]
    anytouch(["export", "--card", str(options.out / "anytouch-tiny"), "--model", run, "--notes", str(NOTES)])


if __name__ == "__main__":
    main()
