"""A chat endpoint on this machine: tests decide what it answers, and read what it was sent."""

import json
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

KEY = "sk-very-secret-0123456789"
GOOD = {"object": "wool scarf", "caption": "Soft and fuzzy, it gives way under light pressure."}


def chat(content, **extra):
    """A chat completion, as the protocol has it."""
    text = content if isinstance(content, str) or content is None else json.dumps(content)
    message = {"role": "assistant", "content": text} | extra.pop("message", {})
    choice = {"index": 0, "message": message, "finish_reason": extra.pop("finish", "stop")}
    return {
        "id": "x",
        "choices": [choice],
        "usage": {"prompt_tokens": 100, "completion_tokens": 20},
    } | extra


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = True

    def __init__(self, behave):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.behave = behave
        self.asked = []
        self.heads = []
        self.lock = threading.Lock()
        self.release = threading.Event()
        self.busy = 0
        self.most = 0

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}/v1"


class _Handler(BaseHTTPRequestHandler):
    def do_POST(self):
        server = self.server
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        with server.lock:
            number = len(server.asked)
            server.asked.append(body)
            server.heads.append(
                (self.path, {name.title(): value for name, value in self.headers.items()})
            )
            server.busy += 1
            server.most = max(server.most, server.busy)
        try:
            status, headers, answer = server.behave(number, body)
            if status == "stall":
                server.release.wait(20)
                return
            data = answer if isinstance(answer, bytes) else json.dumps(answer).encode()
            self.send_response(status)
            headers = {"Retry-After-Ms": "1", "Content-Type": "application/json"} | headers
            for name, value in ({"Content-Length": str(len(data))} | headers).items():
                if value is not None:  # None takes a usual header away
                    self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)
            if len(data) < int(headers.get("Content-Length", 0)):  # drip until the client leaves
                while not server.release.wait(0.02):
                    self.wfile.write(b" ")
        except (BrokenPipeError, ConnectionResetError):
            pass
        finally:
            with server.lock:
                server.busy -= 1

    def do_GET(self):
        self.server.heads.append((self.path, dict(self.headers)))
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_):
        pass


@contextmanager
def serve(behave=lambda number, body: (200, {}, chat(GOOD))):
    """A server that answers by `behave(number, body) -> (status, headers, answer)` while the block
    runs.
    """
    server = _Server(behave)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.release.set()
        server.shutdown()
        server.server_close()
        thread.join()
