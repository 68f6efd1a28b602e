"""Probes of frozen features: of arrays, a label column, named tasks, or a public benchmark.

A task selects rows and labels. Frames are never augmented. The protocols are those of `splits`:
"grouped" holds out whole groups (objects, recordings), which tasks deal again by every seed, and
"released" keeps the manifest's split and selects on test, as the authors released it.
"""

from anytouch_jax.evaluate.array_probes import leave_groups_out, probe_features
from anytouch_jax.evaluate.label_probes import probe_label
from anytouch_jax.evaluate.label_rows import label_rows
from anytouch_jax.evaluate.options import LabelProbeOptions, ProbeOptions, TaskProbeOptions
from anytouch_jax.evaluate.results import (
    Outcome,
    ProbeResult,
    SubsetResult,
    probe_json,
    probe_table,
)
from anytouch_jax.evaluate.saved_heads import calibrated
from anytouch_jax.evaluate.task_probes import probe_benchmark, probe_tasks

__all__ = [
    "LabelProbeOptions",
    "Outcome",
    "ProbeOptions",
    "ProbeResult",
    "SubsetResult",
    "TaskProbeOptions",
    "calibrated",
    "label_rows",
    "leave_groups_out",
    "probe_benchmark",
    "probe_features",
    "probe_json",
    "probe_label",
    "probe_table",
    "probe_tasks",
]
