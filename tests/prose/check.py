"""Prose rules for pages, docstrings and error messages: `python -m tests.prose.check` prints file,
line and reason.

A sentence has at most 30 words, and in a page at most three numbers and no semicolon. A table cell
has at most 25 words. Some phrases are not used anywhere. The README has at most 700 words. Code,
links' addresses and tables' numbers are not prose.
"""

import ast
import json
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

WORDS = 30
NUMBERS = 3
CELL = 25
README_WORDS = 700
PAGES = ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "experiments/**/*.md")
# Copies, and help texts.
MADE = tuple(
    f"docs/{name}"
    for name in ("results/", "tutorials/", "reference/", "contributing.md", "changelog.md")
)
CODE = ("src/**/*.py",)
NOTEBOOKS = ("experiments/notebooks/*.ipynb",)
PHRASES = (
    "told",
    "tells",
    "tell",
    "less the",
    "anew",
    "likewise",
    "of its own",
    "as it is",
    "as they are",
    "where there is none",
    "where there are none",
    "so far as",
    "by heart",
)
_FORBIDDEN = re.compile(r"\b(" + "|".join(PHRASES) + r")\b", re.IGNORECASE)
_SENTENCE_END = re.compile(r"(?<=[.!?:])[\"')\]*]*\s+(?=[\"'(\[*`]*(?:[A-Z0-9`*]|code\b))")
_ABBREVIATION = re.compile(r"\b(e\.g|i\.e|Eq|Sec|Fig|App|No|vs|cf|al)\.\s")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
MESSAGE = re.compile(r"\w+Error|log|warn")  # what is called with a message
NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,.]*%?(?!\w)")


class Fault(NamedTuple):
    """A place that breaks a rule."""

    file: Path
    line: int
    reason: str


class Block(NamedTuple):
    """A paragraph, list item, heading or table cell, with its first line."""

    line: int
    text: str
    kind: str  # prose, heading or cell


def plain(text: str) -> str:
    """Return Markdown without code, addresses and emphasis. A code span counts as one word."""
    text = re.sub(r"``.+?``|`[^`]*`", "code", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"<[^>]+>|https?://\S+", "", text)
    return re.sub(r"[*_]{1,2}(\S(?:.*?\S)?)[*_]{1,2}", r"\1", text)


def sentences(text: str) -> list[str]:
    """Split prose into sentences."""
    text = _ABBREVIATION.sub(lambda match: match[0].replace(". ", ".\u00a0"), text)
    return [part.strip() for part in _SENTENCE_END.split(text) if part.strip()]


def words(text: str) -> list[str]:
    """Return the words of a text: what has a letter or a digit."""
    return [word for word in text.split() if re.search(r"\w", word)]


def markdown_blocks(text: str) -> Iterator[Block]:
    """Yield the prose of a page, block by block; code blocks and front matter are left out."""
    waiting: list[str] = []
    start = 0
    fence = ""
    lines = text.splitlines()
    front = lines and lines[0] == "---"

    def flush() -> Iterator[Block]:
        if waiting:
            yield Block(start, " ".join(waiting), "prose")
            waiting.clear()

    for number, line in enumerate(lines, 1):
        bare = line.strip()
        if front:
            front = number == 1 or bare != "---"
            continue
        if fence or bare.startswith(("```", "~~~")):
            yield from flush()
            if not fence:
                fence = bare[:3]
            elif bare.startswith(fence):
                fence = ""
            continue
        if re.match(r"( {4}|\t)", line) and not waiting:
            continue  # an indented block of code
        if not bare or bare.startswith(("|", "#", "<!--", "!!!", "???", ":::")):
            yield from flush()
            if bare.startswith("#"):
                yield Block(number, bare.lstrip("# "), "heading")
            elif bare.startswith("|") and not re.fullmatch(r"[|\s:-]+", bare):
                yield from (
                    Block(number, cell.strip(), "cell")
                    for cell in re.split(r"(?<!\\)\|", bare.strip("|"))
                )
            continue
        if item := re.match(r"([-*+]|\d+\.)\s+(.*)", bare):
            yield from flush()
            bare = item[2]
        if not waiting:
            start = number
        waiting.append(bare)
    yield from flush()


def page_faults(file: Path, text: str) -> Iterator[Fault]:
    """Yield the faults of a page."""
    total = 0
    for block in markdown_blocks(text):
        prose = plain(block.text)
        total += len(words(prose))
        if found := _FORBIDDEN.search(prose):
            yield Fault(file, block.line, f"the phrase {found[0]!r}")
        if block.kind == "cell":
            if len(words(prose)) > CELL:
                yield Fault(
                    file, block.line, f"a table cell of {len(words(prose))} words, at most {CELL}"
                )
            continue
        for sentence in sentences(prose):
            if len(words(sentence)) > WORDS:
                yield Fault(
                    file,
                    block.line,
                    f"{len(words(sentence))} words, at most {WORDS}: {sentence[:60]}...",
                )
            if ";" in sentence:
                yield Fault(file, block.line, f"a semicolon: {sentence[:60]}...")
            if len(NUMBER.findall(sentence)) > NUMBERS:
                yield Fault(file, block.line, f"more than {NUMBERS} numbers: {sentence[:60]}...")
    if file.name == "README.md" and file.parent == Path() and total > README_WORDS:
        yield Fault(file, 1, f"{total} words, at most {README_WORDS}")


def text_faults(file: Path, line: int, text: str) -> Iterator[Fault]:
    """Yield the faults of a docstring or a message: long sentences and phrases."""
    if found := _FORBIDDEN.search(text):
        yield Fault(file, line, f"the phrase {found[0]!r}")
    for sentence in sentences(text.replace("; ", ". ")):
        if len(words(sentence)) > WORDS:
            yield Fault(
                file, line, f"{len(words(sentence))} words, at most {WORDS}: {sentence[:60]}..."
            )


def code_faults(file: Path, text: str) -> Iterator[Fault]:
    """Yield the faults of a module, in its docstrings and in its messages, which go to errors and
    logs.
    """
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, DOCUMENTED) and (docstring := ast.get_docstring(node)):
            for block in re.split(r"\n\s*\n|\n(?=\s*[-*>]\s)", docstring):
                if not block.startswith("    ") and not block.lstrip().startswith(">>>"):  # code
                    yield from text_faults(
                        file, node.body[0].lineno, plain(" ".join(block.split()))
                    )
        elif isinstance(node, ast.Call) and node.args and MESSAGE.fullmatch(ast.unparse(node.func)):
            parts = (
                node.args[0].values if isinstance(node.args[0], ast.JoinedStr) else [node.args[0]]
            )
            prose = "".join(
                str(part.value) if isinstance(part, ast.Constant) else "code" for part in parts
            )
            yield from text_faults(file, node.lineno, prose)


def notebook_faults(file: Path, text: str) -> Iterator[Fault]:
    """Yield the faults of the text cells of a notebook.

    A line counts within the text of all of them.
    """
    cells = [
        cell["source"] for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"
    ]
    yield from page_faults(
        file,
        "\n\n".join(source if isinstance(source, str) else "".join(source) for source in cells),
    )


def texts(root: Path, patterns: Sequence[str]) -> dict[Path, str]:
    """Return the files of `patterns` below `root` that are not made from others, and their
    texts.
    """
    files = (file.relative_to(root) for pattern in patterns for file in root.glob(pattern))
    own = sorted({file for file in files if not file.as_posix().startswith(MADE)})
    return {file: (root / file).read_text(encoding="utf-8") for file in own}


def faults(root: Path) -> list[Fault]:
    """Return the faults of all pages, modules and notebooks below `root`."""
    rules = (PAGES, page_faults), (CODE, code_faults), (NOTEBOOKS, notebook_faults)
    each = (
        check(file, text)
        for patterns, check in rules
        for file, text in texts(root, patterns).items()
    )
    return [fault for found in each for fault in found]


def main(argv: Sequence[str] = ()) -> int:
    """Print all faults; 1 if there are any."""
    result = faults(Path(argv[0]) if argv else Path())
    for fault in result:
        print(f"{fault.file}:{fault.line}: {fault.reason}")
    return int(bool(result))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
