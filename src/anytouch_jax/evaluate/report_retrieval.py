"""Report sections on retrieval and matching of the same touch by another sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import plots, retrieval
from anytouch_jax.evaluate.pages import Section
from anytouch_jax.evaluate.plots import FractionBar
from anytouch_jax.evaluate.report_rows import grades_of
from anytouch_jax.evaluate.report_study import PIXELS, VECTOR, Study, baseline
from anytouch_jax.evaluate.report_words import Claim
from anytouch_jax.evaluate.retrieval import GALLERY
from anytouch_jax.evaluate.tables import markdown_table, score_text

__all__ = ["GALLERY", "matching_section", "retrieval_section", "study_retrieval"]

Change = tuple[float, float | None, float | None]  # a difference with its interval


def study_retrieval(study: Study, out: Path, size: int) -> tuple[Section | None, dict[str, Any]]:
    """Return retrieval of the test rows for each grade of alignment.

    Each is scored with matched galleries and with random ones. The section is None where nothing
    could be scored.
    """
    table = study.manifest
    rows = study.test(study.rows)
    notes = list(study.notes)
    features = {name: study.test(values) for name, values in study.classes.items()}
    features |= {f"{name} (patches)": study.test(values) for name, values in study.patches.items()}
    if study.pixels is not None:
        features[PIXELS] = study.test(study.pixels)
    vector, missing = baseline(VECTOR, lambda: retrieval.contact_vector(table, rows))
    if vector is not None:
        features[VECTOR] = vector
    notes += missing
    grades = grades_of(table, rows, "test")
    sensors = table.text_column("sensor")[rows]
    touch = table.codes("touch", own=True)[rows]
    results: dict[str, dict[str, list[retrieval.Retrieval]]] = {}
    for grade in map(str, np.unique(grades)):
        part = np.flatnonzero(grades == grade)
        counts = [
            len(np.unique(touch[part][sensors[part] == name])) for name in np.unique(sensors[part])
        ]
        least = min(counts)
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
    section, changes = retrieval_section(results, "stage 2", out)
    return section, {"found": results, "differences": changes, "notes": notes}


def retrieval_section(
    results: Mapping[str, Mapping[str, Sequence[retrieval.Retrieval]]],
    best: str,
    folder: Path,
) -> tuple[Section | None, dict[str, dict[str, Change]]]:
    """Return tables of retrieval, and paired differences to `best`.

    Args:
        results: {grade: {"matched" or "by chance": results}}.
        best: the features that are compared with the others.
        folder: of the report; the figure goes into its folder figures/.
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
            name: FractionBar(result.top1, result.low, result.high, result.chance1)
            for name, result in plain.items()
        }
        others = [name for name in plain if name != best] if best in plain else []
        changes[grade] = {name: retrieval.difference(plain[best], plain[name]) for name in others}
        for name, change in changes[grade].items():
            ahead.append((grade, name, score_text(*change, difference=True)))
        for name, result in plain.items():
            columns = [
                (way, centred) for way in ("matched", "by chance") for centred in (False, True)
            ]
            cells = [pooled.get((name, *column)) for column in columns]
            first = [
                "-" if one is None else score_text(one.top1, one.low, one.high) for one in cells
            ]
            fifth = "-" if cells[0] is None else score_text(cells[0].top5)
            rows.append((grade, name, first[0], fifth, *first[1:], result.gallery, result.queries))
    ways = (
        "recall@1 matched",
        "recall@5 matched",
        "recall@1 matched, centred",
        "recall@1 by chance",
        "recall@1 by chance, centred",
    )
    head = ("data", "features", *ways, "gallery", "queries")
    table = markdown_table(head, rows)
    table += f"\n\n{best}, recall@1 ahead of the others (points, paired by query):\n\n"
    table += markdown_table(("data", "features", f"{best} minus these"), ahead)
    path = folder / "figures" / "retrieval.png"
    if panels:
        plots.bars(path, panels, label="recall@1")
    matched = [result for kinds in results.values() for result in kinds.get("matched", ())]
    near = [result.nearness for result in matched if result.nearness is not None]
    covariates = "nothing"
    if matched:
        covariates = ", ".join(name.removeprefix("label.") for name in matched[0].matched)
    text = (
        "A touch by one sensor is retrieved among touches by another. In matched galleries the "
        f"distractors are the nearest in {covariates}; by chance they are random. Centred: minus "
        "the mean of each sensor. In brackets: 95 % under a bootstrap over objects."
    )
    if near:
        text += f" Distractors lie at {np.mean(near):.2f} of the mean distance of all touches."
    section = None
    if panels:
        text += " Dashes mark chance."
        section = Section("The same touch by another sensor", text, table, path)
    return section, changes


def retrieval_claims(changes: Mapping[str, Mapping[str, Change]], found: Any) -> list[Claim]:
    """Return what retrieval says of stage 2, beside the best features without training."""
    claims = []
    for grade, others in changes.items():
        kinds = found[grade]
        several = kinds.get("matched") or kinds["by chance"]
        of = {
            one.name: one
            for one in several
            if one.query_sensor == retrieval.ALL and not one.centred
        }
        names = [name for name in others if not name.startswith(("stage 1", "stage 2"))]
        if "stage 2" not in of or not names:
            continue
        best = max(names, key=lambda name: of[name].top1)
        own = of["stage 2"]
        told = score_text(own.top1, own.low, own.high)
        guess = f"{best} finds {score_text(of[best].top1)} and chance {score_text(own.chance1)}"
        what = f"the same touch by another sensor ({grade}) is first in"
        claims.append(Claim(what, told, guess, *others[best][1:]))
    return claims


def matching_section(study: Study, encoder: Encoder) -> tuple[Section | None, dict[str, Any]]:
    """Return the scores of the matching head of stage 2 on the test rows, None without a head.

    There is one for each kind of negatives.
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
        "positives. With negatives of any sensor, the two sensors alone reveal part of the answer. "
        "With negatives of the positive's sensor they do not. The rule of the sensors alone is "
        "learned on half of the touches and scored on the other. In brackets: 95 % under a "
        "bootstrap over objects."
    )
    names = {"any": "of any sensor", "same_sensor": "of the positive's sensor"}
    head = ("negatives", "accuracy (chance 50 %)", "AUC", "by the sensors alone", "triples")
    rows = [
        (
            names[score.negatives],
            score_text(score.accuracy, score.low, score.high),
            f"{score.auc:.3f}",
            score_text(score.sensors_alone),
            score.triples,
        )
        for score in scores
    ]
    section = None
    if rows:
        section = Section("Cross-sensor matching", text, markdown_table(head, rows))
    return section, {"found": scores, "notes": notes}
