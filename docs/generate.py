"""Generated pages of the documentation site: commands, API, results and tutorials.

python -m docs.generate        writes docs/reference/, docs/results/ and docs/tutorials/
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import re
import shutil
from pathlib import Path

import anytouch_jax as at
from anytouch_jax.cli.app import COMMANDS, main

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
RESULTS = ROOT / "experiments" / "results"
NOTEBOOKS = ROOT / "experiments" / "notebooks"
# A search finds how-to pages before results and references.
_LOW = "---\nsearch:\n  boost: 0.2\n---\n\n"
# The title of a public name's place in the API reference, by the first part of its module.
_TITLES = {
    "encoder": "Encoders",
    "zoo": "Encoders",
    "export": "Encoders",
    "evaluate": "Probes",
    "ops": "Pure functions",
    "objectives": "Losses of the two stages",
    "nn": "Networks",
    "train": "Training",
    "training": "Training",
    "finetuning": "Training",
    "batch": "Batches",
    "config": "Settings",
    "data": "Data",
    "weights": "Weights",
    "sim": "Simulated touch",
    "errors": "Errors",
}


def help_of(command: str) -> str:
    """Return the help of a command, 80 columns wide, without the frames that a terminal draws."""
    os.environ["COLUMNS"] = "80"
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        main([*command.split(), "--help"])
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue())
    lines = [re.sub(r"[╭╮╰╯─│]+", " ", line).rstrip() for line in plain.splitlines()]
    return "\n".join(lines).strip()


def commands_page() -> str:
    """Return the command reference: each command with its help."""
    parts = [f"{_LOW}# Command reference\n\nEach command answers `--help` with this text.\n"]
    parts += [
        f"## anytouch {name}\n\n{command.summary}\n\n```text\n{help_of(name)}\n```\n"
        for name, command in COMMANDS.items()
    ]
    return "\n".join(parts)


def api_page() -> str:
    """Return the API reference: every public name, under the title of its room."""
    entries: dict[str, list[str]] = {}
    for name in at.__all__:
        module, attribute = at._HOME[name]
        title = _TITLES[module.split(".")[0]]
        entries.setdefault(title, []).append(f"::: anytouch_jax.{module}.{attribute}\n")
    parts = [f"{_LOW}# API reference\n\nImport these names from `anytouch_jax`.\n"]
    for title in dict.fromkeys(_TITLES.values()):
        parts += [f"## {title}\n", *entries.get(title, [])]
    return "\n".join(parts)


def tutorial(notebook: Path, folder: Path) -> str:
    """Return a notebook as a page: its text, its code and what that printed.

    Images go to `folder`.
    """
    parts = [_LOW]
    for number, cell in enumerate(json.loads(notebook.read_text(encoding="utf-8"))["cells"]):
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for place, output in enumerate(cell.get("outputs", ())):
            if printed := "".join(output.get("text", ())).strip():
                # The fence is longer than any in the printed text, so that the text cannot end it.
                fence = max(["``", *re.findall("`+", printed)], key=len) + "`"
                parts.append(f"{fence}text\n{printed}\n{fence}")
            if image := output.get("data", {}).get("image/png"):
                name = f"{notebook.stem}-{number}-{place}.png"
                (folder / name).write_bytes(base64.b64decode("".join(image)))
                parts.append(f"![Output of the cell above]({name})")
    return "\n\n".join(parts) + "\n"


def write() -> None:
    """Write the generated pages."""
    shutil.rmtree(DOCS / "tutorials", ignore_errors=True)
    (DOCS / "tutorials").mkdir()
    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        page = DOCS / "tutorials" / f"{notebook.stem}.md"
        page.write_text(tutorial(notebook, page.parent), encoding="utf-8")
    (DOCS / "reference").mkdir(exist_ok=True)
    (DOCS / "reference" / "commands.md").write_text(commands_page(), encoding="utf-8")
    (DOCS / "reference" / "api.md").write_text(api_page(), encoding="utf-8")
    shutil.rmtree(DOCS / "results", ignore_errors=True)
    (DOCS / "results").mkdir()
    if (RESULTS / "figures").is_dir():
        shutil.copytree(RESULTS / "figures", DOCS / "results" / "figures")
    pages = {
        page: DOCS / "results" / ("index.md" if page.name == "README.md" else page.name)
        for page in RESULTS.glob("*.md")
    }
    pages |= {ROOT / name: DOCS / name.lower() for name in ("CONTRIBUTING.md", "CHANGELOG.md")}
    for page, target in sorted(pages.items()):
        text = _inside(page.read_text(encoding="utf-8"), page, target, pages)
        target.write_text(
            _LOW + text if target.parent.name == "results" else text, encoding="utf-8"
        )


def _inside(text: str, page: Path, target: Path, pages: dict[Path, Path]) -> str:
    """Return a copied page whose links stay inside the site. Other links become text."""

    def link(match: re.Match[str]) -> str:
        whole = match[0]
        title = match[1]
        address = match[2]
        if address.startswith(("http", "#")):
            return whole
        file, _, anchor = address.partition("#")
        source = (page.parent / file).resolve()
        home = pages.get(source, source)
        if home in pages.values() or (home.is_relative_to(DOCS) and home.exists()):
            return (
                f"[{title}]({os.path.relpath(home, target.parent)}{'#' + anchor if anchor else ''})"
            )
        if source.is_relative_to(RESULTS / "figures"):
            return whole
        return title

    return re.sub(r"\[([^\]]*)\]\(([^)\s]+)\)", link, text)


if __name__ == "__main__":
    write()
