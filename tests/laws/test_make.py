"""What a user types after `make`: the commands it would run, its help, its one sentence on a mistake."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from places import ROOT

NAMES = (
    "DATA",
    "SCENES",
    "DEMO",
    "DEMO_STEPS",
    "DEMO_STEPS1",
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


def make(*words: str, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run make without the variables of the outer make, which may be running this test."""
    assert shutil.which("make") is not None
    clean = {key: value for key, value in os.environ.items() if key not in (*NAMES, "MAKELEVEL", "MFLAGS")}
    return subprocess.run(["make", *words], cwd=folder, env=clean, capture_output=True, text=True, check=False)


def planned(*words: str) -> str:
    """The last command that make would run, without its interpreter."""
    done = make("-n", *words)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().splitlines()[-1].removeprefix(".venv/bin/python -m ")


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (
            ["train-stage1", "DATA=mine/manifest.csv"],
            "anytouch_jax train --stage 1 --data mine/manifest.csv --run runs/stage1 --preset tiny",
        ),
        (
            ["train-stage1", "DATA=a.parquet b.csv", "RUN=r", "PRESET=large", "STEPS=4", "STOP_AFTER=2", "SAVE=1"],
            "anytouch_jax train --stage 1 --data a.parquet b.csv --run r --preset large"
            " --steps 4 --stop-after 2 --save-every 1",
        ),
        (
            ["train-stage2", "DATA=a.csv"],
            "anytouch_jax train --stage 2 --data a.csv --run runs/stage2 --preset tiny --init runs/stage1",
        ),
        (
            ["train-stage2", "DATA=a.csv", "INIT=w.pth", "RUN=r"],
            "anytouch_jax train --stage 2 --data a.csv --run r --preset tiny --init w.pth",
        ),
        (
            ["probe", "DATA=a.csv", "RUN=r", "LABEL=slip"],
            "anytouch_jax probe --run r --data a.csv --label slip",
        ),
        (
            ["train-stage1", "DATA='my folder/a.parquet' b.csv", "RUN='my runs/one'"],
            "anytouch_jax train --stage 1 --data 'my folder/a.parquet' b.csv --run 'my runs/one' --preset tiny",
        ),
        (["parity"], "anytouch_jax parity tests/parity/golden"),
        (["parity", "GOLDEN=g"], "anytouch_jax parity g"),
    ],
)
def test_targets_run_the_command_line(words: list[str], command: str) -> None:
    assert planned(*words) == command


def test_what_targets_take_by_default_is_in_the_repository() -> None:
    default = re.search(r"^GOLDEN +\?= (\S+)$", (ROOT / "Makefile").read_text(), re.MULTILINE).group(1)
    folder = (ROOT / default).resolve()
    assert folder.is_relative_to(ROOT) and list(folder.glob("A_*.npz"))


def test_quick_and_whole_test_run() -> None:
    assert planned("test").endswith('-m "not slow"')
    assert "not slow" not in planned("test-all")


def test_every_target_makes_the_environment_first() -> None:
    text = (ROOT / "Makefile").read_text()
    targets = re.search(r"^\.PHONY: (.*)$", text, re.MULTILINE).group(1).split()
    for target in set(targets) - {"help", "clean", "bench-gpu"}:  # which runs where nothing may be installed
        assert re.search(rf"^{target}: \$\(STAMP\)( \$\(scenes\))? ## \S", text, re.MULTILINE), target


def test_plain_make_lists_every_target() -> None:
    done = make()
    targets = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE).group(1).split()
    assert done.returncode == 0
    assert [line.split()[0] for line in done.stdout.splitlines() if re.match(r"  [a-z]", line)] == targets
    assert """DATA="'my folder/a.parquet' b.csv\"\n""" in done.stdout  # as the test above has it


@pytest.mark.parametrize("target", ["train-stage1", "train-stage2", "probe"])
def test_without_data_the_simulated_scenes_are_made_first(target: str, tmp_path: Path) -> None:
    scenes = tmp_path / "scenes"
    done = make("-n", target, f"SCENES={scenes}")
    assert done.returncode == 0
    simulate, use = [line for line in done.stdout.splitlines() if "anytouch_jax" in line and "pip" not in line]
    assert simulate.endswith(f"anytouch_jax simulate --out {scenes}") and f"--data {scenes}/manifest.parquet" in use
    scenes.mkdir()
    (scenes / "manifest.parquet").write_bytes(b"")
    assert "anytouch_jax simulate" not in make("-n", target, f"SCENES={scenes}").stdout
    assert "anytouch_jax simulate" not in make("-n", target, "DATA=a.csv").stdout


def test_the_demo_simulates_trains_both_stages_and_reports() -> None:
    done = make("-n", "demo", "DEMO=d")
    steps = [line for line in done.stdout.splitlines() if "anytouch_jax " in line and "pip" not in line]
    words = [line.split("anytouch_jax ")[1].split()[0] for line in steps]
    assert words == ["simulate", "contact", "train", "train", "report"]
    assert steps[1].startswith("test -e d/scenes/contact.parquet || ")  # a second run does not mark again
    assert "--stage 1" in steps[2] and "--stage 2" in steps[3] and "--init d/stage1" in steps[3]
    for step in steps[2:4]:
        assert "--data d/scenes/contact.parquet" in step and "--loader.contact-only" in step


def test_a_longer_demo_goes_on_from_the_scenes_and_stage_1_of_the_plain_one() -> None:
    plain, longer = (make("-n", "demo", "DEMO=d", *words).stdout.splitlines() for words in ((), ("DEMO_STEPS=600",)))
    assert plain[:-2] == longer[:-2]
    assert "--run d/stage2-600 --init d/stage1 " in longer[-2] and "--steps 600" in longer[-2]
    assert longer[-1].endswith("--stage2 d/stage2-600 --out d/report-600")
    assert plain[-1].endswith("--stage2 d/stage2 --out d/report")
    longest = make("-n", "demo", "DEMO=d", "DEMO_STEPS1=3000", "DEMO_STEPS=600").stdout.splitlines()
    assert plain[:-3] == longest[:-3]
    assert "--run d/stage1-3000 " in longest[-3] and "--steps 3000" in longest[-3]
    assert "--run d/stage2-3000-600 --init d/stage1-3000 " in longest[-2]
    assert longest[-1].endswith("--stage1 d/stage1-3000 --stage2 d/stage2-3000-600 --out d/report-3000-600")


def test_notebooks_run_in_their_own_folder_and_find_their_helpers() -> None:
    done = make("-n", "notebooks", "PAGES=q2_space")
    assert done.returncode == 0 and f"PYTHONPATH={ROOT}/experiments " in done.stdout


def test_an_old_python_is_one_sentence(tmp_path: Path) -> None:
    for name in ("Makefile", "requirements.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path / name)
    old = tmp_path / "python-old"
    old.write_text("#!/bin/sh\nexit 1\n")  # what `sys.exit(version < 3.11)` answers there
    old.chmod(0o755)
    done = make("setup", f"PYTHON={old}", folder=tmp_path)
    assert done.returncode != 0
    assert done.stderr.startswith("This project needs Python 3.11 or newer")
    assert not (tmp_path / ".venv").exists()


def test_pins_cover_the_declared_dependencies() -> None:
    import tomllib

    from packaging.requirements import Requirement

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = [line for line in (ROOT / "requirements.txt").read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+]+", line) for line in lines)
    pins = {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in (line.split("==") for line in lines)}
    declared = [
        *project["dependencies"],
        *(one for extra in project["optional-dependencies"].values() for one in extra),
    ]
    for requirement in map(Requirement, declared):
        assert "<" in str(requirement.specifier), f"{requirement} has no upper bound"
        assert pins[re.sub(r"[-_.]+", "-", requirement.name).lower()] in requirement.specifier
