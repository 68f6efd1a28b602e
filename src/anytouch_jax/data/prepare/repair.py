"""Repairs that need no guess, made on a copy of the manifest."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.manifest.manifest import Manifest, replace_column, select_rows
from anytouch_jax.data.prepare.checks import frame_order, identity, licence_conflicts, repeated_rows, split_leaks
from anytouch_jax.data.prepare.scan import OK, STATES
from anytouch_jax.data.prepare.swapped import beside, verdicts
from anytouch_jax.data.prepare.verify import Report
from anytouch_jax.errors import UserError

_OF_ROWS = {f"leak_{name}" for name in ("sequence", "touch", "grasp_group", "object")}
_OF_ROWS |= {"repeated_frame", "frame_order", "licence_conflict"}  # faults that a dropped row can take away


class Repaired(NamedTuple):
    """The repaired manifest and, a sentence each, what was done and what is left to the user."""

    manifest: Manifest
    done: tuple[str, ...]
    left: tuple[str, ...]


def repair(manifest: Manifest, report: Report, *, swap: Collection[str] = ()) -> Repaired:
    """Do what is certain for the `report` on this manifest.

    Rows whose touch image cannot be used are dropped, and rows that repeat another; a photograph, background or field
    that cannot be used becomes null. Touch and photograph are exchanged in datasets that a background frame shows to
    be swapped as a whole, and in those named in `swap` by the user, who looked. Raises UserError where no usable
    touch image is there at all, and for an unknown name in `swap`.
    """
    found = report.scan
    done: list[str] = []
    if report.content_hash != manifest.content_hash:
        raise UserError("the report is of another manifest; verify this one first")
    result, exchanged = _exchange(manifest, report, swap, done)
    keep = np.ones(len(manifest), bool)
    for column in found.files.code:
        states = found.states(column)
        # An exchanged row has its touch image in the other column.
        if column in ("path", "image_path") and exchanged.any():
            other = found.states("image_path" if column == "path" else "path")
            states = np.where(exchanged, other, states)
        bad = states != OK
        if not bad.any():
            continue
        what = ", ".join(f"{int((states == n).sum())} {STATES[n]}" for n in np.unique(states[bad]))
        if column == "path":
            keep &= ~bad
            done.append(f"dropped {int(bad.sum())} rows whose touch image cannot be used ({what})")
        else:
            cells = result.table[column].combine_chunks()
            result = replace_column(result, column, pa.array(np.where(bad, None, cells.to_numpy(False)), pa.string()))
            done.append(f"emptied {column} in {int(bad.sum())} rows ({what})")
    if not keep.any():
        folder = manifest.files[0].parent
        raise UserError(f"no touch image of {manifest.files[0]} can be used; are the files really in {folder}?")
    repeats = repeated_rows(manifest, identity(found))
    repeats = repeats[keep[repeats]]
    if repeats.size:
        keep[repeats] = False
        done.append(f"dropped {repeats.size} rows that repeat another, touch image and all")
    result = select_rows(result, np.flatnonzero(keep))
    return Repaired(result, tuple(done), _left(report, result, exchanged))


def check_swap(manifest: Manifest, swap: Collection[str]) -> None:
    """Raise UserError for a dataset to swap that the manifest does not have."""
    names = set(manifest.column("dataset").unique().to_pylist())
    unknown = sorted(set(swap) - names)
    if unknown:
        there = ", ".join(sorted(str(name) for name in names if name))
        raise UserError(f"there is no dataset {unknown[0]!r} to swap; the manifest has {there or 'no dataset names'}")


def _exchange(
    manifest: Manifest, report: Report, swap: Collection[str], done: list[str]
) -> tuple[Manifest, np.ndarray]:
    """The manifest with touch and photograph exchanged where it is certain, and which rows those are."""
    exchanged = np.zeros(len(manifest), bool)
    check_swap(manifest, swap)
    for verdict in verdicts(manifest, report.scan):
        if verdict.whole and verdict.witnessed and verdict.dataset not in swap:
            exchanged[verdict.rows] = True
            exchanged |= _backgrounds(manifest, verdict.rows)
            done.append(
                f"exchanged touch image and photograph in {verdict.rows.size} rows of dataset {verdict.dataset!r}: "
                "its photographs resemble the background frames, its touch images do not"
            )
    if swap:
        dataset = manifest.column("dataset").to_pylist()
        chosen = np.array([name in swap for name in dataset]) & manifest.present("image_path")
        exchanged |= chosen
        rows = int(chosen.sum())
        done.append(f"exchanged touch image and photograph in {rows} rows of {', '.join(sorted(swap))}, as asked")
    if not exchanged.any():
        return manifest, exchanged
    touch, picture = (manifest.table[name].combine_chunks().to_numpy(False) for name in ("path", "image_path"))
    result = replace_column(manifest, "path", pa.array(np.where(exchanged, picture, touch), pa.string()))
    result = replace_column(result, "image_path", pa.array(np.where(exchanged, touch, picture), pa.string()))
    false = exchanged & beside(manifest, "background_path")  # it was in the folder of what is now a photograph
    if false.any():
        cells = np.where(false, None, manifest.column("background_path").combine_chunks().to_numpy(False))
        result = replace_column(result, "background_path", pa.array(cells, pa.string()))
        done.append(f"emptied background_path in {int(false.sum())} of them: it lay among the photographs")
    return result, exchanged


def _backgrounds(manifest: Manifest, rows: np.ndarray) -> np.ndarray:
    """The background rows with a photograph, of the dataset and sensor of `rows`: what is true of those is of them."""
    found = np.asarray(pc.equal(manifest.table["split"], "background")) & manifest.present("image_path")
    for name in ("dataset", "sensor"):
        code = manifest.codes(name)
        found &= code == code[rows[0]]
    return found


def _left(report: Report, result: Manifest, exchanged: np.ndarray) -> tuple[str, ...]:
    """What a repair did not take away: faults of files that it knows nothing of, and faults of the rows that remain."""
    rows = {f.kind for f in (*split_leaks(result), *frame_order(result), *licence_conflicts(result))}
    found = []
    for f in report.findings:
        of_rows = f.kind in _OF_ROWS
        mended = f.kind in {*STATES, "repeated_row"} or (of_rows and f.kind not in rows)
        if f.level != "info" and not mended and not (f.kind == "swapped" and exchanged[f.rows].any()):
            found.append(f.sentence)
    return tuple(found)
