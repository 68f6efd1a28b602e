"""What is an encoder worth on real recordings? Scores of encoders beside pixels and a classical
baseline.

    python -m experiments.real.run anytouch-tiny untrained:anytouch-tiny "stage
    1=runs/anytouch-tiny/stage1"

Each model is a name, a run folder or a weights file; `untrained:MODEL` is the same network without
training. Every row goes to `experiments/results/real.jsonl`. `make results` makes the page from
that file alone. `--untouched median` does without the images of the untouched gel, and
`--untouched "first frame"` takes the first frame of a recording for it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, get_args

from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.evaluate.tables import plain
from experiments.benchmarks import machine
from experiments.real import features, recordings, scores, training
from experiments.records import write_record

UNTRAINED = "untrained:"
CNN = "small CNN from scratch"


def load(name: str) -> Encoder:
    """Load an encoder by name, path or TITLE=PATH; `untrained:` gives the same network without
    training.
    """
    name = name.rpartition("=")[2]
    if name.startswith(UNTRAINED):
        return random_encoder(load_encoder(name.removeprefix(UNTRAINED)).config)
    return load_encoder(name)


def task_record(score: scores.Score) -> dict[str, Any]:
    """Return a score as it stands in a record."""
    return {
        "fraction": score.fraction,
        "interval": score.interval(),
        "option": score.option,
        "correct": score.correct.astype(int).tolist(),
        "groups": score.groups.tolist(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", nargs="*")
    parser.add_argument("--data", type=Path, default=Path("../shared/real_touch2/manifest.csv"))
    parser.add_argument(
        "--out", type=Path, default=Path("experiments/results"), help="folder of the records"
    )
    parser.add_argument("--untouched", choices=get_args(recordings.Untouched), default="rule")
    parser.add_argument("--trained", action="store_true", help="train a small CNN with labels too")
    options = parser.parse_args()
    data = recordings.read(options.data, options.untouched)
    end = "" if options.untouched == "rule" else f", {options.untouched}"

    def write(name: str, found: dict[str, scores.Score], **about: Any) -> None:
        about |= {
            "data": data.data,
            "untouched": options.untouched,
            "machine": plain(machine.describe()),
        }
        tasks = {task: task_record(score) for task, score in found.items()}
        write_record(options.out / "real.jsonl", name + end, about | {"tasks": tasks})
        print(
            name + end,
            {task: round(score.fraction, 3) for task, score in found.items()},
            flush=True,
        )

    write("pixels", scores.table(features.pixel_values(data), data), kind="baseline")
    if not end:
        write(
            "HOG and local binary patterns",
            scores.table(features.classical_values(data), data),
            kind="baseline",
        )
    for word in options.models:
        encoder = load(word)
        found = scores.table(features.encoder_features(encoder, data), data)
        write(word.partition("=")[0], found, kind="encoder", fingerprint=encoder.fingerprint)
    if options.trained:
        images = training.cnn_images(data)
        found = {
            f"{task}, {scores.TRAINED}": score(images, data, training.cnn_scores)
            for task, score in scores.TASKS.items()
        }
        write(CNN, found, kind="baseline")


if __name__ == "__main__":
    main()
