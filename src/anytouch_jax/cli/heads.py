"""The head that a command uses: the one that is named, or that of the encoder itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from anytouch_jax.cli.output import log

if TYPE_CHECKING:
    from anytouch_jax.encoder.linear_head import Head


def head_in_use(
    model: Path, named: Path | None, misfit: Callable[[Head], str] = lambda head: ""
) -> Head | None:
    """Return the head that a user named, else that which lies with the encoder.

    Args:
        model: the encoder.
        named: the head of --head.
        misfit: returns the options that the encoder's own head needs, "" if it fits. Else it is
            left out, which is logged.
    """
    from anytouch_jax.encoder.linear_head import find_head, load_head
    from anytouch_jax.weights import registry

    if named is not None:
        return load_head(named)
    if str(model).startswith("hf:"):  # `load_encoder` downloads it
        return None
    own = find_head(registry.locate(model))
    if own is None:
        return None
    head = load_head(own)
    needs = misfit(head)
    if needs:
        log(f"the head of {model} is not used: it needs {needs}")
        return None
    log(f"head: {own}, for {head.label}")
    return head
