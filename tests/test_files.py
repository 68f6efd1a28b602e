import io
import os
import stat
import sys
import time
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest

import anytouch_jax as at
from anytouch_jax import files
from anytouch_jax import progress as bars
from anytouch_jax.data.manifest.files import unpack_npy
from anytouch_jax.encoder.embed import Features, load_index, save_npz
from anytouch_jax.encoder.linear_head import LinearHead
from anytouch_jax.files import atomic_path, atomic_write, lock


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


class Terminal(io.StringIO):
    def isatty(self):
        return True


def screen_of(monkeypatch):
    """Let the error stream be a terminal, from within a test: pytest replaces it between the phases
    of one.
    """
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    return sys.stderr


def test_a_terminal_shows_a_bar_with_the_time_left_and_an_error_takes_it_away(monkeypatch):
    screen = screen_of(monkeypatch)
    monkeypatch.setattr(bars, "WAIT", 0.0)
    assert list(bars.tracked("abc", "letters")) == ["a", "b", "c"]
    assert (
        "letters" in screen.getvalue()
        and "3/3" in screen.getvalue()
        and "0:00:00" in screen.getvalue()
    )
    with pytest.raises(ZeroDivisionError), bars.bar(2, "steps") as advance:
        advance(1)
        raise ZeroDivisionError
    assert screen.getvalue().endswith("\x1b[?25h")  # the cursor is back


def test_short_work_shows_nothing_and_elsewhere_nothing_is_shown(monkeypatch):
    screen = screen_of(monkeypatch)
    assert (
        list(bars.tracked("abc", "letters")) == ["a", "b", "c"]
        and "letters" not in screen.getvalue()
    )
    monkeypatch.setattr(sys, "stderr", io.StringIO())  # no terminal
    monkeypatch.setattr(bars, "WAIT", 0.0)
    assert (
        list(bars.tracked(iter("abc"), "letters")) == ["a", "b", "c"]
        and sys.stderr.getvalue() == ""
    )


def test_a_long_first_item_has_a_bar_and_a_bar_inside_goes_when_it_is_done(monkeypatch):
    screen = screen_of(monkeypatch)
    monkeypatch.setattr(bars, "WAIT", 0.01)
    # never moved
    with bars.bar(1, "folders"):
        assert list(bars.tracked("ab", "frames")) == ["a", "b"]
        while "folders" not in screen.getvalue():
            time.sleep(0.01)
    assert bars._display is None


ARRAY = np.zeros((2, 3), np.float32)


def made(tmp_path, world, tiny_run):
    """Yield objects that a user may meet, by name."""
    encoder = at.load_encoder(tiny_run)
    manifest = at.read_manifest(world)
    config = at.preset("tiny", stage=2)
    features = Features(ARRAY, np.arange(2), {"path": np.array(["a", "b"])})
    save_npz(tmp_path / "f.npz", features, {"encoder": "x", "weights": encoder.fingerprint})
    classes = np.array([f"class {number}" for number in range(40)])
    clip = np.zeros((2, 3, 28, 28, 3), np.uint8)
    rows = np.zeros(2, np.int32)
    match = at.MatchBatch(clip, rows, clip, rows)
    loader_config = encoder.config.with_settings(
        {"data.manifests": (str(world),), "data.batch_size": 2}
    )
    state = at.init_state(encoder.params, encoder.config)
    yield from {
        "encoder": encoder,
        "random": at.random_encoder(encoder.config),
        "net": encoder.net,
        "preprocess": at.Preprocess(encoder, np.zeros((30, 40, 3), np.uint8)),
        "example": at.example_touches()[0],
        "config": config,
        "model": config.model,
        "data": at.DataConfig(manifests=tuple(map(str, range(500)))),
        "manifest": manifest,
        "loader": at.Loader(manifest, loader_config),
        "features": features,
        "index": load_index(tmp_path / "f.npz"),
        "head": at.ProbeHead(),
        "touch": at.TouchBatch(clip, rows),
        "stage 2": at.Stage2Batch(None, match),
        "traced": jax.eval_shape(lambda: at.TouchBatch(clip, rows)),
        "state": state,
        "linear head": LinearHead(
            classes, ARRAY, ARRAY[0], ARRAY[0], ARRAY[0], "object", "class", 1, "f"
        ),
    }.items()


def test_every_repr_is_short_and_shows_no_array(tmp_path, world, tiny_run):
    for name, one in made(tmp_path, world, tiny_run):
        text = repr(one)
        assert len(text) <= 600 and len(text.splitlines()) <= 8, (name, text)
        assert " object at 0x" not in text and "array(" not in text and "[[" not in text, (
            name,
            text,
        )
        assert text.startswith(type(one).__name__), (name, text)


@pytest.mark.parametrize(
    "text", ["LossConfig()", "LossConfig(mask_ratio=0.5)", "DataConfig(manifests=('a.csv',))"]
)
def test_a_configuration_shows_what_is_not_the_default(text):
    assert repr(eval(f"at.{text}")) == text


def test_a_sum_is_that_of_its_parts_whatever_the_number_of_rows() -> None:
    """jaxlib 0.10.2 computes something else here, on CPUs, where more than 32,768 sums come out of
    one fusion.
    """
    rng = np.random.default_rng(0)
    x, place, scale = (
        rng.normal(size=size).astype(np.float32)
        for size in ((100, 400, 49), (1, 400, 49), (100, 400))
    )

    @jax.jit
    def summed(x: jax.Array, scale: jax.Array) -> jax.Array:
        return scale * jnp.sum(place * (x - place * scale[..., None]), -1)

    parts = np.concatenate([summed(x[i : i + 25], scale[i : i + 25]) for i in range(0, 100, 25)])
    reported = f"jaxlib {jaxlib.__version__} sums wrongly; install one that pyproject.toml allows"
    np.testing.assert_allclose(summed(x, scale), parts, rtol=1e-4, atol=1e-4, err_msg=reported)
