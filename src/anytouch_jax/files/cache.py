"""The user's cache folder, and old files in it."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

_DAY = 86400  # seconds


def cache_folder() -> Path:
    """Return the user's folder of what can be made again.

    It is anytouch_jax under $XDG_CACHE_HOME or ~/.cache. Where there is no home, as in a container
    with a user number that it does not know, it is a folder that cannot be made. So callers need no
    case of their own: they go on as with a home that cannot be written.
    """
    return _caches() / "anytouch_jax"


def _caches() -> Path:
    given = os.environ.get("XDG_CACHE_HOME")
    if given:
        return Path(given)
    try:
        return Path.home() / ".cache"
    except RuntimeError:  # no $HOME, and no entry for the user
        return Path(os.devnull)


def remove_old(folder: Path, pattern: str, days: float = 60) -> None:
    """Remove files that match a pattern and were not written or touched for so many days."""
    old = time.time() - days * _DAY
    for file in folder.glob(pattern):
        # another process may remove it, or own it
        with contextlib.suppress(OSError):
            if file.stat().st_mtime < old:
                file.unlink()
