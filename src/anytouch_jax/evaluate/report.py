"""The report of two runs on a manifest: sections of text, figures and tables in one Markdown file,
numbers as JSON.
"""

import base64
import html
import json
import re
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.background.contact import known_contact
from anytouch_jax.data.background.rule import UnitGels
from anytouch_jax.data.images import decode, encode
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import read_file, unpack_npy
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.encoder.embed import embed_rows, rows_with_gel
from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import plots, probing, retrieval, statistics
from anytouch_jax.evaluate.feature_cache import RANDOM, background_difference, principal_components
from anytouch_jax.evaluate.heads import ProbeHead
from anytouch_jax.evaluate.plots import ShareBar
from anytouch_jax.evaluate.probing import ProbeResult
from anytouch_jax.evaluate.reconstruction import pixel_scores, reconstruction_panels
from anytouch_jax.evaluate.retrieval import contact_vector, deepest_rows
from anytouch_jax.evaluate.statistics import Array
from anytouch_jax.evaluate.tasks import best_rows
from anytouch_jax.files import atomic_write
from anytouch_jax.progress import tracked

Change = tuple[float, float | None, float | None]  # a difference with its interval

PIXELS = "pixels minus background"
VECTOR = "area, centroid, force"
LABELS = ("hardness", "roughness", "material", "indenter", "force")
FEWEST = 4  # rows of a t-SNE
_T_SNE_ROWS = 800
_CLIPS = 240  # on which reconstruction errors are measured
_SHOWN = 5  # touches in a sample grid


@dataclass(frozen=True)
class Section:
    """A part of a report, in this order: text, figure, table (Markdown), notes."""

    title: str
    text: str = ""
    table: str = ""
    figure: Path | None = None
    notes: str = ""


def write_report(
    folder: Path,
    sections: Sequence[Section],
    *,
    title: str = "Report",
    numbers: Mapping[str, Any] | None = None,
) -> Path:
    """Write `folder`/report.html, report.md, report.json (`numbers`) and the figures, and return
    the path of report.md.

    Each file is written atomically, report.md last. Raises UserError for a missing figure, OSError
    for a full disk.
    """
    parts = [f"# {title}"]
    for section in sections:
        parts += [f"## {section.title}", section.text]
        if section.figure is not None:
            if not section.figure.is_file():
                raise UserError(
                    f"There is no figure {section.figure} for the report. Draw it first, or leave "
                    "it out."
                )
            atomic_write(folder / "figures" / section.figure.name, section.figure.read_bytes())
            parts.append(f"![{section.title}](figures/{section.figure.name})")
        parts += [section.table, section.notes]
    if numbers is not None:
        atomic_write(
            folder / "report.json",
            json.dumps(statistics.plain(numbers), indent=2, allow_nan=False) + "\n",
        )
    text = "\n\n".join(part.strip() for part in parts if part) + "\n"
    atomic_write(folder / "report.html", html_page(text, folder, title))
    atomic_write(folder / "report.md", text)
    return folder / "report.md"


def html_page(text: str, folder: Path, title: str) -> str:
    """Return Markdown as one HTML page, pictures of `folder`/figures inside; its HTML is text, and
    no script runs.
    """
    from markdown_it import MarkdownIt

    def inside(match: re.Match[str]) -> str:
        path = folder / "figures" / match[1]
        data = path.read_bytes() if path.suffix == ".png" and path.is_file() else b""
        return f'src="data:image/png;base64,{base64.b64encode(data).decode()}"'

    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(text)
    body = re.sub(r'src="figures/([^"/\\]+)"', inside, body)
    style = (
        "body{font:16px/1.5 sans-serif;max-width:60rem;margin:2rem auto;padding:0 "
        "1rem}img{max-width:100%}"
        "table{border-collapse:collapse;display:block;overflow-x:auto}td,th{border:1px solid "
        "#ccc;padding:.2em .6em}"
    )
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; "
        "form-action 'none'"
    )
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">'
        f'<meta name="viewport" content="width=device-width"><title>{html.escape(title)}</title>'
    )
    return f'<!doctype html>\n<html lang="en"><head>{head}<style>{style}</style></head>\n<body>{body}</body></html>\n'


def demo_report(
    manifest: str | Path,
    stage1: str | Path,
    stage2: str | Path,
    out: str | Path,
    log: Log = print,
    *,
    touches: int = 200,
    gallery_size: int = retrieval.GALLERY,
    seed: int = 0,
) -> Path:
    """Write a report of two runs on the split test of a manifest, and return the path of report.md.

    `touches` is the most of test, and half of it of train and of val, each with its deepest frame.
    A report that fails leaves an earlier one in `out` unchanged. Raises UserError, also for a run
    of the other stage and for weights files.
    """
    clock = time.perf_counter()
    table = manifests.read(manifest)
    if (count := len(_chosen(table, "test", touches, seed))) < FEWEST:
        raise UserError(
            f"The report needs {FEWEST} frames of deepest contact. The split test gives {count} "
            "with --touches "
            f"{touches}, {len(_chosen(table, 'test', len(table), seed))} at most. Give more "
            "touches."
        )
    runs = {"stage 1": Path(stage1), "stage 2": Path(stage2)}
    first, second = (_encoder_of_stage(run, stage) for stage, run in enumerate(runs.values(), 1))
    numbers: dict[str, Any] = {"manifest": str(manifest), "data": table.content_hash}
    numbers |= {name.replace(" ", ""): str(run) for name, run in runs.items()}
    double = first.config.model.dtype == "float64"
    with tempfile.TemporaryDirectory(prefix="anytouch-report-") as folder, jax.enable_x64(double):
        drawn = Path(folder)
        sections = [_facts(table, first, second, _lineage(runs["stage 1"], second))]
        sections += [*samples_section(table, drawn, seed=seed), _losses(runs, drawn)]
        parts: dict[str, tuple[Section, Any]] = {
            "pixels": reconstructions_section(table, first, drawn)
        }
        log("report: samples, losses and reconstructions are drawn")
        encoders = {RANDOM: random_encoder(first.config, seed), "stage 1": first, "stage 2": second}
        study = _study(table, encoders, touches, seed, log)
        log(f"report: {len(study.rows)} frames embedded by {len(encoders)} encoders")
        parts |= {
            "space": _space(study, drawn, seed),
            "retrieval": _retrieval(study, drawn, gallery_size),
        }
        log("report: t-SNE is drawn, retrieval is scored")
        parts |= {"matching": _matching(study, second), "probes": _probes(study, drawn)}
        sections += [section for section, _ in parts.values()]
        numbers |= {name: scored for name, (_, scored) in parts.items()}
        numbers["seconds"] = round(time.perf_counter() - clock, 1)
        path = write_report(Path(out), sections, title="What the demo learned", numbers=numbers)
    log(f"{path}: written in {numbers['seconds']:.0f} s")
    return path


def _encoder_of_stage(run: Path, stage: int) -> Encoder:
    """Return the encoder of a run.

    Raises UserError for a weights file, which has no losses, and for another stage.
    """
    if run.is_file():
        raise UserError(
            f"--stage{stage} {run} is a weights file. Give the folder of a run of stage {stage}."
        )
    encoder = load_encoder(run)
    if encoder.config.stage != stage:
        meant = (
            "the stage 1 from which stage 2 started"
            if stage == 1
            else "a stage 2 that started from stage 1"
        )
        raise UserError(
            f"--stage{stage} {run} is a run of stage {encoder.config.stage}. Give {meant}."
        )
    return encoder


def _lineage(stage1: Path, second: Encoder) -> str:
    """Return a sentence if stage 2 did not start from this stage 1, else nothing."""
    init = (second.metadata.get("source") or {}).get("init")
    if init is None:
        return "Stage 2 started from no run, so this stage 1 is no part of it."
    began = Path(init)
    same = began.resolve() == stage1.resolve() or (
        not began.exists() and began.name == stage1.resolve().name
    )
    name = statistics.as_text(began.name)
    if same:
        return ""
    return f"Stage 2 started from another run ({name}), so this stage 1 is no part of it."


def _facts(table: Manifest, first: Encoder, second: Encoder, lineage: str) -> Section:
    split = table.text_column("split")
    objects = table.text_column("object")
    touch = table.codes("touch", own=True)
    sensors = table.text_column("sensor")
    rows = []
    for name in manifests.SPLITS:
        part = split == name
        if part.any():
            counts = (
                part.sum(),
                len(np.unique(touch[part & (touch >= 0)])),
                len(set(objects[part]) - {""}),
            )
            rows.append((name, *counts, ", ".join(sorted(set(sensors[part])))))
    text = (
        f"Data {table.content_hash[:12]}. Stage 1: preset {first.config.preset}, "
        f"{first.config.run.steps} steps of "
        f"{first.config.data.batch_size}. Stage 2: {second.config.run.steps} steps of "
        f"{second.config.data.batch_size}, "
        f"recipe {second.config.recipe}, towers {second.config.towers}. All figures below are of "
        "split test."
    )
    backgrounds = (first.config.data.background, second.config.data.background)
    if backgrounds[0] != backgrounds[1]:
        lineage += f" Stage 1 was trained with background {backgrounds[0]}, stage 2 with background {backgrounds[1]}."
    counted = statistics.markdown_table(("split", "frames", "touches", "objects", "sensors"), rows)
    return Section(
        "Data and runs", text, counted, notes=f"**{lineage.strip()}**" if lineage else ""
    )


def samples_section(manifest: Manifest, folder: Path, *, seed: int = 0) -> list[Section]:
    """Return a section for each grade of alignment: pictures with a touch a row and a sensor a
    column, and captions.
    """
    rows = deepest_rows(manifest)
    sections = []
    grades = _grades(manifest, rows, "")
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
            photo = decode(manifest.file(pictured[0], "image_path")) if pictured else None
            images.append([_picture(manifest, row_of.get(name)) for name in names] + [photo])
            titles.append(str(objects[touch == code][0]) or f"touch {code}")
            captions.append(next((" ".join(text.split()) for text in texts if text), "no caption"))
        suffix = "".join(letter if letter.isalnum() else "_" for letter in f"_{grade}" if grade)
        path = folder / "figures" / f"samples{suffix}.png"
        plots.sample_grid(path, images, titles, [*names, "photograph"])
        lines = zip(*(map(statistics.as_text, texts) for texts in (titles, captions)), strict=True)
        notes = "\n".join(
            f"{i}. *{title}*: {caption}" for i, (title, caption) in enumerate(lines, 1)
        )
        text = (
            "Rows are touches, columns are sensors, each at the deepest frame. Captions are below."
        )
        title = f"Samples{', ' if grade else ''}{statistics.as_text(grade)}"
        sections.append(Section(title, text, figure=path, notes=notes))
    return sections


def _grades(table: Manifest, rows: Array, default: str) -> Array:
    known = "grade" in table.table.column_names
    if known:
        return table.text_column("grade")[rows]
    return np.full(len(rows), default)


def _varied_touches(touch: Array, sensor: Array, objects: Array, seed: int) -> list[int]:
    """Return the touches by most sensors, one per object before any object comes again."""
    codes, first = np.unique(touch, return_index=True)
    sensors = np.array([len(set(sensor[touch == code])) for code in codes])
    order = np.lexsort((np.random.default_rng(seed).random(len(codes)), -sensors))
    names = objects[first[order]]
    # how often the object came before
    turn = [np.sum(names[:place] == name) for place, name in enumerate(names)]
    return codes[order[np.argsort(turn, kind="stable")]][:_SHOWN].tolist()


def _picture(manifest: Manifest, row: int | None) -> Array | None:
    """Return the frame of a row; of a force-field sensor the length of its displacement (three
    channels), mm.
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


def _losses(runs: Mapping[str, Path], folder: Path) -> Section:
    """Return the loss curves of runs {title: run folder}, and the first and last smoothed value of
    each term.
    """
    path = folder / "figures" / "losses.png"
    rows = []
    plots.loss_curves(path, runs)
    for title, run in runs.items():
        lines = plots.read_metrics(run)
        for name in plots.TERMS:
            values = np.array([line[name] for line in lines if line.get(name) is not None])
            if len(values):
                smooth = plots.smoothed(values)
                rows.append(
                    (
                        title,
                        name.replace("_", " "),
                        len(lines),
                        f"{smooth[0]:.3f}",
                        f"{smooth[-1]:.3f}",
                    )
                )
    table = statistics.markdown_table(("run", "term", "steps", "at the start", "at the end"), rows)
    return Section(
        "Losses", "Pale: each step. Strong: running mean over a twentieth of the run.", table, path
    )


def reconstructions_section(
    manifest: Manifest, encoder: Encoder, folder: Path
) -> tuple[Section, dict[str, Any]]:
    """Return masked patches and next frames of stage 1 on a test clip of each sensor, and its
    errors.
    """
    config = encoder.config
    params = encoder.params | {"decoder": encoder.part_params("decoder")}
    rows = _with_images(manifest, manifest.rows_of("test"))
    frames = config.model.frames + 1
    rows = rows_with_gel(encoder, UnitGels(manifest), rows, lambda _: None)
    if (
        config.objective.next_frame and config.data.clip_share > 0
    ):  # else the head for clips is untrained
        ends = np.intersect1d(manifest.clips(frames, "test")[:, -1], rows)
    else:
        ends = rows[:0]
    scores = _pixel_errors(params, manifest, ends, encoder)
    kind: Literal["still", "clip"] = "clip" if len(ends) else "still"
    rows, frames = (ends, frames) if len(ends) else (rows, 1)
    sensor = manifest.codes("sensor")[rows]
    force = np.array([manifest.value(int(row), "label.force") or 0.0 for row in rows], np.float64)
    # the last without forces
    rows = np.sort(best_rows(rows, sensor, force, rows))
    config = replace(config, data=replace(config.data, batch_size=len(rows)))
    _, batch = next(
        iter(evaluation(manifest, rows, config, kind, frames=frames, unknown="universal"))
    )
    image = reconstruction_panels(params, batch.clip, batch.sensor, net=encoder.net, config=config)
    path = folder / "figures" / "reconstructions.png"
    atomic_write(path, encode(image))
    names = ", ".join(map(statistics.as_text, manifest.text_column("sensor")[rows]))
    share = f"{config.objective.keep_ratio:.0%}".replace("%", " %")
    text = f"Stage 1 reads {share} of the patches of a held-out object. From above: {names}."
    title = "Reconstructions"
    table = ""
    if frames > 1:
        title = f"{title} and next frames"
        text = f"{text} The last pair is the next frame and its prediction."
    if scores:
        kinds = {
            "untouched ": "untouched gel",
            "plain ": "mean of the visible patches; copy of the last frame",
        }
        kinds = {"": "stage 1"} | {
            kind: name for kind, name in kinds.items() if f"{kind}reconstruction" in scores
        }
        terms = {"reconstruction": "hidden patches", "next_frame": "next frame"}
        lines = [
            (name, *(f"{scores[kind + term]:.4f}" for kind in kinds))
            for term, name in terms.items()
        ]
        table = statistics.markdown_table(
            (f"error on {scores['clips']} clips in contact", *kinds.values()), lines
        )
    return Section(title, text, table, path), scores


def _pixel_errors(params: Any, manifest: Manifest, ends: Array, encoder: Encoder) -> dict[str, Any]:
    """Return errors of stage 1 and of its baselines on clips in contact, {} if there are none."""
    # in contact or unknown
    ends = ends[known_contact(manifest)[ends] != 0]
    config = encoder.config
    if config.objective.norm_pix_loss or not len(ends):
        return {}
    ends = ends[np.linspace(0, len(ends) - 1, min(_CLIPS, len(ends))).astype(int)]
    config = replace(config, data=replace(config.data, batch_size=min(48, len(ends))))
    return {"clips": len(ends)} | pixel_scores(
        params, manifest, ends, net=encoder.net, config=config
    )


@dataclass(frozen=True, eq=False)
class _Study:
    """The chosen rows of a manifest with the features of each encoder: class token, and mean of the
    patch tokens.
    """

    manifest: Manifest
    rows: Array
    split: Array
    classes: dict[str, Array]
    patches: dict[str, Array]
    pixels: Array | None
    notes: tuple[str, ...]

    def test(self, values: Array) -> Array:
        return values[self.split == "test"]


def _study(
    table: Manifest, encoders: Mapping[str, Encoder], touches: int, seed: int, log: Log
) -> _Study:
    most = {"train": touches // 2, "val": touches // 2, "test": touches}
    rows = np.concatenate([_chosen(table, name, count, seed) for name, count in most.items()])
    classes = {}
    patches = {}
    gels = UnitGels(table)
    for encoder in encoders.values():
        rows = rows_with_gel(encoder, gels, rows, log)
    for name, encoder in encoders.items():
        values = embed_rows(encoder, table, rows, pooling="both", gels=gels, log=log)[1]
        classes[name], patches[name] = np.split(values, [encoder.config.model.embed], axis=1)
    pixels, notes = _baseline(PIXELS, lambda: background_difference(table, rows, gels))
    return _Study(
        table, rows, table.text_column("split")[rows], classes, patches, pixels, tuple(notes)
    )


def _baseline(name: str, make: Callable[[], Array]) -> tuple[Array | None, list[str]]:
    try:
        return make(), []
    except UserError as error:
        return None, [f"no baseline by {name}: {error}"]


def _with_images(table: Manifest, rows: Array) -> Array:
    return rows[~np.isin(table.text_column("sensor")[rows], FIELD_SENSORS)]


def _chosen(table: Manifest, split: str, touches: int, seed: int) -> Array:
    """Return the deepest rows of at most `touches` whole touches of a split; none of an empty train
    or val.
    """
    if split != "test" and split not in set(table.text_column("split")):
        return np.zeros(0, np.int64)
    rows = deepest_rows(table, _with_images(table, table.rows_of(split)))
    codes = table.codes("touch", own=True)[rows]
    names = np.unique(codes)
    if len(names) > touches:
        rows = rows[
            np.isin(codes, np.random.default_rng(seed).choice(names, touches, replace=False))
        ]
    return rows


def _space(study: _Study, out: Path, seed: int) -> tuple[Section, list[plots.Space]]:
    """Return the section and the numbers of the feature spaces: alignment, uniformity, silhouettes,
    t-SNE.
    """
    rows = study.test(study.rows)
    sensors = study.manifest.text_column("sensor")[rows]
    objects = study.manifest.text_column("object")[rows]
    touch = study.manifest.codes("touch", own=True)[rows]
    drawn = np.sort(np.random.default_rng(seed).permutation(len(rows))[:_T_SNE_ROWS])
    features = {name: study.test(values) for name, values in study.classes.items()}
    spaces = [
        plots.describe(values, sensors, objects, touch, name=name)
        for name, values in features.items()
    ]
    points = {
        name: plots.tsne(values[drawn], seed=seed)
        for name, values in tracked(features.items(), "t-SNE")
    }
    path = out / "figures" / "tsne.png"
    plots.tsne_panels(path, points, sensors[drawn], objects[drawn])
    lines = []
    for space in spaces:
        figures = (
            space.alignment,
            space.uniformity,
            space.silhouette_sensor,
            space.silhouette_object,
        )
        lines.append(
            (
                space.name,
                *("-" if value is None else f"{value:.3f}" for value in figures),
                space.rows,
            )
        )
    head = (
        "features",
        "alignment",
        "uniformity",
        "silhouette by sensor",
        "silhouette by object",
        "frames",
    )
    text = (
        "The same touches by several sensors. Alignment: mean squared distance of one touch by two "
        "sensors (0 is "
        "best). Uniformity: lower is more even. Silhouette (-1 to 1): good alignment makes it low "
        "by sensor and high "
        "by object."
    )
    return Section(
        "The space of touches", text, statistics.markdown_table(head, lines), path
    ), spaces


def _retrieval(study: _Study, out: Path, size: int) -> tuple[Section, dict[str, Any]]:
    """Return retrieval of the test rows for each grade of alignment, with matched and with random
    galleries.
    """
    table = study.manifest
    rows = study.test(study.rows)
    notes = list(study.notes)
    features = {name: study.test(values) for name, values in study.classes.items()}
    features |= {f"{name} (patches)": study.test(values) for name, values in study.patches.items()}
    features |= {} if study.pixels is None else {PIXELS: study.test(study.pixels)}
    vector, missing = _baseline(VECTOR, lambda: contact_vector(table, rows))
    features |= {} if vector is None else {VECTOR: vector}
    notes += missing
    grades = _grades(table, rows, "test")
    sensors = table.text_column("sensor")[rows]
    touch = table.codes("touch", own=True)[rows]
    results: dict[str, dict[str, list[retrieval.Retrieval]]] = {}
    for grade in map(str, np.unique(grades)):
        part = np.flatnonzero(grades == grade)
        least = min(
            len(np.unique(touch[part][sensors[part] == name])) for name in np.unique(sensors[part])
        )
        if least < size:
            notes.append(
                f"{grade}: a sensor has {least} touches only, so galleries have {least}, not {size}"
            )
        for kind, match in (("matched", retrieval.COVARIATES), ("by chance", None)):
            try:
                results.setdefault(grade, {})[kind] = retrieval.cross_sensor_retrieval(
                    table,
                    {name: values[part] for name, values in features.items()},
                    rows[part],
                    gallery_size=min(size, least),
                    match=match,
                    metrics={VECTOR: "euclidean"},
                )
            except UserError as error:
                notes.append(f"{grade}, gallery {kind}: not scored: {error}")
    section, changes = retrieval_section(results, "stage 2", notes, out)
    return section, {"found": results, "differences": changes, "notes": notes}


def retrieval_section(
    results: Mapping[str, Mapping[str, Sequence[retrieval.Retrieval]]],
    best: str,
    notes: Sequence[str],
    folder: Path,
) -> tuple[Section, dict[str, dict[str, Change]]]:
    """Return tables of retrieval {grade: {"matched" or "by chance": results}}, and paired
    differences to `best`.
    """
    rows = []
    ahead = []
    changes = {}
    panels = {}
    for grade, kinds in results.items():
        pooled = {
            (result.name, kind, result.centred): result
            for kind, several in kinds.items()
            for result in several
            if result.query_sensor == retrieval.ALL
        }
        kind = "matched" if "matched" in kinds else "by chance"
        plain = {
            name: result
            for (name, other, centred), result in pooled.items()
            if other == kind and not centred
        }
        panels[f"{grade}, gallery {kind}"] = {
            name: ShareBar(result.top1, result.low, result.high, result.chance1)
            for name, result in plain.items()
        }
        others = [name for name in plain if name != best] if best in plain else []
        changes[grade] = {name: retrieval.difference(plain[best], plain[name]) for name in others}
        ahead += [
            (grade, name, _shares(*change, sign="+")) for name, change in changes[grade].items()
        ]
        for name, result in plain.items():
            columns = [
                (way, centred) for way in ("matched", "by chance") for centred in (False, True)
            ]
            cells = [pooled.get((name, *column)) for column in columns]
            shares = [
                "-" if cell is None else _shares(cell.top1, cell.low, cell.high) for cell in cells
            ]
            fifth = "-" if cells[0] is None else _shares(cells[0].top5)
            rows.append(
                (grade, name, shares[0], fifth, *shares[1:], result.gallery, result.queries)
            )
    ways = (
        "recall@1 matched",
        "recall@5 matched",
        "recall@1 matched, centred",
        "recall@1 by chance",
        "recall@1 by chance, centred",
    )
    head = ("data", "features", *ways, "gallery", "queries")
    table = statistics.markdown_table(head, rows)
    table += f"\n\n{best}, recall@1 ahead of the others (points, paired by query):\n\n"
    table += statistics.markdown_table(("data", "features", f"{best} minus these"), ahead)
    path = folder / "figures" / "retrieval.png"
    if panels:
        plots.bars(path, panels, label="recall@1")
    matched = [result for kinds in results.values() for result in kinds.get("matched", ())]
    near = [result.nearness for result in matched if result.nearness is not None]
    covariates = (
        ", ".join(name.removeprefix("label.") for name in matched[0].matched)
        if matched
        else "nothing"
    )
    text = (
        "A touch by one sensor is retrieved among touches by another. In matched galleries the "
        "distractors are the "
        f"nearest in {covariates}; by chance they are random. Centred: minus the mean of each "
        "sensor. In brackets: "
        "95 % under a bootstrap over objects."
        + (
            f" Distractors lie at {np.mean(near):.2f} of the mean distance of all touches."
            if near
            else ""
        )
    )
    return Section(
        "Cross-sensor retrieval", text, table, path if panels else None, _listed(notes)
    ), changes


def _matching(study: _Study, encoder: Encoder) -> tuple[Section, dict[str, Any]]:
    """Return the scores of the matching head of stage 2 on the test rows, for both kinds of
    negatives.
    """
    scores = list[retrieval.MatchScore]()
    notes = list[str]()
    features = study.test(study.classes["stage 2"])
    try:
        scores = retrieval.score_matching(encoder, study.manifest, study.test(study.rows), features)
    except UserError as error:
        notes.append(f"not scored: {error}")
    text = (
        "Did two touches, by two sensors, come from the same place (Eq. 5)? Half of the pairs are "
        "positives. With "
        "negatives of any sensor, the two sensors alone reveal part of the answer. With negatives "
        "of the positive's "
        "sensor they do not. The rule of the sensors alone is learned on half of the touches and "
        "scored on the other. "
        "In brackets: 95 % under a bootstrap over objects."
    )
    names = {"any": "of any sensor", "same_sensor": "of the positive's sensor"}
    head = ("negatives", "accuracy (chance 50 %)", "AUC", "by the sensors alone", "triples")
    rows = [
        (
            names[score.negatives],
            _shares(score.accuracy, score.low, score.high),
            f"{score.auc:.3f}",
            _shares(score.sensors_alone),
            score.triples,
        )
        for score in scores
    ]
    table = statistics.markdown_table(head, rows) if rows else ""
    return Section("Cross-sensor matching", text, table, notes=_listed(notes)), {
        "found": scores,
        "notes": notes,
    }


def _probes(study: _Study, out: Path) -> tuple[Section, dict[str, Any]]:
    """Return probes of labels on held-out objects; a note names each label that cannot be
    probed.
    """
    table = study.manifest
    rows = study.rows
    notes = list(study.notes)
    features = {
        name: np.concatenate([study.classes[name], study.patches[name]], 1)
        for name in study.classes
    }
    if study.pixels is not None:
        features[PIXELS] = principal_components(study.pixels, study.split == "train")
    objects = table.text_column("object")[rows]
    sequences = table.text_column("sequence")[rows]
    groups = np.where(objects == "", sequences, objects)
    results: dict[str, list[ProbeResult]] = {}
    for label in LABELS:
        if f"label.{label}" not in table.table.column_names:
            notes.append(f"{label}: the manifest has no column label.{label}")
            continue
        values = [table.value(int(row), f"label.{label}") for row in rows]
        measured = any(isinstance(value, float) and value % 1 for value in values)
        scored = list[ProbeResult]()
        try:
            for name, x in features.items():
                # Principal components share one scale: unit spread for each would amplify the
                # smallest.
                head = ProbeHead("linear", "common" if name == PIXELS else "column")
                options: dict[str, Any] = {"measured": measured, "name": name, "seeds": 0}
                scored.append(
                    probing.probe_features(x, values, groups, study.split, head, **options)
                )
        except UserError as error:
            notes.append(f"{label}: not probed: {error}")
        results |= {label: scored} if scored else {}
    bars = {
        label: {
            one.probe: ShareBar(one.accuracy, one.low, one.high, one.baseline) for one in scored
        }
        for label, scored in results.items()
        if not scored[0].measured
    }
    path = out / "figures" / "probes.png"
    if bars:
        plots.bars(path, bars, label="accuracy")
    text = (
        "A linear probe on frozen features (class token and mean of patches), fitted on train, "
        "tested on test."
    )
    parts = "\n\n".join(
        f"### {label}\n\n{probing.probe_table(scored).strip()}" for label, scored in results.items()
    )
    return Section("Probes", text, parts, path if bars else None, _listed(notes)), {
        "found": results,
        "notes": notes,
    }


def _listed(notes: Sequence[str]) -> str:
    return "\n".join(f"- {statistics.as_text(note)}" for note in notes)


def _shares(
    value: float, low: float | None = None, high: float | None = None, sign: str = ""
) -> str:
    """Return a share in percent (with `sign` "+": a difference in points) and its interval."""
    interval = (
        "" if low is None or high is None else f" ({100 * low:{sign}.1f} to {100 * high:{sign}.1f})"
    )
    return f"{100 * value:{sign}.1f}{'' if sign else ' %'}{interval}"
