"""Pages of the benchmarks, from their numbers alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from experiments.benchmarks.optimiser import WAYS
from experiments.benchmarks.pareto import pareto
from experiments.benchmarks.versions import WORKS
from experiments.pages.page import Measure, Page, Value, compare
from experiments.records import read_records

VARIANTS, TORCH, MEMORY = "variants.jsonl", "torch.jsonl", "memory.jsonl"
SIMULATOR, SEARCH, VIEW = "simulator.jsonl", "search.jsonl", "view.jsonl"
VERSIONS, OPTIMISER, ENGINES = "versions.jsonl", "optimiser.jsonl", "engines.jsonl"
SCENE = "scene.jsonl"
RUNS = ("small", "small_epyc_stage1", "small_epyc", "large")  # of TORCH
BATCHES = "A training step has 16 samples, and 8 in matching. Preset large has 4."
GIB = 2**30


def _ratio(row: dict[str, Any]) -> Value:
    return Value(row["ratio"], row["ratio"] - row["ratio_iqr"] / 2, row["ratio"] + row["ratio_iqr"] / 2)


def _machine(about: dict[str, Any]) -> str:
    vectors = f" with {about['vectors']}" if about.get("vectors") else ""
    return f"{about['processor'].replace('(R)', '')}{vectors}, {about['cores']} core{'s' * (about['cores'] > 1)}"


def variants(folder: Path) -> Page:
    """Variants of a step: time, error and memory."""
    records = [*read_records(folder / VARIANTS).values()]
    rows: list[Any] = []
    ratios: dict[tuple[str, str], list[float]] = {}
    errors: dict[tuple[str, str], float] = {}
    for numbers in records:
        machine = numbers["machine"].get("vectors") or numbers["machine"]["device"]
        for row in (row for several in numbers["results"].values() for row in several):
            error, key = row["error_gradient"] or row["error_output"], (machine, row["variant"])
            ratios.setdefault(key, []).append(row["ratio"])
            errors[key] = max(error, errors.get(key, 0))
            shown = (1e3 * row["seconds"], _ratio(row), error, row["temp_bytes"] / 2**20)
            rows.append((machine, numbers["preset"], row["workload"], row["variant"], *shown))
    findings = [
        f"{machine}, {name}: a step takes {min(several):.2f} to {max(several):.2f} of the time in float32."
        for (machine, name), several in ratios.items()
        if name != "float32"
    ]
    points = {f"{machine}, {name}": (float(np.median(several)), errors[machine, name])
              for (machine, name), several in ratios.items()}  # fmt: skip
    known = {numbers["machine"].get("vectors"): numbers["machine"] for numbers in records}
    return Page(
        "variants",
        "What do precision, attention and memory options cost, and which pay where?",
        "Variants of a step run in turns in one process. The machines are "
        f"{' and '.join(_machine(one) for one in known.values())}. {BATCHES} The error is that of the gradient, or of "
        "the output of an embedding, against float64. From and to are quartiles. The sentences that say what to choose "
        "speak of the median over the works.",
        ("machine", "preset", "work", "variant", Measure("ms", ".0f", False), Measure("time / float32", ".2f"),
         Measure("error", ".0e", False), Measure("memory, MiB", ".0f", False)),
        rows, [*_choices(folder, points), *findings], (VARIANTS,),
        'make bench WHAT="stage1 stage2 embed" PRESET=small`, on AVX2 `make bench WHAT="stage1 embed" PRESET=tiny',
        "Median time ratio of a variant over its works, against its largest error.",
        lambda path: pareto(path, points, x="time / float32", y="error"),
    )  # fmt: skip


def _choices(folder: Path, points: dict[str, tuple[float, float]]) -> list[str]:
    """Return a sentence for each kind of processor: which type to train in, and which engine embeds."""
    engines = [one for one in read_records(folder / ENGINES).values() if one.get("encoder") == "anytouch-tiny"]
    best = min((one for one in engines if "ratio" in one and one["error"] < 1e-4), key=lambda one: one["ratio"])
    embeds = f"`{best['engine'].split(',')[0]}` embeds a touch in {best['ratio']:.2f} of the time of XLA"
    sentences = []
    for kind in ("AVX2", "AMX"):
        if (name := f"{kind}, bfloat16") not in points:
            continue
        time, error = points[name]
        pays = (f"train and embed in bfloat16. It takes {time:.2f} of float32's time, at an error up to {error:.0e}"
                if time <= 0.9 else f"stay with float32. bfloat16 takes {time:.2f} of its time")  # fmt: skip
        sentences.append(f"on a CPU with {kind}, {pays}.{f' {embeds}.' if kind == 'AVX2' else ''}")
    return [*sentences, "on a GPU, run `make bench-gpu` first: these rows are from CPUs alone."]


def versions(folder: Path) -> Page:
    """Versions of jax and flags of its compiler."""
    records = [*read_records(folder / VERSIONS).values()]
    base = records[0]["version"]
    records.sort(key=lambda one: (WORKS.index(one["work"]), one["dtype"] != "float32", one["version"]))
    rows, ratios = [], {}
    for one in records:
        ratio = Value(one["ratio"], one["ratio_low"], one["ratio_high"])
        error = one["error"].get("gradient", one["error"]["output"])
        rows.append((one["work"], one["dtype"], one["version"], one["ms"], ratio, error, one["temp_bytes"] / 2**20,
                     one["onednn"]))  # fmt: skip
        ratios.setdefault((one["version"], one["dtype"]), []).append(one["ratio"])
    findings = [
        f"{version}, {dtype}: {min(several):.2f} to {max(several):.2f} of the time of {base}."
        for (version, dtype), several in ratios.items()
        if version != base
    ]
    return Page(
        "versions",
        "Which version of jax, and which flags of its compiler?",
        f"Each version is a process, and the processes take turns ({_machine(records[0]['machine'])}, preset "
        f"{records[0]['preset']}). The ratio is to {base} without flags, in the same type. The error is that of the "
        "gradient, or of the output of an embedding, against float64. From and to are quartiles. YNNPACK is a library "
        "of products that jax uses on a CPU by default, and the flag oneDNN puts another in its place. Other work ran "
        "at the same time, at a low priority.",
        ("work", "type", "version", Measure("ms", ".1f", False), Measure("time / baseline", ".2f"),
         Measure("error", ".0e", False), Measure("memory, MiB", ".0f", False),
         Measure("calls of oneDNN", ".0f", False)),
        rows, [*findings, "a newer jax without flags is the best choice here: no flag is faster in all works."],
        (VERSIONS,), "python -m experiments.benchmarks.versions --python PATH",
    )  # fmt: skip


def optimiser(folder: Path) -> Page:
    """Forms of AdamW: time of an update, size of its state and loss after training."""
    records = read_records(folder / OPTIMISER)
    names = [way.name for way in WAYS]
    rows, findings = [], []
    for name in names:
        record = records[name]
        loss = record.get("loss_ratio")
        shown = None if loss is None else Value(float(np.mean(loss)), min(loss), max(loss), len(loss))
        for size in ("tiny", "small"):
            one = record[size]
            ratio = Value(one["ratio"], one["ratio_low"], one["ratio_high"])
            rows.append((name, size, one["ms"], ratio, one["state_bytes"] / 2**20, shown))
        times = [record[size]["ratio"] for size in ("tiny", "small")]
        if name != names[0]:
            findings.append(f"{name}: {min(times):.2f} to {max(times):.2f} of the time of an update.")
        if loss is not None and name != names[0]:
            findings.append(f"{name}: after {record['steps']:,} steps the loss is {min(loss):.4f} to {max(loss):.4f} "
                            "of that with float32.")  # fmt: skip
    first = records[names[0]]
    return Page(
        "optimiser",
        "Which form of AdamW?",
        f"An update of all parameters is timed by itself, and all ways take turns ({_machine(first['machine'])}). The "
        "state holds both moments. The loss is that of the last 100 steps of stage 1 on stills of 56 pixels, as a "
        "share of the loss with float32 and the same seed. From and to are quartiles of the time, and the least and "
        f"largest of the loss over seeds ({len(first['loss'])}).",
        ("way", "preset", Measure("ms", ".1f", False), Measure("time / ours", ".2f"),
         Measure("state, MiB", ".0f", False), Measure("loss / float32", ".4f")),
        rows, findings, (OPTIMISER,), "python -m experiments.benchmarks.optimiser MANIFEST",
    )  # fmt: skip


def torch(folder: Path) -> Page:
    """Ours next to PyTorch."""
    names = ("ours, bfloat16", "PyTorch, eager float32", "PyTorch, eager bfloat16", "PyTorch, compiled bfloat16")
    rows, ratios = [], {name: [] for name in names}  # type: ignore[var-annotated]
    records = read_records(folder / TORCH)
    for run in RUNS:
        numbers = records[run]
        for work, found in numbers["results"].items():
            by_name = {row["name"]: _ratio(row) for row in found["rows"]}
            rows.append((_machine(numbers["machine"]), numbers["preset"], work, *(by_name.get(name) for name in names)))
            for name in names:
                ratios[name] += [by_name[name].mean] if name in by_name else []
    findings = [
        f"{name} takes {min(one):.2f} to {max(one):.2f} of our time in float32." for name, one in ratios.items()
    ]
    return Page(
        "torch",
        "How fast is it next to PyTorch?",
        "Both train and embed with the same weights, batches and masks, in turns. The value is the time as a share of "
        f"ours in float32. {BATCHES} From and to are quartiles.",
        ("machine", "preset", "work", *(Measure(name, ".2f") for name in names)),
        rows, findings, (TORCH,), "make bench-torch",
    )  # fmt: skip


def search(folder: Path) -> Page:
    """Exact search and search in the nearest cells."""
    records = [*read_records(folder / SEARCH).values()]
    rows = [
        (f"{one['count']:,}", one["way"], Value(100 * one["recall"]), one["p50_ms"], one["p99_ms"],
         one["processor_ms"], one["opened_s"], one["opened_processor_s"]) for one in records
    ]  # fmt: skip
    largest = {one["way"].split()[0]: one for one in records if one["count"] == max(one["count"] for one in records)}
    exact, cells = largest["exact"], largest["cells"]
    loads = sorted(one["load"] for one in records)
    return Page(
        "search",
        "How fast is search by touch?",
        f"The {exact['nearest']} nearest of made features of {exact['width']} values are searched, in clusters of "
        "about 50. A query is one touch. Recall is the share of the exact result that is found. The exact way is "
        f"numpy, and FAISS looks into the nearest cells alone. The machine is {_machine(exact['machine'])}. Other work "
        f"ran on it, and its load was {loads[0]:.0f} to {loads[-1]:.0f}. So compare processor times, which are sums "
        "over the threads.",
        ("features", "way", Measure("recall, %"),
         *(Measure(name, ".1f", False) for name in ("p50, ms", "p99, ms", "processor ms", "s to open",
                                                     "processor s to open"))),
        rows,
        [f"Exact search among {exact['count']:,} features takes {exact['processor_ms']:.0f} ms of processor "
         "time a query.",
         f"Cells take {cells['processor_ms']:.1f} ms, with a recall of {100 * cells['recall']:.1f} %.",
         f"Cells are made when the index opens, which takes {cells['opened_processor_s']:.0f} s of processor "
         "time. For a few queries exact search is done earlier."],
        (SEARCH,), "python -m experiments.benchmarks.search",
    )  # fmt: skip


def scene(folder: Path) -> Page:
    """Frames and patches left out of a stream."""
    records = read_records(folder / SCENE)
    measured = records.pop("times")
    programs, (whole, *others) = measured["programs"], records.values()
    rows, points = [], {}
    good: dict[str, list[str]] = {"simulated": [], "real": []}
    for one in (whole, *others):
        fine, real = one["fine"], one["slip"]
        lost = [Value(*part["minus"]).times(100) for part in (fine, one["coarse"], real["kNN"], real["linear"])]
        times = [sum(share * programs[name]["ratio"] for name, share in part["runs"].items()) for part in (fine, real)]
        rows.append((one["name"], times[0], 100 * fine["share"], *lost[:2], times[1], 100 * real["kNN"]["share"],
                     *lost[2:]))  # fmt: skip
        points[one["name"]] = times[0], 100 * (1 - fine["share"])
        for data, time, values in zip(good, times, (lost[:2], lost[2:]), strict=True):
            good[data] += [one["name"]] if time <= 0.5 and min(value.mean for value in values) > -1 else []
    ms = {name: program["ms"] for name, program in programs.items()}
    half = {
        one["name"].replace("50 %", "half"): Value(*one["fine"]["minus"]).times(100)
        for one in others if "50 %" in one["name"]
    }  # fmt: skip
    goals = [f"{data} touch: the goal is met by {', '.join(names) or 'no row'}." for data, names in good.items()]
    return Page(
        "scene",
        "Which frames and patches can a stream leave out?",
        f"`{whole['encoder']}` embeds frames one by one. Some patches or frames are left out. The goal is half the "
        "time at less than one point. A limit in grey levels keeps a quarter, a half or all of the patches: the "
        "fewest that hold those which changed more since the background. Merging gives one mean token a quarter of the "
        "picture. A tenth of a camera's changes from one frame to the next are below its noise. Recall@1 is that of 50 "
        "look-alikes, by another sensor. Slip is judged on objects left out, with heads fitted on whole frames. Times "
        "are ratios to the whole encoder in turns with it, medians "
        f"of {measured['rounds']} rounds on {_machine(measured['machine'])}. Other work ran on it, at a load of "
        f"{measured['machine']['load']:.0f}. They leave out the camera and the "
        "preparation of a frame. Nearly all frames show touch, so a stream with pauses reuses more.",
        ("left out", Measure("time, simulated", ".2f", False), Measure("fine recall@1, %", ".1f", False),
         Measure("minus whole", "+.1f"), Measure("coarse recall@1 minus whole", "+.1f"),
         Measure("time, real", ".2f", False), Measure("slip by kNN, %", ".1f", False), Measure("minus whole", "+.1f"),
         Measure("slip, linear, minus whole", "+.1f")),
        rows,
        [*goals, *(compare(name, "the whole encoder", lost, "fine look-alikes") for name, lost in half.items()),
         *(f"{one['name']}: {100 * one['slip']['reused_free']:.0f} % of real frames of an untouched gel are reused, "
           f"and {100 * one['fine']['reused_free']:.0f} % of simulated ones." for one in others
           if "compare" in one["slip"]["runs"]),
         f"The whole encoder takes {ms['100 %']:.1f} ms. Comparing a frame takes {ms['compare']:.2f} ms, and "
         f"choosing patches {ms['choose']:.2f} ms.",
         f"The projection of patches takes {100 * ms['projection of a clip'] / ms['clip']:.0f} % of a clip's time. "
         "None of it can be reused. Each place in the clip has a kernel, and a frame meets each kernel once."],
        (SCENE,), "python -m experiments.benchmarks.scene scores`, and then `... scene times",
        "Time ratio against the share of touches that are not found first, fine look-alikes.",
        lambda path: pareto(path, points, y="not found first, %"),
    )  # fmt: skip


def view(folder: Path) -> Page:
    """Live touch on the page, and the opening of a large manifest."""
    records = read_records(folder / VIEW)
    named = {"camera alone": "camera alone", "all": "with a head and nearest touches"}
    rows: list[Any] = [
        (what, name, Value(one[what]["p50"], one[what]["p50"], one[what]["p99"]), one[what].get("largest"))
        for key, name in named.items() if (one := records.get(key)) for what in ("encoder", "age")
    ]  # fmt: skip
    findings = [
        f"{name}: the oldest frame is {one['age']['largest']:.0f} ms old when the page shows it. "
        f"The encoder takes {one['encoder']['p99']:.0f} ms at the 99th percentile."
        for key, name in named.items() if (one := records.get(key))
    ]  # fmt: skip
    if opening := records.get("open"):
        least, most = min(opening["seconds"]), max(opening["seconds"])
        findings.append(
            f"a manifest of {opening['rows']:,} rows is on the page {least:.1f} to {most:.1f} s after the command."
        )
    first = next(iter(records.values()))
    return Page(
        "view",
        "How old is live touch on the page?",
        "A film of 30 frames/s takes the place of a camera, and `anytouch-tiny` embeds each frame. Chromium draws the "
        f"page on the same machine ({_machine(first['machine'])}). Age is the time from the arrival of a frame to the "
        "page. Values are medians, and to is the 99th percentile. For age they are the largest of windows of 20 s.",
        ("time", "of", Measure("ms", ".0f"), Measure("largest, ms", ".0f", False)),
        rows, findings, (VIEW,),
        "python -m experiments.benchmarks.view FILM --with MANIFEST FEATURES --head HEAD",
    )  # fmt: skip


def engines(folder: Path) -> Page:
    """One encoder on several engines."""
    records = [one for one in read_records(folder / ENGINES).values() if "p50_ms" in one and "error" in one]
    live = {one["encoder"]: one for one in records if one["engine"] == "XLA, float32"}

    def change(one: dict[str, Any], name: str) -> float | None:
        return 100 * (one[name] - live[one["encoder"]][name]) if name in one else None

    rows: list[Any] = [
        (one["encoder"], one["engine"], one["p50_ms"], one["p99_ms"], Value(one["ratio"]), one["per_s"],
         one["start_s"], one["memory_mib"], one["error"], change(one, "accuracy"), change(one, "recall"))
        for one in records
    ]  # fmt: skip
    findings = []
    for name, base in live.items():
        own = [one for one in records if one["encoder"] == name]
        best = min(own, key=lambda one: one["ratio"])
        findings.append(
            f"{name}: {best['engine']} is the fastest, in {best['ratio']:.2f} of the time of XLA in float32. "
            f"Its median is {best['p50_ms']:.0f} ms, and that of XLA {base['p50_ms']:.0f} ms."
        )
    if small := [one for one in records if one["encoder"] == "small"]:
        met = any(one["p50_ms"] < 15 and one["p99_ms"] < 25 for one in small)
        findings.append(f"small: the goal of 15 ms and 25 ms is {'met' if met else 'missed'} on this machine.")
    clips = [one for one in records if one["encoder"].endswith("clips") and one["engine"].endswith("float32")]
    findings += [
        f"{one['encoder']}: the 99th percentile of {one['engine'].split(',')[0]} in float32 is {one['p99_ms']:.0f} ms. "
        f"A camera of 30 frames/s leaves 33 ms." for one in clips
    ]  # fmt: skip
    findings.append(
        "XLA stays the default of `anytouch stream`: it needs no other package and no export, and it runs on GPUs."
    )
    findings += [_fused(one) for one in records if one["encoder"] == "small" and "kinds" in one]
    first = records[0]
    rounds = min(one["rounds"] for one in records)
    known, loads = live["anytouch-tiny"], sorted(one["machine"]["load"] for one in records)
    return Page(
        "engines",
        "Which engine embeds touch fastest?",
        f"One exported encoder runs on several engines, with {first['machine']['cores']} threads each "
        f"({_machine(first['machine'])}). Engines take turns, one touch at a time, {rounds} times or more. A "
        "touch has one frame, and in clips three. `small` "
        "(384 wide, 224 pixels) is untrained. Batches have 16 touches. Start is from "
        "the imported package to the first features, in a fresh process. Memory is what that process grew by. Error is "
        "the largest difference as a share of the largest feature. int8 is calibrated on 200 other touches. On "
        f"simulated objects held out, `anytouch-tiny` names the indenter of {100 * known['accuracy']:.1f} %. Its "
        f"recall@1 is {100 * known['recall']:.1f} %, among 50 look-alikes by another sensor. The last columns are "
        f"changes from that, in points. Other work ran on the machine, and its load was up to "
        f"{loads[-1]:.0f}. So compare ratios, not times.",
        ("encoder", "engine", Measure("p50, ms", ".1f", False), Measure("p99, ms", ".1f", False),
         Measure("time / XLA float32", ".2f"), Measure("touches/s in batches", ".0f", False),
         Measure("start, s", ".1f", False), Measure("memory, MiB", ".0f", False), Measure("error", ".0e", False),
         Measure("accuracy", "+.1f", False), Measure("recall@1", "+.1f", False)),
        rows, findings, (ENGINES,), "python -m experiments.benchmarks.engines time --corpus MANIFEST",
    )  # fmt: skip


FUSED = {
    "BiasGelu": "bias with GELU", "QLinearMatMul": "8-bit products with their rounding",
    "FullyConnected": "products with bias", "Subgraph": "chains such as attention",
}  # fmt: skip


def _fused(one: dict[str, Any]) -> str:
    """Return a sentence about the operations in the program of an engine."""
    fused = [what for kind, what in FUSED.items() if any(name.split()[0] == kind for name in one["kinds"])]
    return f"{one['engine']} runs {sum(one['kinds'].values())} operations at small, and fuses {' and '.join(fused)}."


def memory(folder: Path) -> Page:
    """Memory and communication of a device."""
    numbers = read_records(folder / MEMORY)["large"]
    several = [row for one in numbers["results"].values() for row in one]
    rows = [
        (f"{row['devices']} device{'s' * (row['devices'] > 1)}", "split" if row["fsdp"] > 1 else "whole",
         row["state"] / GIB, row["temporary"] / GIB, row["sent"] / GIB)
        for row in several
    ]  # fmt: skip
    split = [row for row in several if row["fsdp"] > 1]
    return Page(
        "memory",
        "How much memory does a device need?",
        f"A step of stage 1 on clips, preset large, {several[0]['batch_per_device']} samples a device. The state is "
        "parameters and optimiser. It is kept whole on each device, or split over all of them. The compiler reports "
        "these sizes.",
        ("devices", "state is", *(Measure(f"{name}, GiB", ".2f", False) for name in ("state", "work", "sent"))),
        rows,
        [f"Split over {split[-1]['devices']} devices, the state of one is {split[-1]['state'] / GIB:.2f} GiB."],
        (MEMORY,), "make bench WHAT=memory PRESET=large",
        "State, work and traffic of a device.", lambda path: _lines(path, rows),
    )  # fmt: skip


def _lines(path: Path, rows: list[Any]) -> None:
    from matplotlib.figure import Figure

    from anytouch_jax.evaluate.plots import write_figure

    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots(1, 3)
    for axis, name, column in zip(axes, ("state", "work", "sent"), (2, 3, 4), strict=True):
        for kind in ("whole", "split"):
            points = [(int(row[0].split()[0]), row[column]) for row in rows if row[1] == kind or row[0] == "1 device"]
            axis.plot(*np.transpose(points), "o-", markersize=3, label=f"state {kind}")
        axis.set(title=f"{name}, GiB", xlabel="devices", ylim=(0, None))
        axis.set_xscale("log", base=2)
    axes[0].legend(frameon=False, fontsize=8)
    write_figure(path, figure)


def photometry(folder: Path) -> Page:
    """Simulated pictures against real presses."""
    records = [one for key, one in read_records(folder / SIMULATOR).items() if key.startswith("press-")]
    numbers = [Measure("error", ".2f", False), Measure("PSNR, dB", ".1f", False), Measure("SSIM", ".3f", False)]
    findings = []
    for sensor in dict.fromkeys(one["sensor"] for one in records):
        by = {one["renderer"]: one for one in records if one["sensor"] == sensor}
        rival = by["taxim, shadow (in-sample)"]
        findings += [
            f"{sensor}: our error is {by['ours']['mae']:.1f} grey levels, that of taxim with shadow "
            f"{rival['mae']:.1f}.",
            f"{sensor}: taxim with shadow takes {rival['ms'] / by['ours']['ms']:.0f} times as long.",
        ]
    return Page(
        "photometry",
        "Do simulated pictures look like real presses?",
        "The package taxim has real presses of a ball. Our light is fitted to the even presses, and this table scores "
        "the odd ones. The error is the mean over the dent, in grey levels from 0 to 255. Taxim's own tables were made "
        "from these very presses.",
        ("sensor", "renderer", *numbers, Measure("error around the dent", ".2f", False), Measure("ms", ".0f", False)),
        [(one["sensor"], one["renderer"], one["mae"], one["psnr"], one["ssim"], one["ring_mae"], one["ms"])
         for one in records],
        findings, (SIMULATOR,), "python -m experiments.benchmarks.run simulator",
        "Error in the dent by renderer.", lambda path: _bars(path,
        [(f"{one['sensor']}, {one['renderer']}", one["mae"]) for one in records]),
    )  # fmt: skip


def contact(folder: Path) -> Page:
    """The contact solver: speed against error."""
    records = [one for key, one in read_records(folder / SIMULATOR).items() if key.startswith("contact-")]
    records.sort(key=lambda one: (one["fidelity"], one["grid"], one["iterations"] != "own", one["iterations"]))
    rows = [
        (one["fidelity"], f"{one['grid']} pixels", one["iterations"].replace("own", "until it converges"),
         one["press_ms"] + one["shear_ms"], float(np.mean([*one["rms"].values()])), one["slip_points"],
         float(np.mean([*one["picture"].values()])))
        for one in records
    ]  # fmt: skip
    own = {(one[0], one[1]): one for one in rows if one[2].startswith("until")}
    fast, exact = own["fast", "112 pixels"], own["exact", "112 pixels"]
    return Page(
        "contact",
        "How fast and how exact is the contact solver?",
        "Four surfaces are pressed into a gel and moved. The reference is the converged solution in float64 on the "
        "finest grid. The error is that of displacements, over the largest one. The picture's error is in grey levels.",
        ("fidelity", "grid", "iterations", Measure("ms a frame", ".1f", False), Measure("error, %", ".2f", False),
         Measure("slip, points off", ".1f", False), Measure("picture off", ".2f", False)),
        rows,
        [f"On 112 pixels `fast` takes {fast[3]:.1f} ms a frame and `exact` {exact[3]:.0f} ms.",
         f"On 112 pixels the picture of `fast` is {fast[6]:.1f} grey levels off."],
        (SIMULATOR,), "python -m experiments.benchmarks.run simulator",
        "Milliseconds a frame.", lambda path: _bars(path, [(", ".join(row[:3]), row[3]) for row in rows], log=True),
    )  # fmt: skip


def _bars(path: Path, rows: list[tuple[str, float]], *, log: bool = False) -> None:
    from matplotlib.figure import Figure

    from anytouch_jax.evaluate.plots import write_figure

    figure = Figure(figsize=(7, 0.6 + 0.25 * len(rows)), layout="constrained")
    axis = figure.subplots()
    axis.barh([name for name, _ in rows], [value for _, value in rows], color="C0", log=log)
    axis.invert_yaxis()
    axis.tick_params(labelsize=8)
    write_figure(path, figure)
