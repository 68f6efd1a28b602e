"""`anytouch adapt`: tokens of its own for a sensor that a run has never seen."""

from __future__ import annotations

from anytouch_jax.cli.options_use import Adapt
from anytouch_jax.cli.output import check_home
from anytouch_jax.cli.unused import refuse
from anytouch_jax.cli.words import log
from anytouch_jax.config.parsing import COUNT, NOT_NEGATIVE, SEED, in_range


def run(options: Adapt) -> int:
    """Fit the tokens of a new sensor and write a run folder."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.encoder.adapt import adapt, check_empty, save
    from anytouch_jax.train.mesh import enable_compilation_cache

    in_range("--", options, seed=SEED, steps=COUNT, frames=NOT_NEGATIVE)
    if not options.frames:
        refuse(options, ("labels", "steps", "seed"), "with --frames 0, which fits nothing")
    check_empty(options.out)
    check_home(options.out)
    enable_compilation_cache()
    table = manifests.read([str(path) for path in options.data])
    found = adapt(
        options.run,
        table,
        options.sensor,
        frames=options.frames,
        labels=options.labels,
        steps=options.steps,
        seed=options.seed,
        log=log,
    )
    save(found, options.run, options.out)
    if not options.frames:
        print(f"{options.out}: {options.sensor} has the universal tokens")
        return 0
    where = "of split val" if found.measured == "val" else "that were fitted"
    print(
        f"{options.out}: tokens of {options.sensor} fitted to {options.frames} frames; "
        f"loss on frames {where} {found.before:.4f} -> {found.after:.4f}"
    )
    return 0
