"""Training of the encoder in the package: stage 1, stage 2 in two parts, then the folder with its card.

    python -m experiments.encoders.train --corpus data/corpus --real a.csv b.csv --out runs/anytouch-tiny

The same command again continues. The recipe is the paper's two losses, with what a CPU needs: see README.md. The second
part of stage 2 has stills only, and draws the pairs of two real fingers more often.
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


def real_share(slip: int, press: int) -> list[str]:
    """Return the options that say how often an epoch draws each real recording."""
    return ["--data.weights", "incipient_slip-gelsight_mini_markers", str(slip), "gelslam-gelsight_mini", str(press)]


# Folder, stage, steps, options, and draws of real recordings. Each starts from the one before.
PARTS = (
    ("stage1", 1, 1651, STAGE1, real_share(5, 10)),
    ("stage2-clips", 2, 2000, STAGE2, real_share(5, 10)),
    ("stage2", 2, 1070, [*STAGE2, "--data.clip-share", "0"], real_share(10, 20)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--corpus", type=Path, required=True)
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="manifests of real recordings")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    data = [str(path) for path in (*sorted(options.corpus.glob("*/manifest.parquet")), *options.real)]
    init: list[str] = []
    for folder, stage, steps, recipe, share in PARTS:
        run, more = str(options.out / folder), [*recipe, *(share if options.real else []), *init]
        status = anytouch(["train", "--stage", str(stage), "--data", *data, "--run", run, "--steps", str(steps), *more])
        if status:
            raise SystemExit(status)
        init = ["--init", run]
    anytouch(["export", "--card", str(options.out / "anytouch-tiny"), "--model", run, "--notes", str(NOTES)])


if __name__ == "__main__":
    main()
