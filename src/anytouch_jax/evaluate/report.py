"""The report of a stage-1 and a stage-2 run on a manifest: what they have learned."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import jax

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.arrays import Log
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import report_features, report_retrieval
from anytouch_jax.evaluate.pages import Section, write_report
from anytouch_jax.evaluate.report_features import LABELS
from anytouch_jax.evaluate.report_reconstructions import pixel_claims, reconstructions_section
from anytouch_jax.evaluate.report_rows import chosen_touches
from anytouch_jax.evaluate.report_runs import runs_section
from anytouch_jax.evaluate.report_stages import encoders_of
from anytouch_jax.evaluate.report_study import PIXELS, VECTOR, study_of
from anytouch_jax.evaluate.report_words import opening

# Section, write_report and the names of baselines were defined here.
__all__ = ["LABELS", "PIXELS", "VECTOR", "Section", "demo_report", "write_report"]

FEWEST = 4  # rows of test, for an interval of anything


def demo_report(
    manifest: str | Path,
    stage1: str | Path,
    stage2: str | Path,
    out: str | Path,
    log: Log = print,
    *,
    touches: int = 200,
    gallery_size: int = report_retrieval.GALLERY,
    seed: int = 0,
) -> Path:
    """Write a report of two runs on the split test of a manifest, and return the path of report.md.

    A report that fails leaves an earlier one in `out` unchanged.

    Args:
        manifest: of simulated scenes, or one with the same columns.
        stage1: run folder of stage 1.
        stage2: run folder of stage 2.
        out: folder of the report.
        log: is called with sentences on what is done.
        touches: the most of test, and half of it of train and of val, each with its deepest frame.
        gallery_size: touches in a retrieval gallery.
        seed: of what is drawn.

    Raises:
        UserError: also for a run of the other stage and for weights files.
    """
    clock = time.perf_counter()
    table = manifests.read(manifest)
    count = len(chosen_touches(table, "test", touches, seed))
    if count < FEWEST:
        most = len(chosen_touches(table, "test", len(table), seed))
        raise UserError(
            f"The report needs {FEWEST} frames of deepest contact. The split test gives {count} "
            f"with --touches {touches}, {most} at most. Give more touches."
        )
    runs = {"stage 1": Path(stage1), "stage 2": Path(stage2)}
    encoders = encoders_of(runs["stage 1"], runs["stage 2"], seed)
    first = encoders["stage 1"]
    second = encoders["stage 2"]
    numbers: dict[str, Any] = {"manifest": str(manifest), "data": table.content_hash}
    numbers |= {name.replace(" ", ""): str(run) for name, run in runs.items()}
    double = first.config.model.dtype == "float64"
    with tempfile.TemporaryDirectory(prefix="anytouch-report-") as folder, jax.enable_x64(double):
        drawn = Path(folder)
        parts: dict[str, tuple[Section | None, Any]] = {
            "pixels": reconstructions_section(table, first, drawn)
        }
        log("report: reconstructions are drawn")
        study = study_of(table, encoders, touches, seed, log)
        log(f"report: {len(study.rows)} frames embedded by {len(encoders)} encoders")
        parts["retrieval"] = report_retrieval.study_retrieval(study, drawn, gallery_size)
        parts["matching"] = report_retrieval.matching_section(study, second)
        log("report: retrieval is scored")
        parts["probes"] = report_features.probes_section(study, drawn)
        numbers |= {name: scored for name, (_, scored) in parts.items()}
        found = numbers["retrieval"]
        claims = [
            *report_retrieval.retrieval_claims(found["differences"], found["found"]),
            *report_features.probe_claims(numbers["probes"]["found"]),
            *pixel_claims(numbers["pixels"]),
        ]
        # Of what could not be scored there is no section, but nobody should miss it.
        for name in ("retrieval", "matching", "probes"):
            for note in numbers[name]["notes"]:
                log(f"report: {name}: {note}")
        sections = [section for section, _ in parts.values() if section is not None]
        sections.append(runs_section(table, runs, encoders, drawn))
        numbers["seconds"] = round(time.perf_counter() - clock, 1)
        path = write_report(
            Path(out),
            sections,
            title="What two runs have learned",
            lead=opening(claims, runs),
            numbers=numbers,
        )
    log(f"{path}: written in {numbers['seconds']:.0f} s")
    return path
