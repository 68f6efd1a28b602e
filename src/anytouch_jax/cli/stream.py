"""`anytouch stream`, live features frame by frame, and `anytouch view`, a page in the browser."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional

from anytouch_jax.cli import embed, inputs
from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.cli.heads import head_in_use
from anytouch_jax.cli.output import check_folder, log, refuse_unused
from anytouch_jax.config import UNIVERSAL
from anytouch_jax.config.parsing import Above0, Count, NotNegative, Range
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.linear_head import Head
    from anytouch_jax.encoder.measured import Measure
    from anytouch_jax.live.cameras import CameraSettings
    from anytouch_jax.live.page.live import Live
    from anytouch_jax.live.page.server import Source
    from anytouch_jax.live.stream import Embedded, Result


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """What a camera is asked for. The log says what it gives."""

    # Camera: width and height of its images, pixels.
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
class StreamOptions(CameraOptions, inputs.FrameOptions):
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
    """Also measure: each line has force with its interval, torque, depth, area, centre and slip, in
    N and mm, with deviations. Shear and slip need --frames 3.
    """
    # --fields: mm that the image's width shows. Known sensors need none.
    width_mm: Above0[float | None] = None


def run_stream(options: StreamOptions) -> int:
    """Embed frame by frame, write features or JSON lines, then print the latency."""
    prints_lines = str(options.out) == "-"
    settings = options.settings()
    _check_stream(options)
    from anytouch_jax.live import stream
    from anytouch_jax.live.freshness import nominal_rate

    # The source is opened first, because it fails within a second.
    source, live = stream.open_source(options.data, settings, log)
    nominal = nominal_rate(source)  # a source that is released has none
    if not live:
        refuse_unused(options, [field.name for field in fields(CameraOptions)], "with a video")
    given = inputs.load_inputs(options)
    measure = _measure_of(given.encoder, options) if options.fields else None
    known = inputs.frames_input(given.encoder, options, Path(options.data), given.known_backgrounds)
    embedded = stream.stream_with(
        given.encoder,
        source,
        stream.StreamSettings(
            live=live,
            sensor=known.row,
            frames=options.frames,
            stride=options.stride,
            pooling=given.pooling,
            aggregation=options.aggregation,
            preprocess=known.preprocess,
            contact=known.gate,
            reuse=options.reuse,
            measure=measure,
            log=log,
        ),
    )
    on_each = None
    if prints_lines:
        on_each = partial(_print_line, live=live, head=given.head)
    result = stream.collect(embedded, on_each)
    if result.error is not None and not result.total:
        raise result.error
    if not live and not result.interrupted:
        _check_video(options, result)
    if not prints_lines:
        _save_stream(options, given, known, result, live=live)
    inputs.log_universal(given.encoder, options)
    for line in stream.budget(result):
        log(line)
    if live:
        _log_rate(result, nominal)
    if not prints_lines:
        print(f"{options.out}: {len(result.values)} features of {result.values.shape[1]} values")
    if result.error is not None:
        raise result.error
    return 0


def _check_stream(options: StreamOptions) -> None:
    """Raise UserError for options that do not go together, and for an output that cannot be."""
    if str(options.out) != "-":
        check_folder(options.out, read=(options.model, Path(options.data)), suffix=".npz")
    if options.frames == 1:
        refuse_unused(options, ("stride",), "on single frames. Ask for clips with --frames, or")
    if not options.fields:
        refuse_unused(options, ("width_mm",), "without --fields")


def _measure_of(encoder: Encoder, options: StreamOptions) -> Measure:
    """Return what measures the frames that the options name."""
    from anytouch_jax.data.images import decode

    gel = None if options.background is None else decode(options.background)
    return encoder.measure_of(
        options.sensor or UNIVERSAL,
        gel,
        options.width_mm,
        log,
        rotate=options.rotate,
        flip=options.flip,
    )


def _check_video(options: StreamOptions, result: Result) -> None:
    """Log a video that is shorter than its header says.

    Raises UserError for one without a clip.
    """
    if not len(result.numbers):
        raise UserError(
            f"{options.data} has too few frames for a clip of {options.frames} at stride "
            f"{options.stride}. Lower one of them."
        )
    inputs.log_if_cut(Path(options.data), int(result.numbers[-1]) + 1)


def _log_rate(result: Result, nominal: float) -> None:
    """Log how many fresh frames a second a camera gave, and a warning if they are too few."""
    rate = result.rate(nominal)
    if rate is None:
        return
    log(f"camera: {rate}")
    if rate.warning():
        log(rate.warning())


def _save_stream(
    options: StreamOptions,
    given: inputs.Inputs,
    known: inputs.FramesInput,
    result: Result,
    *,
    live: bool,
) -> None:
    """Write the features, with what was measured and predicted of their frames."""
    from anytouch_jax.encoder.embed import Features

    about = known.about
    about |= {"stride": str(options.stride), "pooling": given.pooling, "input": options.data}
    if live and len(result.numbers):
        about |= {
            "started": f"{result.started:.6f}",
            "missed": str(result.missed),
            "frozen": str(result.frozen),
            "black": str(result.black),
        }
    keys = {
        "frame_index": result.numbers,
        "time": result.time,
        "reused": result.reused,
        "estimated": result.estimated,
    }
    features = Features(result.values, result.numbers, keys)
    features.backgrounds.update(inputs.backgrounds_of(known.preprocess, options))
    features.predictions.update(result.fields or {})
    features.predictions["contact"] = result.contact
    embed.save_features(options.out, given.encoder, features, given.head, options, about)


def _print_line(frame: Embedded, live: bool, head: Head | None) -> None:
    """Print a frame as a line of JSON."""
    line: dict[str, Any] = {"frame": frame.number, "time": round(frame.time, 6)}
    if live:
        line |= {"picture": frame.image, "missed": frame.missed}
    line["reused"] = frame.reused
    if frame.estimated:
        line["background"] = "estimated"
    if head is not None:
        line |= head.summary(frame.values[None])
    is_known = frame.contact == frame.contact  # NaN is unknown
    line["contact"] = bool(frame.contact) if is_known else None
    if frame.fields is not None:
        line["fields"] = frame.fields.summary()
    # The shortest digits that are read back as the same float32.
    line["features"] = [float(str(value)) for value in frame.values]
    print(json.dumps(line), flush=True)


@dataclass(frozen=True, kw_only=True)
class ViewOptions(CameraOptions):
    """Show recordings, features, a run or a camera on a page in the browser.

    Example: anytouch view manifest.parquet features.npz runs/stage1

    Name a manifest, a folder of images, a video, a features file of `anytouch embed`, a run
    folder, the word examples, or a camera: 0, a part of its name, its serial, or an address http://
    or rtsp://. Without any, the page shows the cameras that are connected, and the examples.
    Features show their images if their manifest is named, too. Press Ctrl-C to stop.
    """

    paths: Positional[tuple[str, ...]] = ()  # What to show, several at once.
    live: bool = False  # Play videos as if they came from a camera.
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

    played = list[str]()
    if options.live:
        played = [path for path in options.paths if _is_video(Path(path))]
    cameras = [path for path in options.paths if path in played or camera_of(path) is not None]
    if not cameras and options.paths:
        refuse_unused(
            options, ("model", "sensor", "head", "out"), "without a camera, or a video with --live"
        )
    if len(cameras) == len(played) and options.paths:
        refuse_unused(options, [field.name for field in fields(CameraOptions)], "without a camera")
    if len(cameras) > 1:
        raise UserError(
            f"One camera can be shown at a time, not {len(cameras)}. Start another page for the "
            "next."
        )
    begin = time.perf_counter()
    named = options.paths or ("examples",)
    sources = server.open_sources([Path(path) for path in named if path not in cameras])
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


def _is_video(path: Path) -> bool:
    """Return whether a path is a file that --live can play: not a table, not features."""
    return path.is_file() and path.suffix.lower() not in (".csv", ".parquet", ".npz")


def _open_camera(options: ViewOptions, camera: str, sources: list[Source]) -> Live:
    """Return the live page of a camera, or of a video in its place."""
    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.live.examples import EXAMPLE, SENSOR
    from anytouch_jax.live.page.live import Live
    from anytouch_jax.train.mesh import enable_compilation_cache

    enable_compilation_cache()
    if str(options.model) == DEFAULT:
        log(f"encoder: {DEFAULT} (name another with --model)")
    encoder = load_encoder(options.model)
    head = head_in_use(options.model, options.head)
    if head is not None:
        head.check(encoder.source, encoder.fingerprint, head.pooling, 1)
    # Live touch is compared with the first features that are shown.
    spaces: list[Any] = [source for source in sources if source.kind == "space"]
    sensor = options.sensor
    out = options.out
    if camera == EXAMPLE:
        sensor = SENSOR
        # What it teaches is not mixed with recordings of the user's own sensor.
        out = out.with_name(f"{out.name}_examples")
    return Live(
        camera,
        encoder,
        sensor=sensor,
        head=head,
        space=spaces[0] if spaces else None,
        out=out,
        camera=options.settings(),
        log=log,
    )
