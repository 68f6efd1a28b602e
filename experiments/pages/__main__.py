"""Make the pages of results again from their data: `python -m experiments.pages [FOLDER]`.

FOLDER has the data, and gets the pages and figures. The default is experiments/results, whose
values the README gets too.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write
from anytouch_jax.weights.registry import DEFAULT
from experiments.compare.page import NAME as COMPARED
from experiments.compare.page import compare_encoders
from experiments.pages import matrix, page, speed, studies, trust

RESULTS = Path(__file__).resolve().parents[1] / "results"
README = RESULTS.parents[1] / "README.md"
# The rows of a page that the README shows: what their first two cells are.
SHOWN = {"real": ("object, other finger", "linear"), "teaching": ("convolutional patches", "fine texture")}
STUDIES: Mapping[str, tuple[str, Callable[[Path], page.Page]]] = {
    "real": ("real.jsonl", studies.real),
    "trust": (trust.NAME, trust.trust),
    "health": (trust.NAME, trust.health),
    "backgrounds": ("backgrounds.jsonl", studies.backgrounds),
    "untouched_gel": (studies.GELS, studies.untouched_gel),
    "motion": ("motion.jsonl", studies.motion),
    "lookalikes": ("lookalikes.jsonl", studies.lookalikes),
    "teaching": ("teaching.jsonl", studies.teaching),
    "left_out": ("named.jsonl", studies.left_out),
    "named": ("named.jsonl", studies.named),
    "long_clips": ("long_clips.jsonl", studies.long_clips),
    "pouring": ("pouring.jsonl", studies.pouring),
    "translation": ("translation.jsonl", studies.translation),
    "variants": (speed.VARIANTS, speed.variants),
    "versions": (speed.VERSIONS, speed.versions),
    "optimiser": (speed.OPTIMISER, speed.optimiser),
    "torch": (speed.TORCH, speed.torch),
    "memory": (speed.MEMORY, speed.memory),
    "search": (speed.SEARCH, speed.search),
    "scene": (speed.SCENE, speed.scene),
    "view": (speed.VIEW, speed.view),
    "engines": (speed.ENGINES, speed.engines),
    "by_contact": (studies.CONTACTS, studies.by_contact),
    "photometry": (speed.SIMULATOR, speed.photometry),
    "contact": (speed.SIMULATOR, speed.contact),
    "compare": (COMPARED, compare_encoders),
}


def pages(folder: Path) -> list[page.Page]:
    """Return the pages of a folder, for the data that are there. Raises UserError for data that make no page."""
    made = matrix.pages(folder / matrix.NAME)
    return made + [make(folder) for data, make in STUDIES.values() if (folder / data).exists()]


def index(several: list[page.Page]) -> str:
    """Return the page that lists the others."""
    lines = "\n".join(f"* [{one.question}]({one.name}.md)" for one in several)
    return (
        "# Results\n\nEach page answers one question. It is made from its data alone, by `make results`.\n"
        "A finding stands on one page. An interval is one of 95 %.\n\n"
        f"{lines}\n"
    )


def readme(text: str, several: list[page.Page]) -> str:
    """Return the README with the values of the pages that its table links to, written as `name` 1.2 %."""
    lines = text.splitlines(keepends=True)
    for one in several:
        values = {row[2].removesuffix(f":{DEFAULT}"): row[3] for row in one.rows if row[:2] == SHOWN.get(one.name)}
        for name, value in values.items():
            pattern = re.compile(rf"(?<={re.escape(name)}`) [\d.]+ %")
            lines = [pattern.sub(f" {value.mean:.1f} %", line) if f"/{one.name}.md" in line else line for line in lines]
    return "".join(lines)


def write(folder: Path) -> list[Path]:
    """Write the pages, their figures and the index of a folder, and return the pages. Raises UserError."""
    several = pages(folder)
    for one in several:
        page.draw(one, folder / "figures" / f"{one.name}.png")
        atomic_write(folder / f"{one.name}.md", page.text(one))
    atomic_write(folder / "README.md", index(several))
    if folder == RESULTS:
        atomic_write(README, readme(README.read_text(encoding="utf-8"), several))
    return [folder / f"{one.name}.md" for one in several]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=RESULTS, help="data of the pages")
    try:
        for path in write(parser.parse_args().folder):
            print(path)
    except UserError as error:
        sys.exit(str(error))
