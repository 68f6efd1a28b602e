"""Simulated scenes as teachers: retrieval and probes on objects never touched in training.

1. Retrieval: the same touch by another sensor and unit, among 50 that resemble it most in position, depth and force.
   Compared are stage 2, stage 1, untrained encoders, background-differenced pixels, and contact area, centroid, force.
2. A sensor left out: linear probes of GelSlim, whose touches get the universal tokens, for labels that captions name
   (hardness, roughness, material) and one that they do not (indenter).

`python -m experiments.tables.teaching` takes an hour or more a seed. Finished runs are not made again.
`TOUCHES=260 MORE=0 STEPS1=20 STEPS2=20 SEEDS=0 GRADES=fine` is a trial of minutes. `WORK=` and `OUT=` are folders of
runs and results. `CONVOLUTIONS=1` has encoders whose patches are read by small convolutions, and its own records.

Six touches of each object by the sensor left out: with two a probe cannot distinguish encoders. `MORE=` touches a grade
are trained on alone. The paper's data are contact frames, so only frames with six tenths of the strongest contact of
their recording are drawn. Matching departs from the paper, whose head compares a pair with *one* other on CLIP's
weights: from scratch that stays at chance. Cosines against all other touches of the batch compare 126 pairs at once
(`match_head=cosine`), all of one sensor (`negatives=same_sensor`), so that the sensor is no clue. 600 steps of stage 1
leave the plateau sooner than 150.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.cli import app
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.evaluate import retrieval
from anytouch_jax.evaluate.feature_cache import background_difference, principal_components
from anytouch_jax.evaluate.retrieval import contact_vector, deepest_rows
from anytouch_jax.sim.dataset import VERSION
from anytouch_jax.train.progress import silent
from experiments.benchmarks import machine
from experiments.records import read_records, write_record
from experiments.tables import env
from experiments.tables.by_object import by_object, probed

WORK, OUT = env.path("WORK", "runs/teaching"), env.path("OUT", "experiments/results")
TOUCHES, STEPS1, STEPS2 = env.number("TOUCHES", 1200), env.number("STEPS1", 600), env.number("STEPS2", 4000)
MORE = env.number("MORE", 2 * TOUCHES, least=0)
OBJECTS = env.number("OBJECTS", min(TOUCHES // 2, 500))
SEEDS = env.numbers("SEEDS", "0,1,2")
GRADES = env.names("GRADES", "fine,coarse", ("fine", "coarse"))
CONVOLUTIONS = env.switch("CONVOLUTIONS")
NAME = "teaching_convolutional" if CONVOLUTIONS else "teaching"
SENSORS, LEFT_OUT = ("gelsight_mini", "digit", "duragel"), "gelslim"
STACK, DEPTH = {"width": 128, "heads": 4, "mlp": 512}, {"touch": 4, "image": 2, "text.stack": 2}
KNOWN = ["gelsight_mini", "digit", "duragel", "universal"]  # the sensor table of the encoders
NAMED, UNNAMED = ("hardness", "roughness", "material"), ("indenter",)


def anytouch(*words: Any) -> None:
    """Run a subcommand; a run or a data set that is finished answers at once."""
    status = app.main([str(word) for word in words])
    if status:
        raise SystemExit(status)


SMALL = ["--preset", "tiny", "--model.image-size", 84]
SMALL += ["--model.patch-encoder", "convolutional"] if CONVOLUTIONS else []
SUBTRACT = ["--data.background", "subtract"]  # the contact alone: units differ more than touches do
SUBTRACT += ["--data.contact-only", "--data.jitter", 0, 0, 0, 0]  # colours show slopes
SUBTRACT += ["--data.cache", 5000]  # all frames, once read


def tower(name: str) -> list[Any]:
    return [word for size, n in (STACK | {"depth": DEPTH[name]}).items() for word in (f"--model.{name}.{size}", n)]


TRAIN1 = [*SMALL, *tower("touch"), "--steps", STEPS1, "--batch", 48, "--optim.learning-rate", 1e-3]
TRAIN2 = [*SMALL, *tower("touch"), *tower("image"), *tower("text.stack"), "--steps", STEPS2, "--batch", 64]
TRAIN2 += ["--optim.learning-rate", 1e-3, "--data.negatives", "same_sensor"]
TRAIN2 += ["--model.match-head", "cosine", "--objective.match-weight", 8.0]


def scenes(grade: str) -> list[Path]:
    """The manifests to train on of a grade, contact frames marked. Makes touches by the sensor left out, too."""
    turn, marked = GRADES.index(grade), []
    sets = {  # sensors, touches, number of the first
        f"scenes-{grade}": (SENSORS, TOUCHES, TOUCHES * turn),
        f"more-{grade}": (SENSORS, MORE, TOUCHES * len(GRADES) + MORE * turn),
        f"{LEFT_OUT}-{grade}": ((LEFT_OUT,), 6 * OBJECTS, 6 * OBJECTS * turn),
    }
    for name, (sensors, touches, first) in sets.items():
        folder, size = WORK / name, ["--objects", OBJECTS, "--grade", grade, "--size", 128]
        if touches:
            words = ["--sensors", *sensors, "--touches", touches, "--first", first, *size]
            anytouch("data", "simulate", "--out", folder, *words)
        if touches and sensors == SENSORS:
            marked.append(folder / "manifest_contact.parquet")
            if not marked[-1].exists():
                anytouch("data", "contact", folder / "manifest.parquet", "--share", 0.6, "--out", marked[-1])
    return marked


def prepare(seed: int) -> tuple[Path, Path]:
    """The runs of both stages for a seed."""
    name = "-".join([*GRADES, *(["convolutional"] if CONVOLUTIONS else []), str(seed)])
    one, two = (WORK / f"{name}-stage{stage}" for stage in (1, 2))
    manifests_of = [manifest for grade in GRADES for manifest in scenes(grade)]
    data = ["--data", *manifests_of, "--seed", seed, "--model.sensors", *KNOWN, *SUBTRACT]
    anytouch("train", "--stage", 1, "--run", one, *TRAIN1, *data)
    finished(one, STEPS1)
    anytouch("train", "--stage", 2, "--run", two, "--init", one, *TRAIN2, *data)
    finished(two, STEPS2)
    return one, two


def finished(run: Path, steps: int) -> None:
    """A signal ends training politely; what is half trained must not be scored."""
    if not (run / "checkpoints" / f"{steps:08d}").is_dir():
        raise SystemExit(f"{run} was stopped before its {steps} steps; the same command goes on")


def features(encoders: dict[str, Encoder], seed: int, table: Any, rows: np.ndarray, pooling: Any) -> dict[str, Any]:
    one = encoders["stage 1"]
    plain = replace(one.config, data=replace(one.config.data, background="keep"))
    fresh = {"untrained": random_encoder(one.config, seed), "untrained, whole picture": random_encoder(plain, seed)}
    every = (encoders | fresh).items()
    return {name: embed_rows(e, table, rows, pooling=pooling, log=silent)[1] for name, e in every}


def retrieve(encoders: dict[str, Encoder], grade: str, seed: int) -> dict[str, Any]:
    table = manifests.read(WORK / f"scenes-{grade}" / "manifest.parquet")
    rows = deepest_rows(table, table.rows_of("test"))
    found = features(encoders, seed, table, rows, "class")
    found |= {"pixels": background_difference(table, rows), "vector": contact_vector(table, rows)}
    scored = retrieval.cross_sensor_retrieval(table, found, rows, centre=(True,), metrics={"vector": "euclidean"})
    pooled = {one.name: one.per_query for one in scored if one.query_sensor == retrieval.ALL and one.per_query}
    groups = pooled["stage 2"].groups
    parts = {part: {name: getattr(one, part) for name, one in pooled.items()} for part in ("top1", "top5")}
    return {"data": table.content_hash} | {part: by_object(groups, right) for part, right in parts.items()}


def probes(encoders: dict[str, Encoder], grade: str, seed: int) -> dict[str, Any]:
    """Linear probes on the sensor left out, universal tokens, objects never seen in the test split."""
    table = manifests.read(WORK / f"{LEFT_OUT}-{grade}" / "manifest.parquet")
    rows = np.concatenate([deepest_rows(table, table.rows_of(split)) for split in ("train", "val", "test")])
    split, groups = table.text_column("split")[rows], table.text_column("object")[rows]
    found = features(encoders, seed, table, rows, "both")
    found["pixels"] = principal_components(background_difference(table, rows), split == "train")
    labels = {label: [table.value(int(row), f"label.{label}") for row in rows] for label in (*NAMED, *UNNAMED)}
    return {"data": table.content_hash} | probed(found, labels, groups, split)


SETTINGS = {"touches": TOUCHES, "more": MORE, "objects": OBJECTS, "steps": [STEPS1, STEPS2], "grades": GRADES}
SETTINGS |= {"simulator": VERSION}
RESULTS = OUT / f"{NAME}.jsonl"


def scored(grade: str, seed: int) -> dict[str, Any]:
    """Return the record of a grade and a seed. It is measured first if it is missing, or of other encoders."""
    key = f"{grade}-{seed}"
    found = read_records(RESULTS).get(key)
    encoders = {f"stage {stage}": load_encoder(run) for stage, run in zip((1, 2), prepare(seed), strict=True)}
    about: dict[str, Any] = {
        "settings": SETTINGS,
        "encoders": {name: one.fingerprint for name, one in encoders.items()},
    }
    if found is not None and found | about == found:
        return found
    config = encoders["stage 2"].config
    names = tuple("/".join(Path(one).parts[-2:]) for one in config.data.manifests)
    config = replace(config, data=replace(config.data, manifests=names))
    found = about | {"machine": machine.describe().sentence(), "config": asdict(config)}
    found |= {"retrieval": retrieve(encoders, grade, seed), "probes": probes(encoders, grade, seed)}
    write_record(RESULTS, key, found)
    return found


def main() -> None:
    for grade, seed in product(GRADES, SEEDS):
        scored(grade, seed)


if __name__ == "__main__":
    main()
