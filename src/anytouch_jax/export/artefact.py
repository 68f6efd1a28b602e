"""An exported encoder: its file, the description beside it, and how it is loaded and called.

The file is a `jax.export` artefact or an ONNX model: uint8 frames and sensor rows in, features out,
for any number of touches. A JSON description says how to call it. Loading imports none of the
network's code.
"""

from __future__ import annotations

import hashlib
import os
from base64 import b64decode
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export as jax_export

from anytouch_jax.batch import FieldOutput
from anytouch_jax.config import UNIVERSAL, parse_json
from anytouch_jax.data.images import decode_bytes
from anytouch_jax.encoder import arrays
from anytouch_jax.encoder.arrays import Engine
from anytouch_jax.encoder.sensor_words import resolve_sensor
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.export import engines
from anytouch_jax.export.packages import needed
from anytouch_jax.shown import described

FORMAT = "anytouch_jax.export.1"
# The fields of a description that a caller needs.
_FIELDS: dict[str, type] = {
    **dict.fromkeys(("bytes", "frames", "image_size", "features"), int),
    **dict.fromkeys(("sha256", "jax", "background", "pooling", "join", "dtype", "form"), str),
    **{"platforms": list, "sensors": dict},
}
_ONNX_FIELDS: dict[str, type] = {
    "source": str,
    "config": dict,
    "weights": str,
    "universal_drawn": bool,
}
_SIZES = ("frames", "image_size", "features")
_MOST = 1 << 20  # of a size: a damaged description must not ask for the whole memory
_ENGINES = {"jax": ("xla",), "onnx": ("onnxruntime", "openvino")}


@dataclass(frozen=True)
class Exported:
    """An exported encoder. `about` is its JSON description; call it with touches and a sensor."""

    about: dict[str, Any]
    _data: bytes = field(repr=False)
    _engine: Engine | None = None

    def __getstate__(self) -> dict[str, Any]:
        # What runs stays in its process.
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @cached_property
    def _running(self) -> dict[int, Any]:
        """What runs by the id of its process: a forked one has none of its threads."""
        return {}

    @property
    def _run(self) -> Any:
        process = os.getpid()
        if process not in self._running:
            if self.about["form"] == "onnx":
                run: Any = engines.session(self._data, self._engine or "onnxruntime")
            else:
                with needed("anytouch_jax[export]"):
                    run = jax.jit(jax_export.deserialize(bytearray(self._data)).call)
            self._running[process] = run
        return self._running[process]

    def start(self) -> None:
        """Read the program, so that a damaged one is found. Raises any type of error."""
        assert self._run is not None

    def __repr__(self) -> str:
        return described(
            f"Exported {self.about.get('source', 'encoder')}",
            input=str(self.about.get("input", "")),
            features=f"{self.about['features']}, pooling {self.about['pooling']}",
            background=str(self.about["background"]),
            sensors=", ".join(self.about["sensors"]),
        )

    def __call__(
        self, frames: Any, sensor: str | Sequence[str] | np.ndarray = UNIVERSAL
    ) -> np.ndarray:
        """Return features f32 (B, E) of touches.

        Args:
            frames: (B, T, H, W, 3), u8 RGB or as another family prepares them.
            sensor: one name, names (B,), or rows i32 (B,).

        Raises:
            UserError: another shape, type or sensor.
        """
        frames = arrays.as_array(frames, "frames")
        side = self.about["image_size"]
        kind = self.about.get("frame_dtype", "uint8")
        wanted = (self.about["frames"], *self.about.get("frame_shape", (side, side, 3)))
        fits = frames.ndim == 5 and frames.shape[1:] == wanted
        if frames.dtype != kind or not fits or not len(frames):
            shape = ", ".join(str(size) for size in wanted)
            raise UserError(
                f"touches must be {kind} RGB (B, {shape}), at least one, not {frames.dtype} "
                f"{frames.shape}"
            )
        rows = arrays.rows_of_sensors(sensor, len(frames), self._row, len(self.about["sensors"]))
        if "fields" in self.about:
            # Such a model asks for the aspect, which does not change its features.
            return np.asarray(self.measure(frames, rows, np.zeros(len(frames), np.float32))[0])
        if self.about["form"] == "onnx":
            return np.asarray(self._run(frames, rows))
        refuse_forked()
        with jax.enable_x64(self.about["dtype"] == "float64"):
            return np.asarray(self._run(arrays.filled(frames), arrays.filled(rows)))[: len(frames)]

    @property
    def backgrounds(self) -> dict[str, np.ndarray]:
        """Images RGB u8 (h, w, 3) of the untouched gel, by unit.

        They are those of the touches that int8 was calibrated on.
        """
        return {
            name: decode_bytes(b64decode(text), name)
            for name, text in self.about.get("gels", {}).items()
        }

    def measure(
        self, frames: np.ndarray, rows: np.ndarray, aspect: np.ndarray
    ) -> tuple[np.ndarray, FieldOutput]:
        """Return features and fields, as `Encoder.encode_and_measure`, of a model that has them."""
        values, out = self._run(frames, rows, aspect)
        return values, out

    def _row(self, name: str) -> int:
        sensors: dict[str, int] = self.about["sensors"]
        name = resolve_sensor(name).name
        if name not in sensors:
            raise UserError(
                f"sensor {name!r} is not one of {', '.join(sensors)}; {UNIVERSAL} serves any other"
            )
        return sensors[name]


def describes(path: Path) -> Path:
    """Return the JSON description of an exported encoder."""
    return path.with_name(f"{path.name}.json")


def platform_here() -> str:
    """Return the platform of this process, by its name in artefacts."""
    backend = jax.default_backend()
    return "cuda" if backend == "gpu" else backend


def load(path: str | Path, engine: Engine | None = None) -> Exported:
    """Load what `export` wrote to `path`, to run on an `engine`.

    Raises UserError for a damaged or unfit file.
    """
    path = Path(path)
    data, about = read_checked(path)
    form = about["form"]
    runs_on = _ENGINES[form]
    if engine not in (None, *runs_on):
        raise UserError(
            f"{path} runs on {' or '.join(runs_on)}, not on {engine}; name the encoder that it was "
            "made of"
        )
    here = platform_here()
    if form == "jax" and here not in about["platforms"]:
        raise UserError(
            f"{path} was exported for {', '.join(map(str, about['platforms']))}; this machine runs "
            f"jax on {here}; export it again for this machine"
        )
    exported = Exported(about, data, engine)
    try:
        exported.start()
    except UserError:
        raise
    # Its checksum is right, so it was written by another version, whose bytes raise any error.
    except Exception as error:
        reader = f"jax {jax.__version__}" if form == "jax" else engine or "onnxruntime"
        raise UserError(
            f"{path} cannot be read by {reader}, it was exported by {about['jax']} "
            f"({' '.join(str(error).split())[:200]}); export it again"
        ) from None
    return exported


def read_checked(path: Path) -> tuple[bytes, dict[str, Any]]:
    """Return the bytes of an artefact and its description, after comparing them.

    Raises UserError.
    """
    try:
        data = path.read_bytes()
        text = describes(path).read_bytes()
    except OSError as error:
        missing = describes(path) if path.is_file() else path
        raise UserError(
            f"{missing} cannot be read: {error.strerror or error}; an artefact is two files, FILE "
            "and FILE.json"
        ) from None
    try:
        about = parse_json(text)
        known = about["format"] == FORMAT
    except (ValueError, KeyError, TypeError):
        raise UserError(
            f"{describes(path)} is not the description of an exported encoder; export it again"
        ) from None
    if not known:
        raise UserError(
            f"{describes(path)} has format {str(about['format'])[:100]!r}; this program reads "
            f"{FORMAT!r}"
        )
    about.setdefault("form", "jax")  # files of version 0.2
    wrong = _wrong_field(about)
    if wrong:
        raise UserError(
            f"{describes(path)} is damaged: {wrong} is missing or wrong; export it again"
        )
    if len(data) != about["bytes"] or hashlib.sha256(data).hexdigest() != about["sha256"]:
        raise UserError(
            f"{path} is damaged: its checksum is not the one in {describes(path).name}; export it "
            "again"
        )
    return data, about


def _wrong_field(about: dict[str, Any]) -> str:
    """Return the first field of a description that is missing or wrong, "" if none is."""
    kinds = _FIELDS | (_ONNX_FIELDS if about["form"] == "onnx" else {})
    for name, kind in kinds.items():
        # Not isinstance: True is no number here.
        if type(about.get(name)) is not kind or about[name] in ([], {}):
            return name
    if about["form"] not in _ENGINES:
        return "form"
    for name in _SIZES:
        if not 0 < about[name] < _MOST:
            return name
    rows = list(about["sensors"].values())
    if rows != list(range(len(rows))):
        return "sensors"
    return ""
