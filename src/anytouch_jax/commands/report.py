"""`anytouch report`: what two runs learned of a manifest, as Markdown with figures."""

from __future__ import annotations

from anytouch_jax.commands.output import check_home
from anytouch_jax.commands.words import say
from anytouch_jax.options import Report


def run(options: Report) -> int:
    """Write report.md, report.json and figures/."""
    from anytouch_jax.evaluate.report import demo_report
    from anytouch_jax.train.mesh import enable_compilation_cache

    check_home(options.out)
    enable_compilation_cache()
    demo_report(
        options.data, options.stage1, options.stage2, options.out, say,
        touches=options.touches, gallery_size=options.gallery, seed=options.seed,
    )  # fmt: skip
    return 0
