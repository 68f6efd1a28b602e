"""`anytouch view`: a page in the browser for recordings, features, runs and live touch."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional

from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.cli.output import log, refuse_unused
from anytouch_jax.cli.stream import CameraOptions
from anytouch_jax.config.parsing import Range
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.view.live import Live
    from anytouch_jax.view.server import Source


@dataclass(frozen=True, kw_only=True)
class ViewOptions(CameraOptions):
    """Show recordings, features, a run or a camera on a page in the browser.

    Example: anytouch view manifest.parquet features.npz runs/stage1

    Name a manifest, a folder of pictures, a film, a features file of `anytouch embed`, a run folder, the word examples,
    or a camera: 0, a part of its name, its serial, or an address http:// or rtsp://. Without any, the page shows the
    cameras that are connected, and the examples. Features show their pictures if their manifest is named, too. Press
    Ctrl-C to stop.
    """

    paths: Positional[tuple[str, ...]] = ()  # What to show, several at once.
    live: bool = False  # Play films as if they came from a camera.
    model: Path = Path(DEFAULT)
    """Encoder of a camera: a name of `anytouch info encoders`, a run folder, a weights file, or hf://user/repo."""
    sensor: str | None = None  # Sensor of a camera. Without it, the universal tokens are used.
    head: Path | None = None  # Show the class of a camera's touch by this head of `anytouch probe label --save`.
    out: Path = Path("recordings")
    """Folder for recordings of a camera, with their manifest.parquet, and for the head that they teach."""
    host: str = "127.0.0.1"  # Address to listen on. For any but this machine's own, the page asks for a token.
    port: Annotated[int, Range(1, 65535, "1 to 65535")] = 8765  # Port to listen on.


def run(options: ViewOptions) -> int:
    """Serve the page until Ctrl-C."""
    try:
        from anytouch_jax.view import server
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn"):
            raise
        raise UserError('The page needs starlette and uvicorn: pip install "anytouch_jax[view]"') from None
    from anytouch_jax.data.cameras import camera_of

    played = [path for path in options.paths if options.live and _is_film(path)]
    cameras = [path for path in options.paths if path in played or camera_of(path) is not None]
    if not cameras and options.paths:
        refuse_unused(options, ("model", "sensor", "head", "out"), "without a camera, or a film with --live")
    if len(cameras) == len(played) and options.paths:
        refuse_unused(options, [field.name for field in fields(CameraOptions)], "without a camera")
    if len(cameras) > 1:
        raise UserError(f"One camera can be shown at a time, not {len(cameras)}. Start another page for the next.")
    begin = time.perf_counter()
    sources = server.open_sources([Path(path) for path in options.paths or ("examples",) if path not in cameras])
    if not options.paths:
        sources.insert(0, server.StartPage(lambda camera: _open_camera(options, camera, sources)))
    for camera in cameras:
        sources.append(_open_camera(options, camera, sources))
    log(f"opened in {time.perf_counter() - begin:.1f} s")
    server.serve(sources, options.host, options.port, lambda at: print(f"Open {at} (Ctrl-C stops)", flush=True))
    return 0


def _is_film(name: str) -> bool:
    return Path(name).is_file() and Path(name).suffix.lower() not in (".csv", ".parquet", ".npz")


def _open_camera(options: ViewOptions, camera: str, sources: list[Source]) -> Live:
    from anytouch_jax.encoder.encoder import load_encoder
    from anytouch_jax.encoder.linear_head import load_head
    from anytouch_jax.train.mesh import enable_compilation_cache
    from anytouch_jax.view.live import Live

    enable_compilation_cache()
    if str(options.model) == DEFAULT:
        log(f"encoder: {DEFAULT} (name another with --model)")
    encoder = load_encoder(options.model)
    head = None if options.head is None else load_head(options.head)
    if head is not None:
        head.check(encoder.source, encoder.fingerprint, head.pooling, 1)
    spaces: list[Any] = [source for source in sources if source.kind == "space"]
    return Live(
        camera, encoder, sensor=options.sensor, head=head, space=spaces[0] if spaces else None, out=options.out,
        camera=options.settings(), log=log,
    )  # fmt: skip
