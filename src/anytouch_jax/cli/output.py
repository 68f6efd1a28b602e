"""Places where commands write, options that have no effect, and what commands print."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from anytouch_jax.cli.arguments import DEFAULT, spelled
from anytouch_jax.errors import UserError, shorten

if TYPE_CHECKING:
    from anytouch_jax.data.manifest.manifest import Manifest


def log(sentence: str) -> None:
    """Print a sentence that is not a result on standard error.

    Not by a console of rich: it would write past the bar that may be on the terminal, at the end of
    its line, and the bar would be drawn over it. The bar takes what goes to `sys.stderr`, and shows
    it above itself.
    """
    sys.stderr.write(shorten(sentence) + "\n")
    sys.stderr.flush()


def print_table(markdown: str) -> None:
    """Print a Markdown table, drawn by rich on a terminal."""
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console()
    if console.is_terminal:
        console.print(Markdown(markdown))
    else:
        print(markdown)


def log_default(models: Sequence[Path]) -> None:
    """Report the encoder that a command used because none was named. Call it after the work."""
    if not models:
        log(f"encoder: {DEFAULT} (name others with --model)")


def refuse_unused(options: Any, names: Sequence[str], reason: str) -> None:
    """Raise UserError for those of the options `names` that were changed.

    `reason` ends a sentence that begins "has no effect". An option without effect is refused,
    because a user who gives it expects one.
    """
    defaults = {field.name: field.default for field in fields(options)}
    changed = [spelled(name) for name in names if getattr(options, name) != defaults[name]]
    if changed:
        verb = "has" if len(changed) == 1 else "have"
        raise UserError(f"{', '.join(changed)} {verb} no effect {reason}. Remove it.")


def refuse_join(options: Any, segment: int) -> None:
    """Raise UserError for --aggregation where a touch has one segment of `segment` frames."""
    if (options.frames or 1) <= segment:
        refuse_unused(
            options,
            ("aggregation",),
            f"on touches of up to {segment} frames, which have one segment",
        )


def default_target(manifest: Path, word: str, suffix: str | None = None) -> Path:
    """Return the default place of a result: `<name>_<word>` in the folder of `manifest`."""
    if suffix is None:
        suffix = manifest.suffix
    return manifest.with_name(f"{manifest.stem}_{word}{suffix}")


def check_new(manifest: Manifest, path: Path) -> Path:
    """Return the absolute path of a manifest that `write_new` can write.

    Raises UserError, so that long work is not begun for nothing.
    """
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.manifest.schema import is_manifest

    target = path.expanduser().resolve()
    if target.is_file() and not is_manifest(target):
        raise UserError(
            f"{target} exists and is no manifest. Name another file with --out, or remove it."
        )
    manifests.placed(manifest, target)
    check_folder(target, read=manifest.files)
    return target


def write_new(manifest: Manifest, path: Path) -> Path:
    """Write `manifest` atomically to `path`.

    Raises UserError for one of the files that it was read from.
    """
    from anytouch_jax.data.manifest import manifest as manifests

    target = check_new(manifest, path)
    manifests.write(manifest, target)
    return target


def check_folder(
    path: Path | None, option: str = "--out", *, read: Iterable[str | Path] = (), suffix: str = ""
) -> None:
    """Make the folder of a file that will be written after long work, if there is one.

    Args:
        path: of the file.
        option: that named it.
        read: files that the command reads, which must not be written over.
        suffix: that its name must have.

    Raises:
        UserError: for a folder that cannot be made, for another suffix, and for a `path` that is a
            folder, a device or one of the files that are read.
    """
    if path is None:
        return
    if suffix and path.suffix.lower() != suffix:
        raise UserError(f"{path} must end in {suffix}. Choose another {option}.")
    try:
        if path.exists() and not path.is_file():
            kind = "a folder" if path.is_dir() else "no regular file"
            raise UserError(f"{path} is {kind}. Name a file with {option}.")
        if path.exists() and path.resolve() in {Path(file).expanduser().resolve() for file in read}:
            raise UserError(f"{path} is a file that is read. Name another one with {option}.")
        path.parent.mkdir(parents=True, exist_ok=True)
        writable = os.access(path.parent, os.W_OK)
    except OSError as error:
        reason = error.strerror or error
        raise UserError(
            f"the folder {path.parent} cannot be made: {reason}. Choose another {option}."
        ) from None
    if not writable:
        raise UserError(f"the folder {path.parent} cannot be written to. Choose another {option}.")


def check_home(folder: Path, option: str = "--out") -> None:
    """Check a folder that will be filled after long work.

    Its parents are made, the folder itself is not: it appears when it is whole.
    """
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder} is a file, not a folder. Choose another {option}.")
    if folder.is_dir():
        check_folder(folder / "file", option)
    else:
        check_folder(folder, option)


def check_apart(**outputs: Path | None) -> None:
    """Raise UserError where two outputs, by the names of their options, are the same file."""
    options: dict[Path, str] = {}
    for name, path in outputs.items():
        if path is not None:
            other = options.setdefault(path.expanduser().resolve(), name)
            if other != name:
                raise UserError(
                    f"{spelled(other)} and {spelled(name)} name the same file. Give each another "
                    "name."
                )
