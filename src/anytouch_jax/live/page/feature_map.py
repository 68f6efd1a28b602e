"""Features on the page: their map, its colours, and the nearest touches."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError
from anytouch_jax.live.page.tables import Table, title

METHODS = {"pca": 20_000, "tsne": 2_000}  # and how many points each draws
_NAMES = 20  # values of a column with a colour each
_NEAR = 40  # frames of a recording that may be nearer than the next recording, on average


class FeatureMap:
    """A features file of `anytouch embed`, with the images of a table.

    It is the first of `tables` that has the rows of the file. Raises UserError for another file.
    """

    kind = "space"

    def __init__(self, path: Path, tables: list[Table]) -> None:
        from anytouch_jax.encoder.embed import load_index

        self.name = title(path)
        self.index = load_index(path)
        self._rows = self.index.rows
        known = (number for number, table in enumerate(tables) if self._has_rows_of(table))
        self.table = next(known, None)
        self.map = lru_cache(len(METHODS))(self._map)

    def about(self) -> dict[str, Any]:
        """Return the number of features, the columns that colour them, and where they come from."""
        about = {"count": len(self._rows), "columns": sorted(self.index.keys), "table": self.table}
        about["sensors"] = len(np.unique(self.index.keys.get("sensor", np.zeros(1))))
        return about | {"methods": list(METHODS), "from": self.index.about}

    def _map(self, method: str) -> dict[str, Any]:
        """Return points {x, y, rows} in -1..1 of at most METHODS[method] rows, evenly spread.

        Raises UserError.
        """
        if method not in METHODS:
            raise UserError(f"A map is by {' or '.join(METHODS)}, not {method[:20]}.")
        count = len(self._rows)
        rows = np.unique(np.linspace(0, count - 1, min(METHODS[method], count)).astype(int))
        values = self.index.values[rows]
        if method == "tsne":
            from anytouch_jax.evaluate.plots import tsne

            points = tsne(values)
        else:
            centred = values - values.mean(0)
            axes = np.linalg.eigh(centred.T @ centred)[1]
            # The two largest axes come last. Features of one number have one.
            points = centred @ axes[:, :-3:-1]
            points = np.pad(points, ((0, 0), (0, 2 - points.shape[1])))
        points = points - (points.max(0) + points.min(0)) / 2
        points = points / max(float(np.abs(points).max()), 1e-9)
        return {
            "x": points[:, 0].round(4).tolist(),
            "y": points[:, 1].round(4).tolist(),
            "rows": rows.tolist(),
        }

    def colours(self, method: str, column: str) -> dict[str, Any]:
        """Return {values} of a column of numbers, or {codes, names}, for the points of a map.

        Raises UserError.
        """
        if column not in self.index.keys:
            raise UserError(f"The features have no column {column[:50]}.")
        values = self.index.keys[column][self.map(method)["rows"]]
        if values.dtype.kind in "iuf" and len(np.unique(values)) > _NAMES:
            return {"values": [float(one) if np.isfinite(one) else None for one in values]}
        distinct, codes, counts = np.unique(
            values.astype(str), return_inverse=True, return_counts=True
        )
        shown = np.sort(np.argsort(-counts, kind="stable")[:_NAMES])
        place = np.full(len(distinct), len(shown))
        place[shown] = np.arange(len(shown))
        names = distinct[shown].tolist()
        if len(distinct) > len(shown):
            names.append("others")
        return {"codes": place[codes].tolist(), "names": names}

    def neighbours(self, row: int, *, others: bool) -> dict[str, Any]:
        """Return a row and its ten nearest of other recordings, by cosine.

        With `others` they are of other sensors, too.
        """
        if not 0 <= row < len(self._rows):
            raise UserError(f"There are {len(self._rows)} features, no row {row}.")
        allowed = np.ones(len(self._rows), bool)
        allowed[row] = False
        for name in ("sequence", "sensor") if others else ("sequence",):
            if name in self.index.keys:
                allowed &= self.index.keys[name] != self.index.keys[name][row]
        found = self.near(self.index.values[row], np.flatnonzero(allowed))
        return {"row": self._describe(row), "hits": found}

    def near(
        self, values: Array, among: Array | None = None, count: int = 10
    ) -> list[dict[str, Any]]:
        """Return the nearest rows to unit features (d,), with cosines, one frame of a recording.

        They are of the rows `among` (m,), or of all.
        """
        from anytouch_jax.encoder.embed import nearest

        stored = self.index.values
        if among is None:
            among = np.arange(len(self._rows))
        elif len(among) < len(self._rows):
            stored = stored[among]
        if not len(among):
            return []
        places, cosines = nearest(stored, values[None], min(_NEAR * count, len(among)))
        rows = among[places[0]]
        cosine = dict(zip(rows.tolist(), cosines[0].tolist(), strict=True))
        if "sequence" in self.index.keys:
            # The first of each recording, in the order of nearness.
            first = np.unique(self.index.keys["sequence"][rows], return_index=True)[1]
            rows = rows[np.sort(first)]
        return [
            self._describe(row) | {"cosine": round(cosine[row], 4)} for row in rows[:count].tolist()
        ]

    def _describe(self, row: int) -> dict[str, Any]:
        return {"row": row, "table_row": int(self._rows[row]), "about": self.index.describe(row)}

    def _has_rows_of(self, table: Table) -> bool:
        """Return whether the first, middle and last row of the file are the same of a table."""
        places = [0, len(self._rows) // 2, -1]
        few = self._rows[places]
        if few.min() < 0 or self._rows.max() >= len(table.manifest):
            return False
        keys = [name for name in ("path", "frame_index") if name in self.index.keys]
        for name in keys:
            # Folders may have moved, so files are compared by their names.
            ours = [_last(one) for one in self.index.keys[name][places].astype(str).tolist()]
            there = [_last(str(table.manifest.value(row, name))) for row in few]
            if ours != there:
                return False
        return bool(keys)


def _last(path: str) -> str:
    return path.rpartition("/")[2]
