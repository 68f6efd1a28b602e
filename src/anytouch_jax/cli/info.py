"""`anytouch info`: what a run, a weights file, a manifest or features are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from anytouch_jax.cli.output import check_folder, log, print_table, refuse_unused
from anytouch_jax.config import UNIVERSAL, Config, DataConfig, ModelConfig, from_json
from anytouch_jax.errors import UserError, shorten

if TYPE_CHECKING:
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.live.health import UnitHealth
    from anytouch_jax.weights.keymaps import Weights

_TABLES = (".csv", ".parquet")
_SPREAD_BYTES = 1 << 28  # the features of larger files are not read
_WEIGHTS = (".safetensors", ".pth", ".pt", ".ckpt", ".bin", ".npz")


@dataclass(frozen=True)
class InfoOptions:
    """Describe an encoder by name, a run, weights, a manifest, features, a head, images, a video,
    or the cameras.

    Example: anytouch info runs/stage2 data/scenes/manifest.parquet features.npz

    `anytouch info encoders` lists the encoders in the package, and `anytouch info cameras` the
    connected cameras. `--health` checks every sensor unit of a manifest.
    """

    paths: Positional[tuple[Path, ...]]  # Files, folders and names of encoders.
    # Check every sensor unit of a manifest, and print a verdict and what to do.
    health: bool = False
    image: Path | None = None  # PNG with an image and the verdict of each unit, with --health.
    # Does this encoder see contact? With --health, on rows with contact or background.
    model: Path | None = None


def run(options: InfoOptions) -> int:
    """Print some lines about every path."""
    if options.health:
        return _health(options)
    refuse_unused(options, ("image", "model"), "without --health")
    for number, path in enumerate(options.paths):
        lines = "\n".join(_lines(path)).split("\n")
        print("\n" * bool(number) + "\n".join(map(shorten, lines)))
    return 0


def _health(options: InfoOptions) -> int:
    """Print a table with the checks of every sensor unit, and what to do.

    Exit status 1 reports a fault.
    """
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.evaluate.tables import markdown_table
    from anytouch_jax.live import health

    check_folder(options.image, "--image", read=options.paths, suffix=".png")
    table = manifests.read(options.paths)
    units = list(health.read_units(table))
    if not units:
        raise UserError(
            "No image of a sensor can be read. Check the manifest with `anytouch data verify`."
        )
    results = health.check_units(
        units, {unit.sensor: health.known_backgrounds(unit.sensor) for unit in units}
    )
    if options.model is not None:
        results = [_seen_by(options.model, table, unit) for unit in results]
    marks = {True: "", False: "FAULT ", None: "? "}
    for unit in results:
        rows = [
            (check.name, marks[check.ok] + check.value, "" if check.ok else check.advice)
            for check in unit.checks
        ]
        print(f"\n{shorten(f'{unit.sensor} {unit.unit}')}: {unit.rows:,} frames, {unit.verdict}\n")
        cells = [
            (name, shorten(value), advice if value.startswith("FAULT") else "")
            for name, value, advice in rows
        ]
        print_table(markdown_table(("check", "value", "what to do"), cells))
    if options.image is not None:
        health.health_sheet(results, options.image)
        log(f"{options.image}: an image of each unit")
    faulty = sum(bool(unit.faults) for unit in results)
    print(f"\n{len(results) - faulty} of {len(results)} units are good")
    return int(faulty > 0)


def _seen_by(model: Path, table: Manifest, unit: UnitHealth) -> UnitHealth:
    """Return the health of a unit with the check whether an encoder sees its contact."""
    from dataclasses import replace

    import numpy as np

    from anytouch_jax.cli.embed import contact_of_rows
    from anytouch_jax.encoder.embed import embed_rows
    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.live.health import contact_visible

    here = (table.text_column("sensor") == unit.sensor) & (table.text_column("unit") == unit.unit)
    rows = np.flatnonzero(here & (table.text_column("split") != "background"))
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, 96).astype(int))] if len(rows) else rows
    touched = contact_of_rows(table, rows)
    rows = rows[~np.isnan(touched)]
    touched = touched[~np.isnan(touched)] > 0
    kept, values = (
        embed_rows(load_encoder(model), table, rows, log=log)
        if len(rows)
        else (rows, np.zeros((0, 1)))
    )
    return replace(
        unit, checks=(*unit.checks, contact_visible(values, touched[np.isin(rows, kept)]))
    )


def _of_a_word(word: str) -> list[str]:
    """Return lines about the encoders, one of them by its name, or the cameras, [] for no such
    word.
    """
    from anytouch_jax.weights import registry

    if word == "encoders":
        return [_named(name) for name in registry.list_encoders()]
    if word in registry.list_encoders():
        return [_named(word), *_weights(registry.locate(word))]
    if word == "cameras":
        from anytouch_jax.live.cameras import describe_cameras

        return describe_cameras() or ["no camera is connected"]
    return []


def _lines(path: Path) -> list[str]:
    """Return lines about whatever a user names. Raises UserError for what is of no known kind."""
    lines = _of_a_word(str(path))
    if lines:
        return lines
    if not path.exists():
        raise UserError(f"there is no {path}. Name a file, a folder or an encoder.")
    suffix = path.suffix.lower()
    if lines := _container(path):
        return lines
    description = path.with_name(f"{path.name}.json")
    weights = None
    if path.is_dir() or (suffix in _WEIGHTS and suffix != ".npz" and not description.is_file()):
        from anytouch_jax.zoo.families import load_family

        model, weights = load_family(path)
        if model is not None:
            from anytouch_jax.zoo.encoder import describe_family, family_encoder

            lines = describe_family(family_encoder(model, str(path), path))
            return [f"{path}: {lines[0]}", *lines[1:]]
    if path.is_dir():
        return _folder(path)
    if description.is_file():
        from anytouch_jax.export.export import read_checked

        read_checked(path)
        return [f"{path}: an exported encoder", description.read_text("utf-8").strip()]
    if suffix in _TABLES:
        return _manifest(path)
    if suffix == ".npz" and (lines := _arrays(path) or _stack(path)):
        return lines
    if suffix in _WEIGHTS or path.name.endswith(".index.json"):
        return _weights(path, weights)
    if lines := _images(path):
        return lines
    known = (
        f"a run folder, weights ({', '.join(_WEIGHTS)}), a manifest ({', '.join(_TABLES)}), "
        "features, a head"
    )
    raise UserError(f"{path} has no known format. Known are {known}, images and videos.")


def _container(path: Path) -> list[str]:
    """Return lines about HDF5 or zarr, whose cameras --keys chooses, [] for anything else."""
    from anytouch_jax.data import containers

    kind = containers.kind_of(path)
    if kind not in ("hdf5", "zarr"):
        return []
    from anytouch_jax.datasets.readers.containers import describe_container

    with containers.open_container(path) as container:
        lines = describe_container(container)
    command = f"anytouch data index {kind} {path} --sensor NAME --keys KEY"
    return [f"{path}: {kind}", *lines, f"make a manifest of it: {command}"]


def _stack(path: Path) -> list[str]:
    """Return lines about the stacks of frames in an .npz, [] for one without."""
    from anytouch_jax.data.containers import open_container

    with open_container(path) as container:
        stacks = [one for one in container.fields() if one.form is not None and not one.form.single]
    if not stacks or any(len(one.shape) < 4 for one in stacks):
        return []  # weights have arrays of two and three axes
    lines = [
        f"{one.key}: {one.form.frames} frames, {one.form.words(one.dtype)}"
        for one in stacks
        if one.form is not None
    ]
    return [f"{path}: a stack of frames", *lines, "use it with embed and measure"]


def _images(path: Path) -> list[str]:
    """Return lines about an image, a folder of images or a video, [] for anything else."""
    import cv2

    from anytouch_jax.data import images
    from anytouch_jax.live.cameras import format_of

    use = "use it with embed and view"
    if (files := images.image_files(path)) is not None:
        height, width = images.decode(files[0]).shape[:2]
        what = f"a folder of {len(files)} images" if path.is_dir() else "an image"
        return [f"{path}: {what} of {width} x {height} pixels", use]
    video = images.open_video(path)
    names = (
        cv2.CAP_PROP_FRAME_COUNT,
        cv2.CAP_PROP_FRAME_WIDTH,
        cv2.CAP_PROP_FRAME_HEIGHT,
        cv2.CAP_PROP_FPS,
    )
    count, wide, high, rate = (video.get(name) for name in names)
    codec = format_of(video)
    is_video = video.isOpened() and video.read()[0]
    video.release()
    if not is_video:
        return []
    frames = f"{count:.0f} frames" if count > 0 else "an unknown number of frames"
    seconds = f", {count / rate:.1f} s at {rate:.4g} frames/s" if rate > 0 and count > 0 else ""
    about = f"{wide:.0f} x {high:.0f} pixels, codec {codec or 'unknown'}"
    return [f"{path}: a video of {frames}{seconds}, {about}", f"{use}, and with stream"]


def _named(name: str) -> str:
    """Return a line about an encoder of the package."""
    from anytouch_jax.weights import registry

    card = registry.read_card(name)
    size = sum(card["parameters"].values()) / 1e6
    sensors = ", ".join(card["trained_sensors"] or ["unknown"])
    return f"{name}: {size:.1f} M parameters, {card['image_size']} pixels, trained on {sensors}"


def _folder(path: Path) -> list[str]:
    """Return lines about a run, or about the manifest in the folder: that called manifest, or the
    first.
    """
    from anytouch_jax.data.images import SUFFIXES
    from anytouch_jax.data.manifest.schema import is_manifest
    from anytouch_jax.weights.checkpoint import steps

    tables = [
        file
        for file in sorted(path.iterdir())
        if file.suffix.lower() in _TABLES and is_manifest(file)
    ]
    tables.sort(key=lambda file: file.stem != "manifest")
    if steps(path / "checkpoints") or not tables:
        is_run = (path / "checkpoints").exists() or not any(
            file.suffix.lower() in SUFFIXES for file in path.iterdir()
        )
        if is_run:
            return _run(path)
        return _images(path)
    others = ", ".join(sorted(file.name for file in tables[1:]))
    return [
        *_manifest(tables[0]),
        *([f"other manifests in this folder: {others}"] if others else []),
    ]


def _run(path: Path) -> list[str]:
    from anytouch_jax.weights import checkpoint

    metadata = checkpoint.read_metadata(path)
    config: Config = from_json(metadata["config"])
    source = metadata.get("source") or {}
    loss = metadata.get("metrics", {}).get("loss")
    saved = checkpoint.steps(path / "checkpoints")
    best = checkpoint.best_of(path / "checkpoints")
    model = [_model(config.model), _sensors(config.model, metadata.get("seen"))]
    if "sensor" in source:
        frames = source["frames"]
        minutes = source.get("minutes")
        how = (
            f"trained on {minutes:g} minutes of simulated touches"
            if minutes
            else f"fitted to {frames} frames"
        )
        adapted = f"tokens of {source['sensor']} {how}"
        lines = [f"{path}: the run {source['run']}, with {adapted}", *model]
    else:
        checkpoints = f", checkpoints at {', '.join(map(str, saved))}" if saved else ""
        checkpoints += "" if best is None else f" (lowest loss at {best})"
        starts = [
            f"{name} {source[name]}" for name in ("init", "clip") if source.get(name) is not None
        ]
        content = f" (content {metadata['data'][:12]})" if metadata.get("data") else ""
        lines = [
            f"{path}: a run of stage {config.stage}, step {metadata['step']} of "
            f"{config.run.steps}{checkpoints}",
            f"preset {config.preset}, recipe {config.recipe}, towers {config.towers}, batch "
            f"{config.data.batch_size}",
            *model,
            f"background: {config.data.background}",
            f"started from {', '.join(starts) or 'random weights'}",
            f"data: {', '.join(config.data.manifests) or 'unknown'}{content}",
        ]
        lines += (
            [] if loss is None else [f"loss {loss:.4g}, the mean since the previous checkpoint"]
        )
    try:
        checkpoint.checked(checkpoint.find_checkpoint(path, None))
    except checkpoint.CheckpointError as error:
        lines.append(str(error))
    return lines


def _model(model: ModelConfig, *, heads_known: bool = True) -> str:
    heads = f"{model.touch.heads} heads" if heads_known else "heads unknown"
    return (
        f"touch encoder: width {model.touch.width}, depth {model.touch.depth}, {heads}, images of "
        f"{model.image_size} pixels, {model.patch_encoder} patches of {model.patch}, {model.embed} "
        "features"
    )


def _sensors(model: ModelConfig, trained: Sequence[str] | None) -> str:
    if trained is None:
        names = ", ".join(name for name in model.sensors if name != UNIVERSAL)
        return f"sensors: {names}. It is unknown which of them were trained."
    return f"trained sensors: {', '.join(trained) or 'none'}. All others get the universal tokens."


def _weights(path: Path, weights: Weights | None = None) -> list[str]:
    import numpy as np

    from anytouch_jax.weights import load, safetensors
    from anytouch_jax.weights.convert import detect_layout, to_params

    weights = load.read_weights(path) if weights is None else weights
    metadata = safetensors.read_file_metadata(path)
    layout = detect_layout(weights)
    known = {"own": "this package's", "clip": "HF CLIP's", "openclip": "OpenCLIP's"}
    names = known.get(layout, f"the authors' ({layout})")
    model, unknown = load.form_of_file(path, weights)
    count = sum(array.size for array in weights.values())
    lines = [
        f"{path}: {len(weights)} arrays of {count:,} numbers, with {names} names",
        _model(model, heads_known=not unknown.keys() & {"touch", "image"}),
    ]
    if layout not in ("clip", "openclip"):
        lines.append(_sensors(model, load.trained_sensors(metadata, model)))
        background: Any = metadata.get(safetensors.BACKGROUND_KEY, "keep")
        try:
            lines.append(f"background: {DataConfig(background=background).background}")
            to_params(weights, model)
        except UserError as error:
            lines.append(f"These weights cannot be used: {error}")
    elif not load.clip_activation(path):
        lines.append("The activation is unknown. OpenAI's CLIP wants quick_gelu.")
    if unknown:
        lines.append(
            f"Its head counts are unknown ({', '.join(unknown)}): a config.json gives them."
        )
    if infinite := next(
        (name for name, array in weights.items() if not np.isfinite(array).all()), ""
    ):
        lines.append(f"{infinite} is not finite, so that these weights cannot embed anything.")
    return lines


def _manifest(path: Path) -> list[str]:
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.data.manifest.schema import listed

    summary = manifests.summarise_file(path)

    def counts(name: str) -> str:
        shown, distinct = summary.counts[name]
        return listed([f"{value[:40]} {rows:,}" for value, rows in shown], distinct)

    optional = ("image_path", "text", "background_path", "touch", "object", "field_path")
    filled = [f"{name} {summary.filled[name]:,}" for name in optional if name in summary.filled]
    labels = [name.removeprefix("label.") for name in summary.filled if name.startswith("label.")]
    return [
        f"{path}: a manifest of {summary.rows:,} rows in {summary.recordings:,} recordings, "
        f"{summary.clips:,} clips of three frames",
        f"splits: {counts('split')}",
        f"sensors: {counts('sensor')}",
        f"rows with {', '.join(filled) or 'no optional column'}",
        f"labels: {listed(labels) or 'none'}",
        f"content {summary.digest[:12]}",
    ]


def _arrays(path: Path) -> list[str]:
    """Return lines about features or a head; [] for another .npz.

    Raises UserError for a damaged file.
    """
    from anytouch_jax.encoder.arrays import spread_lines
    from anytouch_jax.files import read_arrays

    is_small = path.stat().st_size < _SPREAD_BYTES
    try:
        arrays = read_arrays(
            path, only=lambda name: name.startswith("about/") or (is_small and name == "features")
        )
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is not a whole .npz file of plain arrays: {error}.") from None
    if {"format", "mark"} <= arrays.keys():
        from anytouch_jax.encoder.linear_head import LinearHead, load_head

        head = load_head(path)
        what = "a number"
        if isinstance(head, LinearHead):
            what = ", ".join(head.classes)
        return [
            f"{path}: a linear head for {head.label}: {what}",
            f"for features of {len(head.mean)} with --pooling {head.pooling} --frames "
            f"{head.frames}, encoder {head.fingerprint}",
            *(head.promises() or ["without calibration: save it again"]),
        ]
    if not {"features", "rows"} <= arrays.keys():
        return []
    values = arrays["features"]
    rows = arrays["rows"]
    if values.ndim != 2 or values.dtype.kind not in "fiu" or rows.shape != values.shape[:1]:
        raise UserError(
            f"{path} needs numeric features (n, d) and rows (n,), not {values.shape} and "
            f"{rows.shape}."
        )
    keys = ", ".join(name.removeprefix("key/") for name in arrays if name.startswith("key/"))
    about = {
        name.removeprefix("about/"): str(arrays[name])[:200]
        for name in arrays
        if name.startswith("about/")
    }
    return [
        f"{path}: {len(values):,} features of {values.shape[1]}, with {keys or 'row numbers'}",
        *(f"{name}: {text}" for name, text in about.items()),
        *(spread_lines(values) if is_small else []),
    ]
