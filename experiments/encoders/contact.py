"""Contact of single frames: the network against the difference from a picture of the untouched gel.

    python -m experiments.encoders.contact simulated data/scenes/manifest.parquet --split test
    python -m experiments.encoders.contact real ../shared/real_touch2/manifest.csv

Both readers get the unit's own picture, an estimate from frames by `anytouch data contact`, or none. The reference is
`label.force`, or else `label.contact_score`: 0 and 3 are untouched, above 0.05 N and 7 is contact.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.prepare.contact import DEFAULT_THRESHOLD, THRESHOLDS, contact_scores, spread
from anytouch_jax.data.prepare.untouched_gel import UntouchedGel
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.evaluate.statistics import Array
from experiments.real.trust import auroc, over_groups
from experiments.records import write_record

LIMITS = {"label.force": (0.0, 0.05), "label.contact_score": (3.0, 7.0)}  # untouched up to, contact above
SHARE = 98  # percentile of a picture's probabilities of contact, as of its difference


def reference(table: manifests.Manifest) -> Array:
    """Return contact of every row f64 (rows,): 1, 0, or NaN where the reference does not say."""
    name = next(name for name in LIMITS if name in table.table.column_names)
    value, (free, pressed) = table.number_column(name), LIMITS[name]
    return np.where(value > pressed, 1.0, np.where(value <= free, 0.0, np.nan))


def by_network(encoder: Encoder, table: manifests.Manifest, rows: Array, gels: list[Any]) -> Array:
    """Return a probability of contact f64 (n,) of `rows`, each with its untouched gel u8 (h, w, 3) or None."""
    sensors, scores, size = table.text_column("sensor"), list[Array](), 64
    for start in range(0, len(rows), size):
        some = rows[start : start + size]
        frames = [decode(table.file(int(row))) for row in some]
        ready = [encoder.preprocess(frame, gel) for frame, gel in zip(frames, gels[start:], strict=False)]
        numbers = np.array([encoder.sensor_row(sensors[row]) for row in some], np.int32)
        aspect = np.array([np.log(frame.shape[0] / frame.shape[1]) for frame in frames], np.float32)
        out = encoder.encode_and_measure(np.stack(ready)[:, None], numbers, aspect)[1]
        scores.append(np.percentile(np.asarray(out.contact, np.float64), SHARE, axis=(1, 2)))
    return 1 / (1 + np.exp(-np.concatenate(scores)))


def compare(encoder: Encoder, table: manifests.Manifest, rows: Array) -> dict[str, tuple[Array, Array]]:
    """Return the scores of every reader on `rows`, f64 (n,), NaN if undecided, with the limits of contact (n,)."""
    limits = np.array([THRESHOLDS.get(one, DEFAULT_THRESHOLD) for one in table.text_column("sensor")[rows]])
    half, estimated = np.full(len(rows), 0.5), np.full(len(table), None, object)
    alone = manifests.replace_column(table, "background_path", [None] * len(table))
    sequence = table.codes("sequence", own=True)
    found = contact_scores(alone, np.flatnonzero(np.isin(sequence, sequence[rows])))
    for members, gel in found.gels:
        estimated[members] = gel
    own = [decode(table.file(int(row), "background_path")) for row in rows]
    difference = [UntouchedGel(gel).score(decode(table.file(int(row)))) for row, gel in zip(rows, own, strict=True)]
    network, known = partial(by_network, encoder, table), np.array([one is not None for one in estimated[rows]])
    with_estimate = np.full(len(rows), np.nan)
    with_estimate[known] = network(rows[known], [gel.picture for gel in estimated[rows[known]]])
    return {
        "difference, own picture": (np.array(difference), limits), "network, own picture": (network(rows, own), half),
        "difference, estimated picture": (found.score[rows].astype(float), limits),
        "network, estimated picture": (with_estimate, half),
        "network, no picture": (network(rows, [None] * len(rows)), half),
    }  # fmt: skip


def figures(score: Array, limit: Array, truth: Array, groups: Array) -> dict[str, Any]:
    """Return shares with their intervals over groups: AUROC, contact found, false alarms, and frames decided."""
    known = ~np.isnan(score)

    def share(kind: int) -> list[float]:
        chosen = known & (truth == kind)
        return over_groups(lambda i: float((score > limit)[chosen][i].mean()), groups[chosen])

    def area(i: Array) -> float:
        free, pressed = (score[known][i][truth[known][i] == kind] for kind in (0, 1))
        return auroc(free, pressed) if len(free) and len(pressed) else np.nan

    decided = over_groups(lambda i: float(known[i].mean()), groups)
    return {"auroc": over_groups(area, groups[known]), "hits": share(1), "alarms": share(0), "decided": decided}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", help="of the frames")
    parser.add_argument("data", type=Path, help="manifest")
    parser.add_argument("--model", default="anytouch-tiny")
    parser.add_argument("--split", default="", help="of the frames (default: all)")
    parser.add_argument("--most", type=int, default=600, help="frames with contact, and as many without")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/contact.jsonl"))
    given = parser.parse_args()
    table = manifests.read(given.data)
    table = manifests.select_rows(table, np.flatnonzero(table.text_column("split") != "background"))  # no free rows
    split, truth = table.text_column("split"), reference(table)
    usable = table.present("background_path") & ((split == given.split) | (not given.split))
    rows = np.sort(np.concatenate([spread(np.flatnonzero(usable & (truth == kind)), given.most) for kind in (0, 1)]))
    groups = table.text_column("sequence")[rows]
    for reader, (score, limit) in compare(load_encoder(given.model), table, rows).items():
        record = figures(score, limit, truth[rows], groups)
        write_record(given.out, f"{given.name}, {reader}", {"encoder": given.model, "frames": len(rows)} | record)
        print(given.name, reader, {name: np.round(value, 3).tolist() for name, value in record.items()}, flush=True)


if __name__ == "__main__":
    main()
