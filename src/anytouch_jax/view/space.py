"""Features for the page: a map by PCA or t-SNE, colours, and nearest neighbours."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.encoder.search import load_index, nearest
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.geometry import tsne
from anytouch_jax.view.tables import Table, title

Array = npt.NDArray[Any]
METHODS = {"pca": 20_000, "tsne": 2_000}  # and how many points each draws
_NAMES = 20  # values of a column with a colour each
_FRAMES = 40  # frames of a recording that may be nearer than the next recording, on average


class FeatureMap:
    """A features file of `anytouch embed`. Raises UserError for another file, such as one with pickled arrays.

    The pictures are those of the first of `tables` that has the rows of the file.
    """

    kind = "space"

    def __init__(self, path: Path, tables: list[Table]) -> None:
        self.name, self.index = title(path), load_index(path)
        self._rows = self.index.rows
        self.table = next((number for number, table in enumerate(tables) if self._has_rows_of(table)), None)
        self.map = lru_cache(len(METHODS))(self._map)

    def about(self) -> dict[str, Any]:
        """Return the number of features, the columns that colour them, and where they come from."""
        about = {"count": len(self._rows), "columns": sorted(self.index.keys), "table": self.table}
        about["sensors"] = len(np.unique(self.index.keys.get("sensor", np.zeros(1))))
        return about | {"methods": list(METHODS), "from": self.index.about}

    def _map(self, method: str) -> dict[str, Any]:
        """Return points {x, y, rows} in -1..1 of at most METHODS[method] rows, evenly spread. Raises UserError."""
        if method not in METHODS:
            raise UserError(f"A map is by {' or '.join(METHODS)}, not {method[:20]}.")
        rows = np.unique(np.linspace(0, len(self._rows) - 1, min(METHODS[method], len(self._rows))).astype(int))
        values = self.index.values[rows]
        if method == "tsne":
            points = tsne(values)
        else:
            centred = values - values.mean(0)
            points = centred @ np.linalg.eigh(centred.T @ centred)[1][:, :-3:-1]
            points = np.pad(points, ((0, 0), (0, 2 - points.shape[1])))
        points = points - (points.max(0) + points.min(0)) / 2
        points = points / max(float(np.abs(points).max()), 1e-9)
        return {"x": points[:, 0].round(4).tolist(), "y": points[:, 1].round(4).tolist(), "rows": rows.tolist()}

    def colours(self, method: str, column: str) -> dict[str, Any]:
        """Return {values} of a column of numbers, or {codes, names} of others, for the points of a map.

        The most frequent values have a name each, and all others are one. Raises UserError.
        """
        if column not in self.index.keys:
            raise UserError(f"The features have no column {column[:50]}.")
        values = self.index.keys[column][self.map(method)["rows"]]
        if values.dtype.kind in "iuf" and len(np.unique(values)) > _NAMES:
            return {"values": [None if not np.isfinite(value) else float(value) for value in values]}
        distinct, codes, counts = np.unique(values.astype(str), return_inverse=True, return_counts=True)
        shown = np.sort(np.argsort(-counts, kind="stable")[:_NAMES])
        place = np.full(len(distinct), len(shown))
        place[shown] = np.arange(len(shown))
        names = [*distinct[shown].tolist(), *(["others"] if len(distinct) > len(shown) else [])]
        return {"codes": place[codes].tolist(), "names": names}

    def neighbours(self, row: int, *, others: bool) -> dict[str, Any]:
        """Return what is known of a row and of its ten nearest of other recordings, by cosine, nearest first.

        With `others`, they are of other sensors.
        """
        if not 0 <= row < len(self._rows):
            raise UserError(f"There are {len(self._rows)} features, no row {row}.")
        allowed = np.ones(len(self._rows), bool)
        allowed[row] = False
        for name in ("sequence", *(["sensor"] if others else [])):
            if name in self.index.keys:
                allowed &= self.index.keys[name] != self.index.keys[name][row]
        found = self.near(self.index.values[row], np.flatnonzero(allowed))
        return {"row": self._describe(row), "hits": found}

    def near(self, values: Array, among: Array | None = None, count: int = 10) -> list[dict[str, Any]]:
        """Return the nearest of `among` rows (m,) to unit features (d,), at most `count`, each with its cosine.

        A recording has one hit, its nearest frame.
        """
        among = np.arange(len(self._rows)) if among is None else among
        if not len(among):
            return []
        stored = self.index.values if len(among) == len(self._rows) else self.index.values[among]
        places, cosines = nearest(stored, values[None], min(_FRAMES * count, len(among)))
        rows = among[places[0]]
        if "sequence" in self.index.keys:
            rows = rows[np.sort(np.unique(self.index.keys["sequence"][rows], return_index=True)[1])]
        cosine = dict(zip(among[places[0]].tolist(), cosines[0].tolist(), strict=True))
        return [self._describe(row) | {"cosine": round(cosine[row], 4)} for row in rows[:count].tolist()]

    def _describe(self, row: int) -> dict[str, Any]:
        return {"row": row, "table_row": int(self._rows[row]), "about": self.index.describe(row)}

    def _has_rows_of(self, table: Table) -> bool:
        """Whether the rows of the file are rows of a table: the same frames at the first, middle and last."""
        few = self._rows[[0, len(self._rows) // 2, -1]]
        if few.min() < 0 or self._rows.max() >= len(table.manifest):
            return False
        keys = [name for name in ("path", "frame_index") if name in self.index.keys]
        ours = {name: self.index.keys[name][[0, len(self._rows) // 2, -1]].astype(str).tolist() for name in keys}
        there = {name: [str(table.manifest.value(row, name)).rpartition("/")[2] for row in few] for name in keys}
        return bool(keys) and all([one.rpartition("/")[2] for one in ours[name]] == there[name] for name in keys)
