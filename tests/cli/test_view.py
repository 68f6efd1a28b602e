import numpy as np

from anytouch_jax.view import server


def test_mistakes(mistake, tmp_path):
    assert "--camera-fps has no effect" in mistake("view", tmp_path, "--camera-fps", 30)
    assert "no.csv" in mistake("view", tmp_path / "no.csv")
    (tmp_path / "a.mp4").write_bytes(b"no film")
    assert "no film" in mistake("view", tmp_path / "a.mp4")
    assert "--head" in mistake("view", tmp_path, "--head", "h.npz")
    assert "One camera" in mistake("view", "0", "1")
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    assert "features" in mistake("view", tmp_path / "a.npz")
    assert "no pictures" in mistake("view", tmp_path)


def test_it_serves_what_it_is_given(anytouch, pressed, monkeypatch):
    served = []
    monkeypatch.setattr(server, "serve", lambda sources, host, port, show: served.append((sources, host, port)))
    assert anytouch("view", pressed, "--port", 9000).status == 0
    ((sources, host, port),) = served
    assert [source.kind for source in sources] == ["table"] and (host, port) == ("127.0.0.1", 9000)
    assert anytouch("view").status == 0
    assert [source.kind for source in served[1][0]] == ["start", "table"]  # cameras, and the examples
