"""Training of the encoder in the package: both stages, then the folder with its card.

    python -m experiments.encoders.train --corpus data/corpus --real a.csv b.csv --out runs/anytouch-tiny

The same command again continues. The recipe is the paper's two losses, with what a CPU needs: see README.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from anytouch_jax.cli.app import main as anytouch

NOTES = Path(__file__).with_name("anytouch-tiny.md")
DATA = [
    "--preset", "tiny", "--batch", "64", "--data.background", "subtract", "--data.contact-only",
    "--data.jitter", "0", "0", "0", "0", "--data.cache", "5000",
]  # fmt: skip
STAGE1 = [*DATA, "--optim.learning-rate", "1e-3", "--objective.norm-pix-loss"]
SMALL = ("width=128", "depth=2", "heads=4", "mlp=512")  # the image tower: photographs are few and simple
STAGE2 = [
    *DATA, "--optim.learning-rate", "7e-4", "--optim.layer-decay", "0.75", "--model.dtype", "bfloat16",
    "--model.match-head", "cosine", "--objective.match-weight", "8", "--objective.match-keep", "0.5",
    "--data.negatives", "same_sensor", "--model.text.stack.depth", "2",
    *(word for part in SMALL for word in (f"--model.image.{part.partition('=')[0]}", part.partition("=")[2])),
]  # fmt: skip
REAL_SHARE = ["--data.weights", "incipient_slip-gelsight_mini_markers", "5", "gelslam-gelsight_mini", "10"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--corpus", type=Path, required=True)
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="manifests of real recordings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, nargs=2, default=(3200, 2000), help="steps of stage 1 and of stage 2")
    options = parser.parse_args()
    data = [str(path) for path in (*sorted(options.corpus.glob("*/manifest.parquet")), *options.real)]
    weights = REAL_SHARE if options.real else []
    stages = [str(options.out / f"stage{number}") for number in (1, 2)]
    for number, run, recipe in zip((1, 2), stages, (STAGE1, STAGE2), strict=True):
        init = ["--init", stages[0]] if number == 2 else []
        steps = str(options.steps[number - 1])
        status = anytouch(
            ["train", "--stage", str(number), "--data", *data, "--run", run, *init, "--steps", steps, *recipe, *weights]
        )
        if status:
            raise SystemExit(status)
    anytouch(["export", "--card", str(options.out / "anytouch-tiny"), "--model", stages[1], "--notes", str(NOTES)])


if __name__ == "__main__":
    main()
