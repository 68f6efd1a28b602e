"""What is an encoder worth on real recordings? Scores of encoders beside pixels and a classical baseline.

    python -m experiments.real.run anytouch-tiny untrained:anytouch-tiny "stage 1=runs/anytouch-tiny/stage1"

Each model is a name, a run folder or a weights file; `untrained:MODEL` is the same network without training. Every row
goes to `experiments/results/real.jsonl`. `make results` makes the page from that file alone.

    python -m experiments.real.run anytouch-tiny --backgrounds

scores one encoder with what may stand in for the picture of the untouched gel (`recordings.read`).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any, get_args

import numpy as np

from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from experiments.benchmarks import machine
from experiments.real import features, recordings, scores, training
from experiments.records import write_record

BASELINES = {"pixels": features.pixel_values, "HOG and local binary patterns": features.classical_values}
UNTRAINED = "untrained:"
CNN = "small CNN from scratch"


def load(name: str) -> Encoder:
    """Load an encoder by name, path or TITLE=PATH; `untrained:` gives the same network without training."""
    name = name.rpartition("=")[2]
    if name.startswith(UNTRAINED):
        return random_encoder(load_encoder(name.removeprefix(UNTRAINED)).config)
    return load_encoder(name)


def milliseconds(encoder: Encoder, data: recordings.Recordings, rounds: int = 30) -> float:
    """Return the median time of one frame, preprocessing included."""
    times = []
    for frame, place in zip(data.frames[: rounds + 5], data.background, strict=False):
        begun = time.perf_counter()
        encoder.encode_touch(encoder.preprocess(frame, data.backgrounds[place]), "gelsight_mini")
        times.append(1000 * (time.perf_counter() - begun))
    return float(np.median(times[5:]))


def record_of(x: np.ndarray, data: recordings.Recordings, about: dict[str, Any]) -> dict[str, Any]:
    """Return the scores of features (n, d) on every task, with whether each recording was right."""
    tasks = {task: task_record(row[""]) for task, row in scores.table({"": x}, data).items()}
    curve = {str(count): scores.label_curve(x, data, count) for count in (1, 2, 5)}
    return about | {"tasks": tasks, "label_curve": curve, "machine": dataclasses.asdict(machine.describe())}


def task_record(score: scores.Score) -> dict[str, Any]:
    """Return a score as it stands in a record."""
    return {
        "share": score.share, "interval": score.interval(), "option": score.option,
        "correct": score.correct.astype(int).tolist(), "groups": score.groups.tolist(),
    }  # fmt: skip


def trained_records(models: list[str], data: recordings.Recordings, common: dict[str, Any], out: Path) -> None:
    """Score a small CNN on every task, and the encoders trained with labels on the first task."""
    about = common | {"machine": dataclasses.asdict(machine.describe())}
    pictures = training.cnn_pictures(data)
    tasks = {
        f"{task}, {scores.TRAINED}": task_record(score(pictures, data, training.cnn_scores))
        for task, score in scores.TASKS.items()
    }
    write_record(out, CNN, about | {"kind": "baseline", "tasks": tasks})
    print(CNN, flush=True)
    for word in models:
        encoder, name = load(word), word.partition("=")[0]
        x = np.stack([
            encoder.preprocess(frame, data.backgrounds[place])
            for frame, place in zip(data.frames, data.background, strict=True)
        ])  # fmt: skip
        score = scores.object_score(x, data, training.fine_tuned_scores(encoder))
        about |= {"kind": "encoder", "fingerprint": encoder.fingerprint}
        write_record(out, f"{name}, fine-tuned", about | {"tasks": {f"object, {scores.TRAINED}": task_record(score)}})
        print(f"{name}, fine-tuned", flush=True)


def background_records(word: str, path: Path, out: Path) -> None:
    """Score an encoder with each kind of background: a record each in `out`."""
    encoder, name = load(word), word.partition("=")[0]
    for kind in get_args(recordings.Background):
        data = recordings.read(path, kind)
        about = {"data": data.content_hash, "encoder": name, "fingerprint": encoder.fingerprint, "kind": kind}
        values = {kind: features.encoder_features(encoder, data)}
        if kind == "median":
            values["pixels"] = features.pixel_values(data)
        for title, x in values.items():
            tasks = {task: task_record(row[""]) for task, row in scores.table({"": x}, data).items()}
            machine_used = {"machine": dataclasses.asdict(machine.describe())}
            write_record(out, title, about | {"tasks": tasks} | machine_used)
            print(title, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="*")
    parser.add_argument("--data", type=Path, default=Path("../shared/real_touch2/manifest.csv"))
    parser.add_argument("--out", type=Path, default=Path("experiments/results"), help="folder of the records")
    parser.add_argument("--backgrounds", action="store_true", help="compare backgrounds with the first model instead")
    parser.add_argument("--trained", action="store_true", help="train a CNN and the encoders with labels too: an hour")
    options = parser.parse_args()
    if options.backgrounds:
        background_records(options.models[0], options.data, options.out / "backgrounds.jsonl")
        return
    data, out = recordings.read(options.data, "rule"), options.out / "real.jsonl"
    common = {"data": data.content_hash}
    for name, compute in BASELINES.items():
        write_record(out, name, record_of(compute(data), data, common | {"kind": "baseline"}))
        print(name, flush=True)
    for word in options.models:
        encoder, name = load(word), word.partition("=")[0]
        about = {"kind": "encoder", "config": json.loads(json.dumps(dataclasses.asdict(encoder.config))),
                 "fingerprint": encoder.fingerprint, "milliseconds": milliseconds(encoder, data)}  # fmt: skip
        x = features.encoder_features(encoder, data)
        write_record(out, name, record_of(x, data, common | about))
        print(name, flush=True)
    if options.trained:
        trained_records(options.models, data, common, out)


if __name__ == "__main__":
    main()
