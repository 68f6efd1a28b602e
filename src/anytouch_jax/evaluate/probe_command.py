"""`anytouch probe`: from a manifest and runs to probe results, each frame encoded once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pyarrow as pa

from anytouch_jax.config import FIELD_SENSORS, Config, preset
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import Encoder, check_frames, embed_rows, load_encoder, random_encoder, text_column
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import baseline, probe
from anytouch_jax.evaluate.given import given
from anytouch_jax.evaluate.probe_rows import prepare
from anytouch_jax.evaluate.saved_heads import head_of, save_head

if TYPE_CHECKING:
    from anytouch_jax.cli.options import Probe

Log = Callable[[str], None]
RAW = "raw pixels"
GROUPS = ("grasp_group", "object", "touch", "sequence")  # what --group is by default: the first that there is


@dataclass(frozen=True)
class Task:
    """The rows of a manifest that take part in a probe, with what the probes need to know of each."""

    manifest: Any
    rows: np.ndarray
    labels: np.ndarray
    groups: np.ndarray
    split: np.ndarray
    subsets: dict[str, np.ndarray]

    def only(self, rows: np.ndarray) -> Task:
        """The task on those of its rows that are in `rows`."""
        keep = np.isin(self.rows, rows)
        subsets = {name: mask[keep] for name, mask in self.subsets.items()}
        return replace(
            self, rows=self.rows[keep], labels=self.labels[keep], groups=self.groups[keep], split=self.split[keep],
            subsets=subsets,
        )  # fmt: skip


def run_probes(options: Probe, log: Log) -> list[Any]:
    """All results: for each encoder (and the controls) a linear probe and kNN, or the groups left out."""
    task = read_task(options, log)
    _check(options, task)  # mistakes are told before the work
    found: list[Any] = []
    for name, values, encoder in _features(options, task, log):
        # Principal components keep their sizes: bringing each to unit spread would blow up the smallest.
        results = probe_features(options, task, values, name, "common" if name == RAW else "column")
        if options.save is not None and encoder is not None and name == str(options.run[0]):
            _save(options, results[0], encoder)
            log(f"{options.save}: the linear head")
        found += results
        log(f"probed {name}")
    if not found:
        raise UserError("nothing to probe: give --run or --features, or keep the controls")
    if options.leave_out is None:
        found.append(probe.majority(task.labels, task.groups, task.split, subsets=task.subsets))
    return found


def _save(options: Probe, linear: Any, encoder: Encoder) -> None:
    """Keep the linear head whose result this is."""
    assert options.save is not None
    model, names = linear.outcome.fitted
    about: dict[str, Any] = {"label": options.label.removeprefix("label."), "pooling": options.pooling}
    save_head(options.save, head_of(model, names, frames=options.frames or 1, mark=encoder.mark, **about))


def _check(options: Probe, task: Task) -> None:
    """Raise UserError for labels, splits or groups that no probe could use, whatever the features are."""
    nothing, left_out = np.zeros((len(task.rows), 1), np.float32), options.leave_out is not None
    split = np.full(len(task.rows), "train") if left_out else task.split
    prepare(nothing, task.labels, task.groups, split, tested=not left_out)
    if left_out and len(np.unique(task.groups)) == 1:
        raise UserError(f"all rows are of one {options.leave_out} ({task.groups[0]}): nothing is left to learn from")


def probe_features(
    options: Probe, task: Task, values: np.ndarray, name: str, scaling: Literal["column", "common"] = "column"
) -> list[Any]:
    """Linear and kNN results of one set of features (n, d) on a task; `scaling` as in `probe.linear_probe`."""
    if options.leave_out is not None:
        return [
            probe.leave_groups_out(
                values,
                task.labels,
                task.groups,
                name=f"{name}: linear, {options.leave_out} left out",
                scaling=scaling,
                subsets=task.subsets,
            )
        ]
    shared: dict[str, Any] = {"protocol": options.protocol, "seeds": options.seeds, "subsets": task.subsets}
    return [
        probe.linear_probe(
            values, task.labels, task.groups, task.split, name=f"{name}: linear", scaling=scaling, **shared
        ),
        probe.knn_probe(values, task.labels, task.groups, task.split, name=f"{name}: kNN", **shared),
    ]


def read_task(options: Probe, log: Log) -> Task:
    """Rows with a label that pass the filters. Raises UserError on a column that is not there."""
    manifest = manifests.read([str(path) for path in options.data])
    table = manifest.table
    label = _column(table, options.label)
    kept = np.array([value not in (None, "") for value in label])
    if options.where is not None:
        name, least = options.where
        values = _column(table, name)
        try:
            number = np.array([np.nan if v in (None, "") else float(v) for v in values])
        except ValueError:
            raise UserError(f"--where {name}: that column holds words, not numbers") from None
        kept &= number > least
    if options.sensor is not None:
        kept &= text_column(manifest, "sensor") == options.sensor
        if options.sensor not in (there := sorted(set(text_column(manifest, "sensor")))):
            raise UserError(f"no row is of sensor {options.sensor!r}; the manifest has {', '.join(there)}")
    fields = kept & np.isin(text_column(manifest, "sensor"), FIELD_SENSORS)
    if fields.any():
        log(f"{fields.sum()} rows of sensors that measure force fields have no images and are left out")
        kept &= ~fields
    split = text_column(manifest, "split")
    kept &= np.isin(split, ("train", "val", "test"))
    if (options.frames or 1) > 1:
        kept &= np.isin(np.arange(len(manifest)), manifest.clips(options.frames or 1)[:, -1])
    rows = np.flatnonzero(kept)
    if not rows.size:
        raise UserError(f"no row has a label in {options.label!r} after the filters")
    log(f"{len(rows)} of {len(manifest)} rows take part")
    groups = _groups(manifest, options, rows)
    if options.leave_out is None:
        subsets = _subsets(manifest, label, split, rows, "classes")
    else:  # a class of everything says little: it is the things left out that alignment may have named
        subsets = _subsets(manifest, _column(table, options.leave_out), split, rows, f"{options.leave_out}s")
    return Task(manifest, rows, np.array([label[r] for r in rows]), groups, split[rows], subsets)


def _column(table: Any, name: str) -> list[Any]:
    for candidate in (f"label.{name}", name):
        if candidate in table.column_names:
            if pa.types.is_nested(table[candidate].type):
                raise UserError(f"the column {candidate!r} holds lists; a probe wants one value a row")
            values: list[Any] = table[candidate].to_pylist()
            return values
    raise UserError(f"the manifest has no column {name!r} or 'label.{name}'; it has {', '.join(table.column_names)}")


def _has_values(table: Any, name: str) -> bool:
    named = {name, f"label.{name}"} & set(table.column_names)
    return any(value not in (None, "") for one in named for value in table[one].to_pylist())


def _groups(manifest: Any, options: Probe, rows: np.ndarray) -> np.ndarray:
    """The column left out or asked for, else the first of `GROUPS` with a value; the sequence where it is empty."""
    table = manifests.with_distinct_keys(manifest, manifest.table)  # recordings of two files are never one
    sequence = table["sequence"].to_pylist()
    usual = (one for one in GROUPS if one != options.label.removeprefix("label.") and _has_values(table, one))
    asked = options.leave_out or options.group
    name = asked or next(usual, "sequence")
    if name == "sequence" and not asked:
        return np.array([sequence[r] for r in rows])
    column = _column(table, name)
    return np.array([str(column[r]) if column[r] not in (None, "") else f"sequence {sequence[r]}" for r in rows])


def _subsets(manifest: Any, names: list[Any], split: np.ndarray, rows: np.ndarray, what: str) -> dict[str, np.ndarray]:
    """Rows of classes that have a photograph or a caption in train, and the others: alignment may have named them."""
    described = manifest.present("image_path") | manifest.present("text")
    named = {names[r] for r in np.flatnonzero(described & (split == "train"))} - {None, ""}
    mask = np.array([names[r] in named for r in rows])
    if mask.all() or not mask.any():
        return {}
    return {f"{what} with a photograph or caption": mask, f"{what} without": ~mask}


def _features(options: Probe, task: Task, log: Log) -> Any:
    """(name, features, encoder or None) of every encoder and file asked for, then of the controls."""
    files = {str(path): given(path, task.manifest) for path in options.features}
    for store in files.values():
        store.add(task.rows, options.frames or 1)
    encoders: list[tuple[str, Encoder]] = [(str(path), load_encoder(path)) for path in options.run]
    if options.controls:
        config: Config = encoders[0][1].config if encoders else preset("tiny")
        encoders.append(("random encoder", random_encoder(config)))
    for _, encoder in encoders:
        check_frames(encoder.config.model, options.frames or 1)
    for name, encoder in encoders:
        rows, values = embed_rows(encoder, task.manifest, task.rows, options.frames or 1, options.pooling, log=log)
        if not np.array_equal(rows, task.rows):
            raise UserError(f"{len(task.rows) - len(rows)} rows could not be read; repair the manifest first")
        yield name, values, encoder
    for path, store in files.items():
        yield path, store.get(task.rows[:, None], options.frames or 1), None
    if options.controls:
        yield RAW, raw_features(task), None


def raw_features(task: Task) -> np.ndarray:
    """Pixels and their difference from the background, reduced by a PCA fitted on train."""
    grounds: dict[Path, np.ndarray] = {}
    pieces = [baseline.row_pixels(task.manifest, int(row), grounds) for row in task.rows]
    train = task.split == "train"
    return baseline.reduce(np.stack(pieces), train if train.any() else np.ones(len(pieces), bool))
