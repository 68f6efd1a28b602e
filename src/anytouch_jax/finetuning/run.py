"""One fine-tuning from a manifest to a folder: read, fit the linear head, train on, calibrate."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.encoder.linear_head import Head
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.finetuning import folder, report
from anytouch_jax.finetuning.beat import Clock, head_of, tune
from anytouch_jax.finetuning.images import read_touches, trainable
from anytouch_jax.finetuning.options import FinetuneOptions, Watch
from anytouch_jax.finetuning.rows import choose_rows
from anytouch_jax.shown import shown_short


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
    folder.refuse_filled(out)
    paths = [data] if isinstance(data, str | Path) else data
    table = manifests.read([str(path) for path in paths])
    encoder = trainable(model, options.frames)
    backgrounds = Backgrounds(table)
    chosen = choose_rows(table, encoder, backgrounds, options, log)
    touches = read_touches(encoder, table, chosen.ids, options.frames, backgrounds, log)
    clock = Clock(begun + 60 * options.minutes, watch)
    result = tune(encoder, touches, chosen, options, clock, ended, log)
    head = head_of(result, options, log)
    if encoder.subtracts:
        head = replace(head, backgrounds=backgrounds.images(chosen.ids))
    test = report.scores_on_test(result, chosen)
    sentence = report.sentence_of(result, chosen, str(model))
    about: dict[str, Any] = {
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
