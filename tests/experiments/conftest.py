"""The scripts of `experiments/` and their package `study` are imported as they are when a script runs."""

from __future__ import annotations

from pathlib import Path

HERE = Path(__file__).resolve().parent
