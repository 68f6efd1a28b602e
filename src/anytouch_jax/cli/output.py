"""Where a command writes a manifest that it made from another one."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

if TYPE_CHECKING:
    from anytouch_jax.data.manifest.manifest import Manifest


def beside(manifest: Path, word: str, suffix: str | None = None) -> Path:
    """The default place of a result: `<name>_<word>` beside the manifest, with its ending unless `suffix` is given."""
    return manifest.with_name(f"{manifest.stem}_{word}{manifest.suffix if suffix is None else suffix}")


def check_new(manifest: Manifest, path: Path) -> Path:
    """The absolute path of a manifest that `write_new` can write: to be asked before long work. Raises UserError."""
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.manifest.schema import is_manifest

    target = path.expanduser().resolve()
    if target in manifest.files:
        raise UserError(f"{target} is the manifest that was read; name another file")
    if target.is_file() and not is_manifest(target):
        raise UserError(f"{target} is there and is no manifest; name another file with --out, or remove it")
    manifests.check_target(manifest, target)
    check_folder(target)
    return target


def write_new(manifest: Manifest, path: Path) -> Path:
    """Write `manifest` to `path`, whole or not at all. Raises UserError for one of the files that it was read from."""
    from anytouch_jax.data.manifest import manifest as manifests

    target = check_new(manifest, path)
    try:
        manifests.write(manifest, target)
    except OSError as error:
        raise UserError(f"{target} cannot be written: {error.strerror or error}") from None
    return target


def check_folder(path: Path, option: str = "--out", *, read: Iterable[str | Path] = ()) -> None:
    """Make the folder of a file that will be written after long work; `option` named it.

    Raises UserError where that cannot be, where `path` is a folder or a device, and where it is one of the files that
    are `read`.
    """
    try:
        if path.is_dir():
            raise UserError(f"{path} is a folder; name a file with {option}")
        if path.exists() and not path.is_file():
            raise UserError(f"{path} is no regular file; name one with {option}")
        if path.exists() and path.resolve() in {Path(one).expanduser().resolve() for one in read}:
            raise UserError(f"{path} is a file that is read; name another one with {option}")
        for folder in reversed(path.parents):
            if folder.exists() and not folder.is_dir():
                raise UserError(f"{folder} is a file, not a folder; choose another {option}")
        path.parent.mkdir(parents=True, exist_ok=True)
        writable = os.access(path.parent, os.W_OK)
    except OSError as error:
        raise UserError(
            f"the folder {path.parent} cannot be made: {error.strerror or error}; choose another {option}"
        ) from None
    if not writable:
        raise UserError(f"the folder {path.parent} cannot be written to; choose another {option}")


def check_apart(**outputs: Path | None) -> None:
    """Raise UserError where two outputs, by the names of their options, are one file: the second would replace the
    first."""
    named: dict[Path, str] = {}
    for name, path in outputs.items():
        if path is not None:
            option, place = f"--{name.replace('_', '-')}", path.expanduser().resolve()
            if place in named:
                raise UserError(f"{named[place]} and {option} name the same file; give each its own")
            named[place] = option


def check_home(folder: Path, option: str = "--out") -> None:
    """As `check_folder`, for a folder that will be filled after long work: its parents are made, it is not."""
    if folder.is_dir():
        if not os.access(folder, os.W_OK):
            raise UserError(f"the folder {folder} cannot be written to; choose another {option}")
        return
    if folder.exists():
        raise UserError(f"{folder} is a file, not a folder; choose another {option}")
    check_folder(folder, option)


def write_text(text: str, path: Path) -> Path:
    """Write a report to `path`, whole or not at all; its folder is made."""
    target = path.expanduser().resolve()
    try:
        atomic_write(target, text)
    except OSError as error:
        raise UserError(f"{target} cannot be written: {error.strerror or error}") from None
    return target
