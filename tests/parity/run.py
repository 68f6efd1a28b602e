"""`anytouch parity`: this implementation against golden vectors."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from experiments.command import run_script


@dataclass(frozen=True)
class Parity:
    """Compare this implementation with golden vectors of the authors' PyTorch code.

    Example: python -m tests.parity.run tests/parity/golden

    Exits 1 when a case is out of tolerance or not understood.
    """

    folder: Path
    """Folder with A_*.json, A_*.npz, ..."""
    verbose: bool = False
    """Print every array, not only the worst of a case."""


def run(options: Parity) -> int:
    """Run every golden case; 1 when one is out of tolerance or not understood."""
    from tests.parity import cases as golden

    rows = golden.run(options.folder)
    worst: dict[str, Any] = {}
    for row in rows:
        held = worst.get(row.case)
        if held is None or row.error / max(row.tolerance, 1e-30) > held.error / max(
            held.tolerance, 1e-30
        ):
            worst[row.case] = row
    table = Table("case", "arrays", "worst array", "error", "tolerance", "")
    counts = {case: sum(row.case == case for row in rows) for case in worst}
    bad = [row for row in rows if not row.good]
    shown = (
        rows
        if options.verbose
        else [*worst.values(), *(row for row in bad if row is not worst[row.case])][:200]
    )
    for row in shown:
        mark = "ok" if row.good else f"OUT {row.note}"
        table.add_row(
            row.case,
            str(counts[row.case]),
            row.array,
            f"{row.error:.2g}",
            f"{row.tolerance:.2g}",
            mark,
        )
    Console(width=None if Console().is_terminal else 160).print(table)
    print(f"{len(rows)} comparisons, {len(bad)} out of tolerance")
    if bad:
        return 1
    return 0


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line `args`; return the exit status."""
    return run_script(Parity, run, args)


if __name__ == "__main__":
    sys.exit(main())
