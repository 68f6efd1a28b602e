"""Where a file of a manifest lies: always in the manifest's folder."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

from anytouch_jax.data.manifest.schema import ManifestError


def resolve(root: str | Path, relative: str | None) -> Path:
    """The file `relative` inside the folder `root` (absolute, resolved).

    Raises ManifestError when the path is empty, absolute, or leaves the folder by "..", or by a symbolic link.
    """
    if not relative:
        raise ManifestError("the path is empty")
    if "\0" in relative:
        raise ManifestError(f"the path {relative!r} is not a file name")
    root = str(root)
    head, _, name = relative.rpartition("/")
    # A folder is looked at once and each file for itself: that is most of the time that a path takes.
    path = f"{_real_folder(root, head)}/{name}"
    if name in ("", ".", "..") or os.path.islink(path):
        path = os.path.realpath(path)
    if relative[0] == "/":
        raise ManifestError(f"the path {relative!r} is absolute; write it relative to the manifest's folder, {root}")
    if not path.startswith(root if root[-1] == "/" else f"{root}/"):
        link = "" if ".." in relative.split("/") else ", by a link; put the files there, or the manifest beside them"
        raise ManifestError(f"the path {relative!r} leaves the folder of the manifest, {root}{link}")
    return Path(path)


@lru_cache(4096)
def _real_folder(root: str, head: str) -> str:
    folder = os.path.realpath(os.path.join(root, head))
    return "" if folder == "/" else folder
