"""The report of two runs on a manifest: sections of text, figures and tables in one Markdown file, numbers as JSON."""

from __future__ import annotations

import io
import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.images import decode
from anytouch_jax.data.loading.evaluation import evaluation
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import read_file
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.prepare.contact import known_contact
from anytouch_jax.encoder.embed import embed_rows, text_column
from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import array_probes, geometry, plots, retrieval, statistics
from anytouch_jax.evaluate.array_probes import ProbeResult
from anytouch_jax.evaluate.feature_cache import background_difference, principal_components
from anytouch_jax.evaluate.heads import ProbeHead
from anytouch_jax.evaluate.reconstruction import pixel_scores, reconstruction_panels, write_png
from anytouch_jax.evaluate.retrieval import contact_vector, deepest_rows
from anytouch_jax.files import atomic_write

Array = npt.NDArray[Any]
Log = Callable[[str], None]
Change = tuple[float, float | None, float | None]  # a difference with its interval

RANDOM, PIXELS, VECTOR = "random encoder", "pixels minus background", "area, centroid, force"
LABELS = ("hardness", "roughness", "material", "indenter")
QUANTITIES = ("force",)
FEWEST = 4  # rows of a t-SNE
_T_SNE_ROWS = 800
_CLIPS = 240  # on which reconstruction errors are measured
_SHOWN = 5  # touches in a sample grid
_SIDE = 200  # pixels of the longer side of a sample
_COLUMNS = (("matched", False), ("matched", True), ("by chance", False), ("by chance", True))


@dataclass(frozen=True)
class Section:
    """A part of a report, in this order: text, figure, table (Markdown), notes."""

    title: str
    text: str = ""
    table: str = ""
    figure: Path | None = None
    notes: str = ""


def write_report(
    folder: Path, sections: Sequence[Section], *, title: str = "Report", numbers: Mapping[str, Any] | None = None
) -> Path:
    """Write `folder`/report.md, report.json (`numbers`) and figures/, and return the path of report.md.

    Figures from elsewhere are copied. The figures are written first and report.md last, each atomically, so an existing
    report is always complete. Raises UserError for a missing figure, OSError for a full disk.
    """
    lines = [f"# {title}"]
    drawn = [section.figure.name for section in sections if section.figure is not None]
    for number, section in enumerate(sections, 1):
        lines.append(f"## {section.title}")
        if section.text:
            lines.append(section.text.strip())
        if section.figure is not None:
            own = section.figure.name
            target = folder / "figures" / (f"{number:02d}_{own}" if drawn.count(own) > 1 else own)
            if not section.figure.is_file():
                raise UserError(f"there is no figure {section.figure} for the report; draw it first or leave it out")
            if section.figure.resolve() != target.resolve():
                atomic_write(target, section.figure.read_bytes())
            lines.append(f"![{section.title}](figures/{target.name})")
        lines += [part.strip() for part in (section.table, section.notes) if part]
    if numbers is not None:
        atomic_write(folder / "report.json", json.dumps(statistics.plain(numbers), indent=2, allow_nan=False) + "\n")
    atomic_write(folder / "report.md", "\n\n".join(lines) + "\n")
    return folder / "report.md"


@dataclass(frozen=True, eq=False)
class _Study:
    """The chosen rows of a manifest with the features of each encoder: class token, and mean of the patch tokens."""

    manifest: Manifest
    rows: Array
    split: Array
    classes: dict[str, Array]
    patches: dict[str, Array]
    pixels: Array | None
    notes: tuple[str, ...]

    def test(self, values: Array) -> Array:
        return values[self.split == "test"]


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

    It has samples, losses, reconstructions, the feature space, retrieval, matching and probes. `touches` is the largest
    number of touches of test, and half of it of train and of val, each with its deepest frame. The folder `out` is
    written at the end, so a report that fails leaves an earlier one unchanged. Raises UserError, also for a run of the
    other stage and for weights files.
    """
    clock, out = time.perf_counter(), Path(out)
    table = manifests.read(manifest)
    _check_touches(table, touches, seed)
    with tempfile.TemporaryDirectory(prefix="anytouch-report-") as drawn:
        sections, numbers = _contents(table, Path(stage1), Path(stage2), Path(drawn), log, touches, gallery_size, seed)
        numbers = {"manifest": str(manifest), **numbers, "seconds": round(time.perf_counter() - clock, 1)}
        path = write_report(out, sections, title="What the demo learned", numbers=numbers)
    log(f"{path}: written in {numbers['seconds']:.0f} s")
    return path


def _encoder_of_stage(run: Path, stage: int) -> Encoder:
    """Return the encoder of a run. Raises UserError for a weights file, which has no losses, and for another stage."""
    if run.is_file():
        raise UserError(f"--stage{stage} {run} is a weights file; give the folder of a run of stage {stage}")
    encoder = load_encoder(run)
    if encoder.config.stage != stage:
        meant = "the stage 1 from which stage 2 started" if stage == 1 else "a stage 2 that started from stage 1"
        raise UserError(f"--stage{stage} {run} is a run of stage {encoder.config.stage}; give {meant}")
    return encoder


def _contents(
    table: Manifest, stage1: Path, stage2: Path, out: Path, log: Log, touches: int, gallery_size: int, seed: int
) -> tuple[list[Section], dict[str, Any]]:
    """Return the sections of a report, their figures drawn in `out`, and its numbers."""
    first, second = _encoder_of_stage(stage1, 1), _encoder_of_stage(stage2, 2)
    encoders = {RANDOM: random_encoder(first.config, seed), "stage 1": first, "stage 2": second}
    numbers: dict[str, Any] = {"data": table.content_hash, "stage1": str(stage1), "stage2": str(stage2)}
    sections = [_facts(table, first, second, _lineage(stage1, second)), *samples_section(table, out, seed=seed)]
    sections.append(losses_section({"stage 1": stage1, "stage 2": stage2}, out))
    section, numbers["pixels"] = reconstructions_section(table, first, out)
    sections.append(section)
    log("report: samples, losses and reconstructions are drawn")
    study = _study(table, encoders, touches, seed, log)
    log(f"report: {len(study.rows)} touches embedded by {len(encoders)} encoders")
    section, numbers["space"] = _space(study, out, seed)
    sections.append(section)
    log("report: t-SNE is drawn")
    section, numbers["retrieval"] = _retrieval(study, out, gallery_size)
    sections.append(section)
    section, numbers["matching"] = _matching(study, second)
    sections.append(section)
    log("report: retrieval and matching are scored")
    section, numbers["probes"] = _probes(study, out)
    return [*sections, section], numbers


def _lineage(stage1: Path, second: Encoder) -> str:
    """Return a sentence if stage 2 did not start from this stage 1, else nothing."""
    init = (second.metadata.get("source") or {}).get("init")
    if init is None:
        return "Stage 2 started from no run, so this stage 1 is no part of it."
    began = Path(init)
    same = began.resolve() == stage1.resolve() or (not began.exists() and began.name == stage1.resolve().name)
    return "" if same else f"Stage 2 started from another run ({began.name}), so this stage 1 is no part of it."


def _facts(table: Manifest, first: Encoder, second: Encoder, lineage: str) -> Section:
    split, objects = text_column(table, "split"), text_column(table, "object")
    touch, sensors = table.codes("touch", own=True), text_column(table, "sensor")
    rows = []
    for name in manifests.SPLITS:
        part = split == name
        if part.any():
            counts = (part.sum(), len(np.unique(touch[part & (touch >= 0)])), len(set(objects[part]) - {""}))
            rows.append((name, *map(str, counts), ", ".join(sorted(set(sensors[part])))))
    text = (
        f"Data {table.content_hash[:12]}. Stage 1: preset {first.config.preset}, {first.config.run.steps} steps of "
        f"{first.config.data.batch_size}. Stage 2: {second.config.run.steps} steps of {second.config.data.batch_size}, "
        f"recipe {second.config.recipe}, towers {second.config.towers}. All figures below are of split test."
    )
    backgrounds = (first.config.data.background, second.config.data.background)
    if backgrounds[0] != backgrounds[1]:
        lineage += f" Stage 1 was trained with background {backgrounds[0]}, stage 2 with background {backgrounds[1]}."
    counted = statistics.markdown_table(("split", "frames", "touches", "objects", "sensors"), rows)
    return Section("Data and runs", text, counted, notes=f"**{lineage.strip()}**" if lineage else "")


def _check_touches(table: Manifest, touches: int, seed: int) -> None:
    """Raise UserError for too few touches in split test, or in `touches`."""
    count = len(_chosen(table, "test", touches, seed))
    if count < FEWEST:
        every = _chosen(table, "test", len(table), seed)
        all_touches = len(np.unique(table.codes("touch", own=True)[every]))
        advice = "give more --touches" if len(every) >= FEWEST else "simulate or record more"
        raise UserError(
            f"the manifest's test split has {all_touches} touches, of which the report would have {count} frames, and "
            f"it needs {FEWEST}; {advice}"
        )


def _study(table: Manifest, encoders: Mapping[str, Encoder], touches: int, seed: int, log: Log) -> _Study:
    most = {"train": touches // 2, "val": touches // 2, "test": touches}
    rows = np.concatenate([_chosen(table, name, count, seed) for name, count in most.items()])
    classes, patches = {}, {}
    for name, encoder in encoders.items():
        embedded, values = embed_rows(encoder, table, rows, pooling="both", log=log)
        if not np.array_equal(embedded, rows):
            raise UserError(f"{len(rows) - len(embedded)} rows could not be read; repair the manifest first")
        classes[name], patches[name] = np.split(values, [encoder.config.model.embed], axis=1)
    pixels: Array | None = None
    notes: tuple[str, ...] = ()
    try:
        pixels = background_difference(table, rows)
    except UserError as error:
        notes = (f"no baseline by {PIXELS}: {error}",)
    return _Study(table, rows, text_column(table, "split")[rows], classes, patches, pixels, notes)


def _chosen(table: Manifest, split: str, touches: int, seed: int) -> Array:
    """Return the deepest rows of at most `touches` whole touches of a split; none of an empty train or val."""
    if split != "test" and split not in set(text_column(table, "split")):
        return np.zeros(0, np.int64)
    rows = table.rows_of(split)
    rows = deepest_rows(table, rows[~np.isin(text_column(table, "sensor")[rows], FIELD_SENSORS)])
    codes = table.codes("touch", own=True)[rows]
    names = np.unique(codes)
    if len(names) > touches:
        rows = rows[np.isin(codes, np.random.default_rng(seed).choice(names, touches, replace=False))]
    return rows


def _space(study: _Study, out: Path, seed: int) -> tuple[Section, list[geometry.Space]]:
    """Return the section and the numbers of the feature spaces: alignment, uniformity, silhouettes, t-SNE."""
    rows = study.test(study.rows)
    sensors, objects = text_column(study.manifest, "sensor")[rows], text_column(study.manifest, "object")[rows]
    touch = study.manifest.codes("touch", own=True)[rows]
    drawn = np.sort(np.random.default_rng(seed).permutation(len(rows))[:_T_SNE_ROWS])
    spaces, points = [], {}
    for name, values in study.classes.items():
        features = study.test(values)
        spaces.append(geometry.describe(features, sensors, objects, touch, name=name))
        points[name] = geometry.tsne(features[drawn], seed=seed)
    path = out / "figures" / "tsne.png"
    plots.tsne_panels(path, points, sensors[drawn], objects[drawn])
    head = ("features", "alignment", "uniformity", "silhouette by sensor", "silhouette by object", "touches")
    lines = []
    for space in spaces:
        figures = (space.alignment, space.uniformity, space.silhouette_sensor, space.silhouette_object)
        cells = ("-" if value is None else f"{value:.3f}" for value in figures)
        lines.append((space.name, *cells, str(space.rows)))
    text = (
        "The same touches by several sensors. Alignment: mean squared distance of one touch by two sensors (0 is "
        "best). Uniformity: lower is more even. Silhouette (-1 to 1): good alignment makes it low by sensor and high "
        "by object."
    )
    return Section("The space of touches", text, statistics.markdown_table(head, lines), path), spaces


def _retrieval(study: _Study, out: Path, size: int) -> tuple[Section, dict[str, Any]]:
    """Return retrieval of the test rows for each grade of alignment, with matched and with random galleries."""
    table, rows, notes = study.manifest, study.test(study.rows), list(study.notes)
    features = {name: study.test(values) for name, values in study.classes.items()}
    features |= {f"{name} (patches)": study.test(values) for name, values in study.patches.items()}
    features |= {} if study.pixels is None else {PIXELS: study.test(study.pixels)}
    try:
        features[VECTOR] = contact_vector(table, rows)
    except UserError as error:
        notes.append(f"no baseline by {VECTOR}: {error}")
    grades = text_column(table, "grade")[rows] if "grade" in table.table.column_names else np.full(len(rows), "test")
    sensors, touch = text_column(table, "sensor")[rows], table.codes("touch", own=True)[rows]
    results: dict[str, dict[str, list[retrieval.Retrieval]]] = {}
    for grade in map(str, np.unique(grades)):
        part = np.flatnonzero(grades == grade)
        least = min(len(np.unique(touch[part][sensors[part] == name])) for name in np.unique(sensors[part]))
        if least < size:
            notes.append(f"{grade}: a sensor has {least} touches only, so galleries have {least}, not {size}")
        for kind, match in (("matched", retrieval.COVARIATES), ("by chance", None)):
            try:
                results.setdefault(grade, {})[kind] = retrieval.cross_sensor_retrieval(
                    table, {name: values[part] for name, values in features.items()}, rows[part],
                    gallery_size=min(size, least), match=match, metrics={VECTOR: "euclidean"},
                )  # fmt: skip
            except UserError as error:
                notes.append(f"{grade}, gallery {kind}: not scored: {error}")
    section, changes = retrieval_section(results, "stage 2", notes, out)
    return section, {"found": results, "differences": changes, "notes": notes}


def _matching(study: _Study, encoder: Encoder) -> tuple[Section, dict[str, Any]]:
    """Return the scores of the matching head of stage 2 on the test rows."""
    scores: list[retrieval.MatchScore] = []
    notes: list[str] = []
    try:
        features = study.test(study.classes["stage 2"])
        scores = retrieval.score_matching(encoder, study.manifest, study.test(study.rows), features)
    except UserError as error:
        notes.append(f"not scored: {error}")
    return matching_section(scores, notes), {"found": scores, "notes": notes}


def _probes(study: _Study, out: Path) -> tuple[Section, dict[str, Any]]:
    """Return probes of labels on held-out objects; a note names each label that cannot be probed."""
    table, rows, notes = study.manifest, study.rows, list(study.notes)
    features = {name: np.concatenate([study.classes[name], study.patches[name]], 1) for name in study.classes}
    if study.pixels is not None:
        features[PIXELS] = principal_components(study.pixels, study.split == "train")
    objects, sequences = text_column(table, "object")[rows], text_column(table, "sequence")[rows]
    groups = np.where(objects == "", sequences, objects)
    results: dict[str, list[ProbeResult]] = {}
    for label in (*LABELS, *QUANTITIES):
        name = f"label.{label}"
        if name not in table.table.column_names:
            notes.append(f"{label}: the manifest has no column {name}")
            continue
        values = [table.value(int(row), name) for row in rows]
        is_measured = any(isinstance(value, float) and value % 1 for value in values)
        results[label] = []
        try:
            for key, x in features.items():
                results[label].append(_probe(x, values, groups, study.split, key, is_measured))
        except UserError as error:
            notes.append(f"{label}: not probed: {error}")
    results = {label: several for label, several in results.items() if several}
    return probes_section(results, notes, out), {"found": results, "notes": notes}


def _probe(x: Array, labels: list[Any], groups: Array, split: Array, name: str, measured: bool) -> ProbeResult:
    # Principal components share one scale: unit spread for each would amplify the smallest.
    head = ProbeHead("linear", "common" if name == PIXELS and not measured else "column")
    return array_probes.probe_features(x, labels, groups, split, head, measured=measured, name=name, seeds=0)


# Sections -----------------------------------------------------------------------------------------------------------


def samples_section(manifest: Manifest, folder: Path, *, seed: int = 0) -> list[Section]:
    """Return a section for each grade of alignment: a picture with a touch per row and a sensor per column, captions.

    The touches are those by most sensors, of different objects if possible.
    """
    rows = deepest_rows(manifest)
    grades = text_column(manifest, "grade")[rows] if "grade" in manifest.table.column_names else np.full(len(rows), "")
    return [_samples(manifest, folder, rows[grades == grade], str(grade), seed) for grade in np.unique(grades)]


def _samples(manifest: Manifest, folder: Path, rows: Array, grade: str, seed: int) -> Section:
    sensor, touch = text_column(manifest, "sensor")[rows], manifest.codes("touch", own=True)[rows]
    objects, names = text_column(manifest, "object")[rows], [str(name) for name in np.unique(sensor)]
    images, titles, captions = [], [], []
    for code in _varied_touches(touch, sensor, objects, seed):
        row_of = {str(sensor[i]): int(rows[i]) for i in np.flatnonzero(touch == code)[::-1]}
        pictured = next((row for row in row_of.values() if manifest.value(row, "image_path") is not None), None)
        photo = None if pictured is None else _shrunk(decode(manifest.file(pictured, "image_path")))
        images.append([_picture(manifest, row_of.get(name)) for name in names] + [photo])
        titles.append(str(objects[np.flatnonzero(touch == code)[0]]) or f"touch {code}")
        texts = [manifest.value(row, "text") for row in row_of.values()]
        captions.append(next((" ".join(text.split()) for text in texts if text), "no caption"))
    suffix = "".join(letter if letter.isalnum() else "_" for letter in grade)
    path = folder / "figures" / f"samples{'_' if grade else ''}{suffix}.png"
    plots.sample_grid(path, images, titles, [*names, "photograph"])
    notes = "\n".join(f"{i + 1}. *{title}*: {captions[i]}" for i, title in enumerate(titles))
    text = "Rows are touches, columns are sensors, each at the deepest frame. Captions are below."
    return Section(f"Samples{', ' if grade else ''}{grade}", text, figure=path, notes=notes)


def _varied_touches(touch: Array, sensor: Array, objects: Array, seed: int) -> list[int]:
    """Return the touches by most sensors, one per object before any object comes again."""
    codes, first = np.unique(touch, return_index=True)
    sensors = np.array([len(set(sensor[touch == code])) for code in codes])
    order = np.lexsort((np.random.default_rng(seed).random(len(codes)), -sensors))
    counts: dict[str, int] = {}
    turn = []
    for i in order:
        name = str(objects[first[i]])
        turn.append(counts.get(name, 0))
        counts[name] = turn[-1] + 1
    return [int(codes[i]) for _, i in sorted(zip(turn, order, strict=True), key=lambda pair: pair[0])][:_SHOWN]


def _picture(manifest: Manifest, row: int | None) -> Array | None:
    """Return the frame of a row; of a force-field sensor the length of its displacement (three channels), mm."""
    if row is None:
        return None
    if manifest.value(row, "sensor") not in FIELD_SENSORS:
        return _shrunk(decode(manifest.file(row)))
    column = "field_path" if manifest.value(row, "field_path") is not None else "path"
    field = np.load(io.BytesIO(read_file(manifest.file(row, column))), allow_pickle=False)
    return np.linalg.norm(field[..., :3], axis=-1) if field.ndim == 3 else field


def _shrunk(image: Array) -> Array:
    ratio = _SIDE / max(image.shape[:2])
    if ratio >= 1:
        return image
    size = (max(1, round(image.shape[1] * ratio)), max(1, round(image.shape[0] * ratio)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def losses_section(runs: Mapping[str, Path], folder: Path) -> Section:
    """Return the loss curves of runs {title: run folder}, and the first and last smoothed value of each term."""
    path, rows = folder / "figures" / "losses.png", []
    plots.loss_curves(path, runs)
    for title, run in runs.items():
        lines = plots.read_metrics(run)
        for name in plots.TERMS:
            values = np.array([line[name] for line in lines if line.get(name) is not None])
            if len(values):
                smooth = plots.smoothed(values)
                rows.append((title, name.replace("_", " "), str(len(lines)), f"{smooth[0]:.3f}", f"{smooth[-1]:.3f}"))
    table = statistics.markdown_table(("run", "term", "steps", "at the start", "at the end"), rows)
    return Section("Losses", "Pale: each step. Strong: running mean over a twentieth of the run.", table, path)


def reconstructions_section(manifest: Manifest, encoder: Encoder, folder: Path) -> tuple[Section, dict[str, Any]]:
    """Return masked patches and next frames of stage 1 on a test clip of each sensor, and its errors."""
    config, params = encoder.config, encoder.params | {"decoder": encoder.part_params("decoder")}
    rows = manifest.rows_of("test")
    rows = rows[~np.isin(text_column(manifest, "sensor")[rows], FIELD_SENSORS)]
    frames = config.model.frames + 1
    is_predicted = config.objective.next_frame and config.data.clip_share > 0  # else the head for clips is untrained
    ends = np.intersect1d(manifest.clips(frames, "test")[:, -1], rows) if is_predicted else rows[:0]
    scores = _pixel_errors(params, manifest, ends, encoder)
    kind: Literal["still", "clip"] = "clip" if len(ends) else "still"
    frames = frames if len(ends) else 1
    rows = _deepest_of_sensors(manifest, ends if len(ends) else rows)
    config = replace(config, data=replace(config.data, batch_size=len(rows)))
    _, batch = next(iter(evaluation(manifest, rows, config, kind, frames=frames, unknown="universal")))
    image = reconstruction_panels(params, batch.clip, batch.sensor, net=encoder.net, config=config)
    path = folder / "figures" / "reconstructions.png"
    write_png(path, image)
    names = ", ".join(text_column(manifest, "sensor")[rows])
    text = f"Stage 1 sees a quarter of the patches of a held-out object. From above: {names}."
    title, table = "Reconstructions", ""
    if frames > 1:
        title, text = f"{title} and next frames", f"{text} The last pair is the next frame and its prediction."
    if scores:
        kinds = {"untouched": "untouched gel", "plain": "mean of the visible patches; copy of the last frame"}
        kinds = {kind: name for kind, name in kinds.items() if f"{kind} reconstruction" in scores}
        head = (f"error on {scores['clips']} clips in contact", "stage 1", *kinds.values())
        terms = {"reconstruction": "hidden patches", "next_frame": "next frame"}
        keys = {name: (term, *(f"{kind} {term}" for kind in kinds)) for term, name in terms.items()}
        lines = [(name, *(f"{scores[key]:.4f}" for key in several)) for name, several in keys.items()]
        table = statistics.markdown_table(head, lines)
    return Section(title, text, table, path), scores


def _pixel_errors(params: Any, manifest: Manifest, ends: Array, encoder: Encoder) -> dict[str, Any]:
    """Return errors of stage 1 and of its baselines on clips in contact, {} if there are none."""
    ends, config = ends[known_contact(manifest)[ends] != 0], encoder.config  # in contact or unknown
    if config.objective.norm_pix_loss or not len(ends):
        return {}
    ends = ends[np.linspace(0, len(ends) - 1, min(_CLIPS, len(ends))).astype(int)]
    config = replace(config, data=replace(config.data, batch_size=min(48, len(ends))))
    return {"clips": len(ends)} | pixel_scores(params, manifest, ends, net=encoder.net, config=config)


def _deepest_of_sensors(manifest: Manifest, rows: Array) -> Array:
    """Return the row of the largest force for each sensor, the last row without forces."""
    sensor = text_column(manifest, "sensor")[rows]
    force = np.array([manifest.value(int(row), "label.force") or 0.0 for row in rows], np.float64)
    order = np.lexsort((rows, force))
    return np.sort([rows[order][np.flatnonzero(sensor[order] == name)[-1]] for name in np.unique(sensor)])


def retrieval_section(
    results: Mapping[str, Mapping[str, Sequence[retrieval.Retrieval]]], best: str, notes: Sequence[str], folder: Path
) -> tuple[Section, dict[str, dict[str, Change]]]:
    """Return tables of retrieval {grade: {"matched" or "by chance": results}}, and differences to the features `best`.

    The differences {grade: {features: (mean, low, high)}} are in recall@1, paired by query.
    """
    rows, ahead, changes, panels = [], [], {}, {}
    for grade, kinds in results.items():
        pooled = {
            (result.name, kind, result.centred): result
            for kind, several in kinds.items() for result in several if result.query_sensor == retrieval.ALL
        }  # fmt: skip
        names = list(dict.fromkeys(name for name, _, _ in pooled))
        kind = "matched" if "matched" in kinds else "by chance"
        plain = {name: pooled[name, kind, False] for name in names}
        panels[f"{grade}, gallery {kind}"] = {
            name: plots.ShareBar(result.top1, result.low, result.high, result.chance1) for name, result in plain.items()
        }
        others = [name for name in names if name != best] if best in names else []
        changes[grade] = {name: retrieval.difference(plain[best], plain[name]) for name in others}
        for name in names:
            cells = [pooled.get((name, *key)) for key in _COLUMNS]
            shares = ["-" if cell is None else _share(cell.top1, cell.low, cell.high) for cell in cells]
            fifth = "-" if cells[0] is None else f"{100 * cells[0].top5:.1f} %"
            sizes = (str(plain[name].gallery), str(plain[name].queries))
            rows.append((grade, name, shares[0], fifth, *shares[1:], *sizes))
        ahead += [(grade, name, _signed(*change)) for name, change in changes[grade].items()]
    head = ("data", "features", "top-1 matched", "top-5 matched", "top-1 matched, centred", "top-1 by chance",
            "top-1 by chance, centred", "gallery", "queries")  # fmt: skip
    table = statistics.markdown_table(head, rows)
    table += f"\n\n{best}, top-1 ahead of the others (points, paired by query):\n\n"
    table += statistics.markdown_table(("data", "features", f"{best} minus these"), ahead)
    path = folder / "figures" / "retrieval.png"
    if panels:
        plots.bars(path, panels, label="top-1")
    matched = [result for kinds in results.values() for result in kinds.get("matched", ())]
    near = [result.nearness for result in matched if result.nearness is not None]
    covariates = ", ".join(name.removeprefix("label.") for name in matched[0].matched) if matched else "nothing"
    text = (
        "A touch by one sensor is retrieved among touches by another. In matched galleries the distractors are the "
        f"nearest in {covariates}; by chance they are random. Centred: minus the mean of each sensor. In brackets: "
        "95 % under a bootstrap over objects."
        + (f" Distractors lie at {np.mean(near):.2f} of the mean distance of all touches." if near else "")
    )
    return Section("Cross-sensor retrieval", text, table, path if panels else None, _listed(notes)), changes


def matching_section(scores: Sequence[retrieval.MatchScore], notes: Sequence[str]) -> Section:
    """Return the scores of the matching head of stage 2 for both kinds of negatives."""
    text = (
        "Did two touches, by two sensors, come from the same place (Eq. 5)? Half of the pairs are positives. With "
        "negatives of any sensor, the two sensors alone reveal part of the answer. With negatives of the positive's "
        "sensor they do not. The rule of the sensors alone is learned on half of the touches and scored on the other. "
        "In brackets: 95 % under a bootstrap over objects."
    )
    names = {"any": "of any sensor", "same_sensor": "of the positive's sensor"}
    head = ("negatives", "accuracy (chance 50 %)", "AUC", "by the sensors alone", "triples")
    rows = []
    for score in scores:
        share, alone = _share(score.accuracy, score.low, score.high), f"{100 * score.sensors_alone:.1f} %"
        rows.append((names[score.negatives], share, f"{score.auc:.3f}", alone, str(score.triples)))
    table = statistics.markdown_table(head, rows) if rows else ""
    return Section("Cross-sensor matching", text, table, notes=_listed(notes))


def probes_section(results: Mapping[str, Sequence[ProbeResult]], notes: Sequence[str], folder: Path) -> Section:
    """Return probes {label: results}: accuracy of classes and R2 of quantities on held-out objects."""
    parts: list[str] = []
    panels: dict[str, dict[str, plots.ShareBar]] = {}
    for label, several in results.items():
        parts.append(f"### {label}\n\n{array_probes.probe_table(several).strip()}")
        bars = {
            result.probe: plots.ShareBar(result.accuracy, result.low, result.high, result.baseline)
            for result in several if not result.measured
        }  # fmt: skip
        panels |= {label: bars} if bars else {}
    path = folder / "figures" / "probes.png"
    if panels:
        plots.bars(path, panels, label="accuracy")
    text = "A linear probe on frozen features (class token and mean of patches), fitted on train, tested on test."
    return Section("Probes", text, "\n\n".join(parts), path if panels else None, _listed(notes))


def _listed(notes: Sequence[str]) -> str:
    return "\n".join(f"- {note}" for note in notes)


def _share(value: float, low: float | None, high: float | None) -> str:
    interval = "" if low is None or high is None else f" ({100 * low:.1f} to {100 * high:.1f})"
    return f"{100 * value:.1f} %{interval}"


def _signed(mean: float, low: float | None, high: float | None) -> str:
    return f"{100 * mean:+.1f}" + ("" if low is None or high is None else f" ({100 * low:+.1f} to {100 * high:+.1f})")
