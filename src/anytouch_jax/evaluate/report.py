"""A report: sections of text, figures and tables as one Markdown file with its pictures and numbers beside it.

`demo_report` is the whole of it for a simulated manifest and the two runs trained on it.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.embed import embed_rows, text_column
from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import array_probes, geometry, matching, probe_results, retrieval, statistics
from anytouch_jax.evaluate.feature_cache import background_difference, principal_components
from anytouch_jax.evaluate.retrieval import contact_vector, deepest_rows
from anytouch_jax.evaluate.sections import (  # fmt: skip
    Section,
    losses_section,
    matching_section,
    probes_section,
    reconstructions_section,
    retrieval_section,
    samples_section,
    space_section,
)
from anytouch_jax.files import atomic_write
from anytouch_jax.weights import checkpoint

Array = npt.NDArray[Any]
Log = Callable[[str], None]

RANDOM, PIXELS, VECTOR = "random encoder", "pixels minus background", "area, centroid, force"
LABELS = ("hardness", "roughness", "material", "indenter")
QUANTITIES = ("force",)
_T_SNE_ROWS = 800
FEWEST = 4  # rows of a t-SNE


def write_report(
    folder: Path, sections: Sequence[Section], *, title: str = "Report", numbers: Mapping[str, Any] | None = None
) -> Path:
    """Write `folder`/report.md, report.json (`numbers`) and figures/; gives back the path of report.md.

    A figure from elsewhere is copied in. The pictures come first and report.md last, each in one move, so that a
    report that is there is whole. Raises UserError for a figure that is not there, OSError for a full disk.
    """
    lines = [f"# {title}"]
    drawn = [section.figure.name for section in sections if section.figure is not None]
    for number, section in enumerate(sections, 1):
        lines.append(f"## {section.title}")
        if section.text:
            lines.append(section.text.strip())
        if section.figure is not None:
            own = section.figure.name
            name = f"{number:02d}_{own}" if drawn.count(own) > 1 else own
            lines.append(f"![{section.title}](figures/{_placed(section.figure, folder / 'figures' / name)})")
        lines += [part.strip() for part in (section.table, section.notes) if part]
    if numbers is not None:
        atomic_write(folder / "report.json", json.dumps(statistics.plain(numbers), indent=2, allow_nan=False) + "\n")
    atomic_write(folder / "report.md", "\n\n".join(lines) + "\n")
    return folder / "report.md"


def _placed(figure: Path, target: Path) -> str:
    """The name of a figure, copied to its place in the report."""
    if not figure.is_file():
        raise UserError(f"there is no figure {figure} for the report; draw it first or leave it out")
    if figure.resolve() != target.resolve():
        atomic_write(target, figure.read_bytes())
    return target.name


@dataclass(frozen=True, eq=False)
class _Study:
    """The chosen rows of a manifest with the features of each encoder: class token and mean of patches apart."""

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
    """What two runs learned of a manifest, on its split test: samples, losses, pictures, space, retrieval, probes.

    `touches` bounds how many touches of test are looked at, and half as many of train and of val, each by its deepest
    frame. Writes the folder `out` as `write_report` does; gives back the path of report.md. Figures are drawn elsewhere
    until all is done, so that a report that fails leaves an earlier one as it was. Raises UserError, also for a run of
    the other stage, and for weights files.
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


def _of_stage(run: Path, stage: int) -> Encoder:
    """The encoder of a run. Raises UserError for a weights file, which has no losses to show, and for a run of the
    other stage."""
    if run.is_file():
        raise UserError(f"--stage{stage} {run} is a weights file; give the folder of a run of stage {stage}")
    encoder = load_encoder(run)
    if encoder.config.stage != stage:
        meant = "the one of stage 1 that it began from" if stage == 1 else "one of stage 2 that began from it"
        raise UserError(f"--stage{stage} {run} is a run of stage {encoder.config.stage}; give {meant}")
    return encoder


def _contents(
    table: Manifest, stage1: Path, stage2: Path, out: Path, log: Log, touches: int, gallery_size: int, seed: int
) -> tuple[list[Section], dict[str, Any]]:
    """The sections of a report, their figures drawn in `out`, and its numbers."""
    first, second = _of_stage(stage1, 1), _of_stage(stage2, 2)
    encoders = {RANDOM: random_encoder(first.config, seed), "stage 1": first, "stage 2": second}
    numbers: dict[str, Any] = {"data": table.content_hash, "stage1": str(stage1), "stage2": str(stage2)}
    sections = [_facts(table, first, second, _lineage(stage1, stage2)), *samples_section(table, out, seed=seed)]
    sections.append(losses_section({"stage 1": stage1, "stage 2": stage2}, out))
    section, numbers["pixels"] = reconstructions_section(table, stage1, out)
    sections.append(section)
    log("report: samples, losses and reconstructions are drawn")
    study = _study(table, encoders, touches, seed, log)
    log(f"report: {len(study.rows)} touches embedded by {len(encoders)} encoders")
    section, numbers["space"] = _space(study, out, seed)
    sections.append(section)
    log("report: t-SNE is drawn")
    section, numbers["retrieval"] = _retrieval(study, out, gallery_size)
    sections.append(section)
    section, numbers["matching"] = _matching(study, stage2)
    sections.append(section)
    log("report: retrieval and matching are scored")
    section, numbers["probes"] = _probes(study, out)
    return [*sections, section], numbers


def _lineage(stage1: Path, stage2: Path) -> str:
    """A sentence where a stage 2 did not begin from this stage 1, else nothing."""
    init = (checkpoint.read_metadata(stage2).get("source") or {}).get("init")
    if init is None:
        return "Stage 2 began from nothing trained, so this stage 1 is no part of it."
    began = Path(init)
    same = began.resolve() == stage1.resolve() or (not began.exists() and began.name == stage1.resolve().name)
    return "" if same else f"Stage 2 began from another run ({began.name}), so this stage 1 is no part of it."


def _facts(table: Manifest, first: Encoder, second: Encoder, lineage: str) -> Section:
    split, objects = text_column(table, "split"), text_column(table, "object")
    touch, sensors = table.codes("touch", own=True), text_column(table, "sensor")
    rows = []
    for name in manifests.SPLITS:
        here = split == name
        if here.any():
            felt = touch[here & (touch >= 0)]
            counts = (here.sum(), len(np.unique(felt)), len(set(objects[here]) - {""}))
            rows.append((name, *map(str, counts), ", ".join(sorted(set(sensors[here])))))
    text = (
        f"Data {table.content_hash[:12]}. Stage 1: preset {first.config.preset}, {first.config.run.steps} steps of "
        f"{first.config.data.batch_size}. Stage 2: {second.config.run.steps} steps of {second.config.data.batch_size}, "
        f"recipe {second.config.recipe}, towers {second.config.towers}. All figures below are of split test."
    )
    shown = (first.config.data.background, second.config.data.background)
    if shown[0] != shown[1]:
        lineage += f" Stage 1 sees touches with background {shown[0]}, stage 2 with background {shown[1]}."
    counted = statistics.markdown_table(("split", "frames", "touches", "objects", "sensors"), rows)
    return Section("Data and runs", text, counted, notes=f"**{lineage.strip()}**" if lineage else "")


def _check_touches(table: Manifest, touches: int, seed: int) -> None:
    """Raise UserError where split test has too few touches for a report, or too few are asked for."""
    there = len(_chosen(table, "test", touches, seed))
    if there < FEWEST:
        every = _chosen(table, "test", len(table), seed)
        count = len(np.unique(table.codes("touch", own=True)[every]))
        advice = "more --touches" if len(every) >= FEWEST else "simulate or record more"
        raise UserError(
            f"the manifest's test split has {count} touches, which give {there} frames to look at; a report needs "
            f"{FEWEST}: {advice}"
        )


def _study(table: Manifest, encoders: Mapping[str, Encoder], touches: int, seed: int, log: Log) -> _Study:
    most = {"train": touches // 2, "val": touches // 2, "test": touches}
    chosen = [_chosen(table, name, count, seed) for name, count in most.items()]
    rows = np.concatenate(chosen)
    classes, patches = {}, {}
    for name, encoder in encoders.items():
        found, values = embed_rows(encoder, table, rows, pooling="both", log=log)
        if not np.array_equal(found, rows):
            raise UserError(f"{len(rows) - len(found)} rows could not be read; repair the manifest first")
        classes[name], patches[name] = np.split(values, [encoder.config.model.embed], axis=1)
    pixels: Array | None = None
    notes: tuple[str, ...] = ()
    try:
        pixels = background_difference(table, rows)
    except UserError as error:
        notes = (f"no baseline by {PIXELS}: {error}",)
    return _Study(table, rows, text_column(table, "split")[rows], classes, patches, pixels, notes)


def _chosen(table: Manifest, split: str, touches: int, seed: int) -> Array:
    """Deepest rows of at most `touches` touches of a split, drawn whole; none of a split other than test if empty."""
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
    rows = study.test(study.rows)
    sensors, objects = text_column(study.manifest, "sensor")[rows], text_column(study.manifest, "object")[rows]
    touch = study.manifest.codes("touch", own=True)[rows]
    shown = np.sort(np.random.default_rng(seed).permutation(len(rows))[:_T_SNE_ROWS])
    found, points = [], {}
    for name, values in study.classes.items():
        here = study.test(values)
        found.append(geometry.describe(here, sensors, objects, touch, name=name))
        points[name] = geometry.tsne(here[shown], seed=seed)
    return space_section(found, points, sensors[shown], objects[shown], out), found


def _retrieval(study: _Study, out: Path, size: int) -> tuple[Section, dict[str, Any]]:
    """Retrieval of the test rows, each grade of alignment apart, with galleries matched and drawn by chance."""
    table, rows, notes = study.manifest, study.test(study.rows), list(study.notes)
    features = {name: study.test(values) for name, values in study.classes.items()}
    features |= {f"{name} (patches)": study.test(values) for name, values in study.patches.items()}
    features |= {} if study.pixels is None else {PIXELS: study.test(study.pixels)}
    try:
        features[VECTOR] = contact_vector(table, rows)
    except UserError as error:
        notes.append(f"no baseline by {VECTOR}: {error}")
    grades = text_column(table, "grade")[rows] if "grade" in table.table.column_names else np.full(len(rows), "test")
    found: dict[str, dict[str, list[retrieval.Retrieval]]] = {}
    for grade in map(str, np.unique(grades)):
        here = np.flatnonzero(grades == grade)
        least = _fewest(table, rows[here])
        if least < size:
            notes.append(f"{grade}: a sensor has {least} touches only, so galleries hold {least}, not {size}")
        for kind, match in (("matched", retrieval.COVARIATES), ("by chance", None)):
            try:
                found.setdefault(grade, {})[kind] = retrieval.cross_sensor_retrieval(
                    table, {name: values[here] for name, values in features.items()}, rows[here],
                    gallery_size=min(size, least), match=match, metrics={VECTOR: "euclidean"},
                )  # fmt: skip
            except UserError as error:
                notes.append(f"{grade}, gallery {kind}: not scored: {error}")
    section, changes = retrieval_section(found, "stage 2", notes, out)
    return section, {"found": found, "differences": changes, "notes": notes}


def _matching(study: _Study, run: Path) -> tuple[Section, dict[str, Any]]:
    """The matcher of stage 2 on the test rows."""
    found: list[matching.MatchScore] = []
    notes: list[str] = []
    try:
        features = study.test(study.classes["stage 2"])
        found = matching.score_matching(run, study.manifest, study.test(study.rows), features)
    except UserError as error:
        notes.append(f"not scored: {error}")
    return matching_section(found, notes), {"found": found, "notes": notes}


def _fewest(table: Manifest, rows: Array) -> int:
    """The fewest touches that a sensor has among `rows`."""
    sensors, touch = text_column(table, "sensor")[rows], table.codes("touch", own=True)[rows]
    return min(len(np.unique(touch[sensors == name])) for name in np.unique(sensors))


def _probes(study: _Study, out: Path) -> tuple[Section, dict[str, Any]]:
    """Probes of labels on objects never seen; a label that cannot be probed is named with its reason."""
    table, rows, notes = study.manifest, study.rows, list(study.notes)
    features = {name: np.concatenate([study.classes[name], study.patches[name]], 1) for name in study.classes}
    if study.pixels is not None:
        features[PIXELS] = principal_components(study.pixels, study.split == "train")
    objects, sequences = text_column(table, "object")[rows], text_column(table, "sequence")[rows]
    groups = np.where(objects == "", sequences, objects)
    found: dict[str, list[probe_results.Result]] = {}
    for label in (*LABELS, *QUANTITIES):
        name = f"label.{label}"
        if name not in table.table.column_names:
            notes.append(f"{label}: the manifest has no column {name}")
            continue
        values = [table.value(int(row), name) for row in rows]
        measured = any(isinstance(one, float) and one % 1 for one in values)
        found[label] = []
        try:
            for key, x in features.items():
                found[label].append(_probe(x, values, groups, study.split, key, measured))
        except UserError as error:
            notes.append(f"{label}: not probed: {error}")
    found = {label: several for label, several in found.items() if several}
    return probes_section(found, notes, out), {"found": found, "notes": notes}


def _probe(x: Array, labels: list[Any], groups: Array, split: Array, name: str, measured: bool) -> probe_results.Result:
    if measured:
        return array_probes.regression_probe(x, labels, groups, split, name=name)
    # Principal components keep their sizes: bringing each to unit spread would blow up the smallest.
    return array_probes.linear_probe(
        x, labels, groups, split, name=name, seeds=0, scaling="common" if name == PIXELS else "column"
    )
