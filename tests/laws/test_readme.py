import ast
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from checked_world import columns
from PIL import Image
from places import ROOT
from tiny_models import tiny_config

from anytouch_jax.cli.app import COMMANDS, GROUPS
from anytouch_jax.config import preset
from anytouch_jax.data.manifest.manifest import from_columns
from anytouch_jax.encoder.encoder import random_encoder
from anytouch_jax.encoder.export import export
from anytouch_jax.encoder.linear_head import Calibration, LinearHead, save_head
from anytouch_jax.nn.functional import build

MAKEFILE = (ROOT / "Makefile").read_text()
FILES = ["README.md", *(file.relative_to(ROOT).as_posix() for file in sorted((ROOT / "docs").rglob("*.md")))]
MADE = tuple(f"docs/{name}" for name in ("results/", "tutorials/", "reference/", "contributing.md", "changelog.md"))
PAGES = {name: (ROOT / name).read_text() for name in FILES if not name.startswith(MADE)}
TEXT = "\n".join(PAGES.values())
BLOCK = re.compile(r"^```python\n(.*?)^```$(?:\n+^```text\n(.*?)^```$)?", re.MULTILINE | re.DOTALL)


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
    count = sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(build(model).abstract()["touch"]))
    row = f"| {model.image_size} | {model.touch.width} x {model.touch.depth} | {count / 1e6:.1f} M |"
    assert re.search(rf"^\| `{name}`[^|]* {re.escape(row)}$", TEXT, re.MULTILINE), row


@pytest.mark.parametrize("name", [name for name, text in PAGES.items() if BLOCK.search(text)])
def test_the_python_of_a_page_runs_and_prints_what_it_shows(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Blocks of a page run in their order, in an empty folder. A text block after one is its output."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"clips": np.zeros((2, 4, 28, 28, 3), np.uint8), "rows": np.zeros(2, np.int32)}
    if "how/equations" in name:  # the same step on a network that compiles fast
        monkeypatch.setattr("anytouch_jax.config.preset", lambda *_, **__: tiny_config(1))
    if "use/export" in name:
        encoder = random_encoder(tiny_config())
        export(encoder, tmp_path / "encoder.bin", frames=1, platforms=("cpu",))
        names |= {"frames": np.zeros((2, 1, 28, 28, 3), np.uint8)}
    if "use/families" in name:
        golden = ROOT / "tests/parity/golden_others"
        shutil.copy(golden / "sparsh_vjepa_learned.safetensors", "sparsh_vjepa.safetensors")
        shutil.copy(golden / "anytouch2_checkpoint-4frames.pth", "anytouch2.pth")
        shutil.copytree(golden / "dinov2_registers_hf", "dinov2")
        Path("config.json").write_text('{"num_attention_heads": 3}')
    if name.endswith(("retrieval.md", "trust.md", "health.md")):
        names |= {"encoder": random_encoder(tiny_config()), "frames": np.zeros((2, 1, 28, 28, 3), np.uint8)}
        width = names["encoder"].encode_touch(names["frames"]).shape[1]
        np.savez("touches.npz", features=np.eye(width, dtype=np.float32), rows=np.arange(width))
        known = Calibration(1.0, 0.9, 0.5, 0.05, 9.0, 20, np.eye(width), np.zeros((5, width)), np.full(5, "digit"))
        arrays = (np.array(["ball", "cube"]), np.ones((width, 1)), np.zeros(1), np.zeros(width), np.ones(width))
        save_head("head.npz", LinearHead(*arrays, "object", "class", 1, "f", known))
        Image.fromarray(np.full((60, 80, 3), 90, np.uint8)).save("a.png")
        names["manifest"] = from_columns(columns(path=["a.png"]), tmp_path / "m.parquet")
    for code, shown in BLOCK.findall(PAGES[name]):
        capsys.readouterr()
        if "runs/" in code:  # test_pages_run.py trains that run
            continue
        exec(code, names)
        assert not shown or capsys.readouterr().out == shown


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


STOP = re.compile(r"^\*\*(\d)\. `([\w/]+\.py)`\*\*(.*)$", re.MULTILINE)
ELSEWHERE = {"Config", "fit", "stride", "TouchBatch"}  # named on the way, defined at another stop


@pytest.mark.parametrize(("page", "count"), [("way_of_a_clip", 9), ("way_of_a_touch", 7)])
def test_the_stops_exist_in_order_and_hold_what_the_page_names(page: str, count: int) -> None:
    stops = STOP.findall((ROOT / "docs" / "how" / f"{page}.md").read_text())
    assert [int(number) for number, _, _ in stops] == list(range(1, count + 1))
    for _, name, text in stops:
        tree = ast.parse((ROOT / "src" / "anytouch_jax" / name).read_text())
        defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        named = {word.rpartition(".")[2] for word in re.findall(r"`(\w+\.?\w+)`", text)}
        assert named - ELSEWHERE <= defined, (name, named - ELSEWHERE - defined)
        assert named & defined, name
