"""Export of a touch encoder as one file that needs jax or an engine alone.

What is written, and how it is loaded, is told in `export.artefact`.
"""

from __future__ import annotations

import hashlib
import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import jax
import numpy as np
from jax import export as jax_export

from anytouch_jax.batch import FieldOutput
from anytouch_jax.config import to_json
from anytouch_jax.data.images import encode
from anytouch_jax.doors import HEADS, enter
from anytouch_jax.encoder import arrays
from anytouch_jax.encoder.arrays import METADATA, Aggregation, Array, Params, Pooling
from anytouch_jax.errors import CheckError, UserError
from anytouch_jax.export import engines
from anytouch_jax.export.artefact import FORMAT, describes, platform_here
from anytouch_jax.export.artefact import Exported as Exported
from anytouch_jax.export.artefact import load as load
from anytouch_jax.export.artefact import read_checked as read_checked
from anytouch_jax.export.engines import Engine
from anytouch_jax.export.packages import needed
from anytouch_jax.fields.outputs import LENGTH
from anytouch_jax.files import atomic_write

if TYPE_CHECKING:
    from anytouch_jax.encoder.base import Encoder

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
# XLA and onnxruntime add in another order: 1.7e-5 was seen on a CPU with AMX.
ONNX_TOLERANCE = 3e-5
# Differences from the live model, over the largest feature: the platform's own rounding.
TOLERANCE = {"float32": 1e-4, "bfloat16": 5e-2, "float64": 1e-4}
_CHECKED = (1, 5)  # batch sizes
_EXAMPLE = {
    "jax": """import pathlib
import jax
run = jax.export.deserialize(bytearray(pathlib.Path({name!r}).read_bytes()))
features = jax.jit(run.call)(frames, sensor)  # {shape}, int32 (B,)""",
    "onnx": """import onnxruntime
run = onnxruntime.InferenceSession({name!r}).run
features = run(["features"], {{"frames": frames, "sensor": sensor}})[0]  # {shape}, int32 (B,)""",
    "fields": """import numpy
import onnxruntime
run = onnxruntime.InferenceSession({name!r}).run
# Of {sensor}: the mm that the width of its image shows, the kPa of its gel, and the logarithm of
# the height over the width of its image.
width_mm, modulus_kpa, aspect = {width_mm}, {modulus_kpa}, {aspect}
given = {{"frames": frames, "sensor": sensor}}  # {shape}, int32 (B,)
given["aspect"] = numpy.full(len(frames), aspect, numpy.float32)
features, depth, force = run(["features", "depth", "force"], given)
depth = width_mm * depth  # mm
force = modulus_kpa * width_mm**2 / 1000 * force  # N along x, along y and into the gel""",
}


@dataclass(frozen=True)
class ExportSettings:
    """What is exported, and in which form.

    Attributes:
        frames: those of a touch.
        platforms: those that a jax artefact runs on.
        pooling: see `Encoder.encode_touch`.
        aggregation: the temporal aggregation of a long clip.
        form: a jax artefact, or ONNX, which is float32 and for CPUs.
        calibration: touches u8 (200, T, H, W, 3) and sensor rows i32 (200,). With these, the linear
            layers of ONNX become int8.
        backgrounds: images of the untouched gel by unit, which are stored in the description.
        fields: ONNX has the outputs of `fields.module` too.
        engine: on which ONNX is compared with the live model.
    """

    frames: int = 1
    platforms: Sequence[str] = ("cpu", "cuda")
    pooling: Pooling = "class"
    aggregation: Aggregation = "mean"
    form: Literal["jax", "onnx"] = "jax"
    calibration: tuple[np.ndarray, np.ndarray] | None = field(default=None, repr=False)
    backgrounds: Mapping[str, np.ndarray] | None = field(default=None, repr=False)
    fields: bool = False
    engine: Engine = "onnxruntime"


def export(  # noqa: PLR0913  the public call; `export_with` takes the record
    encoder: Encoder,
    path: str | Path,
    *,
    frames: int = 1,
    platforms: Sequence[str] = ("cpu", "cuda"),
    pooling: Pooling = "class",
    aggregation: Aggregation = "mean",
    form: Literal["jax", "onnx"] = "jax",
    calibration: tuple[np.ndarray, np.ndarray] | None = None,
    backgrounds: Mapping[str, np.ndarray] | None = None,
    fields: bool = False,
    engine: Engine = "onnxruntime",
) -> dict[str, Any]:
    """Write an encoder of touches to `path` and its description, see `export_with`.

    Args:
        encoder: what is exported.
        path: the file.
        frames: see `ExportSettings`.
        platforms: see `ExportSettings`.
        pooling: see `ExportSettings`.
        aggregation: see `ExportSettings`.
        form: see `ExportSettings`.
        calibration: see `ExportSettings`.
        backgrounds: see `ExportSettings`.
        fields: see `ExportSettings`.
        engine: see `ExportSettings`.
    """
    settings = ExportSettings(
        frames=frames,
        platforms=platforms,
        pooling=pooling,
        aggregation=aggregation,
        form=form,
        calibration=calibration,
        backgrounds=backgrounds,
        fields=fields,
        engine=engine,
    )
    return export_with(encoder, path, settings)


def export_with(encoder: Encoder, path: str | Path, settings: ExportSettings) -> dict[str, Any]:
    """Write an encoder of touches to `path` and its description, and return the description.

    The artefact is first called with 1 and 5 touches and compared with the live model by XLA.

    Raises:
        CheckError: they differ.
        UserError: what cannot be exported or compared here.
        OSError: a full disk.
    """
    path = Path(path)
    encoder = replace(encoder, engine="xla")
    if settings.form == "onnx":
        encoder = encoder.computed_in("float32")
        settings = replace(settings, platforms=(platform_here(),))
    _check(encoder, path, settings)
    model = encoder.config.model
    # The only form of attention that every platform has and that takes any number of touches.
    plain = replace(encoder, config=replace(encoder.config, model=replace(model, attention="xla")))
    # A model that was trained on a GPU may ask for an attention that this machine lacks.
    live = plain if model.attention == "cudnn" and platform_here() != "cuda" else encoder
    with jax.enable_x64(model.dtype == "float64"):
        if settings.form == "onnx":
            params = encoder.params | _field_params(encoder, settings)
            data = engines.touch_graph(params, model, settings.frames, settings.pooling)
            run: Any = engines.session(data, settings.engine)
            tolerance = ONNX_TOLERANCE
        else:
            data = _artefact(plain, settings)
            run = jax.jit(jax_export.deserialize(bytearray(data)).call)
            tolerance = TOLERANCE[model.dtype]
        differs, width = _worst(live, run, settings)
    if differs > tolerance:
        raise CheckError(
            f"the artefact differs from the live model by {differs:.2g} of its largest feature, "
            f"more than {tolerance:g}: not written"
        )
    int8 = None
    if settings.calibration is not None:
        data = engines.quantised(data, *settings.calibration)
        run = engines.session(data)
        int8 = _int8_error(live, run, *settings.calibration, settings.pooling)
    about = _description(encoder, path, settings, _Made(data, width, differs, int8))
    atomic_write(path, data)
    atomic_write(describes(path), json.dumps(about, indent=2) + "\n")
    return about


def _check(encoder: Encoder, path: Path, settings: ExportSettings) -> None:
    """Raise UserError for what cannot be exported or compared here."""
    if settings.form == "onnx" and encoder.blank.dtype != np.uint8:
        raise UserError(
            f"ONNX is written for AnyTouch's own network; export {encoder.source} with --to jax"
        )
    if settings.fields and (settings.form != "onnx" or settings.calibration is not None):
        raise UserError("fields are exported to ONNX in float32: use --to onnx, without --int8")
    _field_params(encoder, settings)
    arrays.check_frames(encoder.config.model, settings.frames)
    wrong = ", ".join(name for name in settings.platforms if name not in PLATFORMS)
    if wrong or not settings.platforms:
        raise UserError(f"platforms must be of {', '.join(PLATFORMS)}, not {wrong or 'none'}")
    here = platform_here()
    if here not in settings.platforms:
        raise UserError(
            f"this machine runs jax on {here}: add it to --platforms, to check the artefact"
        )
    if path.suffix == ".json":
        raise UserError(f"{path} is the name of the description; name the artefact .bin or .onnx")


def _field_params(encoder: Encoder, settings: ExportSettings) -> Params:
    """Return the parameters of fields if they are exported. Raises UserError without any."""
    if settings.fields:
        return {"fields": encoder.part_params("fields")}
    return {}


class _Made(NamedTuple):
    """An artefact, the width of its features, and its differences from the live model."""

    data: bytes
    width: int
    worst: float
    int8: dict[str, float] | None


def _description(
    encoder: Encoder, path: Path, settings: ExportSettings, made: _Made
) -> dict[str, Any]:
    """Return the description of what was made."""
    model = encoder.config.model
    trained = encoder.trained_sensors
    about: dict[str, Any] = {
        "format": FORMAT,
        "form": settings.form,
        "file": path.name,
        "bytes": len(made.data),
        "sha256": hashlib.sha256(made.data).hexdigest(),
        "jax": jax.__version__,
        "platforms": list(settings.platforms),
    }
    if settings.form == "onnx":
        # All that `load_engine` needs to put it in the place of the encoder.
        about["platforms"] = ["cpu"]
        about["config"] = json.loads(to_json(encoder.config))
        about["weights"] = encoder.fingerprint
        about["universal_drawn"] = encoder.universal_drawn
    example: dict[str, Any] = {}
    if settings.fields:
        units = enter(HEADS["fields units"])(encoder.metadata, model.sensors)
        example = units.pop("example")
        about["fields"] = {
            "outputs": list(FieldOutput._fields),
            "calibration": encoder.metadata.get(METADATA, {}),
            **units,
        }
        about["aspect"] = (
            "float32 (B,): the logarithm of the height over the width that the image shows"
        )
    if made.int8 is not None:
        about["int8"] = made.int8
    blank = encoder.blank
    shape = f"{blank.dtype} (B, {settings.frames}, {', '.join(map(str, blank.shape))})"
    images = settings.backgrounds or {}
    text = _EXAMPLE["fields" if settings.fields else settings.form]
    return about | {
        "source": encoder.source,
        "output": f"features: float32 (B, {made.width}), not normalised",
        **encoder.input_form(settings.frames),
        "frames": settings.frames,
        "image_size": model.image_size,
        "features": made.width,
        "background": encoder.config.data.background,
        "pooling": settings.pooling,
        "join": settings.aggregation,
        "dtype": encoder.config.model.dtype,
        "sensors": {name: row for row, name in enumerate(model.sensors)},
        "trained_sensors": None if trained is None else list(trained),
        "worst_difference": made.worst,
        "gels": {name: b64encode(encode(gel)).decode() for name, gel in images.items()},
        "example": text.format(name=path.name, shape=shape, **example),
    }


def _artefact(encoder: Encoder, settings: ExportSettings) -> bytes:
    """Return a jax artefact for any number of touches."""
    (batch,) = jax_export.symbolic_shape("b")
    blank = encoder.blank
    run = partial(encoder.traceable(settings.pooling, settings.aggregation), encoder.params)
    touches = jax.ShapeDtypeStruct((batch, settings.frames, *blank.shape), blank.dtype)
    rows = jax.ShapeDtypeStruct((batch,), np.int32)
    platforms = tuple(settings.platforms)
    program = jax_export.export(jax.jit(run), platforms=platforms)(touches, rows)
    with needed("anytouch_jax[export]"):
        return bytes(program.serialize())


def _worst(encoder: Encoder, run: Any, settings: ExportSettings) -> tuple[float, int]:
    """Return the largest difference from the live model, and the number of features.

    It is over the largest value, or over a usual one if all are small.
    """
    model = encoder.config.model
    rng = np.random.default_rng(0)
    worst = 0.0
    width = 0
    blank = encoder.blank
    for count in _CHECKED:
        clips = rng.integers(0, 256, (count, settings.frames, *blank.shape), np.uint8)
        if blank.dtype != np.uint8:
            clips = clips.astype(blank.dtype) / 255
        rows = rng.integers(0, len(model.sensors), count).astype(np.int32)
        if settings.fields:
            aspect = rng.uniform(-0.5, 0.5, count).astype(np.float32)
            live, mine = encoder.encode_and_measure(clips, rows, aspect, settings.pooling)
            exported, theirs = run(clips, rows, aspect)
            worst = max(worst, _worst_field(mine, theirs))
        else:
            live = encoder.encode_touch(
                clips, rows, pooling=settings.pooling, aggregation=settings.aggregation
            )
            exported = np.asarray(run(clips, rows))
        is_finite = np.isfinite(exported).all() and np.isfinite(live).all()
        if exported.shape != live.shape or not is_finite:
            raise CheckError(
                f"the artefact gives {exported.shape}, the live model {live.shape}, or what is not "
                "finite"
            )
        worst = max(worst, float(np.abs(exported - live).max() / np.abs(live).max()))
        width = live.shape[1]
    return worst, width


def _worst_field(mine: FieldOutput, theirs: FieldOutput) -> float:
    """Return the largest difference of a field, over its largest value or a usual length."""
    worst = 0.0
    for one, other in zip(mine, theirs, strict=True):
        live = np.asarray(one)
        exported = np.asarray(other)
        if live.shape != exported.shape or not np.isfinite(exported).all():
            return float("inf")
        size = max(abs(live).max(), LENGTH)
        worst = max(worst, float(abs(live - exported).max() / size))
    return worst


def _int8_error(
    encoder: Encoder, run: Any, touches: Array, rows: Array, pooling: Pooling
) -> dict[str, float]:
    """Return how much int8 differs from the live features of its calibration touches.

    These are the largest difference, over the largest feature, and the mean cosine.
    """
    items = list(zip(touches, rows, strict=True))
    live = arrays.run_in_batches(
        lambda part: encoder.encode_touch(*part, pooling=pooling), items, 20
    )
    own = arrays.run_in_batches(lambda part: run(*part), items, 20)
    cosine = float((arrays.unit_rows(own) * arrays.unit_rows(live)).sum(1).mean())
    worst = float(np.abs(own - live).max() / np.abs(live).max())
    return {"touches": len(rows), "worst_difference": worst, "cosine": cosine}
