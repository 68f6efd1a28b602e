"""Estimates of the untouched gel: how many recordings `anytouch data contact` decides, and how well.

    anytouch data simulate --out data/units --touches 60 --sensors gelsight_mini digit gelsight 9dtact duragel gelslim \
        --units one --size 240 --seed 46
    python -m experiments.benchmarks.untouched_gel data/units/manifest.parquet

Films are made of simulated frames, pressed for some share of the time. Light and noise change from frame to frame. A
line a sensor goes to `experiments/results/untouched_gel.jsonl`. `make results` makes the page from that file alone.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tyro.conf import Positional

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.prepare.contact import contact_scores, threshold_of_rows
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import markdown_table
from experiments.command import run_script
from experiments.encoders.corpus import TOUCHED
from experiments.records import write_record

NAME = "untouched_gel.jsonl"
WAYS = "alone", "with a picture of the gel"


@dataclass(frozen=True)
class GelOptions:
    """Decide contact in films that are pressed for a share of the time, without a picture of the untouched gel."""

    data: Positional[tuple[Path, ...]]  # Manifests of `anytouch data simulate --units one`.
    films: int = 20  # Films of a sensor and share.
    frames: int = 30  # Frames of a film.
    pressed: tuple[int, ...] = (10, 50, 75, 95)  # Percent of the frames that are pressed.
    out: Path = Path(__file__).parents[1] / "results" / NAME  # JSON lines.


def made_films(table: manifests.Manifest, sensor: str, percent: int, options: GelOptions) -> Iterator[Any]:
    """Yield the frames u8 (n, h, w, 3) of a film, which are pressed (n,), and the untouched gel u8 (h, w, 3).

    Each film is made of one simulated recording. Raises UserError for too few recordings with a free frame.
    """
    rows = np.flatnonzero((table.text_column("sensor") == sensor) & (table.text_column("split") != "background"))
    depth = np.asarray(table.table["label.depth"].to_pylist(), float)
    sequence, count, pressed = table.text_column("sequence"), options.frames, np.zeros(options.frames, bool)
    start = (count - round(percent * count / 100)) // 2
    pressed[start : start + round(percent * count / 100)] = True
    made = 0
    for name in dict.fromkeys(sequence[rows]):
        own = rows[sequence[rows] == name]
        kinds = {True: own[depth[own] > TOUCHED], False: own[depth[own] == 0]}
        if made == options.films:
            return
        if len(kinds[True]) < 3 or not len(kinds[False]):
            continue
        rng, frames = np.random.default_rng([percent, made]), []
        pictures = {kind: [decode(table.file(row)) for row in some] for kind, some in kinds.items()}
        for at, kind in enumerate(pressed.tolist()):
            frame = pictures[kind][at % len(pictures[kind])] * (1 + rng.normal(0, 0.005))
            frames.append(np.clip(frame + rng.normal(0, 1.2, frame.shape), 0, 255).astype(np.uint8))
        made += 1
        yield frames, pressed, decode(table.file(own[0], "background_path"))
    raise UserError(f"There are only {made} recordings of {sensor} with a free frame. Simulate more touches.")


def decided(table: manifests.Manifest, sensor: str, percent: int, options: GelOptions) -> dict[str, dict[str, int]]:
    """Return the counts of films decided and inverted and of frames that are right, in each of WAYS."""
    results, rows = {}, list[tuple[str, int, int]]()
    truth = list[np.ndarray]()
    with tempfile.TemporaryDirectory() as folder:
        for film, (frames, pressed, gel) in enumerate(made_films(table, sensor, percent, options)):
            for at, frame in enumerate(frames):
                cv2.imwrite(f"{folder}/{film}_{at}.png", frame[..., ::-1])
                rows.append((f"{film}_{at}.png", film, at))
            cv2.imwrite(f"{folder}/gel{film}.png", gel[..., ::-1])
            truth.append(pressed)
        paths, films, numbers = (list(column) for column in zip(*rows, strict=True))
        columns = {
            "path": paths, "sensor": [sensor] * len(rows), "sequence": [f"film {film}" for film in films],
            "frame_index": numbers, "split": ["train"] * len(rows),
        }  # fmt: skip
        gels = [f"gel{film}.png" for film in films]
        more: tuple[dict[str, list[str]], ...] = {}, {"background_path": gels}
        for way, others in zip(WAYS, more, strict=True):
            manifest = manifests.from_columns(columns | others, Path(folder) / "m.csv")
            score, limit = contact_scores(manifest).score, threshold_of_rows(manifest, None, 0.0)[0]
            score = score.reshape(len(truth), -1)
            known = [(one > limit, true) for one, true in zip(score, truth, strict=True) if np.isfinite(one).all()]
            results[way] = {
                "films": len(truth), "decided": len(known), "frames": len(known) * options.frames,
                "right": sum(int((found == true).sum()) for found, true in known),
                "inverted": sum(bool(found[~true].mean() > found[true].mean()) for found, true in known),
            }  # fmt: skip
    return results


def run(options: GelOptions) -> int:
    """Measure every sensor of the manifests, store the counts and print a table."""
    table = manifests.read(options.data)
    for sensor in sorted(set(table.text_column("sensor"))):
        shares = {str(percent): decided(table, sensor, percent, options) for percent in options.pressed}
        side = min(decode(table.file(int(np.flatnonzero(table.text_column("sensor") == sensor)[0]))).shape[:2])
        write_record(options.out, f"{sensor}, {side} pixels", {"pressed": shares})
        rows = [(f"{share} %", way, *map(str, one.values())) for share, both in shares.items()
                for way, one in both.items()]  # fmt: skip
        print(markdown_table((sensor, "way", "films", "decided", "frames", "right", "inverted"), rows), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run_script(GelOptions, run))
