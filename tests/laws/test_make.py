import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from places import ROOT
from runs import SIZES

from anytouch_jax.cli.app import COMMANDS, GROUPS
from tests.laws.test_readme import TEXT

NAMES = (
    "DATA",
    "SCENES",
    "DEMO",
    "DEMO_MINUTES",
    "RUN",
    "INIT",
    "PRESET",
    "STEPS",
    "STOP_AFTER",
    "SAVE",
    "LABEL",
    "GOLDEN",
    "PYTHON",
    "MAKEFLAGS",
)
TARGETS = (
    re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE).group(1).split()
)


def make(*words: str, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run make without the variables of the outer make, which may be running this test."""
    assert shutil.which("make") is not None
    clean = {
        key: value
        for key, value in os.environ.items()
        if key not in (*NAMES, "MAKELEVEL", "MFLAGS")
    }
    return subprocess.run(
        ["make", *words], cwd=folder, env=clean, capture_output=True, text=True, check=False
    )


def planned(*words: str) -> list[list[str]]:
    """Return the words of every `anytouch` command that make would run, without the interpreter."""
    done = make("-n", *words)
    assert done.returncode == 0, done.stderr
    commands = [line.partition("-m anytouch_jax ")[2] for line in done.stdout.splitlines()]
    return [shlex.split(command) for command in commands if command]


def parsed(words: list[str]) -> Any:
    """Return the options of an `anytouch` command, which must be understood."""
    name, rest = (" ".join(words[:2]), words[2:]) if words[0] in GROUPS else (words[0], words[1:])
    command = COMMANDS[name]
    return command.parse(command.options, name, rest)


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_can_be_planned(target: str) -> None:
    done = make("-n", target)
    assert done.returncode == 0, done.stderr


def test_variables_reach_the_options() -> None:
    words = [
        "DATA=a.parquet b.csv",
        "RUN=r",
        "PRESET=large",
        "STEPS=4",
        "STOP_AFTER=2",
        "SAVE=1",
        "BATCH=3",
    ]
    options, config = parsed(planned("train-stage1", *words, "ARGS=--data.flip 0")[-1])
    assert (options.stage, options.data, options.run) == (
        1,
        (Path("a.parquet"), Path("b.csv")),
        Path("r"),
    )
    assert (options.preset, config.run.steps, options.stop_after, config.run.save_every) == (
        "large",
        4,
        2,
        1,
    )
    assert config.data.batch_size == 3 and config.data.flip == 0
    spaces = parsed(
        planned("train-stage1", "DATA='my folder/a.parquet' b.csv", "RUN='my runs/one'")[-1]
    ).options
    assert spaces.data == (Path("my folder/a.parquet"), Path("b.csv")) and spaces.run == Path(
        "my runs/one"
    )
    for init, given in (("runs/stage1", []), ("w.pth", ["INIT=w.pth"])):
        options = parsed(planned("train-stage2", "DATA=a.csv", *given)[-1]).options
        assert (options.stage, options.init, options.run) == (2, Path(init), Path("runs/stage2"))
    options = parsed(planned("probe", "DATA=a.csv", "RUN=r", "LABEL=slip")[-1])
    assert (options.model, options.data, options.label) == ((Path("r"),), (Path("a.csv"),), "slip")


def test_what_targets_take_by_default_is_in_the_repository() -> None:
    default = re.search(
        r"^GOLDEN +\?= (\S+)$", (ROOT / "Makefile").read_text(), re.MULTILINE
    ).group(1)
    folder = (ROOT / default).resolve()
    assert folder.is_relative_to(ROOT) and list(folder.glob("A_*.npz"))


def test_plain_make_lists_every_target() -> None:
    done = make()
    assert done.returncode == 0
    assert [
        line.split()[0] for line in done.stdout.splitlines() if re.match(r"  [a-z]", line)
    ] == TARGETS
    # as the test above has it
    assert """DATA="'my folder/a.parquet' b.csv\"\n""" in done.stdout


def test_without_data_touches_are_simulated(tmp_path: Path) -> None:
    for target in ("train-stage1", "train-stage2"):
        assert parsed(planned(target)[-1]).options.data == (Path("simulated"),)
        assert parsed(planned(target, "DATA=a.csv")[-1]).options.data == (Path("a.csv"),)
    scenes = tmp_path / "scenes"
    simulate, use = planned("probe", f"SCENES={scenes}")
    assert simulate[:2] == ["data", "simulate"] and parsed(simulate).out == scenes
    assert f"{scenes}/manifest.parquet" in use
    scenes.mkdir()
    (scenes / "manifest.parquet").write_bytes(b"")
    assert len(planned("probe", f"SCENES={scenes}")) == len(planned("probe", "DATA=a.csv")) == 1


def test_the_demo_is_one_script() -> None:
    done = make("-n", "demo", "DEMO=d", "DEMO_MINUTES=3")
    assert done.stdout.endswith("-m experiments.demo.run --out d --minutes 3\n")


def test_an_old_python_is_one_sentence(tmp_path: Path) -> None:
    for name in ("Makefile", "requirements.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path / name)
    # what `sys.exit(version < 3.11)` answers there
    (tmp_path / "python-old").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "python-old").chmod(0o755)
    done = make("setup", f"PYTHON={tmp_path}/python-old", folder=tmp_path)
    assert done.returncode != 0 and done.stderr.startswith(
        "This project needs Python 3.11 or newer"
    )
    assert not (tmp_path / ".venv").exists()


def test_pins_cover_the_declared_dependencies() -> None:
    import tomllib

    from packaging.requirements import Requirement

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [
        line
        for line in (ROOT / "requirements.txt").read_text().splitlines()
        if not line.startswith("#")
    ]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+]+", line) for line in lines)
    pins = {
        re.sub(r"[-_.]+", "-", name).lower(): version
        for name, version in (line.split("==") for line in lines)
    }
    declared = [
        *project["dependencies"],
        *(one for extra in project["optional-dependencies"].values() for one in extra),
    ]
    # an extra may name others of this package, as [all] does
    declared = [one for one in declared if not one.startswith("anytouch_jax[")]
    for requirement in map(Requirement, declared):
        assert "<" in str(requirement.specifier), f"{requirement} has no upper bound"
        assert pins[re.sub(r"[-_.]+", "-", requirement.name).lower()] in requirement.specifier


# Targets that pages name and that are not run here, with the reason.
NOT_RUN = {
    "setup": "CI begins with it, in a fresh clone",
    "test": "it is running",
    "test-all": "it is running",
    "demo": "it trains for minutes, and tests/experiments/test_demo.py runs its parts",
    "bench": "it measures for minutes, and tests/experiments/test_benchmarks.py runs its parts",
    "compare": "it measures encoders of full size, and test_compare.py runs a small one",
    "docs": "it installs packages from the network",
    "train-stage2": "the tests above read its command, which is that of train-stage1",
}
SMALL = " ".join(f"--{name} {value}" for name, value in SIZES.items())
RUN = {
    "parity": [],
    "train-stage1": ["STEPS=1", "BATCH=2", f"ARGS={SMALL}", "RUN={folder}/run", "DATA={world}"],
}


def test_every_target_of_the_pages_is_run_or_has_a_reason() -> None:
    named = set(re.findall(r"(?:^ {4}|`)make ([a-z][a-z0-9-]*)", TEXT, re.MULTILINE))
    assert named & set(TARGETS) <= NOT_RUN.keys() | RUN.keys()
    assert not NOT_RUN.keys() & RUN.keys() and NOT_RUN.keys() <= named


@pytest.mark.slow
@pytest.mark.parametrize("target", RUN)
def test_a_target_of_the_pages_runs(target: str, world: Path, tmp_path: Path) -> None:
    words = [word.format(folder=tmp_path, world=world) for word in RUN[target]]
    done = make("-o", ".venv/.made", f"PY={sys.executable}", target, *words)
    assert done.returncode == 0, done.stdout + done.stderr
