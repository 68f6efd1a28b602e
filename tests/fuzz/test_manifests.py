"""Hostile manifests: CSV tables and Parquet files as editors, spreadsheets and faulty disks leave them."""

from __future__ import annotations

import csv
import io
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.fuzz.harness import Case, cut, flipped, pick

REQUIRED = ("path", "sensor", "sequence", "frame_index", "split")
HUGE = "9" * 40
WRONG = {
    "path": (
        "", "../other.png", "/etc/hostname", "C:\\data\\a0.png", "..\\a0.png", "a\0b.png", "missing.png", ".",
        "a" * 5000, "\ud83d", "a0.png\n", "~/a0.png", "http://a/b.png", "a0.png/3", "x.zip/0",
        "x.zip/99999999999999999999",
    ),
    "sensor": ("", " ", "Digit ", "universal", "x" * 1_000_000, "dígit"),
    "sequence": ("", "   "),
    "frame_index": ("", "abc", "1.5", "nan", "inf", "1e400", HUGE, "0x10", "1,000", "-", "--1", "\u0661", "1 2"),
    "split": ("", "training", "Train", "TEST", " val", "x" * 1_000_000, "train;test", "0"),
    "stride": ("0", "-1", "abc", "1.5", "nan", HUGE),
    "image_path": ("../x.png", "missing.png", "/dev/zero", "C:\\x.png"),
}  # fmt: skip
# Values of these columns may be used by some commands, and refused by none.
LENIENT = {"sensor": ("Digit ", "universal", "x" * 1_000_000, "dígit"), "frame_index": ("\u0661",), "split": (" val",)}
FILES_ONLY = ("path", "image_path")  # commands that open no file need not look at these


def rows_of(things) -> list[dict[str, str]]:
    with things.manifest.open(newline="") as file:
        return list(csv.DictReader(file))


def csv_bytes(rows, names=None, **options) -> bytes:
    stream = io.StringIO(newline="")
    writer = csv.DictWriter(stream, names or list(rows[0]), **({"lineterminator": "\n"} | options))
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue().encode("utf-8", "surrogatepass")


# Each returns (name, bytes, is it wrong for every command, is it wrong for commands that open files). ---------------


def cell(rng, rows):
    name = pick(rng, WRONG)
    value = pick(rng, WRONG[name])
    row = int(rng.integers(len(rows)))
    for one in rows:
        one.setdefault(name, "1" if name == "stride" else "")
    rows[row][name] = value
    wrong = value not in LENIENT.get(name, ())
    shown = value if len(value) < 30 else f"{len(value)} letters"
    return f"{name} is {shown!r}", csv_bytes(rows), wrong and name not in FILES_ONLY, wrong


def encoding(rng, rows):
    rows[2]["object"] = rows[2]["label.object"] = "küche"
    text = csv_bytes(rows).decode()
    kind = pick(rng, "latin-1, utf-16, utf-32, utf-8-sig, invalid, header, surrogate")
    if kind == "invalid":
        return kind, text.encode().replace("ü".encode(), b"\xc3\x28"), True, True
    if kind == "header":
        return kind, text.encode().replace(b"label.object", b"label.\xff\xfe"), True, True
    if kind == "surrogate":
        return kind, text.encode().replace("ü".encode(), b"\xed\xa0\x80"), True, True
    return kind, text.encode(kind), kind != "utf-8-sig", kind != "utf-8-sig"


def separators(rng, rows):
    by = pick(rng, (";", "\t", "|", " "))
    return f"separated by {by!r}", csv_bytes(rows, delimiter=by), True, True


def line_ends(rng, rows):
    lines = csv_bytes(rows).decode().splitlines()
    ends = pick(
        rng,
        (("\n", "\r\n"), ("\r",), ("\r\n",), ("\n", "\n\n"), ("\n", "\r", "\r\n"), ("\u2028",), ("\x0b",), ("\n\r",)),
    )
    text = "".join(line + ends[i % len(ends)] for i, line in enumerate(lines))
    return f"line ends {ends!r}", text.encode(), ends in (("\u2028",), ("\x0b",)), ends in (("\u2028",), ("\x0b",))


def shape(rng, rows):
    lines = csv_bytes(rows).decode().splitlines()
    at = int(rng.integers(1, len(lines)))
    kind = pick(
        rng,
        "cell more, cell less, no header, header only, empty, spaces, quote, commas, zeros, twice, header again",
    )
    if kind == "cell more":
        lines[at] += ",x"
    elif kind == "cell less":
        lines[at] = lines[at].rpartition(",")[0]
    elif kind == "no header":
        del lines[0]
    elif kind == "header only":
        del lines[1:]
    elif kind == "quote":
        lines[at] = '"' + lines[at]
    elif kind == "commas":
        lines[at] = "," * lines[0].count(",")
    elif kind == "zeros":
        lines[at] = "\0" * 200
    elif kind == "twice":
        lines += lines[1:]  # every frame twice; verify reports it, and a single frame may be embedded
    elif kind == "header again":
        lines.insert(at, lines[0])
    text = {"empty": "", "spaces": "  \n \n"}.get(kind, "\n".join(lines) + "\n")
    return kind, text.encode(), kind != "twice", kind != "twice"


def columns(rng, rows):
    kind = pick(rng, "twice, missing, thousands, thousands wrong, unnamed, long name, case, odd names")
    names = list(rows[0])
    if kind == "twice":
        name = pick(rng, names)
        text = csv_bytes(rows).decode().splitlines()
        lines = [f"{line},{name if i == 0 else 'x'}" for i, line in enumerate(text)]
        return f"{name} twice", "\n".join(lines).encode(), True, True
    if kind in ("missing", "case"):
        name = pick(rng, REQUIRED)
        other = name.upper() if kind == "case" else "other"
        rows = [{(other if key == name else key): value for key, value in row.items()} for row in rows]
        return f"{name} {kind}", csv_bytes(rows), True, True
    if kind.startswith("thousands"):
        count = int(rng.integers(1000, 20_000))
        for row in rows:
            row.update({f"{'label.' if i % 3 else ''}c{i}": "1" for i in range(count)})
            if kind == "thousands wrong":
                row.pop("split")
        wrong = kind == "thousands wrong"
        return f"{count} columns", csv_bytes(rows), wrong, wrong
    name = {
        "unnamed": "",
        "long name": "n" * 200_000,
        "odd names": pick(rng, ("label.", "label. ", "a\nb", "\u202e", "=1+1")),
    }[kind]
    for row in rows:
        row[name] = "x"
    return f"column {name[:12]!r}", csv_bytes(rows), False, False


def long(rng, rows):
    name = pick(rng, ("text", "object", "label.object", "touch", "note", "dataset", "unit", "license", "sequence"))
    value = pick(
        rng, ("a" * 1_000_000, "a\n" * 300_000, "ä" * 400_000, " " * 1_000_000, "\u202e" * 1000, "\x1b[31m" * 500)
    )
    for row in rows:
        row.setdefault(name, "")
    rows[int(rng.integers(len(rows)))][name] = value
    wrong = name == "sequence" and not value.strip()
    return f"{name} of {len(value)} letters", csv_bytes(rows), wrong, wrong


CSV = (cell, cell, cell, encoding, separators, line_ends, shape, shape, columns, long)


# Parquet -------------------------------------------------------------------------------------------------------------


def table(rows) -> dict[str, pa.Array]:
    arrays = {name: pa.array([row[name] or None for row in rows]) for name in rows[0]}
    arrays["frame_index"] = pa.array([int(row["frame_index"]) for row in rows])
    return arrays


def typed(rng, arrays):
    """A column of another type."""
    count = len(arrays["path"])
    kinds = {
        "bytes": pa.array([b"a\xff"] * count), "lists": pa.array([["a"]] * count),
        "records": pa.array([{"a": 1}] * count), "floats": pa.array(np.linspace(0, 1, count)),
        "NaN": pa.array([float("nan")] * count), "nothing": pa.nulls(count), "booleans": pa.array([True] * count),
        "times": pa.array([0] * count, pa.timestamp("ns")), "half": pa.array(np.zeros(count, np.float16)),
        "unsigned": pa.array([(1 << 64) - 1] * count, pa.uint64()),
        "decimal": pa.array([1] * count, pa.int64()).cast(pa.decimal128(30, 2)),
        "months": pa.array([1] * count, pa.date32()), "durations": pa.array([1] * count, pa.duration("s")),
        "infinite": pa.array([np.inf] * count), "map": pa.array([[("a", 1)]] * count, pa.map_(pa.string(), pa.int64())),
        "fixed": pa.array([b"ab"] * count, pa.binary(2)),
    }  # fmt: skip
    kind, name = (
        pick(rng, kinds),
        pick(rng, (*REQUIRED, "stride", "text", "touch", "object", "commercial", "label.object", "note")),
    )
    arrays[name] = kinds[kind]
    number = ("floats", "booleans", "unsigned", "NaN", "infinite", "half", "nothing")
    wrong = (name in REQUIRED and not (name == "frame_index" and kind in number)) or (
        name in ("text", "touch", "object") and kind != "nothing"
    )
    return f"{name} of {kind}", arrays, wrong


def value(rng, arrays):
    name = pick(rng, WRONG)
    wrong = pick(rng, WRONG[name])
    if name in ("frame_index", "stride") or wrong == "\ud83d":
        arrays["frame_index"] = pa.array([None, *range(11)])
        return "a null frame_index", arrays, True
    values = arrays[name].to_pylist()
    values[int(rng.integers(len(values)))] = wrong
    arrays[name] = pa.array(values)
    is_wrong = wrong not in LENIENT.get(name, ()) and name not in FILES_ONLY
    return f"{name} is {wrong[:20]!r}", arrays, is_wrong


PARQUET = (typed, typed, value)


def parquet(rng, things, file: Path) -> tuple[str, bool]:
    arrays = table(rows_of(things))
    kind = pick(rng, ("values",) * 6 + ("cut", "flipped", "footer", "empty", "twice", "csv"))
    if kind == "values":
        name, arrays, wrong = pick(rng, PARQUET)(rng, arrays)
        pq.write_table(pa.table(arrays), file)
        return name, bool(wrong)
    whole = pa.table(arrays)
    if kind == "twice":
        whole = pa.Table.from_arrays([*whole.columns, whole[0]], names=[*whole.column_names, whole.column_names[0]])
    pq.write_table(whole.slice(0, 0) if kind == "empty" else whole, file)
    data = file.read_bytes()
    if kind == "csv":
        data = csv_bytes(rows_of(things))
    elif kind == "cut":
        data = cut(rng, data)
    elif kind == "flipped":  # a page may have no checksum
        data = flipped(rng, data, count=int(rng.integers(1, 30)))
    elif kind == "footer":
        data = flipped(rng, data, len(data) - 400, len(data), int(rng.integers(1, 8)))
    file.write_bytes(data)
    return f"Parquet {kind}", kind not in ("flipped", "footer")


def make(rng, folder: Path, things) -> Case:
    if rng.random() < 0.6:
        name, data, wrong, wrong_files = pick(rng, CSV)(rng, rows_of(things))
        file = folder / "m.csv"
        file.write_bytes(data)
    else:
        file = folder / "m.parquet"
        name, wrong = parquet(rng, things, file)
        wrong_files = wrong
    for picture in things.manifest.parent.glob("*.png"):
        shutil.copyfile(picture, folder / picture.name)
    commands = {
        "info": ("info", file),
        "verify": ("data", "verify", "--no-decode", file),
        "decode": ("data", "verify", file),
        "embed": ("embed", "--model", things.run, "--data", file, "--out", folder / "f.npz"),
        "contact": ("data", "contact", file, "--out", folder / "c.csv"),
        "pack": ("data", "pack", file, "--out", folder / "packed" / "m.parquet"),
        "two": ("info", file, things.manifest),
        "repair": ("data", "verify", file, "--repair", folder / "r.csv"),
        "probe": ("probe", "label", "--features", things.features, "--data", file, "--no-controls"),
    }
    command = pick(
        rng, ("info",) * 5 + ("verify",) * 4 + ("decode",) * 3 + ("embed", "contact", "pack", "two", "repair", "probe")
    )
    opens = command in ("decode", "embed", "verify")
    return Case(f"{name}, {command}", commands[command], wrong or (wrong_files and opens and command != "embed"))


@pytest.mark.parametrize("count", [25, pytest.param(0.2, marks=pytest.mark.slow)])
def test_hostile_manifests(survives, count):
    survives(make, count)
