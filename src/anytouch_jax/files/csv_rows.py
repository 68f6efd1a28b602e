"""Rows of CSV files with their line numbers, for errors that name the line."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path


def csv_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the first line, from 1, and the cells of each row that is not blank.

    A quoted cell may have line breaks, so a row can span several lines.

    Raises:
        csv.Error: For a quote that is left open. It names the line where the quote begins, because
            Python's own message names the last line of the file.
    """
    with path.open(encoding="utf-8-sig", newline="") as file:
        line = 1
        rows = csv.reader(file, strict=True)
        try:
            for cells in rows:
                if cells:
                    yield line, cells
                line = rows.line_num + 1
        except csv.Error:
            limit = csv.field_size_limit()
            raise csv.Error(
                f"the quote in line {line} is not closed, or its cell is longer than {limit:,}"
            ) from None
