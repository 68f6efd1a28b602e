"""Captions of a manifest: prompts for each family of datasets, rows that need a caption, and tables
of captions.

The paper lets GPT-4o write the captions (AnyTouch, appendix). The wording of the prompts is ours,
the inputs are the paper's. Touch and Go and TacQuad send one RGB image. ObjectFolder Real sends
two RGB images and the tactile image, because the RGB images can hide the touched place. TVL,
SSVTP and Octopi send an RGB image and a phrase.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shlex
from collections import Counter
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from anytouch_jax.config.parsing import parse_json
from anytouch_jax.data.background.estimate import scale_image
from anytouch_jax.data.images import decode_bytes, encode
from anytouch_jax.data.manifest import schema
from anytouch_jax.data.manifest.files import read_file
from anytouch_jax.data.manifest.manifest import Manifest, group_rows, replace_column, resolve_path
from anytouch_jax.data.manifest.schema import listed, shown
from anytouch_jax.errors import UserError

Family = Literal["photograph", "object", "phrase"]
PHRASE = "phrase"  # the column that stores the words that were expanded
SECOND_IMAGE = "image2_path"  # a manifest need not have this column
# CLIP reads 77 tokens
_MIN_WORDS = 3
_MAX_WORDS = 60

# Answers are stored under a hash of the prompt: another wording asks, and pays for, every question
# again.
FAMILIES: dict[str, Family] = {
    "touch_and_go": "photograph",
    "tacquad": "photograph",
    "objectfolder_real": "object",
    "tvl": "phrase",
    "ssvtp": "phrase",
    "octopi": "phrase",
}

_SYSTEM = (
    "You describe how surfaces feel to the touch. You look at what you are given, name the "
    "material, and say what a fingertip would feel: texture, roughness, hardness, shape of edges "
    "and bumps, elasticity. You do not mention colours, cameras, sensors, images or who is "
    "touching."
)
_FORM = (
    'Answer with one JSON object and nothing else: {"object": "<what is touched, at most six '
    'words>", "caption": "<one or two sentences, at most 40 words, that say how the touched place '
    'feels>"}.'
)
_TEXTS: dict[Family, str] = {
    "photograph": (
        "The RGB image shows an object or a surface at the moment when it is touched. Decide what "
        "is touched, near where the finger or the sensor is, and describe the tactile properties "
        "of that place."
    ),
    "object": (
        "{views} The place that is touched may be hidden there. The last image "
        "is the imprint of the touched place on a soft gel with coloured light from its sides: it "
        "shows the local "
        "shape (edges, bumps, grooves, grain) of a patch about as large as a fingertip, and its "
        "colours mean nothing. "
        "Take the object and the material from the RGB images and the local shape from the "
        "imprint, and describe the "
        "tactile properties of the touched place. Where they disagree, trust the imprint for shape "
        "and texture."
    ),
    "phrase": (
        "A person described how this touch feels by the words: {phrase}. {view}Expand these words "
        "into a full "
        "description of the tactile properties. Keep every property that is named, contradict "
        "none, and add only what "
        "follows from the material."
    ),
}
_REFUSAL = re.compile(
    r"\b(i'?m sorry|i am sorry|as an ai|"
    r"i can(not|'?t) (see|assist|help|determine|identify|describe|provide|view)|"
    r"unable to (see|assist|help|determine|identify|describe|provide|view))\b",
    re.IGNORECASE,
)


class Prompt(NamedTuple):
    """The words sent to the model. Images follow in the order RGB images, tactile image."""

    family: Family
    system: str
    text: str

    def fingerprint(self) -> str:
        """Return the first 16 hex digits of the SHA-256 of the words."""
        return hashlib.sha256(f"{self.system}\0{self.text}".encode()).hexdigest()[:16]

    def messages(self, jpegs: list[bytes]) -> list[dict[str, Any]]:
        """Return the chat messages with JPEG images as data URLs."""
        urls = [
            f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}" for jpeg in jpegs
        ]
        parts: list[dict[str, Any]] = [{"type": "text", "text": self.text}]
        parts += [{"type": "image_url", "image_url": {"url": url}} for url in urls]
        return [{"role": "system", "content": self.system}, {"role": "user", "content": parts}]


def family_of(dataset: str | None, families: Mapping[str, str] | None = None) -> Family | None:
    """Return the family of a dataset, by `families` or else FAMILIES, or None.

    Raises UserError for an unknown one.
    """
    family = (families or {}).get(dataset or "") or FAMILIES.get(dataset or "")
    if family is not None and family not in _TEXTS:
        raise UserError(f"There is no prompt family {family!r}. Use one of {', '.join(_TEXTS)}.")
    return family


def make_prompt(family: Family, rgb_images: int, phrase: str | None = None) -> Prompt:
    """Return the prompt of a family for a number of RGB images and, in family phrase, the words to
    expand.
    """
    views = "The first two images are RGB images of the same object from two sides."
    if rgb_images == 1:
        views = "The first image is an RGB image of the object."
    view = "The RGB image shows the place that is touched. " if rgb_images else ""
    quoted = json.dumps(" ".join((phrase or "").split()), ensure_ascii=False)
    text = _TEXTS[family].format(views=views, phrase=quoted, view=view)
    return Prompt(family, _SYSTEM, f"{text}\n\n{_FORM}")


class BadAnswer(ValueError):
    """An answer without a usable caption. The message gives the reason."""


def parse_caption(text: str, finish: str) -> tuple[str, str]:
    """Return (caption, object) of an answer.

    Raises BadAnswer if it is empty, cut off, refused, or unfit.
    """
    if finish in ("refusal", "content_filter") or _REFUSAL.search(text):
        raise BadAnswer("refused")
    if not text.strip():
        raise BadAnswer("empty")
    if finish == "length":
        raise BadAnswer("cut off")
    bare = re.sub(r"\A\s*```(?:json)?\s*|\s*```\s*\Z", "", text)
    try:
        answer = parse_json(bare)
    except UserError as error:
        raise BadAnswer("not text" if "Unicode" in str(error) else "not JSON") from None
    caption = answer.get("caption") if isinstance(answer, dict) else None
    if not isinstance(caption, str):
        raise BadAnswer("JSON without a caption")
    caption, words = " ".join(caption.split()), len(caption.split())
    if words < _MIN_WORDS or not re.search(r"[^\W\d_]{2}", caption):
        raise BadAnswer("too short")
    if words > _MAX_WORDS or len(caption) > 12 * _MAX_WORDS:
        raise BadAnswer(f"too long ({words} words)")
    if "\ufffd" in caption or any(ord(letter) < 32 for letter in caption):
        raise BadAnswer("not text")
    return caption, " ".join(str(answer.get("object") or "").split())[:100]


class CaptionJob(NamedTuple):
    """One caption to get: the rows i64 that share it, the prompt, and its images as (row,
    column).
    """

    rows: np.ndarray
    prompt: Prompt
    images: tuple[tuple[int, str], ...]
    phrase: str | None


def find_caption_jobs(
    manifest: Manifest,
    *,
    split: str | None = None,
    families: Mapping[str, str] | None = None,
    overwrite: bool = False,
    second_image: str = SECOND_IMAGE,
) -> tuple[list[CaptionJob], dict[str, int]]:
    """Return the captions to get, and the number of rows left out for each reason.

    Rows of one touch share a caption. Rows without a touch share it by sequence. The RGB image of
    a group is that of its middle frame. Backgrounds and datasets without a prompt family are left
    out. Raises UserError if no caption is missing.

    Args:
        manifest: the frames.
        split: only rows of this split, by default of all.
        families: prompt families by the name of the dataset, beside the known ones.
        overwrite: also captions that rows have.
        second_image: column of the image beside the RGB image.
    """
    names = manifest.table.column_names
    if second_image not in (SECOND_IMAGE, *names):
        raise UserError(f"The manifest has no column {second_image!r}. It has {', '.join(names)}.")
    rows_to_ask, family, left_out = _rows_to_ask(manifest, split, families, overwrite)
    touch = manifest.codes("touch", own=True)
    sequence = manifest.codes("sequence", own=True)
    text = np.where(family == "phrase", manifest.codes("text"), -1)
    key = np.stack([touch, np.where(touch < 0, sequence, -1), text, manifest.codes("dataset")], 1)[
        rows_to_ask
    ]
    groups = group_rows(rows_to_ask, key, np.asarray(manifest.table["frame_index"])[rows_to_ask])
    jobs: list[CaptionJob] = []
    for rows in sorted(groups, key=np.min):
        job = _make_job(manifest, rows, family[rows[0]], second_image)
        if job is None:
            left_out["no RGB image"] += len(rows)
        else:
            jobs.append(job)
    if not jobs:
        reasons = "; ".join(f"{count} rows: {reason}" for reason, count in left_out.items())
        raise UserError(
            f"{manifest.files[0]}: there is nothing to annotate ({reasons or 'no rows'})"
        )
    return jobs, dict(left_out)


def _rows_to_ask(
    manifest: Manifest, split: str | None, families: Mapping[str, str] | None, overwrite: bool
) -> tuple[np.ndarray, np.ndarray, Counter[str]]:
    """Return the row ids i64 to ask for, the family of every row, and the number of other rows by
    reason.
    """
    left_out: Counter[str] = Counter()
    selected = np.asarray(pc.not_equal(manifest.table["split"], "background"))
    if split is not None:
        selected = np.isin(np.arange(len(manifest)), manifest.rows_of(split))
    left_out["background frame, or another split"] = int((~selected).sum())
    family = np.full(len(manifest), None, object)
    for rows in manifest.groups("dataset"):
        name = manifest.value(rows[0], "dataset")
        family[rows] = family_of(name, families)
        if family[rows[0]] is None and selected[rows].any():
            remedy = "the manifest has no column dataset that names it"
            if name is not None:
                known = f"; known: {', '.join(FAMILIES)}" if len(left_out) == 1 else ""
                remedy = f"give it one, such as --family {shlex.quote(name)} RGB image{known}"
            left_out[f"dataset {name!r} has no prompt: {remedy}"] = int(selected[rows].sum())
    selected &= family != None  # noqa: E711 - elementwise
    has_text = manifest.present("text")
    is_phrase = family == "phrase"
    expanded = (
        manifest.present(PHRASE)
        if PHRASE in manifest.table.column_names
        else np.zeros(len(manifest), bool)
    )
    for reason, excluded in (
        ("no phrase to expand", is_phrase & ~has_text),
        ("expanded before", is_phrase & expanded & (not overwrite)),
        ("has a caption", ~is_phrase & has_text & (not overwrite)),
    ):
        left_out[reason] += int((selected & excluded).sum())
        selected &= ~excluded
    return np.flatnonzero(selected), family, +left_out


def _make_job(
    manifest: Manifest, rows: np.ndarray, family: Family, second_image: str
) -> CaptionJob | None:
    with_photograph = [int(row) for row in rows if manifest.value(row, "image_path") is not None]
    if not with_photograph and family != "phrase":
        return None
    phrase = None
    if family == "phrase":  # an expanded phrase is in its own column
        phrase = str(manifest.value(rows[0], PHRASE) or manifest.value(rows[0], "text"))
    images: list[tuple[int, str]] = []
    if with_photograph:
        row = with_photograph[len(with_photograph) // 2]
        images.append((row, "image_path"))
        if family == "object" and manifest.value(row, second_image) is not None:
            images.append((row, second_image))
    prompt = make_prompt(family, len(images), phrase)
    if family == "object":
        images.append((images[0][0], "path"))
    return CaptionJob(rows, prompt, tuple(images), phrase)


def image_bytes(manifest: Manifest, row: int, column: str) -> bytes:
    """Return the encoded image that a cell names. Raises UserError, OSError or ValueError."""
    return read_file(
        resolve_path(manifest.files[manifest.source[row]].parent, manifest.value(row, column))
    )


def small_jpeg(data: bytes, name: str, side: int) -> bytes:
    """Return an encoded image as JPEG with no side longer than `side`.

    Raises ImageError (a UserError).
    """
    pixels = decode_bytes(data, name)
    pixels = scale_image(pixels, side) if max(pixels.shape[:2]) > side else pixels
    return encode(pixels, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 90)


def attach_text(
    manifest: Manifest,
    captions: str | Path,
    *,
    key: str | None = None,
    text: str = "text",
    overwrite: bool = False,
) -> tuple[Manifest, list[str]]:
    """Add captions from a table (.csv or .parquet) with a key column and the column `text`; also
    return notes.

    Raises UserError for a table that lacks a column, has different captions for a key, or matches
    no row.

    Args:
        manifest: the frames.
        captions: the table.
        key: a column of both, by default the one other column of the table.
        text: the table's column of captions.
        overwrite: also rows that have a caption, which keep theirs otherwise.
    """
    path = Path(captions).expanduser()
    caption_of, key = _read_captions(path, key, text)
    keys = _text_of(manifest.column(key), f"{manifest.files[0]}: the key {key!r}")
    at = pc.index_in(keys, value_set=pa.array(list(caption_of), pa.string())).combine_chunks()
    new = pa.chunked_array([pa.array(list(caption_of.values()), pa.string()).take(at)])
    old = manifest.column("text")
    matched = len(at) - at.null_count
    if not matched:
        raise UserError(
            f"{path}: no key {key!r} of it is in the manifest; its first one is "
            f"{shown(next(iter(caption_of), None))}; name the right column with --key"
        )
    kept = 0 if overwrite else pc.sum(pc.and_(pc.is_valid(new), pc.is_valid(old))).as_py()
    unused = len(caption_of) - len(at.drop_null().unique())
    notes = [f"{matched - kept} rows got a caption by {key!r}"]
    notes += [f"{kept} rows already had a caption"] if kept else []
    notes += (
        [f"{unused} of {len(caption_of)} keys of {path.name} are not in the manifest"]
        if unused
        else []
    )
    return replace_column(
        manifest, "text", pc.coalesce(new, old) if overwrite else pc.coalesce(old, new)
    ), notes


def _read_captions(path: Path, key: str | None, text: str) -> tuple[dict[str, str], str]:
    """Return the captions of a table by key, and the name of its key column."""
    suffix = schema.table_suffix(path, "a table of captions")
    with schema.reading(path):
        table = (
            schema.read_text_csv(path)
            if suffix == ".csv"
            else pa.parquet.read_table(path, partitioning=None)
        )
        table.validate(full=True)
    names = table.column_names
    others = [name for name in names if name != text]
    if key is None and len(others) > 1 and text in names:
        raise UserError(f"{path} has the columns {listed(names)}: name the key column")
    key = key or next(iter(others), text)
    for name in (text, key):
        if names.count(name) != 1 or key == text:
            fault = "twice the" if name in names else "no"
            raise UserError(f"{path} has {fault} column {name!r}; it has {listed(names)}")
    keys = _text_of(table[key], f"{path}: {key!r}")
    texts = _text_of(table[text], f"{path}: {text!r}")
    place = partial(schema.place_of, path)
    captions: dict[str, str] = {}
    for row, (name, caption) in enumerate(zip(keys.to_pylist(), texts.to_pylist(), strict=True)):
        caption = " ".join((caption or "").split())
        if name is None and caption:
            raise UserError(f"{place(row)}: a caption without {key}; fill it in")
        if name is not None and caption and captions.setdefault(name, caption) != caption:
            raise UserError(
                f"{place(row)}: {key} {shown(name)} has another caption in an earlier row; keep one"
            )
    return captions, key


def _text_of(column: pa.ChunkedArray, name: str) -> pa.ChunkedArray:
    try:
        return schema.clean_text(column.cast(pa.string()))
    except pa.ArrowException:
        raise UserError(f"{name} must be a plain column, is {column.type}") from None
