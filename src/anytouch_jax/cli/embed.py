"""`anytouch embed`: features of a manifest, a folder of frames, a picture or a video."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.cli.output import check_folder, log, refuse_join, refuse_unused
from anytouch_jax.config import FIELD_SENSORS, UNIVERSAL, check_spelling
from anytouch_jax.config.parsing import Count
from anytouch_jax.errors import UserError
from anytouch_jax.progress import tracked

if TYPE_CHECKING:
    import numpy as np

    from anytouch_jax.data.background.rule import UnitGels
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.encoder.base import Preprocess
    from anytouch_jax.encoder.embed import Features
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.linear_head import ContactGate, LinearHead


@dataclass(frozen=True, kw_only=True)
class SensorOptions:
    """The options that embed, measure and stream share."""

    # Encoder: a name (`anytouch info encoders`), a run, a weights file, or hf://user/repo.
    model: Path = Path(DEFAULT)
    # Sensor of the frames. Without it, or if it is unknown, the universal tokens are used.
    sensor: str | None = None
    # Picture of the untouched gel: it is subtracted, and decides contact.
    background: Path | None = None
    # Turn the frames clockwise by so many degrees, before anything else.
    rotate: Literal[0, 90, 180, 270] = 0
    flip: Literal["none", "across", "down"] = "none"
    """Mirror the frames after that: across exchanges left and right, down exchanges top and
    bottom.
    """


@dataclass(frozen=True, kw_only=True)
class FrameOptions(SensorOptions):
    """The options that embed and stream share."""

    # Frames of a touch: 1 for stills, 3 or more for clips (in segments of three).
    frames: Count[int] = 1
    pooling: Literal["class", "mean", "both"] | None = None
    """Features: the class token, the mean of the patch tokens, or both (default: that of --head,
    else class).
    """
    join: Literal["mean", "sum", "concat"] = "mean"  # How the segments of a long clip are joined.
    dtype: Literal["trained", "float32", "bfloat16"] = "trained"
    """Arithmetic: that of training, or another. Use bfloat16 on GPUs and CPUs with AMX."""
    engine: Literal["auto", "xla", "onnxruntime", "openvino"] = "auto"
    """What computes the features: onnxruntime if it is installed (extra engines) and exact on this
    machine, else xla. An export is made for it once.
    """
    head: Path | None = None
    """Also predict the class with this head of `anytouch probe label --save`: its label,
    probability p, conformal set and whether the touch is novel.
    """


@dataclass(frozen=True, kw_only=True)
class EmbedOptions(FrameOptions):
    """Embed a manifest, a folder of frames, a picture or a video. Writes an .npz of features.

    Example: anytouch embed --data frames/ --sensor digit --out features.npz
    """

    # Manifests (.csv, .parquet), or one folder of frames, picture or video.
    data: tuple[Path, ...]
    out: Path  # The .npz to write: features (n, d), rows (n,), key/* (n,).
    split: str | None = None  # Only this split of a manifest.
    batch: Count[int] = 64  # Frames at a time.
    on_bad_sample: Literal["error", "skip"] = "error"
    """Stop at a row or picture that cannot be read, or skip it, count it and name the first."""
    # Also write the features into the LeRobot data set of the manifest, as this feature.
    column: str | None = None


def run(options: EmbedOptions) -> int:
    """Write the features as .npz."""
    from anytouch_jax.encoder.arrays import spread_lines

    data, is_manifest = options.data[0], takes_manifest(options, options.data, ("split", "column"))
    if data.is_file() and not is_manifest:
        refuse_unused(
            options, ("on_bad_sample",), "with a video, which cannot be read after a bad frame"
        )
    check_folder(options.out, read=(options.model, *options.data), suffix=".npz")
    encoder, pooling, head = load_inputs(options)
    about: dict[str, str] = {}
    if is_manifest:
        features = _embed_manifest(
            encoder, options, pooling, encoder.gels if head is None else head.gels
        )
    else:
        row, preprocess, gate, about = frames_input(
            encoder, options, data, encoder.gels if head is None else head.gels
        )
        features = _embed_frames(encoder, options, pooling, row, preprocess, gate)
        features.gels.update(gels_of(preprocess, options))
        log_universal(encoder, options)
    about |= {"pooling": pooling, "input": " ".join(map(str, options.data))}
    save_features(options.out, encoder, features, head, options, about)
    if options.column is not None:
        _write_columns(data.resolve().parent, options.column, features)
    for line in spread_lines(features.values):
        log(line)
    skipped = f", {features.skipped} skipped" if features.skipped else ""
    print(
        f"{options.out}: {len(features.values)} features of {features.values.shape[1]} "
        f"values{skipped}"
    )
    return 0


def takes_manifest(options: SensorOptions, data: Sequence[Path], of_rows: Sequence[str]) -> bool:
    """Return whether --data names manifests; else it is one folder, picture or video.

    Raises UserError.
    """
    if all(path.suffix.lower() in (".csv", ".parquet") for path in data):
        per_row = ("sensor", "background", "rotate", "flip")
        refuse_unused(
            options, per_row, "with a manifest, whose rows name their sensor and background"
        )
        return True
    if len(data) != 1:
        raise UserError(
            f"--data takes several manifests, or one folder or video, not {len(data)} paths"
        )
    if not data[0].exists():
        raise UserError(
            f"there is no manifest, folder or video at {data[0]}. Give another path with --data."
        )
    refuse_unused(options, of_rows, "with a folder or a video, which has no splits and no columns")
    return False


def load_inputs(
    options: FrameOptions,
) -> tuple[Encoder, Literal["class", "mean", "both"], LinearHead | None]:
    """Return the encoder, the pooling and the head that `options` name.

    Raises UserError if they do not fit.
    """
    from anytouch_jax.encoder.encoder import check_frames, load_encoder
    from anytouch_jax.encoder.linear_head import load_head
    from anytouch_jax.train.mesh import enable_compilation_cache

    head = None if options.head is None else load_head(options.head)
    pooling = options.pooling or ("class" if head is None else head.pooling)
    enable_compilation_cache()
    encoder = load_encoder(options.model, engine=options.engine).computed_in(options.dtype)
    if options.sensor is not None:
        check_spelling(options.sensor, encoder.config.model.sensors)
    if str(options.model) == DEFAULT:
        log(f"encoder: {DEFAULT} (name another with --model)")
    check_frames(encoder.config.model, options.frames)
    refuse_join(options, encoder.config.model.frames)
    if head is not None:
        head.check(encoder.source, encoder.fingerprint, pooling, options.frames, options.join)
    return encoder, pooling, head


def save_features(
    out: Path,
    encoder: Encoder,
    features: Features,
    head: LinearHead | None,
    options: FrameOptions,
    about: dict[str, str],
) -> None:
    """Write features to `out`, with what a `head` predicts, and metadata; log a sensor that is not
    the one named.
    """
    from anytouch_jax.encoder.embed import save_npz

    if head is not None and len(features.values):
        features = replace(
            features, predictions=features.predictions | _predictions(head, features.values)
        )
        sensors = features.keys.get("sensor")
        names = {options.sensor} - {None} if sensors is None else set(sensors.tolist())
        for name in sorted(map(str, names) if head.calibration is not None else ()):
            values = features.values if sensors is None else features.values[sensors == name]
            if head.calibration is not None and (
                warning := head.calibration.sensor_warning(head.scaled(values), name)
            ):
                log(warning)
    about |= {
        "encoder": encoder.source,
        "weights": encoder.fingerprint,
        "dtype": encoder.config.model.dtype,
    }
    save_npz(out, features, about | {"frames": str(options.frames), "join": options.join})


def _predictions(head: LinearHead, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the arrays that a head adds to features: label, p, and of a calibrated head set,
    classes and novelty.
    """
    if head.calibration is None:
        label, p = head(values)
        return {"label": label, "p": p.max(1)}
    assessed = head.assess(values)
    about = {
        "set": assessed.in_set,
        "classes": head.classes,
        "novelty": assessed.novelty,
        "novel": assessed.novel,
    }
    return {"label": assessed.label, "p": assessed.p.max(1), **about}


def frames_input(
    encoder: Encoder, options: SensorOptions, data: Path, known: Mapping[str, np.ndarray]
) -> tuple[int, Preprocess, ContactGate, dict[str, str]]:
    """Return sensor row, preprocessing, gate and metadata of frames, with a head's `known` gels.

    It logs the gel.
    """
    from anytouch_jax.data.background.rule import as_taken
    from anytouch_jax.encoder.base import Preprocess
    from anytouch_jax.encoder.linear_head import ContactGate

    row = encoder.sensor_row(options.sensor or UNIVERSAL, log)
    sensor = options.sensor or UNIVERSAL
    if options.background is not None and not encoder.subtracts:
        log(
            "--background only decides contact: this encoder was trained on frames without "
            "background subtraction"
        )
    known = {name: as_taken(gel, options.rotate, options.flip) for name, gel in known.items()}
    picture, background = choose_gel(encoder, options.background, data, known)
    preprocess = Preprocess(
        encoder, picture, rotate=options.rotate, flip=options.flip, known=known, log=log
    )
    about = {
        "background": background,
        "rotate": str(options.rotate),
        "sensor": sensor,
        "flip": options.flip,
    }
    return row, preprocess, ContactGate(preprocess, sensor), about


def choose_gel(
    encoder: Encoder, named: Path | None, data: Path, known: Mapping[str, np.ndarray]
) -> tuple[np.ndarray | None, str]:
    """Return the untouched gel of a folder, a video, a picture or a camera, and what it is, which
    is logged.

    It is the picture that the user named, that of the unit among the `known` ones, that of the
    folder, or the median of the frames. It is None for a camera, and for an encoder that does
    without. Raises UserError for too few frames.
    """
    from anytouch_jax.data.background import rule as gels
    from anytouch_jax.data.images import BACKGROUND, decode, list_images

    stored = list_images(data)[1].get(BACKGROUND) if data.is_dir() else None
    picture = None
    what = "not subtracted"
    count = 0
    if named is not None or (stored is not None and not (known and encoder.subtracts)):
        # type: ignore[arg-type]
        picture = decode(named or stored)
        what = str(named or stored) if encoder.subtracts else what
    elif encoder.subtracts and not data.exists():
        what = "a picture of the head, or a running estimate" if known else "a running estimate"
        what = what if known or encoder.needs_background else "not subtracted"
    elif encoder.subtracts:
        look, count = (decode(stored), 1) if stored else gels.recording_gel(_some_frames(data))
        gel, why = gels.same_unit(known, look)
        if why:
            log(gels.other_unit(why))
        if gel is not None and (not why or (not stored and count < gels.FEWEST)):
            picture = gel
            what = "the picture that the head was fitted with"
        elif stored or count >= gels.FEWEST:
            picture = look
            what = str(stored) if stored else f"estimated from {count} frames of {data}"
        elif encoder.needs_background:
            raise UserError(
                f"{data} has too few frames to estimate the untouched gel, which is subtracted. "
                f"Give {gels.FEWEST} or "
                "more, or a picture of the gel with nothing on it: --background, or background.png "
                "next to the frames."
            )
    if encoder.subtracts:
        log(f"untouched gel: {what}")
    return picture, what


def _some_frames(data: Path) -> Iterator[np.ndarray]:
    """Yield evenly spread frames of a folder, all frames of a video, or a picture.

    Broken ones are left out.
    """
    from contextlib import suppress

    from anytouch_jax.data import images
    from anytouch_jax.data.background.rule import FRAMES

    if (files := images.picture_files(data)) is None:
        yield from images.frames_from_video(data)
        return
    for file in files[:: -(-len(files) // FRAMES)]:
        with suppress(images.ImageError):
            yield images.decode(file)


def gels_of(preprocess: Preprocess, options: FrameOptions) -> dict[str, np.ndarray]:
    """Return the untouched gel that was subtracted, upright, by the name of the sensor."""
    from anytouch_jax.data.background.rule import reduced
    from anytouch_jax.data.transforms import orient_frame

    if (gel := preprocess.background) is None:
        return {}
    return {options.sensor or UNIVERSAL: reduced(orient_frame(gel, options.rotate, options.flip))}


def log_universal(encoder: Encoder, options: SensorOptions) -> None:
    """Warn about a missing --sensor, after the work: a mistake gets one sentence only."""
    if options.sensor is None and len(encoder.config.model.sensors) > 1:
        names = ", ".join(name for name in encoder.config.model.sensors if name != UNIVERSAL)
        log(f"no --sensor was given, so the universal tokens were used. Known sensors: {names}.")


def log_if_cut(video: Path, count: int) -> None:
    """Warn about a video whose header reports more than the `count` frames that could be read."""
    from anytouch_jax.data.images import count_frames

    reported = count_frames(video)
    if 0.98 * reported > count + 2:  # some containers only estimate it
        log(
            f"{video} reports {reported} frames and {count} could be read. The file may be "
            "incomplete."
        )


def _embed_manifest(
    encoder: Encoder, options: EmbedOptions, pooling: Any, known: Mapping[str, np.ndarray]
) -> Features:
    import numpy as np

    from anytouch_jax.data.background.rule import UnitGels
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.encoder import embed as embedding

    manifest = manifests.read(options.data)
    rows = np.arange(len(manifest)) if options.split is None else manifest.rows_of(options.split)
    usable = usable_rows(manifest, rows, options.frames)
    gels = UnitGels(manifest, known, log) if encoder.subtracts else None
    if gels is not None:
        log(gels.report(usable))
    rows, values = embedding.embed_rows(
        encoder,
        manifest,
        usable,
        options.frames,
        pooling,
        options.join,
        batch=options.batch,
        on_bad_sample=options.on_bad_sample,
        gels=gels,
        log=log,
    )
    keys = {
        name: manifest.text_column(name)[rows] for name in ("path", "sensor", "sequence", "split")
    }
    keys["frame_index"] = np.asarray(manifest.column("frame_index"))[rows]
    others = ("object", "unit", "index", "timestamp")
    more = [
        name for name in manifest.table.column_names if name in others or name.startswith("label.")
    ]
    keys |= {name: embedding.plain_column(manifest, name)[rows] for name in more}
    touched = {} if options.head is None else {"contact": contact_of_rows(manifest, rows, gels)}
    pictures = {} if gels is None else gels.pictures(rows)
    return embedding.Features(values, rows, keys, len(usable) - len(rows), touched, pictures)


def usable_rows(manifest: Manifest, rows: np.ndarray, frames: int) -> np.ndarray:
    """Return those of `rows` that have images and end a clip of `frames` frames; log how many
    others there are.
    """
    import numpy as np

    fields = np.isin(manifest.text_column("sensor")[rows], FIELD_SENSORS)
    if fields.any():
        log(f"{fields.sum()} rows of force-field sensors have no images and are left out")
        rows = rows[~fields]
    usable = rows if frames == 1 else np.intersect1d(rows, manifest.clips(frames)[:, -1])
    if len(usable) < len(rows):
        log(
            f"{len(rows) - len(usable)} of {len(rows)} rows end no clip of {frames} frames and are "
            "left out"
        )
    return usable


def contact_of_rows(
    manifest: Manifest, rows: np.ndarray, gels: UnitGels | None = None
) -> np.ndarray:
    """Return the contact of `rows` (n,): label.contact, or by the untouched gel; NaN if unknown."""
    import numpy as np

    from anytouch_jax.data.background import contact
    from anytouch_jax.data.background.rule import UnitGels

    known = contact.known_contact(manifest)[rows]
    limits = contact.threshold_of_rows(manifest, None, 0.0)[rows]
    unknown = rows[np.isnan(known)]
    score = contact.contact_scores(manifest, unknown, gels=gels or UnitGels(manifest)).score[rows]
    return np.where(np.isnan(known), np.where(np.isnan(score), np.nan, score > limits), known)


def _write_columns(root: Path, column: str, features: Features) -> None:
    """Write features into a LeRobot data set, a column for each camera.

    Raises UserError for another manifest.
    """
    import numpy as np

    from anytouch_jax.datasets.readers.lerobot import camera_names, write_features

    if "index" not in features.keys or not (root / "meta" / "info.json").is_file():
        raise UserError(
            "--column is for a manifest that `data index lerobot` wrote into the data set, not in "
            f"{root}"
        )
    unit = features.keys["unit"]
    numbers = features.keys["index"]
    cameras = np.unique(unit).tolist()
    names = (
        [column] if len(cameras) == 1 else [f"{column}.{name}" for name in camera_names(cameras)]
    )
    rows = [unit == camera for camera in cameras]
    write_features(
        root,
        {name: (features.values[own], numbers[own]) for name, own in zip(names, rows, strict=True)},
    )
    for name, own in zip(names, rows, strict=True):
        print(f"{root}: {own.sum()} features as {name}")


def _embed_frames(
    encoder: Encoder,
    options: EmbedOptions,
    pooling: Any,
    row: int,
    preprocess: Preprocess,
    gate: ContactGate,
) -> Features:
    """Embed every clip of consecutive frames of a folder or a video, keyed by its last frame."""
    import numpy as np

    from anytouch_jax.data.images import count_frames
    from anytouch_jax.encoder.embed import embed_frames

    data = options.data[0]
    times = list[float]()
    contact = list[float]()

    def frames() -> Iterator[tuple[int, str, np.ndarray | None]]:
        for number, name, frame in numbered_frames(data, options.on_bad_sample, times):
            contact.append(np.nan if frame is None else gate(frame))
            yield number, name, frame

    features = embed_frames(
        encoder,
        tracked(frames(), "frames embedded", count_frames(data)),
        row,
        preprocess,
        length=options.frames,
        pooling=pooling,
        join=options.join,
        batch=options.batch,
    )
    features.predictions["contact"] = np.asarray(contact)[features.rows]
    if "path" not in features.keys:
        log_if_cut(data, len(times))
        features.keys["time"] = np.asarray(times)[features.rows]
    return features


def numbered_frames(
    data: Path, on_bad_sample: str, times: list[float]
) -> Iterator[tuple[int, str, np.ndarray | None]]:
    """Yield number, name and RGB u8 pixels of each frame; the frames of a video have no names.

    A folder's pictures come in natural order. A picture that cannot be read is None if bad samples
    are skipped, and the first are logged. The time stamps of a video's frames are appended to
    `times`.
    """
    from anytouch_jax.data import images
    from anytouch_jax.data.loading.samples import NAMED
    from anytouch_jax.data.names import frame_numbers, split_series

    if not data.is_dir() and images.picture_files(data):
        yield 0, data.name, images.decode(data)
        return
    if not data.is_dir():
        for number, (seconds, frame) in enumerate(images.timed_frames(data)):
            times.append(seconds)
            yield number, "", frame
        return
    files, others = images.list_images(data)
    if others:
        log(f"{', '.join(file.name for file in others.values())}: not a frame, not embedded")
    # `start` is the first frame number of a finger: no clip spans two fingers
    start = skipped = 0
    for names in split_series([file.name for file in files]).values():
        numbers = [start + number for number in frame_numbers(names)]
        start = numbers[-1] + 2
        for number, name in zip(numbers, names, strict=True):
            try:
                yield number, name, images.decode(data / name)
            except images.ImageError as error:
                if on_bad_sample == "error":
                    raise
                if (skipped := skipped + 1) <= NAMED:
                    log(f"skipped: {error}")
                yield number, name, None
