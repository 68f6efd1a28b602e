"""The heads that fine-tuning leaves, of classes or of a number, and their calibration."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

from anytouch_jax.encoder.arrays import Array, Log
from anytouch_jax.encoder.calibration import CalibrationRows, calibrate_number
from anytouch_jax.encoder.linear_head import Head, LinearHead, NumberHead
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.saved_heads import calibrated
from anytouch_jax.evaluate.tasks import TaskRows
from anytouch_jax.finetuning.options import FinetuneOptions
from anytouch_jax.finetuning.start import Linear, Parts, Target


class HeadRows(NamedTuple):
    """What a head is made of: its rows, features f32 (n, d) of all of them, and the encoder.

    `tuned` says that the encoder was trained on the rows of `parts.fit`.
    """

    rows: TaskRows
    target: Target
    parts: Parts
    x: Array
    fingerprint: str
    tuned: bool


def make_head(linear: Linear, given: HeadRows, options: FinetuneOptions, log: Log) -> Head:
    """Return the head of a linear function, calibrated, and log what it promises.

    Args:
        linear: weights and bias on scaled features.
        given: rows to calibrate on.
        options: of the training.
        log: takes what the head promises.
    """
    common: dict[str, Any] = {
        "bias": linear.bias,
        "mean": linear.mean,
        "scale": linear.scale,
        "label": options.label.removeprefix("label."),
        "pooling": options.pooling,
        "frames": options.frames,
        "fingerprint": given.fingerprint,
    }
    head: Head
    if given.target.is_number:
        common["bias"] = linear.bias[0]
        head = _calibrated_number(
            NumberHead(weights=linear.weights[:, 0], **common), linear, given, options
        )
    else:
        classes = LinearHead(classes=given.target.names, weights=linear.weights, **common)
        if not given.tuned:
            return _as_probed(classes, linear, given, options, log)
        head = _calibrated_classes(classes, linear, given, options)
    for sentence in head.promises():
        log(sentence)
    return head


def _rows_of(given: HeadRows, logits: Array, y: Array, places: Array) -> CalibrationRows:
    rows = given.rows
    return CalibrationRows(
        logits=logits,
        y=y[places],
        held_out=rows.groups[places],
        features=given.x,
        groups=rows.groups,
        sensors=rows.sensors,
        fit=given.parts.fit,
        val=places,
        tuned=given.tuned,
    )


def _calibrated_classes(
    head: LinearHead, linear: Linear, given: HeadRows, options: FinetuneOptions
) -> LinearHead:
    """Calibrate on the held-out recordings alone: the encoder has seen the labels of the others."""
    places = given.parts.val
    rows = _rows_of(given, linear(given.x[places]), given.rows.labels, places)
    return head.calibrated_on(rows, coverage=options.coverage, false_alarms=options.false_alarms)


def _calibrated_number(
    head: NumberHead, linear: Linear, given: HeadRows, options: FinetuneOptions
) -> NumberHead:
    places = given.parts.val
    rows = _rows_of(given, linear(given.x[places]), given.target.y, places)
    known = calibrate_number(
        rows,
        head.scaled(given.x),
        coverage=options.coverage,
        false_alarms=options.false_alarms,
    )
    return replace(head, calibration=known)


def _as_probed(
    head: LinearHead, linear: Linear, given: HeadRows, options: FinetuneOptions, log: Log
) -> LinearHead:
    """Calibrate a linear head on a frozen encoder as `anytouch probe label --save` does."""
    split = given.rows.split.copy()
    split[given.parts.fit] = "train"
    split[given.parts.val] = "val"
    rows = given.rows._replace(split=split)
    try:
        return calibrated(
            head,
            given.x,
            rows,
            linear.penalty,
            log,
            coverage=options.coverage,
            false_alarms=options.false_alarms,
        )
    except UserError as error:
        log(f"The head has no calibration: {error}")
        return head
