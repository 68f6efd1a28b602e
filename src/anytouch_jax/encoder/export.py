"""Export of a touch encoder as one file that needs jax alone, and loading of that file.

The file is a `jax.export` artefact: uint8 frames and sensor rows in, features out, for any number of touches.
Normalisation and parameters are inside. A JSON description says how to call it and has its checksum. Loading imports
none of the network's code.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jax import export as jax_export

from anytouch_jax.config import UNIVERSAL, parse_json
from anytouch_jax.encoder.arrays import rows_of_sensors
from anytouch_jax.errors import CheckError, UserError
from anytouch_jax.files import atomic_write

if TYPE_CHECKING:
    from anytouch_jax.encoder.embed import Join, Pooling
    from anytouch_jax.encoder.encoder import Encoder

FORMAT = "anytouch_jax.export.1"
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
TOLERANCE = {"float32": 1e-4, "bfloat16": 5e-2, "float64": 1e-4}  # of the largest feature; the platform's own rounding
# The fields of a description that a caller needs.
_FIELDS: dict[str, type] = {
    **dict.fromkeys(("bytes", "frames", "image_size", "features"), int),
    **dict.fromkeys(("sha256", "jax", "background", "pooling", "join", "dtype"), str),
    **{"platforms": list, "sensors": dict},
}
_CHECKED = (1, 5)  # batch sizes
_EXAMPLE = """import pathlib
import jax
run = jax.export.deserialize(bytearray(pathlib.Path({name!r}).read_bytes()))
features = jax.jit(run.call)(frames, sensor)  # {shape}, int32 (B,)"""


@dataclass(frozen=True)
class Exported:
    """An exported encoder. `about` is its JSON description; call it with touches and a sensor."""

    about: dict[str, Any]
    _run: Any = field(repr=False)

    def __call__(self, frames: Any, sensor: str | Sequence[str] | np.ndarray = UNIVERSAL) -> np.ndarray:
        """Return features f32 (B, E) of touches (B, T, H, W, 3), u8 RGB or as another family prepares them.

        `sensor` is one name, names (B,), or rows i32 (B,). Raises UserError for another shape or type, and for a sensor
        that the model does not know.
        """
        frames = np.asarray(frames)
        side, kind = self.about["image_size"], self.about.get("frame_dtype", "uint8")
        wanted = (self.about["frames"], *self.about.get("frame_shape", (side, side, 3)))
        if frames.dtype != kind or frames.ndim != 5 or frames.shape[1:] != wanted or not len(frames):
            shape = ", ".join(str(size) for size in wanted)
            raise UserError(f"touches must be {kind} RGB (B, {shape}), at least one, not {frames.dtype} {frames.shape}")
        rows = rows_of_sensors(sensor, len(frames), self._row, len(self.about["sensors"]))
        with jax.enable_x64(self.about["dtype"] == "float64"):
            return np.asarray(self._run(frames, rows))

    def _row(self, name: str) -> int:
        sensors: dict[str, int] = self.about["sensors"]
        if name not in sensors:
            raise UserError(f"sensor {str(name)!r} is not one of {', '.join(sensors)}; {UNIVERSAL} serves any other")
        return sensors[name]


def describes(path: Path) -> Path:
    """Return the JSON description of an exported encoder."""
    return path.with_name(f"{path.name}.json")


def load(path: str | Path) -> Exported:
    """Load the encoder that `export` wrote to `path`. Raises UserError if it is damaged or for another platform."""
    path = Path(path)
    data, about = read_checked(path)
    if _here() not in about["platforms"]:
        raise UserError(
            f"{path} was exported for {', '.join(map(str, about['platforms']))}; this machine runs jax on {_here()}; "
            "export it again for this machine"
        )
    try:
        module = jax_export.deserialize(bytearray(data))
    except Exception as error:  # its checksum is right, so it was written by another jax
        raise UserError(
            f"{path} cannot be read by jax {jax.__version__}, it was exported by {about['jax']} "
            f"({' '.join(str(error).split())[:200]}); export it again"
        ) from None
    return Exported(about, jax.jit(module.call))


def export(
    encoder: Encoder, path: str | Path, *, frames: int = 1, platforms: Sequence[str] = ("cpu", "cuda"),
    pooling: Pooling = "class", join: Join = "mean",
) -> dict[str, Any]:  # fmt: skip
    """Write an encoder of touches of `frames` frames to `path` and its description, and return the description.

    The artefact is first called with 1 and 5 touches and compared with the live model. Raises CheckError if they
    differ, UserError if it cannot be compared on this machine, OSError for a full disk.
    """
    from anytouch_jax.encoder.encoder import check_frames

    path, model = Path(path), encoder.config.model
    check_frames(model, frames)
    wrong = ", ".join(name for name in platforms if name not in PLATFORMS)
    if wrong or not platforms:
        raise UserError(f"platforms must be of {', '.join(PLATFORMS)}, not {wrong or 'none'}")
    if _here() not in platforms:
        raise UserError(f"this machine runs jax on {_here()}: add it to --platforms, to check the artefact")
    if path.suffix == ".json":
        raise UserError(f"{path} is the name of the description; name the artefact .bin")
    # The only form of attention that every platform has and that takes any number of touches.
    plain = replace(encoder, config=replace(encoder.config, model=replace(model, attention="xla")))
    live = plain if model.attention == "cudnn" and _here() != "cuda" else encoder
    with jax.enable_x64(model.dtype == "float64"):
        data = _artefact(plain, frames, platforms, pooling, join)
        differs, width = _worst(live, data, frames, pooling, join)
    about = {
        "format": FORMAT,
        "file": path.name,
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "jax": jax.__version__,
        "platforms": list(platforms),
        **call_of(encoder, frames=frames, width=width, pooling=pooling, join=join),
        "worst_difference": differs,
        "example": _EXAMPLE.format(name=path.name, shape=_shape(encoder, frames)),
    }
    atomic_write(path, data)
    atomic_write(describes(path), json.dumps(about, indent=2) + "\n")
    return about


def _shape(encoder: Encoder, frames: int) -> str:
    """Return type and shape of the input, as text."""
    return f"{encoder.blank.dtype} (B, {frames}, {', '.join(map(str, encoder.blank.shape))})"


def call_of(
    encoder: Encoder, *, frames: int, width: int, pooling: Pooling = "class", join: Join = "mean"
) -> dict[str, Any]:
    """Return how an exported encoder is called: its inputs, its outputs, the row of each sensor."""
    model = encoder.config.model
    return {
        "source": encoder.source,
        "output": f"features: float32 (B, {width}), not normalised",
        **encoder.input_form(frames),
        "frames": frames,
        "image_size": model.image_size,
        "features": width,
        "background": encoder.config.data.background,
        "pooling": pooling,
        "join": join,
        "dtype": model.dtype,
        "sensors": {name: row for row, name in enumerate(model.sensors)},
        "trained_sensors": None if encoder.trained_sensors is None else list(encoder.trained_sensors),
    }


def _here() -> str:
    """Return the platform of this process, by its name in artefacts."""
    return {"gpu": "cuda"}.get(jax.default_backend(), jax.default_backend())


def _artefact(encoder: Encoder, frames: int, platforms: Sequence[str], pooling: Pooling, join: Join) -> bytes:
    (batch,), blank = jax_export.symbolic_shape("b"), encoder.blank
    run = partial(encoder.traceable(pooling, join), encoder.params)
    touches = jax.ShapeDtypeStruct((batch, frames, *blank.shape), blank.dtype)
    rows = jax.ShapeDtypeStruct((batch,), np.int32)
    return bytes(jax_export.export(jax.jit(run), platforms=tuple(platforms))(touches, rows).serialize())


def _worst(encoder: Encoder, data: bytes, frames: int, pooling: Pooling, join: Join) -> tuple[float, int]:
    """Return the largest difference from the live model, as a share of the largest feature, and the feature count."""
    run = jax.jit(jax_export.deserialize(bytearray(data)).call)
    model, rng, worst, width, blank = encoder.config.model, np.random.default_rng(0), 0.0, 0, encoder.blank
    for count in _CHECKED:
        clips = rng.integers(0, 256, (count, frames, *blank.shape), np.uint8)
        clips = clips if blank.dtype == np.uint8 else clips.astype(blank.dtype) / 255
        rows = rng.integers(0, len(model.sensors), count).astype(np.int32)
        live = encoder.encode_touch(clips, rows, pooling=pooling, join=join)
        exported = np.asarray(run(clips, rows))
        if exported.shape != live.shape or not np.isfinite(exported).all():
            raise CheckError(f"the artefact gives {exported.shape}, the live model {live.shape}, or what is not finite")
        worst = max(worst, float(np.abs(exported - live).max() / np.abs(live).max()))
        width = live.shape[1]
    if worst > TOLERANCE[model.dtype]:
        raise CheckError(f"the artefact differs from the live model by {worst:.2g} of its largest feature: not written")
    return worst, width


def read_checked(path: Path) -> tuple[bytes, dict[str, Any]]:
    """Return the bytes of an artefact and its description, after comparing them. Raises UserError."""
    try:
        data, text = path.read_bytes(), describes(path).read_bytes()
    except OSError as error:
        missing = describes(path) if path.is_file() else path
        raise UserError(
            f"{missing} cannot be read: {error.strerror or error}; an artefact is two files, FILE and FILE.json"
        ) from None
    try:
        about = parse_json(text)
        known = about["format"] == FORMAT
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{describes(path)} is not the description of an exported encoder; export it again") from None
    if not known:
        raise UserError(f"{describes(path)} has format {str(about['format'])[:100]!r}; this program reads {FORMAT!r}")
    wrong = [name for name, kind in _FIELDS.items() if type(about.get(name)) is not kind]
    wrong = wrong or [name for name in ("frames", "image_size", "features") if not 0 < about[name] < 1 << 20]
    if wrong or list(about["sensors"].values()) != list(range(len(about["sensors"]))):
        name = (wrong or ["sensors"])[0]
        raise UserError(f"{describes(path)} is damaged: {name} is missing or wrong; export it again")
    if len(data) != about["bytes"] or hashlib.sha256(data).hexdigest() != about["sha256"]:
        raise UserError(f"{path} is damaged: its checksum is not the one in {describes(path).name}; export it again")
    return data, about
