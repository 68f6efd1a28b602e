import gzip
import json
from pathlib import Path

import numpy as np
from chat_server import GOOD, chat, serve

from anytouch_jax.data.manifest import manifest as manifests
from tests.fuzz.harness import Case, pick

ODD = (
    None,
    True,
    -1,
    0,
    1.5,
    "x",
    "",
    [],
    {},
    10**400,
    "9" * 5000,
    float("nan"),
    float("inf"),
    [1],
    {"a": 1},
    "\ud800",
    1e308,
    "12",
    -(10**30),
    "Soft \ud800 and fuzzy all over it.",
    "Soft and\0fuzzy all over it.",
    "a " * 5000,
    "é" * 100_000,
    "\u202eSoft and fuzzy all over",
    "I am sorry, I cannot help with that.",
    "\x1b[2JSoft and fuzzy",
    "5" * 5000,
    "```json\n{}\n```",
    '{"caption": NaN}',
    '{"caption": "a", "caption": 3}',
    "x" * 3_000_000,
)
STATUSES = (
    100,
    199,
    201,
    204,
    206,
    301,
    307,
    400,
    401,
    404,
    408,
    413,
    418,
    429,
    500,
    503,
    529,
    599,
    600,
    999,
)
BODIES = (
    {"error": {"message": "no"}},
    {"error": "x" * 100_000},
    {"error": {"message": "\ud800 \x1b[31m"}},
    {"error": 3},
    {},
    {"error": {"message": {"a": "b" * 5000}}},
    None,
    "[" * 100_000,
    "<html>" * 1000,
)
WAITS = (
    "1e9",
    "1000000000",
    "-5",
    "nan",
    "inf",
    "Wed, 21 Oct 2099 07:28:00 GMT",
    "x",
    "",
    "1e400",
    "9" * 400,
)


def odd_shape(rng):
    """A chat completion of which one part is something else."""
    value = pick(rng, ODD)
    answer = chat(GOOD)
    part = pick(
        rng,
        "usage, tokens, choices, message, finish_reason, content, parts, caption, object, "
        "captions, whole",
    )
    choice = answer["choices"][0]
    caption = {"caption": value, "object": value, "captions": [value]}
    if part in caption:
        named = {"captions": "caption"}.get(part, part)
        choice["message"]["content"] = json.dumps(GOOD | {named: caption[part]})
    elif part in ("usage", "choices"):
        answer[part] = value
    elif part == "tokens":
        answer["usage"] = {"prompt_tokens": value, "completion_tokens": 3}
    elif part in ("message", "finish_reason"):
        choice[part] = value
    else:
        choice["message"]["content"] = [value, {"text": value}] if part == "parts" else value
    return f"{part} is {str(value)[:20]!r}", (200, {}, value if part == "whole" else answer)


def odd_status(rng):
    status = pick(rng, STATUSES)
    body = pick(rng, BODIES)
    data = body.encode() if isinstance(body, str) else json.dumps(body).encode()
    return f"status {status}", (
        int(status),
        {"Location": pick(rng, ("/", "http://127.0.0.1:1/", "ftp://x", ""))},
        data,
    )


def odd_wait(rng):
    value = pick(rng, WAITS)
    name = pick(rng, ("Retry-After", "Retry-After-Ms"))
    headers = {"Retry-After-Ms": "", name: value}
    return f"{name} {value[:12]}", (
        int(pick(rng, (429, 503, 408))),
        headers,
        {"error": {"message": "slow down"}},
    )


def odd_bytes(rng):
    good = json.dumps(chat(GOOD)).encode()
    packed = {"Content-Encoding": "gzip"}
    kinds = ("text/html", "", "application/json; charset=utf-7", "x" * 5000)
    headers, body = pick(
        rng,
        (
            ({}, good[: int(rng.integers(1, len(good)))]),
            ({}, b""),
            ({}, b"null"),
            ({}, b"\xff\xfe" + good),
            ({}, good.decode().encode("utf-16")),
            ({}, b"<html></html>"),
            ({}, b"[" * 200_000),
            ({}, b'{"choices": NaN}'),
            ({}, b'{"choices": ' + b"9" * 10_000 + b"}"),
            ({"Content-Length": "10"}, good),
            (packed, gzip.compress(good)),
            (packed, good),
            (packed, gzip.compress(b" " * (1 << 26) + good)),
            ({"Content-Type": pick(rng, kinds)}, good),
        ),
    )
    return f"bytes {body[:12]!r} {headers}"[:80], (200, headers, body)


def make(rng, folder: Path, things) -> Case:
    name, answer = pick(rng, (odd_shape, odd_shape, odd_status, odd_wait, odd_bytes))(rng)
    for image in ("t", "p"):
        np.save(
            folder / f"{image}.npy",
            np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8),
        )
    file = folder / "m.csv"
    file.write_text(
        "path,sensor,sequence,frame_index,split,dataset,image_path\nt.npy,digit,s,0,train,x,p.npy\n"
    )
    words = [
        "data",
        "annotate",
        str(file),
        *["--yes", "--family", "x", "photograph", "--tries", "2", "--timeout", "5"],
    ]

    def ask() -> int:
        from anytouch_jax.cli.app import main

        with serve(lambda number, body: answer) as server:
            return main([*words, "--sheet", str(folder / "s.html"), "--url", server.url])

    def check():
        text = manifests.read(folder / "m_captions.csv").column("text").to_pylist()[0]
        if isinstance(text, str) and 10 < len(text) < 1000:
            return None
        return f"caption {text!r}"

    return Case(name, ask, False, check)
