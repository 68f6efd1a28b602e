import io
from pathlib import Path

import numpy as np
from PIL import Image
from videos import write_video

from anytouch_jax.data.images import decode
from tests.fuzz.harness import Case, cut, flipped, pick

FORMATS = ("png", "jpg", "tiff", "bmp", "webp", "npy")


def image(rng) -> np.ndarray:
    """A smooth image that every format keeps nearly unchanged, RGB."""
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


def changed(rng) -> tuple[str, bytes, str, bool, np.ndarray | None]:
    """Return (name, bytes, ending, may be accepted, pixels that it must then have or None)."""
    pixels = image(rng)
    ending = pick(rng, FORMATS)
    kind = pick(
        rng, "whole, other, padded, cut, cut, hole, flipped, flipped, header, header, array"
    )
    ending = {"hole": "png", "array": "npy"}.get(kind, ending)
    if kind in ("other", "padded") and ending == "npy":
        ending = "png"
    data = encoded(pixels, ending)
    size = int(rng.integers(20, 60))
    at = int(rng.integers(8, len(data) - 80))
    tail = pick(rng, (b"\0", b"\xff", b"\xff\xd9", b"IEND", b"\x89PNG\r\n")) * int(
        rng.integers(1, 200_000)
    )
    wrong = {
        "NaN": np.full((30, 30, 3), np.nan, np.float32),
        "above 1": pixels.astype(np.float32),
        "below 0": pixels / -255.0 - 0.1,
        "infinite": np.full((30, 30), np.inf),
        "signed": pixels.astype(np.int8),
        "long": pixels.astype(np.int64),
        "complex": pixels.astype(complex),
        "text": np.array([["a", "b"]]),
        "zero": np.zeros((0, 30, 3), np.uint8),
        "four axes": pixels[None],
        "one axis": pixels.ravel(),
        "two channels": pixels[..., :2],
        "scalar": np.uint8(3),
        "strip": np.zeros((1, 5000, 3), np.uint8),
        "times": np.array([["2020-01-01"]], "M8[D]"),
        "records": np.zeros((30, 30), [("a", "u1"), ("b", "f4")]),
    }
    made = {
        "padded": data + tail,
        "hole": data[:at] + bytes(size) + data[at + size :],  # only PNG has checksums
        "cut": cut(rng, data, 1, 24),  # the end of a JPEG may be some bytes of nothing
        "flipped": flipped(rng, data, count=int(rng.integers(1, 12))),
        "header": flipped(rng, data, 0, 100, int(rng.integers(1, 4))),
        "array": encoded(wrong[pick(rng, wrong)], "npy"),
    }.get(kind, data)
    is_whole = kind in ("whole", "other", "padded")
    is_lost = kind in ("cut", "hole", "array")
    stored = pick(rng, FORMATS[:5]) if kind == "other" else ending
    return f"{ending} {kind}", made, stored, not is_lost, pixels if is_whole else None


def make(rng, folder: Path, things) -> Case:
    if rng.random() < 0.05:
        return video(rng, folder, things)
    name, data, ending, fine, pixels = changed(rng)
    file = folder / "frames" / f"1.{ending}"
    file.parent.mkdir()
    file.write_bytes(data)
    for place, seed in (("0", 1), ("2", 2)):
        (folder / "frames" / f"{place}.{ending}").write_bytes(
            encoded(image(np.random.default_rng(seed)), ending)
        )
    manifest = folder / "m.csv"
    rows = [f"frames/{i}.{ending},digit,s,{i},train" for i in range(3)]
    manifest.write_text("\n".join(["path,sensor,sequence,frame_index,split", *rows]) + "\n")
    embed = ("embed", "--model", things.run, "--out", folder / "f.npz")
    if rng.random() < 0.02:
        file.unlink()
        file.mkdir()
        name = "a folder"
        fine = False
    commands = {
        "verify": ("data", "verify", manifest),
        "manifest": (*embed, "--data", manifest),
        "folder": (*embed, "--data", file.parent),
        "image": (*embed, "--data", file),
        "contact": ("data", "contact", manifest, "--out", folder / "c.csv"),
        "background": (
            "data",
            "contact",
            manifest,
            "--out",
            folder / "c.csv",
            "--background",
            file,
        ),
        "pack": ("data", "pack", manifest, "--out", folder / "packed" / "m.csv"),
    }
    command = pick(
        rng, ("verify",) * 8 + ("manifest", "folder", "image", "contact", "background", "pack")
    )

    def check():
        if pixels is None or command == "background":
            return None
        read = decode(file)
        if read.shape != pixels.shape:
            return f"shape {read.shape}, not {pixels.shape}"
        worst = np.abs(read.astype(int) - pixels).mean()
        if worst > 6:
            return f"mean difference {worst:.1f}"
        return None

    wrong = not fine and command != "pack"
    return Case(
        f"{name}, {command}", commands[command], wrong, None if command == "pack" else check
    )


def video(rng, folder: Path, things) -> Case:
    file = folder / f"film.{pick(rng, ('avi', 'mp4'))}"
    write_video(file, (rng.integers(0, 256, (32, 32, 3), np.uint8) for _ in range(8)))
    data = file.read_bytes()
    kind = pick(rng, ("cut", "flipped", "header", "nothing"))
    changes = {
        "cut": cut(rng, data),
        "flipped": flipped(rng, data, count=20),
        "nothing": rng.bytes(2000),
    }
    file.write_bytes(changes.get(kind, flipped(rng, data, 0, 200, 6)))
    command = pick(rng, ("embed", "stream"))
    words = (command, "--model", things.run, "--data", file, "--out", folder / "f.npz")
    return Case(f"video, {kind}, {command}", words, kind == "nothing")
