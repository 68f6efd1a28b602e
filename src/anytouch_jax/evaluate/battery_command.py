"""`anytouch probe --tasks` and `--benchmark`: the battery for several runs and the controls, as a table and as JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, get_args

from anytouch_jax.config import preset
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import check_frames, load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import battery
from anytouch_jax.evaluate.benchmarks import benchmark_of
from anytouch_jax.evaluate.given import given
from anytouch_jax.evaluate.heads import HeadName
from anytouch_jax.evaluate.statistics import markdown
from anytouch_jax.evaluate.tasks import TASKS, available, task_of

if TYPE_CHECKING:
    from anytouch_jax.cli.options import Probe

RAW = "raw pixels"


def run_battery(options: Probe, log: Callable[[str], None]) -> dict[str, Any]:
    """Every run and control on every task: {"manifest": hash, "data", "runs": {name: config}, "left_out": {task:
    why}, "results": [...]}.

    Raises UserError: both a benchmark and tasks, nothing to probe, and as `battery.run`.
    """
    table = manifests.read([str(path) for path in options.data])
    tasks, settings, paper = _asked(options, table)
    encoders = {str(path): load_encoder(path) for path in options.run}
    for encoder in encoders.values():
        check_frames(encoder.config.model, options.frames or 1)
        if options.join != "mean" and options.frames and options.frames <= encoder.config.model.frames:
            raise UserError(f"--join does nothing for clips of {options.frames} frames, which have one segment")
    if options.controls:
        first = next(iter(encoders.values()), None)
        encoders["random encoder"] = random_encoder(first.config if first else preset("tiny"))
    files = {str(path): given(path, table) for path in options.features}
    if not encoders and not files:
        raise UserError("nothing to probe: give --run or --features, or keep the controls")
    if files and options.order != "right":
        raise UserError("--order does nothing for --features, whose frames are encoded already; leave one of them out")
    names = ("train_sensors", "test_sensors", "train_units", "test_units")
    sides = {name: _names(getattr(options, name)) for name in names}
    tasks, unprobed = (tasks, {}) if options.benchmark else _possible(options, table, tasks, sides, log)
    shared: dict[str, Any] = {name: getattr(options, name) for name in ("cache", "seeds", "order", "max_rows")} | sides
    plain = {name: settings[name] for name in ("protocols", "frames", "head_names", "recipe") if name in settings}
    mine: list[dict[str, Any]] = []
    for name, store in files.items():  # first: a file that lacks rows is told before the work
        mine += [{"features": name} | one for one in battery.run(store, table, tasks, **shared, **plain)]
        log(f"probed {name}")
    found: list[dict[str, Any]] = []
    for name, encoder in encoders.items():
        found += [{"features": name} | one for one in battery.run(encoder, table, tasks, **shared, **settings)]
        log(f"probed {name}")
    found += mine
    if options.controls:
        found += [{"features": RAW} | one for one in battery.run(None, table, tasks, **shared, **plain)]
        log(f"probed {RAW}")
    runs = {name: dataclasses.asdict(encoder.config) for name, encoder in encoders.items()}
    return {"manifest": table.content_hash, "data": [str(path) for path in options.data], "paper": paper,
            "seeds": options.seeds, "sides": sides, "runs": runs, "left_out": unprobed, "results": found}  # fmt: skip


def _asked(options: Probe, table: Any) -> tuple[Sequence[Any], dict[str, Any], float | None]:
    """Tasks, their settings for `battery.run`, and the paper's accuracy of a benchmark."""
    if options.benchmark and options.tasks:
        raise UserError("give --benchmark, which has its own settings, or --tasks, not both")
    if options.benchmark:
        one = benchmark_of(options.benchmark)
        return [one.task], one.settings(), one.paper
    names = available(table) if options.tasks == "all" else _names(options.tasks)
    protocols = ("honest", "published") if options.protocol == "published" else ("honest",)
    asked, known = _names(options.heads) or (), get_args(HeadName)
    if not asked or not set(asked) <= set(known):
        raise UserError(f"--heads {options.heads!r}: choose among {', '.join(known)}, with commas between")
    if options.order != "right" and options.frames is None and names and all(task_of(one).frames == 1 for one in names):
        raise UserError("--order does nothing for stills, which these tasks are of; give --frames, or leave it out")
    settings = {"pooling": options.pooling, "join": options.join, "protocols": protocols, "head_names": asked}
    if not names:
        raise UserError("the manifest has no label of any task; `anytouch probe --label COLUMN` takes any column")
    return names, settings | ({} if options.frames is None else {"frames": options.frames}), None


def _possible(
    options: Probe, table: Any, tasks: Sequence[str], sides: dict[str, Any], log: Callable[[str], None]
) -> tuple[list[str], dict[str, str]]:
    """The tasks that can be probed, and why each of the others cannot, said aloud. Raises UserError when none can."""
    why = battery.left_out(table, tasks, options.frames, battery.Sides(**sides), options.max_rows)
    rest = [one for one in tasks if one not in why]
    if not rest:
        raise UserError("; ".join(f"task {name}: {reason}" for name, reason in why.items()))
    if options.tasks == "all":
        why |= {name: "the manifest has no such label" for name in TASKS if name not in tasks}
    for name, reason in why.items():
        log(f"{name}: not probed ({reason})")
    return rest, why


def _names(text: str | None) -> tuple[str, ...] | None:
    return tuple(one.strip() for one in text.split(",") if one.strip()) if text else None


def to_table(found: dict[str, Any]) -> str:
    """The results of `run_battery` as Markdown, the notes below."""
    head = ("features", "task", "head", "protocol", "score", "95 %", "chance", "train", "test (groups)")
    rows, notes = [], dict[str, None]()
    for one in found["results"]:
        r2 = one["metric"] == "r2"
        score = f"R2 {one['mean']:.3f}, {one['mae']:.3g} {one['unit']}" if r2 else f"{100 * one['mean']:.1f} %"
        chance = f"{one['chance_mae']:.3g} {one['unit']}" if r2 else f"{100 * one['chance']:.1f} %"
        size = f"{one['test']} ({one['groups']})"
        rows.append((one["features"], one["task"], one["head"], one["protocol"], score, _interval(one),
                     chance, str(one["train"]), size))  # fmt: skip
        notes |= dict.fromkeys(f"- {one['task']}: {note}" for note in one["notes"])
    if found["paper"] is not None:
        notes[f"- the paper reports {100 * found['paper']:.2f} % for AnyTouch, its epoch chosen on test"] = None
    return "\n\n".join([markdown(head, rows), *(["\n".join(notes)] if notes else [])]) + "\n"


def _interval(one: dict[str, Any]) -> str:
    if one["low"] is None:
        return "-"
    return f"{one['low']:.3f} to {one['high']:.3f}" if one["metric"] == "r2" else (
        f"{100 * one['low']:.1f} to {100 * one['high']:.1f}"
    )  # fmt: skip


def to_json(found: dict[str, Any]) -> str:
    """The results of `run_battery` as JSON."""
    return json.dumps(found, indent=2, allow_nan=False)
