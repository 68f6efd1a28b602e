"""`anytouch report`: the evaluation of two runs on a manifest, as Markdown with figures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from anytouch_jax.cli.output import check_home, log
from anytouch_jax.config.parsing import Count, Range, Seed


@dataclass(frozen=True)
class ReportOptions:
    """Report on a stage-1 and a stage-2 run: samples, losses, reconstructions, t-SNE, retrieval and probes.

    Example: anytouch report --data data/scenes/manifest.parquet --stage1 runs/stage1 --stage2 runs/stage2 --out report
    """

    data: Path  # Manifest of simulated scenes, or one with the same columns.
    stage1: Path  # Run folder of stage 1.
    stage2: Path  # Run folder of stage 2.
    out: Path  # Folder for report.html (one file with its pictures), report.md, report.json, figures/.
    touches: Count[int] = 200  # Touches of the test split to use, and half as many of train and val.
    gallery: Annotated[int, Range(2, math.inf, "2 or more")] = 50  # Touches in a retrieval gallery.
    seed: Seed = 0  # Random seed.


def run(options: ReportOptions) -> int:
    """Write report.html, report.md, report.json and figures/."""
    from anytouch_jax.evaluate.report import demo_report
    from anytouch_jax.train.mesh import enable_compilation_cache

    check_home(options.out)
    enable_compilation_cache()
    demo_report(
        options.data, options.stage1, options.stage2, options.out, log,
        touches=options.touches, gallery_size=options.gallery, seed=options.seed,
    )  # fmt: skip
    return 0
