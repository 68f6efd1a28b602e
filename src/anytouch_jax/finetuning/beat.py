"""The linear head on the frozen encoder, and whether training beats it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax

from anytouch_jax.encoder.arrays import Array, Log
from anytouch_jax.encoder.base import Encoder
from anytouch_jax.encoder.linear_head import Head
from anytouch_jax.finetuning import heads, start, training
from anytouch_jax.finetuning.images import Touches
from anytouch_jax.finetuning.options import FinetuneOptions, State, Watch
from anytouch_jax.finetuning.rows import Chosen

# Of the time that features took at first: they are computed again at the end.
_RESERVE = 1.3


class Clock(NamedTuple):
    """The end of a run as `time.monotonic`, and who watches."""

    until: float
    watch: Watch | None

    def show(self, score: str = "", before: str = "", looks: int = 0) -> None:
        """Report the time left and the scores."""
        if self.watch is not None:
            self.watch(State(training.time_left(self.until), score, before, looks))


class TuneResult(NamedTuple):
    """An encoder as it is stored, its head, and the features (n, d) before and after."""

    encoder: Encoder
    linear: start.Linear
    given: heads.HeadRows
    improved: bool
    before: start.Held
    after: start.Held
    first: start.Linear
    x: Array
    note: str


def tune(
    encoder: Encoder,
    touches: Touches,
    chosen: Chosen,
    options: FinetuneOptions,
    clock: Clock,
    ended: Callable[[], bool],
    log: Log,
) -> TuneResult:
    """Fit the linear head, train from it, and return whichever is better.

    Args:
        encoder: that is trained from.
        touches: features, labels and frames of all rows.
        chosen: the target and the parts of the rows.
        options: of the training.
        clock: knows when the time is over, and shows the progress.
        ended: says whether the user has asked to end.
        log: takes a sentence on each part.
    """
    target = chosen.target
    parts = chosen.parts
    clock.show()
    begun = time.monotonic()
    run = jax.jit(encoder.traceable(options.pooling))
    x = training.compute_features(run, encoder.params, touches)
    spent = time.monotonic() - begun
    begin = start.linear_start(x, target, parts)
    linear = begin.linear
    before = begin.score
    words = before.text(target)
    log(f"linear head on the frozen encoder: {words} on the held-out recordings")
    clock.show(words, words)
    until = clock.until - _RESERVE * spent

    def watch(best: training.Best) -> None:
        clock.show(best.score.text(target), words, best.looks)

    best = training.Best(before, before)
    note = ""
    if until <= time.monotonic():
        note = "There was no time left to train: give more --minutes."
    else:
        task = training.TuningTask(encoder, touches, target, parts, begin.first, before)
        best = training.train(task, options, until, watch, ended)
    kept = TuneResult(
        encoder=encoder,
        linear=linear,
        given=heads.HeadRows(chosen.rows, target, parts, x, encoder.fingerprint, tuned=False),
        improved=False,
        before=before,
        after=before,
        first=linear,
        x=x,
        note=note,
    )
    if best.encoder is None or best.head is None:
        return kept
    tuned = replace(encoder, params=best.encoder)
    z = training.compute_features(run, tuned.params, touches)
    after = start.held_score(best.head(z[parts.val]), target, parts.val)
    # Looks see only a part of many held-out touches.
    if not after.beats(before):
        return kept
    return kept._replace(
        encoder=tuned,
        linear=best.head,
        given=kept.given._replace(x=z, fingerprint=tuned.fingerprint, tuned=True),
        improved=True,
        after=after,
    )


def head_of(result: TuneResult, options: FinetuneOptions, log: Log) -> Head:
    """Return the head of a result, calibrated."""
    return heads.make_head(result.linear, result.given, options, log)
