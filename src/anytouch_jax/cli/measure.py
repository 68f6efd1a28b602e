"""`anytouch measure`: depth, shear, contact and force of a manifest, a folder of frames, a picture
or a video.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from anytouch_jax.cli import embed
from anytouch_jax.cli.output import check_apart, check_folder, log
from anytouch_jax.config.parsing import Above0
from anytouch_jax.errors import UserError
from anytouch_jax.progress import tracked

if TYPE_CHECKING:
    import numpy as np

    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.fields.measure import Fields

_BATCH = 16  # frames, which are whole pictures of the camera


@dataclass(frozen=True, kw_only=True)
class MeasureOptions(embed.SensorOptions):
    """Measure depth, shear, contact area and force in mm and N, with standard deviations.

    Example: anytouch measure --data press.mp4 --sensor digit --background gel.png --out press.npz

    OUT.csv, next to the .npz, has a line a frame: force, torque, depth, area, centre and slip.
    """

    # Manifests (.csv, .parquet), or one folder of frames, picture or video.
    data: tuple[Path, ...]
    # The .npz to write, with maps of every frame. Its numbers go to a .csv of the same name.
    out: Path
    width_mm: Above0[float | None] = None
    """What the width of the picture shows, in mm. Known sensors need none. For others lengths are
    else shares of it.
    """
    split: str | None = None  # Only this split of a manifest.
    film: Path | None = None  # Film of the frames with depth, shear and force (.mp4, .avi).
    ply: Path | None = None  # Surface of the deepest frame, a mesh in mm (.ply).


class _Touch(NamedTuple):
    """Frames (T, h, w, 3) that end with frame `name`, and how to measure them."""

    name: str
    time: float
    frames: np.ndarray
    sensor: str
    background: np.ndarray | None


def run(options: MeasureOptions) -> int:
    """Write maps, numbers, and if asked a film and a surface."""
    import numpy as np

    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.fields import measure as fields
    from anytouch_jax.files import atomic_path

    is_manifest = embed.takes_manifest(options, options.data, ("split",))
    table = options.out.with_suffix(".csv")
    read = (options.model, *options.data)
    check_folder(options.out, read=read, suffix=".npz")
    check_folder(table, read=read)
    check_folder(options.ply, "--ply", read=read, suffix=".ply")
    if options.film is not None:
        check_folder(
            options.film,
            "--film",
            read=read,
            suffix=".avi" if options.film.suffix == ".avi" else ".mp4",
        )
    check_apart(out=options.out, film=options.film, ply=options.ply)
    encoder = load_encoder(options.model)
    if not encoder.measures:
        raise fields.missing(encoder.source)
    touches = (_of_manifest if is_manifest else _of_frames)(encoder, options)
    parts = list[fields.Fields]()
    names = list[str]()
    times = list[float]()
    lines = list[dict[str, Any]]()
    deepest: tuple[float, Any, Any] = (-np.inf, None, None)
    film = None if options.film is None else _Film(options.film)
    for some, measured in _measured(encoder, touches, options.width_mm):
        parts.append(measured)
        for row, touch in enumerate(some):
            line = measured.summary(row)
            names.append(touch.name)
            times.append(touch.time)
            lines.append(
                {
                    "frame": touch.name,
                    "time": None if touch.time != touch.time else touch.time,
                    **line,
                }
            )
            if film is not None:
                film.add(fields.overlay(touch.frames[-1], measured, row))
            if line["depth"] > deepest[0]:
                deepest = line["depth"], touch.frames[-1], measured[row]
    if film is not None:
        film.close()
    if not lines:
        raise UserError(
            f"there are no frames to measure in {options.data[0]}. Check the path, and --split."
        )
    if options.ply is not None:
        fields.write_surface(options.ply, *deepest[1:])
    with atomic_path(table) as part, open(part, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)
    arrays: dict[str, Any] = fields.stacked(parts) | {
        "name": np.array(names),
        "time": np.array(times),
    }
    arrays |= {
        "about/encoder": np.array(encoder.source),
        "about/weights": np.array(encoder.fingerprint),
    }
    with atomic_path(options.out) as part, open(part, "wb") as file:
        np.savez(file, **arrays)
    if not is_manifest:
        embed.log_universal(encoder, options)
    print(f"{options.out} and {table}: {len(lines)} frames")
    return 0


def _measured(
    encoder: Encoder, touches: Iterator[_Touch], width_mm: float | None
) -> Iterator[tuple[tuple[_Touch, ...], Fields]]:
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
            yield (
                part,
                encoder.measure(
                    frames, first.background, first.sensor, width_mm=width_mm, log=once
                ),
            )


def _of_frames(encoder: Encoder, options: MeasureOptions) -> Iterator[_Touch]:
    """Yield every frame of a folder, a picture or a video. Before the first frame nothing moved."""
    import numpy as np

    from anytouch_jax.config import UNIVERSAL
    from anytouch_jax.data.images import count_frames
    from anytouch_jax.data.transforms import orient_frame

    data = options.data[0]
    length = encoder.config.model.frames
    gel, _ = embed.choose_gel(encoder, options.background, data, {})
    times = list[float]()
    ring = list[np.ndarray]()
    last = -1
    background = None if gel is None else orient_frame(gel, options.rotate, options.flip)
    for number, name, frame in tracked(
        embed.numbered_frames(data, "error", times), "frames measured", count_frames(data)
    ):
        assert frame is not None  # an unreadable one is an error
        frame = np.ascontiguousarray(orient_frame(frame, options.rotate, options.flip))
        is_next = number == last + 1 and ring and ring[-1].shape == frame.shape
        ring = [*(ring if is_next else [frame] * length), frame][-length:]
        last = number
        time = times[-1] if times else float("nan")
        yield _Touch(
            name or str(number), time, np.stack(ring), options.sensor or UNIVERSAL, background
        )
    if times:
        embed.log_if_cut(data, len(times))


def _of_manifest(encoder: Encoder, options: MeasureOptions) -> Iterator[_Touch]:
    """Yield the rows of manifests that have images.

    Before the first frame of a sequence nothing moved.
    """
    import numpy as np

    from anytouch_jax.data.background.rule import UnitGels
    from anytouch_jax.data.images import decode
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.encoder.embed import rows_with_gel

    manifest = manifests.read(options.data)
    length = encoder.config.model.frames
    rows = np.arange(len(manifest)) if options.split is None else manifest.rows_of(options.split)
    rows = embed.usable_rows(manifest, rows, 1)
    gels = UnitGels(manifest)
    if encoder.subtracts:
        log(gels.report(rows))
    rows = rows_with_gel(encoder, gels, rows, log)
    before = {later: earlier for earlier, later in manifest.clips(2).tolist()}
    sensors = manifest.text_column("sensor")
    picture = lru_cache(length)(decode)
    gel_of = gels.shared(lambda gel: gel)
    for row in tracked(rows.tolist(), "frames measured", len(rows)):
        clip = [row]
        while len(clip) < length:
            clip.append(before.get(clip[-1], clip[-1]))
        frames = [picture(manifest.file(one)) for one in reversed(clip)]
        gel = gel_of(row) if encoder.subtracts else None
        same = [frame if frame.shape == frames[-1].shape else frames[-1] for frame in frames]
        yield _Touch(
            str(manifest.column("path")[row].as_py()),
            float("nan"),
            np.stack(same),
            str(sensors[row]),
            gel,
        )


class _Film:
    """A film of pictures RGB u8 of one size, that of the first: others are scaled to it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = (0, 0)
        self._writer: Any = None

    def add(self, picture: np.ndarray) -> None:
        import cv2

        if self._writer is None:
            code = "MJPG" if self._path.suffix == ".avi" else "mp4v"
            self._size = (picture.shape[1], picture.shape[0])
            self._writer = cv2.VideoWriter(
                str(self._path), cv2.VideoWriter.fourcc(*code), 30, self._size
            )
            if not self._writer.isOpened():
                raise UserError(
                    f"{self._path} cannot be written as a film on this computer. Name an .avi file."
                )
        shown = picture if picture.shape[1::-1] == self._size else cv2.resize(picture, self._size)
        self._writer.write(shown[..., ::-1])

    def close(self) -> None:
        if self._writer is not None:
            self._writer.release()
