"""Run the notebooks again in place: `python -m experiments.notebooks.execute [01 04 ...]`, or `make
notebooks`.

Each runs in an own process. Its outputs are stored without what libraries print to standard error.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import nbformat
from nbconvert.preprocessors import ExecutePreprocessor

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


def notebooks(chosen: list[str]) -> list[Path]:
    """Return the notebooks, or those whose names begin with one of `chosen`."""
    every = sorted(HERE.glob("[0-9][0-9]_*.ipynb"))
    return [path for path in every if not chosen or path.name.startswith(tuple(chosen))]


def executed(path: Path) -> str:
    """Return a notebook, run from top to bottom, as JSON. Raises CellExecutionError."""
    page = nbformat.read(path, as_version=4)
    page.metadata = {
        "kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}
    }
    ExecutePreprocessor(timeout=3600, kernel_name="python3").preprocess(
        page, {"metadata": {"path": str(ROOT)}}
    )
    for number, cell in enumerate(page.cells):
        cell["id"] = f"cell-{number}"
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":  # warnings of libraries are not part of the page
            cell["outputs"] = [one for one in cell["outputs"] if one.get("name") != "stderr"]
    return str(nbformat.writes(page))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "number", nargs="*", help="how the names of the notebooks begin (default: all)"
    )
    for path in notebooks(parser.parse_args().number):
        text = executed(path)
        path.write_text(text + "\n", encoding="utf-8")
        print(f"{path.name}: {len(text) / 1e3:.0f} kB", flush=True)
