"""Manifest repairs: bad files, repeated rows and swapped folders, in a copy of the manifest."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.manifest.manifest import Manifest, replace_column, select_rows
from anytouch_jax.data.prepare.scan import OK, STATES
from anytouch_jax.data.prepare.verify import (
    VerifyReport,
    content_ids,
    in_touch_folder,
    repeated_rows,
    row_faults,
    swap_verdicts,
)
from anytouch_jax.errors import UserError

_OF_ROWS = {f"leak_{name}" for name in ("sequence", "touch", "grasp_group", "object")}
_OF_ROWS |= {"repeated_frame", "frame_order", "licence_conflict", "spelling"}  # faults that dropping rows can repair


class Repaired(NamedTuple):
    """The repaired manifest, a sentence for each repair, and a sentence for each fault that is left to the user."""

    manifest: Manifest
    done: tuple[str, ...]
    left: tuple[str, ...]


def repair(manifest: Manifest, report: VerifyReport, *, swap: Collection[str] = ()) -> Repaired:
    """Make the repairs that need no guess, based on the `report` of this manifest.

    Rows with an unusable touch image and repeated rows are dropped. An unusable photograph, background or field file
    becomes null. Touch images and photographs are exchanged in datasets that a background image confirms to be
    swapped as a whole, and in those named in `swap`. Raises UserError if no touch image is usable, and for an unknown
    name in `swap`.
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
        counts = ", ".join(f"{int((states == n).sum())} {STATES[n]}" for n in np.unique(states[bad]))
        if column == "path":
            usable &= ~bad
            done.append(f"dropped {int(bad.sum())} rows whose touch image cannot be used ({counts})")
        else:
            result = _empty_cells(result, column, bad)
            done.append(f"emptied {column} in {int(bad.sum())} rows ({counts})")
    if not usable.any():
        folder = manifest.files[0].parent
        raise UserError(f"no touch image of {manifest.files[0]} can be used; are the files really in {folder}?")
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
    """Return the manifest with touch image and photograph exchanged where needed, and which rows those are."""
    exchanged = np.zeros(len(manifest), bool)
    check_swap(manifest, swap)
    for verdict in swap_verdicts(manifest, report.scan):
        if verdict.whole and verdict.confirmed and verdict.dataset not in swap:
            exchanged[verdict.rows] = True
            exchanged |= _background_rows(manifest, verdict.rows)
            done.append(
                f"exchanged touch image and photograph in {verdict.rows.size} rows of dataset {verdict.dataset!r}: "
                "its photographs resemble the background frames, its touch images do not"
            )
    if swap:
        dataset = manifest.column("dataset").to_pylist()
        chosen = np.array([name in swap for name in dataset]) & manifest.present("image_path")
        exchanged |= chosen
        rows = int(chosen.sum())
        done.append(f"exchanged touch image and photograph in {rows} rows of {', '.join(sorted(swap))}, as requested")
    if not exchanged.any():
        return manifest, exchanged
    touch, image = (manifest.table[name].combine_chunks().to_numpy(False) for name in ("path", "image_path"))
    result = replace_column(manifest, "path", pa.array(np.where(exchanged, image, touch), pa.string()))
    result = replace_column(result, "image_path", pa.array(np.where(exchanged, touch, image), pa.string()))
    photographs = exchanged & in_touch_folder(manifest, "background_path")  # its folder now holds photographs
    if photographs.any():
        result = _empty_cells(result, "background_path", photographs)
        done.append(f"emptied background_path in {int(photographs.sum())} of them: it lay among the photographs")
    return result, exchanged


def _background_rows(manifest: Manifest, rows: np.ndarray) -> np.ndarray:
    """Return the background rows with a photograph of the dataset and sensor of `rows`. They are swapped too."""
    selected = np.asarray(pc.equal(manifest.table["split"], "background")) & manifest.present("image_path")
    for name in ("dataset", "sensor"):
        code = manifest.codes(name)
        selected &= code == code[rows[0]]
    return selected


def _left(report: VerifyReport, result: Manifest, exchanged: np.ndarray) -> tuple[str, ...]:
    """Return the faults that remain after the repair."""
    remaining = {finding.kind for finding in row_faults(result)}
    left = []
    for finding in report.findings:
        repaired = finding.kind in {*STATES, "repeated_row"}
        repaired |= finding.kind in _OF_ROWS and finding.kind not in remaining
        repaired |= finding.kind == "swapped" and bool(exchanged[finding.rows].any())
        if finding.level != "info" and not repaired:
            left.append(finding.sentence)
    return tuple(left)
