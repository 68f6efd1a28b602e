"""A script of `experiments/` as a user runs it: exit status, standard output and standard error."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest


class Outcome(NamedTuple):
    status: int
    out: str
    err: str


@pytest.fixture
def script(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """script(module, *words): run the `main` of a module in this process."""

    def run(module: Any, *words: object) -> Outcome:
        capsys.readouterr()
        try:
            status = module.main([str(word) for word in words])
        except SystemExit as stop:  # the parser's own exit
            status = int(stop.code or 0)
        return Outcome(status, *capsys.readouterr())

    return run
