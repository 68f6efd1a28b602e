"""Linear probes of a sensor that stage 2 left out: what carries over of the labels that captions name?

    python -m experiments.encoders.held_out --model runs/held_out/stage2 --sensor digit --data data/corpus/00*/*.parquet

The deepest frame of each recording by that sensor is embedded. Heads are fitted on train objects, and their penalty is
chosen on val objects. Objects of the test were never touched in training. The indenter is in no caption.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.evaluate import retrieval, statistics
from anytouch_jax.evaluate.feature_cache import background_difference
from anytouch_jax.train.progress import silent
from experiments.benchmarks import machine
from experiments.real.run import UNTRAINED, load
from experiments.real.scores import recording_score
from experiments.records import write_record

LABELS = ("material", "hardness", "roughness", "indenter")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", required=True, help="an encoder whose stage 2 left the sensor out")
    parser.add_argument("--sensor", default="digit")
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, default=Path("experiments/results/held_out.jsonl"))
    options = parser.parse_args()
    table = manifests.read(options.data)
    rows = retrieval.deepest_rows(table, np.arange(len(table)))
    rows = rows[table.text_column("sensor")[rows] == options.sensor]
    columns = {name: table.text_column(name)[rows] for name in ("split", "object", "sequence")}
    encoders = {"AnyTouch": load(options.model), "untrained": load(UNTRAINED + options.model)}
    features = {
        name: embed_rows(one, table, rows, pooling="class", log=silent)[1] for name, one in encoders.items()
    } | {"pixels": background_difference(table, rows)}  # fmt: skip
    record = {
        "data": table.content_hash, "sensor": options.sensor, "encoder": encoders["AnyTouch"].fingerprint,
        "machine": dataclasses.asdict(machine.describe()), "recordings": int((columns["split"] == "test").sum()),
        "labels": {},
    }  # fmt: skip
    for label in LABELS:
        names, y = np.unique(table.text_column(f"label.{label}")[rows], return_inverse=True)
        scores = {
            name: recording_score(x, y, columns["sequence"], columns["split"], len(names))
            for name, x in features.items()
        }  # fmt: skip
        ours = scores["AnyTouch"]
        place = dict(zip(columns["sequence"], columns["object"], strict=True))
        objects = np.array([place[name] for name in ours.groups])
        record["labels"][label] = values = {}
        for name, score in scores.items():
            change = ours.correct.astype(float) - score.correct
            values[name] = {
                "share": score.share, "interval": statistics.mean_interval(score.correct, objects),
                "minus": float(change.mean()), "minus_interval": statistics.mean_interval(change, objects),
            }  # fmt: skip
        print(label, {name: one["share"] for name, one in values.items()}, flush=True)
    write_record(options.out, options.sensor, record)


if __name__ == "__main__":
    main()
