"""Folders of images: their frames in order, their background and their RGB image."""

from __future__ import annotations

import warnings
from pathlib import Path

from anytouch_jax.data.manifest.schema import is_manifest
from anytouch_jax.data.names import frame_order
from anytouch_jax.data.pixels import ImageError

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".npy")
# names of images in a recording that are not frames
BACKGROUND = "background"
PHOTO = "photo"


def list_images(folder: str | Path) -> tuple[list[Path], dict[str, Path]]:
    """Return the frames of a folder in order (`frame_order`), and its other images by name.

    The others are called BACKGROUND and PHOTO. Arrays (.npy) count as frames only if there are no
    images, because recorders put other data beside the images as arrays. Warns if the names
    show no order.

    Raises:
        ImageError: If there are no frames.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ImageError(f"there is no folder {folder}; give another path")
    files = [
        file
        for file in folder.iterdir()
        if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")
    ]
    named = {file.stem.lower(): file for file in files if file.stem.lower() in (BACKGROUND, PHOTO)}
    frames = [file for file in files if file.stem.lower() not in named]
    images = [file for file in frames if file.suffix.lower() != ".npy"]
    frames = images or frames
    if not frames:
        raise ImageError(f"{folder} has no images ({', '.join(SUFFIXES)}){_suggestion(folder)}")
    names, is_clear = frame_order([file.name for file in frames])
    if not is_clear:
        warnings.warn(
            f"the names in {folder} show no order of its images: they come by name", stacklevel=2
        )
    return [folder / name for name in names], named


def image_files(path: Path) -> list[Path] | None:
    """Return the image at `path`, or the frames of a folder in order; None for a video.

    Raises ImageError for a folder without any.
    """
    if path.is_dir():
        return list_images(path)[0]
    if path.suffix.lower() in SUFFIXES:
        return [path]
    return None


def _suggestion(folder: Path) -> str:
    """Suggest what to use instead of a folder without images.

    That is its manifest, or `anytouch data index` for images in sub-folders.
    """
    entries = sorted(folder.iterdir())
    for file in entries:
        if file.suffix.lower() in (".csv", ".parquet") and is_manifest(file):
            return f"; give its manifest {file}"
    folders = [one for one in entries if one.is_dir() and not one.name.startswith(".")]
    below = (file for one in folders for file in one.rglob("*"))
    if any(file.suffix.lower() in SUFFIXES for file in below):
        command = f"anytouch data index recordings {folder} --sensor NAME"
        return f"; they lie in its sub-folders: {command} makes a manifest of them"
    return ""
