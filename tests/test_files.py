import io
import os
import stat
import zipfile
from pathlib import Path

import fsspec
import numpy as np
import pytest
from refused import refused

from anytouch_jax import files
from anytouch_jax.data.manifest.files import local_copy, unpack_npy
from anytouch_jax.files import atomic_path, atomic_write, lock
from anytouch_jax.train.mesh import enable_compilation_cache

REMOTE = "memory://a.png"


def test_a_file_is_replaced_in_one_move(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.json"
    atomic_write(path, "first ½")
    assert path.read_text(encoding="utf-8") == "first ½"
    with atomic_path(path) as part:
        part.write_bytes(b"second")
        assert path.read_text(encoding="utf-8") == "first ½"
    assert path.read_bytes() == b"second" and [file.name for file in path.parent.iterdir()] == [
        "a.json"
    ]
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask


@pytest.mark.parametrize("failing", ["pathlib.Path.write_bytes", "os.fsync", "os.replace"])
def test_a_failed_write_leaves_the_old_file_and_names_it(tmp_path, monkeypatch, failing):
    path = tmp_path / "config.json"
    atomic_write(path, "old")

    def full(*_):
        raise OSError(28, "No space left on device")

    with pytest.raises(KeyboardInterrupt), atomic_path(path) as part:
        part.write_bytes(b"half")
        raise KeyboardInterrupt
    monkeypatch.setattr(failing, full)
    with pytest.raises(OSError, match=r"No space left on device: '.*config\.json'"):
        atomic_write(path, "new")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_a_leftover_of_a_killed_process_is_overwritten(tmp_path):
    path = tmp_path / "a.bin"
    part = tmp_path / "a.bin.tmp"
    part.write_bytes(b"much longer than what follows")
    atomic_write(path, b"short", part=part)
    assert path.read_bytes() == b"short" and list(tmp_path.iterdir()) == [path]


def test_a_lock_is_exclusive_and_ends_with_its_block(tmp_path):
    path = tmp_path / "config.json"
    path.write_text("kept")
    with lock(path) as first, lock(path) as second:
        assert first and not second
    with lock(path) as again:
        assert again and path.read_text() == "kept"


def test_without_a_home_there_is_no_cache_and_no_fault(monkeypatch):
    """A container with a user number that it does not know, and no HOME."""

    def unknown(number: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {number}")

    monkeypatch.setattr("pwd.getpwuid", unknown)
    for name in ("HOME", "XDG_CACHE_HOME", "ANYTOUCH_CACHE"):
        monkeypatch.delenv(name, raising=False)
    folder = files.cache_folder()
    assert not folder.exists() and list(folder.glob("*")) == []
    with pytest.raises(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    files.remove_old(folder, "*")
    assert enable_compilation_cache() is None
    fsspec.filesystem("memory").pipe("/a.png", b"x")
    refused("cannot be copied to .* or name another folder in ANYTOUCH_CACHE", local_copy, REMOTE)


def npz_of(header: dict, data: bytes = b"") -> io.BytesIO:
    """An .npz file with one array of this header and these bytes."""
    member = io.BytesIO()
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(member, header)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("x.npy", member.getvalue() + data)
    file.seek(0)
    return file


def test_arrays_are_read_only_if_they_are_as_their_headers_say(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.arange(6).reshape(2, 3), about=np.array("words"))
    arrays = files.read_arrays(tmp_path / "a.npz", only=lambda name: name == "about")
    assert str(arrays["about"]) == "words" and arrays["x"].shape == (2, 3)
    np.testing.assert_array_equal(
        files.read_arrays(tmp_path / "a.npz")["x"], [[0, 1, 2], [3, 4, 5]]
    )
    np.savez(tmp_path / "objects.npz", x=np.array([{}], object))
    huge = npz_of({"descr": "<f4", "fortran_order": False, "shape": (1 << 30, 1 << 10)})
    short = npz_of({"descr": "<f4", "fortran_order": False, "shape": (2,)}, b"abc")
    for file in (tmp_path / "objects.npz", huge, short):
        with pytest.raises(ValueError, match="array x"):
            files.read_arrays(file)
    bomb = io.BytesIO()
    np.savez_compressed(bomb, x=np.broadcast_to(np.uint8(0), ((1 << 20) * 5,)))
    assert files.read_arrays(bomb)["x"].nbytes == 5 << 20
    whole = (tmp_path / "a.npz").read_bytes()
    for damaged in (whole[:-30], whole[:80] + b"\xff" * 60 + whole[140:], b"", b"PK"):
        with pytest.raises(ValueError):
            files.read_arrays(io.BytesIO(damaged))


def test_an_array_is_read_only_if_it_is_as_its_header_says():
    def npy(array: np.ndarray) -> bytes:
        np.save(file := io.BytesIO(), array)
        return file.getvalue()

    whole = npy(np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(unpack_npy(whole), [[0, 1, 2], [3, 4, 5]])
    huge = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        huge, {"descr": "<f4", "fortran_order": False, "shape": (1 << 30, 1 << 10)}
    )
    damaged = whole[:20] + b"\xff" * 9 + whole[29:]
    for bad in (whole[:-1], damaged, b"", huge.getvalue(), npy(np.array([{}]))):
        with pytest.raises(ValueError):
            unpack_npy(bad)
