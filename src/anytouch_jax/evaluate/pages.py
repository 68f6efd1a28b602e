"""Report pages: sections of text, figures and tables in one Markdown file, and one HTML page."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.tables import plain
from anytouch_jax.files import atomic_write

# Beside the colours and letters of the page of `anytouch view`.
_STYLE = """
body { max-width: 1080px; padding: 24px; font-size: 15px; line-height: 1.55; }
main { display: grid; gap: 16px; grid-template-columns: minmax(0, 1fr); }
h1 { font-size: var(--huge); line-height: 1.2; letter-spacing: 0; }
h2 { font-size: var(--large); }
.lead { display: grid; gap: 10px; }
.lead p { max-width: 46em; }
.lead h1 + p { font-size: 19px; line-height: 1.45; }
.figure { overflow-x: auto; }
.figure img { display: block; }
@media (max-width: 700px) { .figure img { max-width: none; width: 700px; } }
img { max-width: 100%; border-radius: 6px; background: #fff; justify-self: start; }
table { border-collapse: collapse; display: block; overflow-x: auto; }
th { text-align: left; font-weight: 600; color: var(--soft); }
th, td { border-bottom: 1px solid var(--line); padding: 4px 14px 4px 0; white-space: nowrap; }
ul, ol { margin: 0; padding-left: 20px; color: var(--soft); }
"""
# No script, no form and no address: captions of strangers stand on the page.
_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'"
)


@dataclass(frozen=True)
class Section:
    """A part of a report, in this order: text, figure, table (Markdown), notes."""

    title: str
    text: str = ""
    table: str = ""
    figure: Path | None = None
    notes: str = ""


def write_report(
    folder: Path,
    sections: Sequence[Section],
    *,
    title: str = "Report",
    lead: Sequence[str] = (),
    numbers: Mapping[str, Any] | None = None,
    reload: int = 0,
) -> Path:
    """Write report.html, report.md, report.json and the figures, and return the path of report.md.

    Each file is written atomically, report.md last, so a report that is there is whole.

    Args:
        folder: of the files; figures go into its folder figures/.
        sections: in their order.
        title: of the page.
        lead: paragraphs before the first section: what the report says, in words.
        numbers: of report.json.
        reload: seconds after which a browser reads the page again, 0 for a page that is final.

    Raises:
        UserError: for a missing figure.
        OSError: for a full disk.
    """
    parts = [f"# {title}", *lead]
    for section in sections:
        parts += [f"## {section.title}", section.text]
        if section.figure is not None:
            if not section.figure.is_file():
                raise UserError(
                    f"There is no figure {section.figure} for the report. Draw it first, or leave "
                    "it out."
                )
            atomic_write(folder / "figures" / section.figure.name, section.figure.read_bytes())
            parts.append(f"![{section.title}](figures/{section.figure.name})")
        parts += [section.table, section.notes]
    if numbers is not None:
        text = json.dumps(plain(numbers), indent=2, allow_nan=False) + "\n"
        atomic_write(folder / "report.json", text)
    text = "\n\n".join(part.strip() for part in parts if part) + "\n"
    atomic_write(folder / "report.html", html_page(text, folder, title, reload))
    atomic_write(folder / "report.md", text)
    return folder / "report.md"


def html_page(text: str, folder: Path, title: str, reload: int = 0) -> str:
    """Return Markdown as one HTML page with the images of `folder`/figures inside.

    HTML in the Markdown is shown as text, and no script runs.

    Args:
        text: Markdown.
        folder: whose figures/ holds the images.
        title: of the page.
        reload: seconds after which a browser reads it again, 0 for never.
    """
    from markdown_it import MarkdownIt

    def inside(match: re.Match[str]) -> str:
        path = folder / "figures" / match[1]
        data = b""
        if path.suffix == ".png" and path.is_file():
            data = path.read_bytes()
        return f'src="data:image/png;base64,{base64.b64encode(data).decode()}"'

    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(text)
    # A name without slashes: a caption cannot make the page read a file of another folder.
    body = re.sub(r'src="figures/([^"/\\]+)"', inside, body)
    # On a phone a figure keeps its size and is scrolled, by the keyboard too: its letters are read.
    body = body.replace("<p><img", '<p class="figure" tabindex="0"><img')
    first, *others = body.split("<h2>")
    parts = [f'<section class="lead">{first}</section>']
    parts += [f'<section class="card"><h2>{one}</section>' for one in others]
    theme = (files("anytouch_jax") / "theme.css").read_text(encoding="utf-8")
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        f'<meta name="viewport" content="width=device-width"><title>{html.escape(title)}</title>'
    )
    if reload:
        head += f'<meta http-equiv="refresh" content="{reload}">'
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}<style>{theme}{_STYLE}</style></head>\n'
        f"<body><main>{''.join(parts)}</main></body></html>\n"
    )
