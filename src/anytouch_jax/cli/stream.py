"""`anytouch stream`, live features frame by frame, and `anytouch view`, a page in the browser."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional

from anytouch_jax.cli import embed
from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.cli.output import check_folder, log, refuse_unused
from anytouch_jax.config import UNIVERSAL
from anytouch_jax.config.parsing import Above0, Count, NotNegative, Range
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.encoder.linear_head import LinearHead
    from anytouch_jax.live.cameras import CameraSettings
    from anytouch_jax.live.page.live import Live
    from anytouch_jax.live.page.server import Source
    from anytouch_jax.live.stream import Embedded


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """What a camera is asked for. The log says what it gives."""

    # Camera: width and height of its pictures, pixels.
    camera_size: Count[tuple[int, int] | None] = None
    camera_fps: Above0[float | None] = None  # Camera: frames a second.
    camera_format: str | None = None  # Camera: format, four letters such as MJPG or YUYV.

    def settings(self) -> CameraSettings:
        """Return the settings. Raises UserError for a format that is not four letters."""
        from anytouch_jax.live.cameras import CameraSettings

        form = self.camera_format
        if form is not None and not (len(form) == 4 and form.isascii() and form.isalnum()):
            raise UserError(
                f"--camera-format takes four letters such as MJPG or YUYV, not {form[:40]!r}."
            )
        return CameraSettings(self.camera_size, self.camera_fps, form)


@dataclass(frozen=True, kw_only=True)
class StreamOptions(CameraOptions, embed.FrameOptions):
    """Embed a camera or a video frame by frame, and report the latency of each part.

    Example: anytouch stream --data 0 --sensor digit --out -

    A camera's frames are dropped while the encoder is busy. Press Ctrl-C to stop and save. A camera
    that delivers no frame for 2 seconds ends the stream with an error, after the features are
    saved.
    """

    data: str
    """Camera or video file. A camera is a number such as 0, a part of its name, its serial,
    /dev/video0, or an address http:// or rtsp://. `anytouch info cameras` lists them.
    """
    out: Path  # The .npz to write, or - for one JSON line per frame on standard output.
    # Frames from one frame of a clip to the next, as in the training data.
    stride: Count[int] = 1
    reuse: NotNegative[float] = 0.0
    """Reuse features while no place changes by more than so many times the camera's noise (0: while
    frames are equal).
    """
    fields: bool = False
    """Also measure: each line has force, torque, depth, area, centre and slip, in N and mm, with
    deviations. Shear and slip need --frames 3.
    """
    # --fields: mm that the picture's width shows. Known sensors need none.
    width_mm: Above0[float | None] = None


def run_stream(options: StreamOptions) -> int:
    """Embed frame by frame, write features or JSON lines, then print the latency."""
    lines = str(options.out) == "-"
    settings = options.settings()
    data = Path(options.data)
    if not lines:
        check_folder(options.out, read=(options.model, data), suffix=".npz")
    if options.frames == 1:
        refuse_unused(options, ("stride",), "on single frames. Ask for clips with --frames, or")
    if not options.fields:
        refuse_unused(options, ("width_mm",), "without --fields")
    from anytouch_jax.data.images import decode
    from anytouch_jax.encoder.embed import Features
    from anytouch_jax.live import stream

    # first: it fails within a second
    source, live = stream.open_source(options.data, settings, log)
    if not live:
        refuse_unused(options, [field.name for field in fields(CameraOptions)], "with a film")
    encoder, pooling, head = embed.load_inputs(options)
    measure = None
    if options.fields:
        gel = None if options.background is None else decode(options.background)
        turned: dict[str, Any] = {"rotate": options.rotate, "flip": options.flip}
        measure = encoder.measure_of(
            options.sensor or UNIVERSAL, gel, options.width_mm, log, **turned
        )
    known = encoder.gels if head is None else head.gels
    row, preprocess, gate, about = embed.frames_input(encoder, options, data, known)
    embedded = stream.stream(
        encoder,
        source,
        preprocess,
        live=live,
        sensor=row,
        frames=options.frames,
        stride=options.stride,
        pooling=pooling,
        join=options.join,
        log=log,
        contact=gate,
        reuse=options.reuse,
        measure=measure,
    )
    result = stream.collect(
        embedded, (lambda frame: _print_line(frame, live, head)) if lines else None
    )
    if result.error is not None and not result.total:
        raise result.error
    if not live and not result.interrupted:
        if not len(result.numbers):
            raise UserError(
                f"{data} has too few frames for a clip of {options.frames} at stride "
                f"{options.stride}. "
                "Lower one of them."
            )
        embed.log_if_cut(data, int(result.numbers[-1]) + 1)
    if not lines:
        about |= {"stride": str(options.stride), "pooling": pooling, "input": options.data}
        if live and len(result.numbers):
            about |= {"started": f"{result.started:.6f}"}
            about |= {name: str(getattr(result, name)) for name in ("missed", "frozen", "black")}
        features = Features(
            result.values, result.numbers, {"frame_index": result.numbers, "time": result.time}
        )
        features.keys.update(reused=result.reused, estimated=result.estimated)
        features.gels.update(embed.gels_of(preprocess, options))
        features.predictions.update(result.fields or {})
        features.predictions["contact"] = result.contact
        embed.save_features(options.out, encoder, features, head, options, about)
    embed.log_universal(encoder, options)
    for line in stream.budget(result):
        log(line)
    if not lines:
        print(f"{options.out}: {len(result.values)} features of {result.values.shape[1]} values")
    if result.error is not None:
        raise result.error
    return 0


def _print_line(frame: Embedded, live: bool, head: LinearHead | None) -> None:
    # the shortest digits of the same float32
    values = [float(str(value)) for value in frame.values]
    line: dict[str, Any] = {"frame": frame.number, "time": round(frame.time, 6)}
    if live:
        line |= {"picture": frame.picture, "missed": frame.missed}
    line |= {"reused": frame.reused} | ({"background": "estimated"} if frame.estimated else {})
    if head is not None and head.calibration is not None:
        one = head.assess(frame.values[None])
        line |= {"label": str(one.label[0]), "p": round(float(one.p.max()), 6)}
        line |= {"set": head.classes[one.in_set[0]].tolist(), "novel": bool(one.novel[0])}
    elif head is not None:
        (label,), p = head(frame.values[None])
        line |= {"label": str(label), "p": round(float(p.max()), 6)}
    line |= {"contact": None if frame.contact != frame.contact else bool(frame.contact)}
    measured = {} if frame.fields is None else {"fields": frame.fields.summary()}
    print(json.dumps(line | measured | {"features": values}), flush=True)


@dataclass(frozen=True, kw_only=True)
class ViewOptions(CameraOptions):
    """Show recordings, features, a run or a camera on a page in the browser.

    Example: anytouch view manifest.parquet features.npz runs/stage1

    Name a manifest, a folder of pictures, a film, a features file of `anytouch embed`, a run
    folder, the word examples, or a camera: 0, a part of its name, its serial, or an address http://
    or rtsp://. Without any, the page shows the cameras that are connected, and the examples.
    Features show their pictures if their manifest is named, too. Press Ctrl-C to stop.
    """

    paths: Positional[tuple[str, ...]] = ()  # What to show, several at once.
    live: bool = False  # Play films as if they came from a camera.
    # Encoder of a camera: a name, a run, a weights file, or hf://user/repo.
    model: Path = Path(DEFAULT)
    sensor: str | None = None  # Sensor of a camera. Without it, the universal tokens are used.
    # Show the class of a camera's touch by this head of `anytouch probe label --save`.
    head: Path | None = None
    out: Path = Path("recordings")
    """Folder for recordings of a camera, with their manifest.parquet, and for the head that they
    teach.
    """
    # Address to listen on. For any but this machine's own, the page asks for a token.
    host: str = "127.0.0.1"
    port: Annotated[int, Range(1, 65535, "1 to 65535")] = 8765  # Port to listen on.


def run_view(options: ViewOptions) -> int:
    """Serve the page until Ctrl-C."""
    try:
        from anytouch_jax.live.page import server
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn"):
            raise
        raise UserError(
            'The page needs starlette and uvicorn: pip install "anytouch_jax[view]"'
        ) from None
    from anytouch_jax.live.cameras import camera_of

    tables = (".csv", ".parquet", ".npz")
    played = [
        one
        for one in options.paths
        if Path(one).is_file() and Path(one).suffix.lower() not in tables
    ]
    played = played if options.live else []
    cameras = [path for path in options.paths if path in played or camera_of(path) is not None]
    if not cameras and options.paths:
        refuse_unused(
            options, ("model", "sensor", "head", "out"), "without a camera, or a film with --live"
        )
    if len(cameras) == len(played) and options.paths:
        refuse_unused(options, [field.name for field in fields(CameraOptions)], "without a camera")
    if len(cameras) > 1:
        raise UserError(
            f"One camera can be shown at a time, not {len(cameras)}. Start another page for the "
            "next."
        )
    begin = time.perf_counter()
    sources = server.open_sources(
        [Path(path) for path in options.paths or ("examples",) if path not in cameras]
    )
    if not options.paths:
        sources.insert(0, server.StartPage(lambda camera: _open_camera(options, camera, sources)))
    for camera in cameras:
        sources.append(_open_camera(options, camera, sources))
    log(f"opened in {time.perf_counter() - begin:.1f} s")
    server.serve(
        sources,
        options.host,
        options.port,
        lambda at: print(f"Open {at} (Ctrl-C stops)", flush=True),
    )
    return 0


def _open_camera(options: ViewOptions, camera: str, sources: list[Source]) -> Live:
    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.encoder.linear_head import load_head
    from anytouch_jax.live.page.live import Live
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    if str(options.model) == DEFAULT:
        log(f"encoder: {DEFAULT} (name another with --model)")
    encoder = load_encoder(options.model)
    head = None if options.head is None else load_head(options.head)
    if head is not None:
        head.check(encoder.source, encoder.fingerprint, head.pooling, 1)
    spaces: list[Any] = [source for source in sources if source.kind == "space"]
    return Live(
        camera,
        encoder,
        sensor=options.sensor,
        head=head,
        space=spaces[0] if spaces else None,
        out=options.out,
        camera=options.settings(),
        log=log,
    )
