"""`anytouch train`: pre-train, or go on with a run."""

from __future__ import annotations

import signal

from anytouch_jax.commands.words import say
from anytouch_jax.config import Config
from anytouch_jax.options import Train


def run(options: Train, config: Config) -> int:
    """Train or go on; 0 also after SIGTERM (saved), 130 after Ctrl-C (saved)."""
    from anytouch_jax.pretrain import pretrain
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    result = pretrain(config, options.run, init=options.init, clip=options.clip, stop_after=options.stop_after, say=say)
    if result.interrupted == signal.SIGINT:
        return 130
    say(f"{options.run}: {result.step} of {config.run.steps} steps")
    return 0
