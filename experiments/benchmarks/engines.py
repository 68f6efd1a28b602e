"""One encoder by XLA, onnxruntime and OpenVINO: time, start, memory, error, probe accuracy and recall.

    python -m experiments.benchmarks.engines quality --corpus data/corpus/00000/manifest.parquet
    python -m experiments.benchmarks.engines time --corpus data/corpus/00000/manifest.parquet

`quality` takes minutes, also while other work runs. `time` wants a quiet machine: engines take turns, a touch each.
A line an encoder and engine goes to `experiments/results/engines.jsonl`. `make results` makes the page from that file.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np

from anytouch_jax.config import Stack, preset
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import embed_rows, run_in_batches
from anytouch_jax.encoder.encoder import Encoder, load_encoder, load_engine, random_encoder
from anytouch_jax.encoder.engines import CALIBRATION
from anytouch_jax.encoder.export import export
from anytouch_jax.encoder.stream import compile_for_one
from anytouch_jax.evaluate import retrieval
from anytouch_jax.evaluate.probing import probe_features
from anytouch_jax.train.progress import silent
from experiments.benchmarks import machine
from experiments.records import read_records, write_record

OUT = Path("experiments/results/engines.jsonl")
# name -> the engine, and the arithmetic or the file that it runs
ENGINES = {
    "XLA, float32": ("xla", "float32"),
    "XLA, bfloat16": ("xla", "bfloat16"),
    "onnxruntime, float32": ("onnxruntime", "f32.onnx"),
    "onnxruntime, int8": ("onnxruntime", "int8.onnx"),
    "OpenVINO, float32": ("openvino", "f32.onnx"),
    "OpenVINO, int8": ("openvino", "int8.onnx"),
}
UNTRAINED = {"small": preset("small"), "demo": preset("tiny")}  # presets; the demo's network is smaller still
UNTRAINED["demo"] = replace(
    UNTRAINED["demo"], model=replace(UNTRAINED["demo"].model, image_size=84, touch=Stack(128, 2, 4, 512))
)
FRAMES = {"anytouch-tiny, clips": 3}  # of a touch, else 1
ENCODERS = ("anytouch-tiny", *FRAMES, *UNTRAINED)
SENSOR, BATCH = 0, 16
PROBED, TRAIN_ROWS = "label.indenter", 1000


def source_of(name: str) -> Encoder:
    """Return the live encoder in float32."""
    encoder = random_encoder(UNTRAINED[name]) if name in UNTRAINED else load_encoder(name.partition(",")[0])
    return encoder.computed_in("float32")


def encoder_on(encoder: str, engine: str, folder: Path) -> Encoder:
    """Return an encoder on an engine, from the files that `export` wrote to `folder`."""
    kind, what = ENGINES[engine]
    return source_of(encoder).computed_in(what) if kind == "xla" else load_engine(folder / what, kind)  # type: ignore[arg-type]


def touches_of(encoder: Encoder, table: Any, rows: np.ndarray, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Return prepared touches u8 (n, frames, H, W, 3) and sensor rows (n,) of manifest rows."""
    clips: list[np.ndarray] = []
    given, _ = embed_rows(encoder, table, rows, frames, edit=lambda part, _: (clips.append(part), part)[1], log=silent)
    sensors = table.text_column("sensor")[given]
    return np.concatenate(clips), np.array([encoder.sensor_row(one, silent) for one in sensors], np.int32)


def ends_of(table: Any, rows: np.ndarray, frames: int) -> np.ndarray:
    """Return the rows that end a clip of `frames` frames."""
    return rows if frames == 1 else rows[np.isin(rows, table.clips(frames)[:, -1])]


def write_files(encoder: Encoder, table: Any, folder: Path, frames: int) -> None:
    """Export to `folder` in float32 and in int8, calibrated on 200 rows of the training split."""
    rows = ends_of(table, table.rows_of("train"), frames)
    calibration = touches_of(encoder, table, rows[np.linspace(0, len(rows) - 1, CALIBRATION).astype(int)], frames)
    export(encoder, folder / "f32.onnx", frames=frames, form="onnx")
    export(encoder, folder / "int8.onnx", frames=frames, form="onnx", calibration=calibration)


def store(encoder: str, engine: str, found: dict[str, Any], about: dict[str, Any]) -> None:
    """Add to a record, and print."""
    key = f"{encoder}/{list(ENGINES).index(engine)}"
    names = {"encoder": encoder, "engine": engine}
    write_record(OUT, key, read_records(OUT).get(key, {}) | names | found | {"machine": about})
    print(encoder, engine, found, flush=True)


# Quality ------------------------------------------------------------------------------------------------------------


def quality(name: str, table: Any, folder: Path) -> dict[str, dict[str, Any]]:
    """Return the largest error of the features of each engine; of a trained encoder also accuracy and recall@1."""
    source, frames = source_of(name), FRAMES.get(name, 1)
    test = ends_of(table, retrieval.deepest_rows(table, table.rows_of("test")), frames)
    test = test[:64] if name in UNTRAINED else test
    train = ends_of(table, retrieval.deepest_rows(table, table.rows_of("train"), split="train"), frames)
    train = train[np.linspace(0, len(train) - 1, min(TRAIN_ROWS, len(train))).astype(int)]
    rows = test if name in UNTRAINED else np.concatenate([test, train])
    touches, sensors = touches_of(source, table, rows, frames)
    found: dict[str, dict[str, Any]] = {}
    live = None
    for engine in ENGINES:
        encoder = encoder_on(name, engine, folder)
        values = run_in_batches(lambda part: encoder.encode_touch(*part), zip(touches, sensors, strict=True))  # noqa: B023
        live = values if live is None else live
        found[engine] = {"error": float(np.abs(values - live).max() / np.abs(live).max()), "touches": len(rows)}
        if name in UNTRAINED:
            continue
        (recall,) = (
            one
            for one in retrieval.cross_sensor_retrieval(table, {engine: values[: len(test)]}, test, centre=(True,))
            if one.query_sensor == retrieval.ALL
        )
        labels, groups = (table.text_column(column)[rows] for column in (PROBED, "object"))
        split = np.array(["test"] * len(test) + ["train"] * len(train))
        probe = probe_features(values, labels, groups, split, seeds=0)
        found[engine] |= {"recall": recall.top1, "accuracy": probe.accuracy}
        print(engine, found[engine], flush=True)
    return found


# Time ---------------------------------------------------------------------------------------------------------------


def one_touch(encoder: Encoder, frames: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return what `anytouch stream` runs for a touch (1, frames, H, W, 3)."""
    run = compile_for_one(encoder, SENSOR, frames)
    return lambda touch: np.asarray(run(jax.device_put(touch)))


def timed(name: str, folder: Path, rounds: int) -> dict[str, dict[str, Any]]:
    """Return p50 and p99 of one touch in ms and touches/s in batches. Engines take turns."""
    rng, ready = np.random.default_rng(0), {}
    side, frames = source_of(name).config.model.image_size, FRAMES.get(name, 1)
    for engine in ENGINES:
        encoder = encoder_on(name, engine, folder)
        ready[engine] = (one_touch(encoder, frames), encoder.encode_touch)
    several = rng.integers(0, 256, (BATCH, frames, side, side, 3), np.uint8)
    rows = np.full(BATCH, SENSOR, np.int32)
    ones: dict[str, list[float]] = {engine: [] for engine in ENGINES}
    many: dict[str, list[float]] = {engine: [] for engine in ENGINES}
    for number in range(rounds):
        for engine, (one, batch) in ready.items():
            jobs = [(ones, partial(one, several[number % BATCH][None]))]
            jobs += [(many, partial(batch, several, rows))] * (number % (rounds // 5) == 0)
            for times, job in jobs:
                job() if times is many and not number else None  # compiles
                begin = time.perf_counter()
                job()
                times[engine].append(time.perf_counter() - begin)
            time.sleep(0.002)  # threads of an engine wait actively for a while
    base = np.array(ones["XLA, float32"])
    return {
        engine: {
            "p50_ms": 1e3 * float(np.median(times)), "p99_ms": 1e3 * float(np.percentile(times, 99)),
            "ratio": float(np.median(np.array(times) / base)), "rounds": rounds,
            "per_s": BATCH / float(np.median(many[engine])),
        }
        for engine, times in ones.items()
    }  # fmt: skip


def started(name: str, engine: str, folder: Path) -> dict[str, float]:
    """Return seconds from the imported package to the first features, and MiB that the process grew by, twenty on."""

    def resident() -> float:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20

    jax.device_put(np.zeros(1)).block_until_ready()
    before, begin = resident(), time.perf_counter()
    encoder = encoder_on(name, engine, folder)
    frames = FRAMES.get(name, 1)
    touch = np.repeat(encoder.blank[None, None], frames, 1)
    run = one_touch(encoder, frames)
    run(touch)
    seconds = time.perf_counter() - begin
    for _ in range(20):
        run(touch)
    return {"start_s": seconds, "memory_mib": resident() - before}


def kinds_of(path: Path, engine: str) -> dict[str, int]:
    """Return how often each kind of operation is in the program that an engine makes of an ONNX model."""
    if engine == "onnxruntime":
        import onnx
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.optimized_model_filepath = str(path.with_suffix(".optimised"))
        options.log_severity_level = 3
        onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        kinds = [node.op_type for node in onnx.load(options.optimized_model_filepath).graph.node]
    else:
        sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
        import openvino

        model = openvino.Core().compile_model(str(path), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
        nodes = [node.get_rt_info() for node in model.get_runtime_model().get_ops()]
        kinds = [f"{one['layerType'].value} {one['runtimePrecision'].value}" for one in nodes]
        kinds = [kind for kind in kinds if not kind.startswith(("Const", "Input", "Output"))]
    return dict(Counter(kinds).most_common())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("quality", "time", "start"))
    parser.add_argument("--corpus", type=Path, help="manifest of touches by several sensors, with labels")
    parser.add_argument("--encoders", nargs="+", default=list(ENCODERS), choices=ENCODERS)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--folder", type=Path, help="exported files, made where they are missing")
    parser.add_argument("--engine", choices=ENGINES, help="of start: what a fresh process starts")
    options = parser.parse_args()
    about = dataclasses.asdict(machine.describe())
    with TemporaryDirectory() as made:
        for name in options.encoders:
            folder = (options.folder or Path(made)) / name
            if options.what == "start":
                print(json.dumps(started(name, options.engine, folder)))
                continue
            table = manifests.read(options.corpus)
            if not (folder / "int8.onnx").exists():
                write_files(source_of(name), table, folder, FRAMES.get(name, 1))
            if options.what == "quality":
                found = quality(name, table, folder)
                for engine, (kind, what) in ENGINES.items():
                    kinds = {} if kind == "xla" else {"kinds": kinds_of(folder / what, kind)}
                    store(name, engine, found[engine] | kinds | {"data": table.content_hash}, about)
                continue
            found = timed(name, folder, options.rounds)
            for engine in ENGINES:
                command = [sys.executable, "-m", "experiments.benchmarks.engines", "start", "--encoders", name]
                command += ["--folder", str(folder.parent), "--engine", engine]
                fresh = subprocess.run(command, check=True, capture_output=True, text=True).stdout
                store(name, engine, found[engine] | json.loads(fresh.splitlines()[-1]), about)


if __name__ == "__main__":
    main()
