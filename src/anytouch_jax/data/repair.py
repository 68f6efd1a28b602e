"""Repairs that need no guess, made on a copy of the manifest; and where the copy may be written."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from anytouch_jax.config import UserError
from anytouch_jax.data import manifest as manifests
from anytouch_jax.data.checks import identity, repeated_rows
from anytouch_jax.data.edit import replace_column, select
from anytouch_jax.data.manifest import Manifest
from anytouch_jax.data.scan import OK, STATES
from anytouch_jax.data.swapped import verdicts
from anytouch_jax.data.verify import Report


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
    left = _left(report, {v.dataset for v in verdicts(manifest, found) if exchanged[v.rows].any()})
    return Repaired(select(result, np.flatnonzero(keep)), tuple(done), left)


def _exchange(
    manifest: Manifest, report: Report, swap: Collection[str], done: list[str]
) -> tuple[Manifest, np.ndarray]:
    """The manifest with touch and photograph exchanged where it is certain, and which rows those are."""
    exchanged = np.zeros(len(manifest), bool)
    names = set(manifest.column("dataset").unique().to_pylist())
    unknown = sorted(set(swap) - names)
    if unknown:
        there = ", ".join(sorted(str(name) for name in names if name))
        raise UserError(f"there is no dataset {unknown[0]!r} to swap; the manifest has {there or 'no dataset names'}")
    for verdict in verdicts(manifest, report.scan):
        if verdict.whole and verdict.witnessed and verdict.dataset not in swap:
            exchanged[verdict.rows] = True
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
    return replace_column(result, "image_path", pa.array(np.where(exchanged, touch, picture), pa.string())), exchanged


def _left(report: Report, exchanged: Collection[str | None]) -> tuple[str, ...]:
    fixed = {*STATES, "repeated_row"} | ({"swapped"} if exchanged else set())
    return tuple(f.sentence for f in report.findings if f.kind not in fixed and f.level != "info")


def write_repaired(repaired: Repaired, path: str | Path, *, in_place: bool = False) -> Path:
    """Write the repaired manifest to a new file, whole or not at all; over one of its own only with `in_place`."""
    target = Path(path).expanduser().resolve()
    if target in repaired.manifest.files and not in_place:
        raise UserError(f"{target} is the manifest itself; give another name for the repaired one")
    manifests.write(repaired.manifest, target)
    return target
