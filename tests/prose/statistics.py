"""Statistics of the README and the pages in docs: `python -m tests.prose.statistics` prints them
with their limits.

A limit holds over all pages together. That on headings holds on each page. Tables, code and
headings are not prose.
"""

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from tests.prose.check import NUMBER, markdown_blocks, plain, sentences, texts, words

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
        if self.least:
            return self.value >= self.limit
        return self.value <= self.limit


def longest_without_heading(text: str) -> int:
    """Return the most words of prose between two headings of a page."""
    most = count = 0
    for block in markdown_blocks(text):
        count = (
            0
            if block.kind == "heading"
            else count + len(words(plain(block.text))) * (block.kind == "prose")
        )
        most = max(most, count)
    return most


def statistics(pages: Mapping[Path, str]) -> list[Statistic]:
    """Return the statistics of the texts of pages."""
    prose = [
        plain(block.text)
        for text in pages.values()
        for block in markdown_blocks(text)
        if block.kind == "prose"
    ]
    lengths = sorted(len(words(one)) for text in prose for one in sentences(text))
    count = sum(len(words(text)) for text in prose)
    numbers, readers = (
        sum(len(found.findall(text)) for text in prose) for found in (NUMBER, READER)
    )
    run, page = max((longest_without_heading(text), page) for page, text in pages.items())
    return [
        Statistic("words of the median sentence", lengths[len(lengths) // 2], 13),
        Statistic("words of the sentence at 95 %", lengths[int(0.95 * len(lengths))], 25),
        Statistic("numbers in 100 words", 100 * numbers / count, 3),
        Statistic("you and we in 100 words", 100 * readers / count, 1.5, least=True),
        Statistic(f"most words without a heading ({page})", run, 120),
    ]


def main(argv: Sequence[str] = ()) -> int:
    """Print the statistics; 1 if one breaks its limit."""
    result = statistics(texts(Path(argv[0]) if argv else Path(), PAGES))
    for name, value, limit, least in result:
        print(f"{name}: {value:.4g}, {'at least' if least else 'at most'} {limit:g}")
    return int(not all(one.holds for one in result))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
