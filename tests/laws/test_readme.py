import ast
import re
import shlex

import jax
import numpy as np
import pytest
from places import ROOT

from anytouch_jax.cli.app import COMMANDS, GROUPS
from anytouch_jax.config import preset
from anytouch_jax.nn.functional import build

MAKEFILE = (ROOT / "Makefile").read_text()
FILES = [
    "README.md",
    *(file.relative_to(ROOT).as_posix() for file in sorted((ROOT / "docs").rglob("*.md"))),
]
MADE = tuple(
    f"docs/{name}"
    for name in ("results/", "tutorials/", "reference/", "contributing.md", "changelog.md")
)
PAGES = {name: (ROOT / name).read_text() for name in FILES if not name.startswith(MADE)}
TEXT = "\n".join(PAGES.values())


def typed(program: str) -> list[str]:
    """What these pages show to be typed after `program`: lines of code and table cells, without
    comments.
    """
    lines = re.findall(rf"^ {{4}}{program} (.*)$", TEXT, re.MULTILINE)
    cells = re.findall(rf"^\|.*?`{program} ([^`]*)`", TEXT, re.MULTILINE)
    return [
        re.split(r"\s+#|\s\|", line)[0].replace(" ...", "").strip() for line in (*lines, *cells)
    ]


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
    assert ".venv/bin/python" not in TEXT and ". .venv/bin/activate" in PAGES["README.md"]


@pytest.mark.parametrize("line", typed("make"))
def test_a_target_of_the_readme_is_there_and_heeds_its_variables(line: str) -> None:
    target, *given = (word for word in shlex.split(line.replace("[", "").replace("]", "")))
    assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE)
    for variable in given:
        assert f"$({variable.partition('=')[0]})" in MAKEFILE, variable


@pytest.mark.parametrize("name", ["tiny", "small", "base", "large"])
def test_the_table_of_presets_has_their_sizes(name: str) -> None:
    model = preset(name).model
    count = sum(
        int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(build(model).abstract()["touch"])
    )
    row = (
        f"| {model.image_size} | {model.touch.width} x {model.touch.depth} | {count / 1e6:.1f} M |"
    )
    assert re.search(rf"^\| `{name}`[^|]* {re.escape(row)}$", TEXT, re.MULTILINE), row


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
        assert not heading or heading in [
            re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles
        ]


STOP = re.compile(r"^\*\*(\d)\. `([\w/]+\.py)`\*\*(.*)$", re.MULTILINE)
ELSEWHERE = {"Config", "fit", "stride", "TouchBatch"}  # named on the way, defined at another stop


@pytest.mark.parametrize(("page", "count"), [("way_of_a_clip", 9), ("way_of_a_touch", 8)])
def test_the_stops_exist_in_order_and_hold_what_the_page_names(page: str, count: int) -> None:
    stops = STOP.findall((ROOT / "docs" / "how" / f"{page}.md").read_text())
    assert [int(number) for number, _, _ in stops] == list(range(1, count + 1))
    for _, name, text in stops:
        tree = ast.parse((ROOT / "src" / "anytouch_jax" / name).read_text())
        defined = {
            node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)
        }
        named = {word.rpartition(".")[2] for word in re.findall(r"`(\w+\.?\w+)`", text)}
        assert named - ELSEWHERE <= defined, (name, named - ELSEWHERE - defined)
        assert named & defined, name
