"""`anytouch retrieve`: the same touch by another sensor, among touches that resemble it in place, depth and force."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markdown import Markdown

from anytouch_jax.cli.options import Retrieve
from anytouch_jax.cli.output import check_folder
from anytouch_jax.cli.unused import refuse
from anytouch_jax.cli.words import log
from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.config.parsing import COUNT, Range, in_range
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

if TYPE_CHECKING:
    from anytouch_jax.encoder.encoder import Encoder


def run(options: Retrieve) -> int:
    """Score cross-sensor retrieval of frozen features, print a table, write JSON when asked."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.encoder import embed as embedding
    from anytouch_jax.encoder import encoder as features
    from anytouch_jax.evaluate import retrieval
    from anytouch_jax.evaluate.contacts import contact_vector, deepest_rows
    from anytouch_jax.evaluate.feature_cache import background_difference
    from anytouch_jax.evaluate.report import PIXELS, VECTOR
    from anytouch_jax.evaluate.statistics import markdown_table, plain
    from anytouch_jax.train.mesh import enable_compilation_cache

    least = Range(2, math.inf, "2 or more, the touch and at least one other")
    in_range("--", options, gallery=least, frames=COUNT, seeds=COUNT)
    if not options.by_chance:
        refuse(options, ("seeds",), "without --by-chance: what resembles a touch most is not drawn")
    if options.out is not None:
        check_folder(options.out, read=(options.data, *options.run))
    enable_compilation_cache()
    encoders = _encoders(options)
    for encoder in encoders.values():
        features.check_frames(encoder.config.model, options.frames)
    table = manifests.read(options.data)
    rows = table.rows_of(options.split)
    rows = rows[~np.isin(embedding.text_column(table, "sensor")[rows], FIELD_SENSORS)]
    rows = deepest_rows(table, rows, frames=options.frames)
    asked: dict[str, Any] = {
        "gallery_size": options.gallery, "match": None if options.by_chance else retrieval.COVARIATES,
        "seeds": options.seeds,
    }  # fmt: skip
    retrieval.cross_sensor_retrieval(table, {}, rows, **asked)  # a gallery that cannot be is told before the work
    found: dict[str, Any] = {}
    for name, encoder in encoders.items():
        kept, found[name] = embedding.embed_rows(encoder, table, rows, options.frames, options.pooling, log=log)
        if len(kept) < len(rows):
            raise UserError(f"{len(rows) - len(kept)} of {len(rows)} rows could not be read; repair the manifest first")
    if options.controls:
        for name, make in ((PIXELS, background_difference), (VECTOR, contact_vector)):
            try:
                found[name] = make(table, rows)
            except UserError as error:
                log(f"no control by {name}: {error}")
    scored = retrieval.cross_sensor_retrieval(table, found, rows, metrics={VECTOR: "euclidean"}, **asked)
    head = ("features", "query", "gallery", "centred", "top-1", "95 %", "top-5", "chance", "of", "queries")
    text = markdown_table(head, [_row(one) for one in scored])
    Console().print(Markdown(text)) if Console().is_terminal else print(text)
    for note in dict.fromkeys(note for one in scored for note in one.notes):
        log(note)
    if options.out is not None:
        about = {"data": table.content_hash, "split": options.split, "frames": options.frames}
        atomic_write(options.out, json.dumps(about | {"results": plain(scored)}, indent=2) + "\n")
    return 0


def _encoders(options: Retrieve) -> dict[str, Encoder]:
    from anytouch_jax.encoder import encoder as features

    encoders = {str(run): features.load_encoder(run) for run in options.run}
    if options.controls and encoders:
        encoders["random encoder"] = features.random_encoder(next(iter(encoders.values())).config)
    if not encoders and not options.controls:
        raise UserError("nothing to compare: give --run, or leave the controls on")
    return encoders


def _row(one: Any) -> tuple[str, ...]:
    interval = "-" if one.low is None else f"{100 * one.low:.1f} to {100 * one.high:.1f}"
    shares = (f"{100 * one.top1:.1f} %", interval, f"{100 * one.top5:.1f} %", f"{100 * one.chance1:.1f} %")
    return (
        one.name, one.query_sensor, one.gallery_sensor, "yes" if one.centred else "no", *shares, str(one.gallery),
        str(one.queries),
    )  # fmt: skip
