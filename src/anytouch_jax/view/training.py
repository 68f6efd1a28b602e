"""Run folders for the page: losses and figures, also while a run trains."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import parse_json
from anytouch_jax.data.images import decode
from anytouch_jax.errors import UserError

_LINES = 2_000  # points of a loss curve on the page
_BLOCK = 1 << 22  # bytes of metrics.jsonl that are read at once


class Run:
    """A run folder of `anytouch train`, also while it trains: its metrics.jsonl and figures/."""

    kind = "run"

    def __init__(self, folder: Path) -> None:
        self.name, self._folder = folder.name, folder.resolve()

    def about(self) -> dict[str, Any]:
        """Return nothing: all of it may change."""
        return {}

    def losses(self, start: int) -> dict[str, Any]:
        """Return lines {step, loss, ...} of metrics.jsonl from byte `start`, the byte after them, and the figures.

        A file that has become shorter is read from its beginning.
        """
        file = self._folder / "metrics.jsonl"
        lines: list[dict[str, float]] = []
        if file.is_file():
            start = start if 0 <= start <= file.stat().st_size else 0
            with open(file, "rb") as opened:
                opened.seek(start)
                block = opened.read(_BLOCK)
            whole = block[: block.rfind(b"\n") + 1]
            for line in whole.splitlines():
                try:
                    row = parse_json(line.decode())
                except ValueError:
                    continue
                if isinstance(row, dict) and _is_number(row.get("step")):
                    lines.append({str(name)[:60]: value for name, value in row.items() if _is_number(value)})
            start += len(whole)
        every = -(-len(lines) // _LINES)
        return {"lines": lines[:: max(1, every)], "next": start, "figures": sorted(self._figures(), reverse=True)}

    def figure(self, name: str) -> np.ndarray:
        """Return a figure of the run, RGB u8 (h, w, 3). Raises UserError."""
        if name not in self._figures():
            raise UserError("The run has no such figure.")
        return decode(self._figures()[name])

    def _figures(self) -> dict[str, Path]:
        """Return the PNG files in figures/ by name, without links to other places."""
        files = sorted((self._folder / "figures").glob("*.png"))
        return {file.name: file for file in files if file.resolve().is_relative_to(self._folder)}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and abs(value) < 1e300  # not NaN: no comparison with it is true
