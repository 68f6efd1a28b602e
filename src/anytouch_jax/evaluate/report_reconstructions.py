"""The report's section on stage 1: reconstructions of masked patches and next frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.images import encode
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.embed import rows_with_gel
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.evaluate.pages import Section
from anytouch_jax.evaluate.reconstruction import contact_errors, reconstruction_panels
from anytouch_jax.evaluate.report_rows import deepest_by_sensor, with_images
from anytouch_jax.evaluate.report_words import Claim
from anytouch_jax.evaluate.tables import as_text, markdown_table
from anytouch_jax.files import atomic_write

_TERMS = {
    "reconstruction": "the error of hidden patches is",
    "next_frame": "the error of the next frame is",
}
_GUESSES = {
    ("untouched ", "reconstruction"): "painting the background",
    ("untouched ", "next_frame"): "painting the background",
    ("plain ", "reconstruction"): "the mean of the visible patches",
    ("plain ", "next_frame"): "a copy of the last frame",
}


def reconstructions_section(
    manifest: Manifest, encoder: Encoder, folder: Path
) -> tuple[Section, dict[str, Any]]:
    """Return masked patches and next frames of stage 1 on a test clip of each sensor.

    The second is its errors.
    """
    config = encoder.config
    params = encoder.params | {"decoder": encoder.part_params("decoder")}
    rows = with_images(manifest, manifest.rows_of("test"))
    frames = config.model.frames + 1
    rows = rows_with_gel(encoder, Backgrounds(manifest), rows, lambda _: None)
    ends = rows[:0]
    # Without clips in training the head for the next frame is untrained.
    if config.objective.next_frame and config.data.clip_fraction > 0:
        ends = np.intersect1d(manifest.clips(frames, "test")[:, -1], rows)
    scores = contact_errors(params, manifest, ends, encoder)
    kind: Literal["still", "clip"] = "clip"
    if len(ends):
        rows = ends
    else:
        kind = "still"
        frames = 1
    rows = deepest_by_sensor(manifest, rows)
    config = replace(config, data=replace(config.data, batch_size=len(rows)))
    _, batch = next(
        iter(evaluation(manifest, rows, config, kind, frames=frames, unknown="universal"))
    )
    image = reconstruction_panels(params, batch.clip, batch.sensor, net=encoder.net, config=config)
    path = folder / "figures" / "reconstructions.png"
    atomic_write(path, encode(image))
    names = ", ".join(map(as_text, manifest.text_column("sensor")[rows]))
    fraction = f"{config.objective.keep_ratio:.0%}".replace("%", " %")
    text = f"Stage 1 reads {fraction} of the patches of a held-out object. From above: {names}."
    title = "Hidden patches"
    table = ""
    if frames > 1:
        title = "Hidden patches and the next frame"
        text = f"{text} The last pair is the next frame and its prediction."
    if scores:
        table = _errors_table(scores)
    return Section(title, text, table, path), scores


def pixel_claims(scores: Mapping[str, Any]) -> list[Claim]:
    """Return what the errors of stage 1 say, each beside the best guess without a model."""
    claims = []
    for term, (best, gain, low, high) in scores.get("gains", {}).items():
        guess = f"{_GUESSES[best, term]} has {scores[best + term]:.4f}"
        if low is not None and high is not None:
            guess += f", {gain:+.4f} [{low:+.4f}, {high:+.4f}] more"
        claims.append(Claim(_TERMS[term], f"{scores[term]:.4f}", guess, low, high))
    return claims


def _errors_table(scores: Mapping[str, Any]) -> str:
    """Return the errors of stage 1 beside those of guesses without a model, as Markdown."""
    kinds = {"": "stage 1"}
    guesses = {
        "untouched ": "the background",
        "plain ": "mean of the visible patches; copy of the last frame",
    }
    for kind, name in guesses.items():
        if f"{kind}reconstruction" in scores:
            kinds[kind] = name
    lines = []
    for term, name in (("reconstruction", "hidden patches"), ("next_frame", "next frame")):
        if term in scores:
            lines.append((name, *(f"{scores[kind + term]:.4f}" for kind in kinds)))
    header = (f"error on {scores['clips']} clips in contact", *kinds.values())
    return markdown_table(header, lines)
