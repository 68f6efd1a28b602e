"""The rows of a manifest that take part in fine-tuning."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Array, Log
from anytouch_jax.encoder.base import Encoder
from anytouch_jax.evaluate import sources
from anytouch_jax.evaluate.label_rows import labelled_rows, task_of
from anytouch_jax.evaluate.options import LabelProbeOptions
from anytouch_jax.evaluate.tasks import TaskRows
from anytouch_jax.finetuning.options import FinetuneOptions
from anytouch_jax.finetuning.start import Parts, Target, deal_parts, target_of

# More are not seen often enough in an hour of two cores, and would fill the memory.
MOST_ROWS = 20_000


class Chosen(NamedTuple):
    """The rows that take part, what is predicted, and which are held out.

    `ids` (n,) are their numbers in the manifest.
    """

    rows: TaskRows
    ids: Array
    target: Target
    parts: Parts


def choose_rows(
    table: Manifest, encoder: Encoder, backgrounds: Backgrounds, options: FinetuneOptions, log: Log
) -> Chosen:
    """Return the rows with a label, and log how they are used.

    Args:
        table: the manifest.
        encoder: which may need a background.
        backgrounds: backgrounds of the sensor instances.
        options: those of the run.
        log: takes sentences.

    Raises:
        UserError: nothing can be learned, or nothing held out.
    """
    probe = LabelProbeOptions(
        label=options.label,
        group=options.group,
        where=options.where,
        sensor=options.sensor,
        frames=options.frames,
        regression=options.regression,
    )
    task = task_of(table, probe)
    rows = sources.with_gel(labelled_rows(table, task, probe), backgrounds, [encoder])
    count = len(rows.rows)
    if count > MOST_ROWS:
        rows = rows.take(_thinned(rows.groups))
        log(f"{len(rows.rows)} of {count} touches are used, evenly from each group")
    is_number = task.kind == "regression"
    parts = deal_parts(rows, is_number)
    target = target_of(rows, parts, is_number)
    ids = rows.rows[:, 0]
    for note in rows.notes:
        log(note)
    if encoder.subtracts:
        log(backgrounds.report(ids))
    what = f"{len(target.names)} classes" if not is_number else "a number"
    log(
        f"{task.label}: {what}, {len(parts.fit)} touches to train on, {len(parts.val)} held out "
        f"({parts.what}), {len(parts.test)} to test"
    )
    return Chosen(rows, ids, target, parts)


def _thinned(groups: Array) -> Array:
    """Return places of MOST_ROWS rows: every group loses the same part of its frames."""
    order = np.argsort(groups, kind="stable")
    return np.sort(order[np.linspace(0, len(order) - 1, MOST_ROWS).astype(int)])
