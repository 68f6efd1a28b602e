"""The scripts of `experiments/` and their package `study` are imported as they are when a script runs."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1] / "experiments"), str(HERE)]
