"""Touch where vision should be: told from the colours, because folder names can lie (some copies of TVL have them so).

Touch images of one sensor look alike; photographs do not. That is a suspicion. A background frame of the sensor is a
witness: what resembles it is touch.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pyarrow.compute as pc

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.prepare.checks import EXAMPLES, Finding, Level
from anytouch_jax.data.prepare.scan import OK, Scan

_FEWEST = 8  # different pairs that are needed for an opinion
_MOST = 4000  # pairs of a dataset that are looked at to learn what its touch looks like
_WIDER = 1.5  # touch may spread this much more than photographs before it is suspect
_SURE = 0.95  # share of the rows in which the witness must say "swapped"


class Verdict(NamedTuple):
    """Of a dataset: its name, rows with both pictures, those that look swapped, and whether a witness says so."""

    dataset: str | None
    rows: np.ndarray
    swapped: np.ndarray
    whole: bool
    witnessed: bool


def verdicts(manifest: Manifest, found: Scan) -> list[Verdict]:
    """One for every dataset and sensor that has enough rows with a touch image and a photograph."""
    code = found.files.code
    if "image_path" not in code or not found.colours.any():
        return []
    split, both = np.asarray(manifest.table["split"].cast("string")).astype(str), code["image_path"] >= 0
    decoded = (found.state == OK) & (found.size[:, 0] > 0)
    usable = both & decoded[code["path"]] & decoded[code["image_path"]] & (split != "background")
    dataset, sensor = manifest.codes("dataset"), manifest.codes("sensor")
    result = []
    for data, kind in np.unique(np.stack([dataset[usable], sensor[usable]], 1), axis=0):
        here = (dataset == data) & (sensor == kind)
        rows = np.flatnonzero(usable & here)
        pairs = np.unique(np.stack([code["path"][rows], code["image_path"][rows]], 1), axis=0)
        if len(pairs) < _FEWEST:
            continue
        ground = _backgrounds(manifest, found, here, split, rows, decoded)
        swapped, whole = _judge(found, code, rows, pairs, ground)
        if swapped.size:
            result.append(Verdict(manifest.value(rows[0], "dataset"), rows, swapped, whole, bool(len(ground))))
    return result


def beside(manifest: Manifest, column: str) -> np.ndarray:
    """Which rows name a file in `column` that lies in the folder of their touch image: bool (rows,)."""
    folders = [pc.replace_substring_regex(manifest.column(name), r"[^/]*$", "") for name in (column, "path")]
    return np.asarray(pc.fill_null(pc.equal(*folders), False))


def _backgrounds(
    manifest: Manifest, found: Scan, here: np.ndarray, split: np.ndarray, rows: np.ndarray, decoded: np.ndarray
) -> np.ndarray:
    """Colours f32 (k, 48) of the sensor's background frames, k = 0 where there is none.

    What may have changed places itself is no witness: a background row with a photograph of its own, and a
    `background_path` in the folder of the touch images.
    """
    code = found.files.code
    files = [code["path"][here & (split == "background") & (code["image_path"] < 0)]]
    if "background_path" in code:
        files.append(code["background_path"][rows[~beside(manifest, "background_path")[rows]]])
    ids = np.unique(np.concatenate(files))
    # A background that is also a photograph would be a false witness.
    ids = np.setdiff1d(ids, [-1, *np.unique(code["image_path"])])
    return found.colours[ids[decoded[ids]][:64]].astype(np.float32)


def _judge(
    found: Scan, code: dict[str, np.ndarray], rows: np.ndarray, pairs: np.ndarray, ground: np.ndarray
) -> tuple[np.ndarray, bool]:
    """(rows that look swapped, whether it is the whole dataset)."""
    touch = found.colours[code["path"][rows]].astype(np.float32)
    vision = found.colours[code["image_path"][rows]].astype(np.float32)
    if len(ground):
        bad = _distance(vision, ground) < _distance(touch, ground)
        whole = bool(bad.mean() >= _SURE)
        return rows if whole else rows[bad], whole
    centres, spreads = [], []
    for side in (0, 1):
        files = np.unique(pairs[:, side])  # each once: one photograph may serve many rows
        some = files[np.linspace(0, len(files) - 1, min(len(files), _MOST)).astype(int)]
        some = found.colours[some].astype(np.float32)
        centres.append(np.median(some, axis=0))
        spreads.append(float(np.median(_distance(some, centres[side][None]))) if len(files) >= _FEWEST else 0.0)
    if spreads[1] and spreads[0] > _WIDER * spreads[1]:
        return rows, True
    far, near = _distance(touch, centres[0][None]), _distance(vision, centres[0][None])
    return rows[(far > 3 * max(spreads[0], 1.0)) & (near < far / 2)], False


def _distance(colours: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Mean absolute difference f32 (n,) of colours (n, 48) to the nearest of centres (k, 48)."""
    best = np.full(len(colours), np.inf, np.float32)
    for centre in centres:
        np.minimum(best, np.abs(colours - centre[None]).mean(axis=1), out=best)
    return best


def swapped(manifest: Manifest, found: Scan) -> Iterator[Finding]:
    """Datasets, or rows of them, whose touch images and photographs seem to have changed places."""
    for verdict in verdicts(manifest, found):
        name = f"dataset {verdict.dataset!r}" if verdict.dataset else "the rows without a dataset"
        how = "the background frames show it" if verdict.witnessed else "suspected from the colours; look at some"
        what = "all touch images and photographs are" if verdict.whole else f"{verdict.swapped.size} rows are"
        examples = tuple(
            f"{manifest.where(row)}: {manifest.value(row, 'path')!r}, {manifest.value(row, 'image_path')!r}"
            for row in verdict.swapped[:EXAMPLES]
        )
        kind = "swapped" if verdict.whole else "swapped_rows"
        level: Level = "error" if verdict.witnessed else "warning"
        yield Finding(kind, level, f"{name}: {what} swapped ({how})", verdict.swapped, examples, "image_path")
