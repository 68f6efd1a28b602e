"""How often an encoder finds the same touch by another sensor, among 50 on objects never seen: a file for each."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.encoder import Encoder, embed_rows
from anytouch_jax.evaluate import retrieval
from anytouch_jax.evaluate.contacts import deepest_rows
from anytouch_jax.evaluate.statistics import markdown
from anytouch_jax.files import atomic_write
from anytouch_jax.train.progress import silent


def find_again(folder: Path, name: str, seed: int, encoder: Encoder, mark: str, table: Manifest) -> None:
    """Write how often an encoder comes first and among the first five, where it is not known of one with this mark."""
    file = folder / f"found_{name}_{seed}.json"
    if file.exists() and json.loads(file.read_text())["encoder"] == mark:
        return
    rows = deepest_rows(table, table.rows_of("test"))
    seen = {name: embed_rows(encoder, table, rows, log=silent)[1]}
    scored = retrieval.cross_sensor_retrieval(table, seen, rows, centre=(True,))
    one = next(one.found for one in scored if one.query_sensor == retrieval.ALL)
    assert one is not None
    shares = {part: float(np.mean(getattr(one, part))) for part in ("top1", "top5")}
    atomic_write(file, json.dumps({"encoder": mark, "queries": len(one.top1)} | shares) + "\n")


def found_table(folder: Path) -> str:
    """The shares of every encoder that has files in `folder`, in the mean over seeds; "" where none has."""
    rows = []
    for name in sorted({file.stem.removeprefix("found_").rsplit("_", 1)[0] for file in folder.glob("found_*.json")}):
        several = [json.loads(file.read_text()) for file in sorted(folder.glob(f"found_{name}_[0-9]*.json"))]
        rows.append((name, *(f"{100 * np.mean([one[part] for one in several]):.1f} %" for part in ("top1", "top5"))))
    return markdown(("encoder", "first of 50", "among the first five"), rows) if rows else ""
