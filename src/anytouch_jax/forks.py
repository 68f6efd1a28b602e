"""Fork check: a process that was forked after jax had started says so instead of hanging.

A fork copies the memory of a process and none of its threads except the one that forks. XLA
computes in threads of its own, so the first program in such a copy waits for them forever.

Nothing is registered at import. The first call of `refuse_forked`, which everything that computes
makes, registers a hook for later forks.
"""

import os
import sys
import threading

from anytouch_jax.errors import UserError

# The process that imported this module. It tells a fork that happened before the hook was there.
_IMPORTED_IN = os.getpid()
# for jax's own settings; both make it raise a RuntimeError where it would hang
_JAX_SETTINGS = ("jax_no_execution", "jax_no_tracing")

_watching = False
_inherited = False  # whether this process was forked from one whose jax was running


def refuse_forked() -> None:
    """Raise UserError in a process that was forked after its parent had used jax."""
    _watch()
    if _inherited:
        raise UserError(
            "This process was forked from one that has used jax, so it cannot compute. Start "
            'workers with multiprocessing.get_context("spawn"), or load the encoder in the '
            "workers alone."
        )


def _watch() -> None:
    """Register the hook, once a process. A fork before that is found by its traces."""
    global _watching
    if _watching:
        return
    _watching = True
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_look_after_fork)
    # The parent may have used jax itself, before it called anything of ours.
    is_fork = os.getpid() != _IMPORTED_IN
    if is_fork and _jax_is_running() and not _has_native_threads():
        _stop_jax()


def _look_after_fork() -> None:
    """Remember, in the child, whether the parent's jax was running."""
    if _inherited or _jax_is_running():
        _stop_jax()


def _jax_is_running() -> bool:
    # jax has no public question for it. An unknown jax that was imported counts as running.
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is None:
        return False
    asked = getattr(bridge, "backends_are_initialized", None)
    return True if asked is None else bool(asked())


def _has_native_threads() -> bool:
    """Return whether this process has threads that Python did not start, as a running XLA has.

    Where the system does not list them, there may be some.
    """
    try:
        threads = len(os.listdir("/proc/self/task"))
    except OSError:
        return True
    return threads > threading.active_count()


def _stop_jax() -> None:
    """Let jax raise instead of hang, for programs that do not come through our own check."""
    global _inherited
    _inherited = True
    for setting in _JAX_SETTINGS:
        # a new value also drops what jax has cached of the settings
        sys.modules["jax"].config.update(setting, True)
