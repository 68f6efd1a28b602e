"""`anytouch embed`: features of a manifest, a folder of frames, an image or a video."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from anytouch_jax.cli.frame_files import count_input_frames
from anytouch_jax.cli.frame_files import log_if_cut as log_if_cut
from anytouch_jax.cli.frame_files import numbered_frames as numbered_frames
from anytouch_jax.cli.inputs import FrameOptions as FrameOptions
from anytouch_jax.cli.inputs import FramesInput, Inputs
from anytouch_jax.cli.inputs import SensorOptions as SensorOptions
from anytouch_jax.cli.inputs import backgrounds_of as backgrounds_of
from anytouch_jax.cli.inputs import choose_gel as choose_gel
from anytouch_jax.cli.inputs import contact_of_rows as contact_of_rows
from anytouch_jax.cli.inputs import frames_input as frames_input
from anytouch_jax.cli.inputs import load_inputs as load_inputs
from anytouch_jax.cli.inputs import log_universal as log_universal
from anytouch_jax.cli.inputs import takes_manifest as takes_manifest
from anytouch_jax.cli.inputs import usable_rows as usable_rows
from anytouch_jax.cli.output import check_folder, log, refuse_unused
from anytouch_jax.config.parsing import Count
from anytouch_jax.errors import UserError
from anytouch_jax.progress import tracked

if TYPE_CHECKING:
    import numpy as np

    from anytouch_jax.data.background.rule import Backgrounds
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.encoder.embed import Features, NumberedFrame
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.linear_head import Head


@dataclass(frozen=True, kw_only=True)
class EmbedOptions(FrameOptions):
    """Embed a manifest, a folder of frames, an image or a video. Writes an .npz of features.

    Example: anytouch embed --data frames/ --sensor digit --out features.npz
    """

    # Manifests (.csv, .parquet), or one folder of frames, stack (.npy, .npz), image or video.
    data: tuple[Path, ...]
    out: Path  # The .npz to write: features (n, d), rows (n,), key/* (n,).
    split: str | None = None  # Only this split of a manifest.
    batch: Count[int] = 64  # Frames at a time.
    on_bad_sample: Literal["error", "skip"] = "error"
    """Stop at a row or image that cannot be read, or skip it, count it and name the first."""
    # Also write the features into the LeRobot data set of the manifest, as this feature.
    column: str | None = None


class _Rows(NamedTuple):
    """Rows of a manifest, and images of the untouched gel if the encoder subtracts them."""

    manifest: Manifest
    rows: np.ndarray
    backgrounds: Backgrounds | None


class _Work(NamedTuple):
    """What a command embeds, resolved from its options: by what, and rows or frames."""

    options: EmbedOptions
    inputs: Inputs
    source: _Rows | FramesInput


def run(options: EmbedOptions) -> int:
    """Write the features as .npz."""
    from anytouch_jax.encoder.arrays import spread_lines

    work = _resolve(options)
    encoder = work.inputs.encoder
    if isinstance(work.source, _Rows):
        features = _embed_rows(work, work.source)
        about: dict[str, str] = {}
    else:
        features = _embed_frames(work, work.source)
        about = work.source.about
        log_universal(encoder, options)
    about |= {"pooling": work.inputs.pooling, "input": " ".join(map(str, options.data))}
    save_features(options.out, encoder, features, work.inputs.head, options, about)
    if options.column is not None:
        _write_columns(options.data[0].resolve().parent, options.column, features)
    for line in spread_lines(features.values):
        log(line)
    skipped = f", {features.skipped} skipped" if features.skipped else ""
    print(
        f"{options.out}: {len(features.values)} features of {features.values.shape[1]} "
        f"values{skipped}"
    )
    return 0


def _resolve(options: EmbedOptions) -> _Work:
    """Return what the options ask for, before any work.

    Mistakes in words and paths are named before the encoder is loaded. Raises UserError.
    """
    data = options.data[0]
    is_manifest = takes_manifest(options, options.data, ("split", "column"))
    if data.is_file() and not is_manifest:
        refuse_unused(
            options, ("on_bad_sample",), "with a video, which cannot be read after a bad frame"
        )
    check_folder(options.out, read=(options.model, *options.data), suffix=".npz")
    inputs = load_inputs(options)
    if is_manifest:
        return _Work(options, inputs, _resolve_rows(options, inputs))
    return _Work(
        options, inputs, frames_input(inputs.encoder, options, data, inputs.known_backgrounds)
    )


def _resolve_rows(options: EmbedOptions, inputs: Inputs) -> _Rows:
    """Return the rows of manifests that can be embedded, and log the untouched gels."""
    import numpy as np

    from anytouch_jax.data.background.rule import Backgrounds
    from anytouch_jax.data.manifest import manifest as manifests

    manifest = manifests.read(options.data)
    rows = np.arange(len(manifest)) if options.split is None else manifest.rows_of(options.split)
    rows = usable_rows(manifest, rows, options.frames)
    backgrounds = None
    if inputs.encoder.subtracts:
        backgrounds = Backgrounds(manifest, inputs.known_backgrounds, log)
        log(backgrounds.report(rows))
    return _Rows(manifest, rows, backgrounds)


def _embed_rows(work: _Work, source: _Rows) -> Features:
    """Embed rows of manifests, keyed by their columns."""
    import numpy as np

    from anytouch_jax.encoder import embed as embedding

    options = work.options
    manifest = source.manifest
    settings = embedding.RowSettings(
        frames=options.frames,
        pooling=work.inputs.pooling,
        aggregation=options.aggregation,
        batch=options.batch,
        on_bad_sample=options.on_bad_sample,
    )
    rows, values = embedding.embed_with(
        work.inputs.encoder,
        manifest,
        source.rows,
        settings,
        backgrounds=source.backgrounds,
        log=log,
    )
    keys = {
        name: manifest.text_column(name)[rows] for name in ("path", "sensor", "sequence", "split")
    }
    keys["frame_index"] = np.asarray(manifest.column("frame_index"))[rows]
    others = ("object", "unit", "index", "timestamp")
    for name in manifest.table.column_names:
        if name in others or name.startswith("label."):
            keys[name] = embedding.plain_column(manifest, name)[rows]
    predictions = {}
    if work.inputs.head is not None:
        predictions["contact"] = contact_of_rows(manifest, rows, source.backgrounds)
    images = {} if source.backgrounds is None else source.backgrounds.images(rows)
    skipped = len(source.rows) - len(rows)
    return embedding.Features(values, rows, keys, skipped, predictions, images)


def _embed_frames(work: _Work, source: FramesInput) -> Features:
    """Embed every clip of consecutive frames of a folder or a video, keyed by its last frame."""
    import numpy as np

    from anytouch_jax.encoder.embed import embed_frames

    options = work.options
    data = options.data[0]
    times = list[float]()
    contact = list[float]()

    def frames() -> Iterator[NumberedFrame]:
        for number, name, frame in numbered_frames(data, options.on_bad_sample, times):
            contact.append(np.nan if frame is None else source.gate(frame))
            yield number, name, frame

    features = embed_frames(
        work.inputs.encoder,
        tracked(frames(), "frames embedded", count_input_frames(data)),
        source.row,
        source.preprocess,
        length=options.frames,
        pooling=work.inputs.pooling,
        aggregation=options.aggregation,
        batch=options.batch,
    )
    features.predictions["contact"] = np.asarray(contact)[features.rows]
    if times:
        log_if_cut(data, len(times))
        features.keys["time"] = np.asarray(times)[features.rows]
    features.backgrounds.update(backgrounds_of(source.preprocess, options))
    return features


def save_features(
    out: Path,
    encoder: Encoder,
    features: Features,
    head: Head | None,
    options: FrameOptions,
    about: dict[str, str],
) -> None:
    """Write features, with what a head predicts, and log a sensor that is not the one named.

    Args:
        out: the .npz.
        encoder: what computed them.
        features: what is written.
        head: what predicts from them, or None.
        options: those of the command.
        about: metadata, to which those of the encoder are added.
    """
    from anytouch_jax.encoder.embed import save_npz

    if head is not None and len(features.values):
        predictions = features.predictions | head.predictions(features.values)
        features = replace(features, predictions=predictions)
        named = None if options.sensor is None else options.sensor_name
        _log_other_sensors(head, features, named)
    about |= {
        "encoder": encoder.source,
        "weights": encoder.fingerprint,
        "dtype": encoder.config.model.dtype,
    }
    save_npz(
        out, features, about | {"frames": str(options.frames), "aggregation": options.aggregation}
    )


def _log_other_sensors(head: Head, features: Features, named: str | None) -> None:
    """Log if features look like another sensor than the one named, or that of their rows."""
    calibration = head.calibration
    if calibration is None:
        return
    sensors = features.keys.get("sensor")
    if sensors is None:
        parts = {} if named is None else {named: features.values}
    else:
        names = sorted(map(str, set(sensors.tolist())))
        parts = {name: features.values[sensors == name] for name in names}
    for name, values in parts.items():
        warning = calibration.sensor_warning(head.scaled(values), name)
        if warning:
            log(warning)


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
    names = [column]
    if len(cameras) > 1:
        names = [f"{column}.{name}" for name in camera_names(cameras)]
    rows = [unit == camera for camera in cameras]
    write_features(
        root,
        {name: (features.values[own], numbers[own]) for name, own in zip(names, rows, strict=True)},
    )
    for name, own in zip(names, rows, strict=True):
        print(f"{root}: {own.sum()} features as {name}")
