"""Features, contact and force of a live camera over a Unix socket: one JSON line a frame, without
ROS.

python integrations/unix_socket/touch_socket.py 0 digit /tmp/touch.sock gel.png
"""

import argparse
import contextlib
import errno
import json
import socket
from pathlib import Path
from typing import Any


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
            line = {"frame": frame.number, "time": frame.time, "features": frame.values.tolist()}
            # NaN is unknown
            line["contact"] = None if frame.contact != frame.contact else bool(frame.contact)
            line |= {"background": "estimated"} if frame.estimated else {}
            if frame.fields is not None:  # force in N, depth in mm and others, with deviations
                line["fields"] = frame.fields.summary()
            for client in list(clients):
                try:
                    client.sendall(json.dumps(line).encode() + b"\n")
                except OSError:
                    clients.remove(client)
                    client.close()


if __name__ == "__main__":
    import anytouch_jax as at
    from anytouch_jax.data.images import decode
    from anytouch_jax.encoder.linear_head import ContactGate
    from anytouch_jax.live.stream import open_source, stream

    parser = argparse.ArgumentParser(description=__doc__)
    for name, count in {"camera": None, "sensor": None, "address": None, "background": "?"}.items():
        parser.add_argument(name, nargs=count)
    given = parser.parse_args()
    encoder = at.load_encoder("anytouch-tiny")
    (source, live) = open_source(given.camera)
    gel = given.background and decode(given.background)
    # without a gel it estimates one
    preprocess = at.Preprocess(encoder, gel)
    row = encoder.sensor_row(given.sensor)
    gate = ContactGate(preprocess, given.sensor)
    more = {}
    if encoder.measures:
        more = {
            "measure": encoder.measure_of(given.sensor, gel),
            "frames": encoder.config.model.frames,
        }
    serve(
        stream(encoder, source, preprocess, live=live, sensor=row, contact=gate, **more),
        given.address,
    )
