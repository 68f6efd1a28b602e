"""`anytouch measure`: depth, shear, contact and force of manifests, folders and videos."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from anytouch_jax.cli import frame_files, inputs
from anytouch_jax.cli.output import check_apart, check_folder, log
from anytouch_jax.config.parsing import Above0
from anytouch_jax.errors import UserError, handled
from anytouch_jax.progress import tracked

if TYPE_CHECKING:
    import numpy as np

    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.measured import Fields
    from anytouch_jax.fields.results import Results
    from anytouch_jax.fields.video import Video

_BATCH = 16  # frames, which are whole images of the camera
_INTERRUPTED = 130  # exit status


@dataclass(frozen=True, kw_only=True)
class MeasureOptions(inputs.SensorOptions):
    """Measure depth, shear, contact area and force in mm and N, with standard deviations.

    Example: anytouch measure --data press.mp4 --sensor digit --background gel.png --out press.npz

    OUT.csv, next to the .npz, has a line a frame: force, torque, depth, area, centre and slip.
    Ctrl-C ends the measurement, and what was measured is written.
    """

    # Manifests (.csv, .parquet), or one folder of frames, stack (.npy, .npz), image or video.
    data: tuple[Path, ...]
    # The .npz to write, with maps of every frame. Its numbers go to a .csv of the same name.
    out: Path
    width_mm: Above0[float | None] = None
    """What the width of the image shows, in mm. Known and fitted sensors need none. For others
    lengths are else fractions of it.
    """
    split: str | None = None  # Only this split of a manifest.
    # Video of the frames with depth, shear and force (.mp4, .avi), at the rate of the recording.
    video: Path | None = None
    ply: Path | None = None
    """Surface of the deepest frame, a mesh in mm (.ply): x to the right, y down, z away from the
    camera.
    """

    @property
    def table(self) -> Path:
        """The CSV file of numbers."""
        return self.out.with_suffix(".csv")


class _Touch(NamedTuple):
    """Frames (T, h, w, 3) that end with frame `name`, and how to measure them."""

    name: str
    time: float
    frames: np.ndarray
    sensor: str
    background: np.ndarray | None


class _Work(NamedTuple):
    """What is measured by which encoder, and the frames a second of a video of it."""

    options: MeasureOptions
    encoder: Encoder
    touches: Iterator[_Touch]
    rate: float
    is_manifest: bool


class _Deepest(NamedTuple):
    """The deepest frame so far, RGB u8 (h, w, 3), and its fields."""

    depth: float
    frame: np.ndarray
    measured: Fields


def run(options: MeasureOptions) -> int:
    """Write maps, numbers, and if asked a video and a surface; 130 after Ctrl-C."""
    from anytouch_jax.fields.results import Results
    from anytouch_jax.fields.video import Video

    work = _resolve(options)
    with contextlib.ExitStack() as stack:
        results = stack.enter_context(contextlib.closing(Results(options.out)))
        video = None
        if options.video is not None:
            video = stack.enter_context(contextlib.closing(Video(options.video, work.rate)))
        deepest, is_whole = _measure(work, results, video)
        if not len(results):
            raise UserError(
                f"there are no frames to measure in {options.data[0]}. Check the path, and --split."
            )
        out, table = _write(work, results, video, deepest, is_whole=is_whole)
        if not work.is_manifest:
            inputs.log_universal(work.encoder, options)
        print(f"{out} and {table}: {len(results)} frames")
    if is_whole:
        return 0
    log("interrupted: only the frames up to then were measured")
    return _INTERRUPTED


def _resolve(options: MeasureOptions) -> _Work:
    """Return what the options ask for, before any work.

    Mistakes in words and paths are named before the encoder is loaded. Raises UserError.
    """
    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.encoder.measured import missing

    is_manifest = inputs.takes_manifest(options, options.data, ("split",))
    read = (options.model, *options.data)
    check_folder(options.out, read=read, suffix=".npz")
    check_folder(options.table, read=read)
    check_folder(options.ply, "--ply", read=read, suffix=".ply")
    if options.video is not None:
        suffix = ".avi" if options.video.suffix == ".avi" else ".mp4"
        check_folder(options.video, "--video", read=read, suffix=suffix)
    check_apart(out=options.out, video=options.video, ply=options.ply)
    inputs.check_sensor(options)
    encoder = load_encoder(options.model)
    if not encoder.measures:
        raise missing(encoder.source)
    if is_manifest:
        from anytouch_jax.data.manifest import manifest as manifests

        manifest = manifests.read(options.data)
        touches = _of_manifest(encoder, options, manifest)
        return _Work(options, encoder, touches, _rate_of_rows(manifest), is_manifest)
    touches = _of_frames(encoder, options)
    return _Work(options, encoder, touches, _rate_of_frames(options.data[0]), is_manifest)


def _measure(work: _Work, results: Results, video: Video | None) -> tuple[_Deepest | None, bool]:
    """Write the fields of all touches as they come.

    Return the deepest frame, and whether nothing interrupted it. The first Ctrl-C, or SIGTERM, lets
    the batch at hand end, so that all results have the same frames.
    """
    from anytouch_jax.fields.images import overlay

    deepest: _Deepest | None = None
    asked = list[int]()

    def stop(number: int, _: Any) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    batches = _measured(work.encoder, work.touches, work.options.width_mm)
    with handled(stop, signal.SIGINT, signal.SIGTERM):
        for touches, measured in batches:
            names = [touch.name for touch in touches]
            results.add(measured, names, [touch.time for touch in touches])
            for row, touch in enumerate(touches):
                frame = touch.frames[-1]
                depth = float(measured.depth[row].max())
                if deepest is None or depth > deepest.depth:
                    deepest = _Deepest(depth, frame, measured[row])
                if video is not None:
                    video.add(overlay(frame, measured, row))
            if asked:
                return deepest, False
    return deepest, True


def _write(
    work: _Work,
    results: Results,
    video: Video | None,
    deepest: _Deepest | None,
    *,
    is_whole: bool,
) -> tuple[Path, Path]:
    """Move the results to their places, and return those of maps and numbers.

    Results of a part do not replace a file that is there: they get the name NAME.part.
    """
    from anytouch_jax.fields.images import write_surface

    options = work.options

    def place(path: Path) -> Path:
        if is_whole or not path.exists():
            return path
        return path.with_stem(f"{path.stem}.part")

    out = place(options.out)
    table = place(options.table)
    about = {"encoder": work.encoder.source, "weights": work.encoder.fingerprint}
    results.save(out, table, about)
    if options.ply is not None and deepest is not None:
        write_surface(place(options.ply), deepest.frame, deepest.measured)
    # Last, because only a video may turn out to be unwritable at its end.
    if video is not None and options.video is not None:
        video.finish(place(options.video))
    return out, table


def _measured(
    encoder: Encoder, touches: Iterator[_Touch], width_mm: float | None
) -> Iterator[tuple[Sequence[_Touch], Fields]]:
    """Yield touches of one sensor, background and size in batches, and their fields.

    Each warning is logged once.
    """
    import numpy as np

    logged = set[str]()

    def once(sentence: str) -> None:
        if sentence not in logged:
            logged.add(sentence)
            log(sentence)

    for _, group in groupby(
        touches, lambda touch: (touch.sensor, id(touch.background), touch.frames.shape)
    ):
        while part := tuple(islice(group, _BATCH)):
            frames = np.stack([touch.frames for touch in part])
            first = part[0]
            measured = encoder.measure(
                frames, first.background, first.sensor, width_mm=width_mm, log=once
            )
            yield part, measured


def _of_frames(encoder: Encoder, options: MeasureOptions) -> Iterator[_Touch]:
    """Yield every frame of a folder, a stack, an image or a video."""
    import numpy as np

    from anytouch_jax.config import UNIVERSAL
    from anytouch_jax.data.transforms import orient_frame

    data = options.data[0]
    length = encoder.config.model.frames
    gel, _ = inputs.choose_gel(encoder, options.background, data, {})
    background = None
    if gel is not None:
        background = orient_frame(gel, options.rotate, options.flip)
    times = list[float]()
    ring = list[np.ndarray]()
    last = -1
    for number, name, frame in tracked(
        frame_files.numbered_frames(data, "error", times),
        "frames measured",
        frame_files.count_input_frames(data),
    ):
        assert frame is not None  # an unreadable one is an error
        frame = np.ascontiguousarray(orient_frame(frame, options.rotate, options.flip))
        follows = number == last + 1 and ring and ring[-1].shape == frame.shape
        if not follows:
            # Before the first frame nothing moved.
            ring = [frame] * length
        ring = [*ring, frame][-length:]
        last = number
        time = times[-1] if times else float("nan")
        frames = np.stack(ring)
        yield _Touch(name or str(number), time, frames, options.sensor or UNIVERSAL, background)
    if times:
        frame_files.log_if_cut(data, len(times))


def _of_manifest(encoder: Encoder, options: MeasureOptions, manifest: Manifest) -> Iterator[_Touch]:
    """Yield the rows of manifests that have images.

    Before the first frame of a sequence nothing moved.
    """
    import numpy as np

    from anytouch_jax.data.background.rule import Backgrounds
    from anytouch_jax.data.images import decode
    from anytouch_jax.encoder.embed import rows_with_gel

    length = encoder.config.model.frames
    rows = np.arange(len(manifest)) if options.split is None else manifest.rows_of(options.split)
    rows = inputs.usable_rows(manifest, rows, 1)
    backgrounds = Backgrounds(manifest)
    if encoder.subtracts:
        log(backgrounds.report(rows))
    rows = rows_with_gel(encoder, backgrounds, rows, log)
    before = {later: earlier for earlier, later in manifest.clips(2).tolist()}
    sensors = manifest.text_column("sensor")
    image = lru_cache(length)(decode)  # a frame is in `length` clips, one after the other
    gel_of = backgrounds.shared(lambda gel: gel)
    for row in tracked(rows.tolist(), "frames measured", len(rows)):
        clip = [row]
        while len(clip) < length:
            clip.append(before.get(clip[-1], clip[-1]))
        frames = [image(manifest.file(one)) for one in reversed(clip)]
        last = frames[-1]
        frames = [frame if frame.shape == last.shape else last for frame in frames]
        gel = gel_of(row) if encoder.subtracts else None
        name = str(manifest.column("path")[row].as_py())
        yield _Touch(name, float("nan"), np.stack(frames), str(sensors[row]), gel)


def _rate_of_frames(data: Path) -> float:
    """Return the frames a second of a video; a folder, a stack or an image has a usual rate."""
    import cv2

    from anytouch_jax.data import images, stacks
    from anytouch_jax.fields.video import RATE

    if stacks.read_stack(data) is not None or images.image_files(data) is not None:
        return RATE
    video = images.open_video(data)
    try:
        rate = float(video.get(cv2.CAP_PROP_FPS))
    finally:
        video.release()
    return rate if _is_rate(rate) else RATE


def _rate_of_rows(manifest: Manifest) -> float:
    """Return the frames a second of the time stamps of a manifest, a usual rate without any."""
    import numpy as np

    from anytouch_jax.fields.video import RATE

    times = np.zeros(0)
    with contextlib.suppress(UserError):  # of text: the column is the user's own
        times = manifest.number_column("timestamp")
    pairs = manifest.clips(2)
    if not len(times) or not len(pairs):
        return RATE
    steps = times[pairs[:, 1]] - times[pairs[:, 0]]
    steps = steps[np.isfinite(steps) & (steps > 0)]
    rate = 1 / float(np.median(steps)) if len(steps) else 0.0
    return rate if _is_rate(rate) else RATE


def _is_rate(rate: float) -> bool:
    """Whether a number is one of frames a second, and not a header's rubbish."""
    return 0.1 <= rate <= 1000
