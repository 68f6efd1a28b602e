"""Manifest checks: missing, damaged and duplicate files, split leaks, swapped folders, licences, in one report.

Some copies of a dataset (TVL among them) hold touch images where the photographs should be. Touch images of one sensor
look alike and photographs do not, so colours raise a suspicion. A background image of the sensor confirms it: images
that resemble it are touch images.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.manifest.manifest import Manifest, misspelt_sensors
from anytouch_jax.data.manifest.schema import SPLITS, spellings
from anytouch_jax.data.prepare.appearance import picture_faults
from anytouch_jax.data.prepare.licences import NO, YES, Licence, commercial_use, licences
from anytouch_jax.data.prepare.scan import OK, STATES, Scan, scan

_SHARES = ("image_path", "text", "touch", "object", "background_path", "license")
_JSON_ROWS = 1000  # row numbers of a finding that are written to JSON
_EXAMPLES = 5
_FRAME = ("dataset", "sensor", "unit", "sequence", "frame_index", "split")
_LEARNING = ("train", "val", "test")  # the splits that must not share anything
_MIN_PAIRS = 8  # different pairs of images that are needed for an opinion on swapped folders
_MAX_PAIRS = 4000  # pairs of a dataset that are compared
_WIDER = 1.5  # touch images may spread this much more than photographs before they are suspect
_CERTAIN = 0.95  # share of the rows that must resemble the background images to call a dataset swapped
Level = Literal["error", "warning", "info"]


class Finding(NamedTuple):
    """One kind of fault: the row ids i64 that it concerns, and sentences about the first few."""

    kind: str
    level: Level
    sentence: str
    rows: np.ndarray
    examples: tuple[str, ...] = ()
    column: str | None = None


@dataclass(frozen=True)
class VerifyReport:
    """The result of `verify`. `shares` holds, for each dataset and column, the share of rows that have a value."""

    rows: int
    files: int
    decoded: bool
    findings: tuple[Finding, ...]
    licences: tuple[Licence, ...]
    shares: dict[str, dict[str, float]]
    splits: dict[str, int]
    split_hash: str
    content_hash: str
    scan: Scan

    @property
    def ok(self) -> bool:
        """Whether there is no error. Warnings are allowed."""
        return not any(finding.level == "error" for finding in self.findings)

    def to_json(self) -> str:
        """Return the report as JSON, with the first thousand row numbers of each finding."""
        findings: list[dict[str, Any]] = [
            {
                "kind": f.kind, "level": f.level, "sentence": f.sentence, "column": f.column, "count": int(f.rows.size),
                "rows": f.rows[:_JSON_ROWS].tolist(), "examples": list(f.examples),
            }
            for f in self.findings
        ]  # fmt: skip
        report = {
            "rows": self.rows, "files": self.files, "decoded": self.decoded, "ok": self.ok,
            "content_hash": self.content_hash, "split_hash": self.split_hash, "splits": self.splits,
            "shares": self.shares, "licences": [licence._asdict() for licence in self.licences], "findings": findings,
        }  # fmt: skip
        return json.dumps(report, indent=1, ensure_ascii=False) + "\n"

    def to_markdown(self) -> str:
        """Return the report as a page to read."""
        decoded = "every image decoded" if self.decoded else "images not decoded"
        splits = ", ".join(f"{name} {count}" for name, count in self.splits.items())
        lines = [
            f"{self.rows} rows, {self.files} files ({decoded})", "",
            f"content {self.content_hash[:16]}, splits {self.split_hash[:16]}: {splits}", "",
        ]  # fmt: skip
        for finding in self.findings:
            lines.append(f"* **{finding.level}** `{finding.kind}`: {finding.sentence}")
            lines += [f"  * {example}" for example in finding.examples]
        lines += ["" if self.findings else "No fault was found.\n"]
        lines += ["| dataset | " + " | ".join(_SHARES) + " |", "|---" * (len(_SHARES) + 1) + "|"]
        lines += [
            f"| {name} | " + " | ".join(f"{share[column]:.0%}" for column in _SHARES) + " |"
            for name, share in self.shares.items()
        ]
        lines += ["", "| licence | commercial | rows | datasets |", "|---|---|---|---|"]
        use = {YES: "yes", NO: "no"}
        lines += [
            f"| {licence.name or '-'} | {use.get(licence.commercial, 'unknown')} | {licence.rows} | "
            f"{', '.join(licence.datasets[:8])}{' ...' if len(licence.datasets) > 8 else ''} |"
            for licence in self.licences
        ]
        return "\n".join(lines) + "\n"


def verify(
    manifest: Manifest,
    *,
    decode: bool = True,
    objects: bool = False,
    threads: int = 4,
    log: Callable[[str], None] | None = None,
) -> VerifyReport:
    """Check a manifest and every file that it names.

    `decode` reads every file and decodes every image completely. Without it, files must only exist and not be empty.
    With `objects`, an object in two learning splits is an error. The manifest is not changed (see `repair`).
    """
    scanned = scan(manifest, decode=decode, threads=threads, log=log)
    findings = [
        *_bad_files(manifest, scanned),
        *_wrong_sizes(manifest, scanned),
        *_duplicates(manifest, scanned),
        *_swapped(manifest, scanned),
        *(
            Finding(kind, "warning", sentence, rows, _quoted(manifest, rows, column), column)
            for kind, sentence, rows, column in picture_faults(manifest, scanned)
        ),
        *row_faults(manifest, objects=objects),
        *(Finding("unknown_sensor", *fault, (), "sensor") for fault in misspelt_sensors(manifest)),
    ]
    levels = ("error", "warning", "info")
    counts = {entry["values"]: entry["counts"] for entry in pc.value_counts(manifest.table["split"]).to_pylist()}
    return VerifyReport(
        rows=len(manifest),
        files=len(scanned.files),
        decoded=decode,
        findings=tuple(sorted(findings, key=lambda finding: levels.index(finding.level))),
        licences=licences(manifest),
        shares=_shares(manifest),
        splits={name: counts[name] for name in SPLITS if name in counts},
        split_hash=split_hash(manifest),
        content_hash=manifest.content_hash,
        scan=scanned,
    )


def row_faults(manifest: Manifest, *, objects: bool = False) -> Iterator[Finding]:
    """Yield the faults that need no file: leaks between splits, frame order, licence conflicts."""
    yield from _split_leaks(manifest, objects)
    yield from _frame_order(manifest)
    yield from _licence_conflicts(manifest)
    yield from _label_spellings(manifest)


def _shares(manifest: Manifest) -> dict[str, dict[str, float]]:
    dataset = manifest.codes("dataset")
    present = {name: manifest.present(name) for name in _SHARES}
    shares = {}
    for code in np.unique(dataset):
        rows = np.flatnonzero(dataset == code)
        name = str(manifest.value(rows[0], "dataset") or "-")
        shares[name] = {column: float(has_value[rows].mean()) for column, has_value in present.items()}
    return shares


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


def _quoted(manifest: Manifest, rows: np.ndarray, *columns: str) -> tuple[str, ...]:
    """Return a sentence for each of the first few rows: where it is, and its values in `columns`."""
    return tuple(
        f"{manifest.where(row)}: {', '.join(repr(manifest.value(row, column)) for column in columns)}"
        for row in rows[:_EXAMPLES]
    )


def _bad_files(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield files that are missing, outside of the folder, empty, cut short, or unreadable."""
    for column, code in scanned.files.code.items():
        states = scanned.states(column)
        for number, state in enumerate(STATES):
            rows = np.flatnonzero(states == number)
            if number == OK or not rows.size:
                continue
            examples = tuple(
                f"{example}: {scanned.reasons.get(int(code[row]), state)}"
                for row, example in zip(rows, _quoted(manifest, rows, column), strict=False)
            )
            yield Finding(state, "error", f"{rows.size} rows whose {column} is {state}", rows, examples, column)


def _wrong_sizes(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield touch images of another size than most of their dataset, sensor and unit, or than their sequence."""
    size = scanned.size[scanned.files.code["path"]].astype(np.int64)
    rows = np.flatnonzero(size[:, 0] > 0)
    if not rows.size:
        return
    sizes, kind = np.unique(size[rows], axis=0, return_inverse=True)
    kind = kind.ravel()
    keys = np.stack([manifest.codes(name)[rows] for name in ("dataset", "sensor", "unit")], 1)
    usual = _most_frequent(np.unique(keys, axis=0, return_inverse=True)[1].ravel(), kind)
    in_sequence = _most_frequent(np.unique(manifest.codes("sequence", own=True)[rows], return_inverse=True)[1], kind)
    usual = np.where(usual != kind, usual, in_sequence)
    odd = rows[usual != kind]
    if odd.size:
        examples = tuple(
            f"{manifest.where(row)}: {manifest.value(row, 'path')!r} is {size[row][0]} x {size[row][1]}, "
            f"where most of its sensor or sequence are {sizes[main][0]} x {sizes[main][1]}"
            for row, main in zip(odd[:_EXAMPLES], usual[usual != kind], strict=False)
        )
        sentence = f"{odd.size} touch images of another size than most of their dataset, sensor and unit, or sequence"
        yield Finding("wrong_size", "warning", sentence, odd, examples, "path")


def _most_frequent(group: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return the most frequent kind i64 (rows,) in the group of each row."""
    pairs, counts = np.unique(np.stack([group, kind], 1), axis=0, return_counts=True)
    order = np.lexsort((-counts, pairs[:, 0]))
    usual = np.full(pairs[:, 0].max() + 1, -1)
    usual[pairs[order[::-1], 0]] = pairs[order[::-1], 1]  # the last one written is the most frequent
    return usual[group]


def content_ids(scanned: Scan, column: str = "path") -> np.ndarray:
    """Return equal numbers i64 (rows,) for equal bytes, -1 for null. A file without a hash goes by its path."""
    code = scanned.files.code[column]
    numbers = np.char.mod("file %d", np.arange(len(scanned.digest))).astype("S32")
    names = np.where(scanned.digest == b"", numbers, scanned.digest)
    _, same = np.unique(names, return_inverse=True)
    return np.where(code < 0, -1, same[code])


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


def _duplicates(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    """Yield touch images that occur more than once, and touch images that are also the row's photograph."""
    same = content_ids(scanned)
    repeats = repeated_rows(manifest, same)
    if repeats.size:
        sentence = f"{repeats.size} rows repeat an earlier row, touch image and all"
        examples = tuple(manifest.where(row) for row in repeats[:_EXAMPLES])
        yield Finding("repeated_row", "warning", sentence, repeats, examples)
    yield from _leak(manifest, same, "leak_file", "error", "touch image", "path")
    first = np.ones(len(same), bool)
    first[repeats] = False
    _, inverse = np.unique(same, return_inverse=True)
    rows = np.flatnonzero(first & (np.bincount(inverse, weights=first)[inverse] > 1))
    if rows.size:
        sentence = f"{rows.size} rows share the bytes of their touch image"
        yield Finding("duplicate", "warning", sentence, rows, _quoted(manifest, rows, "path"))
    if "image_path" in scanned.files.code:
        image = content_ids(scanned, "image_path")
        rows = np.flatnonzero((same == image) & (image >= 0))
        if rows.size:
            sentence = f"{rows.size} rows whose touch image and photograph are the same"
            yield Finding("touch_is_picture", "error", sentence, rows, _quoted(manifest, rows, "path"), "image_path")


def _leak(manifest: Manifest, codes: np.ndarray, kind: str, level: Level, what: str, column: str) -> Iterator[Finding]:
    """Yield values (codes i64, -1 for null) that occur in two of the learning splits. Examples show `column`."""
    split = manifest.codes("split")
    names = [manifest.value(np.flatnonzero(split == code)[0], "split") for code in range(split.max() + 1)]
    rows = np.flatnonzero((codes >= 0) & np.isin(split, [i for i, name in enumerate(names) if name in _LEARNING]))
    if not rows.size:
        return
    _, value = np.unique(codes[rows], return_inverse=True)
    pairs = np.unique(np.stack([value, split[rows]], 1), axis=0)
    sides = np.bincount(pairs[:, 0])
    leaks = int((sides > 1).sum())
    if not leaks:
        return
    rows = rows[sides[value] > 1]
    _, first = np.unique(codes[rows], return_index=True)
    examples = []
    for row in rows[np.sort(first)[:_EXAMPLES]]:
        here = sorted({names[s] for s in split[rows[codes[rows] == codes[row]]]}, key=SPLITS.index)
        examples.append(f"{what} {manifest.value(row, column)!r} is in {', '.join(here)}")
    sentence = f"{leaks} values of {what} are in more than one of {', '.join(_LEARNING)} ({rows.size} rows)"
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

    def finding(kind: str, level: Level, rows: np.ndarray, what: str) -> Iterator[Finding]:
        if rows.size:
            examples = tuple(
                f"{manifest.where(row)}: frame {frame[row]} of sequence {manifest.value(row, 'sequence')!r}"
                for row in rows[:_EXAMPLES]
            )
            yield Finding(kind, level, f"{rows.size} rows {what}", rows, examples, "frame_index")

    order = np.lexsort((np.arange(len(frame)), frame, sequence))
    twice = (np.diff(sequence[order]) == 0) & (np.diff(frame[order]) == 0)
    rows = np.sort(order[1:][twice])
    yield from finding("repeated_frame", "error", rows, "repeat a frame of their sequence: no clips can be cut from it")
    order = np.argsort(sequence, kind="stable")
    back = (np.diff(sequence[order]) == 0) & (frame[order][1:] < frame[order][:-1])
    rows = np.sort(order[1:][back])
    yield from finding("frame_order", "warning", rows, "stand after a later frame of their sequence")


def _licence_conflicts(manifest: Manifest) -> Iterator[Finding]:
    marked = np.asarray(pc.fill_null(manifest.column("commercial"), False))
    rows = np.flatnonzero(marked & (commercial_use(manifest) == NO))
    if rows.size:
        sentence = f"{rows.size} rows are marked commercial although their licence is not"
        examples = _quoted(manifest, rows, "license")
        yield Finding("licence_conflict", "warning", sentence, rows, examples, "commercial")


def _label_spellings(manifest: Manifest) -> Iterator[Finding]:
    """Yield label values, objects and units that differ by spaces, letter case or Unicode form only."""
    for name in manifest.table.column_names:
        column = manifest.table[name]
        if not pa.types.is_string(column.type) or not (name in ("object", "unit") or name.startswith("label.")):
            continue
        for group in spellings(column.unique().drop_null().to_pylist()):
            rows = [np.flatnonzero(np.asarray(pc.fill_null(pc.equal(column, value), False))) for value in group]
            several = " and ".join(f"{value!r} ({ids.size} rows)" for value, ids in zip(group, rows, strict=True))
            sentence = f"{name} has {several}, which differ only by spaces, letter case or Unicode form"
            examples = tuple(f"{manifest.where(ids[0])}: {value!r}" for value, ids in zip(group, rows, strict=True))
            yield Finding("spelling", "warning", sentence, np.sort(np.concatenate(rows)), examples[:_EXAMPLES], name)


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
    split, both = np.asarray(manifest.table["split"].cast("string")).astype(str), code["image_path"] >= 0
    decoded = (scanned.state == OK) & (scanned.size[:, 0] > 0)
    usable = both & decoded[code["path"]] & decoded[code["image_path"]] & (split != "background")
    dataset, sensor = manifest.codes("dataset"), manifest.codes("sensor")
    result = []
    for data, kind in np.unique(np.stack([dataset[usable], sensor[usable]], 1), axis=0):
        here = (dataset == data) & (sensor == kind)
        rows = np.flatnonzero(usable & here)
        pairs = np.unique(np.stack([code["path"][rows], code["image_path"][rows]], 1), axis=0)
        if len(pairs) < _MIN_PAIRS:
            continue
        backgrounds = _background_colours(manifest, scanned, here, split, rows, decoded)
        swapped, whole = _judge_swap(scanned, code, rows, pairs, backgrounds)
        if swapped.size:
            verdict = SwapVerdict(manifest.value(rows[0], "dataset"), rows, swapped, whole, bool(len(backgrounds)))
            result.append(verdict)
    return result


def in_touch_folder(manifest: Manifest, column: str) -> np.ndarray:
    """Return which rows name a file in `column` that lies in the folder of their touch image, bool (rows,)."""
    folders = [pc.replace_substring_regex(manifest.column(name), r"[^/]*$", "") for name in (column, "path")]
    return np.asarray(pc.fill_null(pc.equal(*folders), False))


def _background_colours(
    manifest: Manifest, scanned: Scan, here: np.ndarray, split: np.ndarray, rows: np.ndarray, decoded: np.ndarray
) -> np.ndarray:
    """Return the colours f32 (k, 48) of the sensor's background images, k = 0 if it has none.

    Images that may be swapped themselves are left out: a background row with its own photograph, and a
    `background_path` in the folder of the touch images.
    """
    code = scanned.files.code
    files = [code["path"][here & (split == "background") & (code["image_path"] < 0)]]
    if "background_path" in code:
        files.append(code["background_path"][rows[~in_touch_folder(manifest, "background_path")[rows]]])
    # A background that is also a photograph would confirm anything.
    ids = np.setdiff1d(np.unique(np.concatenate(files)), [-1, *np.unique(code["image_path"])])
    return scanned.colours[ids[decoded[ids]][:64]].astype(np.float32)


def _judge_swap(
    scanned: Scan, code: dict[str, np.ndarray], rows: np.ndarray, pairs: np.ndarray, backgrounds: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Return the rows that look swapped, and whether the whole dataset does."""
    touch = scanned.colours[code["path"][rows]].astype(np.float32)
    vision = scanned.colours[code["image_path"][rows]].astype(np.float32)
    if len(backgrounds):
        bad = _distance(vision, backgrounds) < _distance(touch, backgrounds)
        whole = bool(bad.mean() >= _CERTAIN)
        return rows if whole else rows[bad], whole
    centres, spreads = [], []
    for side in (0, 1):
        files = np.unique(pairs[:, side])  # each once: one photograph may serve many rows
        files_used = files[np.linspace(0, len(files) - 1, min(len(files), _MAX_PAIRS)).astype(int)]
        colours = scanned.colours[files_used].astype(np.float32)
        centres.append(np.median(colours, axis=0))
        spread = float(np.median(_distance(colours, centres[side][None])))
        spreads.append(spread if len(files) >= _MIN_PAIRS else 0.0)
    if spreads[1] and spreads[0] > _WIDER * spreads[1]:
        return rows, True
    far, near = _distance(touch, centres[0][None]), _distance(vision, centres[0][None])
    return rows[(far > 3 * max(spreads[0], 1.0)) & (near < far / 2)], False


def _distance(colours: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the mean absolute difference f32 (n,) of colours (n, 48) to the nearest of centres (k, 48)."""
    best = np.full(len(colours), np.inf, np.float32)
    for centre in centres:
        np.minimum(best, np.abs(colours - centre[None]).mean(axis=1), out=best)
    return best


def _swapped(manifest: Manifest, scanned: Scan) -> Iterator[Finding]:
    for verdict in swap_verdicts(manifest, scanned):
        name = f"dataset {verdict.dataset!r}" if verdict.dataset else "the rows without a dataset"
        reason = "the background frames show it" if verdict.confirmed else "suspected from the colours; look at some"
        what = "all touch images and photographs are" if verdict.whole else f"{verdict.swapped.size} rows are"
        examples = _quoted(manifest, verdict.swapped, "path", "image_path")
        kind = "swapped" if verdict.whole else "swapped_rows"
        level: Level = "error" if verdict.confirmed else "warning"
        yield Finding(kind, level, f"{name}: {what} swapped ({reason})", verdict.swapped, examples, "image_path")
