"""Manifest checks and repairs: bad and duplicate files, split leaks, swapped folders, licences.

`verify` reports, and `repair` mends in a copy what needs no guess.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.manifest.manifest import (
    Manifest,
    group_rows,
    misspelt_sensors,
    replace_column,
    select_rows,
)
from anytouch_jax.data.manifest.schema import NUMBER, SPLITS, listed, shown, spellings
from anytouch_jax.data.transforms import FORM
from anytouch_jax.datasets import scan as scans
from anytouch_jax.datasets.scan import EXAMPLES, OK, STATES, Finding, Level, Scan, finding
from anytouch_jax.errors import UserError
from anytouch_jax.shown import shown_short

_FRACTIONS = ("image_path", "text", "touch", "object", "background_path", "license")
_LISTED = 1000  # rows of a finding that are written to JSON
_FRAME = ("dataset", "sensor", "unit", "sequence", "frame_index", "split")
_LEARNING = SPLITS[:3]  # the splits that must not share anything: train, val, test


YES = 1
NO = 0
UNKNOWN = -1
_NO = re.compile(
    r"\bnc\b|non-?\s?commercial|(research|academic|educational)[\s-]+(use[\s-]+)?only",
    re.IGNORECASE,
)
_YES = re.compile(
    r"(mit|apache([\s-]2(\.0)?)?|bsd([\s-][0-9]-clause)?|isc|cc0([\s-]1\.0)?|cc[\s-]by([\s-]sa)?([\s-][0-9]\.[0-9])?|"
    r"public[\s-]domain|unlicense)(\s+licen[cs]e)?",
    re.IGNORECASE,
)


class Licence(NamedTuple):
    """Rows under one licence: its name or None, YES, NO or UNKNOWN, the datasets, the number of
    rows.
    """

    name: str | None
    commercial: int
    datasets: tuple[str, ...]
    rows: int


class Commercial(NamedTuple):
    """The rows that may be used commercially, and the numbers of rows left out."""

    manifest: Manifest
    non_commercial: int
    unknown: int


@shown_short
@dataclass(frozen=True)
class VerifyReport:
    """The result of `verify`.

    `fractions` has, by dataset and column, the fraction of rows with a value; `labels` counts.
    """

    rows: int
    files: int
    decoded: bool
    findings: tuple[Finding, ...]
    licences: tuple[Licence, ...]
    fractions: dict[str, dict[str, float]]
    splits: dict[str, int]
    labels: dict[str, int]
    split_hash: str
    content_hash: str
    scan: Scan

    @property
    def ok(self) -> bool:
        """Whether there is no error. Warnings are allowed."""
        return not any(finding.level == "error" for finding in self.findings)

    def to_json(self) -> str:
        """Return the report as JSON, with the row numbers and files of the first thousand rows of
        each finding.
        """
        names = (
            "rows",
            "files",
            "decoded",
            "ok",
            "content_hash",
            "split_hash",
            "splits",
            "labels",
            "fractions",
        )
        report: dict[str, Any] = {name: getattr(self, name) for name in names}
        report["licences"] = [licence._asdict() for licence in self.licences]
        report["findings"] = [
            one._asdict() | {"count": len(one.rows), "rows": one.rows[:_LISTED].tolist()}
            for one in self.findings
        ]
        return json.dumps(report, indent=1, ensure_ascii=False) + "\n"

    def to_markdown(self) -> str:
        """Return the report as a page to read."""
        decoded = "every image decoded" if self.decoded else "images not decoded"
        splits = ", ".join(f"{name} {count}" for name, count in self.splits.items())
        lines = [
            f"{self.rows} rows, {self.files} files ({decoded})",
            "",
            f"content {self.content_hash[:16]}, splits {self.split_hash[:16]}: {splits}",
            "",
        ]
        if self.labels:
            lines += [
                "values of labels: "
                f"{', '.join(f'{name} {count}' for name, count in self.labels.items())}",
                "",
            ]
        for one in self.findings:
            lines += [
                f"* **{one.level}** `{one.kind}`: {one.sentence}",
                *(f"  * {text}" for text in one.examples),
            ]
            lines += ["  * and more: `--out` names the files"] * (
                0 < len(one.examples) < len(one.files)
            )
        lines += ["" if self.findings else "No fault was found.\n"]
        lines += _table("dataset", *_FRACTIONS)
        for name, fraction in self.fractions.items():
            lines += _row(name, *(f"{fraction[column]:.0%}" for column in _FRACTIONS))
        lines += ["", *_table("licence", "commercial", "rows", "datasets")]
        for licence in self.licences:
            use = {YES: "yes", NO: "no"}.get(licence.commercial, "unknown")
            lines += _row(licence.name or "-", use, licence.rows, listed(licence.datasets))
        return "\n".join(lines) + "\n"


def _row(*cells: object) -> list[str]:
    return [f"| {' | '.join(str(cell)[:200] for cell in cells)} |"]


def _table(*names: str) -> list[str]:
    return [*_row(*names), "|---" * len(names) + "|"]


def verify(
    manifest: Manifest, *, decode: bool = True, objects: bool = False, threads: int = 4
) -> VerifyReport:
    """Check a manifest and every file that it names.

    Args:
        manifest: the frames.
        decode: read every image; otherwise files must only exist and not be empty.
        objects: an object in two learning splits is an error.
        threads: that read files.
    """
    scanned = scans.scan(manifest, decode=decode, threads=threads)
    findings = [
        *(fault for check in _FILE_CHECKS for fault in check(manifest, scanned)),
        *row_faults(manifest, objects=objects),
        *(Finding("unknown_sensor", *fault, (), "sensor") for fault in misspelt_sensors(manifest)),
    ]
    levels = ("error", "warning", "info")
    findings = sorted(
        map(partial(_with_files, manifest), findings), key=lambda one: levels.index(one.level)
    )
    counts = {
        entry["values"]: entry["counts"]
        for entry in pc.value_counts(manifest.table["split"]).to_pylist()
    }
    splits = {name: counts[name] for name in SPLITS if name in counts}
    present = {name: manifest.present(name) for name in _FRACTIONS}
    fractions = {
        str(manifest.value(rows[0], "dataset") or "-"): {
            name: float(has[rows].mean()) for name, has in present.items()
        }
        for rows in manifest.groups("dataset")
    }
    names = (name for name in manifest.table.column_names if name.startswith("label."))
    labels = {name: int(manifest.present(name).sum()) for name in names}
    return VerifyReport(
        len(manifest),
        len(scanned.files),
        decode,
        tuple(findings),
        licences(manifest),
        fractions,
        splits,
        labels,
        split_hash(manifest),
        manifest.content_hash,
        scanned,
    )


def _with_files(manifest: Manifest, one: Finding) -> Finding:
    """Return a finding with the files of its first rows, if it is about a column of files."""
    column = one.column or ""
    rows = (
        one.rows[:_LISTED]
        if column.endswith("path") and column in manifest.table.column_names
        else ()
    )
    return one._replace(files=tuple(manifest.value(row, column) for row in rows))


def row_faults(manifest: Manifest, *, objects: bool = False) -> Iterator[Finding]:
    """Yield the faults that need no file: leaks between splits, frame order, licence conflicts,
    spellings.
    """
    for column in ("sequence", "touch", "grasp_group", "object"):
        if column in manifest.table.column_names:
            level: Level = "info" if column == "object" and not objects else "error"
            codes = manifest.codes(column, own=column != "object")
            yield from _leak(manifest, codes, f"leak_{column}", level, column, column)
    yield from _frame_order(manifest)
    marked = np.asarray(pc.fill_null(manifest.column("commercial"), False))
    rows = np.flatnonzero(marked & (commercial_use(manifest) == NO))
    words = "rows are commercial, their licence is not"
    yield from finding(
        manifest, "licence_conflict", "warning", rows, words, "license", column="commercial"
    )
    yield from _label_spellings(manifest)


def split_hash(manifest: Manifest) -> str:
    """Return the SHA-256 of which frame (_FRAME) is in which split, in any order of rows and with
    any paths.
    """
    table = manifest.table
    nulls = pa.nulls(table.num_rows, pa.string())
    columns = [
        table[name].cast(pa.string()) if name in table.column_names else nulls for name in _FRAME
    ]
    # A tag before the value distinguishes a null from an empty text.
    parts = [pc.fill_null(pc.binary_join_element_wise("=", column, ""), "-") for column in columns]
    digest = hashlib.sha256()
    for line in sorted(pc.binary_join_element_wise(*parts, "\x1f").to_pylist()):
        digest.update(line.encode() + b"\n")
    return digest.hexdigest()


def _bad_files(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield files that are missing, outside of the folder, empty, cut short, or unreadable."""
    for column, code in scanned.files.code.items():
        states = scanned.states(column)
        for number, state in enumerate(STATES):
            rows = np.flatnonzero(states == number) if number != OK else np.empty(0, np.int64)
            for fault in finding(
                manifest, state, "error", rows, f"rows whose {column} is {state}", column
            ):
                reasons = [scanned.reasons.get(int(code[row]), state) for row in rows[:EXAMPLES]]
                yield fault._replace(examples=tuple(map("{}: {}".format, fault.examples, reasons)))


def _wrong_sizes(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield touch images of another size than most of their dataset, sensor and unit, or than their
    sequence.
    """
    size = scanned.size[scanned.files.code["path"]]
    rows = np.flatnonzero(size[:, 0] > 0)
    usual = size.copy()
    unit = np.stack([manifest.codes(name)[rows] for name in ("dataset", "sensor", "unit")], 1)
    # the unit counts where both differ
    for keys in (manifest.codes("sequence", own=True)[rows], unit):
        for group in group_rows(rows, keys):
            sizes, counts = np.unique(size[group], axis=0, return_counts=True)
            main = sizes[counts.argmax()]
            odd = group[(size[group] != main).any(axis=1)]
            usual[odd] = main
    rows = np.flatnonzero((usual != size).any(axis=1))
    words = "touch images of another size than most of their dataset, sensor and unit, or sequence"
    for fault in finding(manifest, "wrong_size", "warning", rows, words, "path"):
        reasons = (
            f" is {w} x {h}, where most of its sensor or sequence are {u} x {v}"
            for (w, h), (u, v) in zip(size[rows], usual[rows], strict=True)
        )
        yield fault._replace(
            examples=tuple(map("".join, zip(fault.examples, reasons, strict=False)))
        )


def content_ids(scanned: Scan, column: str = "path") -> np.ndarray:
    """Return equal numbers i64 (rows,) for equal bytes, -1 for null.

    A file without a hash goes by its path.
    """
    code = scanned.files.code[column]
    count = len(scanned.digest)
    names = np.where(scanned.digest == b"", np.arange(count).astype("S32"), scanned.digest)
    return np.where(code < 0, -1, np.unique(names, return_inverse=True)[1][code])


def repeated_rows(manifest: Manifest, same: np.ndarray) -> np.ndarray:
    """Return the rows i64 that repeat an earlier one: equal bytes of the touch image, and equal
    other columns.
    """
    _, inverse, counts = np.unique(same, return_inverse=True, return_counts=True)
    rows = np.flatnonzero(counts[inverse] > 1)
    if not rows.size:
        return rows
    table = manifest.table.take(pa.array(rows))
    plain = [c for c in table.column_names if c != "path" and not pa.types.is_nested(table[c].type)]
    parts = [np.asarray(pc.fill_null(_codes(table[name]), -1)) for name in plain]
    key = np.stack([same[rows], manifest.source[rows], *parts], 1)
    _, first = np.unique(key, axis=0, return_index=True)
    return np.delete(rows, first)


def _codes(column: pa.ChunkedArray) -> pa.Array:
    binary = pa.types.is_binary(column.type) or pa.types.is_large_binary(column.type)
    return (
        (column if binary else column.cast(pa.string()))
        .combine_chunks()
        .dictionary_encode()
        .indices
    )


def _background_forms(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield rows whose background has other proportions than the frame: encoders refuse them."""
    frame = scanned.files.code["path"]
    background = scanned.files.code.get("background_path")
    if background is None:
        return
    rows = np.flatnonzero((frame >= 0) & (background >= 0))
    rows = rows[scanned.decoded[frame[rows]] & scanned.decoded[background[rows]]]
    sizes = scanned.size[frame[rows]].astype(float), scanned.size[background[rows]].astype(float)
    scale = sizes[1].max(1) / sizes[0].max(1)
    odd = rows[np.abs(sizes[0] * scale[:, None] - sizes[1]).max(1) > sizes[1].max(1) / FORM]
    words = (
        "rows whose background_path has other proportions than the frame: it is turned or cropped"
    )
    columns = "path", "background_path"
    yield from finding(
        manifest, "background_form", "error", odd, words, *columns, column="background_path"
    )


def _duplicates(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield touch images that occur more than once, and touch images that are also the row's
    RGB image.
    """
    same = content_ids(scanned)
    repeats = repeated_rows(manifest, same)
    words = "rows repeat an earlier row, touch image and all"
    yield from finding(manifest, "repeated_row", "warning", repeats, words, "path", column="")
    yield from _leak(manifest, same, "leak_file", "error", "touch image", "path")
    first = np.ones(len(same), bool)
    first[repeats] = False
    rows = np.flatnonzero(first & (np.bincount(same, weights=first)[same] > 1))
    yield from finding(
        manifest, "duplicate", "warning", rows, "rows share the bytes of their touch image", "path"
    )
    if "image_path" in scanned.files.code:
        rows = np.flatnonzero(same == content_ids(scanned, "image_path"))
        words = "rows whose touch image and RGB image are the same"
        yield from finding(
            manifest, "touch_is_image", "error", rows, words, "path", column="image_path"
        )


def _leak(
    manifest: Manifest, codes: np.ndarray, kind: str, level: Level, what: str, column: str
) -> Iterator[Finding]:
    """Yield values (codes i64, -1 for null) that occur in two of the learning splits.

    Examples show `column`.
    """
    split = np.asarray(pc.index_in(manifest.table["split"], value_set=pa.array(SPLITS)))
    rows = np.flatnonzero((codes >= 0) & (split < len(_LEARNING)))
    value = np.unique(codes[rows], return_inverse=True)[1]
    pairs = np.unique(np.stack([value, split[rows]], 1), axis=0)
    rows = rows[np.bincount(pairs[:, 0])[value] > 1]
    if not rows.size:
        return
    _, first = np.unique(codes[rows], return_index=True)
    examples = []
    for row in rows[np.sort(first)[:EXAMPLES]]:
        sides = ", ".join(
            SPLITS[side] for side in np.unique(split[rows[codes[rows] == codes[row]]])
        )
        examples.append(f"{what} {shown(manifest.value(row, column))} is in {sides}")
    sentence = (
        f"{len(first)} values of {what} are in more than one of {', '.join(_LEARNING)} "
        f"({rows.size} rows)"
    )
    yield Finding(kind, level, sentence, rows, tuple(examples))


def _frame_order(manifest: Manifest) -> Iterator[Finding]:
    """Yield sequences that repeat a frame, which allows no clips, or whose rows are not in frame
    order.
    """
    sequence = manifest.codes("sequence", own=True) * len(SPLITS) + manifest.codes("split")
    frame = np.asarray(manifest.table["frame_index"])
    by_frame = np.lexsort((frame, sequence))
    by_row = np.argsort(sequence, kind="stable")
    twice = (np.diff(sequence[by_frame]) == 0) & (np.diff(frame[by_frame]) == 0)
    back = (np.diff(sequence[by_row]) == 0) & (frame[by_row][1:] < frame[by_row][:-1])
    faults: tuple[tuple[str, Level, np.ndarray, str], ...] = (
        (
            "repeated_frame",
            "error",
            by_frame[1:][twice],
            "repeat a frame of their sequence, which allows no clips",
        ),
        ("frame_order", "warning", by_row[1:][back], "stand after a later frame of their sequence"),
    )
    for kind, level, rows, words in faults:
        yield from finding(
            manifest, kind, level, np.sort(rows), f"rows {words}", "frame_index", "sequence"
        )


def _label_spellings(manifest: Manifest) -> Iterator[Finding]:
    """Yield labels, objects and units in several spellings, labels with words among numbers, and
    lists.
    """
    for name in manifest.table.column_names:
        column = manifest.table[name]
        if name.startswith("label.") and pa.types.is_nested(column.type):
            words = (
                f"values of {name} are lists, which no probe reads; write a column for each number"
            )
            yield from finding(
                manifest,
                "list_label",
                "warning",
                np.flatnonzero(manifest.present(name)),
                words,
                name,
            )
        if not pa.types.is_string(column.type) or not (
            name in ("object", "unit") or name.startswith("label.")
        ):
            continue
        for group in spellings(column.unique().drop_null().to_pylist()):
            rows = [
                np.flatnonzero(np.asarray(pc.fill_null(pc.equal(column, value), False)))
                for value in group
            ]
            several = " and ".join(
                f"{shown(value)} ({len(ids)} rows)" for value, ids in zip(group, rows, strict=True)
            )
            sentence = (
                f"{name} has {several}, which differ only by spaces, letter case or Unicode form"
            )
            places = [
                f"{manifest.where(ids[0])}: {shown(value)}"
                for value, ids in zip(group, rows, strict=True)
            ]
            every = np.sort(np.concatenate(rows))
            yield Finding("spelling", "warning", sentence, every, tuple(places[:EXAMPLES]), name)
        is_number = np.asarray(pc.fill_null(pc.match_substring_regex(column, NUMBER), False))
        odd = np.flatnonzero(manifest.present(name) & ~is_number)
        if name.startswith("label.") and is_number.sum() > len(odd):
            words = f"values of {name} are words among numbers"
            yield from finding(manifest, "words_among_numbers", "warning", odd, words, name)


def allows(licence: str | None) -> int:
    """Return whether a licence with this name allows commercial use: YES, NO or UNKNOWN."""
    if licence is None or not licence.strip():
        return UNKNOWN
    if _NO.search(licence):
        return NO
    if _YES.fullmatch(licence.strip()):
        return YES
    return UNKNOWN


def commercial_use(manifest: Manifest) -> np.ndarray:
    """Return YES, NO or UNKNOWN, i8 (rows,): a NO by flag or licence decides, then the flag, then
    the licence.
    """
    codes = manifest.codes("license")
    names = pc.unique(manifest.column("license")).drop_null().to_pylist()
    # code -1 is the last one
    verdict = np.array([*(allows(name) for name in names), UNKNOWN], np.int8)[codes]
    flag = np.asarray(pc.fill_null(manifest.column("commercial").cast("int8"), UNKNOWN)).astype(
        np.int8
    )
    return np.where((flag == NO) | (verdict == NO), NO, np.where(flag == YES, YES, verdict)).astype(
        np.int8
    )


def commercial_only(manifest: Manifest) -> Commercial:
    """Return the rows that may certainly be used commercially.

    Raises UserError if there is none.
    """
    use = commercial_use(manifest)
    non_commercial = int((use == NO).sum())
    unknown = int((use == UNKNOWN).sum())
    if not (use == YES).any():
        files = ", ".join(map(str, manifest.files))
        raise UserError(
            f"{files}: no row may certainly be used commercially ({non_commercial} may not, "
            f"{unknown} do not say). Fill in the columns 'license' and 'commercial'."
        )
    return Commercial(select_rows(manifest, np.flatnonzero(use == YES)), non_commercial, unknown)


def licences(manifest: Manifest) -> tuple[Licence, ...]:
    """Return the rows under each licence, most rows first."""
    use = commercial_use(manifest).astype(np.int64)
    result = []
    for rows in group_rows(np.arange(len(manifest)), np.stack([manifest.codes("license"), use], 1)):
        datasets = manifest.column("dataset").take(rows).unique().drop_null().to_pylist()
        name = manifest.value(rows[0], "license")
        verdict = int(use[rows[0]])
        result.append(Licence(name, verdict, tuple(sorted(datasets)), len(rows)))
    return tuple(sorted(result, key=lambda licence: -licence.rows))


_FILE_CHECKS = (
    _bad_files,
    _wrong_sizes,
    _background_forms,
    _duplicates,
    scans.swapped_folders,
    scans.image_faults,
)


_OF_ROWS = {f"leak_{name}" for name in ("sequence", "touch", "grasp_group", "object")}
# faults that dropping rows can repair
_OF_ROWS |= {"repeated_frame", "frame_order", "licence_conflict", "spelling"}


class Repaired(NamedTuple):
    """The repaired manifest, a sentence for each repair, and a sentence for each fault that is left
    to the user.
    """

    manifest: Manifest
    done: tuple[str, ...]
    left: tuple[str, ...]


def repair(manifest: Manifest, report: VerifyReport, *, swap: Collection[str] = ()) -> Repaired:
    """Make the repairs that need no guess, based on the `report` of this manifest.

    Rows with an unusable touch image and repeated rows are dropped. An unusable RGB image,
    background or field file becomes null. Touch images and RGB images are exchanged in datasets
    that a background image confirms to be swapped as a whole, and in those named in `swap`. Raises
    UserError if no touch image is usable, and for an unknown name in `swap`.
    """
    scanned = report.scan
    done: list[str] = []
    if report.content_hash != manifest.content_hash:
        raise UserError("the report is of another manifest; verify this one first")
    result, exchanged = _exchange(manifest, report, swap, done)
    usable = np.ones(len(manifest), bool)
    for column in scanned.files.code:
        states = scanned.states(column)
        if column in ("path", "image_path") and exchanged.any():
            other = scanned.states("image_path" if column == "path" else "path")
            states = np.where(exchanged, other, states)
        bad = states != OK
        if not bad.any():
            continue
        counts = ", ".join(
            f"{int((states == n).sum())} {STATES[n]}" for n in np.unique(states[bad])
        )
        if column == "path":
            usable &= ~bad
            done.append(
                f"dropped {int(bad.sum())} rows whose touch image cannot be used ({counts})"
            )
        else:
            result = _empty_cells(result, column, bad)
            done.append(f"emptied {column} in {int(bad.sum())} rows ({counts})")
    if not usable.any():
        folder = manifest.files[0].parent
        raise UserError(
            f"no touch image of {manifest.files[0]} can be used; are the files really in {folder}?"
        )
    repeats = repeated_rows(manifest, content_ids(scanned))
    repeats = repeats[usable[repeats]]
    if repeats.size:
        usable[repeats] = False
        done.append(f"dropped {repeats.size} rows that repeat another, touch image and all")
    result = select_rows(result, np.flatnonzero(usable))
    return Repaired(result, tuple(done), _left(report, result, exchanged))


def check_swap(manifest: Manifest, swap: Collection[str]) -> None:
    """Raise UserError for a dataset to swap that the manifest does not have."""
    names = set(manifest.column("dataset").unique().to_pylist())
    unknown = sorted(set(swap) - names)
    if unknown:
        known = ", ".join(sorted(str(name) for name in names if name)) or "no dataset names"
        raise UserError(f"there is no dataset {unknown[0]!r} to swap; the manifest has {known}")


def _empty_cells(manifest: Manifest, column: str, rows: np.ndarray) -> Manifest:
    cells = manifest.column(column).combine_chunks().to_numpy(False)
    return replace_column(manifest, column, pa.array(np.where(rows, None, cells), pa.string()))


def _exchange(
    manifest: Manifest, report: VerifyReport, swap: Collection[str], done: list[str]
) -> tuple[Manifest, np.ndarray]:
    """Return the manifest with touch image and RGB image exchanged where needed, and which rows
    those are.
    """
    exchanged = np.zeros(len(manifest), bool)
    check_swap(manifest, swap)
    for verdict in scans.swap_verdicts(manifest, report.scan):
        if verdict.whole and verdict.confirmed and verdict.dataset not in swap:
            exchanged[verdict.rows] = True
            exchanged |= _background_rows(manifest, verdict.rows)
            done.append(
                f"exchanged touch image and RGB image in {verdict.rows.size} rows of dataset "
                f"{verdict.dataset!r}: its RGB images resemble the background frames, its touch "
                "images do not"
            )
    if swap:
        dataset = manifest.column("dataset").to_pylist()
        chosen = np.array([name in swap for name in dataset]) & manifest.present("image_path")
        exchanged |= chosen
        rows = int(chosen.sum())
        done.append(
            f"exchanged touch image and RGB image in {rows} rows of {', '.join(sorted(swap))}, as "
            "requested"
        )
    if not exchanged.any():
        return manifest, exchanged
    touch, image = (
        manifest.table[name].combine_chunks().to_numpy(False) for name in ("path", "image_path")
    )
    result = replace_column(
        manifest, "path", pa.array(np.where(exchanged, image, touch), pa.string())
    )
    result = replace_column(
        result, "image_path", pa.array(np.where(exchanged, touch, image), pa.string())
    )
    # its folder now holds RGB images
    rgb_images = exchanged & scans.in_touch_folder(manifest, "background_path")
    if rgb_images.any():
        result = _empty_cells(result, "background_path", rgb_images)
        done.append(
            f"emptied background_path in {int(rgb_images.sum())} of them: it lay among the "
            "RGB images"
        )
    return result, exchanged


def _background_rows(manifest: Manifest, rows: np.ndarray) -> np.ndarray:
    """Return the background rows with an RGB image of the dataset and sensor of `rows`.

    They are swapped too.
    """
    selected = np.asarray(pc.equal(manifest.table["split"], "background")) & manifest.present(
        "image_path"
    )
    for name in ("dataset", "sensor"):
        code = manifest.codes(name)
        selected &= code == code[rows[0]]
    return selected


def _left(report: VerifyReport, result: Manifest, exchanged: np.ndarray) -> tuple[str, ...]:
    """Return the faults that remain after the repair."""
    remaining = {one.kind for one in row_faults(result)}
    left = []
    for one in report.findings:
        repaired = one.kind in {*STATES, "repeated_row"}
        repaired |= one.kind in _OF_ROWS and one.kind not in remaining
        repaired |= one.kind == "swapped" and bool(exchanged[one.rows].any())
        if one.level != "info" and not repaired:
            left.append(one.sentence)
    return tuple(left)
