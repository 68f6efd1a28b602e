"""Hostile .npz files that users pass on: features, heads, weights, policies, and exported encoders."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anytouch_jax.encoder import export
from anytouch_jax.weights.convert import KEYMAPS
from anytouch_jax.weights.safetensors import read_safetensors
from experiments.pouring.recordings import POLICY, WEIGHTS, load_policy
from tests.fuzz.harness import Case, cut, flipped, pick

Arrays = dict[str, Any]


def member(array, *, shape=None, descr=None, body: bytes | None = None) -> bytes:
    """The bytes of a .npy, whose header may say something else."""
    array = np.asarray(array)
    head = {
        "descr": descr or np.lib.format.dtype_to_descr(array.dtype),
        "fortran_order": False,
        "shape": array.shape if shape is None else shape,
    }
    text = repr(head).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + (array.tobytes() if body is None else body)


def packed(members: dict[str, bytes], *, compress: bool = False, twice: str | None = None) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
        if twice:
            archive.filelist.append(archive.getinfo(f"{twice}.npy"))
    return stream.getvalue()


# Each changes whole arrays and returns (name, bytes, whether no command may accept them). ----------------------------


def dropped(rng, arrays: Arrays, needed):
    name = pick(rng, needed)
    rest = {key: value for key, value in arrays.items() if key != name}
    if rng.random() < 0.5:
        rest[name + "_"] = arrays[name]
    return f"no {name}", packed({key: member(value) for key, value in rest.items()}), True


def other_type(rng, arrays: Arrays, needed):
    name = pick(rng, needed)
    array = np.asarray(arrays[name])
    kinds = {
        "text": array.astype(str), "complex": np.zeros(array.shape, complex), "flags": np.zeros(array.shape, bool),
        "times": np.zeros(array.shape, "M8[s]"), "bytes": np.zeros(array.shape, "S3"),
        "long": np.zeros(array.shape, np.int64), "records": np.zeros(array.shape, [("a", "f4"), ("b", "i2")]),
        "void": np.zeros(array.shape, "V7"), "half": np.zeros(array.shape, np.float16),
        "nothing": np.zeros(array.shape, "U0"), "spans": np.zeros(array.shape, "m8[D]"),
    }  # fmt: skip
    kind = pick(rng, kinds)
    like = {"f": "fiub", "i": "iufb", "u": "iuf", "U": "U"}[array.dtype.kind]
    wrong = kinds[kind].dtype.kind not in like or (array.dtype.kind == "U" and kind == "nothing")
    return (
        f"{name} of {kind}",
        packed({key: member(kinds[kind] if key == name else value) for key, value in arrays.items()}),
        wrong,
    )


def other_shape(rng, arrays: Arrays, needed):
    name = pick(rng, needed)
    array = np.asarray(arrays[name])
    shapes = [
        np.zeros((0, *array.shape[1:]), array.dtype), array[None], np.repeat(array[None], 3, 0), array.ravel()[:1],
        np.zeros((*array.shape, 0), array.dtype), np.zeros((1,) * 30, array.dtype), array.ravel()[:0],
    ]  # fmt: skip
    if array.ndim:
        shapes += [array[:-1], np.concatenate([array, array]), array.reshape(-1)[0]]
    changed = pick(rng, [one for one in shapes if one.shape != array.shape])
    return (
        f"{name} of shape {changed.shape}",
        packed({k: member(changed if k == name else v) for k, v in arrays.items()}),
        True,
    )


def not_finite(rng, arrays: Arrays, needed):
    floats = [name for name in arrays if np.asarray(arrays[name]).dtype.kind == "f" and np.size(arrays[name])]
    name = pick(rng, floats)
    array = np.array(arrays[name], copy=True)
    array.reshape(-1)[int(rng.integers(array.size))] = wrong = pick(rng, (np.nan, np.inf, -np.inf))
    return f"{name} has {wrong}", packed({k: member(array if k == name else v) for k, v in arrays.items()}), True


def huge(rng, arrays: Arrays, needed):
    """A header that announces more than the file has, or zeros that shrink a thousandfold."""
    name = pick(rng, needed)
    array, side = np.asarray(arrays[name]), int(pick(rng, (1 << 20, 10**10, 1 << 62, 1 << 70, -1, -5)))
    members = {key: member(value) for key, value in arrays.items()}
    kind = pick(rng, ("header", "text", "bomb", "nested", "code"))
    if kind == "bomb":
        members[name] = member(np.zeros(0, np.uint8), shape=(3 << 30,), body=bytes(1 << 28))
    elif kind == "nested":
        members[name] = b"\x93NUMPY\1\0" + struct.pack("<H", 60_000) + b"(" * 59_999 + b"\n"
    elif kind == "code":
        members[name] = (
            b"\x93NUMPY\1\0" + struct.pack("<H", 40) + b"__import__('os').system('touch hacked')".ljust(39) + b"\n"
        )
    else:
        members[name] = member(array, shape=(side,), descr=f"<U{1 << 29}" if kind == "text" else None)
    return f"{name}: {kind} of {side}", packed(members, compress=kind == "bomb"), True


def objects(rng, arrays: Arrays, needed):
    name = pick(rng, needed)
    stream = io.BytesIO()
    np.save(stream, np.array([{"a": [1]}], object), allow_pickle=True)
    members = {key: member(value) for key, value in arrays.items()} | {name: stream.getvalue()}
    return f"{name} of objects", packed(members), True


def damaged(rng, arrays: Arrays, needed):
    data = packed({key: member(value) for key, value in arrays.items()}, compress=bool(rng.integers(2)))
    kind = pick(rng, "cut, flipped, directory, random, empty, html, twice, npy, text, encrypted")
    if kind == "twice":
        data = packed({key: member(value) for key, value in arrays.items()}, twice=pick(rng, needed))
    elif kind == "encrypted":
        at = data.find(b"PK\1\2")
        data = data[: at + 8] + b"\1\0" + data[at + 10 :]
    else:
        data = {
            "cut": cut(rng, data), "flipped": flipped(rng, data, count=30), "random": rng.bytes(1000), "empty": b"",
            "directory": flipped(rng, data, data.rfind(b"PK\1\2"), None, 5), "html": b"<!doctype html><html></html>",
            "npy": member(np.zeros(3)), "text": packed({}) + b"x",
        }[kind]  # fmt: skip
    return f"bytes {kind}", data, kind not in ("flipped", "directory")


def more(rng, arrays: Arrays, needed):
    """Arrays that do not belong there, by odd names."""
    names = ("", "../x", "about/" + "n" * 5000, "a\nb", "\u202e", "key/new", "about/frames", "x" * 60_000)
    extra = {pick(rng, names): member(np.asarray(pick(rng, (1, "a" * 100_000, np.zeros((2, 2)), "a\nb"))))}
    return (
        f"more: {next(iter(extra))[:20]!r}",
        packed({key: member(value) for key, value in arrays.items()} | extra),
        False,
    )


def legal(rng, arrays: Arrays, needed):
    """The same values in the other byte order, compressed."""

    def swapped(value):
        array = np.asarray(value)
        return array.astype(array.dtype.newbyteorder(">"))

    return (
        "other byte order",
        packed({key: member(swapped(value)) for key, value in arrays.items()}, compress=True),
        False,
    )


CHANGES = (
    dropped, other_type, other_type, other_shape, other_shape, not_finite, huge, huge, objects, damaged, damaged, more,
    legal,
)  # fmt: skip


def arrays_of(path: Path) -> Arrays:
    with np.load(path) as file:
        return dict(file)


def policy_arrays(things, folder: Path) -> tuple[Arrays, tuple[str, ...]]:
    """A policy as `make pouring` writes it, over the encoder in its folder."""
    shutil.copyfile(things.weights, folder / WEIGHTS)
    about = {
        "stills": True, "pooling": "class", "sensor": "digit", "votes": 1,
        "encoder": arrays_of(things.features)["about/weights"].item(),
    }  # fmt: skip
    arrays = {"mean": np.zeros(12), "basis": np.eye(12)[:, :6], "about": np.asarray(json.dumps(about))}
    for i, (wide, high) in enumerate(((6, 8), (8, 3))):
        arrays |= {f"w/{i}": np.ones((wide, high), np.float32), f"b/{i}": np.zeros(high, np.float32)}
    return arrays, tuple(arrays)


def make(rng, folder: Path, things) -> Case:
    kind = pick(rng, ("features",) * 4 + ("head",) * 4 + ("weights", "weights", "exported", "exported", "policy"))
    if kind == "exported":
        return exported(rng, folder)
    file = folder / "f.npz"
    if kind == "weights":
        arrays, _ = read_safetensors(things.release)
        needed = sorted(arrays.keys() - KEYMAPS["stage1"].unused)
    elif kind == "policy":
        arrays, needed = policy_arrays(things, folder)
        file = folder / POLICY
    else:
        arrays = arrays_of(getattr(things, kind))
        needed = ("features", "rows") if kind == "features" else sorted(arrays)
    name, data, wrong = pick(rng, CHANGES)(rng, arrays, needed)
    file.write_bytes(data)
    embed = ("embed", "--model", things.run, "--data", things.frames, "--out", folder / "o.npz")
    commands = {
        "features": (
            ("info", file),
            ("probe", "label", "--features", file, "--data", things.manifest, "--no-controls"),
        ),
        "head": (("info", file), ("info", file), ("info", file), (*embed, "--head", file)),
        "weights": (
            ("info", file),
            ("export", "--to", "safetensors", "--model", file, "--out", folder / "w.safetensors"),
        ),
        "policy": (lambda: (load_policy(folder), 0)[1],),
    }[kind]
    at = int(rng.integers(len(commands)))
    words = commands[at]
    if kind == "features" and at == 0:
        wrong = wrong and not name.startswith(("rows", "features has", "features of"))  # info shows what there is
    return Case(f"{kind}: {name}", words, wrong)


def exported(rng, folder: Path) -> Case:
    """An exported encoder whose description is damaged, or does not fit the file."""
    file = folder / "e.bin"
    data = rng.bytes(500)
    about: dict[str, Any] = {
        "format": export.FORMAT, "file": "e.bin", "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest(),
        "jax": "0.10", "platforms": ["cpu"], "frames": 1, "image_size": 28, "features": 12, "background": "keep",
        "pooling": "class", "join": "mean", "dtype": "float32", "sensors": {"universal": 0}, "trained_sensors": None,
    }  # fmt: skip
    kind = pick(rng, "none, field, type, bytes, cut, text, json")
    fields = ("format", "bytes", "sha256", "jax", "platforms", "frames", "image_size", "features", "sensors")
    name = pick(rng, fields)
    if kind == "field":
        del about[name]
    elif kind == "type":
        values = (None, -1, 0, 1.5, "", "x" * 10_000, [], {}, [[]], {"a": 5}, True, 1 << 80, [1], {"universal": "0"})
        value = about[name] = pick(rng, [value for value in values if name != "jax" or not isinstance(value, str)])
        kind += f" {name} {str(value)[:20]}"
    text = json.dumps(about)
    if kind == "bytes":
        data = flipped(rng, data)
    elif kind == "cut":
        data = cut(rng, data)
    elif kind == "text":
        text = cut(rng, text.encode(), 0, 2).decode()
    elif kind == "json":
        text = pick(rng, ("", "[]", "null", "[" * 100_000, "{}", '{"format": NaN}', "5" * 5000))
    file.write_bytes(data)
    if kind != "none":
        (folder / "e.bin.json").write_text(text)
    loads = bool(rng.integers(2))
    return Case(f"exported: {kind} {name}", (lambda: (export.load(file), 0)[1]) if loads else ("info", file), True)


@pytest.mark.parametrize("count", [40, pytest.param(0.14, marks=pytest.mark.slow)])
def test_hostile_arrays(survives, count):
    survives(make, count)
