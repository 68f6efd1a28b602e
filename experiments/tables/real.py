"""Real touch: object, and slip with objects left out, compared with raw pixels and an untrained encoder.

Differences are paired by test frame, with an interval over recordings (over objects, where these are left out).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder, random_encoder
from anytouch_jax.evaluate import probing, statistics
from anytouch_jax.evaluate.feature_cache import pixel_components, pixel_features
from anytouch_jax.evaluate.heads import ProbeHead
from anytouch_jax.evaluate.probing import label_rows, leave_groups_out, probe_features
from anytouch_jax.evaluate.tasks import TaskRows
from experiments.tables.plan import Leaf
from experiments.verdicts import accuracy_difference

Row = dict[str, Any]
Fit = Callable[[np.ndarray, Any], probing.ProbeResult]
FIRM: dict[str, Any] = {"where": ("label.contact_score", 7.0), "sensor": "gelsight_mini"}
OURS, UNTRAINED, PIXELS = "trained", "untrained", "pixels"
FOLDS = "object, every recording tested"  # in ten folds: the test split alone has fourteen
FINGERS = (("cam0", "cam2"), ("cam2", "cam0"))


def rows(leaf: Leaf, encoder: Encoder, manifest: Path) -> list[Row]:
    """Views trained, untrained, pixels of the tasks; `trained - pixels`, `trained - untrained` their differences."""
    table = manifests.read(manifest)
    return _object(leaf, encoder, table) + _slip(leaf, encoder, table)


def _object(leaf: Leaf, encoder: Encoder, table: Manifest) -> list[Row]:
    task, subsets = label_rows(table, "object", **FIRM)
    features = _features(leaf, encoder, table, task)

    def linear(split: np.ndarray, protocol: statistics.Protocol = "honest") -> Fit:
        options: dict[str, Any] = {"seeds": 0, "subsets": subsets, "protocol": protocol}
        return lambda x, scaling: probe_features(
            x, task.labels, task.groups, split, ProbeHead("linear", scaling), **options
        )

    found = _compared("object", features, linear(task.split))
    found += _published("object", features, linear(task.split, "published"))
    found += _compared(FOLDS, features, lambda x, scaling: leave_groups_out(
        x, task.labels, task.groups, scaling=scaling, subsets=subsets
    ))  # fmt: skip
    camera = np.array([unit.partition("_")[0] for unit in task.units])
    for first, second in FINGERS:
        # Both fingers of a grasp take part: this tests another camera and gel, not another grasp.
        learned = np.where(task.split == "val", "val", "train")
        split = np.where(camera == first, learned, np.where(camera == second, "test", "unused"))
        found += _compared(f"object, {first}'s units to {second}'s", features, linear(split))
    return found


def _slip(leaf: Leaf, encoder: Encoder, table: Manifest) -> list[Row]:
    task, subsets = label_rows(table, "slip", leave_out="object", **FIRM)
    return _compared(
        "slip, objects left out", _features(leaf, encoder, table, task),
        lambda x, scaling: leave_groups_out(x, task.labels, task.groups, scaling=scaling, subsets=subsets),
    )  # fmt: skip


def _features(leaf: Leaf, encoder: Encoder, table: Manifest, task: TaskRows) -> dict[str, np.ndarray]:
    encoders = {OURS: encoder, UNTRAINED: random_encoder(encoder.config, leaf.seed)}
    found = {
        name: embed_rows(one, table, task.rows[:, 0], pooling="both", log=_quiet)[1] for name, one in encoders.items()
    }
    return found | {PIXELS: pixel_components(pixel_features(table), task)}


def _fitted(features: dict[str, np.ndarray], fit: Fit) -> dict[str, probing.ProbeResult]:
    return {name: fit(x, "common" if name == PIXELS else "column") for name, x in features.items()}


def _published(task: str, features: dict[str, np.ndarray], fit: Fit) -> list[Row]:
    """The same with the penalty chosen on test."""
    found = _fitted(features, fit)
    shared = {"task": task, "protocol": "published", "metric": "accuracy"}
    return [
        shared | {"view": f"{name}, chosen on test", "mean": one.accuracy, "low": one.low, "high": one.high,
                  "test": one.n_test, "chance": one.baseline}
        for name, one in found.items()
    ]  # fmt: skip


def _compared(task: str, features: dict[str, np.ndarray], fit: Fit) -> list[Row]:
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
        mean, low, high = accuracy_difference(by_name[OURS], by_name[name])
        found.append(shared | {"view": f"{OURS} - {name}", "mean": mean, "low": low, "high": high})
    return found


def _quiet(_: str) -> None:
    pass
