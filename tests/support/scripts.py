"""A script of `experiments/` run in this process, as a user runs it."""

import runpy
from typing import Any

import pytest
from places import EXPERIMENTS


def visit(monkeypatch: pytest.MonkeyPatch, script: str, **environment: Any) -> dict[str, Any]:
    """Run `script` from top to bottom with the environment given, and return its names."""
    for key, value in environment.items():
        monkeypatch.setenv(key, str(value))
    return runpy.run_path(str(EXPERIMENTS / script), run_name="__main__")
