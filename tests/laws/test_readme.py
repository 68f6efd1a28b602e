"""What the README and the pages in docs tell a user: commands that parse, targets that are there, Python that runs."""

from __future__ import annotations

import re
import shlex
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from places import ROOT
from tiny_models import tiny_config

from anytouch_jax.cli.app import COMMANDS, GROUPS
from anytouch_jax.config import preset
from anytouch_jax.nn.functional import build

README, MAKEFILE = ((ROOT / name).read_text() for name in ("README.md", "Makefile"))
PAGES = {
    name: (ROOT / name).read_text()
    for name in ("README.md", *(f"docs/{one.name}" for one in (ROOT / "docs").glob("*.md")))
}
TEXT = "\n".join(PAGES.values())
PYTHON = re.findall(r"^```python\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def typed(program: str) -> list[str]:
    """What these pages show to be typed after `program`: lines of code and table cells, without comments."""
    lines = re.findall(rf"^ {{4}}{program} (.*)$", TEXT, re.MULTILINE)
    cells = re.findall(rf"^\|.*?`{program} ([^`]*)`", TEXT, re.MULTILINE)
    return [re.split(r"\s+#|\s\|", line)[0].replace(" ...", "").strip() for line in (*lines, *cells)]


@pytest.mark.parametrize("line", typed("anytouch"))
def test_a_command_of_the_readme_is_understood(line: str) -> None:
    name, *args = shlex.split(line)
    if name in GROUPS:
        name = f"{name} {args.pop(0)}"
    if name == "train" and "--data" not in args:  # the example leaves out what every run needs
        args += ["--data", "m.csv", "--run", "r"]
    command = COMMANDS[name]
    command.parse(command.options, name, args)


def test_one_spelling_of_the_command() -> None:
    assert len(typed("anytouch")) > 20
    assert TEXT.count(".venv/bin/") == 1 and ". .venv/bin/activate" in README


@pytest.mark.parametrize("line", typed("make"))
def test_a_target_of_the_readme_is_there_and_heeds_its_variables(line: str) -> None:
    target, *given = (word for word in shlex.split(line.replace("[", "").replace("]", "")))
    assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE)
    for variable in given:
        assert f"$({variable.partition('=')[0]})" in MAKEFILE, variable


def test_the_notebooks_named_are_those_that_are_made() -> None:
    pages = re.search(r"^PAGES +\?= (.*)$", MAKEFILE, re.MULTILINE).group(1).split()
    reported = re.search(r"make notebooks +# the pages (.*)$", TEXT, re.MULTILINE).group(1)
    assert reported.split(", ") == pages


def test_the_pinned_jax_is_the_one_named_for_a_gpu() -> None:
    pin = re.search(r"^jax==(\S+)$", (ROOT / "requirements.txt").read_text(), re.MULTILINE).group(1)
    assert f'"jax[cuda12]=={pin}"' in README


@pytest.mark.parametrize("name", ["tiny", "small", "base", "large"])
def test_the_table_of_presets_has_their_sizes(name: str) -> None:
    model = preset(name).model
    count = sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(build(model).abstract()["touch"]))
    row = f"| {model.image_size} | {model.touch.width} x {model.touch.depth} | {count / 1e6:.1f} M |"
    assert re.search(rf"^\| `{name}`[^|]* {re.escape(row)}$", TEXT, re.MULTILINE), row


def test_the_snippet_of_an_encoder_runs(tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "stage2").symlink_to(tiny_run)
    monkeypatch.chdir(tmp_path)
    frames = np.random.default_rng(0).integers(0, 256, (3, 40, 30, 3), np.uint8)  # a camera's, not the model's size
    names: dict[str, Any] = {f"frame{i}": frame for i, frame in enumerate(frames)}
    with warnings.catch_warnings(record=True):  # of the sensor that is not in the table
        warnings.simplefilter("always")
        exec(PYTHON[0], names)
    assert names["z"].shape == (1, 12) and np.isfinite(names["z"]).all()


def test_the_snippet_of_training_runs(monkeypatch: pytest.MonkeyPatch, compiled_once: None) -> None:
    asked = []
    monkeypatch.setattr("anytouch_jax.config.preset", lambda *a, **k: asked.append((a, k)) or tiny_config(1))
    names: dict[str, Any] = {"clips": np.zeros((2, 4, 28, 28, 3), np.uint8), "rows": np.zeros(2, np.int32)}
    exec(PYTHON[1], names)
    assert asked == [(("tiny",), {"stage": 1})] and "(B, 4, 112, 112, 3)" in PYTHON[1]
    assert names["state"].step == 1 and np.isfinite(names["metrics"]["loss"])


@pytest.mark.parametrize("name", [*PAGES, "CONTRIBUTING.md"])
def test_links_lead_somewhere(name: str) -> None:
    text = PAGES.get(name) or (ROOT / name).read_text()
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        file, _, heading = target.partition("#")
        if file.startswith("http"):
            continue
        result = (ROOT / name).parent / file if file else ROOT / name
        assert result.is_file(), target
        titles = re.findall(r"^#+ (.*)$", result.read_text(), re.MULTILINE) if heading else []
        assert not heading or heading in [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles]
