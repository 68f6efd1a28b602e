"""Export of a touch encoder as one file that needs jax or an engine alone, its loading, and exports
in a cache.

The file is a `jax.export` artefact or an ONNX model: uint8 frames and sensor rows in, features out,
for any number of touches. A JSON description says how to call it. Loading imports none of the
network's code.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

import jax
import numpy as np
from jax import export as jax_export

from anytouch_jax.config import UNIVERSAL, parse_json, to_json
from anytouch_jax.data.images import decode_bytes, encode
from anytouch_jax.encoder import arrays
from anytouch_jax.encoder.arrays import METADATA, Array, Join, Pooling
from anytouch_jax.errors import CheckError, UserError, refuse_forked
from anytouch_jax.export import engines
from anytouch_jax.export.engines import Engine
from anytouch_jax.fields.outputs import LENGTH, FieldOutput
from anytouch_jax.files import atomic_write, cache_folder, remove_old
from anytouch_jax.shown import described
from anytouch_jax.weights.registry import list_encoders

if TYPE_CHECKING:
    from anytouch_jax.encoder.base import Encoder

FORMAT = "anytouch_jax.export.1"
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
ONNX_TOLERANCE = 1e-5
# of the largest feature; the platform's own rounding
TOLERANCE = {"float32": 1e-4, "bfloat16": 5e-2, "float64": 1e-4}
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
_ENGINES = {"jax": ("xla",), "onnx": ("onnxruntime", "openvino")}
_CHECKED = (1, 5)  # batch sizes
# parameters; in larger encoders products take the time, which are equally fast in XLA
LARGEST = 16_000_000
_CACHE = ".engines"  # next to the weights
_EXAMPLE = {
    "jax": """import pathlib
import jax
run = jax.export.deserialize(bytearray(pathlib.Path({name!r}).read_bytes()))
features = jax.jit(run.call)(frames, sensor)  # {shape}, int32 (B,)""",
    "onnx": """import onnxruntime
run = onnxruntime.InferenceSession({name!r}).run
features = run(["features"], {{"frames": frames, "sensor": sensor}})[0]  # {shape}, int32 (B,)""",
}


@dataclass(frozen=True)
class Exported:
    """An exported encoder. `about` is its JSON description; call it with touches and a sensor."""

    about: dict[str, Any]
    _data: bytes = field(repr=False)
    _engine: Engine | None = None

    def __getstate__(self) -> dict[str, Any]:  # what runs stays in its process
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @cached_property
    def _running(self) -> dict[int, Any]:
        """What runs by the id of its process: a forked one has none of its threads."""
        return {}

    @property
    def _run(self) -> Any:
        if (process := os.getpid()) not in self._running:
            if self.about["form"] == "onnx":
                run: Any = engines.session(self._data, self._engine or "onnxruntime")
            else:
                run = jax.jit(jax_export.deserialize(bytearray(self._data)).call)
            self._running[process] = run
        return self._running[process]

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
        """Return features f32 (B, E) of touches (B, T, H, W, 3), u8 RGB or as another family
        prepares them.

        `sensor` is one name, names (B,), or rows i32 (B,). Raises UserError for another shape, type
        or sensor.
        """
        frames = arrays.as_array(frames, "frames")
        side = self.about["image_size"]
        kind = self.about.get("frame_dtype", "uint8")
        wanted = (self.about["frames"], *self.about.get("frame_shape", (side, side, 3)))
        if (
            frames.dtype != kind
            or frames.ndim != 5
            or frames.shape[1:] != wanted
            or not len(frames)
        ):
            shape = ", ".join(str(size) for size in wanted)
            raise UserError(
                f"touches must be {kind} RGB (B, {shape}), at least one, not {frames.dtype} "
                f"{frames.shape}"
            )
        rows = arrays.rows_of_sensors(sensor, len(frames), self._row, len(self.about["sensors"]))
        if "fields" in self.about:  # the aspect does not change features
            return np.asarray(self.measure(frames, rows, np.zeros(len(frames), np.float32))[0])
        if self.about["form"] == "onnx":
            return np.asarray(self._run(frames, rows))
        refuse_forked()
        with jax.enable_x64(self.about["dtype"] == "float64"):
            return np.asarray(self._run(arrays.filled(frames), arrays.filled(rows)))[: len(frames)]

    @property
    def gels(self) -> dict[str, np.ndarray]:
        """Pictures RGB u8 (h, w, 3) of the untouched gel, by unit, of the touches that int8 was
        calibrated on.
        """
        return {
            name: decode_bytes(b64decode(text), name)
            for name, text in self.about.get("gels", {}).items()
        }

    def measure(
        self, frames: np.ndarray, rows: np.ndarray, aspect: np.ndarray
    ) -> tuple[np.ndarray, FieldOutput]:
        """Return features and fields, as `Encoder.encode_and_measure`, of a model that has
        fields.
        """
        values, out = self._run(frames, rows, aspect)
        return values, out

    def _row(self, name: str) -> int:
        sensors: dict[str, int] = self.about["sensors"]
        if name not in sensors:
            raise UserError(
                f"sensor {str(name)!r} is not one of {', '.join(sensors)}; {UNIVERSAL} serves any "
                "other"
            )
        return sensors[name]


def describes(path: Path) -> Path:
    """Return the JSON description of an exported encoder."""
    return path.with_name(f"{path.name}.json")


def load(path: str | Path, engine: Engine | None = None) -> Exported:
    """Load what `export` wrote to `path`, to run on an `engine`.

    Raises UserError for a damaged or unfit file.
    """
    path = Path(path)
    data, about = read_checked(path)
    form = about["form"]
    runs_on = _ENGINES[about["form"]]
    if engine not in (None, *runs_on):
        raise UserError(
            f"{path} runs on {' or '.join(runs_on)}, not on {engine}; name the encoder that it was "
            "made of"
        )
    if form == "jax" and _here() not in about["platforms"]:
        raise UserError(
            f"{path} was exported for {', '.join(map(str, about['platforms']))}; this machine runs "
            f"jax on {_here()}; "
            "export it again for this machine"
        )
    exported = Exported(about, data, engine)
    try:
        exported._run  # noqa: B018  a damaged file is found here
    except UserError:
        raise
    except Exception as error:  # its checksum is right, so it was written by another version
        reader = f"jax {jax.__version__}" if form == "jax" else engine or "onnxruntime"
        raise UserError(
            f"{path} cannot be read by {reader}, it was exported by {about['jax']} "
            f"({' '.join(str(error).split())[:200]}); export it again"
        ) from None
    return exported


def export(
    encoder: Encoder,
    path: str | Path,
    *,
    frames: int = 1,
    platforms: Sequence[str] = ("cpu", "cuda"),
    pooling: Pooling = "class",
    join: Join = "mean",
    form: Literal["jax", "onnx"] = "jax",
    calibration: tuple[np.ndarray, np.ndarray] | None = None,
    gels: Mapping[str, np.ndarray] | None = None,
    fields: bool = False,
    engine: Engine = "onnxruntime",
) -> dict[str, Any]:
    """Write an encoder of touches of `frames` frames to `path` and its description, and return the
    description.

    The artefact is first called with 1 and 5 touches and compared with the live model by XLA. ONNX
    is float32, for CPUs, and compared on `engine`. With `calibration`, touches u8 (200, T, H, W, 3)
    and sensor rows i32 (200,), its linear layers then become int8. `gels` are pictures of the
    untouched gel of their units. With `fields`, ONNX has the outputs of `nn.fields` too. Raises
    CheckError if they differ, UserError for what cannot be exported or compared here, OSError for a
    full disk.
    """
    encoder = replace(encoder, engine="xla")
    if form == "onnx":
        encoder = encoder.computed_in("float32")
        platforms = (_here(),)
        if encoder.blank.dtype != np.uint8:
            raise UserError(
                f"ONNX is written for AnyTouch's own network; export {encoder.source} with --to jax"
            )
    path = Path(path)
    model = encoder.config.model
    if fields and (form != "onnx" or calibration is not None):
        raise UserError("fields are exported to ONNX in float32: use --to onnx, without --int8")
    params = encoder.params | ({"fields": encoder.part_params("fields")} if fields else {})
    arrays.check_frames(model, frames)
    wrong = ", ".join(name for name in platforms if name not in PLATFORMS)
    if wrong or not platforms:
        raise UserError(f"platforms must be of {', '.join(PLATFORMS)}, not {wrong or 'none'}")
    if _here() not in platforms:
        raise UserError(
            f"this machine runs jax on {_here()}: add it to --platforms, to check the artefact"
        )
    if path.suffix == ".json":
        raise UserError(f"{path} is the name of the description; name the artefact .bin or .onnx")
    # The only form of attention that every platform has and that takes any number of touches.
    plain = replace(encoder, config=replace(encoder.config, model=replace(model, attention="xla")))
    live = plain if model.attention == "cudnn" and _here() != "cuda" else encoder
    with jax.enable_x64(model.dtype == "float64"):
        if form == "onnx":
            data = engines.touch_graph(params, model, frames, pooling)
            run: Any = engines.session(data, engine)
        else:
            data = _artefact(plain, frames, platforms, pooling, join)
            run = jax.jit(jax_export.deserialize(bytearray(data)).call)
        differs, width = _worst(live, run, frames, pooling, join, fields)
    if differs > (tolerance := ONNX_TOLERANCE if form == "onnx" else TOLERANCE[model.dtype]):
        raise CheckError(
            f"the artefact differs from the live model by {differs:.2g} of its largest feature, "
            "more than "
            f"{tolerance:g}: not written"
        )
    more: dict[str, Any] = {"platforms": list(platforms)}
    if form == "onnx":
        config = json.loads(to_json(encoder.config))
        drawn = encoder.universal_drawn
        more = {
            "platforms": ["cpu"],
            "config": config,
            "weights": encoder.fingerprint,
            "universal_drawn": drawn,
        }
    if fields:
        more["fields"] = {
            "outputs": list(FieldOutput._fields),
            "calibration": encoder.metadata.get(METADATA, {}),
        }
        more["aspect"] = (
            "float32 (B,): the logarithm of the height over the width that the picture shows"
        )
    if calibration is not None:
        data = engines.quantised(data, *calibration)
        more["int8"] = _int8_error(live, engines.session(data), *calibration, pooling)
    shape = f"{encoder.blank.dtype} (B, {frames}, {', '.join(map(str, encoder.blank.shape))})"
    trained = encoder.trained_sensors
    about = {
        "format": FORMAT,
        "form": form,
        "file": path.name,
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "jax": jax.__version__,
        **more,
        "source": encoder.source,
        "output": f"features: float32 (B, {width}), not normalised",
        **encoder.input_form(frames),
        "frames": frames,
        "image_size": model.image_size,
        "features": width,
        "background": encoder.config.data.background,
        "pooling": pooling,
        "join": join,
        "dtype": encoder.config.model.dtype,
        "sensors": {name: row for row, name in enumerate(model.sensors)},
        "trained_sensors": None if trained is None else list(trained),
        "worst_difference": differs,
        "gels": {name: b64encode(encode(gel)).decode() for name, gel in (gels or {}).items()},
        "example": _EXAMPLE[form].format(name=path.name, shape=shape),
    }
    atomic_write(path, data)
    atomic_write(describes(path), json.dumps(about, indent=2) + "\n")
    return about


def _here() -> str:
    """Return the platform of this process, by its name in artefacts."""
    return {"gpu": "cuda"}.get(jax.default_backend(), jax.default_backend())


def _artefact(
    encoder: Encoder, frames: int, platforms: Sequence[str], pooling: Pooling, join: Join
) -> bytes:
    (batch,) = jax_export.symbolic_shape("b")
    blank = encoder.blank
    run = partial(encoder.traceable(pooling, join), encoder.params)
    touches = jax.ShapeDtypeStruct((batch, frames, *blank.shape), blank.dtype)
    rows = jax.ShapeDtypeStruct((batch,), np.int32)
    return bytes(
        jax_export.export(jax.jit(run), platforms=tuple(platforms))(touches, rows).serialize()
    )


def _worst(
    encoder: Encoder, run: Any, frames: int, pooling: Pooling, join: Join, fields: bool
) -> tuple[float, int]:
    """Return the largest difference from the live model, over the largest (or a usual) value, and
    the feature count.
    """
    model = encoder.config.model
    rng = np.random.default_rng(0)
    worst = 0.0
    width = 0
    blank = encoder.blank
    for count in _CHECKED:
        clips = rng.integers(0, 256, (count, frames, *blank.shape), np.uint8)
        clips = clips if blank.dtype == np.uint8 else clips.astype(blank.dtype) / 255
        rows = rng.integers(0, len(model.sensors), count).astype(np.int32)
        if fields:
            aspect = rng.uniform(-0.5, 0.5, count).astype(np.float32)
            live, mine = encoder.encode_and_measure(clips, rows, aspect, pooling)
            exported, theirs = run(clips, rows, aspect)
            pairs = [(np.asarray(a), np.asarray(b)) for a, b in zip(mine, theirs, strict=True)]
            off = [
                np.inf if a.shape != b.shape else abs(a - b).max() / max(abs(a).max(), LENGTH)
                for a, b in pairs
            ]
            worst = max(worst, float(np.max(off)))
        else:
            live = encoder.encode_touch(clips, rows, pooling=pooling, join=join)
            exported = np.asarray(run(clips, rows))
        if exported.shape != live.shape or not (
            np.isfinite(exported).all() and np.isfinite(live).all()
        ):
            raise CheckError(
                f"the artefact gives {exported.shape}, the live model {live.shape}, or what is not "
                "finite"
            )
        worst = max(worst, float(np.abs(exported - live).max() / np.abs(live).max()))
        width = live.shape[1]
    return worst, width


def _int8_error(
    encoder: Encoder, run: Any, touches: Array, rows: Array, pooling: Pooling
) -> dict[str, float]:
    """Return the largest difference of int8 on its calibration touches, and the mean cosine with
    the live features.
    """
    items = list(zip(touches, rows, strict=True))
    live = arrays.run_in_batches(
        lambda part: encoder.encode_touch(*part, pooling=pooling), items, 20
    )
    own = arrays.run_in_batches(lambda part: run(*part), items, 20)
    cosine = float((arrays.unit_rows(own) * arrays.unit_rows(live)).sum(1).mean())
    worst = float(np.abs(own - live).max() / np.abs(live).max())
    return {"touches": len(rows), "worst_difference": worst, "cosine": cosine}


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
    fields = _FIELDS | (_ONNX_FIELDS if about["form"] == "onnx" else {})
    wrong = [
        name
        for name, kind in fields.items()
        if type(about.get(name)) is not kind or about[name] in ([], {})
    ]
    wrong += [] if "form" in wrong or about["form"] in _ENGINES else ["form"]
    wrong = wrong or [
        name for name in ("frames", "image_size", "features") if not 0 < about[name] < 1 << 20
    ]
    if wrong or list(about["sensors"].values()) != list(range(len(about["sensors"]))):
        name = (wrong or ["sensors"])[0]
        raise UserError(
            f"{describes(path)} is damaged: {name} is missing or wrong; export it again"
        )
    if len(data) != about["bytes"] or hashlib.sha256(data).hexdigest() != about["sha256"]:
        raise UserError(
            f"{path} is damaged: its checksum is not the one in {describes(path).name}; export it "
            "again"
        )
    return data, about


def cached_export(
    encoder: Encoder, frames: int, pooling: Pooling, *, fields: bool = False
) -> Exported | None:
    """Return the export of touches of `frames` frames on the encoder's engine, None where XLA
    computes.

    "auto" is onnxruntime if it is installed and jax runs on a CPU. The encoder must compute in
    float32, have at most LARGEST parameters, and differ from its export by at most 1e-5. XLA
    computes clips of more than one segment. For an engine that was named, raises UserError if it is
    not installed and for bfloat16, and CheckError if the export differs.
    """
    engine, model, is_auto = encoder.engine, encoder.config.model, encoder.engine == "auto"
    if frames not in (1, model.frames):
        return None
    count = sum(np.size(leaf) for leaf in jax.tree.leaves(encoder.params))
    if is_auto and (jax.default_backend() != "cpu" or model.dtype != "float32" or count > LARGEST):
        return None
    if model.dtype != "float32":
        raise UserError(
            f"{engine} computes in float32, not in {model.dtype}; leave out --dtype, or use XLA"
        )
    on: Engine = "onnxruntime" if engine == "auto" else engine
    try:
        name = f"{_key(encoder, on, frames, pooling, fields)}.onnx"
        folders = _folders(encoder.source)
        for path in (folder / name for folder in folders):
            if is_auto and _is_refused(path):
                return None
            with contextlib.suppress(UserError):
                run = load(path, on)
                for file in (path, describes(path)):
                    with contextlib.suppress(OSError):
                        os.utime(file)
                return run
        return _made(encoder, on, name, folders, frames, pooling, fields)
    except (UserError, OSError):
        if is_auto:
            return None
        raise


def _made(
    encoder: Encoder,
    engine: Engine,
    name: str,
    folders: list[Path],
    frames: int,
    pooling: Pooling,
    fields: bool,
) -> Exported:
    """Make an export, and store it in the first folder that can be written.

    Raises CheckError, which is stored too.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        try:
            export(
                encoder,
                path,
                frames=frames,
                pooling=pooling,
                form="onnx",
                fields=fields,
                engine=engine,
            )
            return load(path, engine)
        except CheckError as error:
            atomic_write(describes(path), json.dumps({"refused": str(error)}))
            raise
        finally:
            # the description last
            files = {file.name: file.read_bytes() for file in sorted(Path(folder).iterdir())}
            for stored in folders if files else []:
                with contextlib.suppress(OSError):
                    for file, data in files.items():
                        atomic_write(stored / file, data)
                    remove_old(stored, "*.onnx*")
                    break


def _key(encoder: Encoder, engine: Engine, frames: int, pooling: Pooling, fields: bool) -> str:
    """Return a name for everything that decides the features: weights, preprocessing, code, engine
    and its version.
    """
    params = encoder.params | ({"fields": encoder.part_params("fields")} if fields else {})
    made_by = Path(engines.__file__).read_bytes(), engines.imported(engine).__version__
    asked = (
        FORMAT,
        engine,
        frames,
        pooling,
        fields,
        encoder.contract,
        encoder.config.data.background,
    )
    digest = hashlib.sha256(repr((asked, made_by)).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        digest.update(f"{path} {leaf.dtype} {leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:32]


def _folders(source: str) -> list[Path]:
    """Return where an export is looked for: next to weights of the user, then in the user's
    cache.
    """
    path = Path(source)
    own = cache_folder() / "engines"
    if source in list_encoders() or source.startswith("hf:") or not path.exists():
        return [own]
    return [(path if path.is_dir() else path.parent) / _CACHE, own]


def _is_refused(path: Path) -> bool:
    """Whether the export was made before, and differed from the live model."""
    try:
        return "refused" in json.loads(describes(path).read_bytes())
    except (OSError, ValueError):
        return False
