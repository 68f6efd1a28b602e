"""Which captions a manifest lacks: groups of rows that share one, and what has to be asked for each group."""

from __future__ import annotations

import base64
import shlex
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import cv2
import numpy as np

from anytouch_jax.data.images import decode_bytes
from anytouch_jax.data.manifest.files import read_file
from anytouch_jax.data.manifest.manifest import Manifest, resolve_path
from anytouch_jax.data.manifest.schema import SPLITS
from anytouch_jax.data.prepare.prompts import FAMILIES, Family, Question, family_of, question
from anytouch_jax.errors import UserError

PHRASE = "phrase"  # the column that keeps the words that were expanded
SECOND_IMAGE = "image2_path"  # a manifest need not have it
_SKIPPED = ("background",)


class Job(NamedTuple):
    """One caption to get: the rows i64 that share it, the question, and its pictures as (row, column)."""

    rows: np.ndarray
    question: Question
    pictures: tuple[tuple[int, str], ...]
    phrase: str | None


class Jobs(NamedTuple):
    """The captions to get, and how many rows are left out for which reason."""

    jobs: list[Job]
    left_out: dict[str, int]


def find_jobs(
    manifest: Manifest,
    *,
    split: str | None = None,
    families: Mapping[str, str] | None = None,
    overwrite: bool = False,
    second_image: str = SECOND_IMAGE,
) -> Jobs:
    """Groups of rows of one touch (else of one sequence) that lack a caption, or whose phrase is to be expanded.

    The picture of a group is that of its middle frame. Rows of other datasets than those of `families` and FAMILIES
    are left out, as are backgrounds. Raises UserError when no caption is lacking.
    """
    if second_image not in (SECOND_IMAGE, *manifest.table.column_names):
        raise UserError(
            f"there is no column {second_image!r}; the manifest has {', '.join(manifest.table.column_names)}"
        )
    asked, family, left = _asked(manifest, split, families, overwrite)
    jobs: list[Job] = []
    for rows in _groups(manifest, asked, family):
        job = _job(manifest, rows, family[rows[0]], second_image)
        if job is None:
            left["no photograph"] += len(rows)
        else:
            jobs.append(job)
    if not jobs:
        why = "; ".join(f"{count} rows: {reason}" for reason, count in left.items())
        raise UserError(f"{manifest.files[0]}: there is nothing to annotate ({why or 'no rows'})")
    return Jobs(jobs, dict(left))


def _asked(
    manifest: Manifest, split: str | None, families: Mapping[str, str] | None, overwrite: bool
) -> tuple[np.ndarray, np.ndarray, Counter[str]]:
    """Which rows to ask for (ids i64), the family of every row, and the count of the others by reason."""
    left: Counter[str] = Counter()
    asked = np.zeros(len(manifest), bool)
    if split is None:
        for name in SPLITS:
            if name not in _SKIPPED:
                asked |= np.asarray(manifest.table["split"].to_pylist()) == name
    else:
        asked[manifest.rows_of(split)] = True
    left["background frame, or another split"] = int((~asked).sum())
    family = np.full(len(manifest), None, object)
    dataset = manifest.codes("dataset")
    for code in np.unique(dataset):
        rows = np.flatnonzero(dataset == code)
        name = manifest.value(rows[0], "dataset")
        family[rows] = chosen = family_of(name, families)
        if chosen is None and asked[rows].any():
            known, remedy = "", "the manifest has no column dataset that names it"
            if name is not None:
                remedy = f"give it one, such as --family {shlex.quote(name)} photograph"
            if not any("has no prompt" in reason for reason in left):
                known = f"; known: {', '.join(FAMILIES)}"
            left[f"dataset {name!r} has no prompt: {remedy}{known}"] = int(asked[rows].sum())
    asked &= family != None  # noqa: E711 - elementwise
    text, expanded = manifest.present("text"), np.zeros(len(manifest), bool)
    if PHRASE in manifest.table.column_names:
        expanded = manifest.present(PHRASE)
    phrase = family == "phrase"
    for reason, bad in (
        ("no phrase to expand", phrase & ~text),
        ("expanded before", phrase & expanded & (not overwrite)),
        ("has a caption", ~phrase & text & (not overwrite)),
    ):
        left[reason] += int((asked & bad).sum())
        asked &= ~bad
    return np.flatnonzero(asked), family, +left


def _groups(manifest: Manifest, asked: np.ndarray, family: np.ndarray) -> list[np.ndarray]:
    """The rows of every group in the order of their frames; groups in the order of their first row."""
    if not asked.size:
        return []
    touch, sequence = manifest.codes("touch", own=True)[asked], manifest.codes("sequence", own=True)[asked]
    text = np.where(family[asked] == "phrase", manifest.codes("text")[asked], -1)
    key = np.stack([touch, np.where(touch < 0, sequence, -1), text, manifest.codes("dataset")[asked]], 1)
    _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
    order = np.lexsort((asked, np.asarray(manifest.table["frame_index"])[asked], first[group.ravel()]))
    cuts = np.flatnonzero(np.diff(group.ravel()[order])) + 1
    return np.split(asked[order], cuts)


def _job(manifest: Manifest, rows: np.ndarray, family: Family, second_image: str) -> Job | None:
    with_photograph = [int(row) for row in rows if manifest.value(row, "image_path") is not None]
    if not with_photograph and family != "phrase":
        return None
    phrase = None
    if family == "phrase":  # one that was expanded stands in a column of its own
        before = manifest.value(rows[0], PHRASE) if PHRASE in manifest.table.column_names else None
        phrase = str(before or manifest.value(rows[0], "text"))
    pictures: list[tuple[int, str]] = []
    if with_photograph:
        row = with_photograph[len(with_photograph) // 2]
        pictures.append((row, "image_path"))
        if family == "object" and manifest.value(row, second_image) is not None:
            pictures.append((row, second_image))
    photographs = len(pictures)
    if family == "object":
        pictures.append((pictures[0][0], "path"))
    return Job(rows, question(family, photographs, phrase), tuple(pictures), phrase)


def picture_bytes(manifest: Manifest, row: int, column: str) -> bytes:
    """The encoded picture in a cell. Raises UserError, OSError or ValueError."""
    return read_file(resolve_path(manifest.files[manifest.source[row]].parent, manifest.value(row, column)))


def small_jpeg(data: bytes, name: str, side: int) -> bytes:
    """The picture as JPEG with no side longer than `side`. Raises ImageError (a UserError)."""
    pixels = decode_bytes(data, name)
    scale = side / max(pixels.shape[:2])
    if scale < 1:
        size = [max(1, round(length * scale)) for length in pixels.shape[1::-1]]
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


def data_url(jpeg: bytes) -> str:
    """A JPEG as a data URL."""
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}"
