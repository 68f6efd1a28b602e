"""Report sections on data and training: how much there is, samples, and losses."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import read_file, unpack_npy
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import plots
from anytouch_jax.evaluate.pages import Section
from anytouch_jax.evaluate.report_rows import grades_of
from anytouch_jax.evaluate.retrieval import deepest_rows
from anytouch_jax.evaluate.tables import as_text, markdown_table

_SHOWN = 5  # touches in a sample grid


def facts_section(table: Manifest, first: Encoder, second: Encoder, lineage: str) -> Section:
    """Return how much data of which sensors there is, and how both runs were trained."""
    split = table.text_column("split")
    objects = table.text_column("object")
    touch = table.codes("touch", own=True)
    sensors = table.text_column("sensor")
    rows = []
    for name in manifests.SPLITS:
        part = split == name
        if part.any():
            touches = len(np.unique(touch[part & (touch >= 0)]))
            things = len(set(objects[part]) - {""})
            listed = ", ".join(sorted(set(sensors[part])))
            rows.append((name, part.sum(), touches, things, listed))
    text = (
        f"Data {table.content_hash[:12]}. Stage 1: preset {first.config.preset}, "
        f"{first.config.run.steps} steps of {first.config.data.batch_size}. Stage 2: "
        f"{second.config.run.steps} steps of {second.config.data.batch_size}, recipe "
        f"{second.config.recipe}, towers {second.config.towers}. All figures below are of split "
        "test."
    )
    backgrounds = (first.config.data.background, second.config.data.background)
    if backgrounds[0] != backgrounds[1]:
        lineage += (
            f" Stage 1 was trained with background {backgrounds[0]}, stage 2 with background "
            f"{backgrounds[1]}."
        )
    counted = markdown_table(("split", "frames", "touches", "objects", "sensors"), rows)
    notes = ""
    if lineage:
        notes = f"**{lineage.strip()}**"
    return Section("Data and runs", text, counted, notes=notes)


def samples_section(manifest: Manifest, folder: Path, *, seed: int = 0) -> list[Section]:
    """Return a section for each grade of alignment: images of touches, and captions.

    An image has a touch a row and a sensor a column.
    """
    rows = deepest_rows(manifest)
    sections = []
    grades = grades_of(manifest, rows, "")
    for grade in np.unique(grades):
        part = rows[grades == grade]
        sensor = manifest.text_column("sensor")[part]
        touch = manifest.codes("touch", own=True)[part]
        objects = manifest.text_column("object")[part]
        names = np.unique(sensor).tolist()
        images = []
        titles = []
        captions = []
        for code in _varied_touches(touch, sensor, objects, seed):
            row_of = {str(sensor[i]): int(part[i]) for i in np.flatnonzero(touch == code)[::-1]}
            texts = [manifest.value(row, "text") for row in row_of.values()]
            pictured = [
                row for row in row_of.values() if manifest.value(row, "image_path") is not None
            ]
            photo = None
            if pictured:
                photo = decode(manifest.file(pictured[0], "image_path"))
            images.append([_image(manifest, row_of.get(name)) for name in names] + [photo])
            titles.append(str(objects[touch == code][0]) or f"touch {code}")
            captions.append(next((" ".join(text.split()) for text in texts if text), "no caption"))
        name = "samples"
        title = "Samples"
        if grade:
            name = re.sub(r"[^\w]", "_", f"samples_{grade}")
            title = f"Samples, {as_text(grade)}"
        path = folder / "figures" / f"{name}.png"
        plots.sample_grid(path, images, titles, [*names, "photograph"])
        notes = []
        for number, (thing, caption) in enumerate(zip(titles, captions, strict=True), 1):
            notes.append(f"{number}. *{as_text(thing)}*: {as_text(caption)}")
        text = (
            "Rows are touches, columns are sensors, each at the deepest frame. Captions are below."
        )
        sections.append(Section(title, text, figure=path, notes="\n".join(notes)))
    return sections


def _varied_touches(touch: Array, sensor: Array, objects: Array, seed: int) -> list[int]:
    """Return the touches by most sensors, one per object before any object comes again."""
    codes, first = np.unique(touch, return_index=True)
    sensors = np.array([len(set(sensor[touch == code])) for code in codes])
    order = np.lexsort((np.random.default_rng(seed).random(len(codes)), -sensors))
    names = objects[first[order]]
    came_before = [np.sum(names[:place] == name) for place, name in enumerate(names)]
    return codes[order[np.argsort(came_before, kind="stable")]][:_SHOWN].tolist()


def _image(manifest: Manifest, row: int | None) -> Array | None:
    """Return the frame of a row, None without a row.

    Of a force-field sensor it is the length of its displacement (three channels) in mm.
    """
    if row is None:
        return None
    if manifest.value(row, "sensor") not in FIELD_SENSORS:
        return decode(manifest.file(row))
    column = "field_path" if manifest.value(row, "field_path") is not None else "path"
    try:
        field = unpack_npy(read_file(manifest.file(row, column)))
    except ValueError as error:
        raise UserError(
            f"{manifest.where(row)}, column {column!r}, is no field of forces: {error}."
        ) from None
    if field.ndim == 3:
        return np.linalg.norm(field[..., :3], axis=-1)
    return field


def losses_section(runs: Mapping[str, Path], folder: Path) -> Section:
    """Return the loss curves of runs {title: run folder}, and where each term began and ended."""
    path = folder / "figures" / "losses.png"
    rows = []
    plots.loss_curves(path, runs)
    for title, run in runs.items():
        lines = plots.read_metrics(run)
        for name in plots.TERMS:
            values = np.array([line[name] for line in lines if line.get(name) is not None])
            if len(values):
                smooth = plots.smoothed(values)
                ends = (f"{smooth[0]:.3f}", f"{smooth[-1]:.3f}")
                rows.append((title, name.replace("_", " "), len(lines), *ends))
    table = markdown_table(("run", "term", "steps", "at the start", "at the end"), rows)
    return Section(
        "Losses", "Pale: each step. Strong: running mean over a twentieth of the run.", table, path
    )
