"""Manifest checks: missing, damaged and duplicate files, split leaks, swapped folders, licences, in one report.

Some copies of a dataset (TVL among them) hold touch images where the photographs should be. Touch images of one sensor
look alike and photographs do not, so colours raise a suspicion. A background image of the sensor confirms it: images
that resemble it are touch images.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.manifest.manifest import Manifest, group_rows, misspelt_sensors
from anytouch_jax.data.manifest.schema import NUMBER, SPLITS, listed, shown, spellings
from anytouch_jax.data.prepare.licences import NO, YES, Licence, commercial_use, licences
from anytouch_jax.data.prepare.scan import (
    BORDER,
    BOTTOM,
    CHROMA,
    EXAMPLES,
    FIELDS,
    NOISE,
    OK,
    SPREAD,
    STATES,
    Finding,
    Level,
    Scan,
    finding,
    scan,
)
from anytouch_jax.data.transforms import FORM
from anytouch_jax.shown import shown_short

_SHARES = ("image_path", "text", "touch", "object", "background_path", "license")
_LISTED = 1000  # rows of a finding that are written to JSON
_FRAME = ("dataset", "sensor", "unit", "sequence", "frame_index", "split")
_LEARNING = SPLITS[:3]  # the splits that must not share anything: train, val, test
_MIN_PAIRS = 8  # different pairs of images that are needed for an opinion on swapped folders
_WIDER = 1.5  # touch images may spread this much more than photographs before they are suspect
_CERTAIN = 0.95  # share of the rows that must resemble the background images to call a dataset swapped


@shown_short
@dataclass(frozen=True)
class VerifyReport:
    """The result of `verify`. `shares` has, by dataset and column, the share of rows with a value; `labels` counts."""

    rows: int
    files: int
    decoded: bool
    findings: tuple[Finding, ...]
    licences: tuple[Licence, ...]
    shares: dict[str, dict[str, float]]
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
        """Return the report as JSON, with the row numbers and files of the first thousand rows of each finding."""
        names = ("rows", "files", "decoded", "ok", "content_hash", "split_hash", "splits", "labels", "shares")
        report: dict[str, Any] = {name: getattr(self, name) for name in names}
        report["licences"] = [licence._asdict() for licence in self.licences]
        report["findings"] = [
            one._asdict() | {"count": len(one.rows), "rows": one.rows[:_LISTED].tolist()} for one in self.findings
        ]
        return json.dumps(report, indent=1, ensure_ascii=False) + "\n"

    def to_markdown(self) -> str:
        """Return the report as a page to read."""
        decoded = "every image decoded" if self.decoded else "images not decoded"
        splits = ", ".join(f"{name} {count}" for name, count in self.splits.items())
        lines = [
            f"{self.rows} rows, {self.files} files ({decoded})", "",
            f"content {self.content_hash[:16]}, splits {self.split_hash[:16]}: {splits}", "",
        ]  # fmt: skip
        if self.labels:
            lines += [f"values of labels: {', '.join(f'{name} {count}' for name, count in self.labels.items())}", ""]
        for one in self.findings:
            lines += [f"* **{one.level}** `{one.kind}`: {one.sentence}", *(f"  * {text}" for text in one.examples)]
            lines += ["  * and more: `--out` names the files"] * (0 < len(one.examples) < len(one.files))
        lines += ["" if self.findings else "No fault was found.\n"]
        lines += _table("dataset", *_SHARES)
        for name, share in self.shares.items():
            lines += _row(name, *(f"{share[column]:.0%}" for column in _SHARES))
        lines += ["", *_table("licence", "commercial", "rows", "datasets")]
        for licence in self.licences:
            use = {YES: "yes", NO: "no"}.get(licence.commercial, "unknown")
            lines += _row(licence.name or "-", use, licence.rows, listed(licence.datasets))
        return "\n".join(lines) + "\n"


def _row(*cells: object) -> list[str]:
    return [f"| {' | '.join(str(cell)[:200] for cell in cells)} |"]


def _table(*names: str) -> list[str]:
    return [*_row(*names), "|---" * len(names) + "|"]


def verify(manifest: Manifest, *, decode: bool = True, objects: bool = False, threads: int = 4) -> VerifyReport:
    """Check a manifest and every file that it names.

    `decode` reads every file and decodes every image completely. Without it, files must only exist and not be empty.
    With `objects`, an object in two learning splits is an error. The manifest is not changed (see `repair`).
    """
    scanned = scan(manifest, decode=decode, threads=threads)
    findings = [
        *(fault for check in _FILE_CHECKS for fault in check(manifest, scanned)),
        *row_faults(manifest, objects=objects),
        *(Finding("unknown_sensor", *fault, (), "sensor") for fault in misspelt_sensors(manifest)),
    ]
    levels = ("error", "warning", "info")
    counts = {entry["values"]: entry["counts"] for entry in pc.value_counts(manifest.table["split"]).to_pylist()}
    return VerifyReport(
        rows=len(manifest),
        files=len(scanned.files),
        decoded=decode,
        findings=tuple(sorted(map(partial(_with_files, manifest), findings), key=lambda one: levels.index(one.level))),
        licences=licences(manifest),
        shares=_shares(manifest),
        splits={name: counts[name] for name in SPLITS if name in counts},
        labels={
            name: int(manifest.present(name).sum()) for name in manifest.table.column_names if name.startswith("label.")
        },
        split_hash=split_hash(manifest),
        content_hash=manifest.content_hash,
        scan=scanned,
    )


def _with_files(manifest: Manifest, one: Finding) -> Finding:
    """Return a finding with the files of its first rows, if it is about a column of files."""
    column = one.column or ""
    rows = one.rows[:_LISTED] if column.endswith("path") and column in manifest.table.column_names else ()
    return one._replace(files=tuple(manifest.value(row, column) for row in rows))


def row_faults(manifest: Manifest, *, objects: bool = False) -> Iterator[Finding]:
    """Yield the faults that need no file: leaks between splits, frame order, licence conflicts, spellings."""
    yield from _split_leaks(manifest, objects)
    yield from _frame_order(manifest)
    marked = np.asarray(pc.fill_null(manifest.column("commercial"), False))
    rows, words = np.flatnonzero(marked & (commercial_use(manifest) == NO)), "rows are commercial, their licence is not"
    yield from finding(manifest, "licence_conflict", "warning", rows, words, "license", column="commercial")
    yield from _label_spellings(manifest)


def _shares(manifest: Manifest) -> dict[str, dict[str, float]]:
    present = {name: manifest.present(name) for name in _SHARES}
    return {
        str(manifest.value(rows[0], "dataset") or "-"): {name: float(has[rows].mean()) for name, has in present.items()}
        for rows in manifest.groups("dataset")
    }


def split_hash(manifest: Manifest) -> str:
    """Return the SHA-256 of which frame is in which split.

    A frame is (dataset, sensor, unit, sequence, frame_index). The order of rows and the paths do not matter.
    """
    table = manifest.table
    nulls = pa.nulls(table.num_rows, pa.string())
    columns = [table[name].cast(pa.string()) if name in table.column_names else nulls for name in _FRAME]
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
            for fault in finding(manifest, state, "error", rows, f"rows whose {column} is {state}", column):
                reasons = [scanned.reasons.get(int(code[row]), state) for row in rows[:EXAMPLES]]
                yield fault._replace(examples=tuple(map("{}: {}".format, fault.examples, reasons)))


def _wrong_sizes(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield touch images of another size than most of their dataset, sensor and unit, or than their sequence."""
    size = scanned.size[scanned.files.code["path"]]
    rows, usual = np.flatnonzero(size[:, 0] > 0), size.copy()
    unit = np.stack([manifest.codes(name)[rows] for name in ("dataset", "sensor", "unit")], 1)
    for keys in (manifest.codes("sequence", own=True)[rows], unit):  # the unit counts where both differ
        for group in group_rows(rows, keys):
            sizes, counts = np.unique(size[group], axis=0, return_counts=True)
            main = sizes[counts.argmax()]
            odd = group[(size[group] != main).any(axis=1)]
            usual[odd] = main
    rows = np.flatnonzero((usual != size).any(axis=1))
    words = "touch images of another size than most of their dataset, sensor and unit, or sequence"
    for fault in finding(manifest, "wrong_size", "warning", rows, words, "path"):
        reasons = (f" is {w} x {h}, where most of its sensor or sequence are {u} x {v}"
                 for (w, h), (u, v) in zip(size[rows], usual[rows], strict=True))  # fmt: skip
        yield fault._replace(examples=tuple(map("".join, zip(fault.examples, reasons, strict=False))))


def content_ids(scanned: Scan, column: str = "path") -> np.ndarray:
    """Return equal numbers i64 (rows,) for equal bytes, -1 for null. A file without a hash goes by its path."""
    code, count = scanned.files.code[column], len(scanned.digest)
    names = np.where(scanned.digest == b"", np.arange(count).astype("S32"), scanned.digest)
    return np.where(code < 0, -1, np.unique(names, return_inverse=True)[1][code])


def repeated_rows(manifest: Manifest, same: np.ndarray) -> np.ndarray:
    """Return the rows i64 that repeat an earlier one: equal bytes of the touch image, and equal other columns."""
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
    return (column if binary else column.cast(pa.string())).combine_chunks().dictionary_encode().indices


def _background_forms(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield rows whose background has other proportions than the frame: encoders refuse them."""
    frame, background = scanned.files.code["path"], scanned.files.code.get("background_path")
    if background is None:
        return
    rows = np.flatnonzero((frame >= 0) & (background >= 0))
    rows = rows[scanned.decoded[frame[rows]] & scanned.decoded[background[rows]]]
    sizes = scanned.size[frame[rows]].astype(float), scanned.size[background[rows]].astype(float)
    scale = sizes[1].max(1) / sizes[0].max(1)
    odd = rows[np.abs(sizes[0] * scale[:, None] - sizes[1]).max(1) > sizes[1].max(1) / FORM]
    words = "rows whose background_path has other proportions than the frame: it is turned or cropped"
    columns = "path", "background_path"
    yield from finding(manifest, "background_form", "error", odd, words, *columns, column="background_path")


def _duplicates(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield touch images that occur more than once, and touch images that are also the row's photograph."""
    same = content_ids(scanned)
    repeats = repeated_rows(manifest, same)
    words = "rows repeat an earlier row, touch image and all"
    yield from finding(manifest, "repeated_row", "warning", repeats, words, "path", column="")
    yield from _leak(manifest, same, "leak_file", "error", "touch image", "path")
    first = np.ones(len(same), bool)
    first[repeats] = False
    rows = np.flatnonzero(first & (np.bincount(same, weights=first)[same] > 1))
    yield from finding(manifest, "duplicate", "warning", rows, "rows share the bytes of their touch image", "path")
    if "image_path" in scanned.files.code:
        rows = np.flatnonzero(same == content_ids(scanned, "image_path"))
        words = "rows whose touch image and photograph are the same"
        yield from finding(manifest, "touch_is_picture", "error", rows, words, "path", column="image_path")


def _leak(manifest: Manifest, codes: np.ndarray, kind: str, level: Level, what: str, column: str) -> Iterator[Finding]:
    """Yield values (codes i64, -1 for null) that occur in two of the learning splits. Examples show `column`."""
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
        sides = ", ".join(SPLITS[side] for side in np.unique(split[rows[codes[rows] == codes[row]]]))
        examples.append(f"{what} {shown(manifest.value(row, column))} is in {sides}")
    sentence = f"{len(first)} values of {what} are in more than one of {', '.join(_LEARNING)} ({rows.size} rows)"
    yield Finding(kind, level, sentence, rows, tuple(examples))


def _split_leaks(manifest: Manifest, objects: bool) -> Iterator[Finding]:
    for column in ("sequence", "touch", "grasp_group", "object"):
        if column in manifest.table.column_names:
            level: Level = "info" if column == "object" and not objects else "error"
            codes = manifest.codes(column, own=column != "object")
            yield from _leak(manifest, codes, f"leak_{column}", level, column, column)


def _frame_order(manifest: Manifest) -> Iterator[Finding]:
    """Yield sequences that repeat a frame, which allows no clips, or whose rows are not in frame order."""
    sequence = manifest.codes("sequence", own=True) * len(SPLITS) + manifest.codes("split")
    frame = np.asarray(manifest.table["frame_index"])
    by_frame, by_row = np.lexsort((frame, sequence)), np.argsort(sequence, kind="stable")
    twice = (np.diff(sequence[by_frame]) == 0) & (np.diff(frame[by_frame]) == 0)
    back = (np.diff(sequence[by_row]) == 0) & (frame[by_row][1:] < frame[by_row][:-1])
    faults: tuple[tuple[str, Level, np.ndarray, str], ...] = (
        ("repeated_frame", "error", by_frame[1:][twice], "repeat a frame of their sequence, which allows no clips"),
        ("frame_order", "warning", by_row[1:][back], "stand after a later frame of their sequence"),
    )
    for kind, level, rows, words in faults:
        yield from finding(manifest, kind, level, np.sort(rows), f"rows {words}", "frame_index", "sequence")


def _label_spellings(manifest: Manifest) -> Iterator[Finding]:
    """Yield label values, objects and units that differ by spaces, letter case or Unicode form only.

    Yield labels too of which most are numbers and some are words, and those that are lists.
    """
    for name in manifest.table.column_names:
        column = manifest.table[name]
        if name.startswith("label.") and pa.types.is_nested(column.type):
            words = f"values of {name} are lists, which no probe reads; write a column for each number"
            yield from finding(manifest, "list_label", "warning", np.flatnonzero(manifest.present(name)), words, name)
        if not pa.types.is_string(column.type) or not (name in ("object", "unit") or name.startswith("label.")):
            continue
        for group in spellings(column.unique().drop_null().to_pylist()):
            rows = [np.flatnonzero(np.asarray(pc.fill_null(pc.equal(column, value), False))) for value in group]
            several = " and ".join(f"{shown(value)} ({len(ids)} rows)" for value, ids in zip(group, rows, strict=True))
            sentence = f"{name} has {several}, which differ only by spaces, letter case or Unicode form"
            places = [f"{manifest.where(ids[0])}: {shown(value)}" for value, ids in zip(group, rows, strict=True)]
            every = np.sort(np.concatenate(rows))
            yield Finding("spelling", "warning", sentence, every, tuple(places[:EXAMPLES]), name)
        is_number = np.asarray(pc.fill_null(pc.match_substring_regex(column, NUMBER), False))
        odd = np.flatnonzero(manifest.present(name) & ~is_number)
        if name.startswith("label.") and is_number.sum() > len(odd):
            words = f"values of {name} are words among numbers"
            yield from finding(manifest, "words_among_numbers", "warning", odd, words, name)


class SwapVerdict(NamedTuple):
    """A dataset with its rows that have both images, those that look swapped, whether all do, and whether a background
    image confirms it."""

    dataset: str | None
    rows: np.ndarray
    swapped: np.ndarray
    whole: bool
    confirmed: bool


def swap_verdicts(manifest: Manifest, scanned: Scan) -> list[SwapVerdict]:
    """Return a verdict for every dataset and sensor with rows that look swapped."""
    code = scanned.files.code
    if "image_path" not in code or not scanned.colours.any():
        return []
    touch, vision = code["path"], code["image_path"]
    background = np.asarray(pc.equal(manifest.table["split"], "background"))
    usable = np.flatnonzero((vision >= 0) & scanned.decoded[touch] & scanned.decoded[vision] & ~background)
    source = np.stack([manifest.codes("dataset"), manifest.codes("sensor")], 1)
    result = []
    for rows in group_rows(usable, source[usable]):
        if len(np.unique(np.stack([touch[rows], vision[rows]], 1), axis=0)) < _MIN_PAIRS:
            continue
        others = np.flatnonzero(background & (vision < 0) & (source == source[rows[0]]).all(axis=1))
        backgrounds = _background_colours(manifest, scanned, others, rows)
        swapped, whole = _judge_swap(scanned.colours, rows, touch[rows], vision[rows], backgrounds)
        if swapped.size:
            dataset = manifest.value(rows[0], "dataset")
            result.append(SwapVerdict(dataset, rows, swapped, whole, bool(len(backgrounds))))
    return result


def in_touch_folder(manifest: Manifest, column: str) -> np.ndarray:
    """Return which rows name a file in `column` that lies in the folder of their touch image, bool (rows,)."""
    folders = [pc.replace_substring_regex(manifest.column(name), r"[^/]*$", "") for name in (column, "path")]
    return np.asarray(pc.fill_null(pc.equal(*folders), False))


def _background_colours(manifest: Manifest, scanned: Scan, others: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the colours f32 (k, 48) of the sensor's background images, k = 0 if it has none.

    They are those of `others`, background rows without a photograph, which could be swapped too, and of `rows`, but for
    a `background_path` in the folder of the touch images.
    """
    code = scanned.files.code
    files = [code["path"][others]]
    if "background_path" in code:
        files.append(code["background_path"][rows[~in_touch_folder(manifest, "background_path")[rows]]])
    # A background that is also a photograph would confirm anything.
    ids = np.setdiff1d(np.concatenate(files), [-1, *np.unique(code["image_path"])])
    return scanned.colours[ids[scanned.decoded[ids]][:64]].astype(np.float32)


def _judge_swap(
    colours: np.ndarray, rows: np.ndarray, touch: np.ndarray, vision: np.ndarray, backgrounds: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Return the rows that look swapped, and whether the whole dataset does; `touch` and `vision` are their files."""
    if len(backgrounds):
        bad = _distance(colours[vision], backgrounds) < _distance(colours[touch], backgrounds)
        whole = bool(bad.mean() >= _CERTAIN)
        return rows if whole else rows[bad], whole
    each = [colours[np.unique(files)] for files in (touch, vision)]  # one photograph may serve many rows
    centre, other = (np.median(part, axis=0)[None] for part in each)
    spreads = [
        float(np.median(_distance(part, middle))) if len(part) >= _MIN_PAIRS else 0.0
        for part, middle in zip(each, (centre, other), strict=True)
    ]
    if spreads[1] and spreads[0] > _WIDER * spreads[1]:
        return rows, True
    far, near = _distance(colours[touch], centre), _distance(colours[vision], centre)
    return rows[(far > 3 * max(spreads[0], 1.0)) & (near < far / 2)], False


def _distance(colours: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the mean absolute difference f32 (n,) of colours u8 (n, 48) to the nearest of centres (k, 48)."""
    return np.min([np.abs(colours.astype(np.float32) - centre).mean(axis=1) for centre in centres], axis=0)


def _swapped(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    for verdict in swap_verdicts(manifest, scanned):
        name = f"dataset {shown(verdict.dataset)}" if verdict.dataset else "the rows without a dataset"
        reason = "the background frames show it" if verdict.confirmed else "suspected from the colours; look at some"
        what = "all touch images and photographs are" if verdict.whole else f"{verdict.swapped.size} rows are"
        kind = "swapped" if verdict.whole else "swapped_rows"
        level: Level = "error" if verdict.confirmed else "warning"
        for fault in finding(manifest, kind, level, verdict.swapped, "", "path", "image_path", column="image_path"):
            yield fault._replace(sentence=f"{name}: {what} swapped ({reason})")


# Pictures that decode but cannot be right: of one colour, cut, noise, repeated, turned, or unlike their recording.
# Cameras, disks and scripts leave them behind. A picture is judged alone, or by the other frames of its sequence.
_FEWEST = 5  # frames of a sequence that show what is usual in it
_NARROW = 14  # bits of 16: more may be all that a dark picture uses
_FROZEN = 3  # equal pictures in a row: cameras have noise
_LAGS = (2, 3, 4)  # pictures of so many sensors may take turns in a sequence
_ALONE = (
    ("flat", "of one colour"),
    ("cut", "of one colour from some row to the bottom, as a file is that was cut"),
    ("border", "with a black border"),
    ("noise", "of noise only"),
)
_IN_SEQUENCE = (
    ("frozen", f"equal to the frames before ({_FROZEN} or more in a row)"),
    ("alternating", "in sequences that jump between the pictures of several sensors"),
    ("grey", "grey where their sequence is coloured"),
    ("dark", "much darker than their sequence"),
    ("inverted", "with inverted brightness for their sequence"),
    ("channels", "with red and blue exchanged for their sequence"),
    ("turned", "rotated or mirrored for their sequence"),
)


def picture_faults(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield the kinds of pictures that cannot be right."""
    looks, narrow = scanned.looks, np.zeros(len(scanned.bits), bool)
    source = np.stack([manifest.codes("dataset"), manifest.codes("sensor")], 1)
    for column, code in scanned.files.code.items():
        rows = np.flatnonzero((code >= 0) & (scanned.bits[code] > 0))
        for group in group_rows(rows, source[rows]):
            files = code[group]
            if (bits := int(scanned.bits[files].max())) <= _NARROW:
                narrow[files] = True
                scaled = f"cv2.imread(file, cv2.IMREAD_UNCHANGED) * {2 ** (16 - bits)}"
                words = f"rows whose {column} has values that use {bits} of 16 bits, and looks black. Scale it: "
                words += f"cv2.imwrite(file, {scaled})"
                yield from finding(manifest, "bits", "warning", group, words, column)
    flat = (looks[:, SPREAD] < 1) & ~narrow
    alone = {
        "flat": flat, "cut": looks[:, BOTTOM] > 0.1, "border": looks[:, BORDER] > 0.03, "noise": looks[:, NOISE] > 0.6
    }  # fmt: skip
    alone = {kind: wrong & ~narrow & (~flat | (kind == "flat")) for kind, wrong in alone.items()}
    for column, code in scanned.files.code.items():
        for kind, words in _ALONE:
            rows = np.flatnonzero((code >= 0) & (scanned.decoded & alone[kind])[code])
            yield from finding(manifest, kind, "warning", rows, f"rows whose {column} is {words}", column)
    files, frame = scanned.files.code["path"], np.asarray(manifest.table["frame_index"])
    faults: dict[str, list[np.ndarray]] = {kind: [] for kind, _ in _IN_SEQUENCE}
    rows = np.flatnonzero((scanned.decoded & ~np.any([*alone.values()], axis=0))[files])
    for members in group_rows(rows, manifest.codes("sequence", own=True)[rows], frame[rows]):
        for kind, wrong in _faults_of_sequence(scanned, files[members]).items():
            faults[kind].append(members[wrong])
    for kind, words in _IN_SEQUENCE:
        rows = np.sort(np.concatenate([np.empty(0, np.int64), *faults[kind]]))
        yield from finding(manifest, kind, "warning", rows, f"touch images {words}", "path")


def _faults_of_sequence(scanned: Scan, files: np.ndarray) -> dict[str, np.ndarray]:
    """Return which frames of a sequence have each fault, bool (frames,); `files` are in the order of the frames."""
    pixels = scanned.pixels[files]
    runs = np.split(np.arange(len(files)), np.flatnonzero(np.diff(pixels.astype(np.int64))) + 1)
    frozen = np.zeros(len(files), bool)
    for run in (run for run in runs if len(run) >= _FROZEN):
        frozen[run[1:]] = True
    faults = {"frozen": frozen}
    if len(files) < _FEWEST:
        return faults
    colours = scanned.colours[files].astype(np.float32)
    faults["alternating"] = np.full(len(files), _alternates(colours))
    if faults["alternating"].any():
        return faults
    usual, chroma = np.median(colours, axis=0), scanned.looks[files, CHROMA]
    faults["grey"] = (chroma < 1.5) & (np.median(chroma) > 6)
    faults["dark"] = (colours.mean(axis=1) < usual.mean() / 4) & (usual.mean() > 20)
    away = np.abs(colours - usual).mean(axis=1)
    spread = float(np.median(away))
    for at in np.flatnonzero((away > max(6.0, 3 * spread)) & ~faults["grey"] & ~faults["dark"]):
        kind, near = min(
            ((kind, float(np.abs(other - usual).mean())) for kind, other in _variants(colours[at])), key=lambda p: p[1]
        )
        if near < min(away[at] / 3, max(3.0, 2 * spread)):
            faults.setdefault(kind, np.zeros(len(files), bool))[at] = True
    return faults


def _alternates(colours: np.ndarray) -> bool:
    """Return whether neighbours differ much more than frames further apart, for colours f32 (frames, 48)."""
    if len(colours) < 2 * _FEWEST - 2:
        return False
    step = np.median(np.abs(np.diff(colours, axis=0)).mean(axis=1))
    return step > 2 and any(
        len(colours) >= 3 * lag and 4 * np.median(np.abs(colours[lag:] - colours[:-lag]).mean(axis=1)) < step
        for lag in _LAGS
    )


def _variants(colours: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the colours f32 (48,) of a picture as they were before each fault, with its kind."""
    fields = colours.reshape(FIELDS, FIELDS, 3)
    yield "inverted", 255 - colours
    yield "channels", fields[..., ::-1].ravel()
    for turns, mirror in itertools.product(range(4), (False, True)):
        if turns or mirror:
            yield "turned", np.rot90(fields[:, ::-1] if mirror else fields, turns).ravel()


_FILE_CHECKS = (_bad_files, _wrong_sizes, _background_forms, _duplicates, _swapped, picture_faults)
