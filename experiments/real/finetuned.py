"""Fine-tuning on real recordings: head and encoder trained on labels, for the three questions of
`experiments.real.run`.

    python -m experiments.real.finetuned anytouch-tiny --minutes 1

The minutes are of each training. There is one for the objects, there are two for the other finger,
and five for slip. It writes a row to `experiments/results/real.jsonl`, scored as
`experiments.real.run` scores frozen features: a recording of test gets the mean of its frames'
probabilities.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

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

QUESTIONS = ("object", "object, other finger", "slip, objects left out")
PATHS = ("path", "background_path", "image_path")


class Part(NamedTuple):
    """One training: the split of each frame, "" for those that are not in it."""

    label: str
    split: np.ndarray


def parts_of(question: str, data: recordings.Recordings) -> Iterator[Part]:
    """Yield the trainings of a question, with the splits of `experiments.real.scores`."""
    if question == "object":
        yield Part("object", data.split)
    elif question == "object, other finger":
        for trained, tested in (("cam0", "cam2"), ("cam2", "cam0")):
            wanted = np.where(data.split == "test", tested, trained)
            yield Part("object", np.where(data.finger == wanted, data.split, ""))
    else:
        for fold in range(5):
            held_out = np.where(data.fold == (fold + 1) % 5, "val", "train")
            yield Part("slip", np.where(data.fold == fold, "test", held_out))


def copied(path: Path, folder: Path) -> list[dict[str, str]]:
    """Copy the frames of the gripper into a folder, because a manifest names images below its own,
    and return the rows of the manifest `path`.
    """
    with path.open(encoding="utf-8", newline="") as file:
        rows = [
            row
            for row in csv.DictReader(file)
            if row["dataset"] == recordings.SET and row["split"] != "background"
        ]
    for name in {row[column] for row in rows for column in PATHS if row[column]}:
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path.parent / name, target)
    return rows


def write_part(rows: list[dict[str, str]], part: Part, out: Path) -> None:
    """Write a manifest of the frames that a training may see."""
    with out.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, fieldnames=list(rows[0]))
        table.writeheader()
        for row, split in zip(rows, part.split, strict=True):
            if split in ("train", "val"):
                table.writerow(row | {"split": str(split)})


def part_score(
    model: str, data: recordings.Recordings, manifest: Path, part: Part, options: FinetuneOptions
) -> tuple[scores.Score, bool]:
    """Return which recordings of test are named right, and whether training beat the linear
    head.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "tuned"
        result = finetune(manifest, part.label, model=model, out=out, options=options)
        encoder = load_encoder(out)
    head = result.head
    assert isinstance(head, LinearHead)
    rows = np.flatnonzero(part.split == "test")
    values = embed_rows(
        encoder, data.manifest, rows, pooling=head.pooling, backgrounds=data.backgrounds
    )[1]
    chances = head(values)[1]
    labels = {"object": data.object, "slip": data.slip.astype(str)}[part.label]
    names = np.unique(data.recording[rows])
    means = np.stack([chances[data.recording[rows] == name].mean(0) for name in names])
    truth = np.array([labels[rows][data.recording[rows] == name][0] for name in names])
    right = head.classes[means.argmax(1)] == truth
    return scores.Score(right, names, options.minutes), result.improved


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("models", nargs="+")
    parser.add_argument("--data", type=Path, default=Path("../shared/real_touch2/manifest.csv"))
    parser.add_argument("--out", type=Path, default=Path("experiments/results"))
    parser.add_argument("--minutes", type=float, default=3.0, help="of each of eight trainings")
    parser.add_argument("--passes", type=int, help="over the touches at most")
    given = parser.parse_args()
    options = FinetuneOptions(minutes=given.minutes)
    if given.passes is not None:
        options = replace(options, recipe=replace(options.recipe, passes=given.passes))
    data = recordings.read(given.data)
    with tempfile.TemporaryDirectory() as folder:
        rows = copied(given.data, Path(folder))
        for model in given.models:
            write_scores(model, data, rows, Path(folder), options, given.out)


def write_scores(
    model: str,
    data: recordings.Recordings,
    rows: list[dict[str, str]],
    folder: Path,
    options: FinetuneOptions,
    out: Path,
) -> None:
    """Train for each question, and write one row of scores."""
    tasks = {}
    beaten = []
    for question in QUESTIONS:
        found = []
        for part in parts_of(question, data):
            manifest = folder / "seen.csv"
            write_part(rows, part, manifest)
            found.append(part_score(model, data, manifest, part, options))
        score = scores.Score(
            np.concatenate([one.correct for one, _ in found]),
            np.concatenate([one.groups for one, _ in found]),
            options.minutes,
        )
        tasks[f"{question}, {scores.TRAINED}"] = task_record(score)
        beaten += [improved for _, improved in found]
        print(model, question, round(score.fraction, 3), flush=True)
    about = {
        "data": data.data,
        "untouched": "rule",
        "machine": plain(machine.describe()),
        "kind": "encoder",
        "minutes": options.minutes,
        "beat_the_linear_head": beaten,
    }
    write_record(out / "real.jsonl", f"{model}, fine-tuned", about | {"tasks": tasks})
    print(f"training beat the linear head {sum(beaten)} times of {len(beaten)}", flush=True)


if __name__ == "__main__":
    main()
