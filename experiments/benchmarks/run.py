"""`anytouch bench`: one table of speed against error."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from anytouch_jax.cli.output import check_folder
from anytouch_jax.cli.unused import refuse
from anytouch_jax.cli.words import log
from anytouch_jax.config import PresetName
from anytouch_jax.config.parsing import COUNT, in_range
from anytouch_jax.errors import UserError
from experiments.command import run_script

if TYPE_CHECKING:
    from experiments.benchmarks.speed import Row

_QUICK_ROUNDS, _QUICK_SAMPLES, _QUICK_PEAK = 2, 2, 512
_NETWORK = ("stage1", "stage2", "embed")
Section = tuple[str, str, list[Any]]  # title, Markdown, records


@dataclass(frozen=True)
class Bench:
    """Measure speed against error: steps, embeddings, compilation, memory on many devices, simulator, loader.

    Example: python -m experiments.benchmarks.run stage1 embed --preset small --out runs/bench

    Without WHAT everything is measured. Variants take turns in one process; quiet the machine first.
    """

    what: tuple[Literal["stage1", "stage2", "embed", "compile", "memory", "simulator", "loader"], ...]
    """What to measure (default: everything)."""
    preset: PresetName = "tiny"
    """Sizes of the network."""
    batch: int | None = None
    """Samples a step (default: 16, 16, 8, 4 by preset; 64 for the loader; 4 a device for memory)."""
    out: Path = Path("runs/bench")
    """Folder for speed.md (speed_WHAT_PRESET.md where not everything at preset tiny), its numbers and figures/."""
    rounds: int = 9
    """Rounds in which all variants take turns; figures are medians."""
    quick: bool = False
    """Two rounds of tiny batches: does it work?"""


def run(options: Bench) -> int:
    """Measure what was asked for, write a page, its numbers and a figure a workload, and print the tables.

    The page is speed.md, with WHAT and the preset in its name where only some or another preset was asked for: no
    measurement is written over by one of something else. Raises UserError for a page that somebody wrote, and for a
    quick run in the place of a measurement.
    """
    from experiments.benchmarks import machine

    in_range("--", options, batch=COUNT, rounds=COUNT)
    _refuse_unused(options)
    page = options.out / f"{_stem(options)}.md"
    check_folder(page)
    if page.exists() and not page.with_suffix(".json").exists():
        raise UserError(f"{page} was not made by bench, it has no numbers beside it: choose another --out")
    if options.quick and page.exists() and not _made_quickly(page):
        raise UserError(f"{page} holds a measurement, which a quick run would replace: choose another --out")
    here = machine.describe()
    log(here.sentence())
    wanted: list[str] = list(dict.fromkeys(options.what)) or list(_SECTIONS)
    sections: list[Section] = []
    for name in wanted:
        for section in _SECTIONS[name](options, name):
            sections.append(section)
            path = _write(options, here, sections)  # after each: what was measured is not lost with what fails later
            print(section[1])
    log(f"{path}, its numbers in {path.stem}.json, and figures/ beside it")
    return 0


def _refuse_unused(options: Bench) -> None:
    asked: set[str] = {*(options.what or _SECTIONS)}
    if asked == {"simulator"}:
        refuse(options, ("preset", "batch"), "for the simulator alone, which has no network")
    if asked <= {"compile", "memory"}:
        refuse(options, ("rounds",), "for compilation and memory, which are measured once")
    if options.quick:
        refuse(options, ("rounds",), f"with --quick, which takes {_QUICK_ROUNDS}")


def _stem(options: Bench) -> str:
    plain = not options.what and options.preset == Bench.preset
    return "_".join(("speed", *dict.fromkeys(options.what), *(() if plain else (options.preset,))))


def _made_quickly(page: Path) -> bool:
    """Whether the numbers beside a page are of a quick run, or none that can be read."""
    try:
        return bool(json.loads(page.with_suffix(".json").read_text(encoding="utf-8")).get("quick", True))
    except (OSError, ValueError, AttributeError):
        return True


def _write(options: Bench, here: Any, sections: list[Section]) -> Path:
    from experiments.benchmarks import speed_report

    quick = "A quick run: two rounds on tiny batches, to see that everything works. Not for comparison.\n\n"
    text = f"# Speed against error\n\n{here.sentence()}\n\n{quick if options.quick else ''}{speed_report.NOTES}\n"
    text += "".join(f"\n## {title}\n\n{body}" for title, body, _ in sections)
    numbers = {
        "machine": speed_report.as_dict(here),
        "preset": options.preset,
        "rounds": _rounds(options),
        "quick": options.quick,
        "results": {title: [speed_report.as_dict(row) for row in rows] for title, _, rows in sections},
    }
    return speed_report.write(options.out, _stem(options), text, numbers)


def _rounds(options: Bench) -> int:
    return _QUICK_ROUNDS if options.quick else options.rounds


def _batch(options: Bench) -> int | None:
    return options.batch or (_QUICK_SAMPLES if options.quick else None)


def _network(options: Bench, name: str) -> list[Section]:
    from experiments.benchmarks import speed, speed_report
    from experiments.benchmarks.workloads import workloads

    found: list[Section] = []
    for work in workloads(name, options.preset, _batch(options)):
        rows = speed.measure(work, rounds=_rounds(options), peak_size=_QUICK_PEAK if options.quick else None, log=log)
        body = speed_report.to_markdown(rows) + "\n" + _figure(options, rows)
        found.append((f"{work.name}, preset {options.preset}", body, rows))
    return found


def _figure(options: Bench, rows: list[Row]) -> str:
    """The Pareto plot of a workload, as a line of Markdown."""
    from anytouch_jax.evaluate import plots
    from experiments.benchmarks import speed_report

    points = speed_report.points(rows)
    if not points:
        return ""
    what = "output" if rows[0].error_gradient is None else "gradient"
    title = f"{rows[0].workload}, preset {options.preset}"
    name = f"speed_{title.replace(', preset ', '_').replace(' ', '_')}.png"
    y = f"relative error of the {what}, against float64"
    plots.pareto(options.out / "figures" / name, points, x="time / float32 baseline", y=y, title=title)
    return f"![{title}](figures/{name})\n"


def _compile(options: Bench, _: str) -> list[Section]:
    from experiments.benchmarks import startup

    log("compile: fresh processes, without and with the cache")
    steps = startup.STAGE1 if options.quick else startup.STEPS
    found = startup.starts(options.preset, steps, _batch(options))
    title = f"First step of a fresh process, preset {options.preset}"
    return [(title, startup.to_markdown(found), list(found))]


def _memory(options: Bench, _: str) -> list[Section]:
    from experiments.benchmarks import memory

    found = []
    for devices, fsdp in memory.MESHES[:3] if options.quick else memory.MESHES:
        log(f"memory: {devices} devices, {fsdp} to a copy of the state")
        found.append(memory.simulate(options.preset, devices, fsdp, _batch(options) or 4))
    title = f"Memory and communication of a device, stage 1 on clips, preset {options.preset}"
    note = "\n" + " ".join((memory.__doc__ or "").split()) + "\n"
    return [(title, memory.to_markdown(found) + note, list(found))]


def _simulator(options: Bench, _: str) -> list[Section]:
    from anytouch_jax.evaluate import plots
    from experiments.benchmarks import fidelity

    log("simulator: contact and shear at every fidelity, against a converged float64 solution")
    quick = options.quick
    variants = [fidelity.Variant("exact", 28), fidelity.Variant("fast", 28)] if quick else fidelity.VARIANTS
    scenes = {"sphere": fidelity.SCENES["sphere"]} if quick else fidelity.SCENES
    reference = 56 if quick else 224
    rows = fidelity.speed_against_error(variants, scenes, reference=reference, rounds=_rounds(options))
    points = {
        f"{row.fidelity} {row.grid}{'' if row.iterations is None else f', {row.iterations}'}": (
            row.press_ms + row.shear_ms,
            100 * max(row.rms.values()),
        )
        for row in rows
    }
    name = "speed_simulator.png"
    y = "worst scene's rms error of the displacement, %"
    plots.pareto(options.out / "figures" / name, points, x="ms a frame", y=y, title="contact and shear")
    body = fidelity.to_markdown(rows) + f"\n![contact and shear](figures/{name})\n"
    small: dict[str, Any] = {"sensors": ("digit",), "batch": 2, "frames": 2, "size": 32} if quick else {}
    log("simulator: whole recordings, when compiled")
    recorded = fidelity.recording_speed(rounds=_rounds(options), **small)
    shape = "two frames at 32" if quick else "ten frames at 224"
    beside = f"Batches of recordings of {shape} pixels, default fidelity:\n\n{fidelity.recorded_markdown(recorded)}"
    return [("Simulator", body, list(rows)), ("Simulator, whole recordings", beside, list(recorded))]


def _loader(options: Bench, _: str) -> list[Section]:
    from experiments.benchmarks import loading, speed_data

    log("loader: frames a second by threads")
    rows = speed_data.measure(options.preset, _batch(options) or 64, rounds=_rounds(options))
    toy = {"sizes": ((64, 48),), "pictures": 4, "rounds": 1, "pixels": 28, "rows": 2000}
    small: dict[str, Any] = toy if options.quick else {}
    with tempfile.TemporaryDirectory() as folder:
        beside = loading.measure_loading(folder, log=log, **small)
    return [
        (f"Loader, preset {options.preset}", speed_data.to_markdown(rows), list(rows)),
        ("Loader beside plain decoding, and a large manifest", beside.to_markdown(), [*beside.speeds, *beside.opened]),
    ]


_SECTIONS: dict[str, Callable[[Bench, str], list[Section]]] = {
    **dict.fromkeys(_NETWORK, _network),
    "compile": _compile,
    "memory": _memory,
    "simulator": _simulator,
    "loader": _loader,
}


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line `args`; return the exit status."""
    return run_script(Bench, run, args)


if __name__ == "__main__":
    sys.exit(main())
