"""Features, contact and force of a live camera over a Unix socket: one JSON line a frame.

It needs no ROS:

    python integrations/unix_socket/touch_socket.py 0 digit /tmp/touch.sock gel.png
"""

import argparse
import contextlib
import errno
import json
import socket
from pathlib import Path
from typing import Any


def line_of(frame: Any) -> dict[str, Any]:
    """Return what is sent of a frame. What is unknown is None."""
    line = {"frame": frame.number, "time": frame.time, "features": frame.values.tolist()}
    is_known = frame.contact == frame.contact  # NaN is unknown
    line["contact"] = bool(frame.contact) if is_known else None
    if frame.estimated:
        line["background"] = "estimated"
    if frame.fields is not None:
        # Force in N, depth in mm and others, with deviations. x is to the right of the image, y
        # down, and force_z into the gel. Slip is None where nothing touches.
        line["fields"] = frame.fields.summary()
    return line


def serve(embedded: Any, path: str) -> None:
    """Send each frame of a stream to all clients of the socket at `path`.

    A client that is too slow is dropped.
    """
    clients = list[socket.socket]()
    file = Path(path)
    if file.exists():
        with socket.socket(socket.AF_UNIX) as old:
            if not file.is_socket() or old.connect_ex(path) != errno.ECONNREFUSED:
                raise SystemExit(
                    f"{path} is in use. Stop the program that serves it, or choose another address."
                )
        file.unlink()  # left by a program that was killed
    with socket.socket(socket.AF_UNIX) as server, contextlib.ExitStack() as stack:
        server.bind(path)
        stack.callback(file.unlink, missing_ok=True)
        server.listen()
        server.setblocking(False)
        for frame in embedded:
            with contextlib.suppress(BlockingIOError):
                clients.append(stack.enter_context(server.accept()[0]))
                clients[-1].setblocking(False)
            data = json.dumps(line_of(frame)).encode() + b"\n"
            for client in list(clients):
                try:
                    client.sendall(data)
                except OSError:
                    clients.remove(client)
                    client.close()


def main() -> None:
    import anytouch_jax as at
    from anytouch_jax.data.images import decode
    from anytouch_jax.encoder.linear_head import ContactGate
    from anytouch_jax.live.stream import open_source, stream

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("camera")
    parser.add_argument("sensor")
    parser.add_argument("address")
    parser.add_argument("background", nargs="?")
    given = parser.parse_args()
    encoder = at.load_encoder("anytouch-tiny")
    source, live = open_source(given.camera)
    gel = given.background and decode(given.background)
    # Without an image of the gel, one is estimated from the frames.
    preprocess = at.Preprocess(encoder, gel)
    measured = {}
    if encoder.measures:
        measured["measure"] = encoder.measure_of(given.sensor, gel)
        measured["frames"] = encoder.config.model.frames
    frames = stream(
        encoder,
        source,
        preprocess,
        live=live,
        sensor=encoder.sensor_row(given.sensor),
        contact=ContactGate(preprocess, given.sensor),
        **measured,
    )
    serve(frames, given.address)


if __name__ == "__main__":
    main()
