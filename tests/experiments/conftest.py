from typing import NamedTuple

import pytest


class Outcome(NamedTuple):
    status: int
    out: str
    err: str


@pytest.fixture
def script(capsys):
    """script(module, *words): run the `main` of a module in this process, as a user runs it."""

    def run(module, *words):
        capsys.readouterr()
        try:
            status = module.main([str(word) for word in words])
        except SystemExit as stop:  # the parser's own exit
            status = int(stop.code or 0)
        return Outcome(status, *capsys.readouterr())

    return run
