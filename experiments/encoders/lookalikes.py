"""Which of 50 look-alikes is the same touch, by another sensor? Encoders and raw pixels on objects
never trained on.

    python -m experiments.encoders.lookalikes anytouch-tiny --fine data/corpus/fine --coarse
    data/corpus/coarse

Queries and galleries are the deepest frames of the test split. The other 49 resemble the touch most
in place, depth and force.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.evaluate import retrieval
from anytouch_jax.evaluate.feature_cache import background_difference
from anytouch_jax.evaluate.tables import plain
from anytouch_jax.train.progress import silent
from experiments.benchmarks import machine
from experiments.real.run import UNTRAINED, load
from experiments.records import write_record


def recall(encoders: dict[str, Encoder], path: Path) -> dict[str, Any]:
    """Return the recall@1 and its interval over objects of each encoder, and of pixels, on the test
    split.
    """
    table = manifests.read(path)
    rows = retrieval.deepest_rows(table, table.rows_of("test"))
    features = {
        name: embed_rows(one, table, rows, pooling="class", log=silent)[1]
        for name, one in encoders.items()
    }
    features["pixels"] = background_difference(table, rows)
    found = retrieval.cross_sensor_retrieval(table, features, rows, centre=(True,))
    scores = {
        one.name: {"fraction": one.top1, "interval": [one.low, one.high]}
        for one in found
        if one.query_sensor == retrieval.ALL
    }
    return {"data": table.content_hash, "touches": len(rows), "scores": scores}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", nargs="+")
    parser.add_argument(
        "--fine", type=Path, help="folder of touches, a dent at the same place for every sensor"
    )
    parser.add_argument("--coarse", type=Path, help="folder of touches by hand")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/lookalikes.jsonl"))
    options = parser.parse_args()
    encoders = {word.partition("=")[0]: load(word) for word in options.models}
    marks = {
        name: one.fingerprint for name, one in encoders.items() if not name.startswith(UNTRAINED)
    }
    for grade in ("fine", "coarse"):
        if folder := getattr(options, grade):
            about = {"encoders": marks, "machine": plain(machine.describe())}
            record = about | recall(encoders, folder / "manifest.parquet")
            write_record(options.out, grade, record)
            print(grade, record["scores"], flush=True)


if __name__ == "__main__":
    main()
