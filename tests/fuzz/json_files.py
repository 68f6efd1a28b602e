import json
from pathlib import Path

from anytouch_jax.weights.safetensors import read_safetensors
from tests.fuzz.harness import Case, cut, flipped, pick
from tests.fuzz.weights import safetensors

MARK = "<<value>>"
BAD = (
    "NaN",
    "Infinity",
    "-Infinity",
    "1e400",
    "-1e999",
    "9" * 5000,
    "-" + "9" * 100_000,
    "1" + "0" * 60,
    '"\\ud800"',
    '"\\udc00\\ud800"',
    "[" * 100_000 + "]" * 100_000,
    '{"a":' * 5000 + "1" + "}" * 5000,
    "[1,]",
    "01",
    "+1",
    ".5",
    "'a'",
    "0x10",
    "// x\n1",
    '"\x01"',
)
ODD = (
    '"' + "x" * 1_000_000 + '"',
    "null",
    "true",
    "[]",
    "{}",
    "-0",
    "1e-400",
    '""',
    "1.5",
    "-1",
    '"\\u0000"',
)
KINDS = "value, value, value, value, more, twice, cut, bytes, list, mark, wide, empty, after"
EXPORTED = {
    "format": "anytouch_jax.export.1",
    "bytes": 3,
    "frames": 1,
    "image_size": 28,
    "features": 12,
    "background": "keep",
    "sha256": "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad",
    "jax": "0",
    "platforms": ["cpu"],
    "pooling": "class",
    "join": "mean",
    "dtype": "float32",
    "sensors": {"universal": 0},
}


def spoiled(rng, text: str) -> tuple[str, bytes, bool]:
    """Return (name, bytes, whether no reader may accept them) of an object in JSON, changed in one
    place.
    """
    data = json.loads(text)
    whole = text.rstrip().encode()
    kind = pick(rng, KINDS)
    value = pick(rng, BAD + ODD)
    name = pick(rng, data)
    inner = [key for key in data if isinstance(data[key], dict) and data[key]]
    if kind == "value" and inner and rng.random() < 0.6:
        outer = pick(rng, inner)
        name = pick(rng, data[outer])
        changed = data | {outer: data[outer] | {name: MARK}}
    else:
        changed = data | {name: MARK}
    other = json.dumps(pick(rng, (data[name], None, 3))) if name in data else "3"
    made = {
        "value": json.dumps(changed).replace(f'"{MARK}"', value).encode(),
        "more": whole[:-1] + f', "another": {value}}}'.encode(),
        "twice": whole[:-1] + f', "{pick(rng, data)}": {other}}}'.encode(),
        "cut": cut(rng, whole),
        "bytes": flipped(rng, whole, count=3),
        "list": b"[" + whole + b"]",
        "mark": b"\xef\xbb\xbf" + whole,
        "wide": text.encode("utf-16"),
        "empty": b"",
        "after": whole + b"}",
    }[kind]
    is_value = kind in ("value", "more")
    return (
        f"{kind} {name} {value[:12]}",
        made,
        value in BAD if is_value else kind not in ("bytes", "mark"),
    )


def make(rng, folder: Path, things) -> Case:
    """A file of JSON as a command meets it: a description of weights, an index, an export, a folder
    under way.
    """
    kind = pick(rng, "weights, model, index, exported, simulate, pack, answers")
    arrays, metadata = read_safetensors(things.weights if kind == "model" else things.release)
    name, data, bad = spoiled(
        rng,
        {
            "weights": json.dumps({"model": {"touch": {"heads": 2}, "decoder": {"heads": 2}}}),
            "model": metadata.get("anytouch_jax.model", "{}"),
            "exported": json.dumps(EXPORTED),
            "index": json.dumps(
                {"metadata": {}, "weight_map": dict.fromkeys(arrays, "w.safetensors")}
            ),
            "simulate": json.dumps({"version": 1, "touches": 2, "depth": [0.3, 1.0]}),
            "pack": json.dumps({"version": 2, "files": "x", "shard": 1}),
            "answers": json.dumps({"key": "k", "caption": "c", "object": "o"}),
        }[kind],
    )
    if kind == "model":
        text = data.decode("utf-8", "replace")
        metadata = metadata | {"anytouch_jax.model": text}
        bad = bad or name.startswith(("wide", "mark"))
    (folder / "w.safetensors").write_bytes(
        safetensors(arrays, {} if kind == "weights" else metadata)
    )
    (folder / "e.bin").write_bytes(b"abc")
    file, words = {
        "weights": ("config.json", ("info", folder / "w.safetensors")),
        "model": ("unused.json", ("info", folder / "w.safetensors")),
        "index": ("m.safetensors.index.json", ("info", folder / "m.safetensors.index.json")),
        "exported": ("e.bin.json", ("info", folder / "e.bin")),
        "simulate": (
            "out/scenes.json",
            ("data", "simulate", "--out", folder / "out", "--touches", "2"),
        ),
        "pack": (
            "out/pack.json",
            ("data", "pack", things.manifest, "--out", folder / "out" / "m.csv"),
        ),
        "answers": (
            "answers.jsonl",
            (
                "data",
                "annotate",
                things.manifest,
                "--answers",
                folder,
                "--estimate",
                "--family",
                "x",
                "photograph",
            ),
        ),
    }[kind]
    (folder / "out").mkdir()
    (folder / file).write_bytes(data)
    # The folder of `simulate` holds another data set in any case.
    return Case(
        f"{kind}: {name}", words, kind == "simulate" or (bad and kind not in ("pack", "answers"))
    )
