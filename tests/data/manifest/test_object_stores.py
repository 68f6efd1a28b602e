"""Object stores that answer over HTTP: S3 and the Hugging Face hub, both served here."""

import hashlib
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

import fsspec
import huggingface_hub.constants
import numpy as np
import pytest
from refused import refused

from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import files
from anytouch_jax.datasets.readers import IndexOptions, index
from tests.data.loading.test_parts import config
from tests.data.manifest.test_containers import write_tar

SHARDS = 4


@pytest.fixture
def corpus(tmp_path, monkeypatch):
    """Tars of four images in a folder, and an empty cache."""
    (tmp_path / "corpus" / "train").mkdir(parents=True)
    for shard in range(SHARDS):
        write_tar(tmp_path / "corpus" / "train" / f"{shard}.tar", range(4 * shard, 4 * shard + 4))
    monkeypatch.setenv("ANYTOUCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "corpus"


class Hub(BaseHTTPRequestHandler):
    """The four requests of the hub's interface that its file system makes to read a data set."""

    root: Path

    def log_message(self, *args):
        pass

    def answer(self, content, status=200):
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("X-Error-Code", "RepoNotFound" if status == 404 else "")
        self.end_headers()
        self.wfile.write(data)

    def entry(self, name):
        file = self.root / name
        if file.is_dir():
            return {"type": "directory", "path": name, "oid": "0" * 40}
        return {
            "type": "file",
            "path": name,
            "oid": hashlib.sha1(name.encode()).hexdigest(),
            "size": file.stat().st_size,
        }

    def do_GET(self):
        path = unquote(urlsplit(self.path).path)
        if path.startswith("/datasets/me/touches/resolve/main/"):
            data = (self.root / path.split("/", 6)[6]).read_bytes()
            first, last = (
                (self.headers.get("Range") or "bytes=0-").removeprefix("bytes=").split("-")
            )
            self.answer(data[int(first) : int(last or len(data)) + 1], 206)
        elif path.startswith("/api/datasets/me/touches/tree/main"):
            files = sorted(self.root.rglob("*"))
            self.answer([self.entry(file.relative_to(self.root).as_posix()) for file in files])
        elif path in ("/api/datasets/me/touches", "/api/datasets/me/touches/revision/main"):
            self.answer({"id": "me/touches", "sha": "0" * 40})
        else:
            self.answer({"error": "Repository not found"}, 404)

    def do_POST(self):
        form = parse_qs(self.rfile.read(int(self.headers["Content-Length"])).decode())
        self.answer([self.entry(name) for name in form["paths"] if (self.root / name).exists()])


@pytest.fixture
def hub(corpus, monkeypatch):
    """The address of the corpus on a hub."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (Hub,), {"root": corpus}))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    here = f"http://127.0.0.1:{server.server_port}"
    constants = huggingface_hub.constants
    template = constants.HUGGINGFACE_CO_URL_TEMPLATE.replace(constants.ENDPOINT, here)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(constants, "ENDPOINT", here)
    yield "hf://datasets/me/touches"
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def bucket(corpus, monkeypatch):
    """The address of the corpus in a bucket of moto's server."""
    pytest.importorskip("s3fs")
    server = pytest.importorskip("moto.server").ThreadedMotoServer(
        ip_address="127.0.0.1", port=0, verbose=False
    )
    server.start()
    for name, value in {
        "AWS_ENDPOINT_URL": "http://{}:{}".format(*server.get_host_and_port()),
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": "testing",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value)
    system = fsspec.filesystem("s3", skip_instance_cache=True)
    type(system).clear_instance_cache()
    system.mkdir("touches")
    system.put(f"{corpus}/", "touches/", recursive=True)
    yield "s3://touches"
    type(system).clear_instance_cache()
    server.stop()


def check_store(url, corpus, tmp_path, monkeypatch):
    """The same batches as from the folder, a shard copied once, nothing copied for the manifest."""
    (tmp_path / "far").mkdir()
    near = index("webdataset", corpus, options=IndexOptions(sensor="digit")).manifest
    far = index(
        "webdataset", tmp_path / "far", options=IndexOptions(sensor="digit", url=url)
    ).manifest
    assert far.column("path").to_pylist() == [
        f"{url}/{path}" for path in near.column("path").to_pylist()
    ]
    assert not (tmp_path / "cache").exists()
    fetched = []
    fetch = files._fetch
    monkeypatch.setattr(
        files, "_fetch", lambda file, target: (fetched.append(file), fetch(file, target))
    )
    loaders = [Loader(manifest, config()) for manifest in (near, far)]
    for step in range(4):
        batches = [loader.batch(step) for loader in loaders]
        np.testing.assert_array_equal(batches[0].clip, batches[1].clip)
    assert sorted(fetched) == [f"{url}/train/{shard}.tar" for shard in range(SHARDS)]
    copies = sorted((tmp_path / "cache").glob("*/*.tar"), key=lambda file: file.name)
    assert [file.read_bytes() for file in copies] == [
        (corpus / "train" / f"{shard}.tar").read_bytes() for shard in range(SHARDS)
    ]
    refused(r"there is no .*/9\.tar", files.local_copy, f"{url}/train/9.tar/0")


def test_a_corpus_on_the_hub_gives_the_batches_of_the_folder(hub, corpus, tmp_path, monkeypatch):
    check_store(hub, corpus, tmp_path, monkeypatch)
    refused(
        r"there is no hf://datasets/me/other/0\.tar",
        files.local_copy,
        "hf://datasets/me/other/0.tar/0",
    )


@pytest.mark.slow
def test_a_corpus_in_a_bucket_gives_the_batches_of_the_folder(
    bucket, corpus, tmp_path, monkeypatch
):
    check_store(bucket, corpus, tmp_path, monkeypatch)
    refused(r"there is no s3://other/0\.tar", files.local_copy, "s3://other/0.tar/0")
