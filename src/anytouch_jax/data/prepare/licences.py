"""Licences: which rows may be used commercially."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
import pyarrow.compute as pc

from anytouch_jax.data.manifest.manifest import Manifest, group_rows, select_rows
from anytouch_jax.errors import UserError

YES, NO, UNKNOWN = 1, 0, -1
_NO = re.compile(r"\bnc\b|non-?\s?commercial|(research|academic|educational)[\s-]+(use[\s-]+)?only", re.IGNORECASE)
_YES = re.compile(
    r"(mit|apache([\s-]2(\.0)?)?|bsd([\s-][0-9]-clause)?|isc|cc0([\s-]1\.0)?|cc[\s-]by([\s-]sa)?([\s-][0-9]\.[0-9])?|"
    r"public[\s-]domain|unlicense)(\s+licen[cs]e)?",
    re.IGNORECASE,
)


class Licence(NamedTuple):
    """Rows under one licence: its name or None, YES, NO or UNKNOWN, the datasets, the number of rows."""

    name: str | None
    commercial: int
    datasets: tuple[str, ...]
    rows: int


class Commercial(NamedTuple):
    """The rows that may be used commercially, and the numbers of rows left out."""

    manifest: Manifest
    non_commercial: int
    unknown: int


def allows(licence: str | None) -> int:
    """Return whether a licence with this name allows commercial use: YES, NO or UNKNOWN."""
    if licence is None or not licence.strip():
        return UNKNOWN
    if _NO.search(licence):
        return NO
    return YES if _YES.fullmatch(licence.strip()) else UNKNOWN


def commercial_use(manifest: Manifest) -> np.ndarray:
    """Return YES, NO or UNKNOWN for every row, i8 (rows,).

    A NO by the flag `commercial` or by the licence's name decides. Otherwise the flag comes before the name.
    """
    codes = manifest.codes("license")
    names = pc.unique(manifest.column("license")).drop_null().to_pylist()
    verdict = np.array([*(allows(name) for name in names), UNKNOWN], np.int8)[codes]  # code -1 is the last one
    flag = np.asarray(pc.fill_null(manifest.column("commercial").cast("int8"), UNKNOWN)).astype(np.int8)
    return np.where((flag == NO) | (verdict == NO), NO, np.where(flag == YES, YES, verdict)).astype(np.int8)


def commercial_only(manifest: Manifest) -> Commercial:
    """Return the rows that may certainly be used commercially. Raises UserError if there is none."""
    use = commercial_use(manifest)
    non_commercial, unknown = int((use == NO).sum()), int((use == UNKNOWN).sum())
    if not (use == YES).any():
        files = ", ".join(map(str, manifest.files))
        raise UserError(
            f"{files}: no row may certainly be used commercially ({non_commercial} may not, {unknown} do not say). "
            "Fill in the columns 'license' and 'commercial'."
        )
    return Commercial(select_rows(manifest, np.flatnonzero(use == YES)), non_commercial, unknown)


def licences(manifest: Manifest) -> tuple[Licence, ...]:
    """Return the rows under each licence, most rows first."""
    use = commercial_use(manifest).astype(np.int64)
    result = []
    for rows in group_rows(np.arange(len(manifest)), np.stack([manifest.codes("license"), use], 1)):
        datasets = manifest.column("dataset").take(rows).unique().drop_null().to_pylist()
        name, verdict = manifest.value(rows[0], "license"), int(use[rows[0]])
        result.append(Licence(name, verdict, tuple(sorted(datasets)), len(rows)))
    return tuple(sorted(result, key=lambda licence: -licence.rows))
