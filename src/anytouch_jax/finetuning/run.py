"""One fine-tuning from a manifest to a folder: read, fit the linear head, train on, calibrate."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.arrays import Array, Log
from anytouch_jax.encoder.encoder import Encoder, check_frames, load_encoder
from anytouch_jax.encoder.linear_head import Head
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.finetuning import folder, heads, start, training
from anytouch_jax.finetuning.options import FinetuneOptions, State, Watch
from anytouch_jax.finetuning.pictures import Touches, read_touches
from anytouch_jax.finetuning.rows import Chosen, choose_rows
from anytouch_jax.shown import shown_short

# Of the time that features took at first: they are computed again at the end.
_RESERVE = 1.3


@shown_short
@dataclass(frozen=True, eq=False)
class Finetuned:
    """What `finetune` leaves.

    Attributes:
        folder: what `load_encoder` and `load_head` read.
        head: of classes or of a number.
        improved: whether head and encoder beat the linear head on the held-out recordings. If not,
            the folder has that head, and the encoder as it was.
        before: the held-out score of the linear head, 0..1, or minus the mean absolute error.
        after: that of the result.
        test: what is known of split test: `before` and `after`, with the 95 % interval of the
            difference over groups. None without such a split.
        sentence: all of it for a user.
    """

    folder: Path
    head: Head
    improved: bool
    before: float
    after: float
    test: dict[str, Any] | None
    sentence: str


def finetune(
    data: str | Path | Sequence[str | Path],
    label: str | None = None,
    *,
    out: str | Path,
    model: str | Path = "anytouch-tiny",
    options: FinetuneOptions | None = None,
    log: Log = print,
    watch: Watch | None = None,
    ended: Callable[[], bool] = lambda: False,
    **changes: Any,
) -> Finetuned:
    """Train an encoder and a head on the labels of a manifest, and write both to a folder.

    It starts from a linear head on the frozen encoder, and keeps whole recordings out. What scores
    best on these is written, which is the linear head with the encoder as it was if nothing is
    better. Ctrl-C ends the training and keeps the best so far.

    Args:
        data: manifests.
        label: the column, "object" by default.
        out: the folder, missing or empty.
        model: what `load_encoder` takes, an encoder of AnyTouch.
        options: all settings.
        log: takes sentences.
        watch: gets the time left and the held-out scores, every few seconds.
        ended: ends the training once it is True, as Ctrl-C does.
        changes: settings by name, such as `minutes=2`: fields of `FinetuneOptions`.

    Raises:
        UserError: rows that cannot be learned from, an encoder that cannot be trained, or a folder
            that has files.
    """
    begun = time.monotonic()
    refuse_forked()
    if label is not None:
        changes["label"] = label
    options = replace(options or FinetuneOptions(), **changes)
    if not 0 < options.minutes < 1e6:
        raise UserError(f"minutes must be above 0, not {options.minutes:g}.")
    out = Path(out)
    folder.check_new(out)
    paths = [data] if isinstance(data, str | Path) else data
    table = manifests.read([str(path) for path in paths])
    encoder = trainable(model)
    check_frames(encoder.config.model, options.frames)
    backgrounds = Backgrounds(table)
    chosen = choose_rows(table, encoder, backgrounds, options, log)
    touches = read_touches(encoder, table, chosen.ids, options.frames, backgrounds, log)
    clock = Clock(begun + 60 * options.minutes, watch)
    result = _tuned(encoder, touches, chosen, options, clock, ended, log)
    head = heads.make_head(result.linear, result.given, options, log)
    if encoder.subtracts:
        head = replace(head, backgrounds=backgrounds.images(chosen.ids))
    test = _test(result, chosen)
    sentence = _sentence(result, chosen, str(model))
    about = {
        "model": str(model),
        "label": head.label,
        "touches": len(chosen.parts.fit),
        "held_out": chosen.parts.what,
        "improved": result.improved,
        "before": result.before._asdict(),
        "after": result.after._asdict(),
        "seconds": round(time.monotonic() - begun, 1),
        "manifest": table.content_hash,
        "options": asdict(options),
        "sentence": sentence,
    }
    if test is not None:
        about["test"] = test
        sentence += f" {test['sentence']}"
    folder.write_folder(out, result.encoder, head, about)
    log(sentence)
    return Finetuned(
        out, head, result.improved, result.before.shown, result.after.shown, test, sentence
    )


def trainable(model: str | Path) -> Encoder:
    """Load an encoder that can be fine-tuned, in float32.

    Raises UserError for one of another family, and for an export.
    """
    encoder = load_encoder(model, engine="xla")
    if type(encoder) is not Encoder:
        raise UserError(
            f"{model} cannot be fine-tuned: name an encoder of AnyTouch, or fit a head on its "
            "frozen features with `anytouch probe label --save`."
        )
    return encoder.computed_in("float32")


class Clock(NamedTuple):
    """The end of a run as `time.monotonic`, and who watches."""

    until: float
    watch: Watch | None

    def show(self, score: str = "", before: str = "") -> None:
        """Report the time left and the scores."""
        if self.watch is not None:
            self.watch(State(training.time_left(self.until), score, before))


class _Result(NamedTuple):
    """An encoder as it is stored, its head, and the features (n, d) before and after."""

    encoder: Encoder
    linear: start.Linear
    given: heads.Given
    improved: bool
    before: start.Held
    after: start.Held
    first: start.Linear
    x: Array
    note: str


def _tuned(
    encoder: Encoder,
    touches: Touches,
    chosen: Chosen,
    options: FinetuneOptions,
    clock: Clock,
    ended: Callable[[], bool],
    log: Log,
) -> _Result:
    """Fit the linear head, train from it, and return whichever is better."""
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

    def watch(done: float, best: training.Best) -> None:
        clock.show(best.score.text(target), words)

    best = training.Best(before, before)
    note = ""
    if until <= time.monotonic():
        note = "There was no time left to train: give more --minutes."
    else:
        task = training.Task(encoder, touches, target, parts, begin.first, before)
        best = training.train(task, options, until, watch, ended)
    kept = _Result(
        encoder=encoder,
        linear=linear,
        given=heads.Given(chosen.rows, target, parts, x, encoder.fingerprint, tuned=False),
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


def _sentence(result: _Result, chosen: Chosen, model: str) -> str:
    """Return what came of it, for a user."""
    before = result.before.text(chosen.target)
    if result.improved:
        return (
            f"On held-out recordings ({chosen.parts.what}) fine-tuning has "
            f"{result.after.text(chosen.target)}, the linear head on the frozen encoder {before}."
        )
    return (
        f"{result.note or 'Fine-tuning was not better on held-out recordings.'} The folder has the "
        f"linear head ({before}) and the encoder of {model} as it was."
    )


def _test(result: _Result, chosen: Chosen) -> dict[str, Any] | None:
    """Return the scores of both on split test, paired by group, or None without one."""
    places = chosen.parts.test
    if not len(places):
        return None
    target = chosen.target
    groups = chosen.rows.groups[places]
    first = start.right_rows(result.first(result.x[places]), target, places)
    last = start.right_rows(result.linear(result.given.x[places]), target, places)
    before = _group_mean(first, groups)
    after = _group_mean(last, groups)
    low, high = mean_interval(last - first, groups)
    about = {"before": before, "after": after, "low": low, "high": high}
    about["groups"] = len(np.unique(groups))
    unit = 1.0 if target.is_number else 100.0
    change = f"{unit * (after - before):+.3g}"
    if low is not None and high is not None:
        change += f" [{unit * low:+.3g}, {unit * high:+.3g}]"
    about["sentence"] = (
        f"On split test ({about['groups']} groups): {unit * after:.3g}, the linear head "
        f"{unit * before:.3g}, difference {change}."
    )
    return about


def _group_mean(values: Array, groups: Array) -> float:
    numbers = np.unique(groups, return_inverse=True)[1]
    return float((np.bincount(numbers, values) / np.bincount(numbers)).mean())
