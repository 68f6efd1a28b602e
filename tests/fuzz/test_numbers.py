"""Hostile numbers on the command line, in every option of every command that takes a number."""

from __future__ import annotations

import typing
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from anytouch_jax.cli.app import COMMANDS
from anytouch_jax.cli.train import Sections
from tests.fuzz.harness import Case, pick

NEVER = (
    "nan", "NaN", "inf", "-inf", "1e400", "-1e400", "abc", "0x10", "1,5", "½", "--", "None5", "1 2", "[1]", "9" * 5000,
    "٣.x",
)  # fmt: skip
SELDOM = (
    "", "-1", "0", "-0", "-1e30", "1e30", "1e-400", "99999999999999999999", "1_000", "１", "1.5",
    "-9223372036854775809", " 3", "2147483648",
)  # fmt: skip
HARMLESS = {"above"}  # any number is one of these


def options_of(kind: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """The options of a command that take numbers, and their types."""
    found, hints = [], typing.get_type_hints(kind)
    for field in fields(kind):
        hint = hints[field.name]
        name = prefix + field.name.replace("_", "-")
        if is_dataclass(hint):
            found += options_of(hint, f"{name}.")
        elif {int, float} & {hint, *typing.get_args(hint)} and bool not in (hint, *typing.get_args(hint)):
            found.append((f"--{name}", hint))
    return found


OPTIONS = [(name, option) for name, command in COMMANDS.items() for option in options_of(command.options)]
OPTIONS += [("train", option) for option in options_of(Sections)]


def make(rng, folder: Path, things) -> Case:
    command, (option, hint) = pick(rng, OPTIONS)
    value = pick(
        rng, NEVER if command in ("train", "report", "data simulate", "adapt") or rng.random() < 0.6 else SELDOM
    )
    out, run, data = folder / "out.npz", things.run, things.manifest
    words: dict[str, tuple[object, ...]] = {
        "data simulate": ("--out", folder / "scenes"),
        "data index": ("recordings", folder, "--sensor", "digit"),
        "data contact": (data, "--out", folder / "c.csv"),
        "data verify": (data, "--no-decode"),
        "data annotate": (data, "--estimate", "--family", "x", "photograph"),
        "data pack": (data, "--out", folder / "p" / "m.csv"),
        "train": ("--data", data, "--run", folder / "run"),
        "embed": ("--model", run, "--data", things.frames, "--out", out),
        "stream": ("--model", run, "--data", folder / "no.avi", "--out", out),
        "probe label": ("--data", data, "--features", things.features, "--no-controls"),
        "probe tasks": ("--data", data, "--features", things.features, "--no-controls"),
        "probe benchmark": ("--data", data, "--features", things.features, "--no-controls", "--name", "ycb"),
        "retrieve": ("--data", data, "--model", run),
        "report": ("--data", data, "--stage1", run, "--stage2", run, "--out", folder / "r"),
        "adapt": ("--model", run, "--data", data, "--sensor", "gelslim", "--out", folder / "new", "--frames", "0"),
        "export": ("--to", "safetensors", "--model", run, "--out", folder / "w.safetensors"),
    }
    given = tuple(word for word in words.get(command, ()))
    if option in given:
        at = given.index(option)
        given = given[:at] + given[at + 2 :]
    values = (value,) if "tuple" not in str(hint) else (value, value)
    joined = (f"{option}={value}",) if len(values) == 1 and rng.random() < 0.7 else (option, *values)
    return Case(f"{command} {option} {value[:20]!r}", (*command.split(), *given, *joined), value in NEVER)


@pytest.mark.parametrize("count", [60, pytest.param(0.05, marks=pytest.mark.slow)])
def test_hostile_numbers(survives, count):
    survives(make, count)
