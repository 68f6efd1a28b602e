"""Real touch: object, and slip with objects left out, beside raw pixels and an untrained encoder.

Differences are paired by test frame, with an interval over recordings (over objects, where these are left out).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.cli.options import Probe
from anytouch_jax.encoder.encoder import Encoder, embed_rows, random_encoder, text_column
from anytouch_jax.evaluate import probe, probe_command, statistics
from experiments.tables.plan import Leaf

Row = dict[str, Any]
OURS, UNTRAINED, PIXELS = "trained", "untrained", "pixels"
FOLDS = "object, every recording tested"  # in ten folds: the test split alone has fourteen
FINGERS = (("cam0", "cam2"), ("cam2", "cam0"))


def rows(leaf: Leaf, encoder: Encoder, manifest: Path) -> list[Row]:
    """Views trained, untrained, pixels of the tasks; `trained - pixels`, `trained - untrained` their differences."""
    options = Probe(
        data=(manifest,), label="object", where=("label.contact_score", 7.0), sensor="gelsight_mini",
        seeds=leaf.size.refits,
    )  # fmt: skip
    found = _object(leaf, encoder, options)
    found += _slip(leaf, encoder, replace(options, label="slip", leave_out="object"))
    return found


def _object(leaf: Leaf, encoder: Encoder, options: Probe) -> list[Row]:
    task = probe_command.read_task(options, _quiet)
    features = _features(leaf, encoder, task)
    found = _compared("object", features, lambda x, scaling: _linear(x, task, task.split, scaling))
    found += _published("object", features, task)
    found += _compared(FOLDS, features, lambda x, scaling: probe.leave_groups_out(
        x, task.labels, task.groups, scaling=scaling, subsets=task.subsets
    ))  # fmt: skip
    camera = np.array([unit.partition("_")[0] for unit in text_column(task.manifest, "unit")[task.rows]])
    for first, second in FINGERS:
        # Both fingers of a grasp take part: this tests another camera and gel, not another grasp.
        learned = np.where(task.split == "val", "val", "train")
        split = np.where(camera == first, learned, np.where(camera == second, "test", "unused"))
        name = f"object, {first}'s units to {second}'s"
        found += _compared(name, features, lambda x, scaling, split=split: _linear(x, task, split, scaling))
    return found


def _slip(leaf: Leaf, encoder: Encoder, options: Probe) -> list[Row]:
    task = probe_command.read_task(options, _quiet)
    features = _features(leaf, encoder, task)
    return _compared(
        "slip, objects left out", features,
        lambda x, scaling: probe.leave_groups_out(
            x, task.labels, task.groups, scaling=scaling, subsets=task.subsets
        ),
    )  # fmt: skip


def _features(leaf: Leaf, encoder: Encoder, task: Any) -> dict[str, np.ndarray]:
    encoders = {OURS: encoder, UNTRAINED: random_encoder(encoder.config, leaf.seed)}
    found = {
        name: embed_rows(one, task.manifest, task.rows, pooling="both", log=_quiet)[1] for name, one in encoders.items()
    }
    return found | {PIXELS: probe_command.raw_features(task)}


def _linear(
    x: np.ndarray, task: Any, split: np.ndarray, scaling: Any, protocol: statistics.Protocol = "honest"
) -> statistics.ProbeResult:
    shared: dict[str, Any] = {"seeds": 0, "scaling": scaling, "subsets": task.subsets, "protocol": protocol}
    return probe.linear_probe(x, task.labels, task.groups, split, **shared)


def _fitted(features: dict[str, np.ndarray], fit: Any) -> dict[str, statistics.ProbeResult]:
    return {name: fit(x, "common" if name == PIXELS else "column") for name, x in features.items()}


def _published(task: str, features: dict[str, np.ndarray], about: Any) -> list[Row]:
    """The same with the penalty chosen on test."""
    found = _fitted(features, lambda x, scaling: _linear(x, about, about.split, scaling, "published"))
    shared = {"task": task, "protocol": "published", "metric": "accuracy"}
    return [
        shared | {"view": f"{name}, chosen on test", "mean": one.accuracy, "low": one.low, "high": one.high,
                  "test": one.n_test, "chance": one.baseline}
        for name, one in found.items()
    ]  # fmt: skip


def _compared(task: str, features: dict[str, np.ndarray], fit: Any) -> list[Row]:
    """A row for each set of features, one for each part of its test rows, and the differences from the first."""
    by_name = _fitted(features, fit)
    shared = {"task": task, "protocol": "honest", "metric": "accuracy"}
    found = []
    for name, one in by_name.items():
        about = {"view": name, "test": one.n_test, "chance": one.baseline}
        found.append(shared | about | {"mean": one.accuracy, "low": one.low, "high": one.high})
        for part in (some for some in one.parts if some.n_test):
            named = {"view": f"{name}, {part.name}", "test": part.n_test}
            found.append(shared | named | {"mean": part.accuracy, "low": part.low, "high": part.high})
    for name in (UNTRAINED, PIXELS):
        mean, low, high = statistics.difference(by_name[OURS], by_name[name])
        found.append(shared | {"view": f"{OURS} - {name}", "mean": mean, "low": low, "high": high})
    return found


def _quiet(_: str) -> None:
    pass
