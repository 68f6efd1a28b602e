"""Runs of `anytouch train` on the page, also while they train."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from anytouch_jax.config import parse_json
from anytouch_jax.data.images import decode
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError

_LINES = 2_000  # points of a loss curve on the page
_BLOCK = 1 << 22  # bytes of metrics.jsonl that are read at once


class Run:
    """A run folder of `anytouch train`, also while it trains: its metrics.jsonl and figures/."""

    kind = "run"

    def __init__(self, folder: Path) -> None:
        self.name = folder.name
        self._folder = folder.resolve()

    def about(self) -> dict[str, Any]:
        """Return nothing: all of it may change."""
        return {}

    def losses(self, start: int) -> dict[str, Any]:
        """Return lines {step, loss, ...} of metrics.jsonl, and the names of the figures.

        Lines are those from byte `start`, and `next` is the byte after them.
        """
        file = self._folder / "metrics.jsonl"
        lines: list[dict[str, float]] = []
        if file.is_file():
            if not 0 <= start <= file.stat().st_size:
                start = 0  # the file was replaced
            with open(file, "rb") as opened:
                opened.seek(start)
                block = opened.read(_BLOCK)
            # A line that is being written is read the next time.
            whole = block[: block.rfind(b"\n") + 1]
            lines = _lines(whole)
            start += len(whole)
        every = max(1, -(-len(lines) // _LINES))
        return {
            "lines": lines[::every],
            "next": start,
            "figures": sorted(self._figures(), reverse=True),
        }

    def figure(self, name: str) -> Array:
        """Return a figure of the run, RGB u8 (h, w, 3). Raises UserError."""
        if name not in self._figures():
            raise UserError("The run has no such figure.")
        return decode(self._figures()[name])

    def _figures(self) -> dict[str, Path]:
        """Return the PNG files in figures/ by name, without links to other places."""
        files = sorted((self._folder / "figures").glob("*.png"))
        return {file.name: file for file in files if file.resolve().is_relative_to(self._folder)}


def _lines(block: bytes) -> list[dict[str, float]]:
    """Return the numbers of each line of metrics.jsonl that has a step."""
    lines = []
    for line in block.splitlines():
        try:
            row = parse_json(line.decode())
        except ValueError:
            continue
        if isinstance(row, dict) and _is_number(row.get("step")):
            lines.append(
                {str(name)[:60]: value for name, value in row.items() if _is_number(value)}
            )
    return lines


def _is_number(value: object) -> bool:
    # NaN is no number here, because no comparison with it is true.
    return isinstance(value, int | float) and abs(value) < 1e300
