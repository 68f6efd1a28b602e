"""Run the notebooks again: `python -m experiments.notebooks.execute [01 04 ...]`, or `make notebooks`.

Each `NN_name.py` becomes `NN_name.ipynb` next to it, with its outputs. Notebooks run in an own process each.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jupytext
from nbconvert.preprocessors import ExecutePreprocessor

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def sources(chosen: list[str]) -> list[Path]:
    """Return the sources of the notebooks, or of those whose names begin with one of `chosen`."""
    every = sorted(HERE.glob("[0-9][0-9]_*.py"))
    return [path for path in every if not chosen or path.name.startswith(tuple(chosen))]


def notebook(source: Path) -> str:
    """Return the notebook of a source, run from top to bottom, as JSON. Raises CellExecutionError."""
    page = jupytext.read(source)
    page.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    ExecutePreprocessor(timeout=3600, kernel_name="python3").preprocess(page, {"metadata": {"path": str(ROOT)}})
    for number, cell in enumerate(page.cells):
        cell["id"] = f"cell-{number}"
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":  # warnings of libraries are not part of the page
            cell["outputs"] = [one for one in cell["outputs"] if one.get("name") != "stderr"]
    return jupytext.writes(page, fmt="ipynb")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("number", nargs="*", help="how the names of the notebooks begin (default: all)")
    for path in sources(parser.parse_args().number):
        text = notebook(path)
        path.with_suffix(".ipynb").write_text(text + "\n", encoding="utf-8")
        print(f"{path.with_suffix('.ipynb').name}: {len(text) / 1e3:.0f} kB", flush=True)
