"""Hostile pictures and films: cut, padded, of odd kinds, with sizes that nobody has, or no pictures at all."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from films import write_film
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


KINDS = (
    whole, wrong_ending, padded, shortened, shortened, bytes_lost, scrambled, scrambled, header, header, odd_array,
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
    write_film(file, (rng.integers(0, 256, (32, 32, 3), np.uint8) for _ in range(8)))
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
