"""What embed, measure, stream and others read: an encoder, frames or rows, and their background."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from anytouch_jax.cli import frame_files
from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.cli.heads import head_in_use
from anytouch_jax.cli.output import log, refuse_join, refuse_unused
from anytouch_jax.config import FIELD_SENSORS, UNIVERSAL, check_spelling
from anytouch_jax.config.parsing import Count
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from anytouch_jax.data.background.rule import Backgrounds
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.encoder.contact_gate import ContactGate
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.interface import Preprocess
    from anytouch_jax.encoder.linear_head import Head


@dataclass(frozen=True, kw_only=True)
class SensorOptions:
    """The options that embed, measure and stream share."""

    # Encoder: a name (`anytouch info encoders`), a run, a weights file, or hf://user/repo.
    model: Path = Path(DEFAULT)
    sensor: str | None = None
    """Sensor of the frames: a name, or a folder NAME.sensor of `anytouch sensor fit` or `sensor
    calibrate`. Without it, or if it is unknown, the universal tokens are used.
    """
    # Image of the untouched gel: it is subtracted, and decides contact.
    background: Path | None = None
    # Turn the frames clockwise by so many degrees, before anything else.
    rotate: Literal[0, 90, 180, 270] = 0
    flip: Literal["none", "across", "down"] = "none"
    """Mirror the frames after that: across exchanges left and right, down exchanges top and
    bottom.
    """

    @property
    def sensor_name(self) -> str:
        """The name that the word of --sensor stands for. Raises UserError for a damaged folder."""
        from anytouch_jax.encoder.sensor_words import resolve_sensor

        return resolve_sensor(self.sensor or UNIVERSAL).name


@dataclass(frozen=True, kw_only=True)
class FrameOptions(SensorOptions):
    """The options that embed and stream share."""

    # Frames of a touch: 1 for stills, 3 or more for clips (in segments of three).
    frames: Count[int] = 1
    pooling: Literal["class", "mean", "both"] | None = None
    """Features: the class token, the mean of the patch tokens, or both (default: that of --head,
    else class).
    """
    aggregation: Literal["mean", "sum", "concat"] = "mean"
    """How the segments of a long clip are joined."""
    dtype: Literal["trained", "float32", "bfloat16"] = "trained"
    """Arithmetic: that of training, or another. Use bfloat16 on GPUs and CPUs with AMX."""
    engine: Literal["auto", "xla", "onnxruntime", "openvino"] = "auto"
    """What computes the features: onnxruntime if it is installed (extra engines) and exact on this
    machine, else xla. An export is made for it once.
    """
    head: Path | None = None
    """Also predict the class with this head of `anytouch probe label --save`: its label,
    probability p, conformal set and whether the touch is novel (default: that of --model, if
    `anytouch finetune` made it).
    """


def takes_manifest(options: SensorOptions, data: Sequence[Path], of_rows: Sequence[str]) -> bool:
    """Return whether --data names manifests; else it is one folder, image or video.

    Args:
        options: those of the command.
        data: the paths of --data.
        of_rows: options that only manifests have.

    Raises:
        UserError: paths that do not go together, and options that have no effect.
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
    from anytouch_jax.data.containers import kind_of

    kind = kind_of(data[0])
    if kind in ("hdf5", "zarr"):
        raise UserError(
            f"{data[0]} is {kind}, which can hold several cameras and recordings. Make a manifest "
            f"of it: anytouch data index {kind} {data[0]} --sensor NAME"
        )
    refuse_unused(options, of_rows, "with a folder or a video, which has no splits and no columns")
    return False


def check_sensor(options: SensorOptions) -> None:
    """Raise UserError for a sensor that is misspelt or damaged, before the encoder is loaded.

    Loading takes seconds. Where only the weights name their sensors, `load_inputs` checks again.
    """
    from anytouch_jax.encoder.sensor_words import resolve_sensor

    if options.sensor is None:
        return
    word = resolve_sensor(options.sensor)
    stored = _stored_sensors(options.model)
    if not word.is_fitted and stored is not None:
        check_spelling(word.name, stored)


def _stored_sensors(model: Path) -> tuple[str, ...] | None:
    """Return the sensors of an encoder as its files state them, None if they do not."""
    from anytouch_jax.config import parse_json
    from anytouch_jax.weights import registry, safetensors

    if str(model).startswith("hf:"):  # it would be downloaded
        return None
    path = registry.locate(model)
    stated: Any = None
    # What is damaged is reported by the reader of weights.
    with suppress(UserError, OSError, ValueError, KeyError, TypeError):
        if path.is_dir():
            stated = parse_json((path / "config.json").read_bytes())["model"]["sensors"]
        elif path.suffix == ".safetensors" and path.is_file():
            metadata = safetensors.read_file_metadata(path)
            stated = parse_json(metadata[safetensors.MODEL_KEY])["sensors"]
    return tuple(map(str, stated)) if isinstance(stated, list) else None


class Inputs(NamedTuple):
    """The encoder, the pooling and the head that options name."""

    encoder: Encoder
    pooling: Literal["class", "mean", "both"]
    head: Head | None

    @property
    def known_backgrounds(self) -> dict[str, np.ndarray]:
        """Images of the untouched gel that the head, or an exported encoder, was fitted with."""
        return self.encoder.backgrounds if self.head is None else self.head.backgrounds


def load_inputs(options: FrameOptions) -> Inputs:
    """Return the encoder, the pooling and the head that `options` name.

    Raises UserError if they do not fit.
    """
    from anytouch_jax.encoder.encoder import check_frames, load_encoder
    from anytouch_jax.encoder.sensor_words import resolve_sensor
    from anytouch_jax.train.mesh import enable_compilation_cache

    check_sensor(options)
    word = resolve_sensor(options.sensor or UNIVERSAL)
    head = head_in_use(options.model, options.head, partial(_fits, options))
    pooling = options.pooling
    if pooling is None:
        pooling = "class" if head is None else head.pooling
    enable_compilation_cache()
    encoder = load_encoder(options.model, engine=options.engine).computed_in(options.dtype)
    if not word.is_fitted:
        check_spelling(word.name, encoder.config.model.sensors)
    if str(options.model) == DEFAULT:
        log(f"encoder: {DEFAULT} (name another with --model)")
    check_frames(encoder.config.model, options.frames)
    refuse_join(options, encoder.config.model.frames)
    if head is not None:
        head.check(
            encoder.source, encoder.fingerprint, pooling, options.frames, options.aggregation
        )
    return Inputs(encoder, pooling, head)


def _fits(options: FrameOptions, head: Head) -> str:
    """Return the options that a head needs and does not have, "" if it fits."""
    wrong = []
    if options.pooling not in (None, head.pooling):
        wrong.append(f"--pooling {head.pooling}")
    if options.frames != head.frames:
        wrong.append(f"--frames {head.frames}")
    if options.aggregation != "mean":
        wrong.append("--aggregation mean")
    return " ".join(wrong)


class FramesInput(NamedTuple):
    """How frames of one sensor are prepared: its row, preprocessing, contact, and metadata."""

    row: int
    preprocess: Preprocess
    gate: ContactGate
    about: dict[str, str]


def frames_input(
    encoder: Encoder, options: SensorOptions, data: Path, known: Mapping[str, np.ndarray]
) -> FramesInput:
    """Return how the frames of `data` are prepared, and log the untouched gel.

    Args:
        encoder: whose features the frames are for.
        options: of the command: sensor, background and orientation.
        data: a folder, an image, a stack of frames or a video.
        known: images of the untouched gel u8 (h, w, 3) that a head was fitted with, by name.
    """
    from anytouch_jax.data.background.rule import as_taken
    from anytouch_jax.encoder.contact_gate import ContactGate
    from anytouch_jax.encoder.interface import Preprocess

    row = encoder.sensor_row(options.sensor or UNIVERSAL, log)
    sensor = options.sensor_name
    if options.background is not None and not encoder.subtracts:
        log(
            "--background only decides contact: this encoder was trained on frames without "
            "background subtraction"
        )
    # Images of a head are upright, and the camera's may not be.
    known = {name: as_taken(gel, options.rotate, options.flip) for name, gel in known.items()}
    image, background = choose_gel(encoder, options.background, data, known)
    preprocess = Preprocess(
        encoder, image, rotate=options.rotate, flip=options.flip, known=known, log=log
    )
    about = {
        "background": background,
        "rotate": str(options.rotate),
        "sensor": sensor,
        "flip": options.flip,
    }
    return FramesInput(row, preprocess, ContactGate(preprocess, sensor), about)


def choose_gel(
    encoder: Encoder,
    named: Path | None,
    data: Path,
    known: Mapping[str, np.ndarray],
    of: str = "the head was fitted with",
) -> tuple[np.ndarray | None, str]:
    """Return the untouched gel of a folder, a video, an image or a camera, and what it is.

    What it is is logged, too. It is the image that the user named, that of the same unit among
    the `known` ones, that of the folder, or the median of the frames. It is None for a camera, and
    for an encoder that does without.

    Args:
        encoder: what it is for.
        named: the file that the user named.
        data: where the frames are.
        known: images of units that a head was fitted with.
        of: what the known images belong to, in words.

    Raises:
        UserError: there are too few frames.
    """
    from anytouch_jax.data.images import BACKGROUND, decode, list_images

    stored = list_images(data)[1].get(BACKGROUND) if data.is_dir() else None
    file = named
    # An image that lies beside the frames counts less than one of a head, see `rule`.
    if file is None and not (known and encoder.subtracts):
        file = stored
    image: np.ndarray | None = None
    if file is not None:
        image = decode(file)
        what = str(file)
    elif not encoder.subtracts:
        return None, "not subtracted"
    elif data.exists():
        image, what = _recording_gel(encoder, data, stored, known, of)
    else:
        what = _live_gel(encoder, known)
    if not encoder.subtracts:  # the image decides contact
        return image, "not subtracted"
    log(f"untouched gel: {what}")
    return image, what


def _live_gel(encoder: Encoder, known: Mapping[str, np.ndarray]) -> str:
    """Return what the untouched gel of a camera will be: `Preprocess` chooses it at run time."""
    if known:
        return "an image of the head, or a running estimate"
    if encoder.needs_background:
        return "a running estimate"
    return "not subtracted"


def _recording_gel(
    encoder: Encoder, data: Path, stored: Path | None, known: Mapping[str, np.ndarray], of: str
) -> tuple[np.ndarray | None, str]:
    """Return the untouched gel of a folder, a video or an image, and what it is."""
    from anytouch_jax.data.background import rule
    from anytouch_jax.data.images import decode

    if stored is not None:
        own = decode(stored)
        what = str(stored)
        is_sure = True
    else:
        own, count = rule.recording_gel(frame_files.some_frames(data))
        what = f"estimated from {count} frames of {data}"
        is_sure = count >= rule.FEWEST
    counts = rule.recognise(known, own, is_background=is_sure, untouched=stored is not None, of=of)
    if counts.warning:
        log(counts.warning)
    if counts.image is not None:
        return counts.image, counts.what
    if is_sure:
        return own, what
    if encoder.needs_background:
        raise UserError(
            f"{data} has too few frames to estimate the untouched gel, which is subtracted. Give "
            f"{rule.FEWEST} or more, or an image of the gel with nothing on it: --background, or "
            "background.png next to the frames."
        )
    return None, "not subtracted"


def backgrounds_of(preprocess: Preprocess, options: SensorOptions) -> dict[str, np.ndarray]:
    """Return the untouched gel that was subtracted, upright, by the name of the sensor."""
    from anytouch_jax.data.background.rule import reduced
    from anytouch_jax.data.transforms import orient_frame

    gel = preprocess.background
    if gel is None:
        return {}
    return {options.sensor_name: reduced(orient_frame(gel, options.rotate, options.flip))}


def log_universal(encoder: Encoder, options: SensorOptions) -> None:
    """Warn about a missing --sensor, after the work: a mistake gets one sentence only."""
    if options.sensor is None and len(encoder.config.model.sensors) > 1:
        names = ", ".join(name for name in encoder.config.model.sensors if name != UNIVERSAL)
        log(f"no --sensor was given, so the universal tokens were used. Known sensors: {names}.")


def usable_rows(manifest: Manifest, rows: np.ndarray, frames: int) -> np.ndarray:
    """Return those of `rows` that have images and end a clip of `frames` frames.

    How many others there are is logged.
    """
    import numpy as np

    is_field = np.isin(manifest.text_column("sensor")[rows], FIELD_SENSORS)
    if is_field.any():
        log(f"{is_field.sum()} rows of force-field sensors have no images and are left out")
        rows = rows[~is_field]
    if frames == 1:
        return rows
    usable = np.intersect1d(rows, manifest.clips(frames)[:, -1])
    if len(usable) < len(rows):
        log(
            f"{len(rows) - len(usable)} of {len(rows)} rows end no clip of {frames} frames and are "
            "left out"
        )
    return usable


def contact_of_rows(
    manifest: Manifest, rows: np.ndarray, backgrounds: Backgrounds | None = None
) -> np.ndarray:
    """Return the contact of `rows` (n,): label.contact, or by the untouched gel; NaN if unknown."""
    import numpy as np

    from anytouch_jax.data.background import contact
    from anytouch_jax.data.background.rule import Backgrounds

    known = contact.known_contact(manifest)[rows]
    limits = contact.threshold_of_rows(manifest, None, 0.0)[rows]
    unknown = rows[np.isnan(known)]
    score = contact.contact_scores(
        manifest, unknown, served=backgrounds or Backgrounds(manifest)
    ).score[rows]
    by_score = np.where(np.isnan(score), np.nan, score > limits)
    return np.where(np.isnan(known), by_score, known)
