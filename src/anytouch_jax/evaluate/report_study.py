"""The study of a report: chosen touches, embedded by each encoder and by baselines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Array, Log
from anytouch_jax.encoder.embed import embed_rows, rows_with_gel
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.feature_cache import background_difference
from anytouch_jax.evaluate.report_rows import chosen_touches

PIXELS = "pixels minus background"
VECTOR = "area, centroid, force"


@dataclass(frozen=True, eq=False)
class Study:
    """The chosen rows of a manifest with the features of each encoder.

    `classes` are class tokens, `patches` means of the patch tokens.
    """

    manifest: Manifest
    rows: Array
    split: Array
    classes: dict[str, Array]
    patches: dict[str, Array]
    pixels: Array | None
    notes: tuple[str, ...]

    def test(self, values: Array) -> Array:
        """Return those of `values`, one a row, that are of split test."""
        return values[self.split == "test"]


def study_of(
    table: Manifest, encoders: Mapping[str, Encoder], touches: int, seed: int, log: Log
) -> Study:
    """Embed at most `touches` of test, and half as many of train and of val, by each encoder.

    Args:
        table: the frames.
        encoders: by name.
        touches: most of split test.
        seed: of the choice.
        log: takes a sentence on each encoder.
    """
    most = {"train": touches // 2, "val": touches // 2, "test": touches}
    rows = np.concatenate(
        [chosen_touches(table, name, count, seed) for name, count in most.items()]
    )
    classes = {}
    patches = {}
    backgrounds = Backgrounds(table)
    for encoder in encoders.values():
        rows = rows_with_gel(encoder, backgrounds, rows, log)
    for name, encoder in encoders.items():
        values = embed_rows(encoder, table, rows, pooling="both", backgrounds=backgrounds, log=log)[
            1
        ]
        width = encoder.config.model.embed
        # What a trunk adds, `nn.sight`, follows both.
        classes[name], patches[name], _ = np.split(values, [width, 2 * width], axis=1)
    pixels, notes = baseline(PIXELS, lambda: background_difference(table, rows, backgrounds))
    return Study(
        table, rows, table.text_column("split")[rows], classes, patches, pixels, tuple(notes)
    )


def baseline(name: str, make: Callable[[], Array]) -> tuple[Array | None, list[str]]:
    """Return features of a baseline, or None and a note on why there are none."""
    try:
        return make(), []
    except UserError as error:
        return None, [f"no baseline by {name}: {error}"]
