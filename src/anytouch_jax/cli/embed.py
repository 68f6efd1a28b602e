"""`anytouch embed`: features of a manifest, a folder of frames, a video or a camera."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anytouch_jax.cli.options import Embed
from anytouch_jax.cli.output import check_folder
from anytouch_jax.cli.unused import refuse, refuse_join
from anytouch_jax.cli.words import log
from anytouch_jax.config import FIELD_SENSORS, UNIVERSAL
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.encoder.embed import Features
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.stream import Embedded
    from anytouch_jax.evaluate.heads import LinearHead

_MANIFESTS = (".csv", ".parquet")


def run(options: Embed) -> int:
    """Write the features of a manifest, a folder of frames or a video as an `.npz`."""
    _refuse_unused(options)
    from anytouch_jax.encoder import embed as embedding
    from anytouch_jax.encoder import encoder as features
    from anytouch_jax.evaluate.heads import load_head
    from anytouch_jax.train.mesh import enable_compilation_cache

    if not (options.stream and str(options.out) == "-"):
        # before what takes long: what is embedded must have a place
        check_folder(options.out, read=(options.run, options.input))
        if options.out.suffix.lower() != ".npz":
            raise UserError(f"{options.out}: features are written as .npz; name such a file with --out")
    head = None if options.head is None else load_head(options.head)
    if head is not None and options.pooling is None:
        options = replace(options, pooling=head.pooling)
    enable_compilation_cache()
    encoder = features.load_encoder(options.run).computed_in(options.dtype)
    features.check_frames(encoder.config.model, options.frames)
    refuse_join(options, encoder.config.model.frames)
    if head is not None:
        head.check(encoder.source, encoder.fingerprint, options.pooled, options.frames, options.join)
    if options.batch < 1:
        raise UserError(f"--batch must be 1 or more, not {options.batch}")
    if options.stream:
        return _stream(encoder, options, head)
    if not options.input.exists():
        raise UserError(f"no manifest, folder or video at {options.input}")
    if options.input.suffix.lower() in _MANIFESTS:
        found = _embed_manifest(encoder, options)
    else:
        found = _embed_frames(encoder, options)
        _say_universal(encoder, options)
    embedding.save_npz(options.out, _named(found, head), _about(encoder, options))
    left = f", {found.skipped} skipped" if found.skipped else ""
    print(f"{options.out}: {len(found.values)} features of {found.values.shape[1]} values{left}")
    return 0


def _about(encoder: Encoder, options: Embed) -> dict[str, str]:
    gel, shown = _gel(encoder, options), options.input.suffix.lower() not in _MANIFESTS
    of_frames = {
        "sensor": options.sensor or UNIVERSAL,
        "background": ("the first frame" if gel is None else str(gel)) if encoder.subtracts else "not taken off",
        "rotate": str(options.rotate),
        "flip": options.flip,
    }
    return {
        "encoder": encoder.source,
        "weights": encoder.fingerprint,
        "input": str(options.input),
        "pooling": options.pooled,
        "frames": str(options.frames),
        "join": options.join,
        "dtype": encoder.config.model.dtype,
    } | (of_frames if shown else {})


def _named(found: Features, head: LinearHead | None) -> Features:
    """Features with what a head says of them: `label` (n,) and its probability `p` (n,)."""
    if head is None:
        return found
    label, p = head(found.values)
    return replace(found, predictions={"label": label, "p": p.max(1)})


def _stream(encoder: Encoder, options: Embed, head: LinearHead | None) -> int:
    """Embed a camera or a video frame by frame: features to an .npz, or as JSON lines; then the latency budget."""
    from anytouch_jax.encoder import embed as embedding
    from anytouch_jax.encoder import stream

    lines = str(options.out) == "-"
    source, live = stream.open_source(options.input)
    rate = 0.0 if live else stream.rate_of(options.input)
    embedded = stream.stream(
        encoder,
        source,
        _sight(encoder, options),
        live=live,
        sensor=encoder.sensor_row(options.sensor or UNIVERSAL, log),
        frames=options.frames,
        stride=options.stride,
        pooling=options.pooled,
        join=options.join,
    )
    result = stream.collect(embedded, partial(_print_line, rate=rate, head=head) if lines else None)
    if not live and not result.interrupted and len(result.numbers):
        _say_cut(options.input, int(result.numbers[-1]) + 1)
    if not len(result.numbers) and not result.interrupted:
        raise UserError(f"{options.input} has too few frames for a clip of {options.frames} at stride {options.stride}")
    if not lines:
        keys = {"frame_index": result.numbers, "time": result.numbers / rate if rate else result.at}
        about = _about(encoder, options) | {"stride": str(options.stride)}
        about |= {"started": f"{result.started:.6f}"} if live and len(result.numbers) else {}
        found = embedding.Features(result.values, result.numbers, keys)
        embedding.save_npz(options.out, _named(found, head if len(result.numbers) else None), about)
    _say_universal(encoder, options)
    for line in stream.budget(result):
        log(line)
    if not lines:
        print(f"{options.out}: {len(result.values)} features of {result.values.shape[1]} values")
    return 0


def _print_line(one: Embedded, rate: float, head: LinearHead | None) -> None:
    values = [float(str(value)) for value in one.values]  # the shortest digits that give the same float32
    line: dict[str, Any] = {"frame": one.number, "time": round(one.number / rate if rate else one.at, 6)}
    if head is not None:
        (label,), p = head(one.values[None])
        line |= {"label": str(label), "p": round(float(p.max()), 6)}
    print(json.dumps(line | {"features": values}), flush=True)


def _gel(encoder: Encoder, options: Embed) -> Path | None:
    """The picture of the untouched gel: that of --background, or that of the folder where the encoder wants one."""
    from anytouch_jax.data.images import BACKGROUND, list_images

    if options.background is None and encoder.subtracts and options.input.is_dir():
        return list_images(options.input)[1].get(BACKGROUND)
    return options.background


def _say_universal(encoder: Encoder, options: Embed) -> None:
    """Tell of a sensor that was not named; once there are features, since a mistake is answered by one sentence."""
    if options.sensor is None:
        names = ", ".join(name for name in encoder.config.model.sensors if name != UNIVERSAL)
        log(f"no --sensor was given: the universal tokens were used; name it where it is one of {names}")


def _sight(encoder: Encoder, options: Embed) -> Any:
    from anytouch_jax.data.images import decode
    from anytouch_jax.encoder.preprocess import Preprocess

    gel = _gel(encoder, options)
    if gel is not None and not encoder.subtracts:
        log("--background is not used: this encoder sees touches as the camera gives them")
    if options.background is None and encoder.subtracts:
        what = "the first frame" if gel is None else str(gel)
        log(f"this encoder sees touches less the untouched gel: {what} is taken for that (else --background)")
    return Preprocess(encoder, None if gel is None else decode(gel), rotate=options.rotate, flip=options.flip)


def _embed_manifest(encoder: Encoder, options: Embed) -> Any:
    from anytouch_jax.data.manifest import manifest as manifests
    from anytouch_jax.encoder import embed as embedding

    manifest = manifests.read(options.input)
    rows = np.arange(len(manifest)) if options.split is None else manifest.rows_of(options.split)
    fields = np.isin(embedding.text_column(manifest, "sensor")[rows], FIELD_SENSORS)
    if fields.any():
        log(f"{fields.sum()} rows of sensors that measure force fields have no images and are left out")
        rows = rows[~fields]
    if options.background is not None:
        log("--background is not used: a manifest names the backgrounds of its rows")
    usable = rows if options.frames == 1 else np.intersect1d(rows, manifest.clips(options.frames)[:, -1])
    if len(usable) < len(rows):
        log(f"{len(rows) - len(usable)} of {len(rows)} rows end no clip of {options.frames} frames and are left out")
    rows, values = embedding.embed_rows(
        encoder, manifest, usable, options.frames, options.pooled, options.join, batch=options.batch,
        on_bad_sample=options.on_bad_sample, log=log,
    )  # fmt: skip
    keys = {name: embedding.text_column(manifest, name)[rows] for name in ("path", "sensor", "sequence", "split")}
    keys["frame_index"] = np.asarray(manifest.column("frame_index"))[rows]
    more = [name for name in manifest.table.column_names if name in ("object", "unit") or name.startswith("label.")]
    keys |= {name: embedding.plain_column(manifest, name)[rows] for name in more}
    return embedding.Features(values, rows, keys, len(usable) - len(rows))


def _embed_frames(encoder: Encoder, options: Embed) -> Any:
    """Every window of `frames` consecutive frames of a folder or a video, keyed by its last frame; no window reaches
    over a frame that is missing or cannot be read."""
    from anytouch_jax.encoder import embed as embedding

    row, see = encoder.sensor_row(options.sensor or UNIVERSAL, log), _sight(encoder, options)
    ring: list[np.ndarray] = []
    waiting: list[np.ndarray] = []
    values: list[np.ndarray] = []
    ends: list[int] = []
    names: list[str] = []

    def flush() -> None:
        if waiting:
            missing = options.batch - len(waiting) if values else 0  # one shape, one compilation
            full = np.stack(waiting + waiting[-1:] * missing)
            z = encoder.encode_touch(full, np.full(len(full), row), pooling=options.pooled, join=options.join)
            values.append(z[: len(waiting)])
            waiting.clear()

    last = None
    for number, name, frame in _numbered_frames(options):
        names.append(name)
        ring = ring if last is None or number == last + 1 else []
        ring = [] if frame is None else [*ring, see(frame)][-options.frames :]
        last = number
        if len(ring) == options.frames:
            waiting.append(np.stack(ring))
            ends.append(len(names) - 1)
        if len(waiting) == options.batch:
            flush()
    flush()
    count = len(names)
    if not any(names):
        _say_cut(options.input, count)
    if not values:
        raise UserError(f"{options.input} has {count} frames, too few for clips of {options.frames} that can be read")
    index = np.array(ends)
    keys = {"frame_index": index} | ({"path": np.array(names)[index]} if any(names) else {})
    return embedding.Features(np.concatenate(values), index, keys, max(0, count - options.frames + 1) - len(index))


def _say_cut(video: Path, count: int) -> None:
    """Tell of a video of which fewer frames could be read than it tells of."""
    from anytouch_jax.data.images import count_frames

    told = count_frames(video)
    if 0.98 * told > count + 2:  # some containers only estimate it
        log(f"{video} tells of {told} frames and {count} could be read; is it whole?")


def _numbered_frames(options: Embed) -> Iterator[tuple[int, str, np.ndarray | None]]:
    """Number, name and RGB pixels u8 of a picture, of a folder's pictures in natural order, or of a video's frames,
    which have no names. A picture that cannot be read is None where bad samples are skipped."""
    from anytouch_jax.data.images import (
        SUFFIXES,
        ImageError,
        decode,
        frame_numbers,
        frames_from_video,
        list_images,
        split_series,
    )

    if options.input.suffix.lower() in SUFFIXES and options.input.is_file():
        yield 0, options.input.name, decode(options.input)
        return
    if not options.input.is_dir():
        yield from ((number, "", frame) for number, frame in enumerate(frames_from_video(options.input)))
        return
    files, beside = list_images(options.input)
    if beside:
        log(f"{', '.join(file.name for file in beside.values())}: not a frame, not embedded")
    start = 0  # of the numbers of a finger's frames: no clip reaches from one finger to the next
    for names in split_series([file.name for file in files]).values():
        numbers = [start + number for number in frame_numbers(names)]
        start = numbers[-1] + 2
        for number, name in zip(numbers, names, strict=True):
            try:
                yield number, name, decode(options.input / name)
            except ImageError:
                if options.on_bad_sample == "error":
                    raise
                yield number, name, None


def _refuse_unused(options: Embed) -> None:
    if options.stream:
        refuse(options, ("split", "batch"), "with --stream, which embeds every frame by itself")
        refuse(options, ("on_bad_sample",), "with --stream: a frame that cannot be had ends it")
        if options.frames == 1:
            refuse(options, ("stride",), "for single frames", "; or ask for clips with --frames")
    elif options.input.suffix.lower() in _MANIFESTS:
        refuse(options, ("sensor", "stride"), "with a manifest, whose rows name their sensor and stride")
        refuse(
            options, ("rotate", "flip"), "with a manifest, whose pictures are those of the training: turn their files"
        )
    else:
        refuse(options, ("split",), "with a folder or a video: only a manifest has splits")
        refuse(options, ("stride",), "without --stream: clips of a folder or a video are of frames in a row")
        if options.input.is_file():
            refuse(options, ("on_bad_sample",), "with a video, of which nothing can be read behind a bad frame")
