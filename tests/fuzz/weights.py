import io
import json
import pickle
import pickletools
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from torch_files import legacy_bytes, tensor, zip_bytes

from anytouch_jax.weights.safetensors import read_safetensors
from tests.fuzz.harness import Case, cut, flipped, pick

SIZES = {
    "F32": 4,
    "F16": 2,
    "BF16": 2,
    "F64": 8,
    "I64": 8,
    "I8": 1,
    "BOOL": 1,
    "U8": 1,
    "F8_E4M3": 1,
}


def safetensors(
    arrays: dict[str, np.ndarray],
    metadata: Any,
    edit=lambda header: None,
    length: int | None = None,
) -> bytes:
    """The bytes of a safetensors file whose header may be edited."""
    header: dict[str, Any] = {"__metadata__": metadata} if metadata else {}
    body = b""
    for name, array in arrays.items():
        raw = np.ascontiguousarray(array, np.float32).tobytes()
        header[name] = {
            "dtype": "F32",
            "shape": list(array.shape),
            "data_offsets": [len(body), len(body) + len(raw)],
        }
        body += raw
    text = edit(header)
    text = (text if isinstance(text, str) else json.dumps(header)).encode("utf-8", "surrogatepass")
    return struct.pack("<Q", len(text) if length is None else length) + text + body


def header(rng, arrays, metadata):
    """A header with one wrong entry, or of another length."""
    name = pick(rng, arrays)
    other = pick(rng, [one for one in arrays if one != name])
    kind = pick(
        rng,
        "offset, overlap, shape, dtype, missing, more, twice, deep, digits, metadata, empty, "
        "length, list",
    )

    def edit(header):
        entry = header[name]
        another = header[other]
        start, end = entry["data_offsets"]
        far = [start + int(rng.integers(1, 1 << 40)), end + int(rng.integers(1, 1 << 40))]
        shapes = (
            [0],
            [-1],
            [1 << 40, 1 << 40],
            [*entry["shape"], 2],
            [(1 << 64) - 1],
            [10**10, 1],
            [10**10],
        )
        dtypes = [one for one in SIZES if SIZES[one] != 4] + [
            "F31",
            "",
            None,
            3,
            "f" * 10_000,
            "C64",
        ]
        changes = {
            "offset": {"data_offsets": far},
            "dtype": {"dtype": pick(rng, dtypes)},
            "digits": {"shape": 0},
            "overlap": {
                "data_offsets": another["data_offsets"],
                "shape": [*another["shape"][::-1], 1],
            },
            "shape": {"shape": pick(rng, shapes)},
        }
        entry.update(changes.get(kind, {}))
        if kind == "missing":
            del entry[pick(rng, entry)]
        elif kind == "more":
            header["n" * 100_000] = {"dtype": "F32", "shape": [], "data_offsets": [0, 0]}
        elif kind == "metadata":
            header["__metadata__"] = pick(rng, (3, [], {"a": 1}, {"a": {"b": "c"}}, "x"))
        elif kind == "empty":
            header.clear()
        text = json.dumps(header)
        return {
            "twice": f'{text[:-1]}, "{name}": {json.dumps(another)}}}',
            "list": f"[{text}]",
            "digits": text.replace('"shape": 0', '"shape": [' + "9" * 5000 + "]"),
            "deep": '{"a":' + "[" * 99_999 + "]" * 99_999 + "}",
        }.get(kind)

    length = int(pick(rng, (0, 1, 7, 1 << 40, (1 << 64) - 1))) if kind == "length" else None
    return (
        f"header: {kind} of {name}",
        safetensors(arrays, metadata, edit, length),
        "safetensors",
        True,
        True,
    )


def not_finite(rng, arrays, metadata):
    name = pick(rng, arrays)
    value = pick(rng, (np.nan, np.inf, -np.inf, 1e39))
    changed = np.array(arrays[name], np.float64 if value == 1e39 else np.float32)
    changed.reshape(-1)[int(rng.integers(changed.size))] = value
    arrays = arrays | {name: changed}
    if rng.random() < 0.5:
        return (
            f"{name} has {value}",
            zip_bytes({key: tensor(one) for key, one in arrays.items()}),
            "pth",
            False,
            True,
        )
    with np.errstate(over="ignore"):
        return f"{name} has {value}", safetensors(arrays, metadata), "safetensors", False, True


def other_arrays(rng, arrays, metadata):
    name = pick(rng, arrays)
    array = arrays[name]
    rest = {key: one for key, one in arrays.items() if key != name}
    made = {
        "missing": rest,
        "more": arrays | {"x" * 300: np.zeros(2, np.float32)},
        "shape": rest | {name: np.zeros((3, 5, 7))},
        "zero": rest | {name: np.zeros((0, *array.shape))},
        "long": rest | {name: np.concatenate([array, array]) if array.ndim else array},
        "prefix": {f"module.{key}": one for key, one in arrays.items()},
        "scalar": rest | {name: np.float32(1)},
        "two prefixes": {
            ("module." if i % 2 else "model.") + key: one
            for i, (key, one) in enumerate(arrays.items())
        },
        "none": {"a": np.zeros(3)},
        "type": rest | {name: array.astype(np.int64)},
        "many": {f"k{i}": np.zeros(1) for i in range(20_000)},
    }
    kind = pick(rng, made)
    changed = {key: np.asarray(one) for key, one in made[kind].items()}
    # The authors' files do not name their sensors, so that a longer table of tokens is another
    # whole file.
    wrong = kind not in ("prefix", "type") and not (
        kind == "long" and (array.ndim == 0 or name == "sensor_token")
    )
    if rng.random() < 0.5 or kind == "type":
        data = zip_bytes({key: tensor(one) for key, one in changed.items()})
        ending = "pth"
        wrong = wrong and kind != "more"
    else:
        data = safetensors(changed, metadata)
        ending = "safetensors"
    return f"arrays: {kind} {name}", data, ending, False, wrong


def bytes_damaged(rng, arrays, metadata):
    ending = pick(rng, ("pth", "pt", "ckpt", "bin", "safetensors", "safetensors"))
    tensors = {key: tensor(one) for key, one in arrays.items()}
    packed = pick(rng, (zip_bytes, legacy_bytes))(tensors)
    data = safetensors(arrays, metadata) if ending == "safetensors" else packed
    made = {
        "cut": cut(rng, data),
        "header": flipped(rng, data, 0, 60, 4),
        "random": rng.bytes(3000),
        "empty": b"",
        "html": b"\n <!DOCTYPE html><html>sign in</html>",
        "zeros": bytes(len(data)),
        "lfs": b"version https://git-lfs.github.com/spec/v1\noid sha256:ab\nsize 12\n",
    }
    kind = pick(rng, made)
    return f"{ending} {kind}", made[kind], ending, kind != "header", kind != "header"


def raw_pickle(rng, arrays, metadata):
    """Bytes for the pickle machine: a flood of operations, deep containers, long numbers,
    operations at random.
    """
    codes = [op.code.encode("latin1") for op in pickletools.opcodes]
    programs = {
        "deep list": b"\x80\x02" + b"](" * 200_000 + b"e" * 200_000 + b".",
        "deep tuple": b"\x80\x02)" + b"\x85" * 200_000 + b".",
        "deep key": b"\x80\x02})" + b"\x85" * 200_000 + b"K\1s.",
        "long number": b"\x80\x02\x8b" + struct.pack("<i", 1 << 20) + b"\xff" * (1 << 20) + b".",
        "digits": b"I" + b"9" * 200_000 + b"\n.",
        "memo": b"\x80\x02Nr\xff\xff\xff\x7f.",
        "bytearray": b"\x96" + struct.pack("<Q", 1 << 40) + b".",
        "frame": b"\x80\x04\x95" + struct.pack("<Q", 1 << 60) + b".",
        "get": b"\x80\x02h\x05.",
        "random": b"\x80\x02" + b"".join(pick(rng, codes) for _ in range(60)),
        "plain": pickle.dumps({"a": np.zeros(3)}),
        "stop": b".",
        "dup": b"\x80\x02]" + b"2" * 500_000 + b".",
        "doubling": b"\x80\x02](K\1e" + b"2\x86" * 200 + b".",
        "doubled key": b"\x80\x02}(K\1" + b"2\x86" * 60 + b"K\1u.",
    }
    kind = pick(rng, programs)
    data = programs[kind]
    if rng.random() < 0.5:
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            archive.writestr("archive/data.pkl", data)
        data = stream.getvalue()
    return f"pickle machine: {kind}", data, "pth", True, True


KINDS = (header, header, not_finite, other_arrays, other_arrays, bytes_damaged, raw_pickle)


def make(rng, folder: Path, things) -> Case:
    if rng.random() < 0.1:
        return shards(rng, folder, things)
    own = rng.random() < 0.5
    arrays, metadata = read_safetensors(things.weights if own else things.release)
    kind = pick(rng, KINDS)
    if kind in (other_arrays, bytes_damaged, not_finite) and not own:
        (folder / "config.json").write_text(
            json.dumps({"model": {"touch": {"heads": 2}, "decoder": {"heads": 2}}})
        )
    name, data, ending, always, used = kind(rng, arrays, metadata)
    file = folder / f"w.{ending}"
    file.write_bytes(data)
    return Case(
        *command(rng, f"{'own' if own else 'release'}, {name}", file, folder, things, always, used)
    )


def command(rng, name, file, folder, things, always, used):
    embed = ("embed", "--model", file, "--data", things.frames, "--out", folder / "f.npz")
    export = ("export", "--to", "safetensors", "--model", file, "--out", folder / "out.safetensors")
    words = pick(
        rng, (("info", file), ("info", file), export, export, embed)[: 5 if used or always else 3]
    )
    return f"{name}, {words[0]}", words, used or always


def shards(rng, folder: Path, things) -> Case:
    """Weights in two files, with an index that does not fit them."""
    arrays, metadata = read_safetensors(things.release)
    names = sorted(arrays)
    files = [f"a-0000{i}-of-00002.safetensors" for i in (1, 2)]
    where = {name: files[i >= len(names) // 2] for i, name in enumerate(names)}
    for file in files:
        inside = {name: arrays[name] for name in names if where[name] == file}
        (folder / file).write_bytes(safetensors(inside, metadata))
    (folder / "config.json").write_text(
        json.dumps({"model": {"touch": {"heads": 2}, "decoder": {"heads": 2}}})
    )
    first = names[0]
    maps: dict[str, Any] = {
        "outside": {first: "../" + things.release.name},
        "absolute": {first: str(things.release)},
        "folder": {first: "."},
        "device": {first: "/dev/zero"},
        "swapped": {first: files[1]},
        "missing name": {"nothing.weight": files[0]},
        "number": {first: 3},
        "record": {first: {}},
    }
    kind = pick(rng, (*maps, "whole", "lost", "html", "cut", "empty", "type"))
    content = {"html": b"<html>", "cut": safetensors(arrays, metadata)[:-9]}.get(kind)
    if kind == "lost":
        (folder / files[1]).unlink()
    elif content is not None:
        (folder / files[0]).write_bytes(content)
    index: Any = {
        "metadata": {"total_size": 1},
        "weight_map": {} if kind == "empty" else where | maps.get(kind, {}),
    }
    if kind == "type":
        index = pick(rng, ([], {"weight_map": []}, {"weight_map": None}, 3))
    file = folder / "a.safetensors.index.json"
    file.write_text(json.dumps(index))
    place = file if rng.random() < 0.7 else folder / files[0]
    return Case(
        *command(rng, f"shards: {kind}", place, folder, things, kind != "whole", kind != "whole")
    )
