"""Hostile run folders: damaged records, configurations, arrays and metrics of checkpoints."""

from __future__ import annotations

import json
import shutil
import zlib
from pathlib import Path
from typing import Any

import pytest

from anytouch_jax.evaluate.plots import loss_curves
from tests.fuzz.harness import Case, cut, flipped, pick

ODD: tuple[Any, ...] = (
    None, True, -1, 0, 1.5, 10**10, 1 << 60, 10**30, "", "x", "y" * 100_000, [], {}, [1], [[]], {"a": 1}, [None] * 3,
    [[[]]], ["a", 3],
)  # fmt: skip


def rewritten(folder: Path, record: Any, *, text: str | None = None) -> None:
    """Write a record with the checksum that fits it."""
    body = json.dumps(record, sort_keys=True)
    outer = f'{{"checksum": {zlib.crc32(body.encode())}, "record": {body}}}' if text is None else text
    (folder / "checkpoint.json").write_text(outer, encoding="utf-8", errors="surrogatepass")


# Each changes a checkpoint folder and returns (name, refused where it is described, refused where it is used). --------


def field(rng, folder, record):
    name = pick(rng, [key for key in record if key != "format"])
    if rng.random() < 0.3:
        del record[name]
        rewritten(folder, record)
        return f"no {name}", True, True
    value = pick(rng, [one for one in ODD if type(one) is not type(record[name])])
    record[name] = value
    rewritten(folder, record)
    return f"{name} is {str(value)[:20]}", True, True


def shape(rng, folder, record):
    name = pick(rng, [one for one in record["arrays"] if one.startswith("trainable/")])
    form = record["arrays"][name]
    kind = pick(rng, "huge, many, negative, zero, more, type, dtype, float, none, renamed, lost, text")
    if kind in ("renamed", "lost"):
        record["arrays"].pop(name)
        if kind == "renamed":
            record["arrays"][
                pick(rng, (name + "x", "", "trainable/", "trainable/touch", "../../x", "trainable//a", "n" * 10_000))
            ] = form
    else:
        changed = {
            "huge": [10**10], "many": [1 << 20] * 3, "negative": [-1], "zero": [0, *form[0]], "more": [*form[0], 2],
            "float": [1.5], "none": None, "type": form[0], "dtype": form[0], "text": "12",
        }[kind]  # fmt: skip
        dtype = {
            "type": pick(rng, ODD),
            "dtype": pick(rng, ("int8", "object", "U3", "float32 ", "bool", "complex64", "V8", "M8[s]")),
        }
        record["arrays"][name] = [changed, dtype.get(kind, form[1])]
    rewritten(folder, record)
    return f"array {name}: {kind}", kind in ("negative", "float", "none", "text"), True


def settings(rng, folder, record):
    """The configuration in the record."""
    config = json.loads(record["config"])
    kind = pick(rng, "field, field, field, text, section, more")
    fine = False
    if kind == "text":
        record["config"] = pick(
            rng, ("", "[]", "null", "{}", "[" * 100_000, "5" * 5000, '{"stage": NaN}', record["config"][:99], "\ud800")
        )
    else:
        section = pick(rng, [one for one in config if isinstance(config[one], dict)])
        part = config[section]
        if kind == "section":
            config[section] = pick(rng, ODD)
            fine = False
        elif kind == "more":
            part["new" * int(pick(rng, (1, 50_000)))] = 1
        else:
            name = pick(rng, part)
            value = pick(rng, [one for one in ODD if type(one) is not type(part[name]) and one != part[name]])
            part[name] = value
            kind = f"{section}.{name} is {str(value)[:20]}"
            fine = True  # None and other values may be allowed there
        record["config"] = json.dumps(config)
    rewritten(folder, record)
    return f"config: {kind}", not fine, not fine


def sizes(rng, folder, record):
    """A configuration of the right types, of another network than the arrays."""
    config = json.loads(record["config"])
    model = config["model"]
    touch = rng.random() < 0.5
    part = model["touch"] if touch else model
    names = ("width", "depth", "heads", "mlp") if touch else ("image_size", "patch", "embed", "frames", "sensor_tokens")
    name = pick(rng, [one for one in names if one in part])
    part[name] = int(pick(rng, [one for one in (0, -1, 3, 5, 64, 10**5, 10**9, 1 << 40) if one != part[name]]))
    record["config"] = json.dumps(config)
    rewritten(folder, record)
    return f"{name} is {part[name]}", False, name != "frames"


def metadata(rng, folder, record):
    inner = pick(rng, ("metadata", "metrics", "files"))
    values = record[inner]
    name = pick(rng, (*values, "seen", "source", "data", "loss") if inner != "files" else values)
    value = pick(rng, ODD)
    values[name] = value
    kind = f"{inner}.{name[:20]} is {str(value)[:20]}"
    if inner == "files" and rng.random() < 0.5:
        del values[name]
        values[pick(rng, ("../checkpoint.json", "/etc/passwd", "/dev/zero", "a\0b", "x" * 5000, "."))] = [3, 4]
        kind = "a file outside"
    rewritten(folder, record)
    wrong = (
        inner == "files"
        or (inner == "metadata" and name == "seen" and not isinstance(value, list))
        or (inner == "metadata" and name == "source" and not isinstance(value, dict))
        or (inner == "metrics" and not (value is None or type(value) in (int, float)))
    )
    return kind, wrong, wrong  # most metadata are for the reader alone


def bytes_damaged(rng, folder, record):
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    file = pick(rng, files)
    kind = pick(rng, "cut, flipped, lost, empty, text, folder")
    if not file.stat().st_size:
        kind = "lost"
    if kind in ("lost", "folder"):
        file.unlink()
        if kind == "folder":
            file.mkdir()
    else:
        data = file.read_bytes()
        file.write_bytes(
            {"cut": cut(rng, data), "flipped": flipped(rng, data), "empty": b"", "text": b"<html></html>"}[kind]
        )
    # `info` describes a damaged checkpoint too; a flipped bit of the record's white space is no damage.
    return f"{file.name} {kind}", False, file.name != "checkpoint.json" or kind != "flipped"


def texts(rng, folder, record):
    """The record is other JSON, or none."""
    good = (folder / "checkpoint.json").read_text()
    text = pick(
        rng,
        (
            "", "[]", "null", "{}", '{"checksum": 1, "record": {}}', "[" * 200_000, good[:-3], "5" * 5000,
            good.replace(":", ""), '{"checksum": NaN, "record": null}', '{"checksum": 1e400, "record": 3}',
            "\ufeff" + good, good.replace('"step": 1', '"step": 1e999'), '{"checksum": "x", "record": "\\ud800"}',
        ),
    )  # fmt: skip
    rewritten(folder, record, text=text)
    return f"record {text[:30]!r}", True, True


KINDS = (field, field, shape, shape, settings, settings, sizes, metadata, bytes_damaged, texts)


def make(rng, folder: Path, things) -> Case:
    if rng.random() < 0.1:
        return metrics(rng, folder)
    run = folder / "run"
    shutil.copytree(things.run, run)
    checkpoint = run / "checkpoints" / "00000001"
    outer = json.loads((checkpoint / "checkpoint.json").read_text())
    name, described, used = pick(rng, KINDS)(rng, checkpoint, outer["record"])
    place = pick(rng, (run, run, run / "checkpoints", checkpoint))
    export = ("export", "--to", "safetensors", "--model", place, "--out", folder / "out.safetensors")
    embed = ("embed", "--model", place, "--data", things.frames, "--out", folder / "f.npz")
    adapt = (
        "adapt", "--model", place, "--data", things.manifest, "--sensor", "gelslim", "--frames", "0", "--out",
        folder / "new",
    )  # fmt: skip
    words = pick(rng, (("info", place), ("info", place), export, export, export, embed if used else export, adapt))
    return Case(f"{name}, {words[0]}", words, described if words[0] == "info" else used)


def metrics(rng, folder: Path) -> Case:
    """A damaged metrics.jsonl, as `anytouch report` draws it."""
    lines = [json.dumps({"step": i, "loss": 1 / (i + 1), "reconstruction": 0.5}) for i in range(20)]
    at = int(rng.integers(len(lines)))
    bad = pick(
        rng,
        (
            "", "{", "[]", "null", '{"step": 3}', '{"loss": 1}', '{"step": "x", "loss": 1}', '{"step": 1, "loss": "y"}',
            "NaN", '{"step": 1, "loss": NaN}', '{"step": 1, "loss": [1]}', "[" * 100_000,
            '{"step": 1, "loss": ' + "9" * 5000 + "}", '{"step": 1e400, "loss": 1}', '{"step": -1, "loss": -1}',
            "\0" * 500, "3", '"text"', '{"step": true, "loss": {}}',
        ),
    )  # fmt: skip
    lines[at] = bad
    data = ("\n".join(lines) + "\n").encode()
    if rng.random() < 0.3:
        data, bad = pick(
            rng,
            (
                (cut(rng, data), "cut"),
                (b"", "empty"),
                (data + b"\xff\xfe", "invalid"),
                (b"\xef\xbb\xbf" + data, "mark"),
            ),
        )
    (folder / "metrics.jsonl").write_bytes(data)
    return Case(f"metrics: {bad[:30]!r}", lambda: (loss_curves(folder / "f.png", {"run": folder}), 0)[1])


@pytest.mark.parametrize("count", [25, pytest.param(0.1, marks=pytest.mark.slow)])
def test_hostile_runs(survives, count):
    survives(make, count)
