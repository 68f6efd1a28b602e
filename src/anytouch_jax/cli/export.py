"""`anytouch export`: an encoder for jax alone or for other engines, or weights as safetensors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from anytouch_jax.cli.output import check_folder, log, refuse_join, refuse_unused
from anytouch_jax.config import UNIVERSAL, ModelConfig, to_json
from anytouch_jax.config.parsing import Count, Ratio
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    import numpy as np

    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.linear_head import Head
    from anytouch_jax.weights.safetensors import Loaded

_INT8 = ("int8", "data", "fields")
# What two networks must share to be interpolated.
_SAME = (
    "touch",
    "patch",
    "patch_encoder",
    "image_size",
    "frames",
    "embed",
    "norm_eps",
    "pre_norm",
    "activation",
    "sensors",
)


@dataclass(frozen=True)
class ExportOptions:
    """Export a touch encoder as one file for jax alone or as ONNX, or weights as safetensors.

    Example: anytouch export --model runs/stage2 --out encoder.bin --frames 3

    The first two take uint8 frames and sensor rows, and return features. OUT.json describes how to
    call them. They are compared with the live model before they are written.

    Example: anytouch export --to onnx --out encoder.onnx --int8 --data manifest.parquet

    Example: anytouch export --to safetensors --model runs/stage2 --out weights.safetensors
    """

    model: Path  # Run folder or weights file (.pth, .safetensors).
    out: Path | None = None  # The file to write. Weights must end in .safetensors, ONNX in .onnx.
    card: Path | None = None
    """Write a folder to upload instead: config.json, model.safetensors as float16, and README.md,
    the model card.
    """
    # Markdown for the card: the data with their licences, results, limits.
    notes: Path | None = None
    to: Literal["jax", "onnx", "safetensors", "release"] = "jax"
    """jax: the touch encoder as a program. onnx: the same for onnxruntime and OpenVINO.
    safetensors: all weights by this package's names. release: weights by the names of the authors'
    files.
    """
    int8: bool = False  # onnx: integer products of 8 bits, calibrated on 200 touches of --data.
    # onnx: also the outputs of depth, shear, contact and force, see OUT.json.
    fields: bool = False
    # onnx: manifests (.csv, .parquet) with touches like those to come.
    data: tuple[Path, ...] = ()
    # jax, onnx: frames of a touch. 1 for stills, 3 or more for clips (in segments of three).
    frames: Count[int] = 1
    # jax: the platforms it runs on.
    platforms: tuple[Literal["cpu", "cuda", "rocm", "tpu"], ...] = ("cpu", "cuda")
    pooling: Literal["class", "mean", "both"] | None = None
    """jax, onnx: class token, mean of patch tokens, or both (default: that of the head of MODEL,
    else class).
    """
    # jax: how the segments of a long clip are joined.
    aggregation: Literal["mean", "sum", "concat"] = "mean"
    dtype: Literal["trained", "float32", "bfloat16"] = "trained"
    """jax: arithmetic of training, or another. Use bfloat16 on GPUs and CPUs with AMX."""
    # Weights: the run or file that MODEL was trained from, to interpolate between the two.
    between: Path | None = None
    fraction: Ratio = 0.5  # Weights: position from BETWEEN (0) to MODEL (1).


def run(options: ExportOptions) -> int:
    """Write an encoder for jax, weights, or a folder to upload."""
    if options.card is not None:
        return _export_card(options, options.card)
    refuse_unused(options, ("notes",), "without --card")
    if options.out is None:
        raise UserError("Name the file to write with --out, or a folder to upload with --card.")
    if options.to in ("jax", "onnx"):
        return _export_encoder(options, options.out)
    unused = ("frames", "platforms", "pooling", "aggregation", "dtype", *_INT8)
    refuse_unused(options, unused, f"with --to {options.to}")
    return _export_weights(options, options.out)


def _export_encoder(options: ExportOptions, out: Path) -> int:
    """Write the touch encoder as a program, for jax or as ONNX."""
    is_onnx = options.to == "onnx"
    foreign = ("platforms", "aggregation", "dtype") if is_onnx else _INT8
    refuse_unused(options, ("between", "fraction", *foreign), f"with --to {options.to}")
    if options.int8 != bool(options.data):
        raise UserError(
            "--int8 is calibrated on the touches of manifests: give both --int8 and --data, or "
            "neither."
        )
    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.encoder.linear_head import HEAD, save_head
    from anytouch_jax.export import export as exports
    from anytouch_jax.train.mesh import enable_compilation_cache

    check_folder(out, read=(options.model, *options.data), suffix=".onnx" if is_onnx else "")
    enable_compilation_cache()
    encoder = load_encoder(options.model).computed_in("float32" if is_onnx else options.dtype)
    refuse_join(options, encoder.config.model.frames)
    head = _own_head(options)
    settings = exports.ExportSettings(
        form="onnx" if is_onnx else "jax",
        frames=options.frames,
        platforms=options.platforms,
        pooling=options.pooling or ("class" if head is None else head.pooling),
        aggregation=options.aggregation,
        fields=options.fields,
    )
    if options.int8:
        touches, backgrounds = _calibration(encoder, options)
        settings = replace(settings, calibration=touches, backgrounds=backgrounds)
    about = exports.export_with(encoder, out, settings)
    print(
        f"{out}: {about['bytes'] / 1e6:.1f} MB for {', '.join(about['platforms'])}; "
        f"{about['input']}"
    )
    print(
        f"largest difference from the live model: {about['worst_difference']:.1e} of the largest "
        "feature"
    )
    if options.int8:
        measured = about["int8"]
        print(
            f"in int8 {measured['worst_difference']:.1e}, mean cosine {measured['cosine']:.4f}, "
            f"on {measured['touches']} touches"
        )
    print(f"{exports.describes(out)}: how to call it")
    if head is not None:
        beside = out.with_suffix(f".{HEAD}")
        save_head(beside, head)
        print(f"{beside}: its head for {head.label}, which at.load_head reads")
    return 0


def _own_head(options: ExportOptions) -> Head | None:
    """Return the head of `anytouch finetune` that reads the exported features, None without one."""
    from anytouch_jax.cli.heads import head_in_use

    def misfit(head: Head) -> str:
        wrong = []
        if options.pooling not in (None, head.pooling):
            wrong.append(f"--pooling {head.pooling}")
        if options.frames != head.frames:
            wrong.append(f"--frames {head.frames}")
        return " ".join(wrong)

    return head_in_use(options.model, None, misfit)


def _calibration(
    encoder: Encoder, options: ExportOptions
) -> tuple[tuple[np.ndarray, np.ndarray], dict[str, np.ndarray] | None]:
    """Return the touches that int8 is calibrated on, and images of their untouched gels.

    Touches are u8 (200, T, H, W, 3), evenly spaced over the rows, with sensor rows i32 (200,).
    """
    import numpy as np

    from anytouch_jax.cli.inputs import usable_rows
    from anytouch_jax.data.background.rule import Backgrounds
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.encoder.embed import RowSettings, embed_with, rows_with_gel
    from anytouch_jax.export.engines import CALIBRATION

    manifest = manifests.read(options.data)
    backgrounds = Backgrounds(manifest)
    rows = usable_rows(manifest, np.arange(len(manifest)), options.frames)
    rows = rows_with_gel(encoder, backgrounds, rows, log)
    if len(rows) < CALIBRATION:
        raise UserError(
            f"--int8 needs {CALIBRATION} touches and --data has {len(rows)}. Name more manifests."
        )
    rows = rows[np.linspace(0, len(rows) - 1, CALIBRATION).astype(int)]
    clips = list[np.ndarray]()

    def keep(part: np.ndarray, _: np.ndarray) -> np.ndarray:
        clips.append(part)
        return part

    # The touches are those that `embed` would encode, prepared and background-subtracted.
    settings = RowSettings(frames=options.frames, edit=keep)
    given, _ = embed_with(encoder, manifest, rows, settings, backgrounds=backgrounds, log=log)
    sensors = manifest.text_column("sensor")[given]
    # `embed_with` has logged unknown sensors already.
    ids = np.array([encoder.sensor_row(name, lambda _: None) for name in sensors], np.int32)
    images = backgrounds.images(given) if encoder.subtracts else None
    return (np.concatenate(clips), ids), images


def _export_card(options: ExportOptions, folder: Path) -> int:
    """Write a folder to upload."""
    from anytouch_jax.encoder.encoder import find_tokenizer
    from anytouch_jax.weights import load, registry

    file_only = (
        "to",
        "frames",
        "platforms",
        "pooling",
        "aggregation",
        "dtype",
        "between",
        "fraction",
        "out",
        *_INT8,
    )
    refuse_unused(options, file_only, "with --card, which writes all weights of MODEL")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder} is not an empty folder. Name a new one with --card.")
    check_folder(folder)
    notes = "" if options.notes is None else options.notes.read_text(encoding="utf-8")
    source = registry.locate(options.model)
    written = registry.write_encoder(
        folder, load.load_model(source), notes, tokenizer=find_tokenizer(source)
    )
    size = (written / registry.WEIGHTS).stat().st_size
    print(f"{written}: {size / 1e6:.1f} MB of weights, {registry.CARD} and README.md")
    return 0


def _export_weights(options: ExportOptions, out: Path) -> int:
    """Write all weights, by this package's names or by those of the authors' files."""
    from anytouch_jax.weights import load, safetensors

    if options.between is None:
        refuse_unused(options, ("fraction",), "without --between")
    read = [path for path in (options.model, options.between) if path and not path.is_dir()]
    check_folder(out, read=read, suffix=".safetensors")
    loaded = load.load_model(options.model, stored_rows=True)
    params = loaded.params
    about = loaded.export_metadata()
    if options.between is not None:
        params = _interpolated(options, options.between, loaded)
        about["source"] = (
            f"{options.fraction:g} of the way from {options.between} to {options.model}"
        )
    if options.to == "release":
        _write_release(options, out, params, loaded.config.model, about)
    else:
        about[safetensors.MODEL_KEY] = to_json(loaded.config.model)
        safetensors.export_safetensors(out, params, about)
    print(f"{out}: written")
    return 0


def _interpolated(options: ExportOptions, before: Path, loaded: Loaded) -> dict[str, Any]:
    """Return parameters between those of a run `before` and those `loaded`.

    Raises UserError for two networks.
    """
    from anytouch_jax.weights import load, safetensors, tree

    other = load.load_model(before, stored_rows=True)
    ours = loaded.config.model
    theirs = other.config.model
    differ = [name for name in _SAME if getattr(theirs, name) != getattr(ours, name)]
    grounds = [
        one.export_metadata().get(safetensors.BACKGROUND_KEY, "keep") for one in (other, loaded)
    ]
    if grounds[0] != grounds[1]:
        differ.append("background")
    if differ:
        raise UserError(
            f"{before} and {options.model} have different networks ({', '.join(differ)}). "
            "--between takes the run that MODEL was trained from."
        )
    return tree.interpolate(other.params, loaded.params, options.fraction)


def _write_release(
    options: ExportOptions,
    out: Path,
    params: dict[str, Any],
    model: ModelConfig,
    about: dict[str, str],
) -> None:
    """Write weights by the names of the authors' files, and log what these do not have.

    Raises UserError without a touch encoder and a decoder.
    """
    from anytouch_jax.weights import convert, safetensors

    if not {"touch", "decoder"} <= params.keys():
        raise UserError(
            f"{options.model} lacks the touch encoder or decoder of the authors' files. Use --to "
            "safetensors."
        )
    params, model = _universal_last(params, model)
    if "matcher" in params and model.match_head == "mlp":
        log(
            "the matching MLP of recipe paper is stored as cross_sensor_mlp.*, which the "
            "authors' code ignores"
        )
    if "force" in params:
        params = {name: part for name, part in params.items() if name != "force"}
        log(
            "the force heads are left out: the authors' files have none. Use --to safetensors "
            "to keep them."
        )
    arrays = convert.to_release(params, model, allow_extra=True)
    metadata = about | {safetensors.MODEL_KEY: to_json(model), "format": "pt"}
    safetensors.write_safetensors(out, arrays, metadata)


def _universal_last(
    params: dict[str, Any], model: ModelConfig
) -> tuple[dict[str, Any], ModelConfig]:
    """Return the same model with its universal tokens in the last row.

    The authors' code reads them there (id -1).
    """
    import numpy as np

    from anytouch_jax.weights.convert import match_sensors

    if model.sensors[-1] == UNIVERSAL:
        return params, model
    names = (*(name for name in model.sensors if name != UNIVERSAL), UNIVERSAL)
    rows = match_sensors(np.asarray(params["touch"]["sensor_tokens"]), model.sensors, names)
    touch = params["touch"] | {"sensor_tokens": rows}
    return params | {"touch": touch}, replace(model, sensors=names)
