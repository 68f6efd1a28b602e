"""Statistics of the README and the pages in docs: `python -m tests.prose.statistics` prints them with their limits.

A limit holds over all pages together. That on headings holds on each page. Tables, code and headings are not prose.
"""

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from tests.prose.check import MADE, NUMBER, markdown_blocks, plain, sentences, words

PAGES = ("README.md", "docs/**/*.md")
READER = re.compile(r"\b(you|your|yours|yourself|we|our|ours|us)\b", re.IGNORECASE)


class Statistic(NamedTuple):
    """A measured value and its limit; `least` says that the value must reach it."""

    name: str
    value: float
    limit: float
    least: bool = False

    @property
    def holds(self) -> bool:
        """Whether the value keeps the limit."""
        return self.value >= self.limit if self.least else self.value <= self.limit


def pages(root: Path) -> dict[str, str]:
    """Return the text of the pages by name, without those that are made from others."""
    files = sorted({file for pattern in PAGES for file in root.glob(pattern)})
    named = {file.relative_to(root).as_posix(): file.read_text(encoding="utf-8") for file in files}
    return {name: text for name, text in named.items() if not name.startswith(MADE)}


def longest_without_heading(text: str) -> int:
    """Return the most words of prose between two headings of a page."""
    most = count = 0
    for block in markdown_blocks(text):
        count = 0 if block.kind == "heading" else count + len(words(plain(block.text))) * (block.kind == "prose")
        most = max(most, count)
    return most


def statistics(texts: Mapping[str, str]) -> list[Statistic]:
    """Return the statistics of pages {name: text}."""
    prose = [plain(block.text) for text in texts.values() for block in markdown_blocks(text) if block.kind == "prose"]
    lengths = sorted(len(words(one)) for text in prose for one in sentences(text))
    count = sum(len(words(text)) for text in prose)
    numbers, readers = (sum(len(found.findall(text)) for text in prose) for found in (NUMBER, READER))
    page, run = max(((name, longest_without_heading(text)) for name, text in texts.items()), key=lambda one: one[1])
    return [
        Statistic("words of the median sentence", lengths[len(lengths) // 2], 13),
        Statistic("words of the sentence at 95 %", lengths[int(0.95 * len(lengths))], 25),
        Statistic("numbers in 100 words", 100 * numbers / count, 3),
        Statistic("you and we in 100 words", 100 * readers / count, 1.5, least=True),
        Statistic(f"most words without a heading ({page})", run, 120),
    ]


def main(argv: Sequence[str] = ()) -> int:
    """Print the statistics; 1 if one breaks its limit."""
    texts = pages(Path(argv[0]) if argv else Path())
    result = statistics(texts)
    for one in result:
        print(
            f"{'holds' if one.holds else 'BREAKS'}  {one.name}: {one.value:.4g}, "
            f"{'at least' if one.least else 'at most'} {one.limit:g}"
        )
    for name, text in texts.items():
        if (run := longest_without_heading(text)) > 120:
            print(f"{name}: {run} words without a heading")
    return int(not all(one.holds for one in result))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
