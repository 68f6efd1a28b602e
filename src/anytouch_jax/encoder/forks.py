"""Forked processes: those of a process that has used jax cannot use it, and hang for ever instead of failing."""

from __future__ import annotations

import os
import sys

from anytouch_jax.errors import UserError

_inherited = False  # whether this process was forked from one whose jax was running


def _look() -> None:
    global _inherited
    bridge = sys.modules.get("jax._src.xla_bridge")  # jax has no public question for it
    is_running = getattr(bridge, "backends_are_initialized", lambda: bridge is not None)
    _inherited = _inherited or is_running()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_look)


def refuse_forked() -> None:
    """Raise UserError in a process that was forked after its parent had used jax."""
    if _inherited:
        raise UserError(
            "This process was forked from one that has used jax, so it cannot compute. Start workers with "
            'multiprocessing.get_context("spawn"), or load the encoder in the workers alone.'
        )
