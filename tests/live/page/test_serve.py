"""What `serve` hands to uvicorn: a page that refuses other sites, or one that needs a token."""

import socket
from urllib.parse import urlsplit

import pytest
import uvicorn
from starlette.testclient import TestClient

from anytouch_jax.live.page import server


@pytest.fixture
def served(monkeypatch):
    """served(host): the settings that uvicorn gets, and the address that is shown."""
    configs = []
    monkeypatch.setattr(uvicorn.Server, "run", lambda self, sockets: configs.append(self.config))

    def run(host):
        addresses = []
        server.serve([], host, 0, addresses.append)
        return configs.pop(), urlsplit(addresses.pop())

    return run


def can_serve(host):
    try:
        socket.create_server((host, 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


FOREIGN = [
    "evil.example",
    "127.0.0.1.evil.example",
    "localhost.evil.example",
    "0.0.0.0",
    "10.0.0.7",
]


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1"])
def test_a_local_page_refuses_the_names_of_other_hosts(served, host):
    """Else a site whose name is pointed at this machine reads the page (DNS rebinding)."""
    if host == "::1" and not can_serve(host):
        pytest.skip("this machine has no IPv6")
    config, address = served(host)
    assert config.host == host and not address.fragment
    page = TestClient(config.app, f"http://127.0.0.1:{address.port}")
    for path in ("/", "/api/sources"):
        assert page.get(path).status_code == 200
        for own in ("localhost", "[::1]", f"127.0.0.1:{address.port}", f"localhost:{address.port}"):
            assert page.get(path, headers={"Host": own}).status_code == 200, own
        for name in FOREIGN:
            for foreign in (name, f"{name}:{address.port}"):
                answer = page.get(path, headers={"Host": foreign})
                assert answer.status_code == 400, (foreign, answer.status_code)


def test_a_page_for_other_machines_needs_the_token_of_its_address(served):
    config, address = served("0.0.0.0")
    word, _, token = address.fragment.partition("=")
    assert word == "token" and len(token) >= 24
    page = TestClient(config.app, "http://robot.local")
    assert page.get("/").status_code == 200, "the page itself holds no data"
    for given in ({}, {"Authorization": "Bearer "}, {"Authorization": f"Bearer {token[:-1]}"}):
        assert page.get("/api/sources", headers=given).status_code == 401, given
    answer = page.get("/api/sources", headers={"Authorization": f"Bearer {token}"})
    assert answer.status_code == 200 and answer.json() == []
    assert served("0.0.0.0")[1].fragment != address.fragment, "a token is of one start"
