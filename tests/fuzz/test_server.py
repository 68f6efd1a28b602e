"""A caption server with odd answers: statuses, bodies, usage, waiting times, and connections that break."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
from chat_server import GOOD, chat, serve

from anytouch_jax.data.manifest import manifest as manifests
from tests.fuzz.harness import Case, pick

ODD = (
    None, True, -1, 0, 1.5, "x", "", [], {}, 10**400, "9" * 5000, float("nan"), float("inf"), [1], {"a": 1}, "\ud800",
    1e308, "12", -(10**30),
)  # fmt: skip


def odd_usage(rng):
    value = pick(rng, ODD)
    usage = pick(
        rng, (value, {"prompt_tokens": value, "completion_tokens": 3}, {"prompt_tokens": 3, "completion_tokens": value})
    )
    return f"usage {str(usage)[:30]}", (200, {}, chat(GOOD) | {"usage": usage})


def odd_caption(rng):
    caption = pick(
        rng,
        (
            *ODD, "Soft \ud800 and fuzzy all over it.", "Soft and\0fuzzy all over it.", "a " * 5000, "é" * 100_000,
            "\u202eSoft and fuzzy all over", "I am sorry, I cannot help with that.", "\x1b[2JSoft and fuzzy all over",
            "Soft\ud83d\ude00 and fuzzy all over it",
        ),
    )  # fmt: skip
    answer = pick(
        rng,
        (
            {"object": "scarf", "caption": caption},
            {"object": caption, "caption": GOOD["caption"]},
            {"caption": [caption]},
        ),
    )
    return f"caption {str(caption)[:20]!r}", (200, {}, chat(json.dumps(answer)))


def odd_content(rng):
    content = pick(
        rng,
        (
            "", "[" * 100_000, "5" * 5000, "```json\n{}\n```", '{"caption": NaN}', "null", "\ud800",
            '{"caption": "a", "caption": 3}', "x" * 3_000_000,
        ),
    )  # fmt: skip
    return f"content {content[:12]!r}", (200, {}, chat(content))


def odd_shape(rng):
    value = pick(rng, ODD)
    name = pick(rng, ("choices", "message", "content", "finish_reason", "refusal", "role", "whole", "parts"))
    reply = chat(GOOD)
    choice = reply["choices"][0]
    if name == "choices":
        reply["choices"] = value
    elif name == "message":
        choice["message"] = value
    elif name == "finish_reason":
        choice[name] = value
    elif name == "parts":
        choice["message"]["content"] = [value, {"text": value}]
    else:
        choice["message"][name] = value
    return f"{name} is {str(value)[:20]}", (200, {}, value if name == "whole" else reply)


def odd_status(rng):
    status = int(
        pick(
            rng,
            (
                100, 102, 199, 201, 204, 206, 301, 302, 307, 400, 401, 403, 404, 408, 409, 413, 418, 422, 429, 500, 502,
                503, 504, 529, 599, 600, 999,
            ),
        )
    )  # fmt: skip
    body = pick(
        rng,
        (
            {"error": {"message": "no"}}, {"error": "x" * 100_000}, {"error": {"message": "\ud800 \x1b[31m"}},
            {"error": 3}, {}, "[" * 100_000, "<html>" * 1000, {"error": {"message": {"a": "b" * 5000}}}, None,
        ),
    )  # fmt: skip
    data = body.encode() if isinstance(body, str) else json.dumps(body).encode()
    return f"status {status}", (status, {"Location": pick(rng, ("/", "http://127.0.0.1:1/", "ftp://x", ""))}, data)


def odd_wait(rng):
    value = pick(
        rng,
        (
            "1e9", "1000000000", "-5", "nan", "inf", "Wed, 21 Oct 2099 07:28:00 GMT", "x", "", "1e400", "0", "9" * 400,
            "Wed, 99 Foo 2099",
        ),
    )  # fmt: skip
    status = int(pick(rng, (429, 503, 408)))
    name = pick(rng, ("Retry-After", "Retry-After-Ms"))
    headers = {name: value} if name == "Retry-After-Ms" else {"Retry-After-Ms": "", name: value}
    return f"{name} {value[:12]}", (status, headers, {"error": {"message": "slow down"}})


def odd_bytes(rng):
    good = json.dumps(chat(GOOD)).encode()
    kind = pick(
        rng,
        "cut, empty, null, invalid, utf-16, html, nested, NaN, short, gzip, bad gzip, bomb, type, digits",
    )
    body, headers = good, {}
    if kind == "cut":
        body = good[: int(rng.integers(1, len(good)))]
    elif kind in ("gzip", "bad gzip", "bomb"):
        headers = {"Content-Encoding": "gzip"}
        body = {"gzip": gzip.compress(good), "bad gzip": good, "bomb": gzip.compress(b" " * (1 << 26) + good)}[kind]
    elif kind == "short":
        headers = {"Content-Length": "10"}
    elif kind == "type":
        headers = {
            "Content-Type": pick(rng, ("text/html", "", "application/json; charset=utf-7", "image/png", "x" * 5000))
        }
    else:
        body = {
            "empty": b"", "null": b"null", "invalid": b"\xff\xfe" + good, "utf-16": good.decode().encode("utf-16"),
            "html": b"<html></html>", "nested": b"[" * 200_000, "NaN": b'{"choices": NaN}',
            "digits": b'{"choices": ' + b"9" * 10_000 + b"}",
        }[kind]  # fmt: skip
    return f"bytes: {kind}", (200, headers, body)


KINDS = (odd_usage, odd_caption, odd_content, odd_shape, odd_shape, odd_status, odd_wait, odd_bytes)


def make(rng, folder: Path, things) -> Case:
    name, answer = pick(rng, KINDS)(rng)
    for picture in ("t", "p"):
        np.save(folder / f"{picture}.npy", np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8))
    file = folder / "m.csv"
    file.write_text("path,sensor,sequence,frame_index,split,dataset,image_path\nt.npy,digit,s,0,train,x,p.npy\n")
    words = [
        "data", "annotate", str(file), "--yes", "--family", "x", "photograph", "--tries", "2", "--timeout", "5",
        "--sheet", str(folder / "s.html"), "--url",
    ]  # fmt: skip

    def ask() -> int:
        from anytouch_jax.cli.app import main

        with serve(lambda number, body: answer) as server:
            return main([*words, server.url])

    def check(_):
        text = manifests.read(folder / "m_captions.csv").column("text").to_pylist()[0]
        return None if isinstance(text, str) and 10 < len(text) < 1000 else f"caption {text!r}"

    return Case(name, ask, False, check)


@pytest.mark.parametrize("count", [8, pytest.param(0.03, marks=pytest.mark.slow)])
def test_odd_answers(survives, count):
    survives(make, count)
