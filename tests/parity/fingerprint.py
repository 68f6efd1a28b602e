"""A fingerprint of what the library computes: are two versions of it equal bit by bit?

    python -m tests.parity.fingerprint --out old.json          # writes old.json and old.npz
    python -m tests.parity.fingerprint --compare old.json new.json

Each part is a dict of arrays by name. A line is printed for each: the start of the SHA-256 of its
arrays, and the sum of their numbers. The last line has the hash of all parts. With --compare,
parts that differ are listed with their largest absolute difference, and the exit status is 1.

Only public names of the package and its command line are used, so that the same file runs on
versions whose modules have other names. Both versions must run on the same machine, with the same
number of cores and the same libraries: how many threads share a sum decides its last bits.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import chdir
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

# What decides the last bits of a sum is pinned before numpy and jax are imported. Commands that
# are started below inherit it. XLA has no such setting: its threads are those of the cores.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.pop("JAX_ENABLE_X64", None)
os.environ.pop("XLA_FLAGS", None)

import cv2
import jax
import numpy as np
import pyarrow.parquet

import anytouch_jax as at

Arrays = dict[str, np.ndarray]

SEED = 7
SIDE = 56  # pixels of an image in training
SENSORS = ("gelsight_mini", "digit")
LIBRARIES = ("jax", "jaxlib", "numpy", "onnxruntime", "scikit-learn")
TIMING = ("samples_per_second", "wait", "wait_fraction")  # metrics that differ between equal runs


# Parts. Each runs in an empty folder, whose contents later parts read, and yields arrays by name.


def features_of(engine: str) -> Arrays:
    """Return features of the example touches as stills and as clips, with both poolings."""
    encoder = at.load_encoder("anytouch-tiny", engine=engine)
    touches = at.example_touches()
    sensors = [touch.sensor for touch in touches]
    stills = []
    clips = []
    for touch in touches:
        frames = [encoder.preprocess(frame, touch.background) for frame in press_of(touch)]
        stills.append(frames[-1])
        clips.append(np.stack(frames))
    arrays = {"prepared": np.stack(clips)}
    for pooling in ("class", "mean"):
        still = encoder.encode_touch(np.stack(stills), sensor=sensors, pooling=pooling)
        clip = encoder.encode_touch(np.stack(clips), sensor=sensors, pooling=pooling)
        arrays[f"still_{pooling}"] = still
        arrays[f"clip_{pooling}"] = clip
    # A sensor that training never saw has the universal tokens.
    arrays["still_universal"] = encoder.encode_touch(np.stack(stills))
    return arrays


def press_of(touch: Any) -> list[np.ndarray]:
    """Return three frames that go from the untouched gel to the touch."""
    gel = touch.background.astype(np.float64)
    change = touch.frame.astype(np.float64) - gel
    return [np.uint8(np.round(gel + fraction * change)) for fraction in (0.0, 0.5, 1.0)]


def features_by_xla() -> Arrays:
    """Return the features that XLA computes."""
    return features_of("xla")


def features_by_default() -> Arrays:
    """Return the features of the default engine: onnxruntime, if it is installed."""
    return features_of("auto")


def texts() -> Arrays:
    """Return embeddings of two sentences by the text tower of the packaged encoder."""
    encoder = at.load_encoder("anytouch-tiny")
    sentences = ["a smooth steel ball", "rough cork with deep grooves"]
    return {"text": encoder.encode_text(sentences)}


def fields() -> Arrays:
    """Return every array of the measured fields of the example touches, still and moving."""
    arrays: Arrays = {}
    said: list[str] = []  # what it warns of is an output too
    for engine in ("xla", "auto"):
        encoder = at.load_encoder("anytouch-tiny", engine=engine)
        for touch in at.example_touches():
            name = f"{engine}/{touch.press}-{touch.sensor}"
            about = (touch.background, touch.sensor)
            still = encoder.measure(touch.frame, *about, log=said.append)
            clip = np.stack(press_of(touch))[None]
            moving = encoder.measure(clip, *about, log=said.append)
            arrays |= arrays_of_record(still, f"{name}/still")
            arrays |= arrays_of_record(moving, f"{name}/clip")
    arrays["said"] = np.array(said)
    return arrays


def arrays_of_record(record: Any, prefix: str) -> Arrays:
    """Return the fields of a dataclass as arrays; what is not an array as its text."""
    arrays = {}
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        is_array = hasattr(value, "dtype")
        arrays[f"{prefix}/{field.name}"] = np.asarray(value if is_array else repr(value))
    return arrays


def simulated_manifest() -> Arrays:
    """Write a small data set by `data simulate`; return its table, images and file hashes."""
    command(
        *("data", "simulate", "--out", "scenes", "--touches", 24, "--objects", 16, "--size", 64),
        *("--frames", 4, "--sensors", *SENSORS, "--seed", SEED, "--vision", 0.9, "--text", 0.9),
    )
    table = pyarrow.parquet.read_table("scenes/manifest.parquet")
    arrays: Arrays = {}
    for column in table.column_names:
        arrays[f"column/{column}"] = column_array(table.column(column).to_pylist())
    files = sorted(path for path in Path("scenes").rglob("*") if path.suffix in (".jpg", ".png"))
    hashes = [f"{path} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path in files]
    arrays["files"] = np.array(hashes)
    for path in files:
        if path.name in ("002.jpg", "photo.jpg"):  # a few, to see how far images differ
            arrays[f"picture/{path}"] = cv2.imread(str(path))
    return arrays


def column_array(values: list[Any]) -> np.ndarray:
    """Return a column as floats, or as texts if it has anything else."""
    is_number = all(isinstance(value, float) for value in values)
    return np.array(values if is_number else [repr(value) for value in values])


def stage1() -> Arrays:
    """Return metrics and final parameters of 20 steps of stage 1 on the simulated data set."""
    config = small(at.preset("tiny", stage=1), steps=20)
    return trained(config, "stage1")


def stage2() -> Arrays:
    """Return metrics and final parameters of 20 steps of stage 2, which starts from stage 1."""
    config = small(at.preset("tiny", stage=2), steps=20)
    return trained(config, "stage2", init="stage1")


def small(config: at.Config, steps: int) -> at.Config:
    """Return a configuration whose network compiles and trains in seconds."""
    model = config.model
    stack = dataclasses.replace(model.touch, width=48, depth=2, heads=4, mlp=96)
    decoder = dataclasses.replace(model.decoder, width=32, depth=1, heads=2, mlp=64)
    model = dataclasses.replace(model, image_size=SIDE, embed=32, touch=stack, decoder=decoder)
    if model.image is not None:
        model = dataclasses.replace(model, image=stack)
    if model.text is not None:
        model = dataclasses.replace(model, text=dataclasses.replace(model.text, stack=stack))
    settings = {
        "data.manifests": ("scenes/manifest.parquet",),
        "data.batch_size": 16,
        "data.background": "either",
        "run.seed": SEED,
        "run.steps": steps,
        "run.save_every": 0,
        "run.figure_every": 0,
    }
    return dataclasses.replace(config, model=model).with_settings(settings)


def trained(config: at.Config, run: str, **options: Any) -> Arrays:
    """Return the metrics of every step of a run in this process, and its parameters at the end."""
    result = at.pretrain(config, run, log=lambda sentence: None, **options)
    arrays = metrics_of(run)
    leaves, _ = jax.tree_util.tree_flatten_with_path(result.params)
    for path, leaf in leaves:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        arrays[f"params/{name}"] = np.asarray(leaf)
    return arrays


def metrics_of(run: str) -> Arrays:
    """Return the metrics of a run by name, a value for each step, without measured times."""
    lines = Path(run, "metrics.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    names = sorted({name for row in rows for name in row if name not in TIMING})
    arrays = {}
    for name in names:
        values = [np.nan if row.get(name) is None else row[name] for row in rows]
        arrays[f"metrics/{name}"] = np.array(values, np.float64)
    return arrays


def endless1() -> Arrays:
    """Return metrics of 5 steps of stage 1 on touches that are simulated while it trains."""
    return endless(1, "--model.fields", 8, "--data.clip-fraction", 0)


def endless2() -> Arrays:
    """Return metrics of 5 steps of stage 2 on touches that are simulated while it trains."""
    return endless(2, "--data.clip-fraction", 0, "--model.match-head", "cosine")


def endless(stage: int, *words: Any) -> Arrays:
    """Return metrics of `train --data simulated`, which is run as a command."""
    run = f"endless{stage}"
    # The program simulates and trains: optimised, it compiles for minutes.
    quick = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    sizes = ["--model.image-size", 28, "--model.embed", 16]
    parts = ["touch", "decoder"] if stage == 1 else ["touch", "decoder", "image", "text.stack"]
    for part in parts:
        for name, value in {"width": 32, "depth": 1, "heads": 2, "mlp": 64}.items():
            sizes += [f"--model.{part}.{name}", value]
    command(
        *("train", "--data", "simulated", "--stage", stage, "--run", run, "--seed", SEED),
        *("--steps", 5, "--batch", 8, "--run.figure-every", 0, "--data.background", "either"),
        *("--simulated.objects", 13, "--simulated.places", 2, "--simulated.sensors", *SENSORS),
        *(*sizes, *words),
        **quick,
    )
    return metrics_of(run)


def simulated_touch() -> Arrays:
    """Return image, gel, fields and force of two presses of a wavy ball, by two sensors."""
    line = (np.arange(200) - 99.5) / 10  # mm
    away = np.hypot(line[None], line[:, None])
    ball = np.sqrt(np.maximum(36.0 - away**2, 0.0)) - 6.0
    relief = np.float32(ball + 0.1 * np.sin(4 * line))
    poses = np.float32([[0.0, 0.0, 0.0, 0.6], [1.0, -0.5, 0.7, 0.9]])
    drag = np.float32([0.2, -0.1, 0.05])
    arrays = {}
    for sensor in SENSORS:
        simulate = jax.jit(partial(at.simulate_touch, sensor=sensor, size=64))
        touch = simulate(relief, poses, drag=drag)
        for name, value in touch._asdict().items():
            arrays[f"{sensor}/{name}"] = np.asarray(value)
    return arrays


def embedded() -> Arrays:
    """Return all that `embed` writes of a folder whose untouched gel it has to estimate."""
    write_frames(Path("frames"))
    arrays: Arrays = {}
    for engine in ("xla", "auto"):
        out = f"{engine}.npz"
        sensor = ("--sensor", "digit")
        command("embed", "--data", "frames", *sensor, "--out", out, "--engine", engine)
        with np.load(out) as file:
            arrays |= {f"{engine}/{name}": file[name] for name in file.files}
    return arrays


def write_frames(folder: Path) -> None:
    """Write twelve frames of a DIGIT: an example touch that moves over the gel and fades."""
    folder.mkdir()
    touch = next(touch for touch in at.example_touches() if touch.sensor == "digit")
    gel = touch.background.astype(np.float64)
    change = touch.frame.astype(np.float64) - gel
    for number in range(12):
        moved = np.roll(change, (8 * number, -5 * number), (0, 1))
        frame = np.uint8(np.clip(np.round(gel + (number % 4) / 3 * moved), 0, 255))
        cv2.imwrite(str(folder / f"{number:03d}.png"), frame[..., ::-1])  # OpenCV writes BGR


def probe() -> Arrays:
    """Return every score of `probe label` on the simulated data set, with controls."""
    data = ("--data", "scenes/manifest.parquet", "--label", "hardness")
    table = command("probe", "label", *data, "--seeds", 3, "--out", "probe.json")
    arrays = {"table": np.array(table.splitlines())}
    for place, result in enumerate(json.loads(Path("probe.json").read_text())):
        for name, value in result.items():
            is_number = isinstance(value, int | float)
            kept = np.float64(value) if is_number else json.dumps(value, sort_keys=True)
            arrays[f"{place}/{name}"] = np.asarray(kept)
    return arrays


PARTS: dict[str, Callable[[], Arrays]] = {
    "features_xla": features_by_xla,
    "features_default": features_by_default,
    "text": texts,
    "fields": fields,
    "manifest": simulated_manifest,
    "stage1": stage1,
    "stage2": stage2,
    "endless1": endless1,
    "endless2": endless2,
    "simulated_touch": simulated_touch,
    "embed": embedded,
    "probe": probe,
}
NEEDS = {"stage1": ["manifest"], "stage2": ["manifest", "stage1"], "probe": ["manifest"]}


def command(*words: Any, **variables: str) -> str:
    """Run `anytouch` of the package that this process imported; return what it printed."""
    source = Path(at.__file__).parents[1]
    environment = os.environ | {"PYTHONPATH": str(source), "COLUMNS": "200"} | variables
    args = [sys.executable, "-m", "anytouch_jax", *map(str, words)]
    done = subprocess.run(args, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(args)}: exit status {done.returncode}\n{done.stderr}")
    return done.stdout


# Hashes and reports.


def digest(arrays: Arrays) -> str:
    """Return the SHA-256 of names, types, shapes and values."""
    whole = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        whole.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        whole.update(array.tobytes())
    return whole.hexdigest()[:16]


def total(arrays: Arrays) -> float:
    """Return the sum of all numbers as float64, without those that are not finite."""
    result = 0.0
    for name in sorted(arrays):
        array = arrays[name]
        if array.dtype.kind in "biuf":
            values = np.asarray(array, np.float64)
            result += float(values[np.isfinite(values)].sum())
    return result


def environment() -> dict[str, Any]:
    """Return what the last bits may depend on besides the code."""
    versions = {}
    for name in LIBRARIES:
        try:
            versions[name] = version(name)
        except ModuleNotFoundError:
            versions[name] = None
    versions["python"] = platform.python_version()
    versions["opencv"] = cv2.__version__
    cores = len(os.sched_getaffinity(0))
    return {"versions": versions, "machine": platform.machine(), "cores": cores}


def with_needs(names: list[str]) -> list[str]:
    """Return the parts to compute, in order: those named, and those whose files they read."""
    wanted = set(names or PARTS)
    for name in names:
        wanted |= set(NEEDS.get(name, ()))
    return [name for name in PARTS if name in wanted]


def compute(only: list[str], out: Path | None) -> None:
    """Compute the parts, print a line for each and the hash of all, and write them to `out`."""
    print(f"anytouch_jax {at.__version__} of {Path(at.__file__).parent}", flush=True)
    stored: Arrays = {}
    parts: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        os.environ["XDG_CACHE_HOME"] = f"{folder}/cache"  # nothing compiled by another version
        for name in with_needs(only):
            begun = time.perf_counter()
            arrays = PARTS[name]()
            seconds = time.perf_counter() - begun
            parts[name] = {"sha256": digest(arrays), "sum": total(arrays), "arrays": len(arrays)}
            print_part(name, parts[name], seconds)
            stored |= {f"{name}:{key}": value for key, value in arrays.items()}
    hashes = "\n".join(f"{name} {part['sha256']}" for name, part in parts.items())
    whole = hashlib.sha256(hashes.encode()).hexdigest()[:16]
    print(f"{'total':18} {whole}")
    if out is not None:
        np.savez_compressed(out.with_suffix(".npz"), **stored)
        about = {"total": whole, "parts": parts, "package": at.__file__} | environment()
        out.write_text(json.dumps(about, indent=2) + "\n")


def print_part(name: str, part: dict[str, Any], seconds: float) -> None:
    """Print the line of a part: its hash, its sum, and what is not compared, its time."""
    columns = (
        f"{name:18} {part['sha256']}",
        f"sum {part['sum']:<24.17g}",
        f"{part['arrays']:4d} arrays",
        f"{seconds:5.1f} s",
    )
    print("  ".join(columns), flush=True)


def compare(one: Path, other: Path) -> bool:
    """Print which parts of two fingerprints are equal; return whether all are."""
    old = json.loads(one.read_text())
    new = json.loads(other.read_text())
    for name in ("versions", "machine", "cores"):
        if old[name] != new[name]:
            print(f"note: {name} differ, {old[name]} and {new[name]}: so may the last bits")
    all_equal = True
    for name in dict.fromkeys([*old["parts"], *new["parts"]]):
        if name not in old["parts"] or name not in new["parts"]:
            print(f"{name:18} only in {one if name in old['parts'] else other}")
            all_equal = False
        elif old["parts"][name] == new["parts"][name]:
            print(f"{name:18} equal")
        else:
            print(f"{name:18} DIFFERS")
            all_equal = False
            print_differences(name, one.with_suffix(".npz"), other.with_suffix(".npz"))
    print("all parts are equal" if all_equal else "not equal")
    return all_equal


def print_differences(part: str, one: Path, other: Path, most: int = 12) -> None:
    """Print the arrays of a part that differ, the largest difference first."""
    if not one.exists() or not other.exists():
        print(f"    {one} or {other} is not there: no arrays to compare")
        return
    old = arrays_of_part(part, one)
    new = arrays_of_part(part, other)
    lines = []
    for name in sorted(old.keys() | new.keys()):
        if name not in old or name not in new:
            lines.append((np.inf, f"{name}: only in {one if name in old else other}"))
        elif digest({"": old[name]}) != digest({"": new[name]}):
            lines.append(difference(name, old[name], new[name]))
    lines.sort(key=lambda line: -line[0])
    for _, line in lines[:most]:
        print(f"    {line}")
    if len(lines) > most:
        print(f"    and {len(lines) - most} more of {len(old)} arrays")


def arrays_of_part(part: str, file: Path) -> Arrays:
    """Return the arrays of one part from a file."""
    with np.load(file) as stored:
        names = [name for name in stored.files if name.startswith(f"{part}:")]
        return {name.removeprefix(f"{part}:"): stored[name] for name in names}


def difference(name: str, old: np.ndarray, new: np.ndarray) -> tuple[float, str]:
    """Return the largest difference of two unequal arrays, to sort by, and a line about it."""
    if old.shape != new.shape:
        return np.inf, f"{name}: shape {old.shape} became {new.shape}"
    if old.dtype.kind not in "biuf" or new.dtype.kind not in "biuf":
        changed = np.argwhere(old != new)
        first = tuple(changed[0]) if len(changed) else ()
        example = f", such as {old[first]} and {new[first]}" if len(changed) else ""
        return np.inf, f"{name}: {len(changed)} of {old.size} texts differ{example}"
    if old.dtype != new.dtype:
        return np.inf, f"{name}: type {old.dtype} became {new.dtype}"
    a = np.asarray(old, np.float64)
    b = np.asarray(new, np.float64)
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    with np.errstate(invalid="ignore"):
        gap = np.where(same, 0.0, np.abs(a - b))
    largest = float(np.max(np.nan_to_num(gap, nan=np.inf, posinf=np.inf), initial=0.0))
    scale = float(np.max(np.abs(a[np.isfinite(a)]), initial=0.0))
    count = int((~same).sum())
    text = f"{name}: largest difference {largest:.3g}, largest value {scale:.3g}"
    return largest, f"{text}, {count} of {a.size} numbers"


def main() -> int:
    """Run the command line; return 1 if two fingerprints differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, metavar="FILE.json")
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=[], metavar="PART")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("OLD.json", "NEW.json"))
    options = parser.parse_args()
    if options.compare:
        return 0 if compare(*options.compare) else 1
    compute(options.only, options.out and options.out.resolve())
    return 0


if __name__ == "__main__":
    sys.exit(main())
