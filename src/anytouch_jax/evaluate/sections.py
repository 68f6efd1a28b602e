"""The sections of a report: each draws its picture into the folder's figures/ and words its table."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.config import FIELD_SENSORS, Config, from_json
from anytouch_jax.data.images import decode
from anytouch_jax.data.loading.evaluation import evaluation
from anytouch_jax.data.manifest.files import read_file
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.prepare.contact import known_contact
from anytouch_jax.encoder.embed import text_column
from anytouch_jax.evaluate import matching, plots, probe_results, retrieval, statistics
from anytouch_jax.evaluate.figures import reconstruction_panels, write_png
from anytouch_jax.evaluate.geometry import Space
from anytouch_jax.evaluate.reconstruction import pixel_scores
from anytouch_jax.evaluate.retrieval import deepest_rows
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import checkpoint

Array = npt.NDArray[Any]
_SHOWN = 5  # touches in a sample grid
_SIDE = 200  # pixels of the longer side of a sample


@dataclass(frozen=True)
class Section:
    """A part of a report, in this order: text, figure, table (Markdown), notes."""

    title: str
    text: str = ""
    table: str = ""
    figure: Path | None = None
    notes: str = ""


def samples_section(manifest: Manifest, folder: Path, *, seed: int = 0) -> list[Section]:
    """A picture for each grade of alignment: rows are touches, columns the sensors and the photograph; captions below.

    The touches are those that most sensors felt, of different objects as far as there are.
    """
    rows = deepest_rows(manifest)
    grades = text_column(manifest, "grade")[rows] if "grade" in manifest.table.column_names else np.full(len(rows), "")
    return [_samples(manifest, folder, rows[grades == grade], str(grade), seed) for grade in np.unique(grades)]


def _samples(manifest: Manifest, folder: Path, rows: Array, grade: str, seed: int) -> Section:
    sensor, touch = text_column(manifest, "sensor")[rows], manifest.codes("touch", own=True)[rows]
    thing, names = text_column(manifest, "object")[rows], [str(one) for one in np.unique(sensor)]
    images, titles, captions = [], [], []
    for code in _spread_out(touch, sensor, thing, seed):
        of = {str(sensor[i]): int(rows[i]) for i in np.flatnonzero(touch == code)[::-1]}
        pictured = next((row for row in of.values() if manifest.value(row, "image_path") is not None), None)
        photo = None if pictured is None else _shrunk(decode(manifest.file(pictured, "image_path")))
        images.append([_picture(manifest, of.get(name)) for name in names] + [photo])
        titles.append(str(thing[np.flatnonzero(touch == code)[0]]) or f"touch {code}")
        texts = [manifest.value(row, "text") for row in of.values()]
        captions.append(next((" ".join(text.split()) for text in texts if text), "no caption"))
    plain = "".join(one if one.isalnum() else "_" for one in grade)
    path = folder / "figures" / f"samples{'_' if grade else ''}{plain}.png"
    plots.sample_grid(path, images, titles, [*names, "photograph"])
    notes = "\n".join(f"{i + 1}. *{title}*: {captions[i]}" for i, title in enumerate(titles))
    text = "Rows are touches, columns the sensors that felt them, each at its deepest frame; captions stand below."
    return Section(f"Samples{', ' if grade else ''}{grade}", text, figure=path, notes=notes)


def _spread_out(touch: Array, sensor: Array, thing: Array, seed: int) -> list[int]:
    """Touches felt by most sensors, one an object as long as there are objects."""
    codes, first = np.unique(touch, return_index=True)
    felt = np.array([len(set(sensor[touch == code])) for code in codes])
    order = np.lexsort((np.random.default_rng(seed).random(len(codes)), -felt))
    turns: dict[str, int] = {}
    turn = []
    for i in order:
        name = str(thing[first[i]])
        turn.append(turns.get(name, 0))
        turns[name] = turn[-1] + 1
    return [int(codes[i]) for _, i in sorted(zip(turn, order, strict=True), key=lambda pair: pair[0])][:_SHOWN]


def _picture(manifest: Manifest, row: int | None) -> Array | None:
    """The frame of a row; of a force-field sensor the size of its displacement (the first three channels), mm."""
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
    """The loss curves of runs {title: run folder}, and the first and last smoothed value of each term."""
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


def reconstructions_section(manifest: Manifest, run: Path, folder: Path) -> tuple[Section, dict[str, Any]]:
    """Hidden patches filled in by stage 1, and the next frame, on a test clip of each sensor; its errors in numbers."""
    params, text, _ = checkpoint.load_params(run)
    config = from_json(text)
    rows = manifest.rows_of("test")
    rows = rows[~np.isin(text_column(manifest, "sensor")[rows], FIELD_SENSORS)]
    frames = config.model.frames + 1
    moving = config.objective.next_frame and config.data.clip_share > 0  # else its head for clips was never trained
    ends = np.intersect1d(manifest.clips(frames, "test")[:, -1], rows) if moving else rows[:0]
    kind, frames = ("clip", frames) if len(ends) else ("still", 1)
    rows = _deepest_of_sensors(manifest, ends if len(ends) else rows)
    config = replace(config, data=replace(config.data, batch_size=len(rows), on_bad_sample="error"))
    _, batch = next(iter(evaluation(manifest, rows, config, kind, frames=frames, unknown="universal")))  # type: ignore[arg-type]
    params = {name: params[name] for name in ("touch", "decoder")}
    scores = _pixel_errors(params, manifest, ends, config)
    image = reconstruction_panels(params, batch.clip, batch.sensor, net=build(usable(config.model)), config=config)
    path = folder / "figures" / "reconstructions.png"
    write_png(path, image)
    names = ", ".join(text_column(manifest, "sensor")[rows])
    words = f"Stage 1 sees a quarter of the patches of an object it has never met; from above: {names}. " + (
        "The last pair is the frame that follows, and what is predicted of it." if frames > 1 else ""
    )
    title = "Reconstructions and next frames" if frames > 1 else "Reconstructions"
    return Section(title, words, _pixels_table(scores) if scores else "", path), scores


def _pixel_errors(params: Any, manifest: Manifest, ends: Array, config: Config, most: int = 240) -> dict[str, Any]:
    """Errors of stage 1 beside guesses without a model on up to `most` clips in contact, {} where there are none."""
    ends = ends[known_contact(manifest)[ends] != 0]  # or nothing is known
    if config.objective.norm_pix_loss or not len(ends):
        return {}
    ends = ends[np.linspace(0, len(ends) - 1, min(most, len(ends))).astype(int)]
    config = replace(config, data=replace(config.data, batch_size=min(48, len(ends))))
    return {"clips": len(ends)} | pixel_scores(params, manifest, ends, config)


def _pixels_table(scores: Mapping[str, Any]) -> str:
    """The errors of `_pixel_errors` as Markdown."""
    terms = {"reconstruction": "hidden patches", "next_frame": "next frame"}
    rivals = {"untouched": "untouched gel", "plain": "mean of the visible patches; copy of the last frame"}
    rivals = {kind: name for kind, name in rivals.items() if f"{kind} reconstruction" in scores}
    rows = [
        (words, *(f"{scores[key]:.4f}" for key in (term, *(f"{kind} {term}" for kind in rivals))))
        for term, words in terms.items()
    ]
    return statistics.markdown_table(
        (f"error on {scores['clips']} clips in contact", "stage 1", *rivals.values()), rows
    )


def _deepest_of_sensors(manifest: Manifest, rows: Array) -> Array:
    """The row of the largest force for each sensor, the last row without forces."""
    sensor = text_column(manifest, "sensor")[rows]
    force = np.array([manifest.value(int(row), "label.force") or 0.0 for row in rows], np.float64)
    order = np.lexsort((rows, force))
    return np.sort([rows[order][np.flatnonzero(sensor[order] == name)[-1]] for name in np.unique(sensor)])


def space_section(
    found: Sequence[Space], points: Mapping[str, Array], sensors: Array, objects: Array, folder: Path
) -> Section:
    """The t-SNE of each feature space {name: (n, 2)}, coloured by sensor and by object, and its figures."""
    path = folder / "figures" / "tsne.png"
    plots.tsne_panels(path, points, sensors, objects)
    head = ("features", "alignment", "uniformity", "silhouette by sensor", "silhouette by object", "touches")
    rows = [
        (one.name, *map(_number, (one.alignment, one.uniformity, one.silhouette_sensor, one.silhouette_object)),
         str(one.rows))
        for one in found
    ]  # fmt: skip
    text = (
        "The same touches by several sensors. Alignment: mean squared distance of one touch felt by two sensors (0 is "
        "best). Uniformity: lower is more even. Silhouette (-1 to 1): a low one by sensor and a high one by object is "
        "what alignment is for."
    )
    return Section("The space of touches", text, statistics.markdown_table(head, rows), path)


def retrieval_section(
    found: Mapping[str, Mapping[str, Sequence[retrieval.Retrieval]]], best: str, notes: Sequence[str], folder: Path
) -> tuple[Section, dict[str, dict[str, tuple[float, float | None, float | None]]]]:
    """Tables of retrieval {grade: {"matched" or "by chance": results}}, with what `best` is ahead of each other.

    Gives back the section and the paired differences in top-1 {grade: {features: (mean, low, high)}}.
    """
    rows, ahead, changes, panels = [], [], {}, {}
    for grade, kinds in found.items():
        pooled = {
            (one.name, kind, one.centred): one
            for kind, several in kinds.items() for one in several if one.query_sensor == retrieval.ALL
        }  # fmt: skip
        names = list(dict.fromkeys(name for name, _, _ in pooled))
        kind = "matched" if "matched" in kinds else "by chance"
        panels[f"{grade}, gallery {kind}"] = {
            name: plots.Bar(one.top1, one.low, one.high, one.chance1)
            for name in names for one in [pooled[name, kind, False]]
        }  # fmt: skip
        changes[grade] = _ahead(pooled, names, best, kind)
        for name in names:
            cells = [pooled.get((name, *key)) for key in _COLUMNS]
            plain = next(one for one in cells if one is not None)
            shares = [_share(one) for one in cells]
            fifth = _percent(cells[0].top5) if cells[0] is not None else "-"
            rows.append((grade, name, shares[0], fifth, *shares[1:], str(plain.gallery), str(plain.queries)))
        ahead += [(grade, name, _change(*change)) for name, change in changes[grade].items()]
    head = ("data", "features", "top-1 matched", "top-5 matched", "top-1 matched, centred", "top-1 by chance",
            "top-1 by chance, centred", "gallery", "queries")  # fmt: skip
    table = (
        statistics.markdown_table(head, rows) + f"\n\n{best}, top-1 ahead of the others (points, paired by query):\n\n"
    )
    table += statistics.markdown_table(("data", "features", f"{best} minus these"), ahead)
    path = folder / "figures" / "retrieval.png"
    if panels:
        plots.bars(path, panels, label="top-1")
    near = [one.nearness for kinds in found.values() for one in kinds.get("matched", ()) if one.nearness is not None]
    text = (
        "A touch by one sensor is looked for among touches by another. Matched galleries: the distractors are the "
        "nearest in " + (", ".join(_matched(found)) or "nothing") + "; by chance: any. Centred: without the mean of "
        "each sensor. In brackets: 95 % over objects drawn anew."
        + (f" Distractors lie at {np.mean(near):.2f} of the mean distance of all touches." if near else "")
    )
    listed = "\n".join(f"- {note}" for note in notes)
    return Section("Cross-sensor retrieval", text, table, path if panels else None, listed), changes


def matching_section(found: Sequence[matching.MatchScore], notes: Sequence[str]) -> Section:
    """How the matcher of stage 2 tells touches of one place from touches of others, both ways."""
    text = (
        "Did two touches, by two sensors, come from the same place (Eq. 5)? Positives and negatives count alike. "
        "Negatives are drawn from any sensor, which the two sensors alone partly give away, and from the positive's, "
        "where they give away nothing. What the sensors alone give is learned on half of the touches and scored on the "
        "other. In brackets: 95 % over objects drawn anew."
    )
    listed = "\n".join(f"- {note}" for note in notes)
    table = statistics.markdown_table(*matching.table(found)) if found else ""
    return Section("Cross-sensor matching", text, table, notes=listed)


_COLUMNS = (("matched", False), ("matched", True), ("by chance", False), ("by chance", True))


def _matched(found: Mapping[str, Mapping[str, Sequence[retrieval.Retrieval]]]) -> tuple[str, ...]:
    several = [one.matched for kinds in found.values() for one in kinds.get("matched", ())]
    return tuple(name.removeprefix("label.") for name in several[0]) if several else ()


def _ahead(pooled: Mapping[Any, retrieval.Retrieval], names: Sequence[str], best: str, kind: str) -> dict[str, Any]:
    if best not in names:
        return {}
    return {
        name: retrieval.difference(pooled[best, kind, False], pooled[name, kind, False])
        for name in names if name != best
    }  # fmt: skip


def probes_section(found: Mapping[str, Sequence[probe_results.Result]], notes: Sequence[str], folder: Path) -> Section:
    """Probes {label: results of several features}: accuracy of classes, R2 of quantities, on objects never seen."""
    parts, panels = [], {}
    for label, several in found.items():
        parts.append(f"### {label}\n\n{probe_results.probe_table(several).strip()}")
        classified = [one for one in several if isinstance(one, probe_results.ProbeResult)]
        if classified:
            panels[label] = {one.probe: plots.Bar(one.accuracy, one.low, one.high, one.baseline) for one in classified}
    path = folder / "figures" / "probes.png"
    if panels:
        plots.bars(path, panels, label="accuracy")
    text = "A linear probe on frozen features (class token and mean of patches), fitted on train, tested on test."
    listed = "\n".join(f"- {note}" for note in notes)
    return Section("Probes", text, "\n\n".join(parts), path if panels else None, listed)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def _share(one: retrieval.Retrieval | None) -> str:
    if one is None:
        return "-"
    between = "" if one.low is None or one.high is None else f" ({100 * one.low:.1f} to {100 * one.high:.1f})"
    return _percent(one.top1) + between


def _change(mean: float, low: float | None, high: float | None) -> str:
    return f"{100 * mean:+.1f}" + ("" if low is None or high is None else f" ({100 * low:+.1f} to {100 * high:+.1f})")
