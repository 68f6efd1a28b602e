"""Probes of frozen features, from models and manifests to a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

from anytouch_jax.encoder.encoder import Join, Pooling
from anytouch_jax.evaluate import battery_command, probe_command, statistics
from anytouch_jax.evaluate.battery_features import Order
from anytouch_jax.evaluate.heads import HeadName
from anytouch_jax.evaluate.statistics import Protocol
from anytouch_jax.files import atomic_write

Log = Callable[[str], None]
Paths = Sequence[str | Path]


def probe_label(
    models: Paths,
    data: Paths,
    label: str = "object",
    *,
    features: Paths = (),
    group: str = "",
    leave_out: str | None = None,
    where: tuple[str, float] | None = None,
    sensor: str | None = None,
    frames: int = 1,
    pooling: Pooling = "class",
    seeds: int = 5,
    protocol: Protocol = "honest",
    controls: bool = True,
    save: Path | None = None,
    out: Path | None = None,
    log: Log = print,
) -> list[Any]:
    """Probe a label column with the features of every model, of features files and of the controls.

    Print the results with `statistics.to_table`. `save`: write the linear head of the only model. `out`: write JSON.
    """
    options: Any = SimpleNamespace(
        run=tuple(map(Path, models)), data=tuple(map(Path, data)), features=tuple(map(Path, features)), label=label,
        group=group, leave_out=leave_out, where=where, sensor=sensor, frames=frames, pooling=pooling, seeds=seeds,
        protocol=protocol, controls=controls, save=save,
    )  # fmt: skip
    results = probe_command.run_probes(options, log)
    if out is not None:
        atomic_write(out, statistics.to_json(results))
    return results


def probe_tasks(
    models: Paths,
    data: Paths,
    tasks: Sequence[str] | Literal["all"] = "all",
    *,
    features: Paths = (),
    heads: Sequence[HeadName] = ("linear",),
    seeds: int = 5,
    protocol: Protocol = "honest",
    frames: int | None = None,
    pooling: Pooling = "class",
    join: Join = "mean",
    order: Order = "right",
    train_sensors: Sequence[str] | None = None,
    test_sensors: Sequence[str] | None = None,
    train_units: Sequence[str] | None = None,
    test_units: Sequence[str] | None = None,
    max_rows: int | None = None,
    controls: bool = True,
    cache: Path | None = None,
    out: Path | None = None,
    log: Log = print,
) -> dict[str, Any]:
    """Probe named tasks with the features of every model, of features files and of the controls.

    Print the result with `task_table`. `protocol` "published" reports both protocols. `out`: write JSON.
    """
    return _battery(
        models, data, features, "all" if tasks == "all" else ",".join(tasks), "", out, log,
        heads=",".join(heads), seeds=seeds, protocol=protocol, frames=frames, pooling=pooling, join=join, order=order,
        max_rows=max_rows, controls=controls, cache=cache, train_sensors=",".join(train_sensors or ()),
        test_sensors=",".join(test_sensors or ()), train_units=",".join(train_units or ()),
        test_units=",".join(test_units or ()),
    )  # fmt: skip


def probe_benchmark(
    models: Paths,
    data: Paths,
    benchmark: str,
    *,
    features: Paths = (),
    seeds: int = 5,
    train_sensors: Sequence[str] | None = None,
    test_sensors: Sequence[str] | None = None,
    train_units: Sequence[str] | None = None,
    test_units: Sequence[str] | None = None,
    max_rows: int | None = None,
    controls: bool = True,
    cache: Path | None = None,
    out: Path | None = None,
    log: Log = print,
) -> dict[str, Any]:
    """Probe a public benchmark with the authors' pooling, head and settings, by both protocols.

    Print the result with `task_table`. `out`: write JSON.
    """
    return _battery(
        models, data, features, "", benchmark, out, log,
        heads="linear", seeds=seeds, protocol="honest", frames=None, pooling="class", join="mean", order="right",
        max_rows=max_rows, controls=controls, cache=cache, train_sensors=",".join(train_sensors or ()),
        test_sensors=",".join(test_sensors or ()), train_units=",".join(train_units or ()),
        test_units=",".join(test_units or ()),
    )  # fmt: skip


def _battery(
    models: Paths, data: Paths, features: Paths, tasks: str, benchmark: str, out: Path | None, log: Log, **rest: Any
) -> dict[str, Any]:
    options: Any = SimpleNamespace(
        run=tuple(map(Path, models)), data=tuple(map(Path, data)), features=tuple(map(Path, features)), tasks=tasks,
        benchmark=benchmark, **rest,
    )  # fmt: skip
    results = battery_command.run_battery(options, log)
    if out is not None:
        atomic_write(out, battery_command.to_json(results))
    return results


def task_table(results: dict[str, Any]) -> str:
    """Return the results of `probe_tasks` or `probe_benchmark` as Markdown."""
    return battery_command.to_table(results)
