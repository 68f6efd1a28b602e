"""What the notebooks share: where the results are, and how a picture and a text are shown, in Jupyter or in a terminal.

`RESULTS=` and `FIGURES=` in the environment say where JSON files are read and pictures are written.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from . import pictures, report
from .results import Run, differences, read

DEFAULT = Path(__file__).resolve().parents[1] / "results" / "matrix"


def runs(question: str) -> list[Run]:
    """The runs of a question; tells what to do where there are none."""
    folder = Path(os.environ.get("RESULTS") or DEFAULT)
    found = [run for run in read(folder) if run.question == question] if folder.is_dir() else []
    if not found:
        text(f"**{folder} holds no result of `{question}`: `make experiments ONLY={question}` makes them.**")
    if wrong := differences([run.about for run in found]):
        text(f"**The results of `{question}` in {folder} differ in what they must share ({wrong}): none is shown.**")
        return []
    return found


def show(path: Path) -> None:
    """Show a picture in a notebook; else say where it is."""
    if _in_jupyter():
        from IPython.display import Image, display

        display(Image(filename=str(path)))
    else:
        print(path)


def picture(several: list[Run]) -> Path | None:
    """Draw and show the picture of a question's runs; None where there is nothing to draw."""
    folder = Path(os.environ.get("FIGURES") or tempfile.mkdtemp(prefix="anytouch-"))
    for path in pictures.draw_all(several, folder):
        show(path)
        return path
    return None


def finding(question: str, several: list[Run]) -> str:
    """The tables of a question and what is said of its signs, shown and given back."""
    part = report.parts(several)[question]
    text(part.text)
    return part.text


def text(markdown: str) -> None:
    """Show Markdown."""
    if _in_jupyter():
        from IPython.display import Markdown, display

        display(Markdown(markdown))
    else:
        print(markdown)


def _in_jupyter() -> bool:
    try:
        from IPython import get_ipython
    except ImportError:
        return False
    return get_ipython() is not None
