import csv
import io
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.fuzz.harness import Case, cut, flipped, pick

REQUIRED = ("path", "sensor", "sequence", "frame_index", "split")
HUGE = "9" * 40
WRONG = {
    "path": (
        "",
        "../other.png",
        "/etc/hostname",
        "C:\\data\\a0.png",
        "..\\a0.png",
        "a\0b.png",
        "missing.png",
        ".",
        "a" * 5000,
        "\ud83d",
        "a0.png\n",
        "~/a0.png",
        "http://a/b.png",
        "a0.png/3",
        "x.zip/0",
        "x.zip/99999999999999999999",
    ),
    "sensor": ("", " ", "Digit ", "universal", "x" * 1_000_000, "dígit"),
    "sequence": ("", "   "),
    "frame_index": (
        "",
        "abc",
        "1.5",
        "nan",
        "inf",
        "1e400",
        HUGE,
        "0x10",
        "1,000",
        "-",
        "--1",
        "\u0661",
        "1 2",
    ),
    "split": ("", "training", "Train", "TEST", " val", "x" * 1_000_000, "train;test", "0"),
    "stride": ("0", "-1", "abc", "1.5", "nan", HUGE),
    "image_path": ("../x.png", "missing.png", "/dev/zero", "C:\\x.png"),
}
# Values of these columns may be used by some commands, and refused by none.
LENIENT = {
    "sensor": ("Digit ", "universal", "x" * 1_000_000, "dígit"),
    "frame_index": ("\u0661",),
    "split": (" val",),
}
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


# Each returns (name, bytes, is it wrong for every command, is it wrong for commands that open
# files). ---------------


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


def text(rng, rows):
    """Another encoding, separator or line end, or lines that are lost, cut and repeated."""
    rows[2]["object"] = rows[2]["label.object"] = "küche"
    whole = csv_bytes(rows).decode()
    head, *lines = whole.splitlines()
    at = int(rng.integers(len(lines)))
    data = whole.encode()
    ends = pick(rng, LINE_ENDS)
    changed = {
        "cell more": lines[at] + ",x",
        "cell less": lines[at].rpartition(",")[0],
        "quote": '"' + lines[at],
        "commas": "," * head.count(","),
        "zeros": "\0" * 200,
        "header again": head,
    }
    made = {
        **{
            name: "\n".join([head, *lines[:at], line, *lines[at + 1 :]]).encode()
            for name, line in changed.items()
        },
        **{name: whole.encode(name) for name in ("latin-1", "utf-16", "utf-32", "utf-8-sig")},
        **{f"separated by {by!r}": csv_bytes(rows, delimiter=by) for by in (";", "\t", "|", " ")},
        "invalid": data.replace("ü".encode(), b"\xc3\x28"),
        "surrogate": data.replace("ü".encode(), b"\xed\xa0\x80"),
        "header": data.replace(b"label.object", b"label.\xff\xfe"),
        "no header": "\n".join(lines).encode(),
        "header only": head.encode(),
        "empty": b"",
        "spaces": b"  \n \n",
        "line ends": "".join(
            line + ends[i % len(ends)] for i, line in enumerate([head, *lines])
        ).encode(),
        "twice": "\n".join(
            [head, *lines, *lines]
        ).encode(),  # verify reports it, a single frame may be embedded
    }
    kind = pick(rng, made)
    wrong = kind not in ("utf-8-sig", "twice", "line ends") or (
        kind == "line ends" and ends in WRONG_ENDS
    )
    return kind, made[kind], wrong, wrong


def columns(rng, rows):
    kind = pick(rng, "twice, missing, thousands, unnamed, long name, case, odd names")
    name = pick(rng, REQUIRED)
    if kind == "twice":
        lines = csv_bytes(rows).decode().splitlines()
        text = "\n".join([f"{lines[0]},{name}", *(f"{line},x" for line in lines[1:])])
        return f"{name} twice", text.encode(), True, True
    if kind in ("missing", "case"):
        other = name.upper() if kind == "case" else "other"
        rows = [
            {(other if key == name else key): value for key, value in row.items()} for row in rows
        ]
        return f"{name} {kind}", csv_bytes(rows), True, True
    count = int(rng.integers(1000, 20_000)) if kind == "thousands" else 0
    odd = {"unnamed": "", "long name": "n" * 200_000}.get(
        kind, pick(rng, ("label.", "a\nb", "\u202e", "=1+1"))
    )
    more = {f"{'label.' if i % 3 else ''}c{i}": "1" for i in range(count)} or {odd: "x"}
    return f"{kind} {odd[:12]!r}", csv_bytes([row | more for row in rows]), False, False


def long(rng, rows):
    name = pick(
        rng,
        (
            "text",
            "object",
            "label.object",
            "touch",
            "note",
            "dataset",
            "unit",
            "license",
            "sequence",
        ),
    )
    value = pick(
        rng,
        (
            "a" * 1_000_000,
            "a\n" * 300_000,
            "ä" * 400_000,
            " " * 1_000_000,
            "\u202e" * 1000,
            "\x1b[31m" * 500,
        ),
    )
    for row in rows:
        row.setdefault(name, "")
    rows[int(rng.integers(len(rows)))][name] = value
    wrong = name == "sequence" and not value.strip()
    return f"{name} of {len(value)} letters", csv_bytes(rows), wrong, wrong


WRONG_ENDS = (("\u2028",), ("\x0b",))
LINE_ENDS = (
    ("\n", "\r\n"),
    ("\r",),
    ("\r\n",),
    ("\n", "\n\n"),
    ("\n", "\r", "\r\n"),
    ("\n\r",),
    *WRONG_ENDS,
)
CSV = (cell, cell, cell, text, text, text, columns, long)


def table(rows) -> dict[str, pa.Array]:
    arrays = {name: pa.array([row[name] or None for row in rows]) for name in rows[0]}
    arrays["frame_index"] = pa.array([int(row["frame_index"]) for row in rows])
    return arrays


def typed(rng, arrays):
    """A column of another type."""
    count = len(arrays["path"])
    kinds = {
        "bytes": pa.array([b"a\xff"] * count),
        "lists": pa.array([["a"]] * count),
        "records": pa.array([{"a": 1}] * count),
        "floats": pa.array(np.linspace(0, 1, count)),
        "NaN": pa.array([float("nan")] * count),
        "nothing": pa.nulls(count),
        "booleans": pa.array([True] * count),
        "times": pa.array([0] * count, pa.timestamp("ns")),
        "half": pa.array(np.zeros(count, np.float16)),
        "unsigned": pa.array([(1 << 64) - 1] * count, pa.uint64()),
        "decimal": pa.array([1] * count, pa.int64()).cast(pa.decimal128(30, 2)),
        "months": pa.array([1] * count, pa.date32()),
        "durations": pa.array([1] * count, pa.duration("s")),
        "infinite": pa.array([np.inf] * count),
        "map": pa.array([[("a", 1)]] * count, pa.map_(pa.string(), pa.int64())),
        "fixed": pa.array([b"ab"] * count, pa.binary(2)),
    }
    kind = pick(rng, kinds)
    name = pick(
        rng, (*REQUIRED, "stride", "text", "touch", "object", "commercial", "label.object", "note")
    )
    arrays[name] = kinds[kind]
    number = ("floats", "booleans", "unsigned", "NaN", "infinite", "half", "nothing")
    wrong = (name in REQUIRED and not (name == "frame_index" and kind in number)) or (
        name in ("text", "touch", "object") and kind != "nothing"
    )
    return f"{name} of {kind}", arrays, wrong


def parquet(rng, things, file: Path) -> tuple[str, bool]:
    arrays = table(rows_of(things))
    kind = pick(rng, ("values",) * 6 + ("cut", "flipped", "footer", "empty", "twice", "csv"))
    if kind == "values":
        name, arrays, wrong = typed(rng, arrays)
        pq.write_table(pa.table(arrays), file)
        return name, bool(wrong)
    whole = pa.table(arrays)
    if kind == "twice":
        whole = pa.Table.from_arrays(
            [*whole.columns, whole[0]], names=[*whole.column_names, whole.column_names[0]]
        )
    pq.write_table(whole.slice(0, 0) if kind == "empty" else whole, file)
    data = file.read_bytes()
    file.write_bytes(
        {
            "csv": csv_bytes(rows_of(things)),
            "cut": cut(rng, data),
            "flipped": flipped(
                rng, data, count=int(rng.integers(1, 30))
            ),  # a page may have no checksum
            "footer": flipped(rng, data, len(data) - 400, len(data), int(rng.integers(1, 8))),
        }.get(kind, data)
    )
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
    for image in things.manifest.parent.glob("*.png"):
        shutil.copyfile(image, folder / image.name)
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
        rng,
        ("info",) * 5
        + ("verify",) * 4
        + ("decode",) * 3
        + ("embed", "contact", "pack", "two", "repair", "probe"),
    )
    opens = command in ("decode", "embed", "verify")
    return Case(
        f"{name}, {command}",
        commands[command],
        wrong or (wrong_files and opens and command != "embed"),
    )
