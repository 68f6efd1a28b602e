"""Hostile JSON, in every file of JSON that a command reads."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from anytouch_jax.weights.safetensors import read_safetensors
from tests.fuzz.harness import Case, cut, flipped, pick
from tests.fuzz.test_weights import safetensors

VALUES = (
    "NaN", "Infinity", "-Infinity", "1e400", "-1e999", "9" * 5000, "-" + "9" * 100_000, "1" + "0" * 60, '"\\ud800"',
    '"\\udc00\\ud800"', '"' + "x" * 1_000_000 + '"', "[" * 100_000 + "]" * 100_000, '{"a":' * 5000 + "1" + "}" * 5000,
    "null", "true", "[]", "{}", "-0", "1e-400", '""', "[1,]", "01", "+1", ".5", "'a'", "0x10", "// x\n1", '"\x01"',
    "1.5", "-1", '"\\u0000"', "1" * 39,
)  # fmt: skip
BROKEN = {"[1,]", "01", "+1", ".5", "'a'", "0x10", "// x\n1", '"\x01"'}
BAD = BROKEN | {
    value
    for value in VALUES
    if value in ("NaN", "Infinity", "-Infinity", "1e400", "-1e999") or len(value) in (5000, 100_001, 61)
}
BAD |= {value for value in VALUES if value[:3] in ("[[[", '{"a', '"\\u') and "0000" not in value}


def spoiled(rng, text: str) -> tuple[str, bytes, bool]:
    """Return (name, bytes, whether no reader may accept them) of an object in JSON, changed in one place."""
    data = json.loads(text)
    kind = pick(
        rng,
        "value, value, value, value, more, twice, cut, bytes, list, mark, wide, empty, after",
    )
    name = pick(rng, data)
    if kind == "value":
        value = pick(rng, VALUES)
        inner = [key for key in data if isinstance(data[key], dict) and data[key]]
        mark = "<<value>>"
        if inner and rng.random() < 0.6:
            outer = pick(rng, inner)
            name = pick(rng, data[outer])
            data = data | {outer: data[outer] | {name: mark}}
        else:
            data = data | {name: mark}
        return (
            f"{name} is {value[:12]}",
            json.dumps(data).replace(f'"{mark}"', value).encode("utf-8", "surrogatepass"),
            value in BAD,
        )
    if kind == "more":
        value = pick(rng, VALUES)
        return (
            f"more: {value[:12]}",
            (text.rstrip()[:-1] + f', "another": {value}' + "}").encode("utf-8", "surrogatepass"),
            value in BAD,
        )
    if kind == "twice":
        return (
            f"{name} twice",
            (text.rstrip()[:-1] + f', "{name}": ' + json.dumps(pick(rng, (data[name], None, 3))) + "}").encode(),
            True,
        )
    return (
        kind,
        {
            "cut": cut(rng, text.rstrip().encode()), "bytes": flipped(rng, text.encode(), count=3),
            "list": f"[{text}]".encode(), "mark": b"\xef\xbb\xbf" + text.encode(), "wide": text.encode("utf-16"),
            "empty": b"", "after": text.encode() + b"}",
        }[kind],
        kind in ("cut", "list", "wide", "empty", "after"),
    )  # fmt: skip


def make(rng, folder: Path, things) -> Case:
    kind = pick(rng, "weights, model, index, exported, simulate, pack, answers")
    if kind == "weights":
        shutil.copyfile(things.release, folder / "w.safetensors")
        text = json.dumps({"model": {"touch": {"heads": 2}, "decoder": {"heads": 2}}})
        name, data, bad = spoiled(rng, text)
        (folder / "config.json").write_bytes(data)
        arrays, metadata = read_safetensors(things.release)
        (folder / "w.safetensors").write_bytes(safetensors(arrays, {}))
        words = ("info", folder / "w.safetensors")
    elif kind == "model":
        arrays, metadata = read_safetensors(things.weights)
        name, data, bad = spoiled(rng, metadata["anytouch_jax.model"])
        text = data.decode("utf-8", "replace")
        bad = bad or name in ("wide", "mark")
        (folder / "w.safetensors").write_bytes(safetensors(arrays, metadata | {"anytouch_jax.model": text}))
        words = ("info", folder / "w.safetensors")
    elif kind == "index":
        arrays, metadata = read_safetensors(things.release)
        (folder / "a.safetensors").write_bytes(safetensors(arrays, metadata))
        name, data, bad = spoiled(
            rng, json.dumps({"metadata": {}, "weight_map": dict.fromkeys(arrays, "a.safetensors")})
        )
        file = folder / "model.safetensors.index.json"
        file.write_bytes(data)
        words = ("info", file)
    elif kind == "exported":
        (folder / "e.bin").write_bytes(b"abc")
        about = {
            "format": "anytouch_jax.export.1", "bytes": 3,
            "sha256": "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad", "jax": "0",
            "platforms": ["cpu"], "frames": 1, "image_size": 28, "features": 12, "background": "keep",
            "pooling": "class", "join": "mean", "dtype": "float32", "sensors": {"universal": 0},
        }  # fmt: skip
        name, data, bad = spoiled(rng, json.dumps(about))
        (folder / "e.bin.json").write_bytes(data)
        words = ("info", folder / "e.bin")
    elif kind == "simulate":
        out = folder / "scenes"
        out.mkdir()
        name, data, bad = spoiled(rng, json.dumps({"version": 1, "touches": 2, "depth": [0.3, 1.0]}))
        (out / "scenes.json").write_bytes(data)
        words, bad = ("data", "simulate", "--out", out, "--touches", "2"), True  # it holds another data set in any case
    elif kind == "pack":
        out = folder / "packed"
        out.mkdir()
        name, data, bad = spoiled(rng, json.dumps({"version": 2, "files": "x", "shard": 1}))
        (out / "pack.json").write_bytes(data)
        (out / "0.zip").write_bytes(b"")
        words, bad = ("data", "pack", things.manifest, "--out", out / "m.csv"), False
    else:
        name, data, bad = spoiled(rng, json.dumps({"key": "k", "caption": "c", "object": "o"}))
        for file in ("answers.jsonl", "failures.jsonl"):
            (folder / file).write_bytes(data)
        words = ("data", "annotate", things.manifest, "--answers", folder, "--estimate", "--family", "x", "photograph")
        bad = False
    return Case(f"{kind}: {name}", words, bad)


@pytest.mark.parametrize("count", [30, pytest.param(0.06, marks=pytest.mark.slow)])
def test_hostile_json(survives, count):
    survives(make, count)
