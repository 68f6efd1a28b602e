"""What the subcommands of `anytouch` do, given their parsed options. Each returns an exit status."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.markdown import Markdown
from rich.table import Table

from anytouch_jax.config import UNIVERSAL, Config, Model, UserError

if TYPE_CHECKING:
    from anytouch_jax import cli
    from anytouch_jax.evaluate.features import Encoder

_MANIFESTS = (".csv", ".parquet")
_VIDEOS = (".avi", ".mp4", ".mov", ".mkv", ".webm", ".m4v")


def say(sentence: str) -> None:
    """Tell the user something that is not a result: on standard error."""
    Console(stderr=True, highlight=False).print(sentence, markup=False, soft_wrap=True)


def train(options: cli.Train, config: Config) -> int:
    """Train or go on; 0 also after SIGTERM (saved), 130 after Ctrl-C (saved)."""
    from anytouch_jax.pretrain import pretrain
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    result = pretrain(config, options.run, init=options.init, clip=options.clip, stop_after=options.stop_after, say=say)
    if result.interrupted == signal.SIGINT:
        return 130
    say(f"{options.run}: {result.step} of {config.run.steps} steps")
    return 0


def embed(options: cli.Embed) -> int:
    """Write the features of a manifest, a folder of frames or a video as an `.npz`."""
    from anytouch_jax.evaluate import features

    encoder = features.load_encoder(options.run)
    if not options.input.exists():
        raise UserError(f"no manifest, folder or video at {options.input}")
    if options.input.suffix.lower() in _MANIFESTS:
        found = _embed_manifest(encoder, options)
    else:
        found = _embed_frames(encoder, options)
    about = {
        "encoder": encoder.source,
        "input": str(options.input),
        "pooling": options.pooling,
        "frames": str(options.frames),
        "join": options.join,
    }
    features.save_npz(options.out, found, about)
    left = f", {found.skipped} skipped" if found.skipped else ""
    print(f"{options.out}: {len(found.values)} features of {found.values.shape[1]} values{left}")
    return 0


def _embed_manifest(encoder: Encoder, options: cli.Embed) -> Any:
    from anytouch_jax.data import manifest as manifests
    from anytouch_jax.evaluate import features

    manifest = manifests.read(options.input)
    rows = np.arange(len(manifest)) if options.split is None else manifest.rows_of(options.split)
    usable = rows if options.frames == 1 else np.intersect1d(rows, manifest.clips(options.frames)[:, -1])
    if len(usable) < len(rows):
        say(f"{len(rows) - len(usable)} of {len(rows)} rows end no clip of {options.frames} frames and are left out")
    rows, values = features.embed_rows(
        encoder, manifest, usable, options.frames, options.pooling, options.join, batch=options.batch, say=say
    )
    keys = {name: features.text_column(manifest, name)[rows] for name in ("path", "sensor", "sequence", "split")}
    keys["frame_index"] = np.asarray(manifest.column("frame_index"))[rows]
    return features.Features(values, rows, keys, len(usable) - len(rows))


def _embed_frames(encoder: Encoder, options: cli.Embed) -> Any:
    """Every window of `frames` consecutive frames of a folder or a video, keyed by its last frame."""
    from anytouch_jax.data.loader import frames_from_folder, frames_from_video
    from anytouch_jax.data.transforms import touch_evaluation
    from anytouch_jax.evaluate import features

    read = frames_from_folder if options.input.is_dir() else frames_from_video
    row, size = encoder.sensor_row(options.sensor, say), encoder.config.model.image_size
    ring: list[np.ndarray] = []
    waiting: list[np.ndarray] = []
    values: list[np.ndarray] = []
    count = 0

    def flush() -> None:
        if waiting:
            full = np.stack(waiting + waiting[-1:] * (options.batch - len(waiting)))  # one shape, one compilation
            z = encoder.embed(full, np.full(len(full), row), pooling=options.pooling, join=options.join)
            values.append(z[: len(waiting)])
            waiting.clear()

    for frame in read(options.input):
        count += 1
        ring = [*ring, touch_evaluation([frame], size)[0]][-options.frames :]
        if len(ring) == options.frames:
            waiting.append(np.stack(ring))
        if len(waiting) == options.batch:
            flush()
    flush()
    if not values:
        raise UserError(f"{options.input} has {count} frames, too few for clips of {options.frames}")
    stacked = np.concatenate(values)
    index = np.arange(options.frames - 1, count)
    return features.Features(stacked, index, {"frame_index": index})


def probe(options: cli.Probe) -> int:
    """Probe frozen features on a label column, print a table, write JSON when asked."""
    from anytouch_jax.evaluate import results
    from anytouch_jax.evaluate.probe_command import run_probes

    found = run_probes(options, say)
    Console().print(Markdown(results.to_table(found))) if Console().is_terminal else print(results.to_table(found))
    if options.out is not None:
        from anytouch_jax.train.record import write_atomic

        options.out.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(options.out, results.to_json(found))
    return 0


def parity(options: cli.Parity) -> int:
    """Run every golden case; 1 when one is out of tolerance or not understood."""
    from anytouch_jax.evaluate import parity as golden

    rows = golden.run(options.folder)
    worst: dict[str, Any] = {}
    for row in rows:
        held = worst.get(row.case)
        if held is None or row.error / max(row.tolerance, 1e-30) > held.error / max(held.tolerance, 1e-30):
            worst[row.case] = row
    table = Table("case", "arrays", "worst array", "error", "tolerance", "")
    counts = {case: sum(row.case == case for row in rows) for case in worst}
    bad = [row for row in rows if not row.good]
    shown = rows if options.verbose else [*worst.values(), *(row for row in bad if row is not worst[row.case])][:200]
    for row in shown:
        mark = "ok" if row.good else f"OUT {row.note}"
        table.add_row(row.case, str(counts[row.case]), row.array, f"{row.error:.2g}", f"{row.tolerance:.2g}", mark)
    Console(width=None if Console().is_terminal else 160).print(table)
    print(f"{len(rows)} comparisons, {len(bad)} out of tolerance")
    return 1 if bad else 0


def convert(options: cli.Convert) -> int:
    """Write a run or a weights file as safetensors, by the authors' key names or by ours."""
    from anytouch_jax.config import from_json, to_json
    from anytouch_jax.io import checkpoint, release

    source: Path = options.source
    if source.is_dir():
        params, text, _ = checkpoint.load_params(source)
        model = from_json(text).model
    else:
        weights = release.read_weights(source)
        model = release.model_of(source, weights)
        params = release.to_params(weights, model)
    if options.names == "release" and model.sensors[-1] != UNIVERSAL:
        params, model = _universal_last(params, model)
    about = {"source": str(source), release.MODEL_KEY: to_json(model)}
    if options.names == "own":
        checkpoint.export_safetensors(options.target, params, about)
    else:
        if "matcher" in params and model.match_head == "mlp":
            say("the matching MLP of recipe paper is stored as cross_sensor_mlp.*: the authors' code does not read it")
        arrays = release.to_release(params, model, allow_extra=True)
        release.write_safetensors(options.target, arrays, about | {"format": "pt"})
    print(f"{options.target}: written")
    return 0


def _universal_last(params: dict[str, Any], model: Model) -> tuple[dict[str, Any], Model]:
    """The same model with its universal tokens in the last row, where the authors' code looks for them (id -1)."""
    from anytouch_jax.io import release

    names = (*(name for name in model.sensors if name != UNIVERSAL), UNIVERSAL)
    rows = release.match_sensors(np.asarray(params["touch"]["sensor_tokens"]), model.sensors, names)
    return params | {"touch": params["touch"] | {"sensor_tokens": rows}}, replace(model, sensors=names)
