"""What the pages of experiments read from the environment."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

from anytouch_jax.errors import UserError
from experiments.tables import env


@pytest.mark.parametrize(("word", "on"), [(None, False), ("", False), ("0", False), ("1", True)])
def test_a_switch_is_off_by_nought(monkeypatch, word, on):
    monkeypatch.delenv("QUICK", raising=False) if word is None else monkeypatch.setenv("QUICK", word)
    assert env.switch("QUICK") is on


def test_what_is_not_given_is_as_usual(monkeypatch):
    for name in ("STEPS", "SEEDS", "TUNE", "OUT", "RUNS"):
        monkeypatch.setenv(name, "")  # as make passes on what is not set
    assert env.number("STEPS", 7) == 7 and env.numbers("SEEDS", "0,2") == [0, 2]
    assert env.names("TUNE", "fine", ("fine", "frozen")) == ["fine"] and env.path("OUT", "x") == Path("x")
    assert env.runs() == {}


def test_runs_are_names_and_paths(monkeypatch, tmp_path):
    one, two = (tmp_path / name for name in ("b", "d=e"))
    for path in (one, two):
        path.touch()
    monkeypatch.setenv("RUNS", f"a={one} c={two},{one}")
    assert env.runs() == {"a": [str(one)], "c": [str(two), str(one)]}


@pytest.mark.parametrize(
    ("name", "word", "sentence"),
    [
        ("STEPS", "many", "STEPS must be a whole number of 1 or more, not 'many'"),
        ("STEPS", "0", "STEPS must be a whole number of 1 or more, not '0'"),
        ("SEEDS", "0,-1", "SEEDS must be a whole number of 0 or more, not '-1'"),
        ("TUNE", "frozen,finely", "TUNE=frozen,finely: there is no 'finely'; choose among fine, frozen"),
        ("RUNS", "a=b runs/x", "RUNS: name=path for every run, not 'runs/x'"),
        ("RUNS", "a=/,runs/none", "RUNS: there is no run runs/none"),
    ],
)
def test_mistakes_are_one_sentence(monkeypatch, name, word, sentence):
    monkeypatch.setenv(name, word)
    with pytest.raises(UserError) as caught:
        env.number("STEPS", 7), env.numbers("SEEDS", "0"), env.runs()
        env.names("TUNE", "fine", ("fine", "frozen"))
    assert str(caught.value) == sentence


def test_a_page_that_is_run_as_a_script_ends_with_the_sentence(monkeypatch):
    monkeypatch.setenv("RUNS", "nix")
    result = subprocess.run(
        [sys.executable, "-m", "experiments.pouring.study"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    lines = result.stderr.splitlines()
    assert result.returncode == 1 and len(lines) == 1 and lines[0].startswith("study.py: ") and "nix" in lines[0]


def test_a_page_that_is_interrupted_says_so():
    words = [sys.executable, "-c", "from experiments.tables import env\nraise KeyboardInterrupt"]
    result = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT)
    assert result.returncode != 0 and result.stderr == "-c: interrupted; the same command goes on\n"
