import json
import shutil
import zlib
from pathlib import Path
from typing import Any

from anytouch_jax.evaluate.plots import loss_curves
from tests.fuzz.harness import Case, cut, flipped, pick
from tests.fuzz.json_files import spoiled

ODD: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1.5,
    10**10,
    1 << 60,
    10**30,
    "",
    "x",
    "y" * 100_000,
    [],
    {},
    [1],
    [[]],
    {"a": 1},
    [None] * 3,
    [[[]]],
    ["a", 3],
)
NAMES = ("x", "", "trainable/", "trainable/touch", "../../x", "trainable//a", "n" * 10_000)
DTYPES = ("int8", "object", "U3", "float32 ", "bool", "complex64", "V8", "M8[s]")
OUTSIDE = ("../checkpoint.json", "/etc/passwd", "/dev/zero", "a\0b", "x" * 5000, ".")
LINES = (
    "",
    "{",
    "[]",
    "null",
    '{"step": 3}',
    '{"loss": 1}',
    '{"step": "x", "loss": 1}',
    '{"step": 1, "loss": "y"}',
    "NaN",
    '{"step": 1, "loss": NaN}',
    '{"step": 1, "loss": [1]}',
    "[" * 100_000,
    "\0" * 500,
    "3",
    '"text"',
    '{"step": 1, "loss": ' + "9" * 5000 + "}",
    '{"step": 1e400, "loss": 1}',
    '{"step": true, "loss": {}}',
)


def odd_for(rng, value: Any) -> Any:
    """A value of another type."""
    return pick(rng, [one for one in ODD if type(one) is not type(value) and one != value])


# Each changes the record of a checkpoint and returns (name, refused where it is described, refused
# where it is used).


def field(rng, record):
    name = pick(rng, [key for key in record if key != "format"])
    value = odd_for(rng, record[name])
    if rng.random() < 0.3:
        del record[name]
        return f"no {name}", True, True
    record[name] = value
    return f"{name} is {str(value)[:20]}", True, True


def shape(rng, record):
    arrays = record["arrays"]
    name = pick(rng, [one for one in arrays if one.startswith("trainable/")])
    sides, dtype = arrays.pop(name)
    forms = {
        "huge": ([10**10], dtype),
        "many": ([1 << 20] * 3, dtype),
        "negative": ([-1], dtype),
        "float": ([1.5], dtype),
        "zero": ([0, *sides], dtype),
        "more": ([*sides, 2], dtype),
        "none": (None, dtype),
        "text": ("12", dtype),
        "type": (sides, pick(rng, ODD)),
        "dtype": (sides, pick(rng, DTYPES)),
        "renamed": (sides, dtype),
        "lost": None,
    }
    kind = pick(rng, forms)
    if kind != "lost":
        arrays[pick(rng, NAMES) if kind == "renamed" else name] = list(forms[kind])
    return f"array {name}: {kind}", kind in ("negative", "float", "none", "text"), True


def settings(rng, record):
    """The configuration in the record: other JSON."""
    name, data, wrong = spoiled(rng, record["config"])
    record["config"] = data.decode("utf-8", "replace")
    wrong |= name.startswith(("wide", "mark"))
    return f"config: {name}", wrong, wrong


def sizes(rng, record):
    config = json.loads(record["config"])
    is_touch = rng.random() < 0.5
    part = config["model"]["touch"] if is_touch else config["model"]
    names = (
        ("width", "depth", "heads", "mlp")
        if is_touch
        else ("image_size", "patch", "frames", "sensor_tokens")
    )
    name = pick(rng, [one for one in names if one in part])
    part[name] = int(
        pick(rng, [one for one in (0, -1, 3, 5, 64, 10**5, 10**9, 1 << 40) if one != part[name]])
    )
    record["config"] = json.dumps(config)
    return f"{name} is {part[name]}", False, name != "frames"


def metadata(rng, record):
    inner = pick(rng, ("metadata", "metrics", "files"))
    values = record[inner]
    value = pick(rng, ODD)
    name = pick(rng, values if inner == "files" else (*values, "seen", "source", "data", "loss"))
    values[name] = value
    if inner == "files" and rng.random() < 0.5:
        del values[name]
        values[pick(rng, OUTSIDE)] = [3, 4]
    wrong = inner == "files" or (
        inner == "metrics" and not (value is None or type(value) in (int, float))
    )
    wrong |= inner == "metadata" and not isinstance(
        value, {"seen": list, "source": dict}.get(name, object)
    )
    # most metadata are for the reader alone
    return f"{inner}.{name[:20]} is {str(value)[:20]}", wrong, wrong


def bytes_damaged(rng, folder: Path):
    file = pick(rng, [file for file in sorted(folder.rglob("*")) if file.is_file()])
    data = file.read_bytes()
    kind = pick(rng, "cut, flipped, lost, empty, text, folder") if data else "lost"
    file.unlink()
    if kind == "folder":
        file.mkdir()
    elif kind != "lost":
        changed = {"cut": cut, "flipped": flipped}.get(
            kind, lambda *_: b"<html></html>" * (kind == "text")
        )
        file.write_bytes(changed(rng, data))
    # `info` describes a damaged checkpoint too; a flipped bit of the record's white space is no
    # damage.
    return f"{file.name} {kind}", False, file.name != "checkpoint.json" or kind != "flipped"


def make(rng, folder: Path, things) -> Case:
    if rng.random() < 0.1:
        return metrics(rng, folder)
    run = folder / "run"
    shutil.copytree(things.run, run)
    record_file = run / "checkpoints" / "00000001" / "checkpoint.json"
    change = pick(
        rng,
        (field, field, shape, shape, settings, settings, sizes, metadata, bytes_damaged, spoiled),
    )
    if change is spoiled:
        name, data, described = spoiled(rng, record_file.read_text())
        record_file.write_bytes(data)
        name = f"record: {name}"
        used = described
    elif change is bytes_damaged:
        name, described, used = change(rng, record_file.parent)
    else:
        record = json.loads(record_file.read_text())["record"]
        name, described, used = change(rng, record)
        body = json.dumps(record, sort_keys=True)
        text = f'{{"checksum": {zlib.crc32(body.encode())}, "record": {body}}}'
        record_file.write_text(text, encoding="utf-8", errors="surrogatepass")
    place = pick(rng, (run, run, run / "checkpoints", record_file.parent))
    export = (
        "export",
        "--to",
        "safetensors",
        "--model",
        place,
        "--out",
        folder / "out.safetensors",
    )
    embed = ("embed", "--model", place, "--data", things.frames, "--out", folder / "f.npz")
    adapt = (
        "adapt",
        "--model",
        place,
        "--data",
        things.manifest,
        "--sensor",
        "gelslim",
        "--frames",
        "0",
    )
    adapt += ("--out", folder / "new")
    words = pick(
        rng,
        (
            ("info", place),
            ("info", place),
            export,
            export,
            export,
            embed if used else export,
            adapt,
        ),
    )
    return Case(f"{name}, {words[0]}", words, described if words[0] == "info" else used)


def metrics(rng, folder: Path) -> Case:
    """A damaged metrics.jsonl, as `anytouch report` draws it."""
    lines = [json.dumps({"step": i, "loss": 1 / (i + 1), "reconstruction": 0.5}) for i in range(20)]
    bad = lines[int(rng.integers(len(lines)))] = pick(rng, LINES)
    data = ("\n".join(lines) + "\n").encode()
    if rng.random() < 0.3:
        data = pick(rng, (cut(rng, data), b"", data + b"\xff\xfe", b"\xef\xbb\xbf" + data))
    (folder / "metrics.jsonl").write_bytes(data)
    return Case(
        f"metrics: {bad[:30]!r}", lambda: (loss_curves(folder / "f.png", {"run": folder}), 0)[1]
    )
