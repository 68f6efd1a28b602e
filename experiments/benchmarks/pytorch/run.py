"""Ours against PyTorch, in one run: the same weights, batches and masks, then steps in turns.

    make bench-torch PRESET=small BATCH=16

First each rival must give the loss of ours to 1e-5 (float32). Then all take turns, round by round:
ours in this process, PyTorch in a separate process that works only when asked. The first step of a
turn is not counted.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np

from anytouch_jax.train.step import merge
from anytouch_jax.weights import convert, load, safetensors
from experiments.benchmarks import machine, speed, variants
from experiments.benchmarks.pytorch.keys import renamed
from experiments.benchmarks.run import table_of
from experiments.benchmarks.workloads import (
    Workload,
    first_state,
    make_batch,
    normalised,
    values_of,
    workloads,
)
from experiments.records import write_record

ROOT = Path(__file__).resolve().parents[3]
WHAT = ("stage1", "stage2", "embed")
RIVALS = ("eager float32", "compiled float32", "eager bfloat16", "compiled bfloat16")
OURS = (variants.BASELINE, variants.Variant("bfloat16", variants.BFLOAT16))
_SETTLE = 0.02  # seconds for our idle threads to stop spinning before the other process works
LOSS_TOLERANCE = 1e-5
GRADIENT_TOLERANCE = 1e-4


class Worker:
    """The PyTorch process."""

    def __init__(self, python: Path) -> None:
        command = [str(python), "-m", "experiments.benchmarks.pytorch.worker"]
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )

    def ask(self, **question: Any) -> dict[str, Any]:
        self.process.stdin.write(json.dumps(question) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"the PyTorch process ended with status {self.process.wait()}")
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait(timeout=60)


def spec(work: Workload) -> dict[str, Any]:
    """What the rival has to know of a workload."""
    config = work.config
    kind = "embed" if not work.trains else work.name.split()[1] if config.stage == 2 else "stage1"
    return {
        "kind": kind,
        "stage": config.stage,
        "kept": int(config.model.patches * config.objective.keep_ratio),
        "model": dataclasses.asdict(config.model),
        "weights": config.pair_weights,
        "match_weight": config.objective.match_weight,
    }


def given(work: Workload) -> tuple[Any, np.ndarray]:
    """The batch and the masks' noise that both sides get."""
    rng = np.random.default_rng(1)
    return make_batch(work), rng.random((work.samples, work.config.model.patches)).astype(
        np.float32
    )


def batch_file(work: Workload, path: Path) -> None:
    batch, noise = given(work)
    part = batch if not hasattr(batch, "align") else batch.align or batch.match
    present = {k: v for k, v in part._asdict().items() if v is not None}
    arrays = {k: v.astype(np.int64) if v.dtype == np.int32 else v for k, v in present.items()}
    safetensors.write_safetensors(path, {**arrays, "noise": noise}, {})


def reference(work: Workload, params: Any) -> dict[str, Any]:
    """Loss, output and gradients of ours in float64, gradients by the authors' key names."""
    batch, noise = given(work)
    config = dataclasses.replace(
        work.config, model=dataclasses.replace(work.config.model, dtype="float64")
    )
    with jax.enable_x64(True):
        args = jax.tree.map(speed.widened, (params, normalised(batch), noise))
        values = jax.device_get(jax.jit(values_of(config, work.trains))(*args))
    if not work.trains:
        return {"output": values["output"]}
    gradient = values["gradient"]
    gradient["decoder"]["position"] = np.zeros_like(params["decoder"]["position"])
    return {
        "output": values["output"],
        "loss": float(values["loss"]),
        "gradient": convert.to_release(gradient, work.config.model),
    }


def rival_errors(loss: float, file: Path, exact: dict[str, Any]) -> dict[str, float]:
    """Relative errors of a rival, as `speed.errors` has them for ours."""
    found = load.read_weights(file)
    errors = {"output": speed.relative([found.pop("output")], [exact["output"]])}
    if "loss" not in exact:
        return errors
    grads = {key.removeprefix("grad/"): value for key, value in found.items()}
    wanted = {renamed(key): value for key, value in exact["gradient"].items()}
    left = {k: v for k, v in wanted.items() if k in grads}
    lost = max(
        (float(np.abs(v).max()) for k, v in wanted.items() if k not in grads and k not in UNUSED),
        default=0.0,
    )
    if lost > 0:
        raise SystemExit("the rival has no gradient for a parameter that ours has one for")
    errors["loss"] = abs(loss - exact["loss"]) / abs(exact["loss"])
    errors["gradient"] = speed.relative([grads[k] for k in left], list(left.values()))
    return errors


# Filled by the authors' layout and read by nothing (golden Q2), and the fixed table.
UNUSED = {
    prefix + key
    for prefix in ("", "touch_mae_model.")
    for key in (
        "touch_model.embeddings.patch_embedding.weight",
        "video_position_embedding.weight",
        "decoder_pos_embed",
    )
}


def compare(
    work: Workload, python: Path, rounds: int, peak_size: int | None, negatives: tuple[str, ...]
) -> dict[str, Any]:
    """Rows of ours and of PyTorch for a workload. Raises SystemExit where the losses differ."""
    state = first_state(work.config)
    params = jax.device_get(merge(state.trainable, state.frozen))
    with TemporaryDirectory() as name:
        folder = Path(name)
        worker = Worker(python)
        try:
            safetensors.write_safetensors(
                folder / "weights.safetensors", convert.to_release(params, work.config.model), {}
            )
            batch_file(work, folder / "batch.safetensors")
            files = {
                "weights": str(folder / "weights.safetensors"),
                "batch": str(folder / "batch.safetensors"),
            }
            about = worker.ask(do="setup", work=spec(work), **files)
            print(f"{work.name}: {about}", file=sys.stderr)
            exact = reference(work, params)
            errors = {}
            notes = {}
            for rival in negatives:
                start = time.perf_counter()
                try:
                    answer = worker.ask(
                        do="values", variant=rival, out=str(folder / "values.safetensors")
                    )
                except RuntimeError as error:
                    notes[rival] = str(error)
                    continue
                first = time.perf_counter() - start
                errors[rival] = rival_errors(answer["loss"], folder / "values.safetensors", exact)
                errors[rival]["first"] = first
                print(f"{work.name}: PyTorch {rival}: {errors[rival]}", file=sys.stderr)
                if "float32" in rival:
                    check(work, rival, errors[rival])
            rows = timed(work, worker, errors, rounds, peak_size, state, params)
        finally:
            worker.close()
    return {"about": about, "rows": rows, "failed": notes}


def check(work: Workload, rival: str, errors: dict[str, float]) -> None:
    """Nothing is timed that does not compute the same."""
    limits = {"output": GRADIENT_TOLERANCE, "loss": LOSS_TOLERANCE, "gradient": GRADIENT_TOLERANCE}
    for what, limit in limits.items():
        if errors.get(what, 0.0) > limit:
            raise SystemExit(
                f"{work.name}, PyTorch {rival}: {what} differs by {errors[what]:.2g}, more than "
                f"{limit:g}"
            )


def timed(
    work: Workload,
    worker: Worker,
    errors: dict[str, Any],
    rounds: int,
    peak_size: int | None,
    state: Any,
    params: Any,
) -> list[dict[str, Any]]:
    """All in turns; each row has its seconds, and its time over ours in float32."""
    programs = [
        variants.compiled(v, work, state if work.trains else {"touch": params["touch"]})
        for v in OURS
    ]
    own = (
        speed.step_calls(programs, state)
        if work.trains
        else speed.embed_calls(programs, jax.device_put(params["touch"]))
    )
    ours_wrong = speed.errors(OURS, work, params)
    inside: dict[str, list[float]] = {rival: [] for rival in errors}

    def rival_step(rival: str) -> None:
        time.sleep(_SETTLE)
        inside[rival] += worker.ask(do="run", variant=rival, count=1)["seconds"]

    run_peak, operations = machine.matmul("float32", peak_size)
    repeats = 20 if work.samples == 1 else 2
    calls = [*own, *(partial(rival_step, rival) for rival in errors), run_peak]
    times = speed.interleaved(calls, rounds, [repeats] * (len(calls) - 1) + [1])
    rate = operations / float(np.median(times[-1]))
    names = [f"ours, {v.name}" for v in OURS] + [f"PyTorch, {rival}" for rival in errors]
    wrong = [*ours_wrong, *errors.values()]
    # without the warm-up
    seconds = times[: len(own)] + [np.reshape(s[1:], (rounds, repeats)) for s in inside.values()]
    # in another's turn the memory of a step may go back to the system
    seconds = [values[:, 1:] for values in seconds]
    base = np.median(seconds[0], axis=1)
    rows = []
    for name, values, error in zip(names, seconds, wrong, strict=True):
        middle = np.median(values, axis=1)
        low, high = np.percentile(middle / base, [25, 75])
        rows.append(
            {
                "name": name,
                "seconds": float(np.median(middle)),
                "ratio": float(np.median(middle / base)),
                "ratio_iqr": float(high - low),
                "samples_per_second": work.samples / float(np.median(middle)),
                "gflops": work.operations / float(np.median(middle)) / 1e9,
                "best_ratio": float(values.min() / seconds[0].min()),
                "peak_fraction": work.operations / float(np.median(middle)) / rate,
                "p50": float(np.percentile(values, 50)),
                "p99": float(np.percentile(values, 99)),
                **error,
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="*", default=WHAT, metavar="|".join(WHAT))
    parser.add_argument(
        "--torch", type=Path, required=True, help="the Python that has torch and transformers"
    )
    parser.add_argument("--preset", default="small", choices=("tiny", "small", "base", "large"))
    parser.add_argument("--batch", type=int)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--negatives", nargs="*", default=list(RIVALS), choices=RIVALS)
    parser.add_argument(
        "--out", type=Path, default=Path("runs/bench/torch.jsonl"), help="file of results"
    )
    parser.add_argument("--peak-size", type=int, help="side of the matrices of the peak")
    options = parser.parse_args()
    if unknown := set(options.what) - {*WHAT}:
        parser.error(f"{', '.join(sorted(unknown))}: choose among {', '.join(WHAT)}")
    if shutil.which(options.torch) is None:
        parser.error(f"--torch {options.torch}: no such program; make bench-torch makes one")
    here = machine.describe()
    if here.load > 0.3 * here.cores:
        print(
            f"load {here.load:.1f}: PyTorch's threads suffer more than ours from other work; wait",
            file=sys.stderr,
        )
    about = {
        "machine": dataclasses.asdict(here),
        "preset": options.preset,
        "rounds": options.rounds,
    }
    key = f"{options.preset}, {here.vectors}"
    results = dict[str, Any]()
    for what in options.what:
        for work in workloads(what, options.preset, options.batch):
            results[work.name] = compare(
                work, options.torch, options.rounds, options.peak_size, tuple(options.negatives)
            )
            write_record(options.out, key, about | {"results": results})
            print(f"### {work.name}\n\n{table_of(results[work.name]['rows'])}\n", flush=True)
    print(f"{options.out}, {key}", file=sys.stderr)


if __name__ == "__main__":
    main()
