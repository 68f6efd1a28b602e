"""Hostile pictures and films: cut, padded, of odd kinds, with sizes that nobody has, or no pictures at all."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from anytouch_jax.data.images import decode
from tests.fuzz.harness import Case, cut, flipped, pick

FORMATS = ("png", "jpg", "tiff", "bmp", "webp", "npy")


def picture(rng) -> np.ndarray:
    """A smooth picture that every format keeps nearly unchanged, RGB."""
    height, width = rng.integers(24, 72, 2)
    y, x = np.mgrid[:height, :width] / max(height, width)
    waves = [np.sin(x * a + y * b + c) for a, b, c in rng.uniform(0, 5, (3, 3))]
    return np.round(128 + 110 * np.stack(waves, -1)).astype(np.uint8)


def encoded(pixels: np.ndarray, ending: str, **options) -> bytes:
    stream = io.BytesIO()
    if ending == "npy":
        np.save(stream, pixels)
    else:
        kind = {"jpg": "JPEG"}.get(ending, ending.upper())
        extra = {"JPEG": {"quality": 95}, "WEBP": {"lossless": True}}.get(kind, {})
        Image.fromarray(pixels).save(stream, kind, **(extra | options))
    return stream.getvalue()


def chunk(kind: bytes, body: bytes, length: int | None = None) -> bytes:
    size = len(body) if length is None else length
    return struct.pack(">I", size) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, rows: bytes, *more: bytes, depth: int = 8, colour: int = 2, lace: int = 0) -> bytes:
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, lace)
    body = chunk(b"IDAT", zlib.compress(rows)) if rows else b""
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + b"".join(more) + body + chunk(b"IEND", b"")


def strip(pixels: np.ndarray) -> bytes:
    return b"".join(b"\0" + row.tobytes() for row in pixels)


# Each returns (name, bytes, ending, may be accepted, pixels that it must then have or None). ------------------------


def whole(rng):
    pixels, ending = picture(rng), pick(rng, FORMATS)
    return f"whole {ending}", encoded(pixels, ending), ending, True, pixels


def wrong_ending(rng):
    pixels, ending = picture(rng), pick(rng, FORMATS[:5])
    other = pick(rng, FORMATS[:5])
    return f"{ending} as {other}", encoded(pixels, ending), other, True, pixels


def padded(rng):
    pixels, ending = picture(rng), pick(rng, FORMATS[:5])
    tail = pick(rng, (b"\0", b"\xff", b"\xff\xd9", b"IEND", b"\x89PNG\r\n")) * int(rng.integers(1, 200_000))
    return f"{ending} with {len(tail)} bytes more", encoded(pixels, ending) + tail, ending, True, pixels


def stuffed(rng):
    """A JPEG with filling bytes between its markers, or with many empty segments."""
    data = encoded(picture(rng), "jpg")
    filling = pick(
        rng,
        (
            b"\xff" * int(rng.integers(1, 3_000_000)),
            b"\xff\xfe\0\2" * int(rng.integers(1, 400_000)),
            (b"\xff\xfe\xff\xff" + bytes(65533)) * int(rng.integers(1, 100)),
        ),
    )
    return f"jpg with {len(filling)} bytes of filling", data[:2] + filling + data[2:], "jpg", True, None


def scans(rng):
    """A progressive JPEG whose last scan is repeated."""
    stream = io.BytesIO()
    size = int(rng.integers(40, 1500))
    Image.fromarray(np.resize(picture(rng), (size, size, 3))).save(stream, "JPEG", progressive=True)
    data = stream.getvalue()
    at = data.rfind(b"\xff\xda")
    count = int(rng.integers(2, 3000))
    return (
        f"progressive jpg of {size} pixels, {count} scans", data[:at] + data[at:-2] * count + b"\xff\xd9", "jpg", True,
        None,
    )  # fmt: skip


def shortened(rng):
    ending = pick(rng, FORMATS)
    # An end of a JPEG may be a few bytes of nothing, and a TIFF ends with its directory.
    data = encoded(picture(rng), ending)
    return f"{ending} cut", cut(rng, data, 1, 24), ending, False, None


def bytes_lost(rng):
    """A block of zeros where the disk lost a page; only PNG has checksums."""
    data = encoded(picture(rng), "png")
    at = int(rng.integers(8, len(data) - 80))
    size = int(rng.integers(20, 60))
    lost = data[:at] + bytes(size) + data[at + size :]
    return "png with a hole", lost, "png", False, None


def scrambled(rng):
    ending = pick(rng, FORMATS)
    data = encoded(picture(rng), ending)
    changed = flipped(rng, data, count=int(rng.integers(1, 12)))
    return f"{ending} with flipped bytes", changed, ending, True, None


def header(rng):
    """Flipped bytes in the first hundred."""
    ending = pick(rng, FORMATS)
    data = encoded(picture(rng), ending)
    return f"{ending} with a damaged header", flipped(rng, data, 0, 100, int(rng.integers(1, 4))), ending, True, None


def nothing(rng):
    ending = pick(rng, FORMATS)
    content = pick(
        rng,
        (
            b"", b"\0", bytes(5000), b"\xff" * 300, b"<!doctype html><html>404</html>", b"not a picture",
            b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n", b"BM", b"II*\0", b"RIFF",
            b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xd9", rng.bytes(3000),
        ),
    )  # fmt: skip
    return f"{ending} of {content[:12]!r}", content, ending, False, None


def giant(rng):
    """A header that declares more pixels than the file has, or than the memory."""
    side = int(pick(rng, (0, 1 << 14, 60_000, 65_500, (1 << 31) - 1, (1 << 32) - 1)))
    other = int(pick(rng, (1, 60, side)))
    kind = pick(rng, "png, jpg, bmp, npy, tiff, webp")
    if kind == "png":
        data = png(side, other, b"\0" * 1000)
    elif kind == "npy":
        shape = (side, max(other, 2), 3)
        head = repr({"descr": "|u1", "fortran_order": False, "shape": shape}).encode().ljust(117) + b"\n"
        data = b"\x93NUMPY\1\0" + struct.pack("<H", len(head)) + head + bytes(300)
    else:
        data = bytearray(encoded(picture(rng), kind))
        if kind == "bmp":
            data[18:26] = struct.pack("<II", side, other)
        elif kind == "jpg":
            at = data.find(b"\xff\xc0") + 5
            data[at : at + 4] = struct.pack(">HH", min(side, 65_535), min(other, 65_535))
        elif kind == "webp":
            data[21:25] = struct.pack("<I", side & 0xFFFFFFFF)
        else:
            at = data.find(struct.pack("<HH", 256, 4))
            at = at if at >= 0 else data.find(struct.pack("<HH", 256, 3))
            data[at + 2 : at + 12] = struct.pack("<HII", 4, 1, side)
        data = bytes(data)
    return f"{kind} of {side} x {other}", data, kind, kind == "webp", None


def chunks(rng):
    """A PNG with a chunk bomb: very many, very long when unpacked, or of a wrong length."""
    pixels = picture(rng)
    height, width = pixels.shape[:2]
    count = int(rng.integers(1000, 300_000))
    bomb = zlib.compress(bytes(int(rng.integers(10, 200)) << 20), 9)
    kind = pick(rng, "text, empty, zTXt, iCCP, iTXt, length, data")
    more = {
        "text": chunk(b"tEXt", b"a\0b") * count, "empty": chunk(b"IDAT", b"") * count,
        "zTXt": chunk(b"zTXt", b"a\0\0" + bomb), "iCCP": chunk(b"iCCP", b"a\0\0" + bomb),
        "iTXt": chunk(b"iTXt", b"a\0\1\0\0\0" + bomb), "length": chunk(b"tEXt", b"a\0b", (1 << 31) - 1),
        "data": chunk(b"IDAT", bomb),
    }[kind]  # fmt: skip
    return f"png with a chunk bomb: {kind}", png(width, height, strip(pixels), more), "png", kind != "length", None


def broken_png(rng):
    pixels = picture(rng)
    height, width = pixels.shape[:2]
    rows = strip(pixels)
    choices = {
        "few rows": png(width, height, rows[: len(rows) // 2]),
        "no rows": png(width, height, b""),
        "depth": png(width, height, rows, depth=int(pick(rng, (0, 3, 7, 32)))),
        "colour": png(width, height, rows, colour=5),
        "no palette": png(width, height, rows, colour=3),
        "lace": png(width, height, rows, lace=9),
        "filter": png(width, height, b"".join(b"\x09" + row.tobytes() for row in pixels)),
        "noise": b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
        + chunk(b"IDAT", rng.bytes(500))
        + chunk(b"IEND", b""),
    }
    name = pick(rng, choices)
    return f"png: {name}", choices[name], "png", False, None


def odd_array(rng):
    pixels = picture(rng)
    wrong = {
        "NaN": np.full((30, 30, 3), np.nan, np.float32), "above 1": pixels.astype(np.float32),
        "below 0": pixels / -255.0 - 0.1, "infinite": np.full((30, 30), np.inf), "signed": pixels.astype(np.int8),
        "long": pixels.astype(np.int64), "complex": pixels.astype(complex), "text": np.array([["a", "b"]]),
        "zero": np.zeros((0, 30, 3), np.uint8), "four axes": pixels[None], "one axis": pixels.ravel(),
        "two channels": pixels[..., :2], "scalar": np.uint8(3), "strip": np.zeros((1, 5000, 3), np.uint8),
        "times": np.array([["2020-01-01"]], "M8[D]"), "records": np.zeros((30, 30), [("a", "u1"), ("b", "f4")]),
    }  # fmt: skip
    name = pick(rng, wrong)
    return f"array: {name}", encoded(wrong[name], "npy"), "npy", False, None


def objects(rng):
    stream = io.BytesIO()
    np.save(stream, np.array([{"a": 1}], object), allow_pickle=True)
    return "array of objects", stream.getvalue(), "npy", False, None


KINDS = (
    whole, wrong_ending, padded, stuffed, scans, shortened, shortened, bytes_lost,
    scrambled, header, nothing, giant, giant, chunks, broken_png, odd_array, objects,
)  # fmt: skip


def make(rng, folder: Path, things) -> Case:
    if rng.random() < 0.05:
        return film(rng, folder, things)
    name, data, ending, fine, pixels = pick(rng, KINDS)(rng)
    file = folder / "frames" / f"1.{ending}"
    file.parent.mkdir()
    file.write_bytes(data)
    for place, seed in (("0", 1), ("2", 2)):
        (folder / "frames" / f"{place}.{ending}").write_bytes(encoded(picture(np.random.default_rng(seed)), ending))
    manifest = folder / "m.csv"
    rows = [f"frames/{i}.{ending},digit,s,{i},train" for i in range(3)]
    manifest.write_text("\n".join(["path,sensor,sequence,frame_index,split", *rows]) + "\n")
    embed = ("embed", "--model", things.run, "--out", folder / "f.npz")
    if rng.random() < 0.02:
        file.unlink()
        file.mkdir()
        name, fine = "a folder", False
    commands = {
        "verify": ("data", "verify", manifest),
        "manifest": (*embed, "--data", manifest),
        "folder": (*embed, "--data", file.parent),
        "picture": (*embed, "--data", file),
        "contact": ("data", "contact", manifest, "--out", folder / "c.csv"),
        "background": ("data", "contact", manifest, "--out", folder / "c.csv", "--background", file),
        "pack": ("data", "pack", manifest, "--out", folder / "packed" / "m.csv"),
    }
    command = pick(rng, ("verify",) * 8 + ("manifest", "folder", "picture", "contact", "background", "pack"))

    def check(_):
        if pixels is None or command == "background":
            return None
        read = decode(file)
        if read.shape != pixels.shape:
            return f"shape {read.shape}, not {pixels.shape}"
        worst = np.abs(read.astype(int) - pixels).mean()
        return f"mean difference {worst:.1f}" if worst > 6 else None

    wrong = not fine and command != "pack"
    return Case(f"{name}, {command}", commands[command], wrong, None if command == "pack" else check)


def film(rng, folder: Path, things) -> Case:
    file = folder / f"film.{pick(rng, ('avi', 'mp4'))}"
    writer = cv2.VideoWriter(
        str(file), cv2.VideoWriter_fourcc(*("MJPG" if file.suffix == ".avi" else "mp4v")), 10, (32, 32)
    )
    for _ in range(8):
        writer.write(rng.integers(0, 256, (32, 32, 3), np.uint8))
    writer.release()
    data, kind = file.read_bytes(), pick(rng, ("cut", "flipped", "header", "nothing"))
    file.write_bytes(
        {
            "cut": cut(rng, data),
            "flipped": flipped(rng, data, count=20),
            "nothing": rng.bytes(2000),
            "header": flipped(rng, data, 0, 200, 6),
        }[kind]
    )
    command = pick(rng, ("embed", "stream"))
    return Case(
        f"film, {kind}, {command}",
        (command, "--model", things.run, "--data", file, "--out", folder / "f.npz"),
        kind == "nothing",
    )


@pytest.mark.parametrize("count", [25, pytest.param(0.24, marks=pytest.mark.slow)])
def test_hostile_pictures(survives, count):
    survives(make, count)
