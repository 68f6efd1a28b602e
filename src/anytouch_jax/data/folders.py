"""Folders of images: their frames in order, their background and their RGB image."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from anytouch_jax.data.containers import NUMPY, ContainerError, stack_rows
from anytouch_jax.data.manifest.schema import is_manifest
from anytouch_jax.data.names import frame_order
from anytouch_jax.data.pixels import ImageError

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".npy")
# names of images in a recording that are not frames
BACKGROUND = "background"
PHOTO = "photo"


def list_images(folder: str | Path) -> tuple[list[Path], dict[str, Path]]:
    """Return the frames of a folder in order (`frame_order`), and its other images by name.

    The others are called BACKGROUND and PHOTO. Arrays (.npy, .npz) count as frames only if there
    are no images, because recorders put other data beside the images as arrays. A stack of
    frames in one file is given as the paths of its frames, see `data.containers`. Warns if the
    names show no order.

    Raises:
        ImageError: If there are no frames.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ImageError(f"there is no folder {folder}; give another path")
    files = [
        file
        for file in folder.iterdir()
        if file.suffix.lower() in (*SUFFIXES, ".npz") and not file.name.startswith(".")
    ]
    named = {
        file.stem.lower(): file
        for file in files
        if file.stem.lower() in (BACKGROUND, PHOTO) and file.suffix.lower() in SUFFIXES
    }
    frames = [file for file in files if file.stem.lower() not in named]
    images = [file for file in frames if file.suffix.lower() not in NUMPY]
    stacks: dict[str, list[Path]] = {}
    if not images:
        stacks = _stacks(frames)
        frames = [file for file in frames if stacks.get(file.name) != []]
    frames = images or frames
    if not frames:
        raise ImageError(f"{folder} has no images ({', '.join(SUFFIXES)}){_suggestion(folder)}")
    names, is_clear = frame_order([file.name for file in frames])
    if not is_clear:
        warnings.warn(
            f"the names in {folder} show no order of its images: they come by name", stacklevel=2
        )
    in_order = [stacks.get(name, [folder / name]) for name in names]
    return [path for paths in in_order for path in paths], named


def _stacks(files: Sequence[Path]) -> dict[str, list[Path]]:
    """Return the frames of each stack among arrays, by the name of its file; none of other .npz.

    Raises ImageError for a file with two arrays of frames.
    """
    stacks = {}
    for file in files:
        try:
            arrays = stack_rows(file)
        except ContainerError as error:
            raise ImageError(str(error)) from None
        if arrays is None:
            continue
        if len(arrays) > 1:
            raise ImageError(
                f"{file} has {len(arrays)} arrays of frames: {', '.join(arrays)}; save one of them "
                "as .npy"
            )
        stacks[file.name] = next(iter(arrays.values()), [])
    return stacks


def image_files(path: Path) -> list[Path] | None:
    """Return the image at `path`, or the frames of a folder or a stack; None for a video.

    Raises ImageError for a folder or a stack without any.
    """
    if path.is_dir():
        return list_images(path)[0]
    if path.suffix.lower() in NUMPY and path.is_file():
        rows = _stacks([path]).get(path.name, [path])
        if not rows:
            raise ImageError(f"{path} has no array of frames (frames, height, width, 3)")
        return rows
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
