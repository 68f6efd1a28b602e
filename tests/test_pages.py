"""Large pages: the command starts itself anew once, with its own words, and only where that can help."""

import os
import subprocess
import sys

import pytest

from anytouch_jax import cli, pages


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", "glibc.malloc.hugetlb=1"),
        ("glibc.malloc.check=3", "glibc.malloc.check=3:glibc.malloc.hugetlb=1"),
        ("glibc.malloc.hugetlb=0", None),
        ("glibc.malloc.check=3:glibc.malloc.hugetlb=1", None),
        ("glibc.malloc.hugetlb_x=1", "glibc.malloc.hugetlb_x=1:glibc.malloc.hugetlb=1"),
    ],
)
def test_tunables_are_added_to_and_never_overruled(before, after):
    assert pages.tuned(before) == after


@pytest.mark.parametrize(
    ("library", "kernel", "there"),
    [
        ("glibc 2.36", "always [madvise] never", True),
        ("glibc 2.35", "[always] madvise never", True),
        ("glibc 2.34", "always [madvise] never", False),
        ("glibc 3.0", "always [madvise] never", True),
        ("glibc 2.36", "always madvise [never]", False),
        ("musl 1.2", "always [madvise] never", False),
        ("glibc unknown", "always [madvise] never", False),
    ],
)
def test_only_where_library_and_kernel_have_them(library, kernel, there, monkeypatch, tmp_path):
    monkeypatch.setattr(os, "confstr", lambda name: library)
    monkeypatch.setattr(pages, "_KERNEL", tmp_path / "enabled")
    assert not pages.available()  # no such file: a kernel without them
    (tmp_path / "enabled").write_text(kernel + "\n")
    assert pages.available() is there


def test_restarts_once_with_the_same_words(monkeypatch):
    calls = []
    monkeypatch.setattr(pages, "available", lambda: True)
    monkeypatch.setattr(sys, "orig_argv", ["python", "-m", "anytouch_jax", "train", "--seed", "3"])
    monkeypatch.setenv("GLIBC_TUNABLES", "")
    monkeypatch.setattr(os, "execv", lambda *words: calls.append(words))
    pages.restart()
    assert calls == [(sys.executable, [sys.executable, "-m", "anytouch_jax", "train", "--seed", "3"])]
    pages.restart()  # as the process that was started does
    assert len(calls) == 1


@pytest.mark.parametrize(
    ("words", "restarts"),
    [(["train", "--seed", "1"], 1), (["train", "--help"], 0), (["--version"], 0), (["tarin", "--seed", "1"], 0)],
)
def test_only_commands_that_work_restart(words, restarts, monkeypatch):
    calls = []
    monkeypatch.setattr(sys, "argv", ["anytouch", *words])
    monkeypatch.setattr(pages, "restart", lambda: calls.append(1))
    monkeypatch.setattr(cli, "main", lambda: 7)
    assert cli.console() == 7
    assert len(calls) == restarts


def test_a_started_command_answers_and_keeps_its_status():
    """End to end: one process, the same number, whose mistake is still the user's."""
    environment = {key: value for key, value in os.environ.items() if key != "GLIBC_TUNABLES"}
    command = [sys.executable, "-m", "anytouch_jax", "parity", "no_such_folder"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("anytouch parity: ") and "Traceback" not in done.stderr
