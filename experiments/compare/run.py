"""Encoders compared: what each family costs, and with your files what it knows.

    python -m experiments.compare.run python -m experiments.compare.run --encoders a=FILE b=FILE
    --data manifest.parquet --label material

Each figure is a line of `experiments/results/compare.jsonl`, and the page of speed has a table of
them. Figures of your own encoders go to `runs/compare/compare.jsonl`, or to the file of `--out`,
with a page next to it.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from anytouch_jax import load_encoder
from anytouch_jax.cli.app import main
from anytouch_jax.encoder.base import Encoder
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write
from experiments.benchmarks import machine
from experiments.benchmarks.workloads import products
from experiments.command import run_script
from experiments.compare.families import FORMS, OURS, untrained
from experiments.compare.table import families_table
from experiments.pages.page import markdown
from experiments.records import read_records, write_record

PROTOCOLS = ("grouped", "released")
RESULTS = Path("experiments/results/compare.jsonl")
YOURS = Path("runs/compare/compare.jsonl")


@dataclass(frozen=True)
class Options:
    """Compare encoders of several families: costs of untrained copies, and accuracy of your
    files.
    """

    encoders: tuple[str, ...] = ()  # NAME=FILE of each encoder whose accuracy is wanted.
    data: tuple[Path, ...] = ()  # Manifests for the accuracy.
    label: str = "material"  # Label column for the accuracy.
    # Measure only these families (default: all, or none with --encoders).
    only: tuple[str, ...] = ()
    repeats: int = 5  # Timed calls of each family.
    out: Path | None = None  # The file of results. Your encoders have one of their own.


def costs(encoder: Encoder, repeats: int) -> dict[str, Any]:
    """Return parameters, operations, memory and times of one touch, in float32, with its smallest
    number of frames.
    """
    frames = encoder.config.model.frames if hasattr(encoder, "form") else 1
    frame = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    gel = np.full_like(frame, 90)
    prepared = encoder.preprocess(frame, gel)
    clip = np.repeat(prepared[None, None], frames, axis=1)
    row = np.zeros(1, np.int32)
    run = encoder.traceable()
    operations = products(jax.make_jaxpr(run)(encoder.params, clip, row).jaxpr)
    program = jax.jit(run).lower(encoder.params, clip, row).compile()
    memory = program.memory_analysis()
    params = jax.device_put(encoder.params)
    jax.block_until_ready(program(params, clip, row))
    prepare = _times(lambda: encoder.preprocess(frame, gel), repeats)
    encode = _times(lambda: jax.block_until_ready(program(params, clip, row)), repeats)
    count = sum(int(np.size(leaf)) for leaf in jax.tree.leaves(encoder.params))
    return {
        "kind": "cost",
        "parameters": count,
        "frames": frames,
        "pixels": list(prepared.shape[:2]),
        "flops": operations,
        "repeats": repeats,
        "memory": int(
            memory.argument_size_in_bytes + memory.temp_size_in_bytes + memory.output_size_in_bytes
        ),
        "prepare_ms": prepare[0],
        "encode_ms": encode[0],
        "encode_cpu_ms": encode[1],
        "machine": dataclasses.asdict(machine.describe()),
    }


def _times(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Return the shortest time of a call, and the median processor time of all its threads, in
    milliseconds.
    """
    walls = []
    processor = []
    for _ in range(repeats):
        begun = time.perf_counter()
        own = time.process_time()
        call()
        walls.append(1000 * (time.perf_counter() - begun))
        processor.append(1000 * (time.process_time() - own))
    return min(walls), float(np.median(processor))


def accuracy(
    name: str, file: str, data: tuple[Path, ...], label: str, protocol: str
) -> dict[str, Any]:
    """Return the accuracy of the linear and kNN probes of an encoder on a label by one protocol."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "probe.json"
        words = [
            "probe",
            "label",
            "--model",
            file,
            "--data",
            *map(str, data),
            "--label",
            label,
            "--out",
            str(out),
        ]
        if main([*words, "--protocol", protocol, "--no-controls"]):
            raise UserError(f"the probe of {name} failed; its message stands above")
        results = json.loads(out.read_text())
    scores = {
        row["probe"].rpartition(": ")[2]: row.get("accuracy", row.get("r2")) for row in results
    }
    return {
        "kind": "accuracy",
        "encoder": name,
        "label": label,
        "protocol": protocol,
        "scores": scores,
    }


def run(options: Options) -> int:
    """Measure, probe, and write the page."""
    wanted = options.only or (() if options.encoders else (*FORMS, *OURS))
    if unknown := [name for name in wanted if name not in {*FORMS, *OURS}]:
        raise UserError(
            f"there is no family {unknown[0]!r}; choose from {', '.join((*FORMS, *OURS))}"
        )
    if options.encoders and not options.data:
        raise UserError("ENCODERS needs the manifest to probe them on; add DATA=manifest.parquet")
    out = options.out or (YOURS if options.encoders else RESULTS)
    for name in wanted:
        write_record(out, f"cost/{name}", costs(untrained(name), options.repeats))
        print(name, flush=True)
    for pair in options.encoders:
        name, equals, file = pair.partition("=")
        if not (equals and name and file):
            raise UserError(f"{pair!r} is no NAME=FILE; write --encoders mine=runs/stage2")
        encoder = load_encoder(file)
        write_record(out, f"cost/{name}", costs(encoder, options.repeats))
        for protocol in PROTOCOLS:
            score = accuracy(name, file, options.data, options.label, protocol)
            write_record(out, f"accuracy/{name}/{options.label}/{protocol}", score)
    table = markdown(families_table(read_records(out)))
    print(table)
    if out != RESULTS:
        atomic_write(out.with_suffix(".md"), f"# Your encoders\n\n{table}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_script(Options, run))
