import contextlib
import io
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from PIL import Image
from refused import refused
from videos import write_video

from anytouch_jax.data import image_headers, images
from anytouch_jax.data.images import ImageError, decode_bytes

RGB = np.random.default_rng(0).integers(0, 256, (16, 24, 3), np.uint8)


def _saved(kind: str, pixels: np.ndarray = RGB, **options: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, kind, **options)
    return stream.getvalue()


def _many_scans(count: int) -> bytes:
    """Return a progressive JPEG whose last scan comes `count` times more."""
    data = _saved("JPEG", progressive=True)
    return data[:-2] + data[data.rindex(b"\xff\xda") : -2] * count + data[-2:]


def _padded(padding: bytes) -> bytes:
    data = _saved("JPEG")
    return data[:20] + padding + data[20:]


def _chunk(kind: bytes, body: bytes = b"") -> bytes:
    return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")


def _many_chunks(chunk: bytes, count: int, at: int = 33) -> bytes:
    data = _saved("PNG")
    return data[:at] + chunk * count + data[at:]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (_many_scans(20_000), "more than 16384 scans"),
        (_padded(b"\xff" * 100_000), "bytes of padding"),
        (_padded(b"\0" * 100_000), "bytes of padding"),
        (_padded(b"\xff\xd0" * 50_000), "bytes of padding"),
        (_padded(b"\xff\xfe\0\2" * 5000), "4096 segments"),
        (_padded(b"\xff\xe1\0\0" * 5000), "4096 segments"),
        (_many_chunks(_chunk(b"gAMA", b"\0\0\0\1"), 9000), "more than 4096 chunks"),
        (_many_chunks(_chunk(b"IDAT"), 9000), "more than 4096 chunks"),
        (_many_chunks(_chunk(b"tEXt", b"a\0b"), 9000, -12), "more than 4096 chunks"),
    ],
    ids=["scans", "fill", "zeros", "restarts", "comments", "exif", "gamma", "data", "text"],
)
def test_a_image_that_would_take_minutes_is_refused(data, words, monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    refused(f"hostile cannot be read: .*{words}", decode_bytes, data, "hostile")


def test_the_limit_of_scans_falls_with_the_size(monkeypatch):
    monkeypatch.setattr(image_headers, "MAX_CODED", 20 * (1 << 16))
    refused("more than 20 scans", decode_bytes, _many_scans(30), "x")
    hidden = (
        _many_scans(0)[:-2] + b"\xff\xfe\0\4\xff\xd9" + _many_scans(30)[len(_many_scans(0)) - 2 :]
    )
    # an end inside a comment is none
    with pytest.raises(ImageError, match="more than 20 scans"):
        decode_bytes(hidden, "x")


@pytest.mark.parametrize(
    "chunk",
    [
        _chunk(b"gAMA", b"\0\0\0\0"),
        _chunk(b"sBIT", b"\0\0\0"),
        _chunk(b"iCCP", b"x\0\0y"),
        _chunk(b"tIME", b""),
    ],
)
def test_a_png_with_odd_chunks_is_decoded_without_a_word(chunk, capfd):
    np.testing.assert_array_equal(decode_bytes(_many_chunks(chunk, 300), "x"), RGB)
    assert capfd.readouterr() == ("", "")


def test_a_broken_tiff_or_bmp_prints_nothing_of_opencv(capfd):
    data = _saved("TIFF", compression="tiff_lzw")
    with contextlib.suppress(ImageError):
        decode_bytes(data[:200] + bytes(len(data) - 400) + data[-200:], "x")
    refused("x cannot be read", decode_bytes, _saved("BMP")[:-40], "x")
    assert capfd.readouterr() == ("", "")


def test_an_animation_gives_its_first_image():
    moving = _saved("PNG", save_all=True, append_images=[Image.fromarray(255 - RGB)])
    np.testing.assert_array_equal(decode_bytes(moving, "x"), RGB)


def test_decoders_print_nothing_and_no_thread_loses_a_line(capfd, tmp_path):
    jpeg = _saved("JPEG")
    png = _saved("PNG")
    noisy = [
        jpeg[:-40] + b"\xff\xd9",
        jpeg[:-60] + b"\xff\x3a" + jpeg[-58:],
        png[:-20] + b"\0" + png[-19:],
    ]
    # today's decoders do print
    for data in noisy:
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert len(capfd.readouterr().err.splitlines()) >= 2

    def decode(_: int) -> None:
        for data in noisy * 20:
            with contextlib.suppress(ImageError):
                decode_bytes(data, "x")

    with ThreadPoolExecutor(4) as pool:
        working = [pool.submit(decode, number) for number in range(4)]
        for number in range(100):
            print(f"our line {number}", file=sys.stderr, flush=True)
        for one in working:
            one.result()
    assert capfd.readouterr().err.splitlines() == [f"our line {number}" for number in range(100)]
    cv2.imdecode(np.frombuffer(noisy[0], np.uint8), cv2.IMREAD_UNCHANGED)
    assert capfd.readouterr().err, "a decoder outside this library prints as before"


@pytest.mark.parametrize(("code", "ending"), [("MJPG", "avi"), ("mp4v", "mp4")])
def test_videos_print_nothing(capfd, tmp_path, code, ending):
    path = tmp_path / f"film.{ending}"
    write_video(path, (cv2.resize(RGB, (64, 48)) for _ in range(12)), code=code)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    capfd.readouterr()
    for number in range(12):
        bad = bytearray(data[: len(data) // 2] if number == 0 else data)
        for at in rng.integers(12, len(bad), 4 * number):
            bad[at] ^= 0x55
        path.write_bytes(bad)
        with contextlib.suppress(ImageError):
            list(images.timed_frames(path))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "suffix", [".png", ".jpg", ".bmp", "down.bmp", ".tiff", ".webp", "lossless.webp", "tags.webp"]
)
def test_a_declared_size_beyond_the_limit_is_refused_before_it_is_unpacked(suffix, monkeypatch):
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix.startswith("lossless") else []
    data = cv2.imencode(f".{suffix.rpartition('.')[2]}", RGB, options)[1].tobytes()
    if suffix == "down.bmp":  # its rows come from the top
        data = data[:22] + (-16).to_bytes(4, "little", signed=True) + data[26:]
    if suffix == "tags.webp":  # another header
        data = _saved("webp", exif=b"Exif\0\0")
    assert decode_bytes(data, "x").shape == (16, 24, 3)
    monkeypatch.setattr(image_headers, "MAX_PIXELS", 16 * 24 - 1)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was unpacked"))
    refused("it declares 24 x 16 pixels", decode_bytes, data, "x")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda png: png[:33] + b"\x7f\xff\xff\xf0" + _chunk(b"tEXt", b"a\0b")[4:] + png[33:],
            "cut short",
        ),
        (lambda png: png[:33] + png[8:33] + png[33:], "corrupt"),
        (lambda png: png[:8] + _chunk(b"tEXt", b"a\0b") + png[8:], "corrupt"),
        (lambda png: png[:-12], "cut short"),
        (lambda png: png[:-2], "cut short"),
    ],
)
def test_a_png_is_walked_before_it_is_decoded(spoil, words, monkeypatch):
    # 4 GB and 13 seconds for the first
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    refused(words, decode_bytes, spoil(_saved("PNG")), "x.png")


@pytest.mark.parametrize("first", [4, 60000])
def test_a_tiff_that_declares_two_sizes_is_refused(first):
    data = bytearray(_saved("TIFF"))
    order = "little" if data[:2] == b"II" else "big"
    at = int.from_bytes(data[4:8], order)
    count = int.from_bytes(data[at : at + 2], order)
    body = data[at + 2 : at + 2 + 12 * count]
    sizes = b"".join(
        tag.to_bytes(2, order)
        + (4).to_bytes(2, order)
        + (1).to_bytes(4, order)
        + value.to_bytes(4, order)
        for value in (first, 60004 - first)
        for tag in (256, 257)
    )
    data[4:8] = len(data).to_bytes(4, order)
    with pytest.raises(ImageError, match="a tag twice"):
        decode_bytes(
            bytes(data) + (count + 4).to_bytes(2, order) + sizes + body + bytes(4), "two.tiff"
        )


def _array(array):
    np.save(stream := io.BytesIO(), array, allow_pickle=True)
    return stream.getvalue()


def _declared(shape, kind):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": kind, "fortran_order": False, "shape": shape}
    )
    return stream.getvalue() + bytes(48)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (_array(np.array([[0.5, np.nan]])), "NaN"),
        (_array(np.full((4, 5, 3), 2.0, np.float32)), r"0\.\.1"),
        (_array(np.full((4, 5, 3), -np.inf)), r"0\.\.1"),
        (_array(np.zeros((4, 5, 2), np.uint8)), "shape"),
        (_array(np.zeros((4, 5, 3), np.int64)), "int64"),
        (_array(np.zeros((4, 5, 3), object)), "cannot be read"),
        (_declared((9999999, 9999999, 3), "|u1"), "cut short"),
        (_declared((4, 4, 3), "|O"), "Python objects"),
        (_declared((0, 4, 3), "|u1"), "shape"),
        (_declared((2**70,), "|u1"), "cut short"),
        (_declared((4, 4, 3), "|V1"), "type"),
        (_declared((-4, -4, 3), "|u1"), "cannot be read"),
        (_declared((4, 4, 3), "<M8[s]"), "cut short"),
    ],
)
def test_an_array_that_is_no_image_or_declares_more_than_it_has_is_refused(data, words):
    refused(rf"x\.npy.*{words}", decode_bytes, data, "x.npy")


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "BMP", "TIFF", "WEBP", "npy"])
def test_cut_files_are_refused(kind):
    large = np.random.default_rng(1).integers(0, 256, (64, 64, 3), np.uint8)
    data = _array(large) if kind == "npy" else _saved(kind, large)
    for fraction in (0.0, 0.02, 0.3, 0.6, 0.95):
        with pytest.raises(ImageError, match=r"cut(\.npy)? cannot be read"):
            decode_bytes(data[: int(fraction * len(data))], "cut.npy" if kind == "npy" else "cut")


def _png(rows: bytes, *, depth: int = 8, colour: int = 2, lace: int = 0) -> bytes:
    head = (24).to_bytes(4, "big") + (16).to_bytes(4, "big") + bytes([depth, colour, 0, 0, lace])
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", rows) + _chunk(b"IEND")


ROWS = zlib.compress(b"".join(b"\0" + row.tobytes() for row in RGB))


@pytest.mark.parametrize(
    "data",
    [
        _png(ROWS[: len(ROWS) // 2]),
        _png(b""),
        _png(ROWS, depth=7),
        _png(ROWS, colour=5),
        _png(ROWS, colour=3),
        _png(ROWS, lace=9),
        _png(zlib.compress(b"".join(b"\x09" + row.tobytes() for row in RGB))),
        _png(bytes(500)),
    ],
    ids=["few rows", "no rows", "depth", "colour", "no palette", "lace", "filter", "noise"],
)
def test_a_png_that_contradicts_itself_is_an_error(data, capfd):
    np.testing.assert_array_equal(decode_bytes(_png(ROWS), "x"), RGB)
    refused("x cannot be read", decode_bytes, data, "x")
    assert capfd.readouterr() == ("", "")
