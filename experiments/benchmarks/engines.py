"""One encoder by XLA, onnxruntime and OpenVINO: the time of one touch, and the error of its
features.

    python -m experiments.benchmarks.engines anytouch-tiny --corpus
    data/corpus/fine/manifest.parquet

Engines take turns, a touch each, so quiet the machine first. int8 is calibrated on touches of the
training split. A line an encoder and engine goes to `experiments/results/engines.jsonl`. The page
of speed shows it.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import embed_rows, run_in_batches
from anytouch_jax.encoder.encoder import Encoder, load_encoder, load_engine
from anytouch_jax.evaluate import retrieval
from anytouch_jax.export.engines import CALIBRATION
from anytouch_jax.export.export import export
from anytouch_jax.live.stream import compile_for_one
from anytouch_jax.train.progress import silent
from experiments.benchmarks import machine
from experiments.records import write_record

# name -> the engine, and the arithmetic or the file that it runs
ENGINES = {
    "XLA, float32": ("xla", "float32"),
    "XLA, bfloat16": ("xla", "bfloat16"),
    "onnxruntime, float32": ("onnxruntime", "f32.onnx"),
    "onnxruntime, int8": ("onnxruntime", "int8.onnx"),
    "OpenVINO, float32": ("openvino", "f32.onnx"),
    "OpenVINO, int8": ("openvino", "int8.onnx"),
}
SENSOR = 0
BATCH = 16


def touches_of(
    encoder: Encoder, table: Any, split: str, frames: int, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return `count` prepared touches u8 (n, frames, H, W, 3) of a split, and their sensor rows
    (n,).
    """
    rows = retrieval.deepest_rows(table, split=split, frames=frames)
    rows = rows[np.linspace(0, len(rows) - 1, count).astype(int)]
    clips: list[np.ndarray] = []
    given, _ = embed_rows(
        encoder, table, rows, frames, edit=lambda part, _: (clips.append(part), part)[1], log=silent
    )
    sensors = table.text_column("sensor")[given]
    return np.concatenate(clips), np.array(
        [encoder.sensor_row(one, silent) for one in sensors], np.int32
    )


def encoders_on(source: Encoder, table: Any, frames: int, folder: Path) -> dict[str, Encoder]:
    """Return an encoder on every engine. Its exported files go to `folder`."""
    export(source, folder / "f32.onnx", frames=frames, form="onnx")
    calibration = touches_of(source, table, "train", frames, CALIBRATION)
    export(source, folder / "int8.onnx", frames=frames, form="onnx", calibration=calibration)
    return {
        name: source.computed_in(what) if kind == "xla" else load_engine(folder / what, kind)  # type: ignore[arg-type]
        for name, (kind, what) in ENGINES.items()
    }


def errors(
    encoders: dict[str, Encoder], touches: tuple[np.ndarray, np.ndarray]
) -> dict[str, float]:
    """Return the largest difference of features from the first engine, as a fraction of its largest
    feature.
    """
    found = {
        name: run_in_batches(
            lambda part, one=one: one.encode_touch(*part), zip(*touches, strict=True)
        )
        for name, one in encoders.items()
    }
    live = next(iter(found.values()))
    return {
        name: float(np.abs(values - live).max() / np.abs(live).max())
        for name, values in found.items()
    }


def one_touch(encoder: Encoder, frames: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return what `anytouch stream` runs for a touch (1, frames, H, W, 3)."""
    run = compile_for_one(encoder, SENSOR, frames)
    return lambda touch: np.asarray(run(jax.device_put(touch)))


def timed(encoders: dict[str, Encoder], frames: int, rounds: int) -> dict[str, dict[str, Any]]:
    """Return p50 and p99 of one touch in ms, and the ratio to the first engine in the same
    round.
    """
    side = next(iter(encoders.values())).config.model.image_size
    touches = np.random.default_rng(0).integers(0, 256, (BATCH, 1, frames, side, side, 3), np.uint8)
    ready = {name: one_touch(encoder, frames) for name, encoder in encoders.items()}
    times: dict[str, list[float]] = {name: [] for name in encoders}
    for number in range(rounds + 1):
        for name, run in ready.items():
            begin = time.perf_counter()
            run(touches[number % BATCH])
            # the first one compiles
            times[name] += [time.perf_counter() - begin] if number else []
            time.sleep(0.002)  # threads of an engine wait actively for a while
    base = np.array(next(iter(times.values())))
    return {
        name: {
            "p50_ms": 1e3 * float(np.median(one)),
            "p99_ms": 1e3 * float(np.percentile(one, 99)),
            "ratio": float(np.median(np.array(one) / base)),
            "rounds": rounds,
        }
        for name, one in times.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("encoders", nargs="+", help="names, run folders or weights files")
    parser.add_argument(
        "--corpus", type=Path, required=True, help="manifest of touches by several sensors"
    )
    parser.add_argument("--frames", type=int, default=1, help="of a touch")
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("experiments/results/engines.jsonl"))
    options = parser.parse_args()
    table = manifests.read(options.corpus)
    about = dataclasses.asdict(machine.describe())
    for name in options.encoders:
        source = load_encoder(name, engine="xla").computed_in("float32")
        shown = name if options.frames == 1 else f"{name}, clips"
        with TemporaryDirectory() as folder:
            several = encoders_on(source, table, options.frames, Path(folder))
            wrong = errors(several, touches_of(source, table, "test", options.frames, CALIBRATION))
            for number, (engine, found) in enumerate(
                timed(several, options.frames, options.rounds).items()
            ):
                record = {
                    "encoder": shown,
                    "engine": engine,
                    "error": wrong[engine],
                    "data": table.content_hash,
                }
                write_record(options.out, f"{shown}/{number}", record | found | {"machine": about})
                print(shown, engine, wrong[engine], found, flush=True)


if __name__ == "__main__":
    main()
