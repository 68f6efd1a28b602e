"""A page of captions beside their pictures, to be checked by hand."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.prepare.captions import Caption
from anytouch_jax.data.prepare.questions import picture_bytes, small_jpeg
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

_SIDE = 256
_STYLE = (
    "body{font:15px/1.4 sans-serif;max-width:1000px;margin:2em auto}article{display:flex;gap:1em;margin:1em 0;"
    "border-top:1px solid #ccc;padding-top:1em}figure{margin:0}img{max-width:200px;display:block}"
    "figcaption,small{color:#666}"
)


def sample_sheet(manifest: Manifest, captions: Sequence[Caption], path: str | Path, *, count: int = 40) -> Path:
    """Write an HTML page of `count` captions drawn by lot, with small copies of their pictures in a folder beside.

    The page and its folder `<name>_images` can be moved together. Raises UserError when there are no captions.
    """
    if not captions:
        raise UserError("there are no captions to look at")
    target = Path(path).expanduser().resolve()
    folder = target.with_name(f"{target.stem}_images")
    chosen = np.random.default_rng(0).permutation(len(captions))[:count]
    parts = [_article(manifest, captions[at], number, folder) for number, at in enumerate(np.sort(chosen))]
    title = f"{len(parts)} of {len(captions)} captions"
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
        f"<h1>{title}</h1><p>Tick what is wrong.</p>{''.join(parts)}</html>\n"
    )
    atomic_write(target, page)
    return target


def _article(manifest: Manifest, caption: Caption, number: int, folder: Path) -> str:
    figures = []
    for place, (row, column) in enumerate((*caption.job.pictures, *_touch(caption))):
        name = f"{number:04d}_{place}_{column.removesuffix('_path')}.jpg"
        try:
            data = picture_bytes(manifest, row, column)
            atomic_write(folder / name, small_jpeg(data, f"{column} of row {row}", _SIDE))
        except (UserError, OSError, ValueError) as error:
            figures.append(f"<p>{html.escape(str(error))}</p>")
            continue
        word = "touch" if column == "path" else "photograph"
        figures.append(f'<figure><img src="{folder.name}/{name}" alt="{word}"><figcaption>{word}</figcaption></figure>')
    job, row = caption.job, int(caption.job.rows[0])
    phrase = f"<p><small>phrase: {html.escape(job.phrase)}</small></p>" if job.phrase else ""
    about = f"{manifest.value(row, 'dataset')}, row {manifest.number[row]}, {len(job.rows)} rows share it"
    return (
        f"<article>{''.join(figures)}<div><p><label><input type=checkbox> {number + 1}. "
        f"<b>{html.escape(caption.object)}</b></label></p><p>{html.escape(caption.text)}</p>{phrase}"
        f"<p><small>{html.escape(about)}</small></p></div></article>"
    )


def _touch(caption: Caption) -> list[tuple[int, str]]:
    """The touch image, where it was not among the pictures that the model saw."""
    if any(column == "path" for _, column in caption.job.pictures):
        return []
    return [(caption.job.pictures[0][0] if caption.job.pictures else int(caption.job.rows[0]), "path")]
