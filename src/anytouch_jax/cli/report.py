"""`anytouch report`: what two runs learned of a manifest, as Markdown with figures."""

from __future__ import annotations

import math

from anytouch_jax.cli.options import Report
from anytouch_jax.cli.output import check_home
from anytouch_jax.cli.words import log
from anytouch_jax.config.parsing import COUNT, SEED, Range, in_range


def run(options: Report) -> int:
    """Write report.md, report.json and figures/."""
    from anytouch_jax.evaluate.report import demo_report
    from anytouch_jax.train.mesh import enable_compilation_cache

    in_range("--", options, touches=COUNT, gallery=Range(2, math.inf, "2 or more"), seed=SEED)
    check_home(options.out)
    enable_compilation_cache()
    demo_report(
        options.data, options.stage1, options.stage2, options.out, log,
        touches=options.touches, gallery_size=options.gallery, seed=options.seed,
    )  # fmt: skip
    return 0
