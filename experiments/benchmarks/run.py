"""Benchmarks: one page of speed against error, with its numbers as JSON."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from anytouch_jax.config import PresetName
from anytouch_jax.errors import UserError
from experiments.benchmarks import compilation, loading, machine, simulator, speed, workloads
from experiments.benchmarks.pareto import pareto
from experiments.benchmarks.speed import NAN
from experiments.command import run_script

Section = tuple[str, list[Any]]  # title, records
QUICK_ROUNDS, QUICK_SAMPLES, QUICK_PEAK = 2, 2, 512
QUICK_NOTE = "A quick run: two rounds on tiny batches, to see that everything works. Not for comparison."
MEMORY_NOTE = " ".join((compilation.__doc__ or "").split("\n\n", 1)[1].split())


@dataclass(frozen=True)
class Bench:
    """Measure speed against error: steps, embeddings, compilation, memory on many devices, simulator, loader.

    Example: python -m experiments.benchmarks.run stage1 embed --preset small --out runs/bench

    Without WHAT everything is measured. The variants take turns in one process. Quiet the machine first.
    """

    what: tuple[Literal["stage1", "stage2", "embed", "compile", "memory", "simulator", "loader"], ...]
    """What to measure (default: everything)."""
    preset: PresetName = "tiny"
    """Sizes of the network."""
    batch: int | None = None
    """Samples a step (default: 16, 16, 8, 4 by preset; 4 a device for memory)."""
    out: Path = Path("runs/bench")
    """Folder of speed.md (speed_WHAT_PRESET.md for a part, or another preset), its numbers and figures/."""
    rounds: int = 9
    """Rounds in which all variants take turns. Figures are medians."""
    quick: bool = False
    """Two rounds of tiny batches, to see that everything works."""

    @property
    def stem(self) -> str:
        """The name of the page: no measurement replaces one of something else."""
        plain = not self.what and self.preset == "tiny"
        return "_".join(("speed", *dict.fromkeys(self.what), *(() if plain else (self.preset,))))

    @property
    def turns(self) -> int:
        return QUICK_ROUNDS if self.quick else self.rounds

    @property
    def samples(self) -> int | None:
        return self.batch or (QUICK_SAMPLES if self.quick else None)


def run(options: Bench) -> int:
    """Measure, and write the page, its numbers and a figure a workload after each section.

    Raises UserError for numbers below 1, and for a page that this run may not replace.
    """
    for name in ("rounds", "batch"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise UserError(f"--{name} must be 1 or more, not {value}.")
    page = options.out / f"{options.stem}.md"
    if page.exists() and (not page.with_suffix(".json").exists() or (options.quick and not _is_quick(page))):
        raise UserError(f"{page} is another page or a measurement, which this run would replace. Choose another --out.")
    here = machine.describe()
    log(here.sentence())
    numbers: dict[str, Any] = {"machine": speed.record_of(here), "preset": options.preset, "rounds": options.turns}
    numbers |= {"quick": options.quick, "results": {}}
    for name in dict.fromkeys(options.what) or SECTIONS:
        for title, rows in SECTIONS[name](options, name):
            if found := _figure(title, rows):
                path, points, axes = found
                pareto(options.out / path, points, title=title, **axes)
            numbers["results"][title] = [speed.record_of(row) for row in rows]
            speed.write_page(options.out, options.stem, page_of(numbers), numbers)
            print(section_of(title, rows))
    log(f"{page}, its numbers in {page.stem}.json, and figures/")
    return 0


def log(sentence: str) -> None:
    """Print progress to standard error."""
    print(sentence, file=sys.stderr, flush=True)


def _is_quick(page: Path) -> bool:
    try:
        return bool(json.loads(page.with_suffix(".json").read_text(encoding="utf-8"))["quick"])
    except (OSError, ValueError, KeyError):
        return True


# The page -------------------------------------------------------------------------------------------------------------

TABLES: tuple[tuple[Any, Callable[[Any], str]], ...] = (
    (speed.SpeedRow, speed.speed_table),
    (compilation.Start, compilation.start_table),
    (compilation.Layout, compilation.layout_table),
    (simulator.FidelityRow, simulator.fidelity_table),
    (simulator.Recorded, simulator.recording_table),
    (loading.LoaderSpeed, loading.loader_table),
    (loading.Opened, loading.opened_table),
)


def page_of(numbers: dict[str, Any]) -> str:
    """Return the page of a run from its numbers alone."""
    parts = ["# Speed against error\n", f"{machine.Machine(**numbers['machine']).sentence()}\n"]
    parts += [*([f"{QUICK_NOTE}\n"] if numbers["quick"] else []), f"{speed.NOTES}\n"]
    for title, rows in numbers["results"].items():
        parts += [f"## {title}\n", section_of(title, [_record(row) for row in rows])]
    return "\n".join(parts)


def section_of(title: str, rows: Sequence[Any]) -> str:
    """Return a section of the page: a table for each kind of record, its figure, and how memory is measured."""
    parts = [table([row for row in rows if type(row) is kind]) for kind, table in TABLES if kind in map(type, rows)]
    if figure := _figure(title, rows):
        parts.append(f"![{title}]({figure[0]})\n")
    if any(isinstance(row, compilation.Layout) for row in rows):
        parts.append(f"{MEMORY_NOTE}\n")
    return "\n".join(parts)


def _record(row: dict[str, Any]) -> Any:
    """Return the record of which `row` is the JSON; null is NaN where that is the default."""
    kind = next(kind for kind, _ in TABLES if {field.name for field in fields(kind)} <= row.keys())
    usual = {field.name: field.default for field in fields(kind)}
    return kind(**{name: usual[name] if row[name] is None and usual[name] is NAN else row[name] for name in usual})


def _figure(title: str, rows: Sequence[Any]) -> tuple[str, dict[str, tuple[float, float]], dict[str, str]] | None:
    """Return the file, the points and the axes of the Pareto plot of a section; None without points."""
    if isinstance(rows[0], simulator.FidelityRow):
        axes = {"x": "ms a frame", "y": "worst scene's rms error of the displacement, %"}
        return "figures/speed_simulator.png", simulator.pareto_points(rows), axes
    points = speed.pareto_points(rows) if isinstance(rows[0], speed.SpeedRow) else {}
    if not points:
        return None
    what = "output" if rows[0].error_gradient is None else "gradient"
    axes = {"x": "time / float32 baseline", "y": f"relative error of the {what}, against float64"}
    return f"figures/speed_{title.replace(', preset ', '_').replace(' ', '_')}.png", points, axes


# Sections -------------------------------------------------------------------------------------------------------------


def _network(options: Bench, name: str) -> Iterator[Section]:
    peak = QUICK_PEAK if options.quick else None
    for work in workloads.workloads(name, options.preset, options.samples):
        rows = speed.measure(work, rounds=options.turns, peak_size=peak, log=log)
        yield f"{work.name}, preset {options.preset}", rows


def _compile(options: Bench, _: str) -> Iterator[Section]:
    log("compile: fresh processes, without and with the cache")
    steps = compilation.STAGE1 if options.quick else compilation.STEPS
    starts = compilation.first_steps(options.preset, steps, options.samples)
    yield f"First step of a fresh process, preset {options.preset}", starts


def _memory(options: Bench, _: str) -> Iterator[Section]:
    layouts = []
    for devices, fsdp in compilation.MESHES[:3] if options.quick else compilation.MESHES:
        log(f"memory: {devices} devices, {fsdp} to a copy of the state")
        layouts.append(compilation.simulate(options.preset, devices, fsdp, options.samples or 4))
    yield f"Memory and communication of a device, stage 1 on clips, preset {options.preset}", layouts


def _simulator(options: Bench, _: str) -> Iterator[Section]:
    log("simulator: contact and shear at every fidelity, against a converged float64 solution")
    small: dict[str, Any] = {}
    if options.quick:
        variants = [simulator.SolverVariant("exact", 28), simulator.SolverVariant("fast", 28)]
        small = {"variants": variants, "scenes": {"sphere": simulator.SCENES["sphere"]}, "reference": 56}
    yield "Simulator", simulator.speed_against_error(**small, rounds=options.turns)
    log("simulator: whole recordings, when compiled")
    small = {"sensors": ("digit",), "batch": 2, "frames": 2, "size": 32} if options.quick else {}
    shape = "two frames at 32" if options.quick else "ten frames at 224"
    recorded = simulator.recording_speed(rounds=options.turns, **small)
    yield f"Simulator, whole recordings of {shape} pixels, default fidelity", recorded


def _loader(options: Bench, _: str) -> Iterator[Section]:
    toy: dict[str, Any] = {"sizes": ((64, 48),), "pictures": 4, "rounds": 1, "pixels": 28, "rows": 2000}
    with tempfile.TemporaryDirectory() as folder:
        rows = loading.measure_loading(folder, log=log, **(toy if options.quick else {}))
    yield "Loader compared with plain decoding, and a large manifest", rows


SECTIONS: dict[str, Callable[[Bench, str], Iterator[Section]]] = {
    **dict.fromkeys(("stage1", "stage2", "embed"), _network),
    "compile": _compile,
    "memory": _memory,
    "simulator": _simulator,
    "loader": _loader,
}


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line `args` and return the exit status."""
    return run_script(Bench, run, args)


if __name__ == "__main__":
    sys.exit(main())
