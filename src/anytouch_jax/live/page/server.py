"""The server of the page: an ASGI application with JSON, images and the live stream.

No address names a file. Other web sites cannot read or change anything. The name of the host is
checked, there are no CORS headers, and every change needs a header that another site cannot send.
"""

from __future__ import annotations

import hmac
import json
import secrets
import socket
from collections.abc import Callable, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from anytouch_jax.config import parse_json
from anytouch_jax.data.images import encode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.schema import is_manifest
from anytouch_jax.errors import UserError
from anytouch_jax.live.cameras import list_cameras
from anytouch_jax.live.examples import EXAMPLE
from anytouch_jax.live.page.feature_map import FeatureMap
from anytouch_jax.live.page.layers import LAYERS, SIDE, field_numbers, scale_down
from anytouch_jax.live.page.runs import Run
from anytouch_jax.live.page.tables import Table, open_examples, open_folder, open_video_table, title

# Its libraries take seconds to import, and a manifest needs none of them.
if TYPE_CHECKING:
    from anytouch_jax.live.page.live import Live

LOCAL = ("127.0.0.1", "localhost", "::1")
# of every request that changes something: another site would need CORS to send it
HEADER = "x-anytouch"
SMALLEST = 64  # pixels of the long side of a live image
_SCRIPTS = ("page.js", "fields.js", "space.js", "live.js")
_SHARED = "theme.css"  # with reports, so it lies in the package's root
_ASSETS = (
    {"": "text/html"}
    | dict.fromkeys((_SHARED, "page.css"), "text/css")
    | dict.fromkeys(_SCRIPTS, "text/javascript")
)
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' "
    "blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_SAFE = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_LONGEST = 10_000  # bytes of a request body
_TABLES = (".csv", ".parquet")

Source: TypeAlias = "StartPage | Table | FeatureMap | Run | Live"


class StartPage:
    """The first page without anything to show: the cameras of this machine.

    `open_camera` opens one of them.
    """

    kind = "start"
    name = "start"

    def __init__(self, open_camera: Callable[[str], Live]) -> None:
        self.open_camera = open_camera

    def about(self) -> dict[str, Any]:
        """Return the cameras that are connected now, and the name of the built-in recording."""
        cameras = {str(one.number): f"{one.name} {one.serial}".strip() for one in list_cameras()}
        return {"cameras": cameras, "example": EXAMPLE}


def open_sources(paths: Sequence[Path]) -> list[Source]:
    """Return what the page shows of each path: a manifest, a folder, a video, features or a run.

    Features show the images of a table among the paths, or of the manifest in their folder that
    they were made from. Raises UserError for anything else.
    """
    tables = list[Table]()
    sources = list[Source]()
    features = list[Path]()
    for path in paths:
        if str(path) == "examples" and not path.exists():
            tables.append(open_examples())
        elif not path.exists():
            raise UserError(
                f"There is no {path}. Name a manifest, a folder, a video, features, a run or a "
                "camera."
            )
        elif path.suffix.lower() == ".npz":
            features.append(path)
        elif path.is_dir() and (path / "metrics.jsonl").is_file():
            sources.append(Run(path))
        else:
            tables.append(_open_table(path))
    numbered = list(tables)
    for path in features:
        space = FeatureMap(path, numbered)
        own = None
        if space.table is None:
            own = _own_manifest(path, space)
        if own is not None:
            numbered.append(own)
            space = FeatureMap(path, numbered)
        sources.append(space)
    return [*numbered, *sources]


def _open_table(path: Path) -> Table:
    if path.suffix.lower() in _TABLES:
        return Table(manifests.read(path), title(path))
    if not path.is_dir():
        return open_video_table(path)
    inside = [
        file
        for file in sorted(path.iterdir())
        if file.suffix.lower() in _TABLES and is_manifest(file)
    ]
    inside.sort(key=lambda file: file.stem != "manifest")
    if inside:
        return Table(manifests.read(inside[0]), title(inside[0]))
    return open_folder(path)


def _own_manifest(features: Path, space: FeatureMap) -> Table | None:
    """Return the table that features were made from, if it lies in their folder."""
    file = Path(space.index.about.get("input", ""))
    inside = file.suffix.lower() in _TABLES and file.resolve().is_relative_to(
        features.resolve().parent
    )
    if inside and file.is_file():
        return Table(manifests.read(file), title(file))
    return None


def app(sources: list[Source], *, token: str = "", hosts: Sequence[str] = LOCAL) -> Starlette:
    """Return the ASGI application of the page.

    Args:
        sources: what it shows. Cameras that are opened by the page are added to it.
        token: if not empty, requests for data need it.
        hosts: names of the host. Others are refused.
    """
    routes = [
        Route("/", _asset),
        Route("/{name:str}", _asset),
        Route("/api/sources", _Sources(sources).listed),
        Route("/api/{source:int}/control", _Sources(sources).control, methods=["POST"]),
    ]
    for kind, answers in _ANSWERS.items():
        for path, answer in answers.items():
            routes.append(_Sources(sources).route(kind, path, answer))
    guards = [
        Middleware(TrustedHostMiddleware, allowed_hosts=list(hosts)),
        Middleware(_Token, token=token),
    ]
    return Starlette(
        routes=routes,
        middleware=guards,
        exception_handlers={UserError: _refuse, ValueError: _refuse},
    )


class _Sources:
    """Finds the source that a request is for, by its number in the address."""

    def __init__(self, sources: list[Source]) -> None:
        self._sources = sources

    def of(self, request: Request, kind: str) -> Any:
        """Return the source of a request. Raises UserError for a number of another kind."""
        number = request.path_params["source"]
        if number >= len(self._sources) or self._sources[number].kind != kind:
            raise UserError("There is no such source.")
        return self._sources[number]

    def route(self, kind: str, path: str, answer: Callable[[Request, Any], Response]) -> Route:
        """Return the route of what a kind of source answers."""

        def endpoint(request: Request) -> Response:
            return answer(request, self.of(request, kind))

        return Route(f"/api/{{source:int}}/{path}", endpoint)

    def listed(self, _: Request) -> Response:
        """Answer with all sources, and what the page can offer of them."""
        return _json(
            [{"name": one.name, "kind": one.kind, "about": one.about()} for one in self._sources]
        )

    async def control(self, request: Request) -> Response:
        """Do what the page asks of a camera, or open one."""
        if request.headers.get(HEADER) is None:
            return _json({"error": "This request did not come from the page."}, 403)
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > _LONGEST:
                return _json({"error": "The request is too long."}, 413)
        order = parse_json(body.decode())
        number = request.path_params["source"]
        start = self._sources[number] if number < len(self._sources) else None
        if isinstance(start, StartPage):
            return _json({"source": await run_in_threadpool(_open, start, order, self._sources)})
        await run_in_threadpool(_control, self.of(request, "live"), order)
        return _json({"done": True})


def _asset(request: Request) -> Response:
    """Answer with a file of the page, one of a table: no address names a file."""
    name = request.path_params.get("name", "")
    if name not in _ASSETS:
        return Response("not found", 404, _SAFE)
    folder = files("anytouch_jax" if name == _SHARED else "anytouch_jax.live.page")
    data = (folder / (name or "page.html")).read_bytes()
    headers = _SAFE | {"Cache-Control": "no-cache"}
    return Response(data, media_type=_ASSETS[name], headers=headers)


def _touch(request: Request, table: Table) -> Response:
    """Answer with a touch by its place, or by one of its rows."""
    filters = _filters(request)
    if request.query_params.get("row") is None:
        place = _number(request, "place")
    else:
        place = table.place_of(_number(request, "row"))
    return _json(table.touch(place, filters))


def _touches(request: Request, table: Table) -> Response:
    """Answer with a page of touches."""
    return _json(table.touches(_number(request, "start"), _filters(request)))


def _filters(request: Request) -> dict[str, str]:
    filters = parse_json(request.query_params.get("filters", "{}"))
    if not isinstance(filters, dict) or not all(isinstance(one, str) for one in filters.values()):
        raise UserError("Filters are texts by the name of their column.")
    return filters


def _frame(request: Request, table: Table) -> Response:
    """Answer with a layer of a row, and its numbers in the headers."""
    view, score, fields = table.layer(request.path_params["row"], _layer(request))
    headers = {"X-Score": "" if np.isnan(score) else f"{score:.2f}"}
    if fields is not None:
        headers["X-Fields"] = json.dumps(field_numbers(fields))
    return _image(view, headers)


def _photo(request: Request, table: Table) -> Response:
    return _image(table.photo(request.path_params["row"]))


def _map(request: Request, space: FeatureMap) -> Response:
    return _json(space.map(_method(request)))


def _colours(request: Request, space: FeatureMap) -> Response:
    return _json(space.colours(_method(request), request.query_params.get("column", "")))


def _neighbours(request: Request, space: FeatureMap) -> Response:
    others = request.query_params.get("others") == "1"
    return _json(space.neighbours(_number(request, "row"), others=others))


def _losses(request: Request, run: Run) -> Response:
    return _json(run.losses(_number(request, "after")))


def _figure(request: Request, run: Run) -> Response:
    return _image(run.figure(request.path_params["name"]), side=4000)


def _stream(request: Request, live: Live) -> Response:
    side = SIDE
    if "side" in request.query_params:
        side = max(SMALLEST, min(SIDE, _number(request, "side")))
    packets = live.packets(_layer(request), side)
    return StreamingResponse(packets, media_type="application/octet-stream", headers=_SAFE)


def _taught(_: Request, live: Live) -> Response:
    return _json(live.teacher.about())


def _recorded(request: Request, live: Live) -> Response:
    """Answer with a layer of a recorded frame."""
    if live.teacher.table is None:
        raise UserError("Nothing is recorded yet.")
    return _frame(request, live.teacher.table)


def _download(request: Request, live: Live) -> Response:
    """Answer with the head, or with a ZIP of the recordings."""
    file = live.teacher.head_file
    if request.path_params["file"] == "head.npz" and file.is_file():
        return Response(file.read_bytes(), media_type="application/octet-stream", headers=_SAFE)
    if request.path_params["file"] != "recordings.zip":
        raise UserError("There is no such file yet.")
    packed = live.teacher.archive()
    blocks = iter(partial(packed.read, 1 << 20), b"")
    return StreamingResponse(blocks, headers=_SAFE, background=BackgroundTask(packed.close))


# What the kinds of sources answer, by the end of the address.
_ANSWERS: dict[str, dict[str, Callable[[Request, Any], Response]]] = {
    "table": {
        "touch": _touch,
        "touches": _touches,
        "frame/{row:int}": _frame,
        "photo/{row:int}": _photo,
    },
    "space": {"map": _map, "colours": _colours, "neighbours": _neighbours},
    "run": {"losses": _losses, "figure/{name:str}": _figure},
    "live": {
        "stream": _stream,
        "taught": _taught,
        "recorded/{row:int}": _recorded,
        "taught/{file:str}": _download,
    },
}


def serve(sources: list[Source], host: str, port: int, show: Callable[[str], None]) -> None:
    """Serve the page until Ctrl-C. `show` gets its address.

    Raises UserError if the port is taken.
    """
    if host in LOCAL:
        # Another site could send a browser here under its own name, so names are checked.
        application = app(sources, hosts=[*LOCAL, "[::1]"])
        token = ""
    else:
        # Nobody knows by which name others reach this machine. The token keeps them out.
        token = secrets.token_urlsafe(18)
        application = app(sources, token=token, hosts=["*"])
    config = uvicorn.Config(
        application,
        host=host,
        port=port,
        log_level="error",
        server_header=False,
        timeout_graceful_shutdown=1,
        lifespan="off",
    )
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        raise UserError(
            f"Port {port} of {host} cannot be used: {error.strerror}. Choose another --port."
        ) from None
    shown = f"[{host}]" if ":" in host else host
    # What follows # never leaves the browser, so no log has the token.
    secret = f"#token={token}" if token else ""
    show(f"http://{shown}:{listener.getsockname()[1]}/{secret}")
    try:
        for one in _live(sources):
            one.start()
        uvicorn.Server(config).run([listener])
    finally:
        for one in _live(sources):
            one.stop()
        listener.close()


def _live(sources: Sequence[Source]) -> list[Any]:
    return [source for source in sources if source.kind == "live"]


class _Token:
    """Refuses requests for data without the token."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app = app
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self._token and scope["type"] == "http" and scope["path"].startswith("/api"):
            given = dict(scope["headers"]).get(b"authorization", b"")
            # The time of this comparison says nothing about the token.
            if not hmac.compare_digest(given, f"Bearer {self._token}".encode()):
                await _json({"error": "The token is missing or wrong."}, 401)(scope, receive, send)
                return
        await self._app(scope, receive, send)


def _open(start: StartPage, order: Any, sources: list[Source]) -> int:
    """Open the camera that the page asks for, unless it is open, and return its place.

    Raises UserError.
    """
    camera = order.get("camera") if isinstance(order, dict) else None
    about = start.about()
    if not isinstance(camera, str) or camera not in (*about["cameras"], about["example"]):
        raise UserError("There is no such camera. Plug it in, and look again.")
    for one in _live(sources):
        if one.source == camera:
            return sources.index(one)
        raise UserError("One camera can be shown at a time. Start another page for the next.")
    live = start.open_camera(camera)
    live.start()
    sources.append(live)
    return len(sources) - 1


def _control(live: Live, order: Any) -> None:
    """Do what the page asks of a live source. Raises UserError for anything else."""
    if not isinstance(order, dict):
        order = {}
    action = order.get("do")
    name = order.get("object")
    sequence = order.get("sequence")
    rotate = order.get("rotate")
    flip = order.get("flip")
    if action == "orient" and rotate in (0, 90, 180, 270) and flip in ("none", "across", "down"):
        if live.recorder.state()["on"]:
            raise UserError("A recording is on. Stop it before you turn the image.")
        live.frames.orient(rotate, flip)
    elif action == "background":
        live.frames.capture_background()
    elif action == "no background":
        live.frames.set_background(None)
    elif action == "record" and isinstance(name, str):
        live.recorder.start(name, live.frames.setup.gel)
    elif action == "stop":
        live.recorder.stop()
        live.teacher.reload()
    elif action == "train":
        live.teacher.train()
    elif action == "train longer":
        live.teacher.train_longer()
    elif action == "keep the best":
        live.teacher.longer.stop()
    elif action == "leave out" and isinstance(sequence, str):
        live.teacher.leave_out(sequence)
    else:
        raise UserError("The page asked for something that this source cannot do.")


def _refuse(_: Request, error: Exception) -> Response:
    return _json({"error": str(error)}, 400)


def _method(request: Request) -> str:
    return request.query_params.get("method", "pca")


def _layer(request: Request) -> str:
    if (name := request.query_params.get("layer", LAYERS[0])) not in LAYERS:
        raise UserError(f"A touch has the layers {', '.join(LAYERS)}.")
    return name


def _number(request: Request, name: str) -> int:
    text = request.query_params.get(name, "0")
    if not (text.isascii() and text.isdecimal() and len(text) < 16):
        raise UserError(f"{name} must be a whole number.")
    return int(text)


def _json(value: Any, status: int = 200) -> Response:
    return JSONResponse(value, status, _SAFE | {"Cache-Control": "no-store"})


def _image(image: Any, headers: dict[str, str] | None = None, *, side: int = SIDE) -> Response:
    headers = _SAFE | {"Cache-Control": "private, max-age=60"} | (headers or {})
    data = encode(scale_down(image, side), ".jpg", cv2.IMWRITE_JPEG_QUALITY, 90)
    return Response(data, media_type="image/jpeg", headers=headers)
