"""Fine-tuning on the objects of the recordings: head and encoder trained on the labels of train.

    python -m experiments.real.finetuned anytouch-tiny --minutes 10

It writes a row to `experiments/results/real.jsonl`, scored as `experiments.real.run` scores frozen
features: a recording of test gets the mean of its frames' probabilities.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.encoder.linear_head import LinearHead
from anytouch_jax.evaluate.tables import plain
from anytouch_jax.finetuning import FinetuneOptions, finetune
from experiments.benchmarks import machine
from experiments.real import recordings, scores
from experiments.real.run import task_record
from experiments.records import write_record

TASK = f"object, {scores.TRAINED}"


def object_score(
    model: str, data: recordings.Recordings, path: Path, options: FinetuneOptions
) -> tuple[scores.Score, str]:
    """Return the recordings of test that are named right, and what fine-tuning says of itself."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "tuned"
        result = finetune(path, "object", model=model, out=out, options=options)
        encoder = load_encoder(out)
    head = result.head
    assert isinstance(head, LinearHead)
    rows = np.flatnonzero(data.split == "test")
    values = embed_rows(
        encoder, data.manifest, rows, pooling=head.pooling, backgrounds=data.backgrounds
    )[1]
    chances = head(values)[1]
    names = np.unique(data.recording[rows])
    means = np.stack([chances[data.recording[rows] == name].mean(0) for name in names])
    truth = np.array([data.object[rows][data.recording[rows] == name][0] for name in names])
    right = head.classes[means.argmax(1)] == truth
    return scores.Score(right, names, options.minutes), result.sentence


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", nargs="+")
    parser.add_argument("--data", type=Path, default=Path("../shared/real_touch2/manifest.csv"))
    parser.add_argument("--out", type=Path, default=Path("experiments/results"))
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--passes", type=int, help="over the touches at most")
    given = parser.parse_args()
    options = FinetuneOptions(minutes=given.minutes)
    if given.passes is not None:
        options = replace(options, recipe=replace(options.recipe, passes=given.passes))
    data = recordings.read(given.data)
    for model in given.models:
        score, sentence = object_score(model, data, given.data, options)
        about = {
            "data": data.data,
            "untouched": "rule",
            "machine": plain(machine.describe()),
            "kind": "encoder",
            "minutes": given.minutes,
            "sentence": sentence,
        }
        name = f"{model}, fine-tuned"
        write_record(given.out / "real.jsonl", name, about | {"tasks": {TASK: task_record(score)}})
        print(name, round(score.share, 3), sentence, flush=True)


if __name__ == "__main__":
    main()
