import io
import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.weights.convert import KEYMAPS
from anytouch_jax.weights.safetensors import read_safetensors
from experiments.pouring.recordings import POLICY, WEIGHTS, load_policy
from tests.fuzz.harness import Case, cut, flipped, pick

Arrays = dict[str, Any]


def packed(arrays: Arrays, *, compress: bool = False, twice: str | None = None) -> bytes:
    """The bytes of a .npz file of arrays that hold no objects."""
    stream = io.BytesIO()
    with zipfile.ZipFile(
        stream, "w", zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    ) as archive:
        for name, array in arrays.items():
            np.save(member := io.BytesIO(), np.asarray(array), allow_pickle=False)
            archive.writestr(f"{name}.npy", member.getvalue())
        if twice:
            archive.filelist.append(archive.getinfo(f"{twice}.npy"))
    return stream.getvalue()


def dropped(rng, arrays: Arrays, needed):
    name = pick(rng, needed)
    rest = {key: value for key, value in arrays.items() if key != name}
    return (
        f"no {name}",
        packed(rest | ({name + "_": arrays[name]} if rng.random() < 0.5 else {})),
        True,
    )


def other_type(rng, arrays: Arrays, needed):
    name = pick(rng, needed)
    array = np.asarray(arrays[name])
    kind = pick(
        rng,
        (
            str,
            complex,
            bool,
            "M8[s]",
            "S3",
            "i8",
            [("a", "f4"), ("b", "i2")],
            "V7",
            "f2",
            "U0",
            "m8[D]",
        ),
    )
    changed = array.astype(str) if kind is str else np.zeros(array.shape, kind)
    like = {"f": "fiub", "i": "iufb", "u": "iuf", "U": "U"}[array.dtype.kind]
    wrong = changed.dtype.kind not in like or kind == "U0"
    return f"{name} of {kind}", packed(arrays | {name: changed}), wrong


def other_shape(rng, arrays: Arrays, needed):
    name = pick(rng, needed)
    array = np.asarray(arrays[name])
    shapes = [
        np.zeros((0, *array.shape[1:]), array.dtype),
        array[None],
        np.repeat(array[None], 3, 0),
        array.ravel()[:1],
        np.zeros((*array.shape, 0), array.dtype),
        np.zeros((1,) * 30, array.dtype),
        array.ravel()[:0],
    ]
    if array.ndim:
        shapes += [array[:-1], np.concatenate([array, array]), array.reshape(-1)[0]]
    changed = pick(rng, [one for one in shapes if one.shape != array.shape])
    return f"{name} of shape {changed.shape}", packed(arrays | {name: changed}), True


def not_finite(rng, arrays: Arrays, needed):
    name = pick(
        rng,
        [
            one
            for one in arrays
            if np.asarray(arrays[one]).dtype.kind == "f" and np.size(arrays[one])
        ],
    )
    array = np.array(arrays[name], copy=True)
    array.reshape(-1)[int(rng.integers(array.size))] = wrong = pick(rng, (np.nan, np.inf, -np.inf))
    return f"{name} has {wrong}", packed(arrays | {name: array}), True


def damaged(rng, arrays: Arrays, needed):
    data = packed(arrays, compress=bool(rng.integers(2)))
    at = data.find(b"PK\1\2")
    made = {
        "cut": cut(rng, data),
        "flipped": flipped(rng, data, count=30),
        "random": rng.bytes(1000),
        "empty": b"",
        "directory": flipped(rng, data, data.rfind(b"PK\1\2"), None, 5),
        "html": b"<!doctype html><html></html>",
        "text": packed({}) + b"x",
        "twice": packed(arrays, twice=pick(rng, needed)),
        "encrypted": data[: at + 8] + b"\1\0" + data[at + 10 :],
    }
    kind = pick(rng, made)
    return f"bytes {kind}", made[kind], kind not in ("flipped", "directory")


CHANGES = (dropped, other_type, other_type, other_shape, other_shape, not_finite, damaged, damaged)


def arrays_of(path: Path) -> Arrays:
    with np.load(path) as file:
        return dict(file)


def policy_arrays(things, folder: Path) -> tuple[Arrays, tuple[str, ...]]:
    """A policy as `make pouring` writes it, over the encoder in its folder."""
    shutil.copyfile(things.weights, folder / WEIGHTS)
    about = {
        "stills": True,
        "pooling": "class",
        "sensor": "digit",
        "votes": 1,
        "encoder": arrays_of(things.features)["about/weights"].item(),
    }
    arrays = {
        "mean": np.zeros(12),
        "basis": np.eye(12)[:, :6],
        "about": np.asarray(json.dumps(about)),
    }
    for i, (wide, high) in enumerate(((6, 8), (8, 3))):
        arrays |= {
            f"w/{i}": np.ones((wide, high), np.float32),
            f"b/{i}": np.zeros(high, np.float32),
        }
    return arrays, tuple(arrays)


def make(rng, folder: Path, things) -> Case:
    kind = pick(rng, ("features",) * 4 + ("head",) * 4 + ("weights", "weights", "policy"))
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
        # info shows what there is
        wrong = wrong and not name.startswith(("rows", "features has", "features of"))
    return Case(f"{kind}: {name}", words, wrong)
