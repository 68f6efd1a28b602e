"""The simulated corpus of the shipped encoders, in shards that are made one after another.

    python -m experiments.encoders.corpus data/corpus --touches 4000

The same command again continues. Each shard is a data set with a manifest. All have the same objects and
splits. `label.contact` comes from the simulator's depth, so that no picture has to be judged.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from anytouch_jax.files import atomic_path
from anytouch_jax.sim.dataset import simulate
from anytouch_jax.sim.scene import Scenes
from anytouch_jax.train.mesh import enable_compilation_cache

SENSORS = ("gelsight_mini", "digit", "gelsight", "gelslim", "duragel", "9dtact")
SHARD = 850  # touches, each by every sensor
GRADES = ("fine", "fine", "coarse", "fine")  # coarse: each sensor touches as by hand
TOUCHED = 0.08  # mm of the deepest point that count as contact


def mark_contact(manifest: Path) -> None:
    """Add `label.contact` to a simulated manifest: whether the object presses deeper than TOUCHED mm."""
    table = pq.read_table(manifest)
    if "label.contact" in table.column_names:
        return
    depth = table["label.depth"]
    contact = pc.cast(pc.greater(depth, TOUCHED), pa.int8())
    with atomic_path(manifest) as part:
        pq.write_table(table.append_column("label.contact", contact), part)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--touches", type=int, default=3400)
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--grades", nargs="+", default=GRADES, choices=set(GRADES), help="of one shard after the other")
    parser.add_argument("--seed", type=int, default=41)
    options = parser.parse_args()
    enable_compilation_cache()  # each shard compiles the same programs
    begun = time.monotonic()
    for first in range(0, options.touches, SHARD):
        scenes = Scenes(
            touches=min(SHARD, options.touches - first), sensors=SENSORS, seed=options.seed,
            grade=options.grades[first // SHARD % len(options.grades)], depth=(0.15, 1.0),
            frames=options.frames, objects=480, size=128, first=first,
            vision=0.4, text=0.7,
        )  # fmt: skip
        mark_contact(simulate(scenes, options.out / f"{first:05d}"))
        print(f"{first + scenes.touches} of {options.touches} touches, {time.monotonic() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
