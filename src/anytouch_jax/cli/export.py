"""`anytouch export`: a trained encoder as one file that needs jax alone."""

from __future__ import annotations

from anytouch_jax.cli.options_use import Export
from anytouch_jax.cli.output import check_folder
from anytouch_jax.cli.unused import refuse_join
from anytouch_jax.encoder.export import describes


def run(options: Export) -> int:
    """Write the artefact and its description, after a comparison with the live model; say how far they differ."""
    from anytouch_jax.encoder import encoder as features
    from anytouch_jax.encoder import export
    from anytouch_jax.train.mesh import enable_compilation_cache

    check_folder(options.out, read=(options.run,))
    enable_compilation_cache()
    encoder = features.load_encoder(options.run).computed_in(options.dtype)
    refuse_join(options, encoder.config.model.frames)
    platforms = [name.strip() for name in options.platforms.split(",") if name.strip()]
    about = export.export(
        encoder, options.out, frames=options.frames, platforms=platforms, pooling=options.pooling, join=options.join
    )
    worst = about["worst_difference"]
    print(f"{options.out}: {about['bytes'] / 1e6:.1f} MB for {', '.join(platforms)}; {about['input']}")
    print(f"at most {worst:.1e} of the largest feature from the live model (1 and 5 touches)")
    print(f"{describes(options.out)}: how to call it")
    return 0
