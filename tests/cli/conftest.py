"""The command line as a user meets it: an exit status, standard output and standard error."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import pytest
from checked_world import columns
from gel_images import press

from anytouch_jax.cli.app import main
from anytouch_jax.data.manifest import manifest as manifests


class Outcome(NamedTuple):
    status: int
    out: str
    err: str


@pytest.fixture
def anytouch(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """anytouch(*words): run the command line in this process."""

    def run(*words: object) -> Outcome:
        capsys.readouterr()
        status = main([str(word) for word in words])
        return Outcome(status, *capsys.readouterr())

    return run


@pytest.fixture
def mistake(anytouch: Callable[..., Outcome]) -> Callable[..., str]:
    """mistake(*words): the one sentence that answers a user's mistake, with status 2."""

    def run(*words: object) -> str:
        done = anytouch(*words)
        assert done.status == 2, done
        assert done.err.startswith(f"anytouch {words[0]}") and "Traceback" not in done.err
        assert len(done.err.strip().splitlines()) == 1, done.err
        return done.err

    return run


@pytest.fixture
def pressed(tmp_path: Path) -> Path:
    """A manifest of one recording by a DIGIT: two background frames, four free ones, four pressed
    ever deeper.
    """
    depths = [0, 0, 0, 0, 0, 0, 30, 50, 70, 90]
    for i, depth in enumerate(depths):
        cv2.imwrite(str(tmp_path / f"{i}.png"), press(depth))
    more = {
        "split": ["background"] * 2 + ["train"] * 8,
        "dataset": ["mine"] * 10,
        "background_path": ["0.png"] * 10,
        "label.force": [0.1 * depth for depth in depths],
        "license": ["MIT"] * 6 + ["CC-BY-NC-4.0"] * 3 + [None],
    }
    file = tmp_path / "touch.parquet"
    manifests.write(manifests.from_columns(columns(10, **more), file), file)
    return file
