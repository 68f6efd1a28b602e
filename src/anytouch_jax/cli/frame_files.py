"""Frames of what a command is given: a folder, a stack, an image or a video."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from anytouch_jax.cli.output import log

if TYPE_CHECKING:
    import numpy as np

    from anytouch_jax.encoder.embed import NumberedFrame


def some_frames(data: Path) -> Iterator[np.ndarray]:
    """Yield evenly spread frames of a folder, all frames of a video, or an image.

    Broken ones are left out.
    """
    from anytouch_jax.data import images, stacks
    from anytouch_jax.data.background.rule import FRAMES

    stack = stacks.read_stack(data)
    if stack is not None:
        yield from stacks.stacked_frames(stack[:: -(-len(stack) // FRAMES)], data)
        return
    files = images.image_files(data)
    if files is None:
        yield from images.frames_from_video(data)
        return
    for file in files[:: -(-len(files) // FRAMES)]:
        with suppress(images.ImageError):
            yield images.decode(file)


def log_if_cut(video: Path, count: int) -> None:
    """Warn about a video whose header reports more than the `count` frames that could be read."""
    from anytouch_jax.data.images import count_frames

    reported = count_frames(video)
    # Some containers only estimate it.
    if 0.98 * reported > count + 2:
        log(
            f"{video} reports {reported} frames and {count} could be read. The file may be "
            "incomplete."
        )


def count_input_frames(data: Path) -> int:
    """Return the number of frames of a folder, a stack, an image or a video's header."""
    from anytouch_jax.data import images, stacks

    stack = stacks.read_stack(data)
    return images.count_frames(data) if stack is None else len(stack)


def numbered_frames(data: Path, on_bad_sample: str, times: list[float]) -> Iterator[NumberedFrame]:
    """Yield number, name and RGB u8 pixels of each frame.

    A folder's images come in natural order. The frames of a video or a stack have no names.

    Args:
        data: a folder, an image, a stack of frames (.npy, .npz) or a video.
        on_bad_sample: with "skip", an image that cannot be read is None, and the first are logged.
        times: the time stamps of a video's frames are appended to it, s.
    """
    from anytouch_jax.data import images, stacks

    stack = stacks.read_stack(data)
    if data.is_dir():
        yield from _frames_of_folder(data, on_bad_sample)
    elif stack is not None:
        for number, frame in enumerate(stacks.stacked_frames(stack, data)):
            yield number, "", frame
    elif images.image_files(data):
        yield 0, data.name, images.decode(data)
    else:
        for number, (seconds, frame) in enumerate(images.timed_frames(data)):
            times.append(seconds)
            yield number, "", frame


def _frames_of_folder(data: Path, on_bad_sample: str) -> Iterator[NumberedFrame]:
    """Yield number, name and pixels of the images of a folder."""
    from anytouch_jax.data import images
    from anytouch_jax.data.loading.samples import NAMED
    from anytouch_jax.data.names import frame_numbers, split_series

    files, others = images.list_images(data)
    if others:
        log(f"{', '.join(file.name for file in others.values())}: not a frame, not embedded")
    skipped = 0
    # The first frame number of a finger. Numbers of two fingers have a gap between them, because no
    # clip spans both.
    start = 0
    for names in split_series([file.relative_to(data).as_posix() for file in files]).values():
        numbers = [start + number for number in frame_numbers(names)]
        start = numbers[-1] + 2
        for number, name in zip(numbers, names, strict=True):
            try:
                yield number, name, images.decode(data / name)
            except images.ImageError as error:
                if on_bad_sample == "error":
                    raise
                skipped += 1
                if skipped <= NAMED:
                    log(f"skipped: {error}")
                yield number, name, None
